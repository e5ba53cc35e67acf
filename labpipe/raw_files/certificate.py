"""Calibration certificates: the Digital Calibration Certificate (DCC) of PTB, XML of schema 3, and tables of
plain certificates as CSV. They are read without a network, entities or a schema file: compared with what the
published schema 3 (https://ptb.de/dcc) asks for where a number, its unit, uncertainty, validity or identity
depends on it. A signature inside the XML is not verified.
"""

from __future__ import annotations

import calendar
import csv
import datetime
import hashlib
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

from labpipe.quantities import UnitError, parse_value
from labpipe.registry import nearest

DCC, SI = "{https://ptb.de/dcc}", "{https://ptb.de/si}"
MOST_BYTES, DEEPEST = 1 << 24, 200
HINT = "a DCC of schema 3 is needed, as the laboratory issued it"

# Names of D-SI units, which are written as \milli\volt\per\metre\tothe{2}, and what labpipe calls them.
_UNITS = {
    "one": "1", "percent": "%", "metre": "m", "gram": "g", "kilogram": "kg", "second": "s", "ampere": "A",
    "kelvin": "K", "degreecelsius": "degC", "newton": "N", "pascal": "Pa", "bar": "bar", "joule": "J",
    "watt": "W", "volt": "V", "henry": "H", "tesla": "T", "weber": "Wb", "coulomb": "C", "hertz": "Hz",
    "radian": "rad", "degree": "deg", "minute": "min", "hour": "h", "litre": "l", "tonne": "t",
}  # fmt: skip
_PREFIXES = {
    "giga": "G", "mega": "M", "kilo": "k", "deci": "d", "centi": "c", "milli": "m", "micro": "u", "nano": "n",
    "pico": "p",
}  # fmt: skip
_TOKEN = re.compile(r"\s*\\([a-z]+)(?:\{([^{}]*)\})?")


@dataclass(frozen=True)
class CertifiedQuantity:
    """A quantity of a certificate: the *names* by which it may be asked for, its *values* in *unit* as
    labpipe writes it, and their standard uncertainties [unit], None where none is stated. table: number of
    the table in which it stands, by which columns belong together. serials: of what was calibrated, where
    the certificate states them for each quantity.
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    unit: str
    std_errors: tuple[float, ...] | None
    table: int
    serials: tuple[str, ...] = ()


@dataclass(frozen=True)
class Certificate:
    """A certificate: its *number*, serial and other numbers of what was calibrated, the last day on which it
    is valid (None: not stated), and what it states. *refused*: why it must not be used.
    """

    number: str
    serials: tuple[str, ...]
    valid_until: datetime.date | None
    quantities: tuple[CertifiedQuantity, ...]
    refused: str = ""

    def quantity(self, name: str, table: int | None = None) -> CertifiedQuantity:
        """The quantity of a name, in a table if one is given; UnitError for none, or for several."""
        quantities = [quantity for quantity in self.quantities if table is None or quantity.table == table]
        named = [quantity for quantity in quantities if name in quantity.names]
        if len(named) == 1:
            return named[0]
        if named:
            raise UnitError(f"the certificate has {len(named)} quantities '{name}'", "name one by its id")
        names = list(dict.fromkeys(name for quantity in quantities for name in quantity.names))
        hint = nearest(name, names) or f"known: {', '.join(names[:12])}"
        raise UnitError(f"the certificate has no quantity '{name}'", hint)


def read_certificate(path: Path, number: str = "", sha256: str = "") -> Certificate:
    """The certificate of a file, of a table of several that of the *number*. *sha256*: what the digest must
    be, if given. UnitError for a file that cannot be read, is no certificate, or another one.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise UnitError(f"'{path.name}' has more than {MOST_BYTES >> 20} MB", HINT)
        content = path.read_bytes()
    except OSError as error:
        what = "no such file" if not path.exists() else (error.strerror or str(error)).lower()
        raise UnitError(f"'{path.name}': {what}", "paths are relative to the file that names them") from None
    if sha256 and hashlib.sha256(content).hexdigest() != sha256.lower():
        raise UnitError(f"'{path.name}' is not the file of that SHA-256", "use the file as it was issued")
    if path.suffix.lower() == ".csv":
        return _read_table(content, path.name, number)
    certificate = _of_xml(content, path.name)
    if number and certificate.number != number:
        raise UnitError(f"'{path.name}' is the certificate '{certificate.number}', not '{number}'")
    return certificate


def _of_xml(content: bytes, name: str) -> Certificate:
    root = _parse(content, name)
    if root.tag != f"{DCC}digitalCalibrationCertificate":
        raise UnitError(f"'{name}' is not a Digital Calibration Certificate", HINT)
    if not re.fullmatch(r"3\.\d+\.\d+\S*", root.get("schemaVersion", "")):
        raise UnitError(f"'{name}' is of schema '{root.get('schemaVersion', '')}'", HINT)
    try:
        _check_children(root, ("administrativeData", "measurementResults"), ("comment", "document"))
        administrative = _only(root, "administrativeData")
        needed = ("dccSoftware", "coreData", "items", "calibrationLaboratory", "respPersons", "customer")
        _check_children(administrative, needed, ("refTypeDefinitions", "statements"))
        core = _only(administrative, "coreData")
        number = _text(_only(core, "uniqueIdentifier"))
        begin, end = (_day(_only(core, f"{at}PerformanceDate")) for at in ("begin", "end"))
        if end < begin:
            raise UnitError("its calibration ends before it begins")
        valid_until, refused = _validity(administrative, end)
        items = _only(administrative, "items")
        if items.find(f"{DCC}item") is None:
            raise UnitError("'items' has no 'item'")
        return Certificate(
            number=number,
            serials=tuple(map(_text, items.iterfind(f".//{DCC}identification/{DCC}value"))),
            valid_until=valid_until,
            quantities=tuple(_quantities(_only(root, "measurementResults"))),
            refused=refused,
        )
    except UnitError as error:
        raise UnitError(f"'{name}' is not a valid certificate: {error.what}", error.hint or HINT) from None


def _parse(content: bytes, name: str) -> ET.Element:
    """The tree of an XML file that declares no document type, so that it can hold no entities of its own."""
    depth = 0

    def refuse(*_: object) -> None:
        raise UnitError(f"'{name}' declares a document type, which no certificate needs", HINT)

    def deeper(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise UnitError(f"'{name}' is nested too deeply", HINT)

    def back(*_: object) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = deeper, back
    try:
        parser.Parse(content, True)
        return ET.fromstring(content)
    except (expat.ExpatError, ET.ParseError, ValueError, LookupError) as error:
        raise UnitError(f"'{name}' is not a readable XML ({error})", HINT) from None


def _local(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2]


def _check_children(element: ET.Element, needed: Sequence[str], others: Sequence[str] = ()) -> None:
    names = [child.tag for child in element if not child.tag.endswith("}Signature")]
    for tag in names:
        if tag.removeprefix(DCC) not in (*needed, *others):
            raise UnitError(f"unknown element '{tag.rpartition('}')[2]}' in '{_local(element)}'")
        if names.count(tag) > 1:
            raise UnitError(f"'{tag.rpartition('}')[2]}' is there twice")
    for child in needed:
        _only(element, child)


def _only(element: ET.Element, name: str, space: str = DCC) -> ET.Element:
    children = element.findall(f"{space}{name}")
    if len(children) != 1:
        what = f"'{_local(element)}' has no '{name}'" if not children else f"'{name}' is there twice"
        raise UnitError(what)
    return children[0]


def _text(element: ET.Element) -> str:
    text = (element.text or "").strip()
    if not text or len(element):
        raise UnitError(f"'{_local(element)}' is empty")
    return " ".join(text.split())


def _day(element: ET.Element) -> datetime.date:
    text = _text(element)
    try:
        # A time zone behind a date moves it by less than a day.
        return datetime.date.fromisoformat(text[:10])
    except ValueError:
        raise UnitError(f"'{_local(element)}' is '{text}', which is not a day") from None


def _validity(administrative: ET.Element, end: datetime.date) -> tuple[datetime.date | None, str]:
    days: list[datetime.date] = []
    refused = ""
    for statement in administrative.iterfind(f"{DCC}statements/{DCC}statement"):
        kinds = (statement.get("refType") or "").lower()
        valid = statement.find(f"{DCC}valid")
        if valid is not None and _text(valid) in ("false", "0"):
            refused = "the laboratory states that it is not valid"
        if "recalibration" in kinds or ("valid" in kinds and "from" not in kinds):
            days += [_day(day) for day in statement.iterfind(f"{DCC}date")]
            days += [_after(end, _text(period)) for period in statement.iterfind(f"{DCC}period")]
    return (min(days) if days else None), refused


_PERIOD = re.compile(r"P(?:(\d+)Y)?(?:(\d+)M)?(?:(\d+)D)?")


def _after(day: datetime.date, period: str) -> datetime.date:
    match = _PERIOD.fullmatch(period)
    if match is None or not any(match.groups()):
        raise UnitError(f"the period '{period}' is not in years, months and days")
    years, months, days = (int(part or 0) for part in match.groups())
    month = day.year * 12 + day.month - 1 + 12 * years + months
    try:
        # A month ends with its last day: 31 January and a month is 28 February.
        last = calendar.monthrange(month // 12, month % 12 + 1)[1]
        return datetime.date(month // 12, month % 12 + 1, min(day.day, last)) + datetime.timedelta(days)
    except (ValueError, OverflowError):
        raise UnitError(f"the period '{period}' is too long") from None


def _quantities(results: ET.Element) -> Iterator[CertifiedQuantity]:
    table = 0
    for result in results.iterfind(f"{DCC}measurementResult/{DCC}results/{DCC}result"):
        pending = [_only(result, "data")]
        while pending:
            owner = pending.pop(0)
            table += 1
            for quantity in owner.iterfind(f"{DCC}quantity"):
                yield from _quantity(quantity, table)
            pending += owner.findall(f"{DCC}list")


def _quantity(quantity: ET.Element, table: int) -> Iterator[CertifiedQuantity]:
    """A quantity with every number that it states: of a hybrid one for each unit; of texts none."""
    contents = quantity.findall(f"{DCC}name/{DCC}content")
    names = [quantity.get("id") or "", *(quantity.get("refType") or "").split()]
    names += [" ".join((content.text or "").split()) for content in contents]
    numbers = [child for child in quantity if child.tag.startswith(SI)]
    if len(numbers) > 1:
        raise UnitError(f"the quantity '{next(filter(None, names), '')}' has several numbers")
    hybrid = [child for child in numbers if _local(child) == "hybrid"]
    for number in [*hybrid[0]] if hybrid else numbers:
        if _local(number) not in _NUMBERS:
            continue
        end = _NUMBERS[_local(number)]
        values = _listing(number, f"value{end}")
        # A list has one unit for all, or one for each.
        text = _text(_only(number, f"unit{end}", SI))
        units = dict.fromkeys(text.split() if end else [text])
        if len(units) > 1:
            raise UnitError(f"a list of numbers has several units: {', '.join(units)}")
        unit = unit_text(next(iter(units)))
        errors = _std_errors(number, end, len(values))
        if hybrid and number is not hybrid[0][0]:
            # Another unit of the same: the first one is what the laboratory states.
            continue
        yield CertifiedQuantity(tuple(filter(None, names)), values, unit, errors, table)


# Elements that hold numbers, and how the names of their parts end.
_NUMBERS = {"real": "", "realListXMLList": "XMLList", "constant": ""}
_PARTS = ("label", "value", "unit", "dateTime", "significantDigit", "quantityType")
# Ways to state an uncertainty: the elements, that of its size, and what it is divided by.
_UNCERTAINTIES = (
    (("expandedUnc",), "uncertainty", "coverageFactor"),
    (("measurementUncertaintyUnivariate", "expandedMU"), "valueExpandedMU", "coverageFactor"),
    (("measurementUncertaintyUnivariate", "standardMU"), "valueStandardMU", ""),
    (("coverageInterval",), "standardUnc", ""),
    (("measurementUncertaintyUnivariate", "coverageIntervalMU"), "standardMU", ""),
)


def _std_errors(number: ET.Element, end: str, count: int) -> tuple[float, ...] | None:
    """The standard uncertainties of a number or a list; one for all of a list may be stated once."""
    elements = {f"{part}{end}" for part in (*_PARTS, *(path[0] for path, _, _ in _UNCERTAINTIES))}
    elements |= {f"{part}{ending}" for part in ("uncertainty", "distribution") for ending in ("", end)}
    for child in number:
        if not child.tag.startswith(SI) or _local(child) not in elements:
            raise UnitError(f"unknown element '{_local(child)}' in '{_local(number)}'")
    stated = [
        (element, size, factor)
        for path, size, factor in _UNCERTAINTIES
        for element in number.findall("/".join(f"{SI}{part}{end}" for part in path))
    ]
    blocks = [child for child in number if "nc" in _local(child) or "Interval" in _local(child)]
    if len(stated) > 1 or len(blocks) > len(stated):
        raise UnitError(f"the uncertainty in '{_local(number)}' is stated twice, or in an unknown form")
    if not stated:
        return None
    element, size, factor = stated[0]
    sizes = _repeat_single(_listing(element, f"{size}{end}"), count)
    factors = _listing(element, f"{factor}{end}") if factor else (1.0,)
    return _quotients(sizes, _repeat_single(factors, count))


def _quotients(sizes: Sequence[float], factors: Sequence[float]) -> tuple[float, ...]:
    if any(not k > 0 for k in factors) or any(u < 0 for u in sizes):
        raise UnitError("an uncertainty is negative, or its coverage factor is not above zero")
    return tuple(u / k for u, k in zip(sizes, factors, strict=True))


def _repeat_single(values: tuple[float, ...], count: int) -> tuple[float, ...]:
    if len(values) not in (1, count):
        raise UnitError(f"{len(values)} entries stand beside {count} values")
    return values * count if len(values) == 1 else values


def _listing(element: ET.Element, name: str) -> tuple[float, ...]:
    return tuple(_finite(text, name) for text in _text(_only(element, name, SI)).split())


def _finite(text: str, name: str) -> float:
    if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", text) or not math.isfinite(float(text)):
        raise UnitError(f"'{name}' has '{text[:80]}', which is not a number")
    return float(text)


def unit_text(text: str) -> str:
    r"""A D-SI unit as labpipe writes it: \\milli\\volt\\per\\metre is mV.m^-1; UnitError for none."""
    if "\\" not in text:
        return text
    parts: list[list[str]] = []
    prefix, sign, place = "", "", 0
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            raise UnitError(f"the unit '{text[:80]}' is not of D-SI")
        word, power = match[1], match[2]
        place = match.end()
        if word == "tothe" and parts and power and re.fullmatch(r"[+-]?\d+(\.\d+)?", power) and not prefix:
            if parts[-1][1] and power[0] == "-":
                raise UnitError(f"a negative power '{power}' behind \\per is ambiguous")
            parts[-1][1] += power.lstrip("+")
        elif power is None and word == "per" and not sign and not prefix:
            sign = "-"
        elif power is None and word in _PREFIXES and not prefix:
            prefix = _PREFIXES[word]
        elif power is None and word in _UNITS:
            parts.append([prefix + _UNITS[word], sign])
            prefix = sign = ""
        else:
            raise UnitError(f"the unit '{text[:80]}' is not known at '\\{word}'")
    if prefix or sign or not parts:
        raise UnitError(f"the unit '{text[:80]}' ends too early")
    powers = {"": "", "-": "^-1"}
    return ".".join(symbol + powers.get(power, f"^{power}") for symbol, power in parts)


_UNIT_PART = re.compile(r"([./]?)\(?([A-Za-z%]+|1)(?:\^\(?([+-]?\d+(?:\.\d+)?)\)?)?\)?")


def dsi_unit(text: str) -> str:
    r"""N.s/m as D-SI writes it, \newton\second\per\metre; the text as it is where D-SI has no name for it."""
    names = {symbol: name for name, symbol in _UNITS.items()}
    written, place, per = "", 0, False
    while place < len(text):
        match = _UNIT_PART.match(text, place)
        if match is None or match[2] not in names:
            return text
        per = per or match[1] == "/"
        power = f"\\tothe{{{match[3]}}}" if match[3] else ""
        written += ("\\per" if per else "") + f"\\{names[match[2]]}{power}"
        place = match.end()
    return written


NEEDED = ("certificate", "quantity", "value", "unit", "uncertainty", "coverage_factor")
OPTIONAL = ("serial", "valid_until", "frequency_hz", "phase_deg", "phase_uncertainty_deg")
FREQUENCY, PHASE = "frequency_hz", "phase_deg"


def _read_table(content: bytes, name: str, number: str) -> Certificate:
    rows = _rows(content, name)
    numbers = list(dict.fromkeys(row["certificate"] for row in rows))
    if not number and len(numbers) > 1:
        raise UnitError(f"'{name}' holds {len(numbers)} certificates", f"add number: {numbers[0]}")
    if number and number not in numbers:
        raise UnitError(f"'{name}' holds no certificate '{number}'", nearest(number, numbers))
    rows = [row for row in rows if row["certificate"] == (number or numbers[0])]
    names = list(dict.fromkeys(row["quantity"] for row in rows))
    try:
        days = [_day_of(row["valid_until"]) for row in rows if row.get("valid_until")]
        quantities = tuple(
            quantity
            for table, named in enumerate(names)
            for quantity in _columns(named, [row for row in rows if row["quantity"] == named], table)
        )
    except UnitError as error:
        raise UnitError(f"'{name}': {error.what}", error.hint) from None
    return Certificate(rows[0]["certificate"], _serials_of(rows), min(days, default=None), quantities)


def _serials_of(rows: Sequence[dict[str, str]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(row["serial"] for row in rows if row.get("serial")))


def _day_of(text: str) -> datetime.date:
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        raise UnitError(f"'{text}' is not a day", "write it as 2026-11-03") from None


def _rows(content: bytes, name: str) -> list[dict[str, str]]:
    try:
        lines = [line for line in content.decode("utf-8-sig").splitlines() if line.strip() and line[0] != "#"]
    except UnicodeDecodeError:
        raise UnitError(f"'{name}' is not a text table", f"columns: {', '.join(NEEDED)}") from None
    reader = list(csv.reader(lines, skipinitialspace=True))
    heads = [cell.strip() for cell in reader[0]] if reader else []
    missing = [column for column in NEEDED if column not in heads]
    unknown = [column for column in heads if column not in (*NEEDED, *OPTIONAL)]
    if missing or unknown or len(set(heads)) < len(heads):
        what = f"has no column '{missing[0]}'" if missing else f"has an unknown or repeated column in {heads}"
        raise UnitError(f"'{name}' {what}", f"columns: {', '.join((*NEEDED, *OPTIONAL))}")
    if any(len(row) != len(heads) for row in reader[1:]) or len(reader) < 2:
        raise UnitError(f"'{name}' has no rows, or one with more or fewer cells than columns")
    return [dict(zip(heads, (cell.strip() for cell in row), strict=True)) for row in reader[1:]]


def _columns(named: str, rows: Sequence[dict[str, str]], table: int) -> Iterator[CertifiedQuantity]:
    units = {row["unit"] for row in rows}
    if len(units) > 1:
        raise UnitError(f"'{named}' has several units: {', '.join(sorted(units))}")

    def column(key: str) -> tuple[float, ...]:
        return tuple(_finite(row[key], key) for row in rows)

    def relative(text: str, value: str) -> float:
        if text.endswith("%"):
            return abs(_finite(value, "value")) * parse_value(text, "1")
        return _finite(text, "uncertainty")

    sizes = [relative(row["uncertainty"], row["value"]) for row in rows]
    factors = column("coverage_factor")
    errors = _quotients(sizes, factors)
    yield CertifiedQuantity((named,), column("value"), units.pop(), errors, table, _serials_of(rows))
    if any(row.get(FREQUENCY) for row in rows):
        yield CertifiedQuantity((FREQUENCY,), column(FREQUENCY), "Hz", None, table)
    if any(row.get(PHASE) for row in rows):
        key = "phase_uncertainty_deg"
        of_phase = _quotients(column(key), factors) if key in rows[0] else None
        yield CertifiedQuantity((PHASE,), column(PHASE), "deg", of_phase, table)

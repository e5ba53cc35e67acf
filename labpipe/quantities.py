"""THE table of physical quantities, and the reading of values with units ("90 um", "134.5 kN/m").

Everything inside labpipe is in SI units, with frequencies in Hz and angles in rad. The conversion happens
here only.
"""

from __future__ import annotations

import difflib
import functools
import math
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import PurePath

from labpipe.errors import ConfigError, LabpipeError

# A dimension is the tuple of exponents of (m, kg, s, A, K, rad). The angle is kept apart from the pure number
# so that "45 deg" is refused where "0.5" is meant; Hz counts revolutions or periods, rad/s counts angle.
Dimension = tuple[float, float, float, float, float, float]

NONE: Dimension = (0, 0, 0, 0, 0, 0)


class UnitError(ValueError):
    """An unknown unit, an unreadable value, or a wrong dimension; carries a hint."""

    def __init__(self, what: str, hint: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint


@contextmanager
def locate_units(
    where: str | PurePath, kind: type[LabpipeError] = ConfigError, before: str = ""
) -> Iterator[None]:
    """A UnitError from within is an error of that *kind* at *where*, *before* ahead of its words."""
    try:
        yield
    except UnitError as error:
        raise kind(f"{before}{error.what}", where, error.hint) from None


@dataclass(frozen=True)
class Unit:
    """A unit: ``value [SI] = factor * value [unit] + offset``."""

    factor: float
    dimension: Dimension
    offset: float = 0.0


@dataclass(frozen=True)
class Quantity:
    """A physical quantity: its symbol, SI unit, and the unit people read in tables."""

    name: str
    symbol: str
    si_unit: str
    display_unit: str


def _dimension(
    m: float = 0, kg: float = 0, s: float = 0, a: float = 0, k: float = 0, rad: float = 0
) -> Dimension:
    return (m, kg, s, a, k, rad)


_G = 9.80665
_BASE: dict[str, Unit] = {
    "m": Unit(1.0, _dimension(m=1)),
    "g": Unit(1e-3, _dimension(kg=1)),
    "s": Unit(1.0, _dimension(s=1)),
    "A": Unit(1.0, _dimension(a=1)),
    "K": Unit(1.0, _dimension(k=1)),
    "rad": Unit(1.0, _dimension(rad=1)),
    "N": Unit(1.0, _dimension(m=1, kg=1, s=-2)),
    "Pa": Unit(1.0, _dimension(m=-1, kg=1, s=-2)),
    "bar": Unit(1e5, _dimension(m=-1, kg=1, s=-2)),
    "J": Unit(1.0, _dimension(m=2, kg=1, s=-2)),
    "W": Unit(1.0, _dimension(m=2, kg=1, s=-3)),
    "V": Unit(1.0, _dimension(m=2, kg=1, s=-3, a=-1)),
    "H": Unit(1.0, _dimension(m=2, kg=1, s=-2, a=-2)),
    "T": Unit(1.0, _dimension(kg=1, s=-2, a=-1)),
    "Wb": Unit(1.0, _dimension(m=2, kg=1, s=-2, a=-1)),
    "C": Unit(1.0, _dimension(s=1, a=1)),
    "Hz": Unit(1.0, _dimension(s=-1)),
    "strain": Unit(1.0, NONE),
    "gn": Unit(_G, _dimension(m=1, s=-2)),
}
_FIXED: dict[str, Unit] = {
    "1": Unit(1.0, NONE),
    "-": Unit(1.0, NONE),
    "%": Unit(1e-2, NONE),
    "ue": Unit(1e-6, NONE),
    "rpm": Unit(1 / 60, _dimension(s=-1)),
    "1/min": Unit(1 / 60, _dimension(s=-1)),
    "deg": Unit(math.pi / 180, _dimension(rad=1)),
    "°": Unit(math.pi / 180, _dimension(rad=1)),
    "l": Unit(1e-3, _dimension(m=3)),
    "L": Unit(1e-3, _dimension(m=3)),
    "min": Unit(60.0, _dimension(s=1)),
    "h": Unit(3600.0, _dimension(s=1)),
    "in": Unit(0.0254, _dimension(m=1)),
    "mil": Unit(2.54e-5, _dimension(m=1)),
    "ft": Unit(0.3048, _dimension(m=1)),
    "t": Unit(1e3, _dimension(kg=1)),
    "lb": Unit(0.45359237, _dimension(kg=1)),
    "lbf": Unit(0.45359237 * _G, _dimension(m=1, kg=1, s=-2)),
    "kgf": Unit(_G, _dimension(m=1, kg=1, s=-2)),
    "psi": Unit(0.45359237 * _G / 0.0254**2, _dimension(m=-1, kg=1, s=-2)),
    "degC": Unit(1.0, _dimension(k=1), 273.15),
    "°C": Unit(1.0, _dimension(k=1), 273.15),
    "degF": Unit(5 / 9, _dimension(k=1), 459.67 * 5 / 9),
    "°F": Unit(5 / 9, _dimension(k=1), 459.67 * 5 / 9),
}
_PREFIX = {
    "G": 1e9,
    "M": 1e6,
    "k": 1e3,
    "d": 1e-1,
    "c": 1e-2,
    "m": 1e-3,
    "u": 1e-6,
    "µ": 1e-6,
    "μ": 1e-6,
    "n": 1e-9,
    "p": 1e-12,
}

QUANTITIES: dict[str, Quantity] = {
    q.name: q
    for q in (
        Quantity("force", "F", "N", "N"),
        Quantity("moment", "M", "N.m", "N.m"),
        Quantity("displacement", "x", "m", "um"),
        Quantity("velocity", "v", "m/s", "mm/s"),
        Quantity("acceleration", "a", "m/s^2", "m/s^2"),
        Quantity("voltage", "U", "V", "V"),
        Quantity("current", "I", "A", "A"),
        Quantity("strain", "epsilon", "1", "ue"),
        Quantity("pressure", "p", "Pa", "bar"),
        Quantity("temperature", "T", "K", "degC"),
        Quantity("flow", "Q", "m^3/s", "l/min"),
        Quantity("tacho", "n", "V", "V"),
        Quantity("time", "t", "s", "s"),
        Quantity("frequency", "f", "Hz", "Hz"),
        Quantity("speed", "Omega", "Hz", "rpm"),
        Quantity("angle", "alpha", "rad", "deg"),
        Quantity("angular_velocity", "omega", "rad/s", "rad/s"),
        Quantity("angular_acceleration", "alpha", "rad/s^2", "rad/s^2"),
        Quantity("length", "l", "m", "mm"),
        Quantity("mass", "m", "kg", "kg"),
        Quantity("ratio", "r", "1", "%"),
        Quantity("stiffness", "k", "N/m", "kN/m"),
        Quantity("damping", "c", "N.s/m", "N.s/m"),
        Quantity("viscosity", "mu", "Pa.s", "Pa.s"),
        Quantity("receptance", "H", "m/N", "um/N"),
        Quantity("mobility", "Y", "m/(N.s)", "mm/(N.s)"),
        Quantity("accelerance", "A", "m/(N.s^2)", "m/(N.s^2)"),
        Quantity("transmissibility", "T", "1", "1"),
    )
}

# No number in SI units that a laboratory meets is larger, no signal smaller: squares of squares stay within
# what a computer holds, so that a slip of the keyboard ends at its place and not as an infinity in a result.
LARGEST, SMALLEST = 1e36, 1e-36
MOST_POWER = 20
MOST_FACTOR = 1e100
# Characters of a text from a file in a message.
ECHO = 80

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_VALUE = re.compile(rf"^\s*({_NUMBER})\s*(.*?)\s*$")
# The g of a gram that may as well be standard gravity, with the prefix of either; kg is a mass, always.
_GRAM = re.compile(r"(?<![^\W\d_])([mu]?)g(?![^\W\d_])")
_TOKEN = re.compile(r"\^\([^)]*\)|\^[+-]?\d+(?:\.\d+)?|[^\W\d_]+|[%°][CF]?|\d+|[/()]|[.*·\s]+|.")


def _simple_unit(symbol: str) -> Unit:
    if symbol in _FIXED:
        return _FIXED[symbol]
    if symbol in _BASE:
        return _BASE[symbol]
    if len(symbol) > 1 and symbol[0] in _PREFIX and symbol[1:] in _BASE:
        base = _BASE[symbol[1:]]
        return Unit(_PREFIX[symbol[0]] * base.factor, base.dimension)
    raise UnitError(f"unknown unit '{symbol}'", nearest_unit(symbol))


def nearest_unit(symbol: str) -> str:
    """The hint for an unknown unit: "did you mean 'um'?", or an empty text."""
    symbols = [*_BASE, *_FIXED, *(p + b for p in _PREFIX for b in ("m", "N", "g", "s", "A", "V", "Hz", "Pa"))]
    same_case = [k for k in symbols if k.lower() == symbol.lower()]
    one_letter = [
        k
        for k in symbols
        if len(k) == len(symbol) > 1 and sum(a != b for a, b in zip(k, symbol, strict=True)) == 1
    ]
    same_start = [k for k in one_letter if k[0] == symbol[0]]
    similar, alike = (difflib.get_close_matches(symbol, symbols, 1, cutoff) for cutoff in (0.75, 0.5))
    near = same_case or similar or same_start or alike
    return f"did you mean '{near[0]}'?" if near else ""


# A power as loggers print it, m/s2.
_BARE_POWER = re.compile(r"(?<![\w^])([a-zA-Zµμ]+)([234])(?![\w.])")


def _power(text: str) -> float:
    """The exponent behind '^': an integer, a decimal number or a fraction in parentheses."""
    match = re.fullmatch(r"\^\(?([+-]?\d+(?:\.\d+)?)(?:/(\d+))?\)?", text)
    if match is None:
        raise UnitError(f"unreadable exponent '{text}'", "write it as s^2 or m^(10/9)")
    divisor = float(match[2] or 1)
    power = float(match[1]) / divisor if divisor else math.inf
    if abs(power) > MOST_POWER:
        raise UnitError(f"no unit has the exponent '{text[:ECHO]}'", "write it as s^2 or m^(10/9)")
    return power


def _factors(text: str) -> list[tuple[str, float]]:
    """(symbol, power) of a compound unit; everything behind a '/' is divided by, up to the end of its
    parentheses.
    """
    factors: list[tuple[str, float]] = []
    # Of every open parenthesis, and of the last one that was closed: its sign, and the number of factors
    # before it.
    groups, sign, last = [(1.0, 0)], 1.0, 0
    for token in _TOKEN.findall(text):
        if token == "/":
            sign = -groups[-1][0]
        elif token == "(":
            groups.append((sign, len(factors)))
        elif token == ")" and len(groups) > 1:
            sign, last = groups.pop()
        elif token.startswith("^") and factors:
            factors[last:] = [(symbol, power * _power(token)) for symbol, power in factors[last:]]
        elif token.strip(" .*·()\t"):
            last = len(factors)
            factors.append((token, sign))
    if text.count("(") != text.count(")") or not factors:
        raise UnitError(f"unreadable unit '{text}'", "write it as N.s/m or m/(N.s^2)")
    return factors


# Lists and reports of thousands of values ask for the same few units.
@functools.lru_cache(maxsize=1024)
def parse_unit(text: str) -> Unit:
    """The unit written as *text*: products with '.', '*' or a blank, powers with '^', one '/' for the
    quotient.

    ``N.s/m``, ``m/(N.s^2)``, ``N/m^1.5`` are read as an engineer writes them, ``m/s2`` as a logger does.
    Raises UnitError with the nearest known unit.
    """
    if len(text) > ECHO:
        raise UnitError(f"unreadable unit '{text[: ECHO - 3]}...'", "write it as N.s/m or m/(N.s^2)")
    text = text.strip().replace("²", "^2").replace("³", "^3").replace("**", "^")
    text = _BARE_POWER.sub(r"\1^\2", text)
    if text in _FIXED:
        return _FIXED[text]
    if "%%" in text:
        raise UnitError(f"unknown unit '{text}'", "did you mean '%'?")
    factor, dimension = 1.0, list(NONE)
    factors = _factors(text)
    for symbol, power in factors:
        unit = _simple_unit(symbol)
        if unit.offset and len(factors) > 1:
            raise UnitError(f"'{symbol}' has an offset and cannot be part of a compound unit", "use K")
        factor *= unit.factor**power
        if not 1 / MOST_FACTOR <= factor <= MOST_FACTOR:
            raise UnitError(f"the unit '{text[:ECHO]}' is too large or too small")
        dimension = [d + power * u for d, u in zip(dimension, unit.dimension, strict=True)]
    return Unit(factor, (dimension[0], dimension[1], dimension[2], dimension[3], dimension[4], dimension[5]))


def readings(text: str) -> tuple[Unit, ...]:
    """The units that *text* may mean: g is the gram, and for those who measure accelerations standard gravity
    ("g/N", "mV/g"); C alone is the coulomb, and of a thermometer the degree Celsius.

    Raises UnitError as parse_unit does.
    """
    if text.strip() == "C":
        return parse_unit("C"), parse_unit("degC")
    gravity = _GRAM.sub(r"\1gn", text)
    return (parse_unit(text),) if gravity == text else (parse_unit(text), parse_unit(gravity))


def may_agree(first: str, second: str) -> bool:
    """Whether two units may be the same, as an unknown one may with any."""
    try:
        return not set(readings(first)).isdisjoint(readings(second))
    except UnitError:
        return True


def unit_of(text: str, si_unit: str) -> Unit:
    """The unit written as *text*, of the dimension of *si_unit*: g is 9.80665 m/s^2 where an acceleration is
    needed, the gram else; C is the degree Celsius where a temperature is.

    Raises UnitError for an unknown unit or a wrong dimension.
    """
    units = readings(text)
    dimension = parse_unit(si_unit).dimension
    for unit in units:
        if unit.dimension == dimension:
            return unit
    check_dimension(text, units[0], si_unit)
    return units[0]


def is_number(text: str) -> bool:
    """Whether a text is a number without a unit."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def parse_value(text: str | float, si_unit: str) -> float:
    """The value of ``"90 um"`` in the SI unit given; a bare number is refused unless the SI unit is a pure
    number.

    Raises UnitError when the number cannot be read, the unit is unknown or has the wrong dimension.
    """
    target = parse_unit(si_unit)
    if isinstance(text, bool) or not isinstance(text, (str, int, float)):
        raise UnitError(f"'{text}' is not a value with a unit", _example(si_unit))
    match = _VALUE.match(str(text))
    if match is None:
        raise UnitError(f"'{text}' is not a value with a unit", _example(si_unit))
    number, unit_text = float(match[1]), match[2]
    if not unit_text:
        if target.dimension == NONE or number == 0:
            return _finite(number, text)
        raise UnitError(f"'{text}' has no unit", f"write it with its unit, e.g. '{match[1]} {si_unit}'")
    unit = unit_of(unit_text, si_unit)
    if si_unit == "kg" and 0 < abs(number * unit.factor) < SMALLEST:
        raise UnitError(f"'{str(text)[:ECHO]}' is too small for a mass", _example(si_unit))
    return _finite(
        (number * unit.factor + unit.offset) / target.factor * _angle_per_period(unit, target), text
    )


def written_unit(text: str | float) -> str:
    """The unit in which a value is written: "rpm" of "2772 rpm", '' for a bare number and for what is no
    value.
    """
    match = _VALUE.match(str(text))
    return "" if match is None else match[2]


def in_unit(value: float, si_unit: str, text: str) -> float:
    """The *value* [*si_unit*] in the unit written as *text*: what parse_value makes of a value with a unit,
    undone.

    Raises UnitError as unit_of does.
    """
    target, unit = parse_unit(si_unit), unit_of(text, si_unit)
    return (value * target.factor / _angle_per_period(unit, target) - unit.offset) / unit.factor


# Of periods, and of the angle that counts them.
_RATES = {_dimension(s=-1), _dimension(s=-1, rad=1)}
_SI_UNITS = (
    *("1", "N", "m", "Hz", "K", "Pa", "N.m", "s", "V", "A", "kg", "rad"),
    *("m/s", "m/s^2", "kg.m", "Pa.s", "N/m", "m^3/s", "kg/s", "W"),
)


def si_amount(text: str | float) -> tuple[float, str]:
    """An amount of any usual dimension in SI with its unit: "427 N" -> (427.0, "N"), "3000 rpm" -> (50.0,
    "Hz"); UnitError for none.

    A scatter behind it ("1000.2 N +- 3.1 N") is left aside.
    """
    match = _VALUE.match(str(text).partition("+-")[0])
    if match is None:
        raise UnitError(f"'{text}' is not an amount", "for example 427 N")
    unit = parse_unit(match[2] or "1")
    same = _RATES if unit.dimension in _RATES else {unit.dimension}
    name = next((name for name in _SI_UNITS if parse_unit(name).dimension in same), None)
    if name is None:
        raise UnitError(f"'{match[2]}' has an unusual dimension", f"known: {', '.join(_SI_UNITS)}")
    value = float(match[1]) * unit.factor + unit.offset
    return _finite(value * _angle_per_period(unit, parse_unit(name)), text), name


def name_of_dimension(dimension: Dimension) -> str:
    """The SI unit of a dimension: N for a force, kg/s for one without a name of its own."""
    units = (*_SI_UNITS, *(quantity.si_unit for quantity in QUANTITIES.values()))
    name = next((unit for unit in units if parse_unit(unit).dimension == dimension), None)
    if name is not None:
        return name
    symbols = ("m", "kg", "s", "A", "K", "rad")
    above = [
        f"{symbol}^{power:g}" if power != 1 else symbol
        for symbol, power in zip(symbols, dimension, strict=True)
        if power > 0
    ]
    below = [
        f"{symbol}^{-power:g}" if power != -1 else symbol
        for symbol, power in zip(symbols, dimension, strict=True)
        if power < 0
    ]
    bottom = f"({'.'.join(below)})" if len(below) > 1 else "".join(below)
    return ".".join(above or ["1"]) + (f"/{bottom}" if below else "")


def _finite(value: float, text: str | float) -> float:
    if not math.isfinite(value):
        raise UnitError(f"'{str(text)[:ECHO]}' is not a finite value")
    if abs(value) > LARGEST:
        raise UnitError(
            f"'{str(text)[:ECHO]}' is out of range", f"no amount in SI units is larger than {LARGEST:g}"
        )
    return value


def _angle_per_period(unit: Unit, target: Unit) -> float:
    """1 Hz = 2 pi rad/s: the factor between counting periods and counting angle."""
    difference = unit.dimension[5] - target.dimension[5]
    return float((2 * math.pi) ** -difference) if unit.dimension != target.dimension else 1.0


def check_dimension(text: str, unit: Unit, si_unit: str) -> None:
    """UnitError unless *unit* (written as *text*) has the dimension of *si_unit*.

    Hz and rad/s are interchangeable.
    """
    dimension = parse_unit(si_unit).dimension
    if unit.dimension == dimension:
        return
    if {unit.dimension, dimension} <= _RATES:
        return
    raise UnitError(f"'{text}' has the wrong dimension, {si_unit} is needed", _example(si_unit))


def _example(si_unit: str) -> str:
    return f"for example '0.5 {si_unit}'" if si_unit != "1" else "for example '0.5' or '50 %'"


def to_display(value: float, display_unit: str) -> float:
    """The SI *value* expressed in *display_unit* (for tables and axes)."""
    unit = parse_unit(display_unit)
    return (value - unit.offset) / unit.factor


DISPLAY_UNITS = {"N/m": "kN/m", "m": "um", "rad": "deg", "1": "1"}


def display_unit(si_unit: str) -> str:
    """The usual display unit of values in *si_unit*."""
    return DISPLAY_UNITS.get(si_unit, si_unit)


PREFIXED = {"N/m": ("N/m", "kN/m", "MN/m", "GN/m"), "N.s/m": ("N.s/m", "kN.s/m"), "N": ("N", "kN", "MN")}


def readable_unit(si_unit: str, values: Iterable[float]) -> str:
    """The display unit of a table or an axis of *values* in *si_unit*: the largest prefix that leaves the
    largest of them above 1.
    """
    units = PREFIXED.get(si_unit)
    if units is None:
        return display_unit(si_unit)
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    return next((unit for unit in reversed(units) if largest >= parse_unit(unit).factor), units[0])

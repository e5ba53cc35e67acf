"""LabVIEW measurement files (.lvm): text with a header of its own, with or without columns of X values."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.raw_files.screening import plain_rate
from labpipe.raw_files.table import unique
from labpipe.raw_files.text_table import open_text

END = "***End_of_Header***"
X_VALUE = "X_Value"
CHUNK_ROWS = 1 << 14
# Share of a step by which channels may begin apart, and the rate [Hz] whose step that is beside X values.
BESIDE, UNSTATED = 0.1, 1e5
# LabVIEW's own words for units; others are written as they are.
# LabVIEW's spectral measurements name their channels so, and write "Time" as the dimension of X all the same.
SPECTRUM = re.compile(r"\((FFT\b|FRF\b|(power|amplitude|cross) spectr)", re.IGNORECASE)
UNITS = {
    "volts": "V", "newtons": "N", "meters": "m", "amps": "A", "amperes": "A", "pascals": "Pa",
    "seconds": "s", "hertz": "Hz", "pounds": "lbf",
}  # fmt: skip


@dataclass(frozen=True)
class LvmHeader:
    """What stands above the numbers; *titles* and *units* have one entry per field, *first_line* counts from
    1. spectrum: the X values are frequencies [Hz], and no rate follows from their steps. starts: X0 of every
    field [s]; step: Delta_X of the first [s]; counts: its number of samples, where channels differ in their
    rates, else 0.
    """

    delimiter: str
    decimal: str
    titles: tuple[str, ...]
    units: tuple[str, ...]
    used: tuple[int, ...]
    sample_rate: float | None
    first_line: int
    spectrum: bool
    starts: tuple[float, ...]
    step: float
    rates: tuple[float, ...] = ()
    counts: tuple[int, ...] = ()


class LvmTable:
    """The channels of a LabVIEW measurement file. Satisfies RawTable. Without columns of X values the rate is
    that of Delta_X; with them it is for the rig's `time: X_Value`, and further segments follow in their
    order. Of several rates the table holds the channels of the highest, or of *rate* [Hz]; `others` are the
    tables of the other ones. DataError for another kind of text, and for segments without X values.
    """

    def __init__(self, path: Path, rate: float | None = None) -> None:
        self.path = path
        header = self._header = self._read_header()
        names = unique([header.titles[place] for place in header.used])
        places = dict(zip(names, header.used, strict=True))
        self.sample_rate, self._count = header.sample_rate, 0
        self.unused: dict[str, int] = {}
        if header.rates:
            rate_of = dict(zip(header.used, header.rates, strict=True))
            self.sample_rate = rate or max(rate_of.values())
            slower = {name: place for name, place in places.items() if rate_of[place] != self.sample_rate}
            self.unused = {name: header.counts[place] for name, place in slower.items()}
            places = {name: place for name, place in places.items() if name not in slower}
            self._count = header.counts[next(iter(places.values()))]
        starts = [header.starts[place] for place in places.values() if header.titles[place] != X_VALUE]
        if not header.spectrum and np.ptp(starts) > BESIDE / (self.sample_rate or UNSTATED):
            what = f"its channels begin up to {np.ptp(starts):g} s apart (X0)"
            raise DataError(what, path, "write channels that begin together")
        self.start = starts[0] if header.rates else 0.0
        self._places, self.columns = places, tuple(places)
        self.units = {name: unit for name, place in places.items() if (unit := header.units[place])}
        if header.spectrum and X_VALUE in places:
            self.units[X_VALUE] = "Hz"

    @property
    def others(self) -> tuple[LvmTable, ...]:
        rates = sorted(set(self._header.rates) - {self.sample_rate}, reverse=True)
        return tuple(LvmTable(self.path, rate) for rate in rates)

    def _lines(self) -> Iterator[str]:
        with open_text(self.path) as lines:
            yield from (line.rstrip("\r\n") for line in lines)

    def _read_header(self) -> LvmHeader:
        entries: dict[str, list[str]] = {}
        ended, delimiter = 0, "\t"
        for number, line in enumerate(self._lines(), 1):
            if number == 1 and not line.startswith("LabVIEW Measurement"):
                what = "is not a LabVIEW measurement file"
                raise DataError(what, self.path, "its first words are LabVIEW Measurement")
            if line.startswith(("Separator\t", "Separator,")):
                delimiter = "," if "Comma" in line else "\t"
            fields = line.split(delimiter)
            if fields[0] == X_VALUE:
                below = (line for n, line in enumerate(self._lines(), 1) if n > number and line.strip())
                titles = [field.strip() for field in fields]
                return _header(entries, titles, delimiter, next(below, ""), number + 1, self.path)
            ended += fields[0].startswith(END)
            entries[fields[0]] = [field.strip() for field in fields]
        untitled = f"has no line of titles ('{X_VALUE} ...')"
        raise DataError("is cut off in its header" if ended < 2 else untitled, self.path)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file]. DataError names line and column of what is no
        number.
        """
        places = [self._places[name] for name in columns]
        rows = (self._numbers(line, places, number) for number, line in self._data_lines())
        while chunk := list(islice(rows, CHUNK_ROWS)):
            yield np.array(chunk)

    def _data_lines(self) -> Iterator[tuple[int, str]]:
        inside, left, stated = False, self._count or np.inf, 0
        first_row, last_row, read = "", "", 0
        for number, line in enumerate(self._lines(), 1):
            first = line.split(self._header.delimiter, 1)[0]
            if first == X_VALUE:
                if number >= self._header.first_line and X_VALUE not in self._places:
                    hint = "write X values ('X value columns') from LabVIEW, or one file per segment"
                    what = "a second segment begins, and no X values say when"
                    raise DataError(what, f"{self.path}:{number}", hint)
                inside = True
            elif inside and first in ("Channels", "Notes"):
                inside = False
            elif inside and left > 0 and line.strip():
                yield number, line
                first_row, last_row, read = first_row or line, line, read + 1
                left -= 1
                stated -= 1
            elif first == "Samples":
                # Of one header for all segments there are more rows than it says.
                counts = [int(text) for text in line.split(self._header.delimiter)[1:] if text.isdigit()]
                stated = max(stated, 0) + (self._count or max(counts, default=0))
        if stated > 0:
            what = f"ends {stated} sample(s) before the last one that its header states"
            hint, step = "the file is cut off", self._header.step
            if X_VALUE in self._places and step and read > 1:
                begin, end = (self._numbers(row, [0], 0)[0] for row in (first_row, last_row))
                if (apart := (end - begin) / (read - 1)) > 1.5 * step:
                    what += f": rows are {apart:g} s apart (X_Value), samples {step:g} s (Delta_X)"
                    hint = "rows were left out after it was written; save the titles and rows alone as .txt"
            raise DataError(what, self.path, hint)

    def _numbers(self, line: str, places: Sequence[int], number: int) -> list[float]:
        fields = line.split(self._header.delimiter)
        row = []
        for place in places:
            text = fields[place].strip() if place < len(fields) else ""
            try:
                row.append(float(_use_decimal_point(text, self._header.decimal)) if text else np.nan)
            except ValueError:
                what = f"column '{self._header.titles[place]}': '{text[:40]}' is not a number"
                raise DataError(what, f"{self.path}:{number}") from None
        return row


def _header(
    entries: dict[str, list[str]], titles: list[str], delimiter: str, row: str, first_line: int, path: Path
) -> LvmHeader:
    stated = entries.get("Decimal_Separator", ["", ""])[1]
    decimal = stated or ("," if delimiter != "," and "," in row else ".")
    padded = {
        key: [*entries.get(key, []), *[""] * len(titles)]
        for key in ("Samples", "Y_Unit_Label", "X_Dimension", "Delta_X", "X0")
    }
    with_x = bool(row.split(delimiter)[0].strip())
    used = [
        place
        for place, title in enumerate(titles)
        if title and title != "Comment" and padded["Samples"][place] != "0" and (title != X_VALUE or with_x)
    ]
    if not [place for place in used if titles[place] != X_VALUE]:
        raise DataError("holds no channel with samples", path)
    # The first field is the word Y_Unit_Label itself.
    units = ["", *(UNITS.get(unit.lower(), unit) for unit in padded["Y_Unit_Label"][1:])]
    channels = [place for place in used if titles[place] != X_VALUE]
    # The X values are frequencies where the titles or the dimensions of X of all channels say so.
    spectrum = all(
        padded["X_Dimension"][place].lower().startswith("freq") or SPECTRUM.search(titles[place])
        for place in channels
    )
    texts = [padded["Delta_X"][place] for place in channels]
    header = partial(
        LvmHeader,
        delimiter,
        decimal,
        tuple(titles),
        tuple(units),
        first_line=first_line,
        spectrum=spectrum,
        starts=tuple(_seconds(text, decimal) for text in padded["X0"]),
        step=_seconds(texts[0], decimal),
    )
    if len(set(texts)) > 1 and not spectrum:
        # Every channel has X values of its own, or none: its step says the same.
        rates = tuple(_rate([text], decimal, path) or 0.0 for text in texts)
        if all(0 < rate < float("inf") for rate in rates) and len(set(rates)) > 1:
            counts = tuple(int(text) if text.isdigit() else 0 for text in padded["Samples"])
            return header(used=tuple(channels), sample_rate=None, rates=rates, counts=counts)
    rate = None if with_x or spectrum else _rate(texts, decimal, path)
    return header(used=tuple(used), sample_rate=rate)


def _use_decimal_point(text: str, decimal: str) -> str:
    return text.replace(",", ".") if decimal == "," else text


def _seconds(text: str, decimal: str) -> float:
    try:
        return float(_use_decimal_point(text, decimal) or 0)
    except ValueError:
        return 0.0


def _rate(steps: Sequence[str], decimal: str, path: Path) -> float | None:
    texts = {_use_decimal_point(step, decimal) for step in steps if step}
    if not texts:
        return None
    try:
        numbers = {float(text) for text in texts}
    except ValueError:
        raise DataError(f"Delta_X '{texts.pop()}' is not a number", path) from None
    if len(numbers) > 1 or min(numbers) <= 0:
        raise DataError("not every channel has a positive step Delta_X", path, "one for each channel")
    (text,), (step,) = list(texts)[:1], numbers
    mantissa, _, exponent = text.upper().partition("E")
    last_digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return plain_rate(step, last_digit / 2)

"""Run-ups as CSV: settings in comment lines, 1x amplitude and phase of every plane and direction in columns.

    # load: 3.66 N
    # unbalance disc 1: 50 g.mm at 0 deg
    # threshold: 2772 rpm +- 6 rpm
    # amplitude error: 1 %
    # phase error: 1 deg
    speed [rpm],disc 1 x amplitude [um],disc 1 x phase [deg],disc 1 y amplitude [um],disc 1 y phase [deg]

Standard errors may have their own columns instead (``disc 1 x amplitude error [um]``, ``disc 1 x phase error
[deg]``). The phase is that of x(t) = A cos(w t + phase), relative to the keyphasor: a lagging motion has a
negative one. For a run with a shaker the lines ``# shaker: 2 N in x, 0 N in y at disc 1`` and ``# shaker
frequency: 0.95`` (over the shaft's speed) replace the unbalances.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError, locate_errors
from labpipe.methods.run_ups.records import DIRECTIONS, RunUp, Shaker
from labpipe.quantities import locate_units, parse_value
from labpipe.raw_files.table import check_columns
from labpipe.raw_files.text_table import CsvTable, open_text
from labpipe.records.settings import parse_phasor
from labpipe.records.uncertain import Uncertain, parse_uncertain
from labpipe.registry import nearest

KEYS = ("load", "threshold", "amplitude error", "phase error", "shaker", "shaker frequency")
_COLUMN = re.compile(
    r"^(?P<plane>.+) (?P<direction>[xy]) (?P<what>amplitude|phase|amplitude error|phase error)\s*(\[.*\])?$"
)
_SPEED = re.compile(r"^speed\s*(\[.*\])?$")
_LINE = re.compile(r"^\s*#\s*(?P<key>[^:]+?)\s*:\s*(?P<text>.*?)\s*$")
_SHAKER = re.compile(r"^(?P<x>.+?)\s+in\s+x\s*,\s*(?P<y>.+?)\s+in\s+y\s+at\s+(?P<plane>.+)$")
UNITS = {"amplitude": "m", "amplitude error": "m", "phase": "rad", "phase error": "rad"}


def read_run_up_csv(
    path: Path, name: str = "", unbalance: Mapping[str, complex] | None = None, load: float | None = None
) -> RunUp:
    """The run-up of a table; *unbalance* [kg m] by plane (empty: residual only) and *load* [N] for one
    without such lines. DataError names the file, the line or column, and the remedy.
    """
    if not path.exists():
        raise DataError("no such file", path)
    read = _Reader(path)
    speed = read.speed
    amplitude, phase = read.amplitudes(), read.stack("phase")
    amplitude_error = read.errors("amplitude error", amplitude, "1")
    phase_error = read.errors("phase error", np.ones_like(phase), "rad")
    if load is None or "load" in read.head:
        load = read.value("load", "N")
    with locate_errors(path):
        shaker, unbalances = read.shaker(), read.unbalances()
        if not unbalances and shaker is None and unbalance is not None:
            unbalances = dict(unbalance) or {read.planes[0]: 0j}
        return RunUp(
            name or path.stem,
            load,
            speed,
            read.planes,
            amplitude * np.exp(1j * phase),
            amplitude_error=amplitude_error,
            phase_error=phase_error,
            unbalance=unbalances,
            shaker=shaker,
            threshold=read.threshold(),
        )


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path, self.table, self.head = path, CsvTable(path), _head(path)
        self.columns = self._columns()
        self.planes = tuple(dict.fromkeys(plane for plane, _, _ in self.columns))

    def fault(self, what: str, hint: str) -> DataError:
        return DataError(what, self.path, hint)

    def _columns(self) -> dict[tuple[str, str, str], str]:
        names: dict[tuple[str, str, str], str] = {}
        for column in self.table.columns:
            if _SPEED.match(column):
                continue
            match = _COLUMN.match(column)
            if match is None:
                hint = "columns are named 'disc 1 x amplitude [um]', 'disc 1 x phase [deg]'"
                raise self.fault(f"the column '{column}' does not belong to a run-up", hint)
            place = (match["plane"], match["direction"], match["what"])
            if place in names:
                raise self.fault(f"the columns '{names[place]}' and '{column}' hold one quantity", "keep one")
            names[place] = column
        if not names:
            raise self.fault("has no plane", "for example a column 'disc 1 x amplitude [um]'")
        return names

    @property
    def speed(self) -> FloatArray:
        """(n_speed,) [rad/s]."""
        columns = [column for column in self.table.columns if _SPEED.match(column)]
        if len(columns) != 1:
            hint = "for example 'speed [rpm]'"
            raise self.fault(f"it has {len(columns) or 'no'} column 'speed' where one is needed", hint)
        return 2 * np.pi * self.in_si(columns[0], "Hz")

    def in_si(self, column: str, si_unit: str) -> FloatArray:
        check_columns(self.table, [column])
        unit = self.table.units.get(column)
        if unit is None:
            hint = f"write it in brackets, for example [{si_unit}]"
            raise self.fault(f"the column '{column}' has no unit", hint)
        factor = _parse(f"1 {unit}", str(self.path), f"column '{column}'", si_unit)
        chunks = [chunk[:, 0] for chunk in self.table.chunks([column])]
        values = np.concatenate(chunks) if chunks else np.zeros(0)
        if not np.all(np.isfinite(values)):
            row = int(np.argmin(np.isfinite(values)))
            what = f"column '{column}': a number is missing in row {row + 1} of the table"
            raise self.fault(what, "leave out the whole row where nothing was measured")
        return np.asarray(values * factor, np.float64)

    def stack(self, what: str) -> FloatArray:
        """(n_speed, n_plane, 2) [m, rad] of a quantity."""
        rows = []
        for plane, direction in product(self.planes, DIRECTIONS):
            if (plane, direction, what) not in self.columns:
                unit = "um" if UNITS[what] == "m" else "deg"
                hint = f"with its unit, for example [{unit}]"
                raise self.fault(f"no column '{plane} {direction} {what}'", hint)
            rows.append(self.in_si(self.columns[(plane, direction, what)], UNITS[what]))
        return np.stack(rows, -1).reshape(-1, len(self.planes), len(DIRECTIONS))

    def amplitudes(self) -> FloatArray:
        """(n_speed, n_plane, 2) [m], above zero."""
        sizes = self.stack("amplitude")
        for row, plane, direction in np.argwhere(sizes <= 0):
            column = self.columns[self.planes[plane], DIRECTIONS[direction], "amplitude"]
            what = f"column '{column}': the amplitude in row {row + 1} of the table is not above zero"
            raise self.fault(what, "leave out the row where a probe does not move; a turn is in the phase")
        return sizes

    def errors(self, what: str, size: FloatArray, unit: str) -> FloatArray:
        """Columns of their own, else the number above the table times *size*."""
        in_columns = any(quantity == what for _, _, quantity in self.columns)
        if in_columns == (what in self.head):
            hint = "'# amplitude error: 1 %' and '# phase error: 1 deg' above the table, or columns of them"
            raise self.fault(f"the {what} is {'stated twice' if in_columns else 'missing'}", hint)
        return self.stack(what) if in_columns else size * self.value(what, unit)

    def value(self, key: str, unit: str) -> float:
        if key not in self.head:
            raise self.fault(f"the {key} is missing", f"a line '# {key}: ... {unit}' above the table")
        return _parse(*self.head[key], key, unit)

    def threshold(self) -> Uncertain | None:
        if "threshold" not in self.head:
            return None
        text, where = self.head["threshold"]
        hertz = _parse(text, where, "threshold", "Hz", parse_uncertain)
        if not hertz.std_error:
            raise DataError("threshold: its uncertainty is missing", where, "for example 2772 rpm +- 6 rpm")
        return Uncertain(2 * np.pi * hertz.value, 2 * np.pi * hertz.std_error)

    def unbalances(self) -> dict[str, complex]:
        unbalances = {}
        for key, (text, where) in self.head.items():
            if not key.startswith("unbalance "):
                continue
            if " at " not in text:
                what = f"{key}: '{text}' is not a size and an angle"
                raise DataError(what, where, "for example 50 g.mm at 0 deg")
            unbalances[key.removeprefix("unbalance ")] = _parse(text, where, key, "kg.m", parse_phasor)
        return unbalances

    def shaker(self) -> Shaker | None:
        if "shaker" not in self.head:
            if "shaker frequency" in self.head:
                where = self.head["shaker frequency"][1]
                raise DataError("shaker frequency: there is no shaker", where, "add a line '# shaker: ...'")
            return None
        text, where = self.head["shaker"]
        match = _SHAKER.match(text)
        if match is None:
            what = f"shaker: '{text}' is not a force at a plane"
            raise DataError(what, where, "for example 2 N in x, 0 N in y at disc 1")
        ratio = self.value("shaker frequency", "1")
        if not ratio > 0:
            where = self.head["shaker frequency"][1]
            raise DataError("shaker frequency: must be positive", where, "over the shaft's speed")
        x, y = (_parse(match[axis], where, "shaker", "N") for axis in DIRECTIONS)
        return Shaker(match["plane"], x, y, ratio)


def _head(path: Path) -> dict[str, tuple[str, str]]:
    entries: dict[str, tuple[str, str]] = {}
    with open_text(path, "utf-8-sig") as lines:
        for number, line in enumerate(lines, 1):
            if line.strip() and not line.lstrip().startswith("#"):
                break
            match = _LINE.match(line)
            if match is None:
                continue
            key, where = match["key"], f"{path}:{number}"
            if key not in KEYS and not key.startswith("unbalance "):
                if difflib.get_close_matches(key.lower(), KEYS, 1, 0.75):
                    raise DataError(f"unknown entry '{key}'", where, nearest(key, KEYS))
                if difflib.get_close_matches(key.split()[0].lower(), ["unbalance"], 1, 0.85):
                    raise DataError(f"unknown entry '{key}'", where, "for example '# unbalance disc 1: ...'")
                continue
            if key in entries:
                raise DataError(f"'{key}' appears twice", where)
            entries[key] = (match["text"], where)
    return entries


def _parse(text: str, where: str, key: str, unit: str, parse: Callable[..., Any] = parse_value) -> Any:
    with locate_units(where, DataError, f"{key}: "):
        return parse(text, unit)


def write_run_up_csv(path: Path, run: RunUp) -> None:
    """As `read_run_up_csv` reads it: rpm, um and degrees, six digits, constant errors as comment lines."""
    columns = {"speed [rpm]": run.rpm}
    parts = (run.amplitude_error / np.abs(run.response), run.phase_error)
    relative, phase = (
        float(np.mean(part)) if np.ptp(part) <= 1e-9 * np.mean(part) else None for part in parts
    )
    for n, plane in enumerate(run.planes):
        for d, direction in enumerate(DIRECTIONS):
            title, phasor = f"{plane} {direction}", run.response[:, n, d]
            columns[f"{title} amplitude [um]"] = np.abs(phasor) * 1e6
            columns[f"{title} phase [deg]"] = np.degrees(np.angle(phasor))
            if relative is None:
                columns[f"{title} amplitude error [um]"] = run.amplitude_error[:, n, d] * 1e6
            if phase is None:
                columns[f"{title} phase error [deg]"] = np.degrees(run.phase_error[:, n, d])
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(f"# {line}\n" for line in _lines(run, relative, phase))
        stream.write(",".join(columns) + "\n")
        np.savetxt(stream, np.stack(list(columns.values()), 1), "%.6g", delimiter=",")


def _lines(run: RunUp, relative: float | None, phase: float | None) -> list[str]:
    lines = [f"load: {run.load:.9g} N"]
    for plane, size in run.unbalance.items():
        lines.append(f"unbalance {plane}: {abs(size) * 1e6:.9g} g.mm at {np.degrees(np.angle(size)):.9g} deg")
    if run.shaker is not None:
        lines.append(f"shaker: {run.shaker.x:.9g} N in x, {run.shaker.y:.9g} N in y at {run.shaker.plane}")
        lines.append(f"shaker frequency: {run.shaker.frequency_ratio:.9g}")
    if run.threshold is not None:
        value, error = (30 / np.pi * speed for speed in (run.threshold.value, run.threshold.std_error))
        lines.append(f"threshold: {value:.9g} rpm +- {error:.9g} rpm")
    if relative is not None:
        lines.append(f"amplitude error: {100 * relative:.9g} %")
    if phase is not None:
        lines.append(f"phase error: {np.degrees(phase):.9g} deg")
    return lines


# Bytes within which a run-up table states the load.
HEAD = 4096
_RUN_UP = re.compile(r"^# *load *:", re.MULTILINE)


def run_up_in(path: Path) -> RunUp | None:
    """The run-up of a file, None where it is not a run-up table."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        head = stream.read(HEAD)
    return read_run_up_csv(path) if _RUN_UP.search(head) else None

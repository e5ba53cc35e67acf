"""What the first rows of a recording, or FRFs, show of excitation and modes: the fits that they propose."""

from __future__ import annotations

import csv
import glob
import json
import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError, LabpipeError
from labpipe.project import first_guess
from labpipe.project.ready_response import is_response
from labpipe.project.settings_reader import DECIDE, conditions_in, plain_stem
from labpipe.quantities import parse_unit
from labpipe.raw_files.first_look import Excitation, look, round_down
from labpipe.raw_files.table import TEXT_SUFFIXES, RawTable, check_time, open_table
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse
from labpipe.records.rig import time_scale
from labpipe.spectra.free_decays import free_decays
from labpipe.spectra.measurement import IDLE, measure
from labpipe.spectra.settings import FrfSettings, ShaftLines
from labpipe.spectra.shaft import at_rest
from labpipe.spectra.sweeps import find_dwells, find_sweeps

# Largest over rms of a sweep of one level, the square root of two and some noise.
STEADY_CREST = 1.9
# Share of a record that dwells or sweeps take where they are its excitation.
SWEPT = 0.4
# Volts that drive a shaker repeat at least so many times as exactly as the force that it makes of them.
CLEANER = 3.0


@dataclass(frozen=True)
class FirstLook:
    """A recording by its metadata; *rate* [Hz], 0 for none; rows (n_sample, n_channel) as recorded."""

    channels: tuple[first_guess.GuessedChannel, ...]
    rate: float
    time: str
    rows: FloatArray
    unused: tuple[str, ...] = ()

    def with_one_quantity(self) -> FirstLook:
        """The same with responses of one quantity alone, the most frequent: others, which may be of the same
        points, are references. A stator that floats has both displacements and accelerations in two
        directions.
        """
        outputs = Counter(channel.quantity for channel in self.channels if channel.role == "output")
        floats = min(outputs["displacement"], outputs["acceleration"]) > 1
        if floats or not self.column_of("input") or not outputs:
            return self
        ((kept, _),) = outputs.most_common(1)
        beside = (
            replace(channel, role="reference")
            if channel.role == "output" and channel.quantity != kept
            else channel
            for channel in self.channels
        )
        return replace(self, channels=tuple(beside))

    def column_of(self, role: str) -> list[int]:
        return [number for number, channel in enumerate(self.channels) if channel.role == role]

    def driven(self) -> list[int]:
        """The columns of the inputs that are not idle beside the strongest."""
        inputs = self.column_of("input")
        sizes = np.std(self.rows[:, inputs], axis=0)
        return [n for n, size in zip(inputs, sizes, strict=True) if not size < IDLE * sizes.max(initial=0.0)]


def first_look(table: RawTable) -> FirstLook:
    """The channels of a table with what its metadata say, its rate and time column, and its first rows."""
    names, rows = first_guess.first_rows(table)
    if rows.shape[0] < 2:
        raise DataError("holds too few samples", table.path)
    times = first_guess.time_columns(names, rows)
    check_time(table, times[0] if times else "")
    signal_numbers = [number for number, name in enumerate(names) if name not in times]
    if not signal_numbers:
        raise DataError("holds no column but time", table.path)
    time = times[0] if times and table.sample_rate is None else ""
    step = first_guess.step_of(rows[:, names.index(time)]) * time_scale(time, table.units) if time else 0.0
    rate = table.sample_rate or (1 / step if step else 0.0)
    copied = first_guess.copies([names[n] for n in signal_numbers], rows[:, signal_numbers])
    chosen = [n for n in signal_numbers if names[n] not in copied]
    others: dict[str, int] = getattr(table, "unused", {})
    unused = (
        *(f"{name}: {reason}" for name, reason in copied.items()),
        *(f"{name}: {n_value} values, the channels have {rows.shape[0]}" for name, n_value in others.items()),
        *(f"{name}: text" for name in getattr(table, "texts", ())),
    )
    sensitivities = getattr(table, "sensitivities", {})
    channels = first_guess.guess_channels([names[n] for n in chosen], table.units, sensitivities)
    signals = rows[:, chosen]
    driven = first_guess.without_static_forces(channels, signals)
    guessed = _with_sweep(first_guess.with_hammer(driven, signals), signals, rate)
    return FirstLook(first_guess.with_a_response(guessed), rate, time, signals, unused)


def _with_sweep(
    channels: tuple[first_guess.GuessedChannel, ...], rows: FloatArray, rate: float
) -> tuple[first_guess.GuessedChannel, ...]:
    """The channels of *rows* (n_sample, n_channel) [recorded units], where none is a force the steadiest
    sweep of volts without a stated sensor as one: responses do not follow at one level.
    """
    if any(channel.role == "input" for channel in channels):
        return channels
    crests: dict[int, float] = {}
    for n, channel in enumerate(channels):
        signal = rows[:, n] - np.mean(rows[:, n])
        crest = float(np.max(np.abs(signal)) / max(np.std(signal), np.finfo(float).tiny))
        may_be = DECIDE in (channel.quantity, channel.sensitivity) or channel.quantity == "voltage"
        if may_be and crest < STEADY_CREST and excitation_of(signal, rate or 1.0).kind == "sweep":
            crests[n] = crest
    if not crests:
        return channels
    steadiest = min(crests, key=crests.__getitem__)
    return first_guess.as_force(channels, steadiest, "a force by its sweep, which is a guess")


def excitation_of(force: FloatArray, rate: float) -> Excitation:
    """The kind of a force (n_sample,) [any unit] at a *rate* [Hz], dwells and sweeps among what has no
    period.
    """
    seen = look(force, rate)
    if seen.kind != "random":
        return seen
    with suppress(DataError):
        dwells = find_dwells(force)
        if sum(dwell.stop - dwell.start for dwell in dwells) >= SWEPT * force.size:
            tones = [dwell.frequency * rate for dwell in dwells]
            return Excitation("stepped-sine", force.size, (min(tones), max(tones)), len(dwells))
    try:
        sweeps = find_sweeps(force)
    except DataError:
        return seen
    if sum(sweep.stop - sweep.start for sweep in sweeps) < SWEPT * force.size:
        return seen
    widest = max(sweeps, key=lambda sweep: sweep.high - sweep.low)
    band = widest.low * rate, min(widest.high * rate, 0.4 * rate)
    return Excitation("sweep", widest.stop - widest.start, band, len(sweeps))


def drive_of(first: FirstLook, force: int, excitation: Excitation) -> int | None:
    """The column of the volts that drive the shaker: they repeat with the period of its periodic *force*
    (a column), and more exactly. None where no or several channels do.
    """
    if excitation.kind != "periodic":
        return None
    shape = excitation.repeats, excitation.length
    periods = first.rows[: math.prod(shape)].reshape(*shape, -1)
    noise = np.std(periods - periods.mean(axis=0), axis=(0, 1))
    size = np.std(periods, axis=(0, 1))
    volts = [n for n in first.column_of("reference") if first.channels[n].quantity == "voltage"]
    drives = [n for n in volts if size[n] > 0 and CLEANER * noise[n] * size[force] < noise[force] * size[n]]
    return drives[0] if len(drives) == 1 else None


# Lines in the half-power width of a peak that show its damping, and fewest blocks of a random recording.
RESOLVED, FEWEST_BLOCKS = 5, 4


@dataclass(frozen=True)
class Proposal:
    """A fit by its *model*, with the *band* [Hz] around a peak where one was seen; *is_mode*: the peak looks
    like a mode; *lines*: those in its half-power width.
    """

    model: str = "sdof"
    band: tuple[float, float] | None = None
    is_mode: bool = True
    lines: int = RESOLVED


UNSEEN = Proposal()
# Coherence of all lines that tells nothing, since it is of a single average.
ALL_EXPLAINED = 1 - 1e-9
# Phase of a mobility at its peak [deg] beyond which force and response are at no one point.
AT_ONE_POINT = 60.0


def propose(
    frequency: FloatArray,
    mobility: FloatArray | ComplexArray,
    *,
    at_one_point: bool,
    coherence: FloatArray | None = None,
) -> Proposal:
    """The fit around the highest peak of a *mobility* (n_line,) [1]: a single mass where force and response
    are at one point, which the phase of complex ones can deny, else a mode.
    """
    peak, seen = first_guess.highest_peak(mobility, coherence)
    turned = abs(np.angle(mobility[peak])) > np.radians(AT_ONE_POINT)
    size = np.abs(mobility)
    lines = first_guess.half_power_lines(size, peak)
    if (at_one_point and not turned) or frequency.size < first_guess.MODAL_LINES:
        return Proposal("sdof", first_guess.band_of(frequency, size, peak), seen, lines)
    return Proposal("modal", first_guess.band_of(frequency, size, peak, first_guess.MODAL_LINES), seen, lines)


def proposals(
    first: FirstLook, inputs: Sequence[int], outputs: Sequence[int], excitation: Excitation, drive: int | None
) -> tuple[dict[str, Proposal], Excitation]:
    """The fits around the highest peaks by channel, and the excitation, a random one with blocks long enough
    for these peaks, or as long as the record allows. *drive*: the column of what drives the shaker.
    """
    fits = _proposals(first, inputs, outputs, excitation, drive)
    while excitation.kind == "random" and any(fit.lines < RESOLVED for fit in fits.values()):
        length = round_down(2 * excitation.length + excitation.length // 2)
        if FEWEST_BLOCKS * length > first.rows.shape[0]:
            break
        excitation = replace(excitation, length=length, repeats=first.rows.shape[0] // length)
        fits = _proposals(first, inputs, outputs, excitation, drive)
    return fits, excitation


def widen_bands(fits: Mapping[str, Proposal], others: Mapping[str, Proposal]) -> dict[str, Proposal]:
    """The *fits* of one recording, with bands that hold those of another as well, where both see a peak."""
    wider = {}
    for key, fit in fits.items():
        band, other = fit.band, others.get(key, UNSEEN).band
        if band and other:
            fit = replace(fit, band=(min(band[0], other[0]), max(band[1], other[1])))
        wider[key] = fit
    return wider


def _proposals(
    first: FirstLook, inputs: Sequence[int], outputs: Sequence[int], excitation: Excitation, drive: int | None
) -> dict[str, Proposal]:
    chosen = [*inputs, *outputs, *([] if drive is None else [drive])]
    channels = tuple(_as_channel(first.channels[number]) for number in chosen)
    kinds = {channel.quantity for channel in channels if channel.role == "output"}
    if not outputs or len(kinds) > 1:
        return {}
    length = excitation.length / first.rate
    periodic = excitation.kind == "periodic"
    keys: dict[str, Any] = {"block": length} if excitation.kind in ("random", "impact") else {}
    if periodic:
        keys = {"period": length, "skip": 1 if excitation.repeats > 2 else 0}
    if drive is not None:
        keys["reference"] = (first.channels[drive].key,)
    # A dwell may lie beside its own frequency by rounding.
    band = None if excitation.kind == "stepped-sine" else excitation.band
    settings = FrfSettings(excitation=excitation.kind, band=band, **keys)
    try:
        response = measure([Recording(channels, first.rows[:, chosen], first.rate)], settings)
    except DataError:
        return {}
    has_quantities = all(first.channels[number].quantity != DECIDE for number in chosen)
    ports = enumerate(response.outputs)
    return {port.label: proposal_of(response, row, stated=has_quantities) for row, port in ports}


def proposal_of(response: FrequencyResponse, row: int, *, stated: bool) -> Proposal:
    """The fit to an element of the first column; *stated*: no quantity is a guess, phases say something."""
    coherence = None if response.coherence is None else response.coherence[:, row, 0]
    if coherence is not None and coherence.min() > ALL_EXPLAINED:
        # One hit explains itself.
        coherence = None
    order = {"receptance": 1, "accelerance": -1}.get(response.form, 0)
    # Neither the low nor the high end outweighs a resonance.
    weight = np.maximum(response.frequency, response.frequency[response.frequency > 0].min()) ** order
    mobility = response.matrix[:, row, 0] * 1j**order * weight
    peak_of = mobility if stated else np.abs(mobility)
    return propose(response.frequency, peak_of, at_one_point=True, coherence=coherence)


def _as_channel(channel: first_guess.GuessedChannel) -> Channel:
    """The channel for a look at the spectra; what is not known counts as a displacement, in any unit."""
    is_plain = channel.quantity in ("force", "velocity", "acceleration")
    quantity = channel.quantity if is_plain else "displacement"
    return Channel(channel.key, quantity, channel.role, channel.dof)


def turning_tacho(first: FirstLook) -> str | None:
    """The first tacho that shows a shaft that turns; None for none."""
    for number, channel in enumerate(first.channels):
        if channel.quantity == "tacho":
            recording = Recording((_as_channel(channel),), first.rows[:, [number]], first.rate or 1.0)
            if not at_rest(recording, ShaftLines(tacho=channel.key)):
                return channel.key
    return None


# Share of its frequency to either side of a mode that a fit of its decay looks at, the periods of a decay
# that give such a band the lines that a fit asks for, and the lines of a single decay.
DECAY_WIDTH, LEAST_PERIODS, LINES_ALONE = 0.4, 16, 21


def decay_bands(looks: Sequence[FirstLook], outputs: Sequence[int]) -> dict[str, tuple[float, float]]:
    """A band [Hz], per sample without a rate, around the strongest line of each response's free decays, that
    holds those of all recordings of one kind; of responses that die away in the first.
    """
    first, *others = (_decay_bands(look, outputs) if outputs else {} for look in looks)
    for name, (low, high) in first.items():
        bands = [(low, high), *(other[name] for other in others if name in other)]
        first[name] = min(low for low, _ in bands), max(high for _, high in bands)
    return first


def _decay_bands(first: FirstLook, outputs: Sequence[int]) -> dict[str, tuple[float, float]]:
    rate = first.rate or 1.0
    channels = tuple(_as_channel(first.channels[number]) for number in outputs)
    recording = Recording(channels, first.rows[:, list(outputs)], rate)
    try:
        decays = free_decays([recording], FrfSettings(excitation="decay")).decays
    except DataError:
        return {}
    samples = max((decay.samples for decay in decays), key=len)
    bands = {}
    for column, channel in enumerate(channels):
        line = _power(samples[:, column], np.hanning(samples.shape[0]))
        strongest, length = int(np.argmax(line)), samples.shape[0]
        if strongest < LEAST_PERIODS:
            # It drifts or swings slowly while it decays: the highest peak of so many periods, of all decays.
            strongest, length = _strongest_peak([decay.samples[:, column] for decay in decays])
        if strongest:
            f = strongest * rate / length
            width = max(DECAY_WIDTH, LINES_ALONE / (2 * strongest) if len(decays) == 1 else 0.0)
            bands[channel.name] = ((1 - width) * f, (1 + width) * f)
    return bands


def _strongest_peak(decays: Sequence[FloatArray]) -> tuple[int, int]:
    """(line, samples) of the highest peak of LEAST_PERIODS or more in the longer decays; line 0: none."""
    length = sorted(decay.size for decay in decays)[len(decays) // 2]
    taper = 0.5 + 0.5 * np.cos(np.pi * np.arange(length) / length)
    power = np.mean([_power(decay[:length], taper) for decay in decays if decay.size >= length], axis=0)
    peaks = first_guess.peaks_of(np.sqrt(power))
    peaks = peaks[peaks >= LEAST_PERIODS]
    return (int(peaks[np.argmax(power[peaks])]) if peaks.size else 0), length


def _power(samples: FloatArray, taper: FloatArray) -> FloatArray:
    return np.abs(np.fft.rfft((samples - samples.mean()) * taper)) ** 2


# Several recordings of one kind: what a table beside them, or their names, say of each.

# Conditions by the unit of a number in a name, and words before a number that only counts recordings.
BY_UNIT = {"speed": "Hz", "load": "N", "temperature": "K", "pressure": "Pa", "voltage": "V", "current": "A"}
BY_UNIT |= {"gap": "m", "mass": "kg", "time": "s", "moment": "N.m"}
COUNTS = (
    "run", "rep", "repeat", "test", "rec", "file", "no", "nr", "meas", "trial", "messung", "lauf", "number",
)  # fmt: skip
CASE = "case"
# Fewest files of a folder with the same columns beside which those with others are left out.
OF_ONE_KIND = 3
_SEPARATORS = re.compile(r"([-_\s]+|(?<!\d)\.|\.(?!\d))")
_NUMBER = re.compile(r"([^\W\d_]*)(\d+(?:\.\d+)?)([^\W\d_]*|%|°C)")
_TITLE = re.compile(r"(.+?)\s*[\[(/]\s*([^\])]+?)\s*[\])]?")
# Most characters of a table of conditions, and its most rows for each recording.
SHORT_TABLE, ROWS_PER_RECORDING = 1 << 17, 10


def recordings_in(folder: Path) -> tuple[list[Path], dict[str, str]]:
    """The files of a *folder* that can be read, and why others are left out, by name. DataError for none."""
    columns: dict[Path, tuple[str, ...]] = {}
    left_out: dict[str, str] = {}
    paths = sorted(path for path in folder.iterdir() if path.is_file() and path.name[0] != ".")
    for path in paths:
        try:
            columns[path] = () if is_response(path) else tuple(open_table(path).columns)
        except LabpipeError as error:
            left_out[path.name] = error.what
    stems = {plain_stem(path) for path in columns}
    tables = {path.name for path in paths if conditions_of_table(path, stems - {plain_stem(path)})}
    kinds = Counter(names for path, names in columns.items() if path.name not in tables).most_common(1)
    if not kinds:
        raise DataError("holds no recording that can be read", folder)
    ((kind, count),) = kinds
    if count >= OF_ONE_KIND:
        left_out |= {path.name: "has other columns" for path, names in columns.items() if names != kind}
    left_out = {name: why for name, why in left_out.items() if name not in tables}
    return [path for path in paths if path.name not in left_out], left_out


def conditions_of_table(path: Path, stems: Collection[str]) -> dict[str, dict[str, str]]:
    """The conditions of recordings by their *stems*, from a short text table with a column that names each of
    most of them, and a column for every condition: "speed [rpm]" of 500 is speed: 500 rpm. Empty for others.
    """
    if path.suffix.lower() not in TEXT_SUFFIXES or path.stat().st_size > SHORT_TABLE:
        return {}
    import pandas as pd

    try:
        table = pd.read_csv(path, sep=None, engine="python", dtype=str, index_col=False).fillna("")
    except (ValueError, csv.Error):
        return {}
    # Times and frequencies look like names such as 1.csv, of many more rows.
    for column in table if len(table) <= ROWS_PER_RECORDING * (1 + len(stems)) else ():
        named = [plain_stem(Path(cell.strip())) for cell in table[column]]
        if 2 * len({*named} & {*stems}) > len(stems):
            parts = {title: _condition(title) for title in table.columns.drop(column)}
            rows = zip(named, table.to_dict("records"), strict=True)
            return {
                stem: {
                    name: f"{cell.strip().replace(',', '.')} {unit}".strip()
                    for title, (name, unit) in parts.items()
                    if (cell := row[title]).strip()
                }
                for stem, row in rows
            }
    return {}


def _condition(title: str) -> tuple[str, str]:
    """Name and unit of a condition by the *title* of its column: "oil (degC)"."""
    match = _TITLE.fullmatch(title.strip())
    name, unit = (match[1], match[2]) if match else (title, "")
    return re.sub(r"\W+", "_", name.strip()).strip("_"), unit


def pattern_of_names(stems: Sequence[str]) -> str:
    """The pattern of recordings' names that differ in numbers or words between `_`, `-` and blanks, with the
    conditions in it: 500rpm_1, 1000rpm_1 and 1000rpm_2 are {speed}_{}. Empty where names differ otherwise,
    or in words alone.
    """
    parts = [_SEPARATORS.split(stem) for stem in stems]
    columns = list(zip(*parts, strict=False))
    if len({len(row) for row in parts}) > 1 or any(len(set(column)) > 1 for column in columns[1::2]):
        return ""
    places = {n: column for n, column in enumerate(columns) if len(set(column)) > 1}
    fixed = ["", "", *(column[0] if len(set(column)) == 1 else "" for column in columns), "", ""]
    named = {n: _named_part(column, fixed[n], fixed[n + 4]) for n, column in places.items()}
    if all(name == CASE for _, name, *_ in named.values()):
        return ""
    amounts = any(is_amount for *_, is_amount in named.values())
    texts, names = [column[0] for column in columns], Counter[str]()
    for n, (before, name, after, is_amount) in named.items():
        names[name] += 1
        name += f"_{names[name]}" if names[name] > 1 else ""
        # Beside an amount, a number that only counts is no condition.
        texts[n] = (
            f"{before}{{{'' if amounts and not is_amount and name.lower() in COUNTS else name}}}{after}"
        )
    pattern = "".join(texts)
    is_plain = not any(set("{}") & set(stem) for stem in stems)
    return pattern if is_plain and all(conditions_in(stem, pattern) is not None for stem in stems) else ""


def _named_part(column: Sequence[str], before: str, after: str) -> tuple[str, str, str, bool]:
    """What stands before a condition in a *column* of names' parts, its name, what stands after it, and
    whether it is an amount with a unit; *before*, *after*: the parts beside it.
    """
    matches = [match for match in map(_NUMBER.fullmatch, column) if match]
    words, units = {match[1] for match in matches}, {match[3] for match in matches}
    names = {_name_of_unit(unit) for unit in units}
    if len(matches) < len(column) or len(words) > 1 or len(names) > 1:
        return "", CASE, "", False
    (word,), (name,) = words, names
    if not name:
        name = word or _name_of_unit(after) or (before if before.isidentifier() else "number")
        return word, name, units.pop() if len(units) == 1 else "", False
    # C alone is the coulomb.
    return word, name if word.lower() in ("", *COUNTS) else word, "C" if units == {"C"} else "", True


def _name_of_unit(unit: str) -> str:
    """What is usually measured in a *unit*; empty for none."""
    if unit.endswith("Hz"):
        return "frequency"
    dimensions = first_guess.dimensions_of(unit)
    return next((name for name, of in BY_UNIT.items() if parse_unit(of).dimension in dimensions), "")


def without_table(files: Sequence[Path]) -> tuple[Sequence[Path], dict[str, dict[str, str]]]:
    """The *files* without one that is a table of conditions of the others, and these by stem."""
    for file in files:
        others = [other for other in files if other != file]
        if conditions := conditions_of_table(file, [plain_stem(other) for other in others]):
            return others, conditions
    return files, {}


def quote(content: object) -> str:
    return json.dumps(content, ensure_ascii=False)


def remark(line: str, words: str) -> str:
    return f"{line:<30} # {words}"


# Most recordings of one kind that are looked at for the bands of their fits.
LOOKED_AT = 24


@dataclass(frozen=True)
class Tests:
    """Files that are a test each, with their *paths* as the pipeline names them, and *conditions* by stem."""

    files: Sequence[Path]
    paths: Sequence[str]
    conditions: Mapping[str, Mapping[str, str]]

    def further_files(self) -> list[Path]:
        """Some of the further files where all are of one kind, else none."""
        kinds = {
            (tuple(table.columns), *sorted(table.units.items())) for table in map(open_table, self.files)
        }
        return list(self.files[1 :: max(1, len(self.files) // LOOKED_AT)]) if len(kinds) == 1 else []

    def lines(self, kind: str) -> list[str]:
        """The entry `recordings`, `frfs` or `tests` by the *kind* of files: each file of a pattern is a test
        where their names say by numbers what differed.
        """
        if len(self.paths) == 1 and not self.conditions:
            return [f"{kind}: {self.paths[0] if self.paths[0][0] == '{' else quote(self.paths[0])}"]
        stems = [plain_stem(file) for file in self.files]
        pattern = pattern_of_names(stems) if kind == "recordings" and not self.conditions else ""
        if pattern and self.further_files():
            each = remark(f"  - each: {quote(self._glob() or list(self.paths))}", "every file is a test")
            return ["tests:", each, remark(f"    pattern: {quote(pattern)}", "conditions in their names")]
        lines = [remark("tests:", "conditions: {speed: 3000 rpm} states what differed")]
        for file, stem, path in zip(self.files, stems, self.paths, strict=True):
            stated = ", ".join(
                f"{name}: {quote(text)}" for name, text in self.conditions.get(stem, {}).items()
            )
            conditions = f", conditions: {{{stated}}}" if stated else ""
            lines.append(f"  - {{name: {quote(file.stem)}, {kind}: {quote(path)}{conditions}}}")
        return lines

    def _glob(self) -> str:
        """The glob of these files and no other; empty where there is none."""
        file, columns = self.files[0], zip(*(file.name for file in self.files), strict=False)
        same = next((n for n, letters in enumerate(columns) if len(set(letters)) > 1), 0)
        # Numbers to come may begin with another digit.
        begin = file.name[:same].rstrip("0123456789")
        folder, pattern = self.paths[0].removesuffix(file.name), f"{begin}*{file.suffix}"
        is_whole = sorted(file.parent.glob(pattern)) == sorted(self.files)
        return folder + pattern if is_whole and not glob.has_magic(folder + begin) else ""

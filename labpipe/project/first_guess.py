"""What a file's own metadata say of its channels; what they do not say stays open."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.project.rig_file import DEFAULT_ROLES
from labpipe.project.settings_reader import DECIDE
from labpipe.quantities import QUANTITIES, Dimension, UnitError, parse_unit, readings
from labpipe.raw_files.first_look import hit_starts
from labpipe.raw_files.screening import TimeAxisScreen
from labpipe.raw_files.table import RawTable
from labpipe.records.finding import Finding

# Largest number of rows read.
MOST_ROWS = 1 << 21
# Words that YAML takes for something else than a text.
NO_TEXTS = ("null", "true", "false")
# Relative deviation of the steps of a time axis.
EVEN = 1e-3
# A copy is looked for where a column exceeds this share of its peak, at so many samples at least.
FAINT, LEAST_LOUD = 0.01, 8

_RECORDED = (
    "force", "displacement", "velocity", "acceleration", "voltage", "current", "pressure", "temperature",
    "moment"
)  # fmt: skip
_BRACKETS = re.compile(r"\[.*?\]|\(.*?\)")
_POINT = re.compile(r"^(?:[^\d:]*|[^:]*:)(\d+):?([+-])[XYZ](?:_\d+)?$")
_BASE = re.compile(r"\b(?:base|table|foundation|ground|tisch|fundament)\b", re.IGNORECASE)
_BY_NAME = (
    ("tacho", r"tacho|key.?phasor|\bkey\b|trigger|rpm|drehzahl"),
    (
        "force",
        r"force|hammer|kraft|load.?cell|\blc\b|impact|impuls(?!e? ?resp)|excitation|anregung|shaker"
        r"|\bf[xyz]?\d*\b",
    ),
    ("acceleration", r"acc|beschl|\ba[xyz]?\d*\b"),
    ("velocity", r"vel|\bv[xyz]?\d*\b"),
    ("displacement", r"disp|prox|probe|eddy|gap|weg|\b[xyz]\d*\b"),
    ("current", r"current|strom|\bi\d*\b"),
)


# Units of numbers that are shares of full scale, as of sound files.
SHARES = ("1",)
_SENSITIVITY = {"force": "10 mV/N", "acceleration": "10 mV/(m/s^2)", "velocity": "20 mV/(mm/s)"}


@dataclass(frozen=True)
class GuessedChannel:
    """One channel of a rig file to be; *quantity*, *unit* and *sensitivity*, for volts, may be DECIDE. *role*
    is empty where it follows from an open quantity; *guess*: what was taken from the name alone.
    """

    key: str
    column: str
    quantity: str
    unit: str
    role: str
    dof: str
    sensitivity: str = ""
    invert: bool = False
    guess: str = ""

    @property
    def decisions(self) -> tuple[str, ...]:
        """Decisions that the user must take, as text."""
        known = QUANTITIES.get(self.quantity)
        sensitivity = _SENSITIVITY.get(self.quantity, "8 V/mm")
        recorded = "volts"
        if self.unit in SHARES:
            recorded, sensitivity = "share of full scale", f"0.01 1/({known.si_unit if known else 'mm'})"
        questions = {
            "quantity": f"what is measured: {', '.join(_RECORDED[:4])}, ...; delete a channel that is not "
            "needed",
            "unit": "the unit of the recorded numbers" + (f", for example {known.si_unit}" if known else ""),
            "sensitivity": f"recorded {recorded} per quantity, for example {sensitivity}",
        }
        decisions = tuple(text for name, text in questions.items() if getattr(self, name) == DECIDE)
        return (*decisions, self.guess) if decisions and self.guess else decisions


def first_rows(table: RawTable) -> tuple[tuple[str, ...], FloatArray]:
    """Distinct columns of a table and their first rows (n_row, n_column) [recorded units]."""
    names = tuple(dict.fromkeys(table.columns))
    chunks: list[FloatArray] = []
    rows = 0
    for chunk in table.chunks(names):
        chunks.append(chunk[: MOST_ROWS - rows])
        rows += chunks[-1].shape[0]
        if rows >= MOST_ROWS:
            break
    return names, np.concatenate([np.empty((0, len(names))), *chunks])


def time_columns(names: Sequence[str], rows: FloatArray) -> list[str]:
    """Columns of *rows* (n_row, n_column) [recorded units] of equal positive steps, as printed: times."""
    return [name for name, column in zip(names, rows.T, strict=True) if step_of(column)]


def step_of(column: FloatArray) -> float:
    """The step of a column (n_row,) [recorded units] that is a time axis, 0 for any other."""
    screen = TimeAxisScreen("")
    try:
        screen.add(column)
        return 1 / screen.sample_rate()
    except DataError:
        return 0.0


def copies(names: Sequence[str], rows: FloatArray) -> dict[str, str]:
    """Columns of *rows* (n_row, n_column) [recorded units] that repeat an earlier one, and why. A copy equals
    the other column, or lies between zero and it, and somewhere nearly equals it: under a window.
    """
    copied: dict[str, str] = {}
    for number, name in enumerate(names):
        for place, other in enumerate(names):
            if place == number or other in copied:
                continue
            if reason := _repetition(rows[:, number], rows[:, place], place < number):
                copied[name] = f"{reason} of {other}"
                break
    return copied


def _repetition(column: FloatArray, other: FloatArray, is_later: bool) -> str:
    if np.array_equal(column, other):
        return "a copy" if is_later and np.any(column) else ""
    size = np.abs(other)
    loud = size > FAINT * size.max(initial=0.0)
    if np.count_nonzero(loud) < LEAST_LOUD:
        return ""
    share = column[loud] / other[loud]
    windowed = 0 <= share.min() < 1 - 0.1 < share.max() <= 1 + EVEN
    within = np.all(np.abs(column) <= size * (1 + EVEN) + EVEN * size.max())
    return "a windowed copy" if windowed and within else ""


def windows_of_copies_alone(table: RawTable, measured: Sequence[str]) -> Finding | None:
    """The warning of *measured* columns whose copies alone have the window that a pipeline states. A damping
    that they never had is taken off them: zeta comes out 1 / (w_n tau) too small.
    """
    names, rows = first_rows(table)
    number = {name: n for n, name in enumerate(names)}
    pairs = {
        raw: other
        for raw in filter(number.__contains__, measured)
        for other in names
        if other not in measured and _repetition(rows[:, number[other]], rows[:, number[raw]], False)
    }
    if not pairs:
        return None
    message = (
        f"{table.path.name} holds {', '.join(pairs)} without a window, and with one under another name, so "
        "that `windowed` takes off a damping that was never added: leave `windowed` out, or name the copies "
        f"in the rig file ({', '.join(f'{raw}: {{column: {other}}}' for raw, other in pairs.items())})"
    )
    return Finding("not-windowed", message)


def guess_channels(
    names: Sequence[str], units: dict[str, str], sensitivities: Mapping[str, str] | None = None
) -> list[GuessedChannel]:
    """A channel for every column by its metadata. The force of a rig with one response acts along it;
    more responses in one direction than two of a pair are at different points.
    """
    keys: list[str] = []
    for name in names:
        keys.append(_key(name, keys))
    guessed = [_guess(name, key, units.get(name, "")) for name, key in zip(names, keys, strict=True)]
    guessed = [_sense(channel, (sensitivities or {}).get(channel.column, "")) for channel in guessed]
    if len({*map(_node, names)} - {""}) > 1:
        guessed = [replace(c, dof=f"{_node(c.column)}.{c.dof}") if _node(c.column) else c for c in guessed]
    if not any(channel.role == "input" for channel in guessed):
        guessed = _with_base(guessed)
    outputs = [channel for channel in guessed if channel.role == "output"]
    numbers = Counter((channel.quantity, channel.dof) for channel in outputs)
    guessed = [replace(c, dof=c.key) if numbers[c.quantity, c.dof] > 2 else c for c in guessed]
    return [_along(channel, outputs) for channel in guessed]


def _with_base(channels: Sequence[GuessedChannel]) -> list[GuessedChannel]:
    """The channels with a motion that is a base's by its name as what drives others of its quantity."""
    for number, channel in enumerate(channels):
        others = [c for c in channels if c.role == "output" and c.quantity == channel.quantity]
        if channel.role == "output" and len(others) > 1 and _BASE.search(channel.column):
            base = replace(channel, role="input", guess="what drives, by its name, which is a guess")
            return [*channels[:number], base, *channels[number + 1 :]]
    return list(channels)


# Standard deviation over mean below which a force is none that drives.
STATIC = 0.02


def with_hammer(channels: Sequence[GuessedChannel], rows: FloatArray) -> tuple[GuessedChannel, ...]:
    """The channels of *rows* (n_sample, n_channel) [recorded units], where none is a force the shortest hits
    of an unknown quantity, or of volts, as one: what a hit excites lasts longer.
    """
    lengths = {
        n: float(np.sum(signal**2) / np.max(np.abs(signal)) ** 2)
        for n, channel in enumerate(channels)
        if channel.quantity in (DECIDE, "voltage")
        and hit_starts(signal := rows[:, n] - np.median(rows[:, n])).size
    }
    if not lengths or any(channel.role == "input" for channel in channels):
        return tuple(channels)
    return as_force(channels, min(lengths, key=lengths.__getitem__), "a force by its hits, which is a guess")


def without_static_forces(channels: Sequence[GuessedChannel], rows: FloatArray) -> tuple[GuessedChannel, ...]:
    """The channels of *rows* (n_sample, n_channel) [recorded units], where one force varies those that hardly
    do beside their mean, as a preload, as references: they drive nothing.
    """
    static = np.std(rows, axis=0) < STATIC * np.abs(np.mean(rows, axis=0))
    drives = [channel.role == "input" for channel in channels]
    if np.all(static[drives]):
        return tuple(channels)
    return tuple(
        replace(c, role="reference") if drive and is_static else c
        for c, drive, is_static in zip(channels, drives, static, strict=True)
    )


def as_force(channels: Sequence[GuessedChannel], number: int, guess: str) -> tuple[GuessedChannel, ...]:
    """The channels with the one of that *number* as a force, and why it is a *guess*."""
    sensitivity = DECIDE if _needs_sensitivity(channels[number].unit) else ""
    force = replace(channels[number], quantity="force", role="input", sensitivity=sensitivity, guess=guess)
    outputs = [c for n, c in enumerate(channels) if c.role == "output" and n != number]
    return tuple(_along(force, outputs) if n == number else c for n, c in enumerate(channels))


def with_a_response(channels: tuple[GuessedChannel, ...]) -> tuple[GuessedChannel, ...]:
    """The channels, where beside a force none is a response the volts as sensors that are to be told."""
    roles = {channel.role for channel in channels}
    if "input" not in roles or "output" in roles:
        return channels
    sensors = [
        replace(c, quantity=DECIDE, role="", sensitivity=DECIDE) if c.quantity == "voltage" else c
        for c in channels
    ]
    responses = [channel for channel in sensors if channel.quantity == DECIDE]
    return tuple(_along(channel, responses) for channel in sensors)


def _needs_sensitivity(unit: str) -> bool:
    return unit in SHARES or _measured_in(unit) == "voltage"


def _guess(name: str, key: str, unit: str) -> GuessedChannel:
    plain_name = re.sub(r"[_\W]+", " ", _BRACKETS.sub(" ", name).lower())
    by_name = next((quantity for quantity, pattern in _BY_NAME if re.search(pattern, plain_name)), DECIDE)
    quantity = _measured_in(unit)
    sensitivity = guess = ""
    if quantity in ("voltage", "") and by_name not in (DECIDE, "tacho"):
        # A sensor's volts, or a number without a unit: the quantity follows from the name.
        sensitivity = DECIDE if quantity == "voltage" else ""
        quantity = by_name
        guess = f"{quantity} is a guess from the name"
    elif by_name == "force" and quantity not in ("force", "moment"):
        guess = f"the name says force, the unit {quantity}"
        quantity = DECIDE
    elif by_name == "tacho":
        quantity, unit = "tacho", unit or "V"
    quantity = quantity or DECIDE
    sensitivity = DECIDE if unit in SHARES else sensitivity
    role = DEFAULT_ROLES.get(quantity, "" if quantity == DECIDE else "reference")
    point = _POINT.match(name)
    invert = point is not None and point[2] == "-"
    return GuessedChannel(
        key, name, quantity, unit or DECIDE, role, _direction(name) or key, sensitivity, invert, guess
    )


def _sense(channel: GuessedChannel, sensitivity: str) -> GuessedChannel:
    """The channel with the sensitivity of a sensor in volts, whose unit says what is measured."""
    match = re.match(r"^\s*[\d.eE+-]+\s*(\S.*)$", sensitivity)
    if match is None or _measured_in(channel.unit) != "voltage":
        return channel
    stated, volt = dimensions_of(match[1]), parse_unit("V").dimension
    for quantity in _RECORDED:
        wanted = tuple(u - q for u, q in zip(volt, _si_dimension(quantity), strict=True))
        if wanted in stated and quantity != "voltage":
            role = DEFAULT_ROLES.get(quantity, "reference")
            return replace(channel, quantity=quantity, role=role, sensitivity=sensitivity.strip(), guess="")
    return channel


def _measured_in(unit: str) -> str:
    dimensions = dimensions_of(unit)
    return next((name for name in _RECORDED if _si_dimension(name) in dimensions), "")


def _si_dimension(quantity: str) -> Dimension:
    return parse_unit(QUANTITIES[quantity].si_unit).dimension


def dimensions_of(unit: str) -> list[Dimension]:
    """What may be measured in a *unit*, as of `readings`; nothing in one that is unknown."""
    try:
        return [reading.dimension for reading in readings(unit)]
    except UnitError:
        return []


def _node(name: str) -> str:
    """The node of a point such as "12-Z" (universal files) or "shaft:12:-Z" (Test.Lab), '' for others."""
    match = _POINT.match(name)
    return match[1] if match else ""


def _direction(name: str) -> str:
    """x, y or z where the name has one as a word or at its end, or as that of a force: Fx."""
    plain_name = _BRACKETS.sub(" ", name)
    match = re.search(r"(?:^|[_\W\d])([xyz])(?:$|[_\W\d])", plain_name, re.I)
    match = match or re.search(r"[a-z]([XYZ])\b|\b[Ff]([xyz])\b", plain_name)
    return (match[1] or match[2]).lower() if match else ""


def _key(name: str, used_keys: Sequence[str]) -> str:
    """A short name for a channel: the column's without its unit, in letters, digits and underscores."""
    plain = re.sub(r"\W+", "_", _BRACKETS.sub(" ", name)).strip("_").lower() or "channel"
    key = first = plain if plain[0].isalpha() and plain not in NO_TEXTS else f"ch_{plain}"
    number = 1
    while key in used_keys:
        number += 1
        key = f"{first}_{number}"
    return key


def _along(channel: GuessedChannel, outputs: Sequence[GuessedChannel]) -> GuessedChannel:
    """A force whose name has no direction acts along the only response."""
    if channel.role != "input" or channel.dof != channel.key or len(outputs) != 1:
        return channel
    return replace(channel, dof=outputs[0].dof)


# Bands around the peaks of FRFs, as a first look at their modes.

# A fit looks at this share of the peak's frequency to either side, or at so many half-power widths if that is
# less, but at some widths and this many lines at least; a stabilisation diagram at so many.
AROUND, WIDTHS, LEAST_WIDTHS, LEAST_LINES, MODAL_LINES = 0.1, 10.0, 2.5, 12, 26
# Logarithm by which a peak stands out of what lies between it and the next higher one: a factor of 2.
STANDS_OUT = 0.7
# R^2 of a mode: of amplitudes, where peaks of ten FRFs by others have .93 or more and noise .9 or less
# (median .3); of complex numbers, where noise has .64 or less and channels that were not excited .87.
LIKE_A_MODE, LIKE_A_POLE = 0.95, 0.9
# Fewest lines that can tell a mode, and least half-width of a pole in lines: a single line by itself is none.
LEAST_AROUND, LEAST_WIDTH = 9, 0.1
# Coherence at a peak that no noise has.
EXPLAINED = 0.8
Numbers = FloatArray | ComplexArray


def highest_peak(mobility: Numbers, coherence: FloatArray | None = None) -> tuple[int, bool]:
    """The line of the highest peak of a *mobility* (n_line,) [1] that looks like a mode, or that the force
    explains by its *coherence* (n_line,) [1], and whether there is one. Neither an end nor what hardly stands
    out, or follows no pole, is one; without any it is the highest of all.
    """
    size = np.abs(mobility)
    peaks = peaks_of(size)
    ordered = peaks[np.argsort(-size[peaks])] if peaks.size else np.array([np.argmax(size)])
    explained = np.zeros(size.size) if coherence is None else coherence
    like_a_mode: Callable[[Any, int], bool] = _is_pole if np.iscomplexobj(mobility) else _is_mode
    for peak in map(int, ordered):
        if peaks.size and (explained[peak] > EXPLAINED or like_a_mode(mobility, peak)):
            return peak, True
    return int(ordered[0]), False


def peaks_of(mobility: FloatArray) -> IntArray:
    """The places of lines of a *mobility* (n_line,) [1] that stand out of their surroundings, as scipy's
    find_peaks has them, whose package takes longer to load than all else here.
    """
    y = np.log(np.maximum(mobility, np.finfo(float).tiny))
    places = np.flatnonzero((y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:])) + 1
    apart, kept = max(y.size // 400, 1), np.ones(places.size, bool)
    for n in np.argsort(y[places])[::-1]:
        if kept[n]:
            kept &= np.abs(places - places[n]) >= apart
            kept[n] = True
    return np.array([k for k in places[kept] if _prominence(y, int(k)) >= STANDS_OUT], np.intp)


def _prominence(y: FloatArray, peak: int) -> float:
    """How far a *peak* lies above the higher of the two valleys between it and what is higher."""
    left, right = np.flatnonzero(y[:peak] > y[peak]), np.flatnonzero(y[peak:] > y[peak])
    before = y[left[-1] if left.size else 0 : peak + 1].min()
    after = y[peak : (peak + right[0] if right.size else y.size)].min()
    return float(y[peak] - max(before, after))


def band_of(
    frequency: FloatArray, mobility: FloatArray, peak: int, lines: int = LEAST_LINES
) -> tuple[float, float]:
    """The band [Hz] around the line *peak* of a *mobility* (n_line,) [1], with so many *lines* at least."""
    spacing = float(np.median(np.diff(frequency)))
    width = half_power_lines(mobility, peak) * spacing
    # Of a light damping a tenth of the frequency holds neighbours, of a heavy one no whole peak.
    reach = min(AROUND * float(frequency[peak]), WIDTHS * width)
    reach = max(reach, LEAST_WIDTHS * width, lines / 2 * spacing)
    lowest, highest = float(frequency[frequency > 0][0]), float(frequency[-1])
    # What an end of the lines cuts off is added on the other side.
    low = max(min(float(frequency[peak]) - reach, highest - lines * spacing), lowest)
    return low, min(max(float(frequency[peak]) + reach, low + lines * spacing), highest)


def half_power_lines(mobility: FloatArray, peak: int) -> int:
    """Lines around a *peak* of a *mobility* (n_line,) [1] with half its power or more."""
    beside = mobility < mobility[peak] / np.sqrt(2)
    left, right = beside[:peak][::-1], beside[peak:]
    return sum(int(np.argmax(side) if side.any() else side.size) for side in (left, right))


# Mean sine of the steps of a phase by half a half-power width around a peak: of a pole about -0.7.
# Of fourteen FRFs by others -0.1 to -0.7, and 0.23 of one that is conjugate. A peak over the median that no
# noise has.
RISES, CLEAR = 0.15, 10.0


def phase_rises(h: Numbers, peak: int) -> bool:
    """Whether the phase of FRFs (n_line, n_element) [1] rises through the *peak*: the phase of no mode does,
    so that they are complex conjugates, as where the factors of a cross spectrum are interchanged.
    """
    size = np.abs(h[:, 0])
    if size[peak] < CLEAR * np.median(size):
        return False
    width = max(half_power_lines(size, peak), 2)
    around, step = h[max(peak - width, 0) : peak + width + 1], width // 2
    products = around[step:] * around[:-step].conj()
    return bool(np.sum(products.imag) > RISES * np.sum(np.abs(products)))


def _is_pole(h: ComplexArray, peak: int) -> bool:
    """Whether H around a *peak* is that of one stable pole beside a constant, (a + b x) / (x - p), by R^2."""
    x, y = _around(h, peak)
    if not y.size:
        return False
    a, b, p = np.linalg.lstsq(np.stack([np.ones_like(x), x, y], axis=1), x * y, rcond=None)[0]
    left = y - (a + b * x) / (x - p)
    explained = np.vdot(left, left).real < (1 - LIKE_A_POLE) * np.sum(np.abs(y - y.mean()) ** 2)
    return bool(explained and p.imag > LEAST_WIDTH * (x[1] - x[0]))


def _around(h: Numbers, peak: int) -> tuple[FloatArray, Numbers]:
    """Three half-power widths around a *peak*, up to lines that are higher: their places from -1 to 1, and
    values by that of the peak; none where they are too few or no numbers.
    """
    size = np.abs(h)
    reach = max(int(1.5 * half_power_lines(size, peak)), 4)
    higher = np.flatnonzero(size > size[peak])
    begin = max(peak - reach, 0, *(higher[higher < peak][-1:] + 1))
    end = min(peak + reach + 1, h.size, *higher[higher > peak][:1])
    y = h[begin:end] / size[peak]
    if y.size < LEAST_AROUND or not np.all(np.isfinite(y)):
        y = y[:0]
    return np.linspace(-1, 1, y.size), y


def _is_mode(mobility: FloatArray, peak: int) -> bool:
    """Whether |H|^2 around a *peak* is a quotient of two parabolas, as of one mode beside others, by R^2."""
    x, y = _around(mobility**2, peak)
    if not y.size:
        return False
    columns = np.stack([np.ones_like(x), x, -y * x, -y * x * x], axis=1)
    c = np.linalg.lstsq(columns, y, rcond=None)[0]
    left = y - (c[0] + c[1] * x) / (1 + c[2] * x + c[3] * x * x)
    return bool(left @ left < (1 - LIKE_A_MODE) * np.sum((y - y.mean()) ** 2))

"""Virtual rigs with true parameters, their files as a logger writes them; VIRTUAL_RIGS by kind."""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.records.recording import Recording
from labpipe.records.response import FrequencyResponse
from labpipe.records.spectra import ChannelSpectra
from labpipe.registry import Registry, nearest
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings


def one_mass_truth(mass: float, stiffness: float, damping: float) -> dict[str, float]:
    """Mass [kg], k [N/m], c [N.s/m], f_n = sqrt(k / m) / 2 pi [Hz], zeta = c / (2 sqrt(k m)) [1] by name.
    Equation (sim-one-mass).
    """
    natural = math.sqrt(stiffness / mass)
    modal = {"f_n": natural / (2 * math.pi), "zeta": damping / (2 * mass * natural)}
    return {"mass": mass, "k": stiffness, "c": damping, **modal}


def coefficients_by_name(labels: Sequence[str], glue: str = "", **matrices: ArrayLike) -> dict[str, float]:
    """Entries of the matrices (n, n) by name: k_xx, k_xy, ... of k and the labels x, y. *glue* between two
    labels.
    """
    return {
        f"{letter}_{labels[row]}{glue}{labels[column]}": float(value)
        for letter, matrix in matrices.items()
        for (row, column), value in np.ndenumerate(np.asarray(matrix))
    }


VIRTUAL_RIGS = Registry("virtual rig")

Truth = dict[str, float]


class VirtualRig(Protocol):
    """The settings of a virtual rig of any kind."""

    @property
    def kind(self) -> str: ...
    @property
    def name(self) -> str: ...


@dataclass(frozen=True)
class LoggedTable:
    """A file of a logger: *columns* "name [unit]" of recorded numbers (n_row,), as *text* or binary.

    level: of compression, None for the default; dictionary, split: how the bytes of a column are packed.
    """

    columns: Mapping[str, NDArray[np.generic]]
    text: bool = False
    level: int | None = None
    dictionary: bool = True
    split: bool = False


@dataclass(frozen=True)
class LoggedFile:
    """A text file in a format of its own: *content* is what *write* puts at a path."""

    content: Any
    write: Callable[[Path, Any], None]


@dataclass(frozen=True)
class Simulation:
    """*files* by the name of their run, and the *truth*: entries of truth.json."""

    files: Mapping[str, LoggedTable | FrequencyResponse | LoggedFile]
    truth: Mapping[str, Any]


@dataclass(frozen=True)
class SimulatedRun:
    """A run: its recording, or its calibration table ("name [unit]": (n_row,)), and its true parameters."""

    name: str
    truth: dict[str, Any]
    recording: Recording | None = None
    table: dict[str, FloatArray] | None = None


def generator(seed: int, name: str) -> np.random.Generator:
    """The random numbers of a run: the same for a seed and a name, whatever other runs are made."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def with_noise(rig: Any, level: float) -> Any:
    """The rig with every number of its section `noise` times *level*."""
    scaled = {field.name: level * getattr(rig.noise, field.name) for field in fields(rig.noise)}
    return replace(rig, noise=replace(rig.noise, **scaled))


@dataclass(frozen=True, kw_only=True)
class VirtualRigKind:
    """A kind of virtual rig; every function takes the settings of a rig first.

    settings: dataclass of the rig file. runs: names of its runs, none where the rig is one FRF; usual: those
    that are made unless runs are named, all by default. simulate: (rig, seed, runs) -> files and truth; a
    run's samples depend on rig, seed and its name only. For studies: parameters: (rig, runs) -> true
    parameters of a fit by name [SI]; noisy: (rig, level) -> the rig with its noise at a level of a study;
    recordings: (rig, seed, runs) -> recordings in SI units, or response: (rig, seeds) -> an FRF with noise,
    without for None. with_lines: (rig, count) -> the rig with another number of lines; std_errors: (rig,
    runs, band [Hz]) -> Cramer-Rao standard errors where the rig knows them.
    """

    settings: type
    runs: Callable[[Any], tuple[str, ...]]
    simulate: Callable[[Any, int, Sequence[str]], Simulation]
    parameters: Callable[[Any, Sequence[str]], Truth]
    noisy: Callable[[Any, float], Any] = with_noise
    recordings: Callable[[Any, int, Sequence[str]], Sequence[Recording]] | None = None
    usual: Callable[[Any], tuple[str, ...]] | None = None
    response: Callable[[Any, Sequence[int] | None], FrequencyResponse] | None = None
    with_lines: Callable[[Any, int], Any] | None = None
    std_errors: Callable[[Any, Sequence[str], tuple[float, float]], Truth] | None = None


def kind_of_recordings(
    settings: type,
    *,
    record: Callable[[Any, str, np.random.Generator], Recording],
    logged: Callable[[Recording], LoggedTable],
    truth: Callable[[Any], Mapping[str, Any]] = attrgetter("truth"),
    **others: Any,
) -> VirtualRigKind:
    """A kind whose runs are recordings: *record* makes a run by name, *logged* its file; *others* as of
    VirtualRigKind. The parameters are the *truth* unless they are given.
    """

    def make(rig: Any, seed: int, names: Sequence[str]) -> tuple[Recording, ...]:
        return tuple(record(rig, name, generator(seed, name)) for name in names)

    def simulate(rig: Any, seed: int, names: Sequence[str]) -> Simulation:
        return Simulation({run.name: logged(run) for run in make(rig, seed, names)}, {"truth": truth(rig)})

    defaults = {"simulate": simulate, "recordings": make, "parameters": lambda rig, _runs: truth(rig)}
    return VirtualRigKind(settings=settings, **{**defaults, **others})


def kind_of_tests(
    settings: type,
    *,
    tests: Callable[[Any, int, Sequence[str]], Sequence[SimulatedRun]],
    logged: Callable[[Recording], LoggedTable],
    **others: Any,
) -> VirtualRigKind:
    """A kind whose runs each have their truth, recordings as well as calibration tables. *others* as of
    VirtualRigKind.
    """

    def recordings_of(rig: Any, seed: int, names: Sequence[str]) -> list[Recording]:
        return [run.recording for run in tests(rig, seed, names) if run.recording is not None]

    def simulate(rig: Any, seed: int, names: Sequence[str]) -> Simulation:
        runs = tests(rig, seed, names)
        files = {
            run.name: LoggedTable(run.table or {}, text=True)
            if run.recording is None
            else logged(run.recording)
            for run in runs
        }
        return Simulation(files, {"runs": {run.name: run.truth for run in runs}})

    return VirtualRigKind(settings=settings, simulate=simulate, recordings=recordings_of, **others)


def kind_of(rig: VirtualRig) -> VirtualRigKind:
    """The kind of a virtual rig."""
    kind: VirtualRigKind = VIRTUAL_RIGS.load(rig.kind)
    return kind


def simulate(rig: VirtualRig, seed: int, runs: Iterable[str] | None = None) -> Simulation:
    """Files and truth of the named runs, of all without names. ConfigError with the nearest known name on a
    miss.
    """
    return kind_of(rig).simulate(rig, seed, chosen_runs(rig, runs))


def recordings(rig: VirtualRig, seed: int, runs: Iterable[str] | None = None) -> tuple[Recording, ...]:
    """The recordings of the named runs in SI units; ConfigError for a rig without recordings."""
    kind = kind_of(rig)
    if kind.recordings is None:
        raise ConfigError(f"a {rig.kind} gives no recordings", hint="labpipe simulate says what it gives")
    return tuple(kind.recordings(rig, seed, chosen_runs(rig, runs)))


def kind_of_responses(rig: VirtualRig, frf: FrfSettings | None) -> VirtualRigKind:
    """The kind of a rig that gives a response, if need be by *frf*; ConfigError for another."""
    kind = kind_of(rig)
    if kind.response is None and kind.recordings is None:
        what = f"a {rig.kind} gives no frequency response"
        raise ConfigError(what, hint="studies repeat fits of frequency responses")
    if kind.response is None and frf is None:
        raise ConfigError("the study needs the frf: section to measure this rig's recordings")
    return kind


def simulated_response(
    rig: VirtualRig, seeds: Sequence[int], runs: Iterable[str] | None, frf: FrfSettings | None
) -> FrequencyResponse | ChannelSpectra:
    """One FRF matrix of the rig, its noise from *seeds*: given directly, or measured from its *runs* as *frf*
    says; or spectra. ConfigError for a rig that has none.
    """
    kind = kind_of_responses(rig, frf)
    if kind.response is not None:
        return kind.response(rig, seeds)
    assert frf is not None
    # Different for different rows of up to a million repeats.
    seed = functools.reduce(lambda joined, part: joined * 1_000_003 + part, seeds, 0)
    made = list(recordings(rig, seed, runs))
    return channel_spectra(made, frf) if frf.result == "spectra" else measure(made, frf)


def chosen_runs(rig: VirtualRig, runs: Iterable[str] | None) -> tuple[str, ...]:
    """The named runs, the usual ones without names; ConfigError for a name that the rig does not have."""
    kind = kind_of(rig)
    available = kind.runs(rig)
    if runs is None:
        return available if kind.usual is None else kind.usual(rig)
    chosen = tuple(runs)
    if chosen and not available:
        raise ConfigError("this rig has no runs, it is one FRF", hint="leave --run out")
    for name in chosen:
        if name not in available:
            raise ConfigError(f"no run '{name}'", hint=nearest(name, available))
    return chosen


# Long runs are stored as whole numbers: quantity -> (recorded unit, recorded value per SI value).
WHOLE = {
    "force": ("mN", 1e3),
    "displacement": ("nm", 1e9),
    "acceleration": ("mm/s^2", 1e3),
    "current": ("mA", 1e3),
    "tacho": ("V", 1.0),
}
FINE_VOLTAGE, COARSE_VOLTAGE = ("uV", 1e6), ("mV", 1e3)


def force_and_displacements(run: Recording) -> LoggedTable:
    """Force and two displacements in um, single precision; split, as the bytes of noise pack best."""
    titles = ("force [N]", *(f"{channel.name} [um]" for channel in run.channels[1:]))
    columns = dict(zip(titles, (run.samples * [1.0, 1e6, 1e6]).T.astype(np.float32), strict=True))
    return LoggedTable(columns, dictionary=False, split=True)


def _whole(title: str, counts: FloatArray, kind: type[np.signedinteger]) -> NDArray[np.generic]:
    if not np.all(np.abs(counts) <= np.iinfo(kind).max):
        what = f"{title}: beyond {np.iinfo(kind).max}, where the logger ends"
        raise ConfigError(what, hint="make the forces, motions or noise of the rig smaller")
    return counts.astype(kind)


def force_and_accelerations(run: Recording) -> LoggedTable:
    """As a 16-bit logger stores them: force in cN, accelerometers in mV at 10 mV per m/s^2."""
    steps = np.rint(run.samples * [100.0, *[10.0] * (len(run.channels) - 1)])
    titles = ("force [cN]", *(f"{channel.name} [mV]" for channel in run.channels[1:]))
    columns = {title: _whole(title, column, np.int16) for title, column in zip(titles, steps.T, strict=True)}
    return LoggedTable(columns, level=19, dictionary=False)


def whole_numbers(
    run: Recording,
    units: Mapping[str, tuple[str, float]] | None = None,
    steps: Mapping[str, int] | None = None,
) -> LoggedTable:
    """Columns such as "x [nm]", "ix [mA]", "ux [mV]" as whole numbers; injected voltages are small, so in uV.
    *units* as WHOLE has them. *steps*: by channel, the step of the logger in the recorded unit; coarse steps
    pack best by a dictionary of their values.
    """
    columns = {}
    chosen = {**WHOLE, **(units or {})}
    for channel, samples in zip(run.channels, run.samples.T, strict=True):
        voltage = FINE_VOLTAGE if channel.role != "reference" else COARSE_VOLTAGE
        unit, per_si = chosen.get(channel.quantity, voltage)
        step = steps[channel.name] if steps else 1
        title = f"{channel.name} [{unit}]"
        columns[title] = _whole(title, step * np.rint(samples * (per_si / step)), np.int32)
    return LoggedTable(columns, level=19, dictionary=bool(steps), split=not steps)

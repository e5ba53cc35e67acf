"""Virtual rigs with true parameters. VIRTUAL_RIGS by kind: the settings of a rig file, its runs, their files, and responses for studies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import ConfigError
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.recording import Recording
from labpipe.records.response import FrequencyResponse
from labpipe.records.run_up import RunUp
from labpipe.registry import Registry, nearest
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

VIRTUAL_RIGS = Registry(
    "virtual rig",
    {
        "virtual-magnetic-rig": "labpipe.simulate.magnetic_rig:MAGNETIC_RIG",
        "virtual-mdof-rig": "labpipe.simulate.mdof_rig:MDOF_RIG",
        "virtual-ball-bearing-rig": "labpipe.simulate.ball_bearing_rig:BALL_BEARING_RIG",
        "virtual-journal-rig": "labpipe.simulate.journal_rig:JOURNAL_RIG",
        "virtual-unbalance-rig": "labpipe.simulate.unbalance_rig:UNBALANCE_RIG",
        "virtual-white-noise-rig": "labpipe.simulate.white_noise_rig:WHITE_NOISE_RIG",
        "virtual-decay-rig": "labpipe.simulate.decay_rig:DECAY_RIG",
        "virtual-floating-rig": "labpipe.simulate.floating_rig:FLOATING_RIG",
        "virtual-sweep-rig": "labpipe.simulate.sweep_rig:SWEEP_RIG",
        "virtual-base-rig": "labpipe.simulate.base_rig:BASE_RIG",
        "virtual-levitated-rig": "labpipe.simulate.levitated_rig:LEVITATED_RIG",
    },
)

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
class Simulation:
    """*files* by the name of their run, and the *truth*: entries of truth.json."""

    files: Mapping[str, LoggedTable | FrequencyResponse | RunUp]
    truth: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class VirtualRigKind:
    """A kind of virtual rig; every function takes the settings of a rig first.

    settings: dataclass of the rig file. runs: names of its runs, none where the rig is one FRF; usual: those that are made unless runs are
    named, all by default. simulate: (rig, seed, runs) -> files and
    truth; a run's samples depend on rig, seed and its name only. For studies: parameters: (rig, runs) -> true parameters of a fit by name
    [SI]; noisy: (rig, level) -> the rig with its noise at a level of a study; recordings: (rig, seed, runs) -> recordings in SI units, or
    response: (rig, seeds) -> an FRF with noise, without for None. with_lines: (rig, count) -> the rig with another number of lines;
    std_errors: (rig, runs, band [Hz]) -> Cramer-Rao standard errors where the rig knows them.
    """

    settings: type
    runs: Callable[[Any], tuple[str, ...]]
    simulate: Callable[[Any, int, Sequence[str]], Simulation]
    parameters: Callable[[Any, Sequence[str]], Truth]
    noisy: Callable[[Any, float], Any]
    recordings: Callable[[Any, int, Sequence[str]], Sequence[Recording]] | None = None
    usual: Callable[[Any], tuple[str, ...]] | None = None
    response: Callable[[Any, Sequence[int] | None], FrequencyResponse] | None = None
    with_lines: Callable[[Any, int], Any] | None = None
    std_errors: Callable[[Any, Sequence[str], tuple[float, float]], Truth] | None = None


def kind_of(rig: VirtualRig) -> VirtualRigKind:
    """The kind of a virtual rig."""
    kind: VirtualRigKind = VIRTUAL_RIGS.load(rig.kind)
    return kind


def simulate(rig: VirtualRig, seed: int, runs: Iterable[str] | None = None) -> Simulation:
    """Files and truth of the named runs, of all without names; ConfigError with the nearest known name on a miss."""
    return kind_of(rig).simulate(rig, seed, chosen_runs(rig, runs))


def recordings(rig: VirtualRig, seed: int, runs: Iterable[str] | None = None) -> tuple[Recording, ...]:
    """The recordings of the named runs in SI units; ConfigError for a rig without recordings."""
    kind = kind_of(rig)
    if kind.recordings is None:
        raise ConfigError(f"a {rig.kind} gives no recordings", hint="labpipe simulate says what it gives")
    return tuple(kind.recordings(rig, seed, chosen_runs(rig, runs)))


def simulated_response(
    rig: VirtualRig, seeds: Sequence[int], runs: Iterable[str] | None = None, frf: FrfSettings | None = None
) -> FrequencyResponse | ChannelSpectra:
    """One FRF matrix of the rig, its noise from *seeds*: given directly, or measured from its *runs* as *frf* says; or spectra.

    ConfigError for a rig that has none.
    """
    kind = kind_of(rig)
    if kind.response is not None:
        return kind.response(rig, seeds)
    if kind.recordings is None:
        raise ConfigError(f"a {rig.kind} gives no frequency response", hint="studies repeat fits of frequency responses")
    if frf is None:
        raise ConfigError("the study needs the frf: section to measure this rig's recordings")
    made = list(recordings(rig, _joined(seeds), runs))
    return channel_spectra(made, frf) if frf.result == "spectra" else measure(made, frf)


def _joined(seeds: Sequence[int]) -> int:
    """One integer from several, different for different rows of up to a million repeats."""
    joined = 0
    for part in seeds:
        joined = joined * 1_000_003 + part
    return joined


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

"""Settings of run-ups: runs, probes, methods, metamodels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.errors import ConfigError, SettingError
from labpipe.methods.run_ups.records import DIRECTIONS, HELD_OUT, TRAINED, ProbeError
from labpipe.methods.run_ups.rotor import PARAMETERS, RunUpRotor
from labpipe.quantities import UnitError
from labpipe.records.rig import Rig
from labpipe.records.settings import Settings, choice, integer, names, quantity, section, setting, text
from labpipe.records.uncertain import COURSES, Uncertain, Uncertainty, parse_uncertain, uncertainty_of
from labpipe.registry import Registry, nearest

KEYPHASOR = "keyphasor"
MANY_PULSES = "of several pulses a revolution none marks the angle of the unbalance"
ONE_PULSE = "a tacho with one pulse per revolution"


@dataclass(frozen=True)
class ProbeUncertainties:
    """Of the probes of a table: relative gain [1], phase [rad], delay [s]; angle [rad] of the keyphasor."""

    gain: Uncertain | None = None
    phase: Uncertain | None = None
    delay: Uncertain | None = None
    keyphasor: Uncertain | None = None

    def errors(self, planes: Sequence[str]) -> tuple[ProbeError, ...]:
        """Of every probe, each its own, by plane and direction, unless the uncertainty names a source."""
        errors = []
        for effect, unit in (("gain", "1"), ("phase", "rad"), ("delay", "s")):
            number: Uncertain | None = getattr(self, effect)
            if number is None or number.std_error == 0:
                continue
            slope, power = COURSES[effect]
            for at, plane in enumerate(planes):
                for axis, direction in enumerate(DIRECTIONS):
                    matrix = np.zeros((len(planes), 2, 2), np.complex128)
                    matrix[at, axis, axis] = slope
                    source = uncertainty_of(number, f"{plane} {direction}.{effect}", unit)
                    errors.append(ProbeError(source, matrix, power))
        if self.keyphasor is not None and self.keyphasor.std_error > 0:
            errors.append(turning(uncertainty_of(self.keyphasor, KEYPHASOR, "rad"), len(planes)))
        return tuple(errors)


def turning(uncertainty: Uncertainty, n_plane: int, slope: complex = 1j, power: int = 0) -> ProbeError:
    """The error of the keyphasor, which turns all phasors alike."""
    return ProbeError(uncertainty, np.tile(slope * np.eye(2), (n_plane, 1, 1)), power)


# From rotor, trained runs and settings to a Solved: labpipe.methods.run_ups.methods.
METHODS = Registry("run-up method")
METAMODELS = ("response-surface", "network", "gaussian-process", "physical")
SEARCHES = ("pattern", "cobyqa")
# Settings of labpipe's own methods, each with those that it is of.
OF_METHODS = {
    "bound": ("amplitudes", "points"),
    "ridge": ("points",),
    "known": ("joint",),
    "search": ("amplitudes",),
    "starts": ("amplitudes",),
}


def _file(help: str, kind: str, into: str) -> Any:
    return setting("file", help, default="", file_kind=kind, into=into)


@dataclass(frozen=True, kw_only=True)
class RunSettings(Settings):
    """One entry of ``run_ups.runs:``, a table or a recording; *unbalance* [kg m] by plane in place of the
    table's. path, subtracted: the files with their folder; recorded_by: contents of `rig`.
    """

    file: str = _file("table of the run-up (CSV), relative to the pipeline file", "path", "path")
    recording: str = _file("time recording of the run-up with a tacho, instead of a table", "path", "path")
    rig: str = _file("rig file of a raw recording; dofs name planes: disc1.x, disc1.y", "rig", "recorded_by")
    tacho: str = text("channel with the tacho's pulses")
    pulses: int = integer("pulses of the tacho per revolution", 1)
    harmonics: int = integer("multiples of the speed fitted along", 2)
    revolutions: int = integer("revolutions of one stretch", 20)
    name: str = text("name of the run; default: the file's")
    role: str = choice("fits see trained runs only", (TRAINED, HELD_OUT), TRAINED)
    load: float | None = quantity("static load; default: the table's", "N", None)
    threshold: Uncertain | None = setting(
        "uncertain", "measured threshold of instability; default: the table's", "Hz", None
    )
    subtract: str = _file(
        "run of the residual unbalance, subtracted phasor by phasor (a file of the same kind)",
        "path",
        "subtracted",
    )
    printed_critical_speed: tuple[float, ...] = setting(
        "values", "printed elsewhere, shown for reference: measured, original, enhanced", "Hz", ()
    )
    printed_threshold: tuple[float, ...] = setting("values", "the same of the threshold", "Hz", ())
    unbalance: tuple[tuple[str, complex], ...] = setting(
        "phasors", "known unbalance by plane, instead of the table's: {disc 1: 50 g.mm at 0 deg}", "kg.m", ()
    )
    path: Path = Path()
    subtracted: Path | None = None
    recorded_by: Rig | None = None

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", Path(self.file or self.recording).name.split(".")[0])
        if bool(self.file) == bool(self.recording):
            hint = "file: load-1.csv, or recording: run.parquet with tacho:"
            raise ConfigError("one of 'file' and 'recording' is needed", hint=hint)
        if self.recording:
            self._check_recording()
        else:
            for name in ("rig", "tacho", "pulses", "harmonics", "revolutions"):
                if name in self.written:
                    raise SettingError(name, f"'{name}' belongs to a recording", "leave it out of a table")
        self.require_positive("load")
        if self.threshold is not None and not (self.threshold.value > 0 and self.threshold.std_error > 0):
            raise ConfigError("'threshold' needs its uncertainty", hint="for example 2772 rpm +- 6 rpm")
        for name in ("printed_critical_speed", "printed_threshold"):
            values = getattr(self, name)
            if values and not (len(values) == 3 and min(values) > 0):
                hint = "measured, original and enhanced"
                raise SettingError(name, f"'{name}' has three values above zero", hint)

    def _check_recording(self) -> None:
        if not self.tacho:
            raise ConfigError("'tacho' is missing", hint="name the channel with the tacho's pulses")
        if self.load is None:
            hint = "a recording does not state it; for example load: 3.66 N"
            raise ConfigError("'load' is missing", hint=hint)
        if not self.unbalance:
            hint = "a recording does not state it; for example {disc 1: 50 g.mm at 0 deg}"
            raise SettingError("unbalance", "unbalance: is missing", hint)
        if self.pulses != 1:
            raise SettingError("pulses", MANY_PULSES, ONE_PULSE)
        if min(self.harmonics, self.revolutions - 1) < 1:
            raise ConfigError("'harmonics' is at least 1, 'revolutions' at least 2")


@dataclass(frozen=True)
class ProbeSettings(Settings):
    """Standard uncertainties of the probes of all runs, or as brackets say, as in a rig file."""

    gain: str = text(
        "of every probe, relative: 1 %, or 2 % (k=2), or 1 % (source=calibrator) of all together"
    )
    phase: str = text("of every probe, at every speed alike: 0.5 deg")
    delay: str = text("of every probe's chain: 5 us")
    keyphasor: str = text("of the keyphasor's angle, which turns all phasors alike: 1 deg")
    uncertainties: ProbeUncertainties = ProbeUncertainties()

    def __post_init__(self) -> None:
        units = {"gain": "1", "phase": "rad", "delay": "s", "keyphasor": "rad"}
        numbers = {}
        for name, unit in units.items():
            text, value = getattr(self, name), "1" if name == "gain" else f"0 {unit}"
            try:
                numbers[name] = parse_uncertain(f"{value} +- {text}", unit) if text else None
            except UnitError as error:
                raise SettingError(
                    name, f"'{text}' is not an uncertainty: {error.what}", error.hint
                ) from None
        object.__setattr__(self, "uncertainties", ProbeUncertainties(**numbers))


@dataclass(frozen=True, kw_only=True)
class RunUpSettings(Settings):
    """The ``run_ups:`` section; *rig*: contents of `rotor`."""

    rotor: str = setting(
        "file", "rotor file with pins, relative to the pipeline file", file_kind="run-up-rotor", into="rig"
    )
    runs: tuple[RunSettings, ...] = setting(
        "entries",
        "the run-ups, for example - {file: load-1.csv}",
        section=RunSettings,
        default=(),
        needed=True,
    )
    methods: tuple[str, ...] = setting(
        "names", f"what is fitted: {', '.join(METHODS)}", default=("points", "joint")
    )
    metamodels: tuple[str, ...] = names(
        f"of coefficients over load and speed: {', '.join(METAMODELS)}", may_be_empty=True
    )
    metamodels_of: str = choice("the method whose coefficients they are fitted to", tuple(METHODS), "joint")
    plane: str = text("plane of the critical speeds; default: the last one")
    bound: float = quantity("largest change of a coefficient (amplitudes, points)", "1", 0.3)
    ridge: float = quantity("standard deviation of that change before a run is seen (points)", "1", 0.15)
    known: tuple[str, ...] = names(
        f"joint: what is as in the rotor file, of {', '.join(PARAMETERS)}", may_be_empty=True
    )
    search: str = choice("how amplitudes are fitted", SEARCHES, "pattern")
    starts: int = integer("starts of that search at one load and speed, to show their spread", 20)
    seed: int = integer("of random starts and networks", 1)
    source: str = text("where the printed values are from")
    probes: ProbeSettings = section(
        "uncertainties of the probes of tables; a recording has those of its rig file",
        ProbeSettings,
        ProbeSettings(),
    )
    rig: RunUpRotor | None = None

    def __post_init__(self) -> None:
        for field, table in (("methods", METHODS), ("metamodels", METAMODELS), ("known", PARAMETERS)):
            names = getattr(self, field)
            for name in names:
                if name not in table:
                    raise SettingError(field, f"unknown name '{name}'", nearest(name, table))
                if names.count(name) > 1:
                    raise SettingError(field, f"'{name}' is named twice", "leave one out")
        all_ours = set() < {*self.methods} <= {"amplitudes", "points", "joint", "process"}
        for key in self.written if all_ours else ():
            if not {*OF_METHODS.get(key, self.methods)} & {*self.methods}:
                what = f"'{key}' is of {' and '.join(OF_METHODS[key])}, which is not among the methods"
                raise SettingError(key, what, "leave it out")
        if len(set(self.known)) == len(PARAMETERS):
            raise SettingError("known", "nothing is left to estimate", "leave some out")
        if not (0 < self.bound < 1 and self.ridge > 0):
            hint = "for example bound: 30 %"
            raise ConfigError("'bound' lies between 0 and 100 %, 'ridge' above 0", hint=hint)
        if self.plane and self.rig is not None and self.plane not in self.rig.plane_names:
            hint = nearest(self.plane, self.rig.plane_names)
            raise SettingError("plane", f"no plane '{self.plane}' in {self.rig.name}", hint)
        self._check_fits()

    def _check_fits(self) -> None:
        needed = {self.metamodels_of} if self.metamodels else set()
        if "physical" in self.metamodels:
            needed.add("joint")
        for name in sorted(needed - set(self.methods)):
            what = f"metamodels need the method '{name}', which is not fitted"
            raise SettingError("metamodels", what, f"add {name} to run_ups.methods")
        if not self.runs:
            raise SettingError("runs", "a list of runs is needed", "for example - {file: load-1.csv}")
        names = [run.name for run in self.runs]
        for name in names:
            if names.count(name) > 1:
                raise SettingError("runs", f"a second run named '{name}'", "names must differ")
        files = [run.path for run in self.runs]
        if twice := next((run for run in self.runs if files.count(run.path) > 1 and run.path.name), None):
            what = f"several runs are of '{twice.path.name}'"
            raise SettingError("runs", what, "a run counts once; leave the others out")
        if self.probes != ProbeSettings() and all(run.recording for run in self.runs):
            raise SettingError("probes", "no run is a table", "a recording has those of its rig file")
        if all(run.role == HELD_OUT for run in self.runs):
            raise SettingError("runs", "every run is held out, none is trained", "leave out role: of some")

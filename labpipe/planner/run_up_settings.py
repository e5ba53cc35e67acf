"""The ``plan:`` section for run-ups: which loads, unbalances and speeds there could be, and what is wanted of the film."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.planner.criteria import CRITERIA, MINIMAX
from labpipe.records.settings import Settings, setting
from labpipe.registry import nearest
from labpipe.rigs.film_family import BOUND, COEFFICIENTS, PARAMETERS
from labpipe.rigs.run_up_rotor import RunUpRotor

RUN_UPS = "run-ups"
EXPONENTS = ("viscosity_speed", "viscosity_load")
SPEEDS = ("critical_speed", "threshold")


@dataclass(frozen=True)
class ReadingSettings(Settings):
    """Standard errors of the readings at one speed, from one dwell there."""

    amplitude: float = setting("value", "of the amplitude itself", unit="1", default=0.01)
    displacement: float = setting("value", "added to every reading, in squares", unit="m", default=0.0)
    phase: float = setting("value", "of the phase", unit="rad", default=float(np.deg2rad(1)))
    threshold: float = setting("value", "of the threshold speed itself", unit="1", default=0.002)

    def __post_init__(self) -> None:
        if min(self.amplitude, self.phase, self.threshold) <= 0 or self.displacement < 0:
            raise ConfigError("the noise of a reading is positive", hint="for example amplitude: 1 %")


@dataclass(frozen=True)
class TrialSettings(Settings):
    """One way to excite the rotor: a trial unbalance, or a shaker whose force does not turn."""

    unbalance: tuple[tuple[str, complex], ...] = setting("phasors", "by plane: {disc 1: 50 g.mm at 0 deg}", unit="kg.m", default=())
    shaker: str = setting("text", "plane on which a shaker acts, along x, instead", default="")
    force: float = setting("value", "of the shaker, 0-to-peak", unit="N", default=1.0)
    ratio: float = setting("value", "frequency of the shaker over that of the shaft", unit="1", default=0.95)

    def __post_init__(self) -> None:
        if bool(self.unbalance) == bool(self.shaker):
            raise ConfigError("a trial has an unbalance or a shaker", hint="unbalance: {disc 1: 50 g.mm at 0 deg}")
        if min(self.force, self.ratio) <= 0:
            raise ConfigError("force and ratio of a shaker are positive")

    @property
    def words(self) -> str:
        """The excitation in words."""
        if self.shaker:
            return f"shaker at {self.shaker}: {self.force:g} N in x, {self.ratio:g} of the speed"
        return "; ".join(f"{plane}: {1e6 * abs(size):.4g} g mm at {np.degrees(np.angle(size)):.4g} deg" for plane, size in self.unbalance)


@dataclass(frozen=True)
class RunUpPlanSettings(Settings):
    """Which run-ups there could be, how well they are read, and what they are to tell; *rig*: contents of `rotor`."""

    model: str = setting("choice", "what will be identified: the oil film over load and speed", choices=(RUN_UPS,))
    rotor: str = setting("file", "rotor file with pins", file_kind="run-up-rotor", into="rig")
    _: KW_ONLY
    loads: tuple[float, ...] = setting("values", "static loads that can be set", unit="N")
    speeds: tuple[float, float] = setting("band", "speeds that can be run", unit="Hz")
    step: float = setting("value", "from one speed of a run to the next", unit="Hz")
    dwell: float = setting("value", "time at one speed", unit="s")
    duration: float = setting("value", "of all runs together", unit="s")
    trials: tuple[tuple[str, TrialSettings], ...] = setting(
        "sections", "ways to excite the rotor, by name", section=TrialSettings, default=(), needed=True
    )
    stretches: int = setting("integer", "parts of the speeds that can be run by themselves", default=3)
    changeover: float = setting("value", "time between runs", unit="s", default=0.0)
    to_threshold: bool = setting("flag", "the highest stretch may be run on until the rotor gets unstable", default=False)
    displacement_limit: float | None = setting("value", "largest at a plane, 0-to-peak; default: none", unit="m", default=None)
    journal_limit: float | None = setting("value", "largest of the journal, 0-to-peak; default: none", unit="m", default=None)
    noise: ReadingSettings = setting("section", "of a reading", section=ReadingSettings, default=ReadingSettings())
    expected: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series", "factors on the rotor file's film, exponents of the viscosity; default: the rotor file", unit="1", default=()
    )
    earlier: str = setting("file", "identification.json whose joint fit is expected where `expected` has none", default="")
    known: tuple[str, ...] = setting("names", f"what is known: of {', '.join(PARAMETERS)}", default=())
    at_load: float | None = setting("value", "load at which speeds and coefficients are predicted", unit="N", default=None)
    at_speed: float | None = setting("value", "speed at which coefficients are predicted", unit="Hz", default=None)
    goal: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series",
        "relative standard errors that are wanted: {k_xy: 5 %, threshold: 1 %}; default: all parameters alike",
        unit="1",
        default=(),
    )
    criterion: str = setting("choice", "least largest error, sum of squares, or volume", choices=CRITERIA, default=MINIMAX)
    rig: RunUpRotor | None = None

    def __post_init__(self) -> None:
        self._check_signs()
        if len(self.omega) < 2 * max(self.stretches, 1):
            raise ConfigError(f"{len(self.omega)} speeds make no {self.stretches} stretches of two or more", field="stretches")
        if not self.trials:
            raise ConfigError("there is no way to excite the rotor", hint="{trial-1: {unbalance: {disc 1: 50 g.mm}}}", field="trials")
        for name in self.known:
            if name not in PARAMETERS:
                raise ConfigError(f"the film has no parameter {name}", hint=nearest(name, PARAMETERS), field="known")
        for name, values in self.expected:
            self._check_expected(name, values)
        self._check_goals()
        if self.rig is not None:
            self.rig.place.film("a plan of run-ups")
            for name, trial in self.trials:
                self._check_planes(self.rig, name, trial)

    def _check_signs(self) -> None:
        for name in ("step", "dwell", "duration", "at_load", "at_speed", "displacement_limit", "journal_limit"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ConfigError(f"'{name}' must be positive", field=name)
        if self.changeover < 0 or min(self.loads, default=0.0) <= 0:
            raise ConfigError("loads are positive, and so is the time between runs", field="loads")
        if self.speeds[0] <= 0 or self.stretches < 1:
            raise ConfigError("speeds begin above zero, and there is one stretch of them at least", field="speeds")

    def _check_expected(self, name: str, values: tuple[float, ...]) -> None:
        if name not in PARAMETERS:
            raise ConfigError(f"the film has no parameter {name}", hint=nearest(name, PARAMETERS), field="expected")
        if len(values) != 1 or (name not in EXPONENTS and values[0] <= 0):
            raise ConfigError(f"{name} is one factor above zero", hint=f"{name}: 0.9", field="expected")
        if abs(logarithm(name, values[0])) > BOUND[PARAMETERS.index(name)]:
            raise ConfigError(
                f"{name} of {values[0]:g} is beyond what a joint fit looks for", hint="change the rotor file", field="expected"
            )

    def _check_goals(self) -> None:
        names = (*PARAMETERS, *(SPEEDS if self.at_load else ()), *(COEFFICIENTS if self.at_load and self.at_speed else ()))
        for name, values in self.goal:
            if name not in names:
                hint = "at_load and at_speed say where" if name in (*SPEEDS, *COEFFICIENTS) else nearest(name, names)
                raise ConfigError(f"no {name} is predicted", hint=hint, field="goal")
            if name in self.known:
                raise ConfigError(f"{name} is known", hint="leave one of goal and known out", field="goal")
            if len(values) != 1 or values[0] <= 0:
                raise ConfigError(f"the goal of {name} is one positive relative error", hint=f"{name}: 2 %", field="goal")

    @staticmethod
    def _check_planes(rig: RunUpRotor, name: str, trial: TrialSettings) -> None:
        for plane in (*dict(trial.unbalance), *([trial.shaker] if trial.shaker else [])):
            if plane not in rig.plane_names:
                raise ConfigError(f"trial {name}: no plane '{plane}'", hint=nearest(plane, rig.plane_names), field="trials")

    @property
    def omega(self) -> FloatArray:
        """All speeds (n_speed,) [rad/s]."""
        low, high = self.speeds
        return np.asarray(2 * np.pi * np.linspace(low, high, max(round((high - low) / self.step), 0) + 1))

    def values(self, earlier: Mapping[str, float]) -> FloatArray:
        """Expected logarithms (12,) [-] of PARAMETERS; *earlier*: factors and exponents [1] where none is given."""
        given = dict(earlier) | {name: value for name, (value,) in self.expected}
        return np.array([logarithm(name, given.get(name, 0.0 if name in EXPONENTS else 1.0)) for name in PARAMETERS])


def logarithm(name: str, value: float) -> float:
    """The logarithm that stands for a factor; an exponent of the viscosity stands for itself."""
    return value if name in EXPONENTS else float(np.log(value))

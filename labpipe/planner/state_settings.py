"""The ``plan:`` section for a floating bearing at several loads and speeds: which states there could be, and what is wanted of them."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from labpipe.errors import ConfigError
from labpipe.planner.criteria import CRITERIA, MINIMAX
from labpipe.planner.model import AXES
from labpipe.planner.plan import FEWEST_PERIODS
from labpipe.planner.schemes import INTERLEAVED, TOGETHER
from labpipe.planner.settings import DensitySettings, NoiseSettings, PlanSettings
from labpipe.records.settings import Settings, setting

STATES = "bearing-states"
FLOATING = "dynamic-stiffness"
COEFFICIENTS = tuple(f"{letter}_{row}{column}" for letter in "kc" for row in AXES for column in AXES)


@dataclass(frozen=True)
class StatePlanSettings(Settings):
    """Which loads and speeds can be run, how a state is tested, and what the tests are to tell."""

    model: str = setting("choice", "what will be identified: a floating bearing over load and speed", choices=(STATES,))
    bearing: str = setting("file", "bearing file with `load` and `speed`; its y and z are the plan's x and y", file_kind="bearing")
    _: KW_ONLY
    loads: tuple[float, ...] = setting("values", "static loads that can be set", unit="N")
    speeds: tuple[float, ...] = setting("values", "speeds that can be run", unit="Hz")
    mass: float = setting("value", "mass of the stator", unit="kg")
    band: tuple[float, float] = setting("band", "frequencies that are excited, all alike", unit="Hz")
    period: float = setting("value", "length of one period; lines lie 1 / period apart", unit="s")
    sample_rate: float = setting("value", "of signals and recordings", unit="Hz")
    run: float = setting("value", "measured time of one run in one state", unit="s")
    duration: float = setting("value", "of all runs with what lies between them", unit="s")
    force_limit: float = setting("value", "largest force of a shaker, 0-to-peak", unit="N")
    displacement_limit: float | None = setting("value", "largest displacement in x or y, 0-to-peak; default: none", unit="m", default=None)
    changeover: float = setting("value", "time between runs", unit="s", default=0.0)
    noise: NoiseSettings | None = setting("section", "noise of the sensors per sample", section=NoiseSettings, default=None)
    noise_density: DensitySettings | None = setting("section", "or its density", section=DensitySettings, default=None)
    estimate: tuple[str, ...] = setting(
        "names", "numbers of the bearing file that all states have in common; default: none, every state by itself", default=()
    )
    goal: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series", "relative standard errors that are wanted: {k_xy: 2 %, clearance: 1 %}; default: all alike", unit="1", default=()
    )
    criterion: str = setting("choice", "least largest error, sum of squares, or volume", choices=CRITERIA, default=MINIMAX)
    scheme: str = setting("choice", "how both shakers run at once", choices=(INTERLEAVED, TOGETHER), default=INTERLEAVED)
    exclude: tuple[tuple[float, float], ...] = setting("bands", "frequencies that are not excited", unit="Hz", default=())
    mains: float | None = setting("value", "mains frequency, whose multiples are left out", unit="Hz", default=None)
    skip: int = setting("integer", "transient periods before the measured ones, in every run", default=1)

    def __post_init__(self) -> None:
        if min((*self.loads, *self.speeds), default=0.0) <= 0 or not (self.loads and self.speeds):
            raise ConfigError("loads and speeds are positive", field="loads")
        if self.changeover < 0 or self.duration <= 0:
            raise ConfigError("times are positive", field="duration")
        if self.periods < FEWEST_PERIODS:
            hint = f"a run of {FEWEST_PERIODS * self.period:g} s or more"
            raise ConfigError(f"{self.periods} periods in a run, the noise is known from {FEWEST_PERIODS}", hint=hint, field="run")
        for name, values in self.goal:
            if name not in (*COEFFICIENTS, *self.estimate):
                allowed = f"known: {', '.join((*COEFFICIENTS, *self.estimate))}"
                raise ConfigError(f"no {name} is predicted", hint=allowed, field="goal")
            if len(values) != 1 or values[0] <= 0:
                raise ConfigError(f"the goal of {name} is one positive relative error", hint=f"{name}: 2 %", field="goal")
        self.at(self.speeds[0])

    @property
    def periods(self) -> int:
        """Measured periods of a run."""
        return int(self.run / self.period + 0.5)

    @property
    def seconds(self) -> float:
        """Time that a run takes [s], transient periods and what lies between runs included."""
        return (self.periods + self.skip) * self.period + self.changeover

    def at(self, speed: float) -> PlanSettings:
        """The settings of the test of one state at a *speed* [Hz]; ConfigError as for any test."""
        names = ("mass", "band", "period", "sample_rate", "force_limit", "displacement_limit", "noise", "noise_density")
        return PlanSettings(
            FLOATING,
            **{name: getattr(self, name) for name in (*names, "scheme", "exclude", "mains", "skip")},
            duration=self.periods * self.period,
            expected=tuple((name, 1.0) for name in COEFFICIENTS),
            speed=speed,
        )

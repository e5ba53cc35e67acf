"""The ``plan:`` section for wear: at which speeds, loads and in which bands a worn rotor could be tested, and what is wanted."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from labpipe.bearings.journal_kind import Wear
from labpipe.errors import ConfigError
from labpipe.planner.criteria import CRITERIA, MINIMAX
from labpipe.records.settings import Settings, Uncertain, setting
from labpipe.rigs.rotor_rig import RotorRig, worn_place

WORN = "worn-bearing"
NUISANCES = {"viscosity": "Pa.s", "clearance": "m", "cavitation_pressure": "Pa", "beta": "s"}


@dataclass(frozen=True)
class WearNoise(Settings):
    """Standard deviations of the sensors' noise per sample, at the sampling rate of the plan."""

    displacement: float = setting("value", "of the displacement", unit="m", default=1e-6)
    force: float = setting("value", "of the force", unit="N", default=0.0)

    def __post_init__(self) -> None:
        if self.displacement <= 0 or self.force < 0:
            raise ConfigError("the noise of the displacement is positive", hint="for example displacement: 1 um")


@dataclass(frozen=True)
class WearGoal(Settings):
    """Standard errors that are wanted."""

    depth: float | None = setting("value", "of the depth", unit="m", default=None)
    angle: float | None = setting("value", "of the angle", unit="rad", default=None)

    def __post_init__(self) -> None:
        if any(value is not None and value <= 0 for value in (self.depth, self.angle)):
            raise ConfigError("a goal is a positive standard error", hint="for example {depth: 0.2 um, angle: 1 deg}")


@dataclass(frozen=True)
class WearPlanSettings(Settings):
    """Which tests there could be, how they are measured, and what they are to tell; *rig*: contents of `rotor`."""

    model: str = setting("choice", "what will be identified: depth and angle of wear", choices=(WORN,))
    rotor: str = setting("file", "rotor file", file_kind="rotor", into="rig")
    _: KW_ONLY
    expected: Wear = setting("section", "depth and angle that are expected", section=Wear)
    speeds: tuple[float, ...] = setting("values", "speeds that can be run", unit="Hz")
    duration: float = setting("value", "of all tests together", unit="s")
    sample_rate: float = setting("value", "of the recordings", unit="Hz")
    bands: tuple[tuple[float, float], ...] = setting("bands", "bands that can be excited, one at a time", unit="Hz")
    force: float = setting("value", "rms of the shaker's white force, in whatever band", unit="N")
    bearing: str = setting("text", "name of the worn bearing; default: the last one", default="")
    loads: tuple[float, ...] = setting(
        "values", "static forces on the shaft that can be set, up; default: as in the file", unit="N", default=()
    )
    load_node: int = setting("integer", "node of that static force; default: that of the shaker", default=0)
    run: float = setting("value", "length of one run, under a force in y and again in z", unit="s", default=60.0)
    changeover: float = setting("value", "time between tests", unit="s", default=0.0)
    block: float = setting("value", "block length of the responses", unit="s", default=4.0)
    noise: WearNoise = setting("section", "of the sensors, per sample", section=WearNoise, default=WearNoise())
    viscosity: Uncertain | None = setting("uncertain", "estimated along, e.g. 0.104 Pa.s +- 3 %", unit="Pa.s", default=None)
    clearance: Uncertain | None = setting("uncertain", "of all bearings, estimated along, e.g. 90 um +- 2 %", unit="m", default=None)
    cavitation_pressure: Uncertain | None = setting("uncertain", "estimated along, e.g. -0.1 bar +- 0.1 bar", unit="Pa", default=None)
    beta: Uncertain | None = setting("uncertain", "damping of the shaft, estimated along", unit="s", default=None)
    angle_limit: float = setting("value", "largest angle there could be, either way", unit="rad", default=np.pi / 9)
    goal: WearGoal = setting("section", "{depth: 0.2 um, angle: 1 deg}; default: both alike", section=WearGoal, default=WearGoal())
    criterion: str = setting("choice", "least largest error, sum of squares, or volume", choices=CRITERIA, default=MINIMAX)
    rig: RotorRig | None = None

    def __post_init__(self) -> None:
        for name in ("duration", "sample_rate", "force", "run", "block"):
            if getattr(self, name) <= 0:
                raise ConfigError(f"'{name}' must be positive", field=name)
        if min(self.speeds, default=0.0) <= 0:
            raise ConfigError("speeds are positive", field="speeds")
        if any(low <= 0 or 2 * high >= self.sample_rate for low, high in self.bands):
            raise ConfigError("bands lie between 0 and half the sampling rate", field="bands")
        if self.run < 2 * self.block or self.changeover < 0:
            raise ConfigError("a run holds two blocks or more, and no time between tests is negative", field="run")
        if self.expected.depth < 0 or abs(self.expected.angle) > self.angle_limit:
            raise ConfigError(
                "the expected wear is beyond its limits", hint="a depth of zero or more, within angle_limit", field="expected"
            )
        for name, given in self.nuisances.items():
            if not given.std_error > 0:
                raise ConfigError(f"{name} has no doubt", hint="90 um +- 2 %; what is certain belongs into the rotor file", field=name)
        self._check_rig()

    def _check_rig(self) -> None:
        if self.rig is not None:
            worn_place(self.rig, self.bearing)
            self.rig.rotor.check_node(self.node, "load_node")

    @property
    def node(self) -> int:
        """Node of the static force."""
        assert self.rig is not None
        return self.load_node or self.rig.force

    @property
    def nuisances(self) -> dict[str, Uncertain]:
        """What is estimated along, by name."""
        return {name: getattr(self, name) for name in NUISANCES if getattr(self, name) is not None}

    @property
    def static_forces(self) -> tuple[float, ...]:
        """The static forces that can be set [N]; those of the rotor file unless given."""
        assert self.rig is not None
        return self.loads or (sum(force for node, _, force in self.rig.loads if node == self.node),)

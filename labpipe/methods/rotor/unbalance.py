"""Response to unbalance over speed in forward and backward circles: settings, record, rules."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.methods.journal_bearing.kind import Wear
from labpipe.methods.rotor.response import forward_backward_motion, unbalance_response
from labpipe.methods.rotor.rig import RotorRig
from labpipe.records.settings import Settings, quantity, setting


@dataclass(frozen=True)
class PeakChange:
    """Changes of the largest radii [m] and of their speeds [Hz], with their sign, by one standard uncertainty
    of a *source*.
    """

    source: str
    forward_peak: float
    forward_speed: float
    backward_peak: float
    backward_speed: float


@dataclass(frozen=True)
class UnbalanceCase:
    """One state of the bearing: wear *depth* [m] at *angle* [rad]; radii [m] of the forward and the backward
    circle at every speed.

    changes: of the largest of them by the uncertainties of the bearings' numbers.
    """

    name: str
    depth: float
    angle: float
    forward: tuple[float, ...]
    backward: tuple[float, ...]
    changes: tuple[PeakChange, ...] = ()

    def error(self, name: str) -> float | None:
        """Standard uncertainty of a largest radius [m] or its speed [Hz] by all sources, such as
        `forward_peak`; None without any.
        """
        return math.sqrt(sum(getattr(change, name) ** 2 for change in self.changes)) if self.changes else None


@dataclass(frozen=True)
class UnbalanceRuns:
    """All cases of one rotor over the same *speed* [Hz]; *node*: of the displacements; *bearing*: the worn
    bearing.
    """

    rotor: str
    bearing: str
    node: int
    speed: tuple[float, ...]
    cases: tuple[UnbalanceCase, ...]

    def values(self, case: UnbalanceCase) -> dict[str, tuple[float, str]]:
        """The largest radii [m] of a case and their speeds [Hz], by name, each with its unit."""
        peaks = {}
        for name, radius in (("forward", case.forward), ("backward", case.backward)):
            largest = max(radius)
            peaks[f"{name}_peak"] = (largest, "m")
            peaks[f"{name}_speed"] = (self.speed[radius.index(largest)], "Hz")
        return peaks


MOST_SPEEDS = 2000
STEP_OF_SPEED = "step of the speeds"


@dataclass(frozen=True)
class UnbalanceSettings(Settings):
    """The ``unbalance:`` section of a pipeline; *rig*: contents of `rotor`."""

    rotor: str = setting(
        "file", "rotor file with its unbalances, relative to the pipeline file", file_kind="rotor", into="rig"
    )
    speeds: tuple[float, float] = setting("band", "range of speeds", unit="Hz")
    cases: tuple[tuple[str, Wear], ...] = setting(
        "sections",
        "states of wear by name, for example {healthy: {depth: 0 um}}",
        section=Wear,
        default=(),
        needed=True,
    )
    step: float = quantity("step of speed", "Hz", 0.5)
    bearing: str = setting("text", "name of the worn bearing; default: the last one", default="")
    rig: RotorRig | None = None

    def __post_init__(self) -> None:
        if not self.cases:
            raise ConfigError(
                "cases: are missing", hint="for example cases: {healthy: {depth: 0 um}}", field="cases"
            )
        if not 0 < self.speeds[0] < self.speeds[1]:
            raise ConfigError("'speeds' must rise from above zero", hint="for example speeds: 40-65 Hz")
        if not 0 < self.step <= self.speeds[1] - self.speeds[0]:
            raise ConfigError("'step' must be positive and no longer than the range of speeds")
        if (self.speeds[1] - self.speeds[0]) / self.step > MOST_SPEEDS:
            raise ConfigError(f"more than {MOST_SPEEDS} speeds", hint="take a longer step")
        if self.rig is None:
            return
        if not self.rig.unbalances:
            raise ConfigError(
                "the rotor has no unbalances", hint="add unbalances: to the rotor file", field="rotor"
            )
        for _, case in self.cases:
            self.rig.with_bearings(
                (self.rig.place(self.bearing).name,), wear_depth=case.depth, wear_angle=case.angle
            )

    @property
    def speed(self) -> FloatArray:
        """Every speed of the range (n_speed,) [Hz], the last one at most its end."""
        low, high = self.speeds
        return low + self.step * np.arange(int(np.floor((high - low) / self.step + 1e-9)) + 1)


def unbalance_runs(settings: UnbalanceSettings) -> UnbalanceRuns:
    """The response of every case at every speed, the films' coefficients those of that speed."""
    rig = settings.rig
    if rig is None:
        raise ConfigError("no rotor was read", hint="name it with unbalance.rotor")
    worn = rig.place(settings.bearing).name
    cases = []
    for name, case in settings.cases:
        worn_rig = rig.with_bearings((worn,), wear_depth=case.depth, wear_angle=case.angle)
        forward, backward = _radii(worn_rig, settings.speed).tolist()
        changes = [_changes(worn_rig, settings.speed, source.source) for source in worn_rig.sources]
        if changes:
            # A peak lies anywhere within half a step of its speed: limits of a rectangular distribution.
            within = settings.step / np.sqrt(12.0)
            changes.append(PeakChange(STEP_OF_SPEED, 0.0, within, 0.0, within))
        cases.append(
            UnbalanceCase(name, case.depth, case.angle, tuple(forward), tuple(backward), tuple(changes))
        )
    return UnbalanceRuns(rig.name, worn, rig.response, tuple(settings.speed.tolist()), tuple(cases))


def _radii(rig: RotorRig, speeds: FloatArray) -> FloatArray:
    """Radii (2, n_speed) [m] of the forward and the backward circle at *speeds* (n_speed,) [Hz]."""
    return np.abs([orbit(rig.at_speed(float(speed))) for speed in speeds]).T


def _changes(rig: RotorRig, speeds: FloatArray, source: str) -> PeakChange:
    """Half the difference of the peaks with the numbers of a *source* a standard uncertainty above and below
    (GUM 5.1.3, note 2).
    """
    above, below = (
        np.concatenate([_peak(speeds, radius) for radius in _radii(end, speeds)]) for end in rig.ends(source)
    )
    forward_peak, forward_speed, backward_peak, backward_speed = ((above - below) / 2).tolist()
    return PeakChange(source, forward_peak, forward_speed, backward_peak, backward_speed)


def _peak(speeds: FloatArray, radius: FloatArray) -> FloatArray:
    """Largest radius [m] and its speed [Hz], (2,), by a parabola through three speeds, which tells less than
    a step; an end as it is.
    """
    at = int(np.argmax(radius))
    if not 0 < at < radius.size - 1:
        return np.array([radius[at], speeds[at]])
    before, top, after = radius[at - 1 : at + 2]
    shift = 0.5 * (before - after) / (before - 2 * top + after)
    return np.array(
        [top - 0.25 * (before - after) * shift, speeds[at] + shift * (speeds[at + 1] - speeds[at])]
    )


def orbit(rig: RotorRig) -> ComplexArray:
    """Phasors of the forward and the backward circle (2,) [m], 0-to-peak, at the rig's response node and
    speed.
    """
    amounts: dict[int, complex] = {}
    for part in rig.unbalances:
        amounts[part.node] = amounts.get(part.node, 0j) + part.size * np.exp(1j * part.phase)
    outputs = rig.rotor.dofs(rig.response)
    motion = unbalance_response(rig.rotor, rig.supports(), np.array([rig.omega]), amounts, outputs)
    return forward_backward_motion(motion)[0]

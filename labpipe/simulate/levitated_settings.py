"""Settings of the virtual levitated rig: rotor, magnetic bearings, controller, injection, and what disturbs them."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting

KIND = "virtual-levitated-rig"
PLACES = ("output", "input")
AXES = {"x": ("x",), "xy": ("x", "y")}
ENDS = ("a", "b")
# Runs in which all axes are excited at once, and the one without excitation; others are named after their axis, as multisine-x.
RANDOM, SHAKER, REST, MULTISINE = "random", "shaker", "rest", "multisine"


@dataclass(frozen=True)
class BendingMode(Settings):
    """One free-free bending mode in either plane, of modal mass 1 kg: q'' + 2 zeta w_0 q' + w_0^2 q = sum of shape times force."""

    frequency: float = setting("value", "natural frequency w_0", unit="Hz")
    at_bearings: tuple[float, ...] = setting("values", "its shape at both bearings, for a modal mass of 1 kg", unit="1")
    at_sensors: tuple[float, ...] = setting("values", "its shape at both sensors", unit="1")
    damping_ratio: float = setting("value", "damping ratio of the mode", unit="1", default=0.003)
    at_unbalance: float = setting("value", "its shape at the unbalance", unit="1", default=0.0)

    def __post_init__(self) -> None:
        if not self.frequency > 0:
            raise ConfigError("the natural frequency is positive", field="frequency")
        for name in ("at_bearings", "at_sensors"):
            if len(getattr(self, name)) != len(ENDS):
                raise ConfigError(f"'{name}' needs a number for each of the two ends", field=name)


@dataclass(frozen=True)
class LongRotor(Settings):
    """A rotor on two bearings: its inertias, and places along the axis from the centre of gravity on."""

    inertia: float = setting("value", "transverse moment of inertia about the centre of gravity", unit="kg.m^2")
    bearings: tuple[float, ...] = setting("values", "places of the two bearings", unit="m")
    sensors: tuple[float, ...] = setting("values", "places of the two sensors, of either axis", unit="m")
    polar_inertia: float = setting("value", "polar moment of inertia", unit="kg.m^2", default=0.0)
    bending: BendingMode | None = setting("section", "a bending mode", section=BendingMode, default=None)

    def __post_init__(self) -> None:
        if not self.inertia > 0:
            raise ConfigError("the transverse moment of inertia is positive", field="inertia")
        for name in ("bearings", "sensors"):
            places = getattr(self, name)
            if len(places) != len(ENDS) or places[0] == places[1]:
                raise ConfigError(f"'{name}' needs two different places", field=name)


@dataclass(frozen=True)
class SampledPid(Settings):
    """i = -(P + I / s + D s / (1 + s T)) X y by the bilinear transform, sampled and held at *rate*, *delay* intervals late.

    y are the readings of all sensors, X mixes them: the unit matrix unless `mixing` is given.
    """

    proportional: float = setting("value", "P, current per displacement", unit="A/m")
    derivative: float = setting("value", "D, current per velocity", unit="A.s/m")
    integral: float = setting("value", "I, current per displacement and time", unit="A/(m.s)", default=0.0)
    derivative_time: float = setting("value", "time constant T of the differentiator", unit="s", default=2e-4)
    rate: float = setting("value", "sampling rate of the controller", unit="Hz", default=10e3)
    delay: int = setting("integer", "whole intervals from a reading to the output computed from it", default=1)
    mixing: tuple[tuple[float, ...], ...] | None = setting(
        "matrix", "X, from readings to axes of control (order of the axes)", unit="1", default=None
    )

    def __post_init__(self) -> None:
        if not (self.rate > 0 and self.derivative_time > 0):
            raise ConfigError("rate and derivative_time are positive")
        if self.delay < 0:
            raise ConfigError("'delay' must not be negative", field="delay")


@dataclass(frozen=True)
class Injection(Settings):
    """What is added in the loop, at the controller's output (a current) or input (a displacement); its rms is that of one axis."""

    rms: float = setting("value", "rms at the output [A]; at the input [m] it is this times `per_ampere`", unit="A", default=0.1)
    place: str = setting("choice", "where it is added", choices=PLACES, default="output")
    per_ampere: float = setting("value", "displacement added at the input for 1 A", unit="m/A", default=1e-4)
    band: tuple[float, float] = setting("band", "excited frequencies", unit="Hz", default=(5.0, 500.0))
    spacing: float = setting("value", "spacing of the lines of a multisine", unit="Hz", default=1.0)
    periods: int = setting("integer", "periods of a multisine recorded, all of them steady", default=20)
    duration: float = setting("value", "length of the other runs", unit="s", default=20.0)

    def __post_init__(self) -> None:
        for name in ("rms", "per_ampere", "spacing", "periods", "duration"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", field=name)


@dataclass(frozen=True)
class LevitatedNoise(Settings):
    """Standard deviations of what the rig adds to the recordings, of the part up to half the sampling rate of the recording."""

    displacement: float = setting("value", "position sensors; it is in the loop", unit="m", default=1e-7)
    current: float = setting("value", "measured currents", unit="A", default=1e-4)
    force: float = setting("value", "measured force of a shaker", unit="N", default=0.05)
    disturbance: float = setting("value", "random force on the rotor at every bearing and axis", unit="N", default=1.0)
    reference: float = setting("value", "recorded injection, of the unit in which it is recorded", unit="1", default=0.0)


@dataclass(frozen=True)
class LevitatedRig(Settings):
    """A rotor in magnetic bearings under a sampled controller: a mass on one bearing, or a `rotor` on two."""

    kind: str = setting("choice", "which virtual rig", choices=(KIND,))
    mass: float = setting("value", "mass of the rotor", unit="kg")
    control: SampledPid = setting("section", "the controller", section=SampledPid)
    _: KW_ONLY
    name: str = setting("text", "name of the rig", default="Virtual levitated rotor")
    axes: str = setting("choice", "directions", choices=tuple(AXES), default="x")
    rotor: LongRotor | None = setting("section", "rotor on two bearings; without it, a mass on one", section=LongRotor, default=None)
    force_per_current: float = setting("value", "k_i of one bearing", unit="N/A", default=80.0)
    negative_stiffness: float = setting("value", "pull of one bearing's bias field per displacement, -k_s", unit="N/m", default=2e5)
    damping: float = setting("value", "passive damping at every bearing", unit="N.s/m", default=0.0)
    cross_stiffness: float = setting("value", "k_xy = -k_yx at every bearing, as of a seal", unit="N/m", default=0.0)
    amplifier_bandwidth: float = setting("value", "-3 dB bandwidth of the current amplifiers", unit="Hz", default=2000.0)
    injection: Injection = setting("section", "what is added in the loop", section=Injection, default=Injection())
    shaker: float = setting("value", "rms force of a shaker at every bearing and axis (run shaker)", unit="N", default=10.0)
    speed: float = setting("value", "shaft speed", unit="Hz", default=0.0)
    unbalance: float = setting("value", "mass times eccentricity", unit="kg.m", default=0.0)
    unbalance_place: float = setting("value", "its place along the axis", unit="m", default=0.0)
    runout: tuple[float, ...] = setting("values", "amplitudes of 1x, 2x, ... that the sensors see", unit="m", default=())
    sample_rate: float = setting("value", "sampling rate of the recording: the controller's over a whole number", unit="Hz", default=2000.0)
    force_recorded: bool = setting("flag", "the currents are recorded as the forces k_i i", default=False)
    output_recorded: bool = setting("flag", "the controller's outputs, with what is added there, are recorded too (u_)", default=False)
    noise: LevitatedNoise = setting("section", "noise", section=LevitatedNoise, default=LevitatedNoise())

    def __post_init__(self) -> None:
        for name in ("mass", "force_per_current", "amplifier_bandwidth", "sample_rate", "shaker"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", field=name)
        if self.speed < 0:
            raise ConfigError("the shaft speed must not be negative", hint="it turns from x to y", field="speed")
        if self.axes == "x" and (self.cross_stiffness or (self.rotor is not None and self.rotor.polar_inertia)):
            raise ConfigError("cross-coupling and gyroscopic moments need both axes", hint="axes: xy", field="axes")
        _whole(self.control.rate / self.sample_rate, f"the recording's rate divides that of the controller, {self.control.rate:g} Hz")
        _whole(self.sample_rate / self.injection.spacing, "a period of the injection holds no whole number of samples")
        if not self.injection.band[1] < self.sample_rate / 2:
            raise ConfigError(f"the injection's band must lie below {self.sample_rate / 2:g} Hz", field="injection")
        n = len(self.labels)
        if self.control.mixing is not None and np.shape(self.control.mixing) != (n, n):
            raise ConfigError(f"control.mixing is not a {n} x {n} matrix", hint=f"its axes are {', '.join(self.labels)}", field="control")

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the controlled axes: x, y of one bearing, ax, ay, bx, by of two."""
        return AXES[self.axes] if self.rotor is None else tuple(end + axis for end in ENDS for axis in AXES[self.axes])

    @property
    def runs(self) -> tuple[str, ...]:
        """The names of all recordings that can be made."""
        single = (f"{kind}-{label}" for kind in (MULTISINE, RANDOM) for label in self.labels)
        return (RANDOM, *single, SHAKER, REST)

    @property
    def usual(self) -> tuple[str, ...]:
        """All axes at random, and a multisine on each."""
        return (RANDOM, *(f"{MULTISINE}-{label}" for label in self.labels))

    @property
    def decimation(self) -> int:
        """Steps of the controller per recorded sample."""
        return round(self.control.rate / self.sample_rate)


def _whole(number: float, what: str) -> None:
    if abs(number - round(number)) > 1e-9 * number or round(number) < 1:
        raise ConfigError(what, field="sample_rate")

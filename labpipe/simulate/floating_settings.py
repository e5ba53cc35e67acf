"""Settings of the virtual floating-stator rig: stator, shaft, shakers, probes, and the film in every condition."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from labpipe.bearings.journal_kind import JournalSettings
from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting

KIND = "virtual-floating-rig"
Matrix = tuple[tuple[float, ...], ...]
NONE: Matrix = ((0.0, 0.0), (0.0, 0.0))
# Way of excitation -> ends of the names of its recordings.
RUNS_OF = {"alternating": ("x", "y"), "hadamard": ("plus", "minus"), "zipper": ("zipper",), "random": ("random",)}
FILMS = ("given", "journal")


@dataclass(frozen=True)
class Relaxation(Settings):
    """G j w tau / (1 + j w tau) in either direction: damping that turns into stiffness."""

    stiffness: float = setting("value", "stiffness G that is added at high frequency", unit="N/m")
    time: float = setting("value", "relaxation time tau", unit="s")

    def __post_init__(self) -> None:
        if not self.time > 0:
            raise ConfigError("the relaxation time is positive", field="time")


@dataclass(frozen=True)
class Pad(Settings):
    """(R_0 + j w R_1) / (1 + 2 zeta j w / w_0 - (w / w_0)^2) in either direction: a pad with inertia, as of a tilting-pad bearing."""

    stiffness: float = setting("value", "R_0", unit="N/m")
    damping: float = setting("value", "R_1", unit="N.s/m")
    frequency: float = setting("value", "natural frequency of the pad, w_0", unit="Hz")
    damping_ratio: float = setting("value", "damping ratio of the pad", unit="1")

    def __post_init__(self) -> None:
        if not self.frequency > 0:
            raise ConfigError("the natural frequency of a pad is positive", field="frequency")


@dataclass(frozen=True)
class Condition(Settings):
    """A condition of the test: the film between stator and shaft, H = K + j w C - w^2 M and what is added to it."""

    speed: float = setting("value", "shaft speed", unit="Hz", default=0.0)
    load: float = setting("value", "static load on the bearing, downwards (-y)", unit="N", default=0.0)
    pressure: float = setting("value", "pressure drop or supply pressure, for the record", unit="Pa", default=0.0)
    film: str = setting("choice", "K and C as given here, or of the rig's journal bearing", choices=FILMS, default="given")
    stiffness: Matrix = setting("matrix", "K of the film (x, y)", unit="N/m", default=NONE)
    damping: Matrix = setting("matrix", "C of the film", unit="N.s/m", default=NONE)
    mass: Matrix = setting("matrix", "virtual mass M of the film", unit="kg", default=NONE)
    relaxation: Relaxation | None = setting("section", "relaxation, added in x and in y", section=Relaxation, default=None)
    pad: Pad | None = setting("section", "pad with inertia, added in x and in y", section=Pad, default=None)

    def __post_init__(self) -> None:
        _check_matrices(self, "stiffness", "damping", "mass")
        if self.speed < 0:
            raise ConfigError("the shaft speed must not be negative", hint="it turns from x to y", field="speed")
        if self.film == "journal" and not (self.speed > 0 and self.load > 0):
            raise ConfigError("a journal bearing needs a speed and a load", field="film")


@dataclass(frozen=True)
class FloatingNoise(Settings):
    """Standard deviations of the measuring noise of a sample, white up to half the sampling rate."""

    force: float = setting("value", "load cells", unit="N", default=2.0)
    displacement: float = setting("value", "relative probes", unit="m", default=2e-7)
    acceleration: float = setting("value", "accelerometers", unit="m/s^2", default=0.05)
    drive: float = setting("value", "recorded drives", unit="V", default=1e-4)

    def of(self, quantity: str) -> float:
        """Standard deviation of a channel of this quantity [SI]; zero for the tacho."""
        return {"force": self.force, "displacement": self.displacement, "acceleration": self.acceleration, "voltage": self.drive}.get(
            quantity, 0.0
        )


@dataclass(frozen=True)
class FloatingRig(Settings):
    """A stator on soft supports around a shaft on its own supports, pushed by two shakers; runs CONDITION-x, -y, -plus, -minus, ..."""

    kind: str = setting("choice", "which virtual rig", choices=(KIND,))
    stator_mass: float = setting("value", "mass of the stator with its housing", unit="kg")
    conditions: tuple[tuple[str, Condition], ...] = setting("sections", "conditions by name", section=Condition, default=(), needed=True)
    _: KW_ONLY
    name: str = setting("text", "name of the rig", default="Virtual floating stator")
    journal: JournalSettings | None = setting("section", "journal bearing between stator and shaft", section=JournalSettings, default=None)
    baseline_stiffness: Matrix = setting("matrix", "of hoses and soft supports on the stator", unit="N/m", default=NONE)
    baseline_damping: Matrix = setting("matrix", "of the same", unit="N.s/m", default=NONE)
    shaft_mass: float = setting("value", "mass that moves with the shaft", unit="kg", default=40.0)
    shaft_stiffness: Matrix = setting("matrix", "of the shaft's own supports", unit="N/m", default=((2.4e8, 0.0), (0.0, 2.4e8)))
    shaft_damping: Matrix = setting("matrix", "of the same", unit="N.s/m", default=((2e4, 0.0), (0.0, 2e4)))
    shaft_noise: float = setting("value", "rms of a random force on the shaft in x and in y, white in the band", unit="N", default=0.0)
    unbalance: float = setting("value", "mass times eccentricity of the shaft", unit="kg.m", default=0.0)
    runout: tuple[float, ...] = setting(
        "values", "amplitudes of 1x, 2x, ... that the probes see of the shaft's surface", unit="m", default=()
    )
    excitation: str = setting("choice", "recordings that are made unless they are named", choices=tuple(RUNS_OF), default="hadamard")
    force: float = setting("value", "rms force of one shaker", unit="N", default=2000.0)
    band: tuple[float, float] = setting("band", "excited frequencies", unit="Hz", default=(10.0, 100.0))
    spacing: float = setting("value", "spacing of the excited lines", unit="Hz", default=1.0)
    slope: float = setting("value", "power of frequency with which the amplitude of the lines goes, -1 for 1/f", unit="1", default=0.0)
    periods: int = setting("integer", "periods recorded, all of them steady", default=8)
    sample_rate: float = setting("value", "sampling rate", unit="Hz", default=2000.0)
    drives: bool = setting("flag", "the drives of the shakers, u_x and u_y, are recorded too", default=False)
    gain: float = setting("value", "force of a shaker over its drive", unit="N/V", default=1000.0)
    probe_delay: float = setting("value", "delay of the relative probes", unit="s", default=0.0)
    noise: FloatingNoise = setting("section", "measuring noise", section=FloatingNoise, default=FloatingNoise())

    def __post_init__(self) -> None:
        _check_matrices(self, "baseline_stiffness", "baseline_damping", "shaft_stiffness", "shaft_damping")
        for name in ("stator_mass", "shaft_mass", "force", "spacing", "periods", "sample_rate", "gain"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", field=name)
        if not self.conditions:
            raise ConfigError("conditions: are missing", hint="for example conditions: {dry: {}}", field="conditions")
        if self.journal is None and any(condition.film == "journal" for _, condition in self.conditions):
            raise ConfigError("a condition has the film of a journal bearing, the rig has no `journal`", field="conditions")
        if not self.band[1] < self.sample_rate / 2:
            raise ConfigError(f"band must lie below half the sampling rate, {self.sample_rate / 2:g} Hz", field="band")
        exact = self.sample_rate / self.spacing
        if abs(exact - round(exact)) > 1e-9 * exact:
            raise ConfigError(f"a period of {1 / self.spacing:g} s holds no whole number of samples", field="spacing")

    @property
    def runs(self) -> tuple[str, ...]:
        """The names of all recordings that can be made."""
        return tuple(f"{name}-{end}" for name, _ in self.conditions for ends in RUNS_OF.values() for end in ends)

    @property
    def usual(self) -> tuple[str, ...]:
        """The recordings of every condition under the rig's `excitation`."""
        return tuple(f"{name}-{end}" for name, _ in self.conditions for end in RUNS_OF[self.excitation])

    def condition(self, run: str) -> Condition:
        """The condition of a recording."""
        return dict(self.conditions)[run.rpartition("-")[0]]

    @property
    def n_sample(self) -> int:
        """Samples of a recording."""
        return self.periods * round(self.sample_rate / self.spacing)


def _check_matrices(owner: Settings, *names: str) -> None:
    for name in names:
        if np.shape(getattr(owner, name)) != (2, 2):
            raise ConfigError(f"{name} is not a 2 x 2 matrix", field=name)

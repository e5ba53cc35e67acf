"""A virtual mass on a spring and a damper on a table that shakes: motion of the mass, absolute or relative to the table."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.records.recording import Channel, Recording
from labpipe.records.settings import Settings, setting
from labpipe.signals.sweep import Sweep
from labpipe.simulate.one_mass import one_mass_truth
from labpipe.simulate.virtual_rigs import LoggedTable, Simulation, VirtualRigKind

KIND = "virtual-base-rig"
# What of the mass a run measures: its acceleration, or its displacement relative to the table.
RUNS = {"absolute": "acceleration", "relative": "displacement", "sweep": "acceleration"}
# A free decay is followed until this share of it is left.
DIED_OUT = 1e-12


@dataclass(frozen=True)
class BaseNoise(Settings):
    """Standard deviations of the measuring noise, white up to half the sampling rate."""

    base: float = setting("value", "accelerometer on the table", unit="m/s^2", default=0.005)
    acceleration: float = setting("value", "accelerometer on the mass", unit="m/s^2", default=0.1)
    displacement: float = setting("value", "probe between table and mass", unit="m", default=1e-6)


@dataclass(frozen=True)
class BaseRig(Settings):
    """m x'' = -k (x - b) - c (x' - b'), b the table's motion: white noise in two runs, a logarithmic sweep from rest in the third."""

    kind: str = setting("choice", "which virtual rig", choices=(KIND,))
    mass: float = setting("value", "mass that moves", unit="kg")
    stiffness: float = setting("value", "stiffness between table and mass", unit="N/m")
    damping: float = setting("value", "damping between table and mass", unit="N.s/m")
    _: KW_ONLY
    name: str = setting("text", "name of the rig", default="Virtual mass on a shaking table")
    acceleration: float = setting("value", "rms acceleration of the table", unit="m/s^2", default=5.0)
    band: tuple[float, float] = setting("band", "band in which the table shakes", unit="Hz", default=(10.0, 100.0))
    sample_rate: float = setting("value", "sampling rate", unit="Hz", default=512.0)
    duration: float = setting("value", "length of a run", unit="s", default=32.0)
    pause: float = setting("value", "pause after the sweep, part of its run", unit="s", default=4.0)
    noise: BaseNoise = setting("section", "measuring noise", section=BaseNoise, default=BaseNoise())

    def __post_init__(self) -> None:
        for name in ("mass", "stiffness", "damping", "acceleration", "sample_rate", "duration"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", field=name)
        if not 0 < self.band[0] < self.band[1] < self.sample_rate / 2:
            raise ConfigError(f"band must lie between 0 and {self.sample_rate / 2:g} Hz", field="band")
        if not 0 <= self.pause < self.duration:
            raise ConfigError("pause must lie between 0 and the length of a run", field="pause")


def relative_transmissibility(rig: BaseRig, frequency: FloatArray) -> ComplexArray:
    """w^2 m / (k + j w c - w^2 m) [1] at *frequency* (n,) [Hz], (n,); the absolute one is 1 more. Equation (sim-base)."""
    w = 2 * np.pi * frequency
    return np.asarray(w**2 * rig.mass / (rig.stiffness + 1j * w * rig.damping - w**2 * rig.mass))


def base_runs(rig: BaseRig, seed: int, names: Sequence[str] = tuple(RUNS)) -> tuple[Recording, ...]:
    """The named runs: acceleration *base* of the table and *mass* [m/s^2], or *gap* between them [m], with independent noise.

    White noise is periodic in the whole run and band-limited, so x = T b line by line is the exact steady state.
    """
    return tuple(_run(rig, name, np.random.default_rng([seed, zlib.crc32(name.encode())])) for name in names)


def _run(rig: BaseRig, name: str, rng: np.random.Generator) -> Recording:
    base = _swept(rig) if name == "sweep" else _white(rig, rng)
    relative = RUNS[name] == "displacement"
    response = _response(rig, base, relative, DIED_OUT if name == "sweep" else 1.0)
    levels = [rig.noise.base, rig.noise.displacement if relative else rig.noise.acceleration]
    channels = (
        Channel("base", "acceleration", "input", "z"),
        Channel("gap", "displacement", "output", "z") if relative else Channel("mass", "acceleration", "output", "z"),
    )
    samples = np.column_stack([base, response])
    return Recording(channels, samples + rng.standard_normal(samples.shape) * levels, rig.sample_rate, name)


def _white(rig: BaseRig, rng: np.random.Generator) -> FloatArray:
    """White acceleration of the rig's rms in its band, (n_sample,) [m/s^2]."""
    n_sample = round(rig.duration * rig.sample_rate)
    frequency = fft.rfftfreq(n_sample, 1 / rig.sample_rate)
    spectrum = fft.rfft(rng.standard_normal(n_sample))
    spectrum[(frequency < rig.band[0]) | (frequency > rig.band[1])] = 0.0
    white = fft.irfft(spectrum, n_sample)
    return np.asarray(white * (rig.acceleration / np.std(white)))


def _swept(rig: BaseRig) -> FloatArray:
    """A logarithmic sweep up with its pause, (n_sample,) [m/s^2]."""
    return Sweep(rig.band, rig.duration - rig.pause, rig.acceleration, "logarithmic", "up", rig.pause).samples(rig.sample_rate, 1)


def _response(rig: BaseRig, base: FloatArray, relative: bool, left: float) -> FloatArray:
    """Acceleration of the mass [m/s^2], or its displacement relative to the table [m], (n_sample,); *left*: share of a decay at the end.

    T_r / (j w)^2 = -m / (k + j w c - w^2 m) goes from the table's acceleration to the relative displacement, at 0 Hz too.
    """
    n_sample = fft.next_fast_len(base.size + int(-np.log(left) * 2 * rig.mass / rig.damping * rig.sample_rate), real=True)
    n_sample = n_sample if left < 1 else base.size
    frequency = fft.rfftfreq(n_sample, 1 / rig.sample_rate)
    w = 2 * np.pi * frequency
    gap = -rig.mass / (rig.stiffness + 1j * w * rig.damping - w**2 * rig.mass)
    factor = gap if relative else 1 + relative_transmissibility(rig, frequency)
    return np.asarray(fft.irfft(fft.rfft(base, n_sample) * factor, n_sample)[: base.size])


def truth(rig: BaseRig) -> dict[str, float]:
    """k, c, mass, f_n and zeta [SI, Hz]."""
    return one_mass_truth(rig.mass, rig.stiffness, rig.damping)


def _simulate(rig: BaseRig, seed: int, runs: Sequence[str]) -> Simulation:
    """One file per run, accelerations in steps of 1 mm/s^2 and displacement in steps of 100 nm."""
    files = {}
    for run in base_runs(rig, seed, runs):
        columns = {"base [mm/s^2]": np.rint(1e3 * run.samples[:, 0]).astype(np.int32)}
        if RUNS[run.name] == "displacement":
            columns["gap [nm]"] = 100 * np.rint(1e7 * run.samples[:, 1]).astype(np.int32)
        else:
            columns["mass [mm/s^2]"] = 10 * np.rint(1e2 * run.samples[:, 1]).astype(np.int32)
        files[run.name] = LoggedTable(columns, level=19)
    return Simulation(files, {"truth": truth(rig)})


def _at_level(rig: BaseRig, level: float) -> BaseRig:
    noise = rig.noise
    scaled = BaseNoise(base=level * noise.base, acceleration=level * noise.acceleration, displacement=level * noise.displacement)
    return replace(rig, noise=scaled)


BASE_RIG = VirtualRigKind(
    settings=BaseRig,
    runs=lambda _rig: tuple(RUNS),
    simulate=_simulate,
    parameters=lambda rig, _runs: truth(rig),
    noisy=_at_level,
    recordings=base_runs,
)

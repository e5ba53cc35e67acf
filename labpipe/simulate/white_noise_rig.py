"""A virtual rotor in an anisotropic support under a white-noise force, along x in one run and along y in the other."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.settings import Settings, setting
from labpipe.simulate.logged import force_and_displacements
from labpipe.simulate.virtual_rigs import Simulation, VirtualRigKind

KIND = "virtual-white-noise-rig"
RUNS = {"along-x": "x", "along-y": "y"}
AXES = ("x", "y")


@dataclass(frozen=True)
class SensorNoise(Settings):
    """Standard deviations of the measuring noise, white up to half the sampling rate."""

    displacement: float = setting("value", "displacement sensors", unit="m", default=5e-6)
    force: float = setting("value", "force transducer", unit="N", default=0.05)


@dataclass(frozen=True)
class WhiteNoiseRig(Settings):
    """m q'' + C q' + K q = f of the rotor's centre (x, y), with an unbalance that turns from x to y.

    Force, sampling and blocks are those of Mendes et al.; bending near 82 Hz as on their rig, unbalance as on Machado's.
    """

    kind: str = setting("choice", "which virtual rig", choices=(KIND,))
    stiffness: tuple[tuple[float, ...], ...] = setting("matrix", "stiffness matrix K (x, y)", unit="N/m")
    damping: tuple[tuple[float, ...], ...] = setting("matrix", "damping matrix C (x, y)", unit="N.s/m")
    mass: float = setting("value", "mass that moves with the rotor", unit="kg")
    _: KW_ONLY
    name: str = setting("text", "name of the rig", default="Virtual rotor under white noise")
    force: float = setting("value", "rms force of the shaker", unit="N", default=30.0)
    bandwidth: float = setting("value", "the force is white up to here", unit="Hz", default=400.0)
    sample_rate: float = setting("value", "sampling rate", unit="Hz", default=1024.0)
    blocks: int = setting("integer", "blocks recorded one after the other", default=100)
    block: float = setting("value", "length of one block", unit="s", default=5.0)
    speed: float = setting("value", "shaft speed", unit="Hz", default=50.0)
    unbalance: float = setting("value", "mass times eccentricity", unit="kg.m", default=5.5e-5)
    noise: SensorNoise = setting("section", "measuring noise", section=SensorNoise, default=SensorNoise())

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            if np.shape(getattr(self, name)) != (2, 2):
                raise ConfigError(f"{name} is not a 2 x 2 matrix")
        for name in ("mass", "force", "bandwidth", "sample_rate", "blocks", "block"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive")
        for name in ("speed", "bandwidth"):
            if not 0 <= getattr(self, name) < self.sample_rate / 2:
                raise ConfigError(f"{name} must lie below half the sampling rate, {self.sample_rate / 2:g} Hz")

    @property
    def n_sample(self) -> int:
        return self.blocks * round(self.block * self.sample_rate)


def receptance(rig: WhiteNoiseRig, frequency: FloatArray) -> ComplexArray:
    """(K + j w C - w^2 m)^-1 at *frequency* (n,) [Hz], (n, 2, 2) [m/N]. Equation (sim-mdof)."""
    w = 2 * np.pi * frequency[:, None, None]
    h: ComplexArray = np.linalg.inv(np.array(rig.stiffness) + 1j * w * np.array(rig.damping) - w**2 * rig.mass * np.eye(2))
    return h


def white_noise_runs(rig: WhiteNoiseRig, seed: int, names: Sequence[str] = tuple(RUNS)) -> tuple[Recording, ...]:
    """The named runs: force f, displacements x and y [SI]; with independent noise.

    The force is periodic in the whole run and band-limited, so x = H f line by line is the exact steady state, without aliasing.
    """
    return tuple(_run(rig, name, np.random.default_rng([seed, zlib.crc32(name.encode())])) for name in names)


def _run(rig: WhiteNoiseRig, name: str, rng: np.random.Generator) -> Recording:
    dof = RUNS[name]
    spectrum = _force_spectrum(rig, rng)
    h = receptance(rig, fft.rfftfreq(rig.n_sample, 1 / rig.sample_rate))[:, :, AXES.index(dof)]
    force = fft.irfft(spectrum, rig.n_sample)
    motion = fft.irfft(spectrum[:, None] * h, rig.n_sample, axis=0) + _unbalance_motion(rig, rng.uniform(0, 2 * np.pi))
    samples = np.column_stack([force, motion]) + rng.standard_normal((rig.n_sample, 3)) * [rig.noise.force, *[rig.noise.displacement] * 2]
    channels = (
        Channel("f", "force", "input", dof, AXIS_ANGLES[dof]),
        *(Channel(axis, "displacement", "output", axis, AXIS_ANGLES[axis]) for axis in AXES),
    )
    return Recording(channels, samples, rig.sample_rate, name)


def _force_spectrum(rig: WhiteNoiseRig, rng: np.random.Generator) -> ComplexArray:
    """DFT of a white force of the rig's rms and bandwidth, (n_sample // 2 + 1,) [N]."""
    spectrum: ComplexArray = fft.rfft(rng.standard_normal(rig.n_sample))
    spectrum[fft.rfftfreq(rig.n_sample, 1 / rig.sample_rate) > rig.bandwidth] = 0.0
    spectrum[0] = 0.0
    return spectrum * (rig.force / np.sqrt(2 * np.sum(np.abs(spectrum) ** 2)) * rig.n_sample)


def _unbalance_motion(rig: WhiteNoiseRig, phase: float) -> FloatArray:
    """Steady motion (n_sample, 2) [m] under u W^2 (cos, sin)(W t + phase)."""
    turning = rig.unbalance * (2 * np.pi * rig.speed) ** 2 * np.array([1, -1j])
    amplitude = receptance(rig, np.array([rig.speed]))[0] @ turning
    angle = 2 * np.pi * rig.speed * np.arange(rig.n_sample) / rig.sample_rate + phase
    return np.asarray((np.exp(1j * angle)[:, None] * amplitude).real)


def truth(rig: WhiteNoiseRig) -> dict[str, Any]:
    """k_xx ... c_yy, mass, speed and unbalance [SI, Hz], by name."""
    matrices = (("k", rig.stiffness), ("c", rig.damping))
    coefficients: dict[str, Any] = {f"{letter}_{AXES[r]}{AXES[c]}": m[r][c] for letter, m in matrices for r in range(2) for c in range(2)}
    return {"mass": rig.mass, **coefficients, "speed_hz": rig.speed, "unbalance": rig.unbalance}


def _simulate(rig: WhiteNoiseRig, seed: int, runs: Sequence[str]) -> Simulation:
    """One file per force direction."""
    files = {run.name: force_and_displacements(run) for run in white_noise_runs(rig, seed, runs)}
    return Simulation(files, {"truth": truth(rig)})


def _at_level(rig: WhiteNoiseRig, level: float) -> WhiteNoiseRig:
    noise = rig.noise
    return replace(rig, noise=replace(noise, displacement=level * noise.displacement, force=level * noise.force))


WHITE_NOISE_RIG = VirtualRigKind(
    settings=WhiteNoiseRig,
    runs=lambda _rig: tuple(RUNS),
    simulate=_simulate,
    parameters=lambda rig, _runs: truth(rig),
    noisy=_at_level,
    recordings=white_noise_runs,
)

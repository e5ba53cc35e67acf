"""A virtual mass on a spring and a damper, driven by a shaker through swept sines: one linear sweep, and logarithmic ones up and down."""

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

KIND = "virtual-sweep-rig"
# Law, direction and number of the sweeps of a run.
RUNS = {"linear": ("linear", "up", 1), "logarithmic": ("logarithmic", "up-down", 4)}
# The logger begins this long before the first sweep [s].
PRETRIGGER = 0.5
# A free decay is followed until this share of it is left.
DIED_OUT = 1e-12


@dataclass(frozen=True)
class SweepRig(Settings):
    """m y'' + c y' + k y = f from rest; f a sweep with constant amplitude, then a pause; white noise on force and probe."""

    kind: str = setting("choice", "which virtual rig", choices=(KIND,))
    mass: float = setting("value", "mass that moves", unit="kg")
    stiffness: float = setting("value", "stiffness of its support", unit="N/m")
    damping: float = setting("value", "damping of its support", unit="N.s/m")
    _: KW_ONLY
    name: str = setting("text", "name of the rig", default="Virtual mass under swept sines")
    band: tuple[float, float] = setting("band", "band that is swept", unit="Hz", default=(20.0, 80.0))
    force: float = setting("value", "rms force while a sweep runs", unit="N", default=5.0)
    duration: float = setting("value", "length of the linear sweep; the others take half as long", unit="s", default=24.0)
    pause: float = setting("value", "pause after every sweep", unit="s", default=3.0)
    noise: float = setting("value", "standard deviation of the probe's noise", unit="m", default=1e-6)
    force_noise: float = setting("value", "standard deviation of the force transducer's noise", unit="N", default=0.02)
    sample_rate: float = setting("value", "sampling rate", unit="Hz", default=512.0)

    def __post_init__(self) -> None:
        for name in ("mass", "stiffness", "damping", "force", "duration", "sample_rate"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", field=name)
        for name in ("pause", "noise", "force_noise"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must not be negative", field=name)
        if not 0 < self.band[0] < self.band[1] < self.sample_rate / 2:
            raise ConfigError(f"band must lie between 0 and {self.sample_rate / 2:g} Hz", field="band")


def receptance(rig: SweepRig, frequency: FloatArray) -> ComplexArray:
    """1 / (k + j w c - w^2 m) [m/N] at *frequency* (n,) [Hz], (n,)."""
    w = 2 * np.pi * frequency
    return np.asarray(1 / (rig.stiffness + 1j * w * rig.damping - w**2 * rig.mass))


def sweep_runs(rig: SweepRig, seed: int, names: Sequence[str] = tuple(RUNS)) -> tuple[Recording, ...]:
    """The named runs: force f [N] and displacement y [m] with noise."""
    return tuple(_run(rig, name, np.random.default_rng([seed, zlib.crc32(name.encode())])) for name in names)


def _run(rig: SweepRig, name: str, rng: np.random.Generator) -> Recording:
    law, direction, count = RUNS[name]
    sweep = Sweep(rig.band, rig.duration / (1 if count == 1 else 2), rig.force, law, direction, rig.pause)
    force = np.concatenate([np.zeros(round(PRETRIGGER * rig.sample_rate)), sweep.samples(rig.sample_rate, count)])
    samples = np.column_stack([force, motion(rig, force)])
    samples = samples + rng.standard_normal(samples.shape) * [rig.force_noise, rig.noise]
    channels = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))
    return Recording(channels, samples, rig.sample_rate, name)


def motion(rig: SweepRig, force: FloatArray) -> FloatArray:
    """Displacement (n_sample,) [m] from rest under a band-limited *force* (n_sample,) [N].

    The product with H line by line, over a time after which what comes round has died out. Equation (sim-sweep).
    """
    decay = -np.log(DIED_OUT) * 2 * rig.mass / rig.damping
    n_sample = fft.next_fast_len(force.size + int(decay * rig.sample_rate), real=True)
    spectrum = fft.rfft(force, n_sample) * receptance(rig, fft.rfftfreq(n_sample, 1 / rig.sample_rate))
    return np.asarray(fft.irfft(spectrum, n_sample)[: force.size])


def truth(rig: SweepRig) -> dict[str, float]:
    """k, c, mass, f_n and zeta [SI, Hz]."""
    return one_mass_truth(rig.mass, rig.stiffness, rig.damping)


def _simulate(rig: SweepRig, seed: int, runs: Sequence[str]) -> Simulation:
    """One file per run, force in steps of 10 mN and displacement in steps of 100 nm."""
    files = {}
    for run in sweep_runs(rig, seed, runs):
        force, y = (np.rint(column).astype(np.int32) for column in (1e2 * run.samples[:, 0], 1e7 * run.samples[:, 1]))
        files[run.name] = LoggedTable({"f [mN]": 10 * force, "y [nm]": 100 * y}, level=19)
    return Simulation(files, {"truth": truth(rig)})


SWEEP_RIG = VirtualRigKind(
    settings=SweepRig,
    runs=lambda _rig: tuple(RUNS),
    simulate=_simulate,
    parameters=lambda rig, _runs: truth(rig),
    noisy=lambda rig, level: replace(rig, noise=level * rig.noise, force_noise=level * rig.force_noise),
    recordings=sweep_runs,
)

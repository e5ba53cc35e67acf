"""A virtual rig: one mass on a spring and a damper under a multisine, recorded as force and displacement with
noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.errors import ConfigError
from labpipe.raw_files.excitation import design_multisine
from labpipe.records.recording import Channel, Recording
from labpipe.records.settings import Settings, setting
from labpipe.simulate.virtual_rigs import LoggedTable, Simulation, VirtualRigKind

KIND, RUN = "virtual-sdof-rig", "multisine"
CHANNELS = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))


@dataclass(frozen=True, kw_only=True)
class VirtualSdofRig(Settings):
    """What a file of this rig holds.

    *force_noise* and *displacement_noise* are standard deviations of a sample.
    """

    kind: str = setting("choice", "which virtual rig", choices=(KIND,))
    name: str = setting("text", "name of the rig", default="Virtual rig of one mass")
    mass: float = setting("value", "mass", unit="kg")
    stiffness: float = setting("value", "stiffness of the spring", unit="N/m")
    damping: float = setting("value", "damping of the damper", unit="N.s/m")
    band: tuple[float, float] = setting("band", "lines of the multisine", unit="Hz", default=(1.0, 100.0))
    spacing: float = setting("value", "distance of the lines, one over the period", unit="Hz", default=0.5)
    level: float = setting("value", "rms of the force", unit="N", default=0.3)
    sample_rate: float = setting("value", "sampling rate", unit="Hz", default=1000.0)
    periods: int = setting("integer", "periods recorded, all of them in the steady state", default=5)
    force_noise: float = setting("value", "noise of the force", unit="N", default=1e-3)
    displacement_noise: float = setting("value", "noise of the displacement", unit="m", default=1e-7)

    def __post_init__(self) -> None:
        if min(self.mass, self.stiffness, self.damping) <= 0:
            raise ConfigError("mass, stiffness and damping must be positive")
        if self.periods < 2:
            raise ConfigError(
                "'periods' must be at least 2", hint="the noise is what differs between periods"
            )


def recordings(rig: VirtualSdofRig, seed: int, runs: Sequence[str]) -> list[Recording]:
    """Force [N] and displacement [m] in the steady state, exact line by line: X = F / (k - w^2 m + j w c)."""
    rng = np.random.default_rng(seed)
    made = []
    for name in runs:
        force = design_multisine(rig.band, rig.spacing, rig.level).samples(rig.sample_rate, 1)
        omega = 2 * np.pi * np.fft.rfftfreq(force.size, 1 / rig.sample_rate)
        receptance = 1 / (rig.stiffness - omega**2 * rig.mass + 1j * omega * rig.damping)
        displacement = np.fft.irfft(np.fft.rfft(force) * receptance, force.size)
        samples = np.tile(np.stack([force, displacement], axis=1), (rig.periods, 1))
        noise = rng.standard_normal(samples.shape) * [rig.force_noise, rig.displacement_noise]
        made.append(Recording(CHANNELS, samples + noise, rig.sample_rate, name))
    return made


def parameters(rig: VirtualSdofRig, _runs: Sequence[str] = ()) -> dict[str, float]:
    """What a fit should give [SI units]."""
    omega = float(np.sqrt(rig.stiffness / rig.mass))
    zeta = rig.damping / (2 * rig.mass * omega)
    return {"k": rig.stiffness, "c": rig.damping, "m": rig.mass, "f_n": omega / (2 * np.pi), "zeta": zeta}


def simulate(rig: VirtualSdofRig, seed: int, runs: Sequence[str]) -> Simulation:
    """One file for each run, and the truth."""
    files = {run.name: _logged(run) for run in recordings(rig, seed, runs)}
    return Simulation(files, {"truth": parameters(rig)})


def _logged(run: Recording) -> LoggedTable:
    """As a logger writes it: time, force in N, displacement in um."""
    time = np.arange(run.n_sample) / run.sample_rate
    force, displacement = run.samples.T
    return LoggedTable({"t [s]": time, "force [N]": force, "y [um]": 1e6 * displacement}, text=True)


def at_level(rig: VirtualSdofRig, level: float) -> VirtualSdofRig:
    """The rig with *level* times its noise."""
    return replace(
        rig, force_noise=level * rig.force_noise, displacement_noise=level * rig.displacement_noise
    )


SDOF_RIG = VirtualRigKind(
    settings=VirtualSdofRig,
    runs=lambda _rig: (RUN,),
    simulate=simulate,
    parameters=parameters,
    noisy=at_level,
    recordings=recordings,
)

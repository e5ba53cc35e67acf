"""A virtual mass on springs that is struck and left to itself: free decays of one mode, of two close modes,
and with a joint that slips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import SettingError
from labpipe.records.recording import Channel, Recording
from labpipe.records.settings import Settings, choice, integer, quantity, setting, text
from labpipe.simulate.virtual_rigs import Simulation, VirtualRigKind, generator, whole_numbers

KIND = "virtual-decay-rig"
RUNS = ("struck", "beating", "joint")
PRETRIGGER = 0.2


@dataclass(frozen=True)
class DecayRig(Settings):
    """y = offset + sum of decaying oscillations after every hit, each hit weaker than the one before; white
    noise on the probe. The run *joint* has the first mode alone, with A' = -w (zeta + joint A / amplitude) A.
    """

    kind: str = choice("which virtual rig", (KIND,))
    frequencies: tuple[float, ...] = setting(
        "values", "natural frequencies; the runs struck and joint have the first alone", "Hz"
    )
    damping_ratios: tuple[float, ...] = setting("values", "damping ratio of every mode", "1")
    _: KW_ONLY
    name: str = text("name of the rig", "Virtual mass on springs, struck")
    mass: float = quantity("mass that moves", "kg", 2.0)
    amplitude: float = quantity("amplitude of every mode after the first hit", "m", 1e-4)
    joint: float = quantity("damping ratio that the joint adds at that amplitude", "1", 0.003)
    hits: int = integer("hits in a run", 3)
    interval: float = quantity("time from hit to hit", "s", 4.0)
    weaker: float = quantity("amplitude of a hit over that of the one before", "1", 0.8)
    offset: float = quantity("offset of the probe", "m", 2e-5)
    noise: float = quantity("standard deviation of the probe's noise", "m", 1e-6)
    sample_rate: float = quantity("sampling rate", "Hz", 1024.0)

    def __post_init__(self) -> None:
        if len(self.frequencies) != len(self.damping_ratios):
            raise SettingError("damping_ratios", "'damping_ratios' needs one value for every frequency")
        self.require_positive("mass", "amplitude", "hits", "interval", "weaker", "sample_rate")
        self.require_not_negative("joint", "noise")
        if self.interval * self.sample_rate < 2:
            raise SettingError("interval", "'interval' is shorter than two samples", "interval: 4 s")
        lowest, highest = 1 / self.interval, self.sample_rate / 2
        if not all(lowest <= frequency < highest for frequency in self.frequencies):
            what = f"frequencies must lie between {lowest:g} Hz, a period after a hit, and {highest:g} Hz"
            raise SettingError("frequencies", what)
        self.require_share("damping_ratios", or_none=True)


def decay_runs(rig: DecayRig, seed: int, names: Sequence[str] = RUNS) -> tuple[Recording, ...]:
    """The named runs: displacement y [m] with noise."""
    return tuple(_run(rig, name, generator(seed, name)) for name in names)


def _run(rig: DecayRig, name: str, rng: np.random.Generator) -> Recording:
    time = np.arange(round(rig.interval * rig.sample_rate)) / rig.sample_rate
    quiet = np.zeros(round(PRETRIGGER * rig.sample_rate))
    motions = [
        rig.amplitude * rig.weaker**hit * motion(rig, name, time, rig.weaker**hit) for hit in range(rig.hits)
    ]
    samples = np.concatenate([quiet, *motions]) + rig.offset
    samples = samples + rig.noise * rng.standard_normal(samples.size)
    return Recording((Channel("y", "displacement", "output", "y"),), samples[:, None], rig.sample_rate, name)


def motion(rig: DecayRig, name: str, time: FloatArray, strength: float) -> FloatArray:
    """The motion (n_sample,) over its first amplitude [1] at *time* (n_sample,) [s] after a hit of relative
    *strength*. Equation (sim-decay).
    """
    if name == "joint":
        return _slipping(rig, time, strength)
    modes = 1 if name == "struck" else len(rig.frequencies)
    total = np.zeros(time.size)
    for frequency, ratio in zip(rig.frequencies[:modes], rig.damping_ratios[:modes], strict=True):
        omega = 2 * np.pi * frequency
        total += np.exp(-ratio * omega * time) * np.sin(omega * np.sqrt(1 - ratio**2) * time)
    return total


def _slipping(rig: DecayRig, time: FloatArray, strength: float) -> FloatArray:
    """A' = -w (z0 + z1 A) A in closed form: A = z0 A0 E / (z0 + z1 A0 (1 - E)), E = exp(-z0 w t),
    for z0 > 0.
    """
    omega, rest = 2 * np.pi * rig.frequencies[0], max(rig.damping_ratios[0], 1e-9)
    decay = np.exp(-rest * omega * time)
    return rest * decay / (rest + rig.joint * strength * (1 - decay)) * np.sin(omega * time)


def truth(rig: DecayRig, names: Sequence[str] = RUNS) -> dict[str, float]:
    modes = len(rig.frequencies) if "beating" in names else 1
    entries: dict[str, float] = {}
    for n, frequency, ratio in zip(range(1, modes + 1), rig.frequencies, rig.damping_ratios, strict=False):
        entries |= {f"f_n_{n}": frequency, f"zeta_{n}": ratio}
        entries[f"log_decrement_{n}"] = 2 * np.pi * ratio / float(np.sqrt(1 - ratio**2))
    omega = 2 * np.pi * rig.frequencies[0]
    entries |= {"mass": rig.mass, "k": rig.mass * omega**2, "c": 2 * rig.damping_ratios[0] * rig.mass * omega}
    if "joint" in names:
        entries |= {"zeta_rest_1": rig.damping_ratios[0], "zeta_slope_1": rig.joint / rig.amplitude}
    return entries


def _simulate(rig: DecayRig, seed: int, runs: Sequence[str]) -> Simulation:
    files = {run.name: whole_numbers(run, steps={"y": 10}) for run in decay_runs(rig, seed, runs)}
    return Simulation(files, {"truth": {name: truth(rig, [name]) for name in runs}})


DECAY_RIG = VirtualRigKind(
    settings=DecayRig,
    runs=lambda _rig: RUNS,
    simulate=_simulate,
    parameters=truth,
    noisy=lambda rig, level: replace(rig, noise=level * rig.noise),
    recordings=decay_runs,
)

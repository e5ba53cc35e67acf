"""A magnetic-bearing loop cut open: controller, and motion and current per command, in continuous time or sampled with its hold."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_loop import ControlLoop, chain_factors, controller_terms
from labpipe.bearings.magnetic_stability import Levitated
from labpipe.bearings.sampled_loop import SampledLaw, Suspended, sampled_law, sampled_plant

# Signals of a loop that an injection e moves; the units are per volt at either place.
SIGNALS = ("before", "after", "output", "displacement", "current")
INPUT, OUTPUT = "input", "output"
# Distance of z from a pole of the controller below which it is there.
AT_A_POLE = 1e-12


@dataclass(frozen=True)
class OpenLoop:
    """Controller C [1] with the probe's sensitivity k [V/m], motion X [m/V] and current I [A/V] per command, (n_line,) each.

    L = -k X C is the loop, S = 1 / (1 + L); the force on the rotor is -k_i i, so that X has a minus sign. recorded_motion: what a logger
    with a filter sees of X, None where it is X.
    """

    sensor: float
    controller: ComplexArray
    motion: ComplexArray
    current: ComplexArray
    recorded_motion: ComplexArray | None = None

    @property
    def loop(self) -> ComplexArray:
        """L (n_line,) [1]."""
        # Of an integrator at rest no number, though L is infinite.
        with np.errstate(invalid="ignore"):
            return -self.sensor * self.motion * self.controller

    @property
    def sensitivity(self) -> ComplexArray:
        """S = 1 / (1 + L) (n_line,) [1]."""
        return np.asarray(1 / (1 + self.loop))

    def signals(self, place: str) -> dict[str, ComplexArray]:
        """SIGNALS per injection (n_line,) [V/V, m/V, A/V], added ahead of the controller (input) or behind it (output).

        before and after are the two sides of the sum where it is added; output is the command behind it.
        """
        s = self.sensitivity
        command = self.controller * s if place == INPUT else s
        motion = self.motion if self.recorded_motion is None else self.recorded_motion
        sides = {"before": s - 1, "after": s}
        return {**sides, "output": command, "displacement": motion * command, "current": self.current * command}


def open_loop(plant: Levitated, omega: FloatArray, rate: float | None = None, filtered: bool = False) -> OpenLoop:
    """The loop at *omega* [rad/s] (n_line,), sampled and held at *rate* [Hz]; without one in continuous time, the hold as delay.

    *filtered*: current and motion are recorded through a filter against aliasing, not as the controller samples them. ConfigError for
    what cannot be sampled.
    """
    loop = plant.loop
    if rate is None:
        chain = chain_factors(loop, omega)
        current: ComplexArray = loop.amplifier * chain["delay"] * chain["amplifier"]
        motion = -loop.force_per_current * current / (-plant.mass * omega**2 - plant.negative_stiffness)
        law = np.asarray(np.sum(list(controller_terms(loop, omega).values()), axis=0))
        return OpenLoop(loop.sensor, law.astype(np.complex128), motion * chain.get("sensor", 1.0), current)
    motion, current = _sampled_motion(Suspended(loop, plant.negative_stiffness, plant.mass), omega, rate)
    law_at = law_response(_own_law(loop, rate), omega, rate)
    if not filtered:
        return OpenLoop(loop.sensor, law_at, motion, current)
    # The delay holds half an interval for the hold already.
    delayed = (
        loop.amplifier * chain_factors(loop, omega)["amplifier"] * np.exp(-1j * omega * loop.delay) * np.sinc(omega / (2 * np.pi * rate))
    )
    moved = -loop.force_per_current * delayed / (-plant.mass * omega**2 - plant.negative_stiffness)
    return OpenLoop(loop.sensor, law_at, motion, delayed, moved * chain_factors(loop, omega).get("sensor", 1.0))


@lru_cache(maxsize=16)
def _own_law(loop: ControlLoop, rate: float) -> SampledLaw:
    return sampled_law(loop, rate, loop.blocks())


def law_response(law: SampledLaw, omega: FloatArray, rate: float) -> ComplexArray:
    """C(z) (n_line,) [1] of a sampled controller at omega (n_line,) [rad/s]; infinite at a pole, as of an integrator at rest."""
    if not len(law.a):
        return np.full(np.shape(omega), law.d, np.complex128)
    z = np.exp(1j * np.asarray(omega) / rate)
    values = np.full(z.shape, np.inf, np.complex128)
    away = np.min(np.abs(z[:, None] - np.linalg.eigvals(law.a)), axis=1) > AT_A_POLE
    shifted = z[away, None, None] * np.eye(len(law.a)) - law.a
    states = np.linalg.solve(shifted, np.broadcast_to(law.b[:, None], (len(shifted), len(law.b), 1)))
    values[away] = law.c @ states[..., 0].T + law.d
    return values


def _sampled_motion(plant: Suspended, omega: FloatArray, rate: float) -> tuple[ComplexArray, ComplexArray]:
    """Reading of the probe and current per command, with computing delay and hold."""
    motion, whole = sampled_plant(plant, rate)
    z = np.exp(1j * np.asarray(omega) / rate)
    late = motion.hold[:, 0] * z[:, None] ** (-whole - 1.0) + motion.hold[:, 1] * z[:, None] ** (-float(whole))
    n = motion.step.shape[0]
    states = np.linalg.solve(z[:, None, None] * np.eye(n) - motion.step, late[..., None])[..., 0]
    return states[:, 3 if n == 4 else 0], states[:, 2]

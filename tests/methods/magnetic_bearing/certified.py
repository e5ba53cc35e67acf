"""Recorded loops written down anew: both sides of the sum, motion and current under an injection, with noise
that all share in part.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.methods.magnetic_bearing.bearing import MagneticFile
from labpipe.methods.magnetic_bearing.loop import ControlLoop
from labpipe.methods.magnetic_bearing.sampled_loop import SampledLoop, Suspended, sampled_loop, straight
from labpipe.records.response import FrequencyResponse, Port

RATE = 20e3
FREQUENCY = np.arange(10.0, 1000.0, 5.0)
# Zone A, log decrement near 2: a loop as they are accepted.
LOOP = ControlLoop(proportional=1.6, derivative=1.2e-3)
FILE = MagneticFile(
    kind="magnetic-bearing", mass=0.065, frequency=50.0, negative_stiffness=33106.0, loop=LOOP
)
UNKNOWNS = ("negative_stiffness", "force_per_current", "bandwidth", "delay")
MIXED = np.array([[1.0, 0.0, 0.0, 0.0], [0.8, 0.6, 0.0, 0.0], [0.3, 0.1, 0.9, 0.0], [0.2, 0.0, 0.3, 0.8]])


def loop_response(loop: SampledLoop, omega: np.ndarray) -> np.ndarray:
    """z over force (as `straight` feeds it), noise and injection at omega [rad/s], (n_line, 5, 3)."""
    z = np.exp(1j * omega / loop.rate)[:, None, None]
    whole = loop.c @ np.linalg.inv(z * np.eye(loop.a.shape[0]) - loop.a) @ loop.b + loop.d
    force = (whole[:, :, :1] + z * whole[:, :, 1:2]) / straight(omega, loop.rate)[:, None, None]
    return np.concatenate([force, whole[:, :, 2:]], axis=2)


def clean(file: MagneticFile = FILE) -> np.ndarray:
    """before, after, displacement, current over the injection (n_line, 4), by the matrices that run in
    time.
    """
    plant = file.suspension()
    loop = sampled_loop(Suspended(plant.loop, plant.negative_stiffness, plant.mass), RATE)
    signals = loop_response(loop, 2 * np.pi * FREQUENCY)
    return signals[:, [1, 2, 0, 4], 2]


def response(
    rng: np.random.Generator | None, noise: float = 0.02, file: MagneticFile = FILE, periods: int = 0
) -> FrequencyResponse:
    """Noise as a share of the r.m.s. of every signal; of a known covariance, or that of so many periods."""
    true = clean(file)
    scale = noise * np.sqrt(np.mean(np.abs(true) ** 2, axis=0))[:, None] * MIXED
    covariance = np.broadcast_to((scale @ scale.T).astype(complex), (len(true), 4, 4))
    ports = tuple(Port(name, name, name) for name in ("before", "after", "x", "i"))
    dof, matrix = float("inf"), true
    if rng is not None and periods:
        draws = true + drawn(rng, (periods, *true.shape)) @ scale.T * np.sqrt(periods)
        matrix, dof = draws.mean(axis=0), periods - 1.0
        rest = draws - matrix
        covariance = np.einsum("plc,pld->lcd", rest, rest.conj()) / (periods * (periods - 1))
    elif rng is not None:
        matrix = true + drawn(rng, true.shape) @ scale.T
    return FrequencyResponse(
        FREQUENCY,
        matrix[:, :, None],
        ports,
        (Port("e", "e", "e"),),
        form="other",
        covariance=covariance,
        covariance_dof=dof,
    )


def drawn(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Circular complex noise of unit variance."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def with_gain(file: MagneticFile, gain: float) -> MagneticFile:
    """The same loop with its gain scaled."""
    return replace(file, loop=replace(file.loop, amplifier=gain * file.loop.amplifier))

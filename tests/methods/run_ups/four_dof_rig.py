"""A rig of four dofs with non-proportional damping and skew stiffness under four white forces, written apart
from labpipe's own rigs.

Without a change in time the motion is exact, line by line of the whole record (the force is periodic in it).
With one, it is integrated: 4 states of displacement and 4 of velocity, the forces between samples by straight
lines, the changing part as a force of its own that is corrected once per step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from labpipe.records.recording import Channel, Recording

RATE, BANDWIDTH = 256.0, 100.0
# Steps of the integration per sample.
FINE = 4
MASS = np.array([1.0, 1.4, 0.8, 1.2])
# Chain of springs [N/m] to ground and from dof to dof, and a skew part such as films and seals have.
STIFFNESS = 1e3 * np.array([[30.0, -10, 0, 0], [-10, 34, -12, 0], [0, -12, 26, -8], [0, 0, -8, 40]])
SKEW = 1e3 * np.array([[0.0, 1.5, 0, 0], [-1.5, 0, 0, 0], [0, 0, 0, 1.0], [0, 0, -1.0, 0]])
# Damping [N s/m] that is in no proportion to stiffness or mass: one damper at dof 2, one between 3 and 4.
DAMPING = np.array([[6.0, -1, 0, 0], [-1, 22, -2, 0], [0, -2, 14, -8], [0, 0, -8, 12]])
FORCE = 10.0


@dataclass(frozen=True)
class FourDofRig:
    """Length of the record [s], rms *force* [N], rms sensor *noise* [m] and what is wrong.

    gain, stiffness: relative change of sensor 1, of K from the beginning to the end of the record, even in
    time. cubic: stiffness of every spring to ground [N/m^3]. hidden: (frequency [Hz], damping ratio, share)
    of a mode besides the four.
    """

    length: float = 200.0
    force: float = FORCE
    noise: float = 2e-6
    gain: float = 0.0
    stiffness: float = 0.0
    cubic: float = 0.0
    hidden: tuple[float, float, float] | None = None


def true_stiffness() -> np.ndarray:
    """K (4, 4) [N/m]."""
    return STIFFNESS + SKEW


def receptance(rig: FourDofRig, frequency: np.ndarray) -> np.ndarray:
    """H (n, 4, 4) [m/N] with the hidden mode, whose shape is (1, -1, 1, -1) and whose mass gives 1 / k its
    *share* of H_11(0).
    """
    s = 2j * np.pi * frequency[:, None, None]
    h = np.linalg.inv(true_stiffness() + s * DAMPING + s**2 * np.diag(MASS))
    if rig.hidden is not None:
        f_n, zeta, share = rig.hidden
        shape = np.array([1.0, -1, 1, -1])
        compliance = share * np.linalg.inv(true_stiffness())[0, 0]
        r = frequency / f_n
        h = h + compliance * np.outer(shape, shape) / (1 - r**2 + 2j * zeta * r)[:, None, None]
    return h


def recordings(rig: FourDofRig, seeds: range) -> list[Recording]:
    """One recording per seed: forces f1 ... f4 [N] and displacements x1 ...

    x4 [m], all noise white and independent.
    """
    n = round(rig.length * RATE)
    generators = [np.random.default_rng([7, seed]) for seed in seeds]
    spectra = np.stack([_force_spectrum(rig, rng, n) for rng in generators])
    force = np.fft.irfft(spectra, n, axis=1)
    if rig.stiffness or rig.cubic:
        motion = _integrated(rig, spectra, n)
    else:
        h = receptance(rig, np.fft.rfftfreq(n, 1 / RATE))
        motion = np.fft.irfft(np.einsum("foi,rfi->rfo", h, spectra), n, axis=1)
    motion[:, :, 0] *= 1 + rig.gain * np.linspace(0, 1, n)
    noise = np.stack([rng.normal(size=(n, 4)) for rng in generators])
    channels = (
        *(Channel(f"f{d}", "force", "input", str(d)) for d in range(1, 5)),
        *(Channel(f"x{d}", "displacement", "output", str(d)) for d in range(1, 5)),
    )
    samples = np.concatenate([force, motion + rig.noise * noise], axis=2)
    return [Recording(channels, one, RATE, f"seed {seed}") for one, seed in zip(samples, seeds, strict=True)]


def _force_spectrum(rig: FourDofRig, rng: np.random.Generator, n: int) -> np.ndarray:
    spectrum = np.fft.rfft(rng.normal(size=(n, 4)), axis=0)
    spectrum[(np.fft.rfftfreq(n, 1 / RATE) > BANDWIDTH) | (np.arange(n // 2 + 1) == 0)] = 0
    return spectrum * (rig.force / np.sqrt(2 * np.sum(np.abs(spectrum) ** 2, axis=0)) * n)


def _integrated(rig: FourDofRig, spectra: np.ndarray, n: int) -> np.ndarray:
    """Displacements (n_run, n, 4) [m] at rest at the beginning, for all runs side by side."""
    fine, dt = n * FINE, 1 / (RATE * FINE)
    # Straight lines between samples weigh a line by sinc^2; the force is divided by it beforehand.
    weight = np.sinc(np.fft.rfftfreq(n, 1 / RATE) * dt) ** 2
    force = np.fft.irfft(spectra / weight[None, :, None], fine, axis=1) * FINE
    step, now, then = _steps(dt)
    # What the forces do in each step is there beforehand: the loop is Python's. For matrices as small as
    # these `dot` takes half of the time of `@`.
    driven = np.ascontiguousarray((force @ now + np.roll(force, -1, axis=1) @ then).swapaxes(0, 1))
    then_x = then[:, :4]
    state = np.zeros((spectra.shape[0], 8))
    motion = np.empty((n, spectra.shape[0], 4))
    extra = _extra_force(rig, fine)
    for number in range(fine):
        x = state[:, :4]
        if number % FINE == 0:
            motion[number // FINE] = x
        begin = extra(x, number)
        free = state.dot(step) + driven[number] + begin.dot(now)
        state = free + extra(free[:, :4] + begin.dot(then_x), number + 1).dot(then)
    return motion.swapaxes(0, 1)


def _extra_force(rig: FourDofRig, fine: int) -> Callable[[np.ndarray, int], np.ndarray]:
    """What the changing part of the stiffness adds to the force: -dK(t) x - cubic x^3."""
    # Asked for twice in every step: what is not there costs nothing.
    change = -rig.stiffness * true_stiffness().T / fine
    if not rig.cubic:
        return lambda x, number: x.dot(change * number)
    if not rig.stiffness:
        return lambda x, _: x * x * (-rig.cubic * x)
    return lambda x, number: (x @ change) * number - rig.cubic * x * x * x


def _steps(dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transposed matrices of one step: state, force at its beginning, force at its end (Franklin, Powell and
    Workman, sec. 6.3.2).
    """
    inverse = 1 / MASS[:, None]
    system = np.zeros((16, 16))
    system[:4, 4:8] = np.eye(4)
    system[4:8, :8] = np.hstack([-inverse * true_stiffness(), -inverse * DAMPING])
    system[4:8, 8:12] = np.diag(1 / MASS)
    system[8:12, 12:16] = np.eye(4) / dt
    whole = linalg.expm(system * dt)
    slope = whole[:8, 12:16]
    return whole[:8, :8].T, (whole[:8, 8:12] - slope).T, slope.T

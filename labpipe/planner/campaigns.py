"""What tests of a given length tell once every signal is as large as the limits allow: predicted standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.planner.criteria import A, D
from labpipe.planner.designs import optimum
from labpipe.planner.information import Noise, relative_errors, sensitivities, vector_information
from labpipe.planner.model import PlannedModel
from labpipe.planner.schemes import Multisines
from labpipe.signals.least_peak import least_peak_phases, one_period, peaks

# Motion that starts from rest: samples per period of the highest frequency, and the exponent by which the slowest motion has died away.
SAMPLES, DIED = 64, 9.0
# Starts within a period that are looked at closely.
STARTS = 16
# What rounding may add to a signal at its limit is taken off beforehand.
OBEYED = 1 - 1e-12


@dataclass(frozen=True)
class Limits:
    """Largest force of a shaker [N] and displacement of a probe [m], 0-to-peak; of the crest factor [1] of a force; None: no limit.

    At all times: between samples, and while a test starts from rest and comes to rest.
    """

    force: float
    displacement: float | None = None
    crest_factor: float | None = None

    def __post_init__(self) -> None:
        for name in ("force", "displacement", "crest_factor"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ConfigError(f"'{name}' must be positive", field=name)
        if self.crest_factor is not None and self.crest_factor < np.sqrt(2):
            raise ConfigError("no periodic signal has a crest factor below that of a sine, 1.41", field="crest_factor")


@dataclass(frozen=True)
class EarlierInformation:
    """What an earlier test counts for: *information* (n_coefficient, n_coefficient) [1] of relative coefficients, beside *duration* [s]."""

    information: FloatArray
    duration: float

    @property
    def rate(self) -> FloatArray:
        """Information (n_coefficient, n_coefficient) [1/s] spread over the planned duration."""
        return self.information / self.duration


@dataclass(frozen=True)
class Rig:
    """Model, noise, limits and directions of the shakers (n_shaker, n_dof) [1], with their names; *spacing* of the lines [Hz].

    known: what an earlier test tells, where it is combined with the planned one.
    """

    model: PlannedModel
    noise: Noise
    limits: Limits
    directions: ComplexArray
    shakers: tuple[str, ...]
    spacing: float
    known: EarlierInformation | None = None

    @property
    def known_rate(self) -> FloatArray:
        """Information (n_coefficient, n_coefficient) [1/s] of an earlier test over the planned duration; zero without one."""
        return np.zeros((len(self.model.names),) * 2) if self.known is None else self.known.rate

    def omega(self, test: Multisines) -> FloatArray:
        """Angular frequencies (n_line,) [rad/s] of a test's lines."""
        return np.asarray(2 * np.pi * self.spacing * test.lines)

    def motion(self, test: Multisines) -> ComplexArray:
        """Steady displacements (n_line, n_dof) [m] of a test."""
        return np.einsum("lij,lj->li", self.model.receptance(self.omega(test)), test.forces @ self.directions)

    def over_limits(self, test: Multisines) -> ComplexArray:
        """Amplitudes of all limited signals over their limits, by shaker, (n_line, n_shaker, n_signal) [1]: forces, then probes."""
        running = running_shakers(test)
        unit = np.eye(len(self.shakers))[:, running] / self.limits.force
        parts = [test.forces[:, :, None] * unit]
        if self.limits.displacement is not None:
            moved = np.einsum("lij,sj->lsi", self.model.receptance(self.omega(test)), self.directions)
            parts.append(test.forces[:, :, None] * moved / self.limits.displacement)
        return np.concatenate(parts, axis=2)

    def rate(self, test: Multisines) -> FloatArray:
        """Information per second, (n_coefficient, n_coefficient) [1/s], of relative coefficients."""
        forces = test.forces @ self.directions
        return np.asarray(vector_information(sensitivities(self.model, self.noise, self.omega(test)), forces).sum(axis=0))


def running_shakers(test: Multisines) -> BoolArray:
    """The shakers (n_shaker,) [1] that have a force in a test."""
    return np.any(np.abs(test.forces) > 0, axis=0)


def as_large_as_allowed(rig: Rig, test: Multisines, *, random_starts: int = 0, optimised: bool = True) -> Multisines:
    """The test with phases of least peak, unless they are not to be *optimised*, and every force as large as the limits allow.

    Without *random_starts* the phases are a first look.
    """
    running = running_shakers(test)
    # The shakers have limits of their own: those that a design pushes less are not to be the reason for larger phases.
    rms = np.where(running, np.sqrt(np.sum(np.abs(test.forces) ** 2, axis=0)), 1.0)
    test = test.scaled(np.where(running, rig.limits.force / rms, 0.0))
    if optimised:
        gains = rig.over_limits(test)[:, running]
        phases = np.zeros(test.forces.shape)
        phases[:, running] = least_peak_phases(test.lines, gains, test.groups, random_starts=random_starts, quick=not random_starts)
        test = test.turned(phases)
    largest = np.where(running, peaks(test.lines, test.forces), 1.0)
    test = test.scaled(rig.limits.force / largest)
    return test.scaled(OBEYED / max(float(peaks(test.lines, rig.over_limits(test).sum(axis=1)).max()), 1.0))


def from_rest(rig: Rig, test: Multisines, seconds: float) -> Multisines:
    """The test with its period begun where little motion starts and stops, and smaller forces where *seconds* [s] from rest still need it.

    Equation (plan-from-rest).
    """
    limit = rig.limits.displacement
    if limit is None or rig.model.free_motion is None:
        return test
    omega, motion = rig.omega(test), rig.motion(test)
    # States of the steady motion at steps of an eighth of the highest line's period, velocities as displacements at the rms frequency.
    velocity = 1j * omega[:, None] * motion / np.sqrt(np.average(omega**2, weights=np.sum(np.abs(motion) ** 2, axis=1)))
    states = one_period(test.lines, np.hstack([motion, velocity]), SAMPLES // 8)
    begins = np.argsort(np.sum(states**2, axis=0))[:STARTS] / states.shape[1]
    shifted = [test.turned(2 * np.pi * test.lines[:, None] * begin) for begin in begins]
    moved = [float(largest_motion(rig, begun, seconds).max()) for begun in shifted]
    return shifted[int(np.argmin(moved))].scaled(min(OBEYED * limit / min(moved), 1.0))


def largest_motion(rig: Rig, test: Multisines, seconds: float) -> FloatArray:
    """Largest displacement (n_dof,) [m] of *seconds* [s] of a test that starts from rest, and of what moves on when it stops.

    The steady motion alone where what starts does not die away.
    """
    motion = rig.motion(test)
    largest, free = peaks(test.lines, motion), rig.model.free_motion
    if free is None:
        return largest
    poles = np.linalg.eigvals(free)
    omega = rig.omega(test)
    steady = one_period(test.lines, motion, max(SAMPLES, int(SAMPLES * np.abs(poles.imag).max() / omega[-1])))
    step = 1 / rig.spacing / steady.shape[1]
    n_force = round(seconds / step)
    n_step = min(int(DIED / -poles.real.max() / step) + 2, 2 * n_force)
    begin = np.concatenate([motion.sum(axis=0).real, (1j * omega @ motion).real])
    started, over_steps = begin[:, None], expm(free * step)
    while started.shape[1] < n_step:
        started, over_steps = np.hstack([started, over_steps @ started]), over_steps @ over_steps
    started = started[: rig.model.n_dof, :n_step]
    on = min(n_step, n_force)
    running = np.take(steady, np.arange(on), axis=1, mode="wrap") - started[:, :on]
    stopped = started - np.pad(started[:, n_force:], ((0, 0), (0, on)))
    between = np.cos(np.pi / SAMPLES)
    return np.maximum(largest, np.abs(np.hstack([running, stopped])).max(axis=1) / between)


def crest_factors(test: Multisines) -> FloatArray:
    """Peak over rms (n_running,) [1] of the force of every shaker that runs."""
    forces = test.forces[:, running_shakers(test)]
    return np.asarray(peaks(test.lines, forces) / np.sqrt(np.sum(np.abs(forces) ** 2, axis=0) / 2))


@dataclass(frozen=True)
class Campaign:
    """Tests with their shares of the time (n_test,) [1], and what they tell per second: *rate* (n, n) [1/s], relative; *known* besides."""

    tests: tuple[Multisines, ...]
    shares: FloatArray
    rate: FloatArray
    known: EarlierInformation | None = None

    @property
    def information(self) -> FloatArray:
        """Information per second (n, n) [1/s], what an earlier test tells spread over the planned duration."""
        return self.rate if self.known is None else self.rate + self.known.rate

    def errors(self, duration: float) -> FloatArray:
        """Relative standard errors (n_coefficient,) [1] of *duration* [s] of data and what is known before, the noise being known.

        Equation (plan-earlier).
        """
        return relative_errors(self.rate * duration if self.known is None else self.rate * duration + self.known.information)


def with_shares(rig: Rig, tests: Sequence[Multisines], shares: FloatArray) -> Campaign:
    """The tests with *shares* (n_test,) [1] of the time."""
    return Campaign(tuple(tests), shares, np.tensordot(shares, np.stack([rig.rate(test) for test in tests]), 1), rig.known)


def equal_times(rig: Rig, tests: Sequence[Multisines]) -> Campaign:
    """The tests with the same time each."""
    return with_shares(rig, tests, np.full(len(tests), 1 / len(tests)))


def campaign(rig: Rig, tests: Sequence[Multisines], criterion: str, goals: FloatArray) -> Campaign:
    """The tests with the best division of the time among them; goals (n_coefficient,) [1]: as in `score`."""
    rates = np.stack([rig.rate(test) for test in tests])
    if len(rates) == 1:
        return equal_times(rig, tests)
    wanted = np.isfinite(goals)
    weight = 1 / np.where(wanted, goals, 1.0)
    design = optimum(criterion, (rates + rig.known_rate) / np.outer(weight, weight), np.eye(wanted.size)[wanted])
    shares = np.maximum(design.shares, 0.02)
    shares = shares / shares.sum()
    return Campaign(tuple(tests), shares, np.tensordot(shares, rates, 1), rig.known)


def score(information: FloatArray, criterion: str, goals: FloatArray) -> float:
    """How poor information (n, n) [1/s] is: errors over goals (n_coefficient,) [1], infinite where a coefficient is not wanted, at 1 s.

    minimax: the largest; A: the root of the sum of squares; D: det(I)^(-1/2n) of all. Smaller is better. Equation (plan-score).
    """
    errors = relative_errors(information)
    if not np.all(np.isfinite(errors)):
        return float("inf")
    if criterion == D:
        return float(np.exp(-np.linalg.slogdet(information)[1] / (2 * len(information))))
    over = (errors / goals)[np.isfinite(goals)]
    return float(np.sqrt(np.sum(over**2)) if criterion == A else over.max())

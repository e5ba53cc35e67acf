"""How spectra are put on shakers, signals of least peak within the limits, and what tests of a given length
tell with them.

Source s, a shaker say, has the phase phi_ls at line l, and signal c is s_c(t) = Re sum_ls g_lsc exp(j (phi_ls
+ 2 pi k_l t)), t in periods. The peak is approached by 2p-norms of all signals, p rising (Guillaume,
Schoukens, Pintelon and Kollar 1991, IEEE Trans. Instrum. Meas. 40, 982).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.linalg import expm

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import SettingError
from labpipe.methods.planning.designs import A, D, optimum
from labpipe.methods.planning.model import (
    PlannedModel,
    SensorDensities,
    relative_errors,
    residual_whitener,
    sensitivities,
    vector_information,
)
from labpipe.raw_files.excitation import _signals, one_period, peaks
from labpipe.records.settings import Settings

ONE_BY_ONE, TOGETHER, INTERLEAVED = "one by one", "together", "interleaved"
# Lines with less than this share of a test's power are left out.
LEFT_OUT = 1e-5


@dataclass(frozen=True)
class Multisines:
    """The forces of one test: amplitudes *forces* (n_line, n_shaker) [N] of all shakers at *lines* (n_line,)
    [multiples of the spacing].

    name: of the test, the shakers that run in it. groups (n_line,) [1]: lines of one number keep the phase
    between the shakers.
    """

    name: str
    lines: IntArray
    forces: ComplexArray
    groups: IntArray

    def turn(self, phases: FloatArray) -> Multisines:
        """With phases (n_line, n_shaker) [rad] added."""
        return replace(self, forces=self.forces * np.exp(1j * phases))

    def scale(self, factors: FloatArray | float) -> Multisines:
        """With forces times factors (n_shaker,) [1]."""
        return replace(self, forces=self.forces * factors)


Scheme = Callable[[IntArray, FloatArray, tuple[str, ...]], tuple[Multisines, ...]]


def shaker_by_shaker(lines: IntArray, power: FloatArray, names: tuple[str, ...]) -> tuple[Multisines, ...]:
    """A test for every shaker: mean squares *power* (n_line, n_shaker) [N^2] at lines (n_line,) [multiples].
    *names* of the shakers.
    """
    tests = []
    for number, name in enumerate(names):
        kept = power[:, number] > LEFT_OUT * power[:, number].sum()
        if np.any(kept):
            alone = np.zeros((np.count_nonzero(kept), len(names)), complex)
            alone[:, number] = np.sqrt(2 * power[kept, number])
            tests.append(Multisines(name, lines[kept], alone, np.arange(len(alone))))
    return tuple(tests)


def both_at_once(lines: IntArray, power: FloatArray, names: tuple[str, ...]) -> tuple[Multisines, ...]:
    """One test of two shakers at once, with opposite signs on neighbouring lines; arguments as of one_by_one,
    power (n_line, 2) [N^2]. Equation (plan-together).
    """
    paired, used = _pairs(lines, power)
    forces = np.repeat(np.sqrt(paired), 2, axis=0).astype(complex)
    forces[1::2, 1] *= -1
    return _keep(names, used, forces, np.repeat(np.arange(len(paired)), 2))


def interleave(lines: IntArray, power: FloatArray, names: tuple[str, ...]) -> tuple[Multisines, ...]:
    """One test of two shakers, each on every other line; power (n_line, 2) [N^2], as of one_by_one."""
    paired, used = _pairs(lines, power)
    forces = np.zeros((used.size, 2), complex)
    forces[::2, 0], forces[1::2, 1] = np.sqrt(2 * paired).T
    return _keep(names, used, forces, np.arange(used.size))


def _pairs(lines: IntArray, power: FloatArray) -> tuple[FloatArray, IntArray]:
    first = np.arange(0, lines.size - 1, 2)
    return np.add.reduceat(power, first, axis=0), lines[: 2 * first.size]


def _keep(
    names: tuple[str, ...], lines: IntArray, forces: ComplexArray, groups: IntArray
) -> tuple[Multisines, ...]:
    size = np.sum(np.abs(forces) ** 2, axis=1)
    kept = size > LEFT_OUT * size.sum()
    return (Multisines("+".join(names), lines[kept], forces[kept], groups[kept]),)


SCHEMES: dict[str, Scheme] = {ONE_BY_ONE: shaker_by_shaker, TOGETHER: both_at_once, INTERLEAVED: interleave}


# Samples per period of the highest line, while searching.
SEARCHED = 8
HALF_NORMS, STEPS = (4, 16, 64, 256), 200
QUICK_NORMS, QUICK_STEPS = (4, 32), 40
# Relative change of the norm at which a descent ends: a thousandth of it takes twice the steps, and the peaks
# are the same to .1 %, which is what other starts change them by.
SETTLED = 1e-6
# Norms that every start descends; further ones the best alone: two steps in five less, peaks .1 % higher.
EVERY_START = 2


def schroeder_phases_of(power: FloatArray) -> FloatArray:
    """Schroeder's phases [rad] of lines with *power* (n_line,) [any unit]: phi_n = -2 pi sum_{l<n} (n - l)
    p_l, p summing to 1. Equation (spec-schroeder-power).
    """
    return -2 * np.pi * np.cumsum(np.concatenate([[0.0], np.cumsum(power / power.sum())[:-1]]))


def least_peak_phases(
    lines: IntArray,
    gains: ComplexArray,
    groups: IntArray | None = None,
    *,
    random_starts: int = 1,
    quick: bool = False,
) -> FloatArray:
    """Phases (n_line, n_source) [rad] that make the largest peak of all signals small.

    gains (n_line, n_source, n_signal) [1]: amplitudes over the limit of their signal; lines (n_line,)
    [multiples]. The sources of a line differ in phase by as much as on all lines of the same number in
    *groups* (n_line,), by default of a line alone. Starts from Schroeder's phases and from *random_starts*
    random ones; never worse than Schroeder's. *quick*: a first look, a few per cent above. Equation
    (plan-peak).
    """
    n_line, n_source, _ = gains.shape
    group = np.arange(n_line) if groups is None else np.unique(groups, return_inverse=True)[1]
    schroeder = schroeder_phases_of(np.sum(np.abs(gains) ** 2, axis=(1, 2)))
    rng = np.random.default_rng(0)
    n_difference = (n_source - 1) * (int(group.max()) + 1)
    begins = [np.concatenate([schroeder, np.zeros(n_difference)])]
    begins += [rng.uniform(0, 2 * np.pi, n_line + n_difference) for _ in range(random_starts)]
    if random_starts and n_difference:
        begins.append(np.concatenate([schroeder, rng.uniform(0, 2 * np.pi, n_difference)]))
    problem = _PhaseProblem(lines, gains, group)
    best, least = begins[0], problem.peak(begins[0])
    options = {"maxiter": QUICK_STEPS if quick else STEPS, "ftol": SETTLED}
    how = {"jac": True, "method": "L-BFGS-B", "options": options}
    for number, p in enumerate(QUICK_NORMS if quick else HALF_NORMS, 1):
        begins = [scipy.optimize.minimize(problem.norm, start, args=(p,), **how).x for start in begins]
        reached = [problem.peak(end) for end in begins]
        lowest = int(np.argmin(reached))
        if reached[lowest] < least:
            best, least = begins[lowest], reached[lowest]
        if number >= EVERY_START:
            begins = [begins[lowest]]
    return np.mod(problem.phases(best), 2 * np.pi)


class _PhaseProblem:
    """The peak by phases of the first source (n_line,), then differences of the others by group."""

    def __init__(self, lines: IntArray, gains: ComplexArray, group: IntArray) -> None:
        self.lines, self.gains, self.group = lines, gains, group
        self.n_line, self.n_source, _ = gains.shape
        self.n_group = int(group.max()) + 1
        self.n_sample = scipy.fft.next_fast_len(SEARCHED * int(lines.max()), real=True)

    def phases(self, unknowns: FloatArray) -> FloatArray:
        first = unknowns[: self.n_line, None]
        others = unknowns[self.n_line :].reshape(self.n_group, self.n_source - 1)
        return np.concatenate([first, first + others[self.group]], axis=1)

    def amplitudes(self, unknowns: FloatArray) -> ComplexArray:
        return self.gains * np.exp(1j * self.phases(unknowns))[:, :, None]

    def peak(self, unknowns: FloatArray) -> float:
        return float(peaks(self.lines, self.amplitudes(unknowns).sum(axis=1)).max())

    def norm(self, unknowns: FloatArray, p: int) -> tuple[float, FloatArray]:
        amplitudes = self.amplitudes(unknowns)
        scaled = _signals(self.lines, amplitudes.sum(axis=1), self.n_sample)
        largest = max(scaled.max(), -scaled.min())
        scaled /= largest
        # scaled^(2 p - 1) = scaled scaled^2 ... scaled^p, p a power of two: a third of a general one's time.
        square = scaled * scaled
        powers = scaled * square
        for _ in range(p.bit_length() - 2):
            square *= square
            powers *= square
        total = float(np.vdot(powers, scaled))
        spectrum = scipy.fft.rfft(powers, axis=1, overwrite_x=True)[:, self.lines].T
        # Re(1j a conj(S)) of all signals.
        slope = np.einsum("lsc,lc->ls", amplitudes, spectrum.conj()).imag / -largest / total
        differences = np.zeros((self.n_group, self.n_source - 1))
        np.add.at(differences, self.group, slope[:, 1:])
        slopes = np.concatenate([slope.sum(axis=1), differences.reshape(-1)])
        return float(np.log(largest) + np.log(total) / (2 * p)), slopes


# Motion from rest: samples per period of the highest frequency, exponent by which the slowest has died.
SAMPLES, DIED = 64, 9.0
# Starts within a period that are looked at closely.
STARTS = 16
# What rounding may add to a signal at its limit is taken off beforehand.
OBEYED = 1 - 1e-12


@dataclass(frozen=True)
class RigLimits(Settings):
    """Largest force of a shaker [N] and displacement of a probe [m], 0-to-peak; of the crest factor [1] of a
    force; None: no limit.

    At all times: between samples, and while a test starts from rest and comes to rest.
    """

    force: float
    displacement: float | None = None
    crest_factor: float | None = None

    def __post_init__(self) -> None:
        self.require_positive("force", "displacement", "crest_factor")
        if self.crest_factor is not None and self.crest_factor < np.sqrt(2):
            what = "no periodic signal has a crest factor below that of a sine, 1.41"
            raise SettingError("crest_factor", what)


@dataclass(frozen=True)
class EarlierInformation:
    """An earlier test's *information* (n_coefficient, n_coefficient) [1], relative, beside *duration* [s]."""

    information: FloatArray
    duration: float

    @property
    def rate(self) -> FloatArray:
        """Information (n_coefficient, n_coefficient) [1/s] spread over the planned duration."""
        return self.information / self.duration


@dataclass(frozen=True)
class PlannedRig:
    """Model, noise, limits and directions of the shakers (n_shaker, n_dof) [1], with their names; *spacing*
    of the lines [Hz]. earlier: what an earlier test tells, where it is combined with the planned one.
    """

    model: PlannedModel
    noise: SensorDensities
    limits: RigLimits
    directions: ComplexArray
    shakers: tuple[str, ...]
    spacing: float
    earlier: EarlierInformation | None = None

    @property
    def known_rate(self) -> FloatArray:
        """That of an earlier test over the planned duration (n_coefficient, n_coefficient) [1/s], or zero."""
        return np.zeros((len(self.model.names),) * 2) if self.earlier is None else self.earlier.rate

    def omega(self, test: Multisines) -> FloatArray:
        """Angular frequencies (n_line,) [rad/s] of a test's lines."""
        return 2 * np.pi * self.spacing * test.lines

    def motion(self, test: Multisines) -> ComplexArray:
        """Steady displacements (n_line, n_dof) [m] of a test."""
        return np.einsum("lij,lj->li", self.model.receptance(self.omega(test)), test.forces @ self.directions)

    def amplitudes_over_limits(self, test: Multisines) -> ComplexArray:
        """Amplitudes of forces, then probes over their limits, (n_line, n_shaker, n_signal) [1]."""
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
        sensitivity = sensitivities(self.model, self.noise, self.omega(test), forces)
        return vector_information(sensitivity, forces).sum(axis=0)


def running_shakers(test: Multisines) -> BoolArray:
    """The shakers (n_shaker,) [1] that have a force in a test."""
    return np.any(np.abs(test.forces) > 0, axis=0)


def enlarge_to_limits(
    rig: PlannedRig, test: Multisines, *, random_starts: int = 0, optimised: bool = True
) -> Multisines:
    """The test with phases of least peak, unless they are not to be *optimised*, and every force as large as
    the limits allow. Without *random_starts* the phases are a first look.
    """
    running = running_shakers(test)
    # Each shaker has its own limit: those that a design pushes less are not to worsen the phases.
    rms = np.where(running, np.sqrt(np.sum(np.abs(test.forces) ** 2, axis=0)), 1.0)
    test = test.scale(np.where(running, rig.limits.force / rms, 0.0))
    if optimised:
        gains = rig.amplitudes_over_limits(test)[:, running]
        phases = np.zeros(test.forces.shape)
        phases[:, running] = least_peak_phases(
            test.lines, gains, test.groups, random_starts=random_starts, quick=not random_starts
        )
        test = test.turn(phases)
    test = test.scale(rig.limits.force / np.where(running, peaks(test.lines, test.forces), 1.0))
    return test.scale(
        OBEYED / max(float(peaks(test.lines, rig.amplitudes_over_limits(test).sum(axis=1)).max()), 1.0)
    )


def from_rest(rig: PlannedRig, test: Multisines, seconds: float) -> Multisines:
    """The test with its period begun where little motion starts and stops, and smaller forces where *seconds*
    [s] from rest still need it. Equation (plan-from-rest).
    """
    limit = rig.limits.displacement
    if limit is None or rig.model.free_motion is None:
        return test
    omega, motion = rig.omega(test), rig.motion(test)
    # States of the steady motion at steps of an eighth of the highest line's period, velocities as
    # displacements at the rms frequency.
    rms = np.sqrt(np.average(omega**2, weights=np.sum(np.abs(motion) ** 2, axis=1)))
    velocity = 1j * omega[:, None] * motion / rms
    states = one_period(test.lines, np.hstack([motion, velocity]), SAMPLES // 8)
    begins = np.argsort(np.sum(states**2, axis=0))[:STARTS] / states.shape[1]
    shifted = [test.turn(2 * np.pi * test.lines[:, None] * begin) for begin in begins]
    moved = [float(largest_motion(rig, begun, seconds).max()) for begun in shifted]
    return shifted[int(np.argmin(moved))].scale(min(OBEYED * limit / min(moved), 1.0))


def largest_motion(rig: PlannedRig, test: Multisines, seconds: float) -> FloatArray:
    """Largest displacement (n_dof,) [m] of *seconds* [s] of a test that starts from rest, and of what moves
    on when it stops. The steady motion alone where what starts does not die away.
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


@dataclass(frozen=True)
class Settling:
    """What the motion that starts with every test does to the coefficients of a campaign.

    shift (n_test, n_coefficient, n_state) [1 per state]: of relative coefficients by the motion left at the
    first measured period; begin (n_test, n_state) [m, m/s]: that motion at rest; over (n_state, n_state) [1]:
    what a period leaves of it.
    """

    shift: FloatArray
    begin: FloatArray
    over: FloatArray

    def shifts(self, skip: int) -> FloatArray:
        """Shifts (n_coefficient,) [1] of the relative coefficients where *skip* periods are dropped."""
        return np.einsum("tcs,ts->c", self.shift, self.begin @ np.linalg.matrix_power(self.over, skip).T)


def settling(rig: PlannedRig, timed: PlannedCampaign, periods: Sequence[int]) -> Settling | None:
    """The effect of free motion on tests of *periods* measured periods each, at first order; None where it
    does not die away.

    Motion z of the state equation z' = A z adds 2 / (P T) C (A - jw)^-1 (exp(A P T) - 1) z to the average
    over P periods, and that acts on the coefficients as an error of the response does. Equation
    (plan-settling).
    """
    free = rig.model.free_motion
    if free is None:
        return None
    seconds = np.array(periods) / rig.spacing
    total = sum(rig.rate(test) * time for test, time in zip(timed.tests, seconds, strict=True))
    if timed.earlier is not None:
        total = total + timed.earlier.information
    n_dof, n_state = rig.model.n_dof, len(free)
    shifts, begins = [], []
    for test, time in zip(timed.tests, seconds, strict=True):
        omega, motion, unit = rig.omega(test), rig.motion(test), np.eye(n_state)
        forces = test.forces @ rig.directions
        begins.append(-np.concatenate([motion.sum(axis=0).real, (1j * omega @ motion).real]))
        left = np.linalg.solve(free - 1j * omega[:, None, None] * unit, expm(free * time) - unit)
        forced = np.linalg.solve(rig.model.receptance(omega), 2 / time * left[:, :n_dof])
        whitened = residual_whitener(rig.model, rig.noise, omega, forces) @ forced
        sensitivity = sensitivities(rig.model, rig.noise, omega, forces)
        responses = np.einsum("lnij,lj->lni", sensitivity, forces)
        change = np.einsum("lni,lis->ns", responses.conj(), whitened).real
        shifts.append(-time * np.linalg.solve(total, change))
    return Settling(np.array(shifts), np.array(begins), expm(free / rig.spacing))


def crest_factors(test: Multisines) -> FloatArray:
    """Peak over rms (n_running,) [1] of the force of every shaker that runs."""
    forces = test.forces[:, running_shakers(test)]
    return peaks(test.lines, forces) / np.sqrt(np.sum(np.abs(forces) ** 2, axis=0) / 2)


@dataclass(frozen=True)
class PlannedCampaign:
    """Tests, *shares* (n_test,) [1] of the time, relative *rate* (n, n) [1/s]; *earlier*: told besides."""

    tests: tuple[Multisines, ...]
    shares: FloatArray
    rate: FloatArray
    earlier: EarlierInformation | None = None

    @property
    def information(self) -> FloatArray:
        """Information per second (n, n) [1/s], an earlier test's spread over the planned duration."""
        return self.rate if self.earlier is None else self.rate + self.earlier.rate

    def errors(self, duration: float) -> FloatArray:
        """Relative standard errors (n_coefficient,) [1] of *duration* [s] of data and what is known before,
        the noise being known. Equation (plan-earlier).
        """
        before = 0.0 if self.earlier is None else self.earlier.information
        return relative_errors(self.rate * duration + before)


def with_shares(rig: PlannedRig, tests: Sequence[Multisines], shares: FloatArray) -> PlannedCampaign:
    """The tests with *shares* (n_test,) [1] of the time."""
    rates = np.stack([rig.rate(test) for test in tests])
    return PlannedCampaign(tuple(tests), shares, np.tensordot(shares, rates, 1), rig.earlier)


def equal_times(rig: PlannedRig, tests: Sequence[Multisines]) -> PlannedCampaign:
    return with_shares(rig, tests, np.full(len(tests), 1 / len(tests)))


def campaign(
    rig: PlannedRig, tests: Sequence[Multisines], criterion: str, goals: FloatArray
) -> PlannedCampaign:
    """The tests with the best division of the time among them; goals (n_coefficient,) [1]: as in `score`."""
    if len(tests) == 1:
        return equal_times(rig, tests)
    rates = np.stack([rig.rate(test) for test in tests])
    wanted = np.isfinite(goals)
    weight = 1 / np.where(wanted, goals, 1.0)
    relative = (rates + rig.known_rate) / np.outer(weight, weight)
    design = optimum(criterion, relative, np.eye(wanted.size)[wanted])
    shares = np.maximum(design.shares, 0.02)
    shares = shares / shares.sum()
    return PlannedCampaign(tuple(tests), shares, np.tensordot(shares, rates, 1), rig.earlier)


def score(information: FloatArray, criterion: str, goals: FloatArray) -> float:
    """How poor information (n, n) [1/s] is: errors over goals (n_coefficient,) [1], infinite where a
    coefficient is not wanted, at 1 s.

    minimax: the largest; A: the root of the sum of squares; D: det(I)^(-1/2n) of all. Smaller is better.
    Equation (plan-score).
    """
    errors = relative_errors(information)
    if not np.all(np.isfinite(errors)):
        return float("inf")
    if criterion == D:
        return float(np.exp(-np.linalg.slogdet(information)[1] / (2 * len(information))))
    over = (errors / goals)[np.isfinite(goals)]
    return float(np.sqrt(np.sum(over**2)) if criterion == A else over.max())

"""One posterior from all tests of a rotor: start, descent, sizes of the small errors, priors that give way,
conflicts between tests, and what no test tells.

Sources: Kennedy and O'Hagan 2001 (small errors), MacKay 1992 (evidence), Hausman 1978 (conflicts).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter, itemgetter

import numpy as np
import scipy

from labpipe.arrays import BoolArray, FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import FitError
from labpipe.estimation.descent import minimise
from labpipe.methods.rotor.posterior import Posterior, Problem, root_of
from labpipe.methods.rotor_system.evidence import (
    Deflections,
    FreeModes,
    Responses,
    RunUpVectors,
    SystemEvidence,
)
from labpipe.methods.rotor_system.model import SystemModel
from labpipe.methods.run_ups.misfit import shared_noise
from labpipe.records.finding import NORMAL

# Shares of an amplitude that count as noise in the first steps, one after the other.
SLACK = (1.0, 0.3, 0.1)
# The size of a group of small errors stays between the declared one and this many times it.
MOST_SIZE = 6.0
# Rounds of estimating sizes, and the change that ends them.
ROUNDS, SETTLED = 8, 0.03
# A prior further off than this many of its standard uncertainties gives way, as Student's t does with so many
# degrees of freedom.
GIVES_WAY, STUDENT = 2.0, 4.0
# Distance in standard errors at which a descent ends, and its most steps.
NEAR, MOST_STEPS = 1e-2, 40
# Further starts, drawn this far about the means in standard uncertainties.
RESTARTS, DRAWN, RESTART_SEED = 3, 0.6, 20261126
# Steps with noise that is enlarged by a share of the amplitudes, before the share is taken anew.
STEPS = 4
# Draws by which the normal approximation is compared with the tests, and the excess over the number of
# unknowns that it bears, in standard deviations of a median of so many; fits of randomised maximum likelihood
# where it fails, the steps of each, and the chance of a chi-square beyond which it has lost the rotor.
LOOKED, BEARABLE, REFITS, REFIT_STEPS, LOST = 80, 3.0, 60, 6, 1e-4
# Misfit of a test below this probability, or a size beyond this many of the declared one, asks for an
# alternative; intervals are then widened, since sizes are poorly known.
MISFIT, ENLARGED, WIDENED = 1e-3, 1.5, 1.5
# Share of what a test says of an unknown that it must say against all others, for it to have its own there.
LEAST_CONTENT = 1e-6


@dataclass(frozen=True)
class SystemProblem(Problem[SystemModel]):
    """All *tests* of a rotor with all that carries it."""

    tests: tuple[SystemEvidence, ...]


@dataclass(frozen=True)
class Pull:
    """What a *test* does to the unknowns that the others tell: the one it moves most, by how many standard
    errors of that move; *wider* (n_unknown,): the factor by which standard errors are larger without it [1].
    """

    test: str
    unknown: str
    z: float
    wider: FloatArray


@dataclass(frozen=True, kw_only=True)
class SystemPosterior(Posterior[SystemModel]):
    """The posterior of a rotor: *sizes* of the small errors by group, *widened*: factor on intervals.

    refits (n_draw, n_unknown) [unit of each]: fits of moved data where the normal approximation fails (not
    *normal*), in place of draws of it.
    """

    problem: SystemProblem
    sizes: Mapping[str, float]
    widened: float = 1.0
    alternative: str = ""
    refits: FloatArray | None = None
    normal: bool = True

    @property
    def tests(self) -> tuple[SystemEvidence, ...]:
        return self.problem.tests

    @property
    def chi2(self) -> dict[str, tuple[float, int]]:
        """(chi-square, independent data) by test."""
        return {
            test.name: (
                float(residual @ residual),
                max(1, round(residual.size / getattr(test, "shared", 1.0))),
            )
            for test, (residual, _) in zip(self.tests, self.by_test, strict=True)
        }

    @cached_property
    def covariance(self) -> FloatArray:
        """V + V E V of all unknowns (n_unknown, n_unknown) [products of their units], E the `shared_noise` of
        run-ups less one baseline.
        """
        plain, nets = super().covariance, zip(self.tests, self.by_test, strict=True)
        parts = (
            (test.net[0], part)
            for test, (_, slopes) in nets
            if isinstance(test, RunUpVectors) and test.net is not None
            for part in test.by_baseline(slopes)
        )
        return plain + plain @ shared_noise(parts, len(plain)) @ plain

    @property
    def standard_errors(self) -> FloatArray:
        """(n_unknown,) [unit of each]: of the covariance, or the root mean square of the refits about the
        values.
        """
        if self.refits is None:
            return np.sqrt(np.diag(self.covariance))
        return np.sqrt(np.mean((self.refits - self.values) ** 2, axis=0))

    @property
    def shares(self) -> FloatArray:
        """Share (n_unknown,) [1] of the prior's standard uncertainty that is left; above .7 no test tells."""
        return self.standard_errors / self.model.errors

    @property
    def enlarged(self) -> dict[str, float]:
        """Groups whose size passed 1.5 times the declared one, with the ratio, the largest first."""
        ratios = {group: size / self.model.groups[group] for group, size in self.sizes.items()}
        return dict(
            sorted(
                ((group, ratio) for group, ratio in ratios.items() if ratio > ENLARGED),
                key=lambda pair: -pair[1],
            )
        )

    @property
    def misfits(self) -> dict[str, float]:
        """Tests whose chi-square has a probability below .001, with it."""
        tails = {name: chi2_tail(chi2, n) for name, (chi2, n) in self.chi2.items()}
        return {name: tail for name, tail in tails.items() if tail < MISFIT}

    @property
    def contradicted(self) -> list[tuple[str, float]]:
        """Unknowns with a declared prior that is more than 3 of its standard uncertainties off."""
        z = (self.values - self.model.means) / self.model.errors
        unknowns = zip(self.model.unknowns, z, strict=True)
        return [
            (unknown.name, float(distance))
            for unknown, distance in unknowns
            if abs(distance) > 3 and not unknown.group
        ]

    def error_of(self, gradient: FloatArray, predicted: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Standard errors (...,) [unit of the prediction], widened, of predictions with *gradient* (...,
        n_unknown); where there are refits of what is *predicted* (...,) of each, NaN without it: the distance
        that 95 % of them keep, over 1.96. Unknowns that the tests tell together alone go far along a bent
        line, on which a prediction hardly changes: a gradient leaves that line.
        """
        variance = np.einsum("...i,ij,...j->...", gradient, self.covariance, gradient)
        error = np.sqrt(np.maximum(variance, 0.0))
        if self.refits is not None:
            distances = np.abs(
                np.array([predicted(values) for values in self.refits]) - predicted(self.values)
            )
            # Ranked, since what is not there counts as far off; one more is below the r-th in r / (n + 1).
            rank = min(math.ceil(0.95 * (len(distances) + 1)), len(distances))
            reach = np.sort(np.nan_to_num(distances, nan=np.inf), axis=0)[rank - 1] / NORMAL
            error = np.where(np.isfinite(reach), reach, error)
        return self.widened * error

    def covariance_with(self, test: SystemEvidence) -> FloatArray:
        """The covariance with one more *test*, (F + J^T J)^-1, (n_unknown, n_unknown) [unit of each]."""
        slopes = test.residual(self.model, self.values)[1]()
        return np.linalg.inv(np.linalg.inv(self.covariance) + slopes.T @ slopes)

    def draws(self, n_draw: int, seed: int = 0) -> FloatArray:
        """Draws (n_draw, n_unknown) [unit of each], of the refits where there are such."""
        if self.refits is not None:
            return self.refits[np.arange(n_draw) % len(self.refits)]
        return normal_draws(self.values, self.covariance, n_draw, seed)


def normal_draws(values: FloatArray, covariance: FloatArray, n_draw: int, seed: int = 0) -> FloatArray:
    """Draws (n_draw, n_unknown) of N(*values* (n_unknown,), *covariance* (n_unknown, n_unknown)) [unit of
    each].
    """
    normal = np.random.default_rng(seed).standard_normal((n_draw, values.size))
    return values + normal @ root_of(covariance).T


def fit_system(
    model: SystemModel, tests: Sequence[SystemEvidence], *, estimate_sizes: bool = True
) -> SystemPosterior:
    """The posterior of all *tests*; FitError where no minimum is found. Standing tests first, then run-ups
    with noise that is enlarged at first: from prior means one start suffices in matched cases. Sizes of
    groups by EM: tau^2 = (sum m^2 + tr V + 2 tau_0^2) / (n + 2), between the declared size and six times it.
    Equation (system-sizes).
    """
    all_free = np.ones(model.means.size, dtype=bool)
    problem = SystemProblem(model, tuple(tests), model.means, model.errors, all_free, model.means)
    values = _begin(problem)
    ungrouped = model.in_group("")
    sizes = dict(model.groups)
    for _ in range(ROUNDS if estimate_sizes else 1):
        values = _descend(problem, values)
        distance, errors = values - model.means, problem.errors.copy()
        if estimate_sizes:
            variances = np.diag(SystemPosterior(problem=problem, values=values, sizes=sizes).covariance)
            for group, declared in model.groups.items():
                members = model.in_group(group)
                squares = float(np.sum(distance[members] ** 2 + variances[members]))
                size = np.sqrt((squares + 2 * declared**2) / (members.sum() + 2))
                sizes[group] = float(np.clip(size, declared, MOST_SIZE * declared))
                errors[members] = sizes[group]
        gives_way = ungrouped & (np.abs(distance) > GIVES_WAY * model.errors)
        errors[ungrouped] = model.errors[ungrouped]
        errors[gives_way] = np.sqrt(
            (STUDENT * model.errors[gives_way] ** 2 + distance[gives_way] ** 2) / (STUDENT + 1)
        )
        earlier, problem = problem.errors, replace(problem, errors=errors)
        if np.all(np.abs(errors / earlier - 1) < SETTLED):
            break
    return SystemPosterior(problem=problem, values=_descend(problem, values), sizes=sizes)


def _begin(problem: SystemProblem) -> FloatArray:
    """Values at a minimum: from the middle of the priors, and where that ends in none or in one that no test
    fits, from draws about it as well; the least of them.
    """
    rng = np.random.default_rng(RESTART_SEED)
    minima: list[tuple[float, FloatArray]] = []
    for attempt in range(RESTARTS + 1):
        offset = DRAWN * problem.errors * rng.standard_normal(problem.errors.size) if attempt else 0.0
        try:
            # A prior that is far off needs longer to come near under enlarged noise.
            values = _descend(problem, _start(problem, problem.means + offset, STEPS * (1 + 2 * attempt)))
        except FitError:
            if attempt == RESTARTS and not minima:
                raise
            continue
        residuals = [residual for residual, _ in problem.parts(values)]
        n, chi2 = sum(part.size for part in residuals), sum(float(part @ part) for part in residuals)
        cost = chi2 + float(np.sum(((values - problem.means) / problem.errors) ** 2))
        minima.append((cost, values))
        if chi2 < n + 4 * np.sqrt(2 * n):
            break
    return min(minima, key=itemgetter(0))[1]


def _start(problem: SystemProblem, values: FloatArray, steps: int) -> FloatArray:
    """Values near the minimum: modes and deflections, then responses, then all, noise enlarged less and
    less, so many *steps* with each.
    """
    of_modes, standing = (
        replace(problem, tests=tuple(test for test in problem.tests if isinstance(test, kinds)))
        for kinds in ((FreeModes, Deflections), (FreeModes, Deflections, Responses))
    )
    if of_modes.tests:
        values = _descend(of_modes, values)
    if len(of_modes.tests) < len(standing.tests):
        values = _temper(standing, values, steps)
    if len(standing.tests) < len(problem.tests):
        # The unbalance alone first, in which the vectors are linear.
        unbalance = np.array([unknown.unit == "kg.m" for unknown in problem.model.unknowns])
        values = _descend(_loosen(problem, values, SLACK[0]), values, unbalance, steps)
        values = _temper(problem, values, steps)
    return values


def _loosen(problem: SystemProblem, values: FloatArray, share: float) -> SystemProblem:
    tests = tuple(test.loosen(problem.model, values, share) for test in problem.tests)
    return replace(problem, tests=tests)


def _temper(problem: SystemProblem, values: FloatArray, steps: int) -> FloatArray:
    for share in SLACK:
        values = _descend(_loosen(problem, values, share), values, most_steps=steps)
    return values


def _descend(
    problem: SystemProblem, start: FloatArray, free: BoolArray | None = None, most_steps: int = MOST_STEPS
) -> FloatArray:
    problem = replace(problem, base=start, free=problem.free if free is None else free)
    minimum = minimise(problem, start[problem.free], NEAR, most_steps)
    if not minimum.converged and most_steps == MOST_STEPS:
        hint = "check nodes, directions and units of the tests, or declare more uncertainty"
        raise FitError("the tests of the rotor lead to no minimum", hint=hint)
    return problem.whole(minimum.values)


def pulls(posterior: SystemPosterior) -> list[Pull]:
    """What each test does to what the others say: theta_-t - theta = (F - F_t)^-1 J_t^T r_t, J_t of the
    residual r_t, is N(0, V_-t - V) where all is well (Hausman 1978). Equation (system-pull).
    """
    model, all_pulls = posterior.model, []
    # As the weights count tests, each by itself.
    covariance, ungrouped = posterior.free_covariance, model.in_group("")
    information = np.linalg.inv(covariance)
    for test, (residual, jacobian) in zip(posterior.tests, posterior.by_test, strict=True):
        left_out = np.linalg.inv(information - jacobian.T @ jacobian)
        shift = left_out @ jacobian.T @ residual
        shift_error = np.sqrt(np.maximum(np.diag(left_out - covariance), 1e-30))
        # Rounding makes anything of unknowns that the test does not move; small errors are named by group.
        z = np.where(ungrouped & (shift_error > 1e-3 * np.sqrt(np.diag(left_out))), shift / shift_error, 0.0)
        worst = int(np.argmax(np.abs(z)))
        wider = np.sqrt(np.diag(left_out) / np.diag(covariance))
        all_pulls.append(Pull(test.name, model.unknowns[worst].name, float(z[worst]), wider))
    return all_pulls


@dataclass(frozen=True)
class Explanation:
    """What would make tests agree: another *value* [unit of it] of the unknown of that *number* in one
    *test*, or small errors of a *group* that are larger than declared by the factor *value*; chi-square of
    tests and priors has a *fall* by it [1].
    """

    fall: float
    value: float
    test: str = ""
    number: int = 0
    group: str = ""


def explanations(posterior: SystemPosterior) -> list[Explanation]:
    """What would make the tests agree, the best first, an unknown in the test in which it explains most. By a
    further unknown in the residual of one test, linearised and with small errors as declared: a that column,
    s = a^T r - a^T J V g and i = a^T a - a^T J V J^T a, chi-square falls by s^2 / i at a change -s / i; V^-1
    = sum J^T J + P, g half the gradient of chi-square. Equation (system-explanation).
    """
    model, distance = posterior.model, posterior.values - posterior.model.means
    information = sum(jacobian.T @ jacobian for _, jacobian in posterior.by_test)
    slope = sum(jacobian.T @ residual for residual, jacobian in posterior.by_test)

    def least(errors: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        prior = errors**-2.0
        covariance, gradient = np.linalg.inv(information + np.diag(prior)), slope + prior * distance
        step = covariance @ gradient
        return covariance, step, float(distance @ (prior * distance) - gradient @ covariance @ gradient)

    covariance, step, chi2 = least(model.errors)
    best: dict[str, Explanation] = {}
    for test, (residual, jacobian) in zip(posterior.tests, posterior.by_test, strict=True):
        square = jacobian.T @ jacobian
        score = jacobian.T @ residual - square @ step
        content = np.diag(square - square @ covariance @ square)
        for number, unknown in enumerate(model.unknowns):
            if unknown.group or content[number] <= LEAST_CONTENT * square[number, number]:
                continue
            change = -float(score[number] / content[number])
            # All others move with it.
            moved = change * (1 - float(covariance[number] @ square[:, number])) - float(step[number])
            value = float(posterior.values[number]) + moved
            explanation = Explanation(change**2 * float(content[number]), value, test.name, number)
            best[unknown.name] = max(best.get(unknown.name, explanation), explanation, key=attrgetter("fall"))
    for group, ratio in posterior.enlarged.items():
        chi2_larger = least(np.where(model.in_group(group), ratio, 1.0) * model.errors)[2]
        best[group] = Explanation(chi2 - chi2_larger, ratio, group=group)
    return sorted(best.values(), key=attrgetter("fall"), reverse=True)


def budget(posterior: SystemPosterior, gradient: FloatArray) -> dict[str, float]:
    """The share [1] of the variance of a prediction with this *gradient* (n_unknown,) that would go if one
    unknown, or all small errors of a group, were known: (V g)_s^T V_ss^-1 (V g)_s / g^T V g; largest first.
    Unknowns that the tests tell together have shares in common, so that all of them may exceed 1. Equation
    (system-budget).
    """
    response = posterior.covariance @ gradient
    variance, shares = float(gradient @ response), {}
    names = np.array([unknown.group or unknown.name for unknown in posterior.model.unknowns])
    for name in dict.fromkeys(names.tolist()):
        members = np.flatnonzero(names == name)
        factors = np.linalg.lstsq(posterior.covariance[np.ix_(members, members)], response[members])[0]
        shares[name] = float(response[members] @ factors) / variance if variance else 0.0
    return dict(sorted(shares.items(), key=lambda pair: -pair[1]))


def common_changes(posterior: SystemPosterior) -> dict[str, float]:
    """Standard uncertainties to which the tests alone tell ln of the stiffness, and of the damping, of all
    bearings at speed against rest: (1 / u^2 - 1 / u_0^2)^-1/2 of their mean, u_0 as declared [1]. Nothing
    where one error of all is an unknown, and where no bearing has such errors.
    """
    unknowns, changes = posterior.model.unknowns, dict[str, float]()
    letters = np.array([u.name.removesuffix(" running").rpartition(" ")[2][:1] for u in unknowns])
    for quantity, letter in (("stiffness", "k"), ("damping", "c")):
        alike = posterior.model.in_group("bearings") & (letters == letter)
        if not alike.any() or any(u.name.startswith("all bearings") for u in unknowns):
            continue
        mean = alike / alike.sum()
        declared = 1 / float(np.sum((mean * posterior.errors) ** 2))
        by_tests = 1 / float(mean @ posterior.covariance @ mean) - declared
        changes[quantity] = 1 / np.sqrt(max(by_tests, 1e-6 * declared))
    return changes


def normality(posterior: SystemPosterior) -> tuple[float, float]:
    """How normal a posterior is: the median excess of chi-square of its draws over that of its middle, and
    the largest one that chance gives a normal posterior, about its number of unknowns [1].
    """
    problem, n = posterior.problem, posterior.values.size
    middle = problem.chi2(posterior.values)
    excess = np.array([problem.chi2(draw) for draw in posterior.draws(LOOKED)]) - middle
    # A median of so many draws scatters 1.25 times as much as their mean.
    return float(np.median(excess)), n + BEARABLE * 1.25 * float(np.sqrt(2 * n / LOOKED))


def refit(posterior: SystemPosterior, n_draw: int = REFITS, seed: int = 0) -> SystemPosterior:
    """The posterior by randomised maximum likelihood where the normal approximation fails: data and prior
    means are moved by their own standard uncertainties and fitted again, *n_draw* times (Chen and Oliver
    2012). Equation (system-draws). The chi-square of moved data is a non-central one about that of the
    posterior; a fit that ends beyond it has lost the rotor, and where most have, the normal approximation
    stands.
    """
    problem, rng = posterior.problem, np.random.default_rng(seed)
    residual, jacobian = problem.residual(posterior.values), problem.jacobian(posterior.values)
    chi2, dof = float(residual @ residual), residual.size - posterior.values.size
    highest = float(scipy.stats.ncx2.isf(LOST, dof, chi2))
    fits = []
    for _ in range(n_draw):
        noise = rng.standard_normal(residual.size)
        start = posterior.values - posterior.covariance @ (jacobian.T @ noise)
        drawn = replace(problem, moved=noise)
        fitted = minimise(drawn, start, NEAR, REFIT_STEPS).values
        if drawn.chi2(fitted) < highest:
            fits.append(fitted)
    return replace(posterior, refits=np.array(fits)) if 2 * len(fits) > n_draw else posterior

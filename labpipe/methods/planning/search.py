"""The search for a plan: candidates, and optimum designs of several criteria and costs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import SettingError
from labpipe.methods.planning.campaigns import (
    ONE_BY_ONE,
    SCHEMES,
    Multisines,
    PlannedCampaign,
    PlannedRig,
    campaign,
    crest_factors,
    enlarge_to_limits,
    equal_times,
    score,
)
from labpipe.methods.planning.designs import CRITERIA, Design, DesignCertificate, optimum
from labpipe.methods.planning.model import PlannedModel, SensorDensities, sensitivities, vector_information
from labpipe.raw_files.excitation import schroeder_phases


@dataclass(frozen=True)
class Candidates:
    """Single lines with a direction of force each.

    line (n_candidate,): index of the line; direction (n_candidate, n_dof) [1]; cost (n_candidate,) [1]: of a
    mean square of 1 N^2, unit force power by default; information (n_candidate, n_coefficient, n_coefficient)
    [1/s] at unit cost, of relative coefficients.
    """

    line: IntArray
    direction: ComplexArray
    cost: FloatArray
    information: FloatArray


def candidates(
    model: PlannedModel,
    noise: SensorDensities,
    omega: FloatArray,
    directions: ComplexArray,
    displacement_share: float = 0.0,
    stroke: float = 1.0,
) -> Candidates:
    """All *directions* (n_direction, n_dof) [1] on all lines omega (n_line,) [rad/s].

    A mean square of 1 N^2 costs (1 - a) + a |H u|^2 / stroke^2, a = *displacement_share* [1], *stroke* [m/N]:
    the limit of displacement over that of force. Equation (plan-cost).
    """
    line = np.repeat(np.arange(omega.size), len(directions))
    direction = np.tile(directions, (omega.size, 1))
    motion = np.einsum("lij,lj->li", model.receptance(omega)[line], direction)
    cost = (1 - displacement_share) + displacement_share * np.sum(np.abs(motion) ** 2, axis=1) / stroke**2
    # A mean square of 1 N^2 is an amplitude of sqrt(2) N.
    sensitivity = sensitivities(model, noise, omega[line], direction)
    information = 2 * vector_information(sensitivity, direction) / cost[:, None, None]
    return Candidates(line, direction, cost, information)


# Shares of the displacement in the cost of a line that are tried where it is limited.
DISPLACEMENT_SHARES = (0.0, 0.5, 1.0)
# Candidates that are looked at closely, of those that did best at a first look.
CLOSE = 3
CLOSE_STARTS = 2
# Phases of a flat multisine: as known, of least crest factor, or of least peak of force and displacement.
SCHROEDER, LEAST_CREST, BOTH_LIMITS = FLAT_PHASES = ("schroeder", "least crest", "both limits")
# Share of the power on all lines alike that is tried whatever floor is asked for.
USUAL_FLOOR = 0.2
# Steps towards shakers that do the same.
BALANCING = 5


@dataclass(frozen=True)
class Wanted:
    """*criterion*: minimax, A or D; goals (n_coefficient,) [1]: relative standard errors, infinite for
    coefficients that are not wanted. floor [1]: share of the cost on all lines alike, whatever the optimum
    is.
    """

    criterion: str
    goals: FloatArray
    floor: float = 0.2

    def __post_init__(self) -> None:
        if not 0 <= self.floor < 1:
            what = f"a floor of {100 * self.floor:g} % of the power leaves nothing to plan"
            raise SettingError("floor", what, "20 % is usual")
        if not np.any(np.isfinite(self.goals)):
            raise SettingError("goal", "no coefficient is wanted")


@dataclass(frozen=True)
class DesignStart:
    """A design on the shakers: where it comes from, and its power (n_line, n_shaker) [1] before scaling.
    floor [1]: share of the power that is on all lines alike.
    """

    criterion: str
    scheme: str
    certificate: DesignCertificate | None
    power: FloatArray
    floor: float


@dataclass(frozen=True)
class DesignCandidate(DesignStart):
    """A design with what it tells at the limits."""

    campaign: PlannedCampaign


def flat(rig: PlannedRig, lines: IntArray, scheme: str, phases: str = BOTH_LIMITS) -> PlannedCampaign:
    """Equal amplitudes on all lines (n_line,) [multiples] and shakers, equal times, with these *phases*."""
    tests = SCHEMES[scheme](lines, np.ones((lines.size, len(rig.shakers))), rig.shakers)
    if phases == SCHROEDER:
        tests = tuple(test.turn(schroeder_phases(test.lines)[:, None]) for test in tests)
    if phases == LEAST_CREST:
        alone = replace(rig, limits=replace(rig.limits, displacement=None))
        tests = tuple(enlarge_to_limits(alone, test, random_starts=CLOSE_STARTS) for test in tests)
    kind: Any = {"random_starts": CLOSE_STARTS, "optimised": phases == BOTH_LIMITS}
    return equal_times(rig, [enlarge_to_limits(rig, test, **kind) for test in tests])


def best(rig: PlannedRig, lines: IntArray, wanted: Wanted, schemes: Sequence[str]) -> DesignCandidate:
    """The design that tells most, of lines (n_line,) [multiples]. ConfigError where no crest factor fits."""

    def poor(candidate: DesignCandidate) -> float:
        return score(candidate.campaign.information, wanted.criterion, wanted.goals)

    def crest(candidate: DesignCandidate) -> float:
        return max(float(crest_factors(test).max()) for test in candidate.campaign.tests)

    looked = [_look(rig, lines, wanted, source, 0) for source in _sources(rig, lines, wanted, schemes)]
    looked.sort(key=poor)
    close = [_look(rig, lines, wanted, source, CLOSE_STARTS) for source in looked[:CLOSE]]
    limit = rig.limits.crest_factor
    if limit is not None:
        every = (*close, *looked)
        close = [candidate for candidate in every if crest(candidate) <= limit]
        if not close:
            hint = f"the lowest reached is {min(map(crest, every)):.2f}; allow that, or a larger floor"
            raise SettingError("crest_factor", f"no design has a crest factor of {limit:g} or less", hint)
    return min(close, key=poor)


def reference(rig: PlannedRig, lines: IntArray, wanted: Wanted) -> Design:
    """The optimum on lines (n_line,) [multiples] at equal mean square force, floor included."""
    return _design(_candidates(rig, lines, 0.0), wanted, wanted.criterion, wanted.floor)


def _candidates(rig: PlannedRig, lines: IntArray, share: float) -> Candidates:
    """All lines and shakers at a displacement's *share* [1] in the cost, with what is known before."""
    stroke = (rig.limits.displacement or 1.0) / rig.limits.force
    omega = 2 * np.pi * rig.spacing * lines
    of_lines = candidates(rig.model, rig.noise, omega, rig.directions, share, stroke)
    if rig.earlier is None:
        return of_lines
    tests = flat(rig, lines, ONE_BY_ONE, LEAST_CREST).tests
    price = of_lines.cost.reshape(lines.size, -1)
    costs = [np.sum(price[np.isin(lines, test.lines)] * np.abs(test.forces) ** 2 / 2) for test in tests]
    return replace(of_lines, information=of_lines.information + rig.known_rate / float(np.mean(costs)))


def _design(pool: Candidates, wanted: Wanted, criterion: str, floor: float) -> Design:
    which = np.isfinite(wanted.goals)
    weight = 1 / np.where(which, wanted.goals, 1.0)
    least = floor * pool.cost / pool.cost.sum()
    information = pool.information / np.outer(weight, weight)
    return optimum(criterion, information, np.eye(which.size)[which], least)


def _balance(pool: Candidates, wanted: Wanted, criterion: str, floor: float, n_shaker: int) -> Design:
    """The optimum for shakers at once: the price of a shaker's force rises until all do the same."""
    price = np.ones(n_shaker)
    shaker = np.arange(pool.line.size) % n_shaker
    for _ in range(BALANCING):
        factor = price[shaker]
        information = pool.information / factor[:, None, None]
        priced = replace(pool, cost=pool.cost * factor, information=information)
        design = _design(priced, wanted, criterion, floor)
        done = np.bincount(shaker, design.shares / factor)
        price *= np.sqrt(np.maximum(done, 1e-3 * done.max()))
        price /= price.mean()
    return replace(design, shares=design.shares / factor)


def _sources(
    rig: PlannedRig, lines: IntArray, wanted: Wanted, schemes: Sequence[str]
) -> Iterator[DesignStart]:
    limited = rig.limits.displacement is not None
    at_once = [scheme for scheme in schemes if scheme != ONE_BY_ONE]
    for share in DISPLACEMENT_SHARES if limited else (0.0,):
        choices = _candidates(rig, lines, share)
        for criterion in CRITERIA:
            # Many lines have a lower peak than the few of an optimum, which can tell more at the limits.
            more = max(wanted.floor, USUAL_FLOOR), min(2 * max(wanted.floor, USUAL_FLOOR), 0.9)
            for floor in sorted({wanted.floor, *(more if criterion == wanted.criterion else ())}):
                if ONE_BY_ONE in schemes:
                    design = _design(choices, wanted, criterion, floor)
                    source = design.certificate, _power(choices, design, lines), floor
                    yield DesignStart(criterion, ONE_BY_ONE, *source)
                if at_once:
                    design = _balance(choices, wanted, criterion, floor, len(rig.shakers))
                    source = design.certificate, _power(choices, design, lines), floor
                    yield from (DesignStart(criterion, name, *source) for name in at_once)
    for scheme in schemes:
        yield DesignStart("flat", scheme, None, np.ones((lines.size, len(rig.shakers))), wanted.floor)


def _power(pool: Candidates, design: Design, lines: IntArray) -> FloatArray:
    return (design.shares / pool.cost).reshape(lines.size, -1)


def _look(
    rig: PlannedRig, lines: IntArray, wanted: Wanted, source: DesignStart, random_starts: int
) -> DesignCandidate:
    tests: tuple[Multisines, ...] = SCHEMES[source.scheme](lines, source.power, rig.shakers)
    large = [enlarge_to_limits(rig, test, random_starts=random_starts) for test in tests]
    told = campaign(rig, large, wanted.criterion, wanted.goals)
    return DesignCandidate(**vars(source) | {"campaign": told})


def schemes_of(n_shaker: int, wanted: str) -> tuple[str, ...]:
    """The schemes to try for a wanted one, or `best`; a single shaker knows one."""
    if n_shaker < 2:
        return (ONE_BY_ONE,)
    return tuple(SCHEMES) if wanted == "best" else (wanted,)

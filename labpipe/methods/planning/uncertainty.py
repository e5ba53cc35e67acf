"""What is expected of a rig, and predicted uncertainty budgets: a planned test rehearsed, and what
systematic sources add to its noise.

Channel c has in period p of P, beside its signal, a_c / sqrt(P - 1) sum_m exp(2 pi j (m p / P + m c / (P -
1))) on every line, m from 1 to P - 1. Over the periods these have the mean zero and are orthogonal to each
other, so that the average is what the rig does, and its covariance by the scatter, a_c^2 / (P - 1), that of
white noise in every sensor; and all m are alike, as of noise that does not go on from period to period.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np
from scipy import fft

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.display import difference_in, per_cent, shown_unit
from labpipe.distributions import coverage_factor
from labpipe.errors import SettingError
from labpipe.methods.planning import campaigns
from labpipe.methods.planning.model import (
    UNITS,
    PlannedModel,
    SensorDensities,
    relative_errors,
    sensitivities,
)
from labpipe.methods.planning.records import PlannedCoefficient
from labpipe.methods.planning.settings import EXPANDED, PlanSettings
from labpipe.raw_files.excitation import peaks
from labpipe.records.finding import Contribution
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.uncertain import Budget, Uncertainty
from labpipe.registry import nearest

# Singular values below this share of the largest count as zero, columns scaled to unit length.
SINGULAR = 1e-9
# Shares of a coefficient in what is not determined below this count as none.
INVOLVED = 1e-6
# Distance of another line, as a share of the frequency, where no neighbour is known.
OTHER = 0.25


@dataclass(frozen=True)
class ForceVectors:
    """Force vectors (n_vector, n_dof) [N] at frequencies (n_vector,) [Hz]."""

    frequency: FloatArray
    forces: ComplexArray


@dataclass(frozen=True)
class Identifiability:
    """*rank* of what an excitation tells of *n_coefficient* coefficients; *undetermined*: names of those it
    does not determine.

    *remedies*: single changes each of which makes the rank full, the smallest first.
    """

    rank: int
    n_coefficient: int
    undetermined: tuple[str, ...]
    remedies: tuple[str, ...] = ()

    @property
    def full(self) -> bool:
        return self.rank == self.n_coefficient

    @property
    def words(self) -> str:
        text = f"the excitation determines {self.rank} of {self.n_coefficient} coefficients"
        return f"{text}; not told apart: {', '.join(self.undetermined)}"

    @property
    def remedy(self) -> str:
        none = "no single change helps: another direction and more lines"
        return f"{' or '.join(self.remedies)} would determine all" if self.remedies else none


def identifiability(model: PlannedModel, noise: SensorDensities, excitation: ForceVectors) -> Identifiability:
    """Rank of what the excitation tells of the model's coefficients, in the expected state of the rig, with
    remedies tried out. Equation (plan-rank).
    """
    ranked = _rank(model, noise, excitation)
    if ranked.full:
        return ranked
    changes = _changes(model, excitation)
    remedies = tuple(words for words, changed, other in changes if _rank(changed, noise, other).full)
    return replace(ranked, remedies=remedies)


def _rank(model: PlannedModel, noise: SensorDensities, excitation: ForceVectors) -> Identifiability:
    sensitivity = sensitivities(model, noise, 2 * np.pi * excitation.frequency)
    change = np.einsum("lnij,lj->lin", sensitivity, excitation.forces).reshape(-1, len(model.names))
    rows = np.concatenate([change.real, change.imag])
    length = np.linalg.norm(rows, axis=0)
    # A column of zeros stays one: scaling would hide a coefficient without any information.
    determined = length > SINGULAR * length.max()
    scaled = rows / np.where(determined, length, 1.0) * determined
    _, singular, right = np.linalg.svd(scaled, full_matrices=True)
    rank = int(np.count_nonzero(singular > SINGULAR * singular[0]))
    involved = np.any(np.abs(right[rank:]) > INVOLVED, axis=0)
    return Identifiability(rank, len(model.names), tuple(compress(model.names, involved)))


def _changes(
    model: PlannedModel, excitation: ForceVectors
) -> Iterator[tuple[str, PlannedModel, ForceVectors]]:
    if UNITS["m"] in model.units:
        yield "a known mass", model.with_known_mass(), excitation
    frequency, forces = excitation.frequency, excitation.forces
    lines = np.unique(frequency)
    another = lines[-1] + (lines[-1] - lines[-2]) if lines.size > 1 else lines[0] * (1 + OTHER)
    more = ForceVectors(np.append(frequency, another), np.concatenate([forces, forces[:1]]))
    yield "another line", model, more
    if model.n_dof == 2:
        across = np.stack([-forces[:, 1].conj(), forces[:, 0].conj()], axis=1)
        both = ForceVectors(np.tile(frequency, 2), np.concatenate([forces, across]))
        yield "a second direction of force", model, both


DRAWS = 200
SEED = 1
# The middle share of the draws that ranges hold.
MIDDLE = 0.95
# At an end of the range: gain below this share of the predicted, errors above so many times theirs.
LEAST_GAIN, MOST_ERROR = 0.8, 1.25


@dataclass(frozen=True)
class Earlier:
    """The uncertainties of an earlier result of coefficients *names* (n,).

    noise (n, n) [squared SI units]: covariance by noise; sources: names of its systematic errors, changes
    (n_source, n) [SI units] of the coefficients by one standard uncertainty of each.
    """

    names: tuple[str, ...]
    noise: FloatArray
    sources: tuple[str, ...] = ()
    changes: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def covariance(self, without: Sequence[str] = ()) -> FloatArray:
        """(n, n) [squared SI units] of noise and systematic errors, those *without* left out."""
        rows = [row for source, row in zip(self.sources, self.changes, strict=True) if source not in without]
        return self.noise + sum((np.outer(row, row) for row in rows), np.zeros_like(self.noise))

    def places(self, model: PlannedModel) -> list[tuple[int, int]]:
        """Numbers of the coefficients of a model with theirs here."""
        shared = [name for name in self.names if name in model.names]
        return [(model.names.index(name), self.names.index(name)) for name in shared]

    def covariance_of(self, model: PlannedModel, without: Sequence[str] = ()) -> FloatArray:
        """(n_coefficient, n_coefficient) [squared SI units] of a model's coefficients, of typed ones zero."""
        whole = np.zeros((len(model.names),) * 2)
        there, here = np.array(self.places(model), int).reshape(-1, 2).T
        whole[np.ix_(there, there)] = self.covariance(without)[np.ix_(here, here)]
        return whole

    def information_beside(
        self, model: PlannedModel, duration: float, common: Sequence[str] = ()
    ) -> campaigns.EarlierInformation:
        """What counts beside a test of *duration* [s]; *common*: sources of errors that the new test has as
        well, which add no uncertainty here. ConfigError where the result states no errors.
        """
        covariance = self.covariance_of(model, common)
        there = [number for number, _ in self.places(model)]
        part = covariance[np.ix_(there, there)]
        if not there or not np.all(np.isfinite(part)) or np.any(np.diagonal(part) <= 0):
            what = "the earlier result states no errors of its coefficients"
            raise SettingError("combine_earlier", what, "combine_earlier: false")
        root = np.sqrt(np.diagonal(part))
        information = np.zeros_like(covariance)
        size = np.outer(root, root)
        information[np.ix_(there, there)] = np.linalg.pinv(part / size, hermitian=True) / size
        return campaigns.EarlierInformation(information * np.outer(model.scales, model.scales), duration)


@dataclass(frozen=True)
class Expected:
    """Expected coefficients by name [SI], and the uncertainty of those that an earlier result gives."""

    values: Mapping[str, float]
    earlier: Earlier | None = None


@dataclass(frozen=True)
class Spread:
    """Ends of the middle of the draws: errors (2, n_coefficient) [1], relative to the expected scales, and
    gain (2,) [1].

    met [1]: share of draws in which all goals are met. peak [1]: upper end of the largest signal over its
    limit.
    """

    errors: FloatArray
    gain: FloatArray
    met: float
    peak: float


def spread(
    rig: campaigns.PlannedRig,
    planned: campaigns.PlannedCampaign,
    flat: campaigns.PlannedCampaign,
    covariance: FloatArray,
    limits: FloatArray,
    criterion: str,
    duration: float,
) -> Spread:
    """The prediction over draws of the coefficients from their *covariance* (n, n) [squared SI units].

    limits (n,) [1]: relative standard errors that meet the goals, infinite for none; *flat*: the test that
    the gain refers to.
    """
    rng = np.random.default_rng(SEED)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = rig.model.expected + rng.normal(size=(DRAWS, len(covariance))) @ root.T
    errors, gains, over = [], [], []
    for drawn in draws:
        truth = replace(rig, model=rig.model.with_values(drawn))
        planned_rate, other = (_rate(rig, truth, campaign) + rig.known_rate for campaign in (planned, flat))
        errors.append(relative_errors(planned_rate * duration))
        poor = campaigns.score(planned_rate, criterion, limits)
        gains.append(campaigns.score(other, criterion, limits) / poor if np.isfinite(poor) else 0.0)
        signals = ((test.lines, truth.amplitudes_over_limits(test).sum(axis=1)) for test in planned.tests)
        over.append(max(float(peaks(*signal).max()) for signal in signals))
    ends = [(1 - MIDDLE) / 2, (1 + MIDDLE) / 2]
    met = float(np.mean(np.all(np.array(errors) <= limits, axis=1)))
    # An end is the value of a draw: between an infinite one and another there is none.
    middle = [np.quantile(np.array(of_draws), ends, axis=0, method="nearest") for of_draws in (errors, gains)]
    return Spread(middle[0], middle[1], met, float(np.quantile(over, ends[1], method="nearest")))


def _rate(
    rig: campaigns.PlannedRig, truth: campaigns.PlannedRig, campaign: campaigns.PlannedCampaign
) -> FloatArray:
    """What a campaign tells per second on the rig as it is, (n, n) [1/s], relative to the expected scales."""
    ratio = rig.model.scales / truth.model.scales
    rate = campaigns.with_shares(truth, campaign.tests, campaign.shares).rate
    return rate * np.outer(ratio, ratio)


def spread_notes(drawn: Spread, predicted: FloatArray, gain: float, with_goals: bool) -> tuple[str, ...]:
    """What an unsure expectation means for *predicted* errors (n,) [1] and the *gain* [1] over flat."""
    notes = []
    low, high = drawn.gain
    if low < LEAST_GAIN * gain or np.any(drawn.errors[1] > MOST_ERROR * predicted):
        notes.append(
            "The earlier result does not know the rig well enough for this plan: over draws from its "
            f"covariance the gain is {low:.2g} to {high:.2g}, where {gain:.2g} is predicted. Spend a fifth "
            "of the time on a flat multisine, and plan the rest from its result."
        )
    if with_goals and drawn.met < 1:
        share = f"{100 * drawn.met:.0f} % of the draws"
        notes.append(f"All goals are met in {share} from the earlier result's covariance.")
    if drawn.peak > 1 + 1e-6 and not np.isclose(drawn.peak, 1.0, rtol=0.01):
        beyond = f"a signal exceeds its limit by {100 * (drawn.peak - 1):.0f} % or more"
        notes.append(f"In 2.5 % of the draws {beyond}: raise the level step by step.")
    return tuple(notes)


# Periods beyond the number of channels: degrees of freedom of their covariance.
SPARE = 4
# Samples per period over the highest line.
SAMPLES = 2.6


def rehearse(
    rig: campaigns.PlannedRig,
    test: campaigns.Multisines,
    channels: Sequence[Channel],
    seconds: float,
    skip: int,
    highest: int,
) -> Recording:
    """The recording of *test* by *channels*, its noise that of an average over *seconds* [s], after *skip*
    periods that are dropped.

    highest: line of all tests, which have one sampling rate. ConfigError for a response whose noise the plan
    does not state.
    """
    mean = np.stack([_amplitudes(rig, test, channel) for channel in channels], axis=1)
    n_period, n_channel = len(channels) + SPARE, len(channels)
    n_sample = fft.next_fast_len(int(SAMPLES * highest) + 8, real=True)
    densities = np.array([getattr(rig.noise, channel.quantity) for channel in channels])
    size = densities * np.sqrt(2 / seconds * (n_period - 1))
    turns = np.arange(1, n_period)
    courses = np.exp(2j * np.pi / n_period * np.outer(np.arange(n_period), turns)) @ np.exp(
        2j * np.pi / (n_period - 1) * np.outer(turns, np.arange(n_channel))
    )
    periods = []
    for course in courses / np.sqrt(n_period - 1):
        spectrum = np.zeros((n_sample // 2 + 1, n_channel), complex)
        spectrum[test.lines] = mean
        spectrum[1 : (n_sample + 1) // 2] += size * course
        periods.append(fft.irfft(spectrum * (n_sample / 2), n_sample, axis=0))
    samples = np.concatenate([periods[0]] * skip + periods)
    return Recording(tuple(channels), samples, n_sample * rig.spacing, test.name)


def _amplitudes(rig: campaigns.PlannedRig, test: campaigns.Multisines, channel: Channel) -> ComplexArray:
    if channel.quantity == "force":
        shaker = rig.shakers.index(channel.dof) if channel.dof in rig.shakers else 0
        return test.forces[:, shaker]
    along = rig.motion(test) @ _direction(channel, rig.model.n_dof)
    if channel.quantity == "displacement":
        return along
    if channel.quantity == "acceleration":
        return -(rig.omega(test) ** 2) * along
    what = f"the plan states no noise of {channel.name}, a {channel.quantity}"
    raise SettingError("rig", what, "displacement or acceleration")


def _direction(channel: Channel, n_dof: int) -> ComplexArray:
    if n_dof == 1:
        return np.ones(1, complex)
    angle = AXIS_ANGLES[channel.dof] if channel.angle is None else channel.angle
    return np.array([np.cos(angle), np.sin(angle)], complex)


COVERAGE = 0.95
# Systematic share of the variance where measuring longer gains less than a tenth of the uncertainty.
LASTING = 0.81
# Share of the variance that a goal leaves to noise, at least, where a source is to be calibrated for it.
FOR_NOISE = 0.1

# From tests with their whole periods to the budget of their evaluation; None where nothing is uncertain.
Rehearse = Callable[[campaigns.PlannedRig, Sequence[campaigns.Multisines], Sequence[int]], Budget | None]


@dataclass(frozen=True)
class Goals:
    """Relative standard errors by noise and relative expanded uncertainties that are wanted, (n_coefficient,)
    [1] each; infinite: none.
    """

    random: FloatArray
    expanded: FloatArray

    @property
    def any(self) -> bool:
        return bool(np.any(np.isfinite(self.random) | np.isfinite(self.expanded)))


def goals_of(settings: PlanSettings, model: PlannedModel) -> Goals:
    """Those of the settings; ConfigError for a coefficient that the model does not have."""
    goals = {kind: np.full(len(model.names), np.inf) for kind in (False, True)}
    for name, (value,) in settings.goal:
        coefficient = name.removesuffix(EXPANDED)
        if coefficient not in model.names:
            what = f"the model has no coefficient {coefficient}"
            raise SettingError("goal", what, nearest(coefficient, model.names))
        goals[name.endswith(EXPANDED)][model.names.index(coefficient)] = value
    return Goals(goals[False], goals[True])


def limits(goals: Goals, budget: Budget | None, scales: FloatArray) -> FloatArray:
    """Relative standard errors by noise (n_coefficient,) [1] that meet all goals beside the systematic part;
    zero where none does.

    scales (n_coefficient,) [units of the coefficients]: what errors are relative to. Equation (plan-limits).
    """
    if not goals.any:
        return np.ones(len(scales))
    systematic = np.zeros(len(scales)) if budget is None else budget.systematic / scales
    allowed = goals.expanded / factors(budget, len(scales))
    with np.errstate(invalid="ignore"):
        left = np.where(np.isfinite(allowed), np.sqrt(np.maximum(allowed**2 - systematic**2, 0.0)), np.inf)
    return np.minimum(goals.random, left)


def factors(budget: Budget | None, n: int) -> FloatArray:
    """Coverage factors (n_coefficient,) [1] by effective degrees of freedom, infinite without a budget."""
    dofs = np.full(n, np.inf) if budget is None else budget.dof
    return np.array([coverage_factor(COVERAGE, float(dof)) for dof in dofs])


def aims(allowed: FloatArray, goals: Goals) -> FloatArray:
    """What a design aims at (n_coefficient,) [1]: the limits, or a tenth of a goal that none meets."""
    return np.where(allowed > 0, allowed, goals.expanded / 10)


def combine_with_earlier(
    budget: Budget,
    earlier: Earlier,
    campaign: campaigns.PlannedCampaign,
    model: PlannedModel,
    duration: float,
) -> Budget:
    """The budget of a test of *duration* [s] and the earlier result together. Equation (plan-beside)."""
    assert campaign.earlier is not None
    information, scales = campaign.rate * duration, model.scales
    weight = np.linalg.inv(information + campaign.earlier.information)
    places = earlier.places(model)
    changes = []
    for source, change in zip(budget.sources, budget.changes, strict=True):
        pulled = information @ (change / scales)
        if source.source in earlier.sources:
            before = np.zeros(len(scales))
            for there, here in places:
                before[there] = earlier.changes[earlier.sources.index(source.source), here]
            pulled = pulled + campaign.earlier.information @ (before / scales)
        changes.append(scales * (weight @ pulled))
    return replace(budget, changes=np.array(changes))


def with_uncertainty(
    coefficients: Sequence[PlannedCoefficient], budget: Budget
) -> tuple[PlannedCoefficient, ...]:
    """The coefficients with relative systematic, combined and expanded uncertainty, shares of sources."""
    of_all = factors(budget, len(coefficients))
    columns = zip(coefficients, budget.systematic, budget.combined, of_all, strict=True)
    return tuple(
        replace(
            c,
            systematic=float(systematic / c.scale),
            combined=float(combined / c.scale),
            coverage_factor=float(factor),
            expanded=float(factor * combined / c.scale),
            budget=tuple(
                Contribution(source, float(np.sqrt(share) * combined / c.scale), share)
                for source, share in budget.shares(c.name).items()
            ),
        )
        for c, systematic, combined, factor in columns
    )


def lasting_notes(coefficients: Sequence[PlannedCoefficient]) -> Iterator[str]:
    """Where longer measuring hardly helps, and which source it is."""
    by_source: dict[str, list[str]] = {}
    for c in coefficients:
        if c.systematic is not None and c.combined and (c.systematic / c.combined) ** 2 > LASTING:
            largest = max((part for part in c.budget if part.source != "noise"), key=lambda part: part.share)
            by_source.setdefault(largest.source, []).append(f"{c.name} ({100 * largest.share:.0f} %)")
    for source, names in by_source.items():
        share = f"the share in brackets of the variance is that of {source}"
        yield f"Longer measuring hardly helps {', '.join(names)}: {share}."


def unreachable(goals: Goals, allowed: FloatArray) -> BoolArray:
    """Coefficients (n_coefficient,) whose goal no time meets; *allowed* (n_coefficient,) [1]: `limits`."""
    return np.isfinite(goals.expanded) & (allowed <= 0)


def calibration_notes(goals: Goals, budget: Budget, random: FloatArray, scales: FloatArray) -> Iterator[str]:
    """For every goal that no time meets, which source must be known how well; *random* (n,) [units]."""
    allowed = scales * goals.expanded / factors(budget, len(scales))
    for number in np.flatnonzero(unreachable(goals, limits(goals, budget, scales))):
        name, changes = budget.names[number], np.abs(budget.changes[:, number])
        noise = min(random[number] ** 2, (1 - FOR_NOISE) * allowed[number] ** 2)
        left = float(max(allowed[number] ** 2 - noise, FOR_NOISE * allowed[number] ** 2))
        largest = int(changes.argmax())
        rest = left - float(np.sum(np.delete(changes, largest) ** 2))
        what = f"{name} to {per_cent(goals.expanded[number])} expanded is not met however long one measures"
        if rest > 0:
            source = budget.sources[largest]
            now, then = (_size(source, share) for share in (1.0, float(np.sqrt(rest)) / changes[largest]))
            yield f"{what}: {source.source} is known to {now} and must be known to {then}."
        else:
            share = float(np.sqrt(left / np.sum(changes**2)))
            yield f"{what}: {_listing(budget, changes)} must all be known {1 / share:.2g} times better."


def _listing(budget: Budget, changes: FloatArray) -> str:
    order = np.argsort(-changes)
    count = int(np.searchsorted(np.cumsum(changes[order] ** 2), 0.95 * np.sum(changes**2))) + 1
    return ", ".join(budget.sources[number].source for number in order[:count])


def _size(source: Uncertainty, share: float) -> str:
    """A standard uncertainty times a share, relative in per cent; below one rounded down."""
    size = source.std_error * share
    unit = "%" if source.unit == "1" else shown_unit(source.unit, size)
    shown = 100 * size if unit == "%" else difference_in(size, unit)
    digit = 10.0 ** (np.floor(np.log10(shown)) - 1)
    rounded = np.floor(shown / digit + (1e-9 if share < 1 else 0.5)) * digit
    return f"{rounded:.2g} {unit}"

"""What is expected of a rig, how sure that is, and whether an excitation determines all coefficients.

Where it is to be combined with the new test, its information V^-1 adds to that of the new one: the errors of
both are those of (V^-1 + I)^-1. And the new test runs on the rig as it is, not as it was expected: its errors
are those at coefficients drawn from V about the expected ones, the planned forces being applied all the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.methods.planning.campaigns import Campaign, EarlierInformation, Rig, score, with_shares
from labpipe.methods.planning.model import Noise, PlannedModel, relative_errors, sensitivities
from labpipe.raw_files.excitation import peaks

# Singular values below this share of the largest count as zero, columns scaled to unit length.
SINGULAR = 1e-9
# Shares of a coefficient in what is not determined below this count as none.
INVOLVED = 1e-6
# Distance of another line, as a share of the frequency, where no neighbour is known.
OTHER = 0.25


@dataclass(frozen=True)
class Excitation:
    """Force vectors (n_vector, n_dof) [N] at frequencies (n_vector,) [Hz]."""

    frequency: FloatArray
    forces: ComplexArray

    @classmethod
    def of_directions(cls, frequency: FloatArray, directions: ComplexArray) -> Excitation:
        """Each of *directions* (n_direction, n_dof) [1] on every *frequency* (n_line,) [Hz], in tests of
        their own.
        """
        return cls(np.repeat(frequency, len(directions)), np.tile(directions, (frequency.size, 1)))


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
        if self.full:
            return f"the excitation determines all {self.n_coefficient} coefficients"
        return (
            f"the excitation determines {self.rank} of {self.n_coefficient} coefficients; not told "
            f"apart: {', '.join(self.undetermined)}"
        )

    @property
    def remedy(self) -> str:
        return (
            f"{' or '.join(self.remedies)} would determine all"
            if self.remedies
            else "no single change helps: another direction and more lines"
        )


def identifiability(model: PlannedModel, noise: Noise, excitation: Excitation) -> Identifiability:
    """Rank of what the excitation tells of the model's coefficients, in the expected state of the rig, with
    remedies tried out.

    Equation (plan-rank).
    """
    ranked = _ranked(model, noise, excitation)
    if ranked.full:
        return ranked
    remedies = tuple(
        words for words, changed, other in _changes(model, excitation) if _ranked(changed, noise, other).full
    )
    return Identifiability(ranked.rank, ranked.n_coefficient, ranked.undetermined, remedies)


def _ranked(model: PlannedModel, noise: Noise, excitation: Excitation) -> Identifiability:
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
    return Identifiability(
        rank, len(model.names), tuple(name for name, part in zip(model.names, involved, strict=True) if part)
    )


def _changes(model: PlannedModel, excitation: Excitation) -> Iterator[tuple[str, PlannedModel, Excitation]]:
    """Single changes of model or test, in words: the smallest first."""
    if any(name.startswith("m") for name in model.names):
        yield "a known mass", model.with_known_mass(), excitation
    lines = np.unique(excitation.frequency)
    another = lines[-1] + (lines[-1] - lines[-2]) if lines.size > 1 else lines[0] * (1 + OTHER)
    first = excitation.forces[:1]
    yield (
        "another line",
        model,
        Excitation(np.append(excitation.frequency, another), np.concatenate([excitation.forces, first])),
    )
    if model.n_dof == 2:
        across = np.stack([-excitation.forces[:, 1].conj(), excitation.forces[:, 0].conj()], axis=1)
        yield (
            "a second direction of force",
            model,
            Excitation(np.tile(excitation.frequency, 2), np.concatenate([excitation.forces, across])),
        )


# What is expected of a rig, how sure that is, and what this does to a plan.

DRAWS = 200
SEED = 1
# The middle share of the draws that ranges hold.
MIDDLE = 0.95
# A gain of less than this share of the predicted one, or errors of more than this times the predicted ones,
# at an end of their range.
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
        return np.asarray(self.noise + sum((np.outer(row, row) for row in rows), np.zeros_like(self.noise)))

    def places(self, model: PlannedModel) -> list[tuple[int, int]]:
        """Numbers of the coefficients of a model with theirs here."""
        known = [name for name in self.names if name in model.names]
        return [(model.names.index(name), self.names.index(name)) for name in known]

    def covariance_of(self, model: PlannedModel, without: Sequence[str] = ()) -> FloatArray:
        """(n_coefficient, n_coefficient) [squared SI units] of a model's coefficients.

        Zero for those that are typed.
        """
        whole = np.zeros((len(model.names),) * 2)
        there, here = np.array(self.places(model), int).reshape(-1, 2).T
        whole[np.ix_(there, there)] = self.covariance(without)[np.ix_(here, here)]
        return whole

    def known(self, model: PlannedModel, duration: float, common: Sequence[str] = ()) -> EarlierInformation:
        """What counts beside a test of *duration* [s]; *common*: sources of errors that the new test has as
        well, which add no uncertainty here.

        ConfigError where the result states no errors.
        """
        covariance = self.covariance_of(model, common)
        there = [number for number, _ in self.places(model)]
        part = covariance[np.ix_(there, there)]
        if not there or not np.all(np.isfinite(part)) or np.any(np.diagonal(part) <= 0):
            raise ConfigError(
                "the earlier result states no errors of its coefficients",
                hint="combine_earlier: false",
                field="combine_earlier",
            )
        root = np.sqrt(np.diagonal(part))
        information = np.zeros_like(covariance)
        information[np.ix_(there, there)] = np.linalg.pinv(
            part / np.outer(root, root), hermitian=True
        ) / np.outer(root, root)
        return EarlierInformation(information * np.outer(model.scales, model.scales), duration)


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
    rig: Rig,
    planned: Campaign,
    flat: Campaign,
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
    draws = (
        rig.model.expected
        + rng.normal(size=(DRAWS, len(covariance))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    )
    errors, gains, over = [], [], []
    for drawn in draws:
        truth = replace(rig, model=rig.model.with_expected(drawn))
        planned_rate, other = (_rate(rig, truth, campaign) + rig.known_rate for campaign in (planned, flat))
        errors.append(relative_errors(planned_rate * duration))
        poor = score(planned_rate, criterion, limits)
        gains.append(score(other, criterion, limits) / poor if np.isfinite(poor) else 0.0)
        over.append(
            max(float(peaks(test.lines, truth.over_limits(test).sum(axis=1)).max()) for test in planned.tests)
        )
    ends = [(1 - MIDDLE) / 2, (1 + MIDDLE) / 2]
    met = float(np.mean(np.all(np.array(errors) <= limits, axis=1)))
    # An end is the value of a draw: between an infinite one and another there is none.
    middle = [np.quantile(np.array(of_draws), ends, axis=0, method="nearest") for of_draws in (errors, gains)]
    return Spread(middle[0], middle[1], met, float(np.quantile(over, ends[1], method="nearest")))


def _rate(rig: Rig, truth: Rig, campaign: Campaign) -> FloatArray:
    """What a campaign tells per second on the rig as it is, (n, n) [1/s], relative to the expected scales."""
    ratio = rig.model.scales / truth.model.scales
    return np.asarray(with_shares(truth, campaign.tests, campaign.shares).rate * np.outer(ratio, ratio))


def spread_notes(found: Spread, predicted: FloatArray, gain: float, with_goals: bool) -> tuple[str, ...]:
    """What the uncertainty of the expectation means for the plan.

    *predicted* (n,) [1] errors, *gain* [1] over flat.
    """
    notes = []
    low, high = found.gain
    if low < LEAST_GAIN * gain or np.any(found.errors[1] > MOST_ERROR * predicted):
        notes.append(
            "The earlier result does not know the rig well enough for this plan: over draws from its "
            f"covariance the gain is {low:.2g} to {high:.2g}, where {gain:.2g} is predicted. Spend a fifth "
            "of the time on a flat multisine, and plan the rest from its result."
        )
    if with_goals and found.met < 1:
        notes.append(
            f"All goals are met in {100 * found.met:.0f} % of the draws from the earlier result's covariance."
        )
    if found.peak > 1 + 1e-6 and not np.isclose(found.peak, 1.0, rtol=0.01):
        notes.append(
            f"In 2.5 % of the draws a signal exceeds its limit by {100 * (found.peak - 1):.0f} % or more: "
            "raise the level step by step."
        )
    return tuple(notes)

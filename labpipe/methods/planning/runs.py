"""Which runs, and how many of each: exact designs of operating conditions within a time.

V. V. Fedorov 1972, Theory of Optimal Experiments, sec. 3.2: exchange of single runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.errors import FitError, SettingError
from labpipe.estimation.statistics import combination_text
from labpipe.methods.planning.designs import A, D, Design, certificate, optimum, variances
from labpipe.methods.planning.records import PlannedNumber, PlannedRun, RunPlan

# What makes the first runs comparable, before they determine all: this share of all information.
SLIGHT = 1e-9
MOST_EXCHANGES = 50
# Eigenvalues of information below this share of the largest are zero, parameters at unit diagonal.
SINGULAR = 1e-12
# Runs that a plan lists one by one, of the shortest kind.
MOST_RUNS = 10_000
# Factor of the time up to which goals are looked for.
LONGEST = 1e6


@dataclass(frozen=True)
class RunChoices:
    """Runs to choose from: *cost* (n_run,) [s], *information* (n_run, n, n) [1] of one run each, *prior* (n,
    n) [1] known before. settled (n,) [1]: parameters that the prior settles for good; none unless given.
    """

    cost: FloatArray
    information: FloatArray
    prior: FloatArray
    settled: BoolArray | None = None

    def of(self, counts: FloatArray | IntArray) -> FloatArray:
        """Information (n, n) [1] of numbers of runs (n_run,) [1], with what is known before."""
        return self.prior + np.tensordot(counts, self.information, 1)


@dataclass(frozen=True)
class RunDesign:
    """*counts* (n_run,) [1] of runs; information (n, n) [1] of all and before; shares (n_run,) [1] of the
    time at the optimum.

    efficiency [1]: the least that the counts have, by their variances, against any division of the same time,
    whole runs or not.
    """

    counts: IntArray
    information: FloatArray
    shares: FloatArray
    efficiency: float


def best_runs(criterion: str, choices: RunChoices, duration: float, wanted: FloatArray) -> RunDesign:
    """The best numbers of runs within *duration* [s] for combinations *wanted* (n_wanted, n) [1]; ConfigError
    where none or too many fit.

    FitError where no numbers of runs determine what is wanted. Equation (plan-runs).
    """
    shortest = float(choices.cost.min())
    if shortest > duration:
        hint = f"a duration of {shortest:.4g} s or more"
        raise SettingError("duration", f"no run fits into {duration:g} s", hint)
    if duration > MOST_RUNS * shortest:
        room = f"{duration:g} s have room for {duration / shortest:.3g} runs of {shortest:.3g} s"
        what = f"{room}; a plan lists {MOST_RUNS} at most"
        raise SettingError("duration", what, "a shorter duration, or longer runs")
    whole = choices.information * (duration / choices.cost)[:, None, None] + choices.prior
    separate = _separate(criterion, whole, choices, wanted)
    design = separate or optimum(criterion, whole, wanted)
    begun = np.floor(design.shares * duration / choices.cost + 1e-9).astype(int)
    if separate:
        begun = _require_one_each(choices, begun, duration)
    counts = _fill(criterion, choices, duration, wanted, begun)
    counts = _exchange(criterion, choices, duration, wanted, counts)
    information = choices.of(counts)
    value, best = _values(criterion, np.stack([information, design.information]), wanted)
    if not np.isfinite(value / best):
        raise FitError("no runs of that time determine what is wanted", hint="a longer duration")
    efficiency = min(design.certificate.efficiency / float(value / best), 1.0)
    return RunDesign(counts, information, design.shares, efficiency)


def _separate(criterion: str, whole: FloatArray, choices: RunChoices, wanted: FloatArray) -> Design | None:
    """The optimum among runs each of which tells of parameters of its own, *whole* (n_run, n, n) [1] in all
    the time.

    With the variances v of what is wanted of a run in all the time, its share goes as max v, as the root of
    sum v, or as its number of parameters: the Lagrange conditions of minimax, A and D.
    """
    determined = np.diagonal(choices.information, axis1=1, axis2=2) > 0
    owner = np.argmax(determined, axis=0)
    of_run = np.abs(wanted) @ determined.T > 0
    if (
        np.any(choices.prior)
        or np.any(determined.sum(axis=0) != 1)
        or np.any(of_run.sum(axis=1) != 1)
        or not np.all(of_run.any(axis=0))
    ):
        return None
    sizes = np.zeros(len(whole))
    for number, information in enumerate(whole):
        block = np.ix_(owner == number, owner == number)
        if np.linalg.matrix_rank(information[block], hermitian=True) < len(information[block]):
            return None
        v = variances(information[block], wanted[of_run[:, number]][:, owner == number])
        by_criterion = {D: len(information[block]), A: np.sqrt(v.sum())}
        sizes[number] = by_criterion.get(criterion, v.max())
    shares = sizes / sizes.sum()
    together = np.tensordot(shares, whole, 1)
    return Design(shares, together, certificate(criterion, whole, together, wanted))


def _require_one_each(choices: RunChoices, counts: IntArray, duration: float) -> IntArray:
    """The counts with one run of every kind at least, fewer of the most frequent where time is short."""
    counts = np.maximum(counts, 1)
    while float(counts @ choices.cost) > duration * (1 + 1e-9) and counts.max() > 1:
        counts[int(counts.argmax())] -= 1
    if float(counts @ choices.cost) > duration * (1 + 1e-9):
        kinds = f"{len(counts)} kinds of runs, each of which alone determines something"
        hint = f"a duration of {float(choices.cost.sum()):.4g} s or more"
        raise SettingError("duration", f"{kinds}, do not fit into {duration:g} s", hint)
    return np.asarray(counts)


def _fill(
    criterion: str, choices: RunChoices, duration: float, wanted: FloatArray, counts: IntArray
) -> IntArray:
    counts = counts.copy()
    slight = SLIGHT * choices.information.sum(axis=0)
    while True:
        left = duration * (1 + 1e-9) - float(counts @ choices.cost)
        fit = np.flatnonzero(choices.cost <= left)
        if fit.size == 0:
            return counts
        now = choices.of(counts) + slight
        before = _values(criterion, now[None], wanted)[0]
        gain = np.log(before / _values(criterion, now + choices.information[fit], wanted)) / choices.cost[fit]
        counts[fit[int(np.argmax(gain))]] += 1


def _exchange(
    criterion: str, choices: RunChoices, duration: float, wanted: FloatArray, counts: IntArray
) -> IntArray:
    value = _values(criterion, choices.of(counts)[None], wanted)[0]
    for _ in range(MOST_EXCHANGES):
        trials = []
        for number in np.flatnonzero(counts):
            fewer = counts.copy()
            fewer[number] -= 1
            trials.append(_fill(criterion, choices, duration, wanted, fewer))
        values = _values(criterion, np.stack([choices.of(trial) for trial in trials]), wanted)
        best = int(np.argmin(values))
        if not values[best] < value * (1 - 1e-9):
            break
        counts, value = trials[best], values[best]
    return counts


def _values(criterion: str, information: FloatArray, wanted: FloatArray) -> FloatArray:
    root = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    values = np.full(len(information), np.inf)
    regular = np.all(root > 0, axis=1)
    scaled = information[regular] / (root[regular, :, None] * root[regular, None, :])
    regular[regular] = np.linalg.eigvalsh(scaled)[:, 0] > SINGULAR
    if not np.any(regular):
        return values
    if criterion == D:
        values[regular] = np.exp(-np.linalg.slogdet(information[regular])[1] / information.shape[-1])
        return values
    v = np.stack([variances(of_run, wanted) for of_run in information[regular]])
    values[regular] = v.sum(axis=1) if criterion == A else v.max(axis=1)
    return values


def errors_after(choices: RunChoices, counts: FloatArray | IntArray, wanted: FloatArray) -> FloatArray:
    """Standard errors (n_wanted,) [1] of *wanted* (n_wanted, n) [1]; infinite where left open."""
    return _errors(choices.of(counts), wanted)


def lasting_errors(choices: RunChoices, wanted: FloatArray) -> FloatArray:
    """Standard errors (n_wanted,) [1] that no number of runs goes below: those known before."""
    unseen = undetermined_combinations(choices)
    if unseen.size == 0:
        return np.zeros(len(wanted))
    involved = wanted @ unseen
    errors = _errors(unseen.T @ choices.prior @ unseen, involved)
    return np.where(np.any(np.abs(involved) > 1e-6, axis=1), errors, 0.0)


def undetermined_combinations(choices: RunChoices) -> FloatArray:
    """Combinations (n, n_unseen) [1] of parameters of which no run tells anything."""
    n = len(choices.prior)
    free = np.arange(n) if choices.settled is None else np.flatnonzero(~choices.settled)
    total = np.einsum("a,aij->ij", 1 / choices.cost, choices.information)[np.ix_(free, free)]
    root = np.sqrt(np.diagonal(total))
    root = np.where(root > np.sqrt(SINGULAR) * root.max(), root, root.max())
    values, vectors = np.linalg.eigh(total / np.outer(root, root))
    unseen = np.zeros((n, int(np.count_nonzero(values <= SINGULAR * values[-1]))))
    unseen[free] = vectors[:, : unseen.shape[1]] / root[:, None]
    if unseen.shape[1]:
        pivots = linalg.qr(unseen.T, mode="r", pivoting=True)[1][: unseen.shape[1]]
        unseen = unseen @ np.linalg.inv(unseen[pivots])
    return unseen / np.linalg.norm(unseen, axis=0)


def _errors(information: FloatArray, wanted: FloatArray) -> FloatArray:
    root = np.sqrt(np.maximum(np.diagonal(information), 0))
    if np.any(root == 0):
        return np.full(len(wanted), np.inf)
    values, vectors = np.linalg.eigh(information / np.outer(root, root))
    parts = np.abs((wanted / root) @ vectors)
    poor = values <= SINGULAR * values[-1]
    left_open = np.any(parts[:, poor] > 1e-6 * np.linalg.norm(parts, axis=1, keepdims=True), axis=1)
    errors = np.sqrt(np.sum(parts[:, ~poor] ** 2 / values[~poor], axis=1))
    return np.where(left_open, np.inf, errors)


def time_for_goals(choices: RunChoices, counts: IntArray, wanted: FloatArray) -> float:
    """Factor [1] of the runs after which all errors of *wanted* (n_wanted, n) [1 / goal] are below 1."""
    return least_factor(-30.0, lambda factor: errors_after(choices, counts * factor, wanted).max() <= 1)


def least_factor(low: float, enough: Callable[[float], object]) -> float:
    """The least factor of a time that is *enough*, from exp(*low*) up to LONGEST; infinite beyond."""
    high = float(np.log(LONGEST))
    if not enough(LONGEST):
        return float("inf")
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(np.exp(middle)) else (middle, high)
    return float(np.exp(high))


@dataclass(frozen=True)
class RunQuantity:
    """A number that the runs tell: *row* (n,) [unit per parameter unit], its derivatives by the parameters;
    *goal* [unit], None for none. scale [unit]: what its errors are shown relative to, None for none.
    """

    name: str
    unit: str
    expected: float
    row: FloatArray
    goal: float | None = None
    scale: float | None = None


@dataclass(frozen=True)
class CandidateRun:
    """A candidate: one run of *seconds* [s] under *conditions* in words, its information (n, n) [1]."""

    name: str
    seconds: float
    conditions: tuple[tuple[str, str], ...]
    information: FloatArray


@dataclass(frozen=True)
class Change:
    """A change in *words*, of *size* single ones: the conditions then, and the parameters *settled*."""

    words: str
    size: int
    conditions: tuple[CandidateRun, ...]
    settled: tuple[str, ...] = ()


@dataclass(frozen=True)
class RunQuestion:
    """What is asked: *parameters* (n names), *prior* (n, n) [1] of what is known before, candidates, numbers
    wanted, time [s].

    units (n,) [parameter units]: sizes in which parameters are compared. settled: by the prior.
    remedies: changes, the smallest first, each tried before it is named.
    """

    parameters: tuple[str, ...]
    units: FloatArray
    prior: FloatArray
    conditions: tuple[CandidateRun, ...]
    quantities: tuple[RunQuantity, ...]
    duration: float
    criterion: str
    settled: tuple[str, ...] = ()
    remedies: tuple[Change, ...] = ()

    def choices(self, change: Change | None = None) -> RunChoices:
        """The conditions, or those after a *change*, as choices, parameters in their units."""
        conditions = self.conditions if change is None else change.conditions
        settled = (*self.settled, *(() if change is None else change.settled))
        cost = np.array([condition.seconds for condition in conditions])
        information = np.stack([condition.information for condition in conditions])
        size = np.outer(self.units, self.units)
        return RunChoices(cost, information * size, self.prior * size, np.isin(self.parameters, settled))


@dataclass(frozen=True)
class Answered:
    """The plan, and the covariance (n, n) [parameter units squared] after all planned runs."""

    plan: RunPlan
    covariance: FloatArray

    def add_notes(self, notes: Iterable[str]) -> Answered:
        return replace(self, plan=replace(self.plan, notes=(*self.plan.notes, *notes)))


def plan_runs(question: RunQuestion, title: str, model: str, notes: Sequence[str] = ()) -> Answered:
    """The best runs. ConfigError for goals that no number of them meets, FitError for none determined."""
    choices = question.choices()
    quantities = question.quantities
    aimed = [quantity for quantity in quantities if quantity.goal is not None] or list(quantities)
    rows = np.stack([quantity.row * question.units for quantity in quantities])
    pairs = [(row, quantity) for row, quantity in zip(rows, quantities, strict=True) if quantity in aimed]
    sizes = [quantity.goal or quantity.scale or float(np.abs(row).max()) or 1.0 for row, quantity in pairs]
    wanted = np.stack([row for row, _ in pairs]) / np.array(sizes)[:, None]
    _check_open(question, choices, aimed, wanted)
    design = best_runs(question.criterion, choices, question.duration, wanted)
    flat = question.duration / choices.cost / len(choices.cost)
    with_goals = any(quantity.goal is not None for quantity in quantities)
    factor = time_for_goals(choices, design.counts, wanted) if with_goals else 0.0
    spent = float(design.counts @ choices.cost)
    plan = RunPlan(
        title=title,
        model=model,
        criterion=question.criterion,
        duration=spent,
        efficiency=design.efficiency,
        gain=_gain(question.criterion, choices, design, flat, wanted),
        candidates=len(question.conditions),
        numbers=tuple(_numbers(quantities, rows, choices, design, flat)),
        runs=tuple(_runs(question.conditions, design)),
        needed=spent * factor if with_goals and np.isfinite(factor) else None,
        undetermined=_words(question.parameters, choices, question.units),
        remedies=_remedies(question),
        notes=tuple(notes),
    )
    return Answered(plan, np.linalg.inv(design.information) * np.outer(question.units, question.units))


def _check_open(
    question: RunQuestion, choices: RunChoices, aimed: Sequence[RunQuantity], wanted: FloatArray
) -> None:
    lasting = lasting_errors(choices, wanted)
    pairs = list(zip(aimed, lasting, strict=True))
    beyond = [quantity.name for quantity, error in pairs if quantity.goal is not None and error > 1]
    beyond += [quantity.name for quantity, error in pairs if not np.isfinite(error)]
    if not beyond:
        return
    never = f"they do not determine {', '.join(dict.fromkeys(beyond))} to the goal"
    unseen = "; ".join(_words(question.parameters, choices, question.units))
    what = f"however many runs there are, {never}: no run tells {unseen}"
    remedies = _remedies(question)
    hint = f"{' or '.join(remedies)} would determine all" if remedies else "another kind of run"
    raise SettingError("goal", what, hint)


def _words(names: Sequence[str], choices: RunChoices, units: FloatArray) -> tuple[str, ...]:
    return tuple(
        combination_text(names, direction * units) for direction in undetermined_combinations(choices).T
    )


def _remedies(question: RunQuestion) -> tuple[str, ...]:
    if undetermined_combinations(question.choices()).size == 0:
        return ()
    helpful: list[Change] = []
    for change in question.remedies:
        if helpful and change.size > helpful[-1].size:
            break
        helpful += [change] if undetermined_combinations(question.choices(change)).size == 0 else []
    return tuple(change.words for change in helpful)


def _gain(
    criterion: str, choices: RunChoices, design: RunDesign, flat: FloatArray, wanted: FloatArray
) -> float:
    """Error of an equal division over the design's: largest, root sum of squares, or volume's n-th root."""
    if criterion == D:
        levels = [float(np.linalg.slogdet(choices.of(counts))[1]) for counts in (design.counts, flat)]
        return float(np.exp((levels[0] - levels[1]) / (2 * len(choices.prior))))
    planned, other = (errors_after(choices, counts, wanted) for counts in (design.counts, flat))
    if criterion == A:
        return float(np.sqrt(np.sum(other**2) / np.sum(planned**2)))
    return float(other.max() / planned.max())


def _numbers(
    quantities: Sequence[RunQuantity],
    rows: FloatArray,
    choices: RunChoices,
    design: RunDesign,
    flat: FloatArray,
) -> list[PlannedNumber]:
    after, even = errors_after(choices, design.counts, rows), errors_after(choices, flat, rows)
    before, lasting = errors_after(choices, 0 * flat, rows), lasting_errors(choices, rows)
    return [
        PlannedNumber(
            quantity.name,
            quantity.unit,
            quantity.expected,
            error=_finite(after[number]),
            flat=_finite(even[number]),
            lasting=_finite(lasting[number]),
            before=_finite(before[number]),
            goal=quantity.goal,
            scale=quantity.scale,
        )
        for number, quantity in enumerate(quantities)
    ]


def _finite(error: float) -> float | None:
    return float(error) if np.isfinite(error) else None


def _runs(conditions: Sequence[CandidateRun], design: RunDesign) -> list[PlannedRun]:
    return [
        PlannedRun(condition.name, int(count), condition.seconds, float(share), condition.conditions)
        for condition, count, share in zip(conditions, design.counts, design.shares, strict=True)
        if count > 0
    ]

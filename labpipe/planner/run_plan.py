"""From candidates of runs, with what each tells, to planned runs and what they will tell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.identify.combinations import combination_text
from labpipe.planner.criteria import A, D
from labpipe.planner.runs import RunChoices, RunDesign, best_runs, errors_after, lasting_errors, time_for_goals, undetermined
from labpipe.records.run_plan import PlannedNumber, PlannedRun, RunPlan


@dataclass(frozen=True)
class Quantity:
    """A number that the runs tell: *row* (n,) [unit per parameter unit], its derivatives by the parameters; *goal* [unit], None for none.

    scale [unit]: what its errors are shown relative to, None for none.
    """

    name: str
    unit: str
    expected: float
    row: FloatArray
    goal: float | None = None
    scale: float | None = None


@dataclass(frozen=True)
class Condition:
    """A candidate: one run of *seconds* [s] under *conditions* in words, with its information (n, n) [1] of the parameters."""

    name: str
    seconds: float
    conditions: tuple[tuple[str, str], ...]
    information: FloatArray


@dataclass(frozen=True)
class Change:
    """A change in *words*, made of *size* single ones: the conditions there would be, and the parameters *known* then."""

    words: str
    size: int
    conditions: tuple[Condition, ...]
    known: tuple[str, ...] = ()


@dataclass(frozen=True)
class RunQuestion:
    """What is asked: *parameters* (n names), *prior* (n, n) [1] of what is known before, candidates, numbers wanted, time [s].

    units (n,) [parameter units]: sizes in which parameters are compared. known: those that the prior settles. remedies: changes, the
    smallest first, each tried before it is named.
    """

    parameters: tuple[str, ...]
    units: FloatArray
    prior: FloatArray
    conditions: tuple[Condition, ...]
    quantities: tuple[Quantity, ...]
    duration: float
    criterion: str
    known: tuple[str, ...] = ()
    remedies: tuple[Change, ...] = ()

    def choices(self) -> RunChoices:
        """The conditions as choices, parameters in their units."""
        return self._choices(self.conditions, self.known)

    def changed(self, change: Change) -> RunChoices:
        """The choices after a change."""
        return self._choices(change.conditions, (*self.known, *change.known))

    def _choices(self, conditions: Sequence[Condition], known: Sequence[str]) -> RunChoices:
        cost = np.array([condition.seconds for condition in conditions])
        information = np.stack([condition.information for condition in conditions])
        return RunChoices(cost, information, self.prior, np.isin(self.parameters, known)).in_units(self.units)


@dataclass(frozen=True)
class Answered:
    """The plan, and the covariance (n, n) [parameter units squared] of the parameters after all planned runs."""

    plan: RunPlan
    covariance: FloatArray

    def noted(self, notes: Iterable[str]) -> Answered:
        """With further notes."""
        return replace(self, plan=replace(self.plan, notes=(*self.plan.notes, *notes)))


def plan_runs(question: RunQuestion, title: str, model: str, notes: Sequence[str] = ()) -> Answered:
    """The best runs; ConfigError where none of the goals can be met by any number of them, FitError where nothing is determined."""
    choices = question.choices()
    quantities = question.quantities
    aimed = [quantity for quantity in quantities if quantity.goal is not None] or list(quantities)
    rows = _rows(quantities, question.units)
    wanted = np.stack([row / _size(quantity, row) for quantity, row in zip(quantities, rows, strict=True) if quantity in aimed])
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


def _rows(quantities: Sequence[Quantity], units: FloatArray) -> FloatArray:
    return np.stack([quantity.row * units for quantity in quantities])


def _size(quantity: Quantity, row: FloatArray) -> float:
    """What an error of a number is compared by [its unit]: its goal, else its scale, else its change by one unit of the parameters."""
    return quantity.goal or quantity.scale or float(np.abs(row).max()) or 1.0


def _check_open(question: RunQuestion, choices: RunChoices, aimed: Sequence[Quantity], wanted: FloatArray) -> None:
    """ConfigError where a number with a goal, or any number, stays open however many runs there are."""
    lasting = lasting_errors(choices, wanted)
    beyond = [
        quantity.name for quantity, error in zip(aimed, lasting, strict=True) if error > (1.0 if quantity.goal is not None else np.inf)
    ]
    beyond += [quantity.name for quantity, error in zip(aimed, lasting, strict=True) if not np.isfinite(error)]
    if not beyond:
        return
    unseen = "; ".join(_words(question.parameters, choices, question.units))
    what = f"however many runs there are, they do not determine {', '.join(dict.fromkeys(beyond))} to the goal: no run tells {unseen}"
    remedies = _remedies(question)
    hint = f"{' or '.join(remedies)} would determine all" if remedies else "another kind of run"
    raise ConfigError(what, hint=hint, field="goal")


def _words(names: Sequence[str], choices: RunChoices, units: FloatArray) -> tuple[str, ...]:
    """Combinations that no run tells, in words."""
    return tuple(combination_text(names, direction * units) for direction in undetermined(choices).T)


def _remedies(question: RunQuestion) -> tuple[str, ...]:
    """The smallest changes after which the runs, with what is known for certain, determine all parameters."""
    if undetermined(question.choices()).size == 0:
        return ()
    helpful: list[Change] = []
    for change in question.remedies:
        if helpful and change.size > helpful[-1].size:
            break
        helpful += [change] if undetermined(question.changed(change)).size == 0 else []
    return tuple(change.words for change in helpful)


def _gain(criterion: str, choices: RunChoices, design: RunDesign, flat: FloatArray, wanted: FloatArray) -> float:
    """Error of an equal division over that of the design: of the largest, the root of the sum of squares, or the volume's n-th root."""
    if criterion == D:
        levels = [float(np.linalg.slogdet(choices.of(counts))[1]) for counts in (design.counts, flat)]
        return float(np.exp((levels[0] - levels[1]) / (2 * len(choices.prior))))
    planned, other = (errors_after(choices, counts, wanted) for counts in (design.counts, flat))
    return float(np.sqrt(np.sum(other**2) / np.sum(planned**2)) if criterion == A else other.max() / planned.max())


def _numbers(
    quantities: Sequence[Quantity], rows: FloatArray, choices: RunChoices, design: RunDesign, flat: FloatArray
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


def _runs(conditions: Sequence[Condition], design: RunDesign) -> list[PlannedRun]:
    return [
        PlannedRun(condition.name, int(count), condition.seconds, float(share), condition.conditions)
        for condition, count, share in zip(conditions, design.counts, design.shares, strict=True)
        if count > 0
    ]

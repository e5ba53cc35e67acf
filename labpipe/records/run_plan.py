"""Planned runs: under which operating conditions a rig is to run, and what that will tell."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PlannedNumber:
    """What the runs will tell of a parameter or of a prediction made from them; errors are standard errors in *unit*.

    expected: its value; error: after all planned runs, flat: after the same time shared among all candidates alike; lasting: what no
    number of runs goes below; before: what is known without a run, None for nothing; goal: None for none. scale [unit]: what errors are
    shown relative to, None where they are shown as they are.
    """

    name: str
    unit: str
    expected: float
    error: float | None
    flat: float | None
    lasting: float | None = 0.0
    before: float | None = None
    goal: float | None = None
    scale: float | None = None


@dataclass(frozen=True)
class PlannedRun:
    """One condition: *count* runs of *seconds* each [s]; share [1] of the time at the optimum; conditions: name and text, in words."""

    name: str
    count: int
    seconds: float
    share: float
    conditions: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class RunPlan:
    """Planned runs and their prediction.

    duration [s]: that all runs take; efficiency [1]: the least that the counts have against any division of the time among the candidates;
    needed [s]: that meets all goals, None without goals or where no time does; gain [1]: of the criterion over an equal division.
    undetermined: in words, what no run of the candidates tells; remedies: single changes each of which makes all determined.
    """

    title: str
    model: str
    criterion: str
    duration: float
    efficiency: float
    gain: float
    candidates: int
    numbers: tuple[PlannedNumber, ...]
    runs: tuple[PlannedRun, ...]
    needed: float | None = None
    undetermined: tuple[str, ...] = ()
    remedies: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

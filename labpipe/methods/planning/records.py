"""A planned test, and planned runs: what is to be applied, and what it will tell."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.records.finding import Contribution


@dataclass(frozen=True)
class PlannedCoefficient:
    """A coefficient [SI *unit*] with its *expected* value and predicted standard errors, all relative to
    *scale*, its expected size.

    error: with the noise known; error_weighted: with weights from the scatter of the periods; flat: of a flat
    multisine of equal peak and time. goal: the relative error that is wanted, None for none. error_range: of
    *error* over draws from the covariance of an earlier result, None where what is expected has no
    uncertainty, or a draw leaves the coefficient undetermined. systematic: what numbers of the rig and the
    mass add, None without uncertainties; then there are the combined and the expanded uncertainty,
    coverage_factor times the former, and the *budget*, noise among the sources. goal_expanded: the relative
    expanded uncertainty that is wanted.
    """

    name: str
    unit: str
    expected: float
    scale: float
    error: float
    error_weighted: float
    flat: float
    goal: float | None = None
    error_range: tuple[float, float] | None = None
    goal_expanded: float | None = None
    systematic: float | None = None
    combined: float | None = None
    coverage_factor: float | None = None
    expanded: float | None = None
    budget: tuple[Contribution, ...] = ()


@dataclass(frozen=True)
class PlannedTest:
    """One run of the shakers: *periods* periods are used after *skip* are dropped.

    frequency (n_line,) [Hz]; amplitude and phase [N, rad]: by shaker, each (n_line,); crest_factor,
    peak_force [1, N] by shaker, also between samples; peak_displacement [m] by probe, from rest to rest;
    files: of the signals, by shaker.
    """

    name: str
    periods: int
    skip: int
    shakers: tuple[str, ...]
    files: tuple[str, ...]
    frequency: tuple[float, ...]
    amplitude: tuple[tuple[float, ...], ...]
    phase: tuple[tuple[float, ...], ...]
    crest_factor: tuple[float, ...]
    peak_force: tuple[float, ...]
    peak_displacement: tuple[float, ...]


@dataclass(frozen=True)
class Plan:
    """The planned tests and their prediction.

    period [s], sample_rate [Hz], duration [s] of all measured periods; needed [s]: duration that meets all
    goals, None without goals, or where none does; unreachable: coefficients whose goals none meets because of
    systematic errors; efficiency [1]: the least that the underlying design has against the best of its kind
    at equal mean square force; factor [1]: of the standard errors where weights come from the scatter of the
    periods; gain [1]: of the largest error over goal (or of all, without goals), by the flat multisine it is
    compared with: its name and the ratio; gain_range: of the one over least crest, over draws from the
    covariance of an earlier result. combined: whether that result counts beside the test.
    """

    title: str
    model: str
    criterion: str
    scheme: str
    design: str
    floor: float
    period: float
    sample_rate: float
    duration: float
    efficiency: float
    factor: float
    coefficients: tuple[PlannedCoefficient, ...]
    tests: tuple[PlannedTest, ...]
    gains: tuple[tuple[str, float], ...]
    needed: float | None = None
    mass: float | None = None
    notes: tuple[str, ...] = ()
    gain_range: tuple[float, float] | None = None
    combined: bool = False
    unreachable: tuple[str, ...] = ()

    @property
    def with_goals(self) -> bool:
        return any(c.goal is not None or c.goal_expanded is not None for c in self.coefficients)


@dataclass(frozen=True)
class PlannedNumber:
    """What the runs will tell of a parameter or of a prediction made from them; errors are standard errors in
    *unit*.

    expected: its value; error: after all planned runs, flat: after the same time shared among all candidates
    alike; lasting: what no number of runs goes below; before: what is known without a run, None for nothing;
    goal: None for none. scale [unit]: what errors are shown relative to, None where they are shown as they
    are.
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
    """One condition, in words: *count* runs of *seconds* [s] each; share [1] of the time at the optimum."""

    name: str
    count: int
    seconds: float
    share: float
    conditions: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class RunPlan:
    """Planned runs and their prediction.

    duration [s]: that all runs take; efficiency [1]: the least that the counts have against any division of
    the time among the candidates; needed [s]: that meets all goals, None without goals or where no time does;
    gain [1]: of the criterion over an equal division. undetermined: in words, what no run of the candidates
    tells; remedies: single changes each of which makes all determined.
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

"""Exact designs of runs: printed designs, all divisions counted out, and what stays open."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.methods.planning.designs import CRITERIA, optimum
from labpipe.methods.planning.runs import (
    CandidateRun,
    Change,
    RunChoices,
    RunQuantity,
    RunQuestion,
    best_runs,
    errors_after,
    lasting_errors,
    plan_runs,
    time_for_goals,
    undetermined_combinations,
)

# Quadratic regression y = a + b x + c x^2 at x = -1, -.5, 0, .5, 1.
X = np.linspace(-1, 1, 5)
ROWS = np.stack([np.ones(5), X, X**2], axis=1)
QUADRATIC = np.einsum("ai,aj->aij", ROWS, ROWS)
NOTHING = np.zeros((3, 3))


def test_extrapolation_of_a_line() -> None:
    # y = a + b x on [-1, 1], wanted at x = 2: Hoel and Levine 1964, shares |l_i(2)| of Lagrange's
    # polynomials: 3/4 at 1, 1/4 at -1; the variance is (3/2 + 1/2)^2 = 4.
    design = optimum("minimax", np.einsum("ai,aj->aij", ROWS[:, :2], ROWS[:, :2]), np.array([[1.0, 2.0]]))
    np.testing.assert_allclose(design.shares[[0, 4]], [0.25, 0.75], atol=2e-3)
    assert design.certificate.efficiency >= 0.999
    assert np.linalg.inv(design.information)[0] @ [1, 2] + 2 * (
        np.linalg.inv(design.information)[1] @ [1, 2]
    ) == pytest.approx(4, rel=1e-3)


@pytest.mark.parametrize(
    ("criterion", "runs", "counts"), [("D", 9, [3, 0, 3, 0, 3]), ("A", 8, [2, 0, 4, 0, 2])]
)
def test_quadratic_regression(criterion: str, runs: int, counts: list[int]) -> None:
    # Fedorov 1972, Theory of Optimal Experiments, sec. 2.2 and 2.9: thirds, and quarters with a half in the
    # middle.
    design = best_runs(criterion, RunChoices(np.ones(5), QUADRATIC, NOTHING), float(runs), np.eye(3))
    assert design.counts.tolist() == counts
    assert design.efficiency >= 0.999


@pytest.mark.parametrize("criterion", CRITERIA)
def test_no_other_counts_are_better(criterion: str) -> None:
    # Seven runs are no multiple of the optimum: all 210 divisions of seven runs among five places.
    choices = RunChoices(np.ones(5), QUADRATIC, 0.1 * np.eye(3))
    design = best_runs(criterion, choices, 7.0, np.eye(3))
    values = []
    for counts in product(range(8), repeat=5):
        if sum(counts) == 7:
            inverse = np.linalg.inv(choices.of(np.array(counts)))
            values.append(
                {
                    "D": np.linalg.det(inverse) ** (1 / 3),
                    "A": np.trace(inverse),
                    "minimax": np.diagonal(inverse).max(),
                }[criterion]
            )
    inverse = np.linalg.inv(design.information)
    own = {
        "D": np.linalg.det(inverse) ** (1 / 3),
        "A": np.trace(inverse),
        "minimax": np.diagonal(inverse).max(),
    }[criterion]
    assert own == pytest.approx(min(values))
    assert 0.8 < design.efficiency <= 1
    # The certificate is a bound: the best of whole runs is one division of that time.
    assert min(values) >= own * design.efficiency * (1 - 1e-9)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_runs_that_each_tell_of_parameters_of_their_own(criterion: str) -> None:
    # Three rigs side by side, of one, two and one parameters; all 165 divisions of eleven runs that leave
    # none out are fewer still.
    information = np.zeros((3, 4, 4))
    information[0, 0, 0], information[2, 3, 3] = 4.0, 0.3
    information[1, 1:3, 1:3] = [[2.0, 0.5], [0.5, 1.0]]
    choices = RunChoices(np.ones(3), information, np.zeros((4, 4)))
    design = best_runs(criterion, choices, 11.0, np.eye(4))
    values = {
        "D": lambda inverse: np.linalg.det(inverse) ** 0.25,
        "A": np.trace,
        "minimax": lambda inverse: np.diagonal(inverse).max(),
    }
    found = [
        values[criterion](np.linalg.inv(choices.of(np.array(counts))))
        for counts in product(range(1, 10), repeat=3)
        if sum(counts) == 11
    ]
    own = values[criterion](np.linalg.inv(design.information))
    assert own == pytest.approx(min(found))
    assert 0.8 < design.efficiency <= 1
    # Shares by hand: variances 1/4, 4/7 and 8/7, 10/3 of one run each.
    expected = {
        "minimax": np.array([1 / 4, 8 / 7, 10 / 3]),
        "A": np.sqrt([1 / 4, 12 / 7, 10 / 3]),
        "D": np.array([1.0, 2.0, 1.0]),
    }[criterion]
    np.testing.assert_allclose(design.shares, expected / expected.sum(), rtol=1e-9)
    with pytest.raises(ConfigError, match="3 kinds of runs"):
        best_runs(criterion, choices, 2.0, np.eye(4))


def test_runs_of_different_length_fill_the_time() -> None:
    choices = RunChoices(np.array([2.0, 3.0]), np.stack([np.eye(2)] * 2), np.zeros((2, 2)))
    assert best_runs("A", choices, 9.0, np.eye(2)).counts.tolist() == [4, 0]
    with pytest.raises(
        ConfigError, match=r"20001 s have room for 1e\+04 runs of 2 s; a plan lists 10000 at most"
    ):
        best_runs("A", choices, 20001.0, np.eye(2))
    with pytest.raises(ConfigError, match="no run fits into 1 s"):
        best_runs("A", choices, 1.0, np.eye(2))
    with pytest.raises(FitError, match="no runs of that time"):
        best_runs("A", RunChoices(np.ones(5), QUADRATIC, NOTHING), 2.0, np.eye(3))


def test_what_no_run_tells_stays_as_it_was_known() -> None:
    # a + b is measured alone; both are known to 1 before: their difference stays at sqrt(2), each at 1 /
    # sqrt(2).
    choices = RunChoices(np.ones(1), np.ones((1, 2, 2)), np.eye(2))
    (direction,) = undetermined_combinations(choices).T
    np.testing.assert_allclose(np.abs(direction), np.sqrt([0.5, 0.5]))
    wanted = np.array([[1.0, 0.0], [1.0, -1.0], [1.0, 1.0]])
    np.testing.assert_allclose(lasting_errors(choices, wanted), [np.sqrt(0.5), np.sqrt(2), 0.0], atol=1e-9)
    np.testing.assert_allclose(errors_after(choices, np.array([100]), wanted)[2], np.sqrt(1 / (100 + 0.5)))
    open_choices = RunChoices(np.ones(1), np.ones((1, 2, 2)), np.zeros((2, 2)))
    assert np.isinf(lasting_errors(open_choices, wanted)).tolist() == [True, True, False]


def test_time_that_goals_need() -> None:
    choices = RunChoices(np.ones(1), np.eye(1)[None], np.zeros((1, 1)))
    # 25 runs give 0.2; 0.1 needs four times as many.
    assert time_for_goals(choices, np.array([25]), np.array([[10.0]])) == pytest.approx(4.0)
    assert np.isinf(
        time_for_goals(
            RunChoices(np.ones(1), np.zeros((1, 1, 1)), np.eye(1)), np.array([1]), np.array([[10.0]])
        )
    )


def test_a_goal_out_of_reach_is_refused_with_the_change_that_helps() -> None:
    one = CandidateRun("sum", 1.0, (), np.ones((2, 2)))
    other = CandidateRun("difference", 1.0, (), np.array([[1.0, -1.0], [-1.0, 1.0]]))
    changes = (
        Change("the same again", 1, (one, one)),
        Change("the difference", 1, (one, other)),
        Change("a known b", 1, (one,), ("b",)),
        Change("both", 2, (one, other), ("b",)),
    )
    quantities = (
        RunQuantity("a", "1", 1.0, np.array([1.0, 0.0]), 0.1),
        RunQuantity("a + b", "1", 1.0, np.ones(2)),
    )
    question = RunQuestion(
        ("a", "b"), np.ones(2), np.eye(2), (one,), quantities, 10.0, "minimax", remedies=changes
    )
    with pytest.raises(
        ConfigError, match=r"do not determine a to the goal: no run tells a \+1.00, b -1.00"
    ) as refusal:
        plan_runs(question, "", "run-ups")
    assert refusal.value.hint == "the difference or a known b would determine all"


def test_without_goals_errors_are_compared_in_units_of_the_parameters() -> None:
    # Micrometres and degrees, each told by a run of its own, equally well in these units: as many runs of
    # each.
    units = np.array([1e-6, np.deg2rad(1)])
    conditions = tuple(
        CandidateRun(name, 1.0, (), np.diag(row) / np.outer(units, units))
        for name, row in zip("ab", np.eye(2), strict=True)
    )
    quantities = tuple(RunQuantity(name, "1", 1.0, row) for name, row in zip("ab", np.eye(2), strict=True))
    plan = plan_runs(
        RunQuestion(("a", "b"), units, np.zeros((2, 2)), conditions, quantities, 6.0, "minimax"),
        "",
        "run-ups",
    ).plan
    assert [run.count for run in plan.runs] == [3, 3]

"""Rank statements: 2, 4, 4, 8 for four data sets, the advice, and combinations that truly change nothing
measured.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.estimation.statistics import combination_text
from labpipe.methods.run_ups.misfit import (
    ADVICE,
    measured_statement,
    rank_of,
    rank_statements,
    scales,
    unseen_combinations,
)
from labpipe.methods.run_ups.rotor import as_eight
from labpipe.methods.run_ups.virtual_rig import run_ups
from tests.methods.run_ups.run_up_cases import RIG, virtual


@pytest.mark.parametrize("load", [3.7, 10.0])
@pytest.mark.parametrize("speed", [60.0, 150.0, 250.0])
def test_ranks_are_two_four_four_and_eight(load: float, speed: float) -> None:
    found = rank_statements(RIG, load, speed)
    assert [one.rank for one in found] == [2, 4, 4, 8]
    assert [len(one.free) for one in found] == [6, 4, 4, 0]
    assert [one.advice for one in found] == ["", "", ADVICE, ""]
    assert "a second unbalance run adds no rank, a non-rotating shaker run does" in found[2].advice
    assert all(np.isfinite(one.condition) and one.condition >= 1 for one in found)
    assert "(k_xx + j Omega c_xx) x_b + (k_xy + j Omega c_xy) y_b" in found[1].words


def test_about_other_coefficients_the_ranks_stay(rng: np.random.Generator) -> None:
    eight = as_eight(*RIG.start_coefficients(5.0, np.array([150.0])))[0] * rng.uniform(0.8, 1.2, 8)
    assert [one.rank for one in rank_statements(RIG, 5.0, 150.0, eight)] == [2, 4, 4, 8]


def test_a_change_that_is_not_seen_changes_no_response(rng: np.random.Generator) -> None:
    """Any dK + j Omega dC with (dK + j Omega dC) x_b = 0, also under another unbalance, and finite rather
    than small.
    """
    speed = np.array([150.0])
    stiffness, damping = RIG.start_coefficients(5.0, speed)
    condensed = RIG.condense(speed, RIG.known_unbalance)
    journal, _ = condensed.journal(stiffness, damping)
    across = np.array([-journal[0, 1], journal[0, 0]])
    rows = (
        0.1
        * stiffness[0, 0, 0]
        * (rng.standard_normal((2, 1)) + 1j * rng.standard_normal((2, 1)))
        * across
        / np.abs(across).max()
    )
    changed = stiffness + rows.real, damping + rows.imag / speed
    for unbalance in (RIG.known_unbalance, {"disc 2": 5e-5j}):
        there = RIG.condense(speed, unbalance)
        np.testing.assert_allclose(there.response(*changed), there.response(stiffness, damping), rtol=1e-9)
    assert np.max(np.abs(changed[0] / stiffness - 1)) > 0.01


def test_the_runs_at_hand_get_the_advice_when_only_the_unbalance_differs() -> None:
    rig = virtual("inside", "second_unbalance=true", "shaker=true")
    runs = {run.name: run for run in run_ups(rig, 1, ["load-2", "load-2-second", "load-2-shaker"])}

    def statement(*names: str):  # type: ignore[no-untyped-def]
        return measured_statement(RIG, [runs[name] for name in names], 5.9, 150.0)

    assert (statement("load-2").rank, statement("load-2").advice) == (4, "")
    assert (statement("load-2", "load-2-second").rank, statement("load-2", "load-2-second").advice) == (
        4,
        ADVICE,
    )
    assert (statement("load-2", "load-2-shaker").rank, statement("load-2", "load-2-shaker").advice) == (8, "")
    # One force that does not turn moves the journal along one vector as well, but along another.
    assert statement("load-2-shaker").rank == 4
    assert statement("load-2-shaker").advice.startswith("a run under an unbalance adds rank")


def test_ranks_do_not_need_a_known_unbalance() -> None:
    """A rotor of which only a shaker's force is known; ranks are those of any unbalance."""
    rows = rank_statements(dataclasses.replace(RIG, unbalances=()), 5.9, 150.0)
    assert [row.rank for row in rows] == [2, 4, 4, 8]


def test_a_run_that_nothing_excites_is_refused() -> None:
    (run,) = run_ups(virtual("inside"), 1, ["load-2"])
    with pytest.raises(DataError, match="was excited by nothing"):
        RIG.excite(dataclasses.replace(run, unbalance={"disc 1": 0j}))


def test_rank_and_condition_of_matrices_by_hand() -> None:
    rank, condition = rank_of(np.array([[[3.0, 0, 0], [0, 0.5, 0]], [[1.0, 1, 0], [1.0, 1, 0]]]))
    np.testing.assert_array_equal(rank, [2, 1])
    np.testing.assert_allclose(condition, [6, 1])


def test_combinations_in_words() -> None:
    assert combination_text(("a", "b", "c"), np.array([1.0, -2.0, 0.1])) == "b +1.00, a -0.50"
    assert unseen_combinations(np.array([[1.0, 1.0]]), ("a", "b")) in (
        ("a +1.00, b -1.00",),
        ("b +1.00, a -1.00",),
    )


def test_a_coefficient_near_zero_is_measured_against_the_direct_ones() -> None:
    start = np.array([[4.0, 3.0, 1e-6, 9.0, 1.0, 0.1, -0.5, 4.0]])
    np.testing.assert_allclose(scales(start)[0], [4, 3, 1.2, 9, 1, 0.4, 0.5, 4])


def test_parts_that_look_alike_stand_in_the_order_of_the_names() -> None:
    """Whatever their last digits, which differ from machine to machine."""
    assert (
        combination_text(("a", "b", "c"), np.array([0.25, 0.25 * (1 + 1e-12), -0.5]))
        == "c +1.00, a -0.50, b -0.50"
    )

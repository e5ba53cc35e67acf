"""Goals and notes of a predicted uncertainty budget, and that of two tests together, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.planning.campaigns import PlannedCampaign
from labpipe.methods.planning.model import planned_model
from labpipe.methods.planning.uncertainty import (
    Earlier,
    Goals,
    aims,
    calibration_notes,
    combine_with_earlier,
    limits,
    unreachable,
)
from labpipe.records.uncertain import Budget, Uncertainty

# k = 1000 N/m, c = 10 N.s/m: the probe makes k 0.6 % and c 1.2 % wrong, the cell each 0.8 % and 0.5 %; noise
# 0.1 %.
SCALES = np.array([1000.0, 10.0])
PROBE, CELL = np.array([6.0, 0.12]), np.array([8.0, -0.05])
NOISE = np.array([1.0, 0.01])
BUDGET = Budget(
    ("k", "c"),
    NOISE,
    None,
    (Uncertainty("probe", 0.01, "1"), Uncertainty("cell", 2e-6, "s")),
    np.array([PROBE, CELL]),
)
# Two-sided 95 % of the normal distribution.
FACTOR = 1.959964


def test_what_expanded_goals_leave_to_noise() -> None:
    # k: 1 % systematic, 2.5 % expanded allow 1.2755 % combined: sqrt(1.2755^2 - 1) % = 0.792 % by noise; c:
    # 1.3 % are beyond 2 % / 1.96.
    goals = Goals(np.array([np.inf, 0.03]), np.array([0.025, 0.02]))
    allowed = limits(goals, BUDGET, SCALES)
    np.testing.assert_allclose(allowed, [np.sqrt((0.025 / FACTOR) ** 2 - 0.01**2), 0.0], rtol=1e-6)
    assert list(unreachable(goals, allowed)) == [False, True]
    np.testing.assert_allclose(aims(allowed, goals), [allowed[0], 0.002])
    # Of goals by noise nothing is taken off, and without goals all count alike.
    np.testing.assert_array_equal(
        limits(Goals(np.array([0.02, np.inf]), np.full(2, np.inf)), BUDGET, SCALES), [0.02, np.inf]
    )
    np.testing.assert_array_equal(
        limits(Goals(np.full(2, np.inf), np.full(2, np.inf)), BUDGET, SCALES), [1, 1]
    )


def test_the_source_that_must_be_known_better() -> None:
    # c to 2 % expanded allows 1.0204 % combined; noise 0.1 % and the cell 0.5 % leave 0.884 % to the probe,
    # which makes 1.2 % for its 1 %.
    (note,) = calibration_notes(Goals(np.full(2, np.inf), np.array([np.inf, 0.02])), BUDGET, NOISE, SCALES)
    assert note == (
        "c to 2 % expanded is not met however long one measures: probe is known to 1 % and must "
        "be known to 0.73 %."
    )
    assert 0.73e-2 <= np.sqrt((0.02 / FACTOR) ** 2 - 0.001**2 - 0.005**2) / 0.012 * 0.01 < 0.74e-2
    # k to 1 %: 0.51 % combined is less than the 0.6 % of the probe alone: both by sqrt(1 / (0.51^2 - 0.1^2))
    # = 2.0.
    (note,) = calibration_notes(Goals(np.full(2, np.inf), np.array([0.01, np.inf])), BUDGET, NOISE, SCALES)
    assert note.endswith("cell, probe must all be known 2 times better.")
    # k to 1.5 %: of 0.765 % the probe takes 0.6 % and noise 0.1 %: 0.464 % are left to the cell's 0.8 % for 2
    # us.
    (note,) = calibration_notes(Goals(np.full(2, np.inf), np.array([0.015, np.inf])), BUDGET, NOISE, SCALES)
    assert note.endswith("cell is known to 2 us and must be known to 1.1 us.")


def test_systematic_errors_of_two_tests_together() -> None:
    # The mean weighted by information: a source of both tests with one effect stays, one of the new test
    # alone is thinned out.
    known = Earlier(("k", "c"), np.diag(NOISE**2), ("probe",), PROBE[None]).information_beside(
        planned_model("sdof", {"k": 1000.0, "c": 10.0}, 1.0), 5.0, ("probe",)
    )
    # The new test tells three times as much of k, and a third of c.
    rate = np.diag(np.diagonal(known.information) * [3, 1 / 3]) / 5
    model = planned_model("sdof", {"k": 1000.0, "c": 10.0}, 1.0)
    earlier = Earlier(("k", "c"), np.diag(NOISE**2), ("probe",), PROBE[None])
    both = combine_with_earlier(BUDGET, earlier, PlannedCampaign((), np.ones(0), rate, known), model, 5.0)
    np.testing.assert_allclose(both.changes, [PROBE, CELL * [3 / 4, 1 / 4]], rtol=1e-12)
    assert both.changes[0, 0] == pytest.approx(6.0)

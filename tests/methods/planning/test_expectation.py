"""An earlier result in a plan: its information beside the new test's, and the prediction over draws from its
covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.planning.campaigns import ONE_BY_ONE
from labpipe.methods.planning.model import planned_model, relative_errors
from labpipe.methods.planning.plan import make_plan, planned_lines, time_needed
from labpipe.methods.planning.search import LEAST_CREST, flat
from labpipe.methods.planning.settings import NoiseSettings, PlanSettings
from labpipe.methods.planning.uncertainty import Earlier, Expected, spread, spread_notes
from labpipe.records.uncertain import Budget, Uncertainty
from tests.methods.planning.rigs import PEDESTAL
from tests.methods.planning.test_search import planned_rig

NAMES = ("k", "c")
# 2 % of k, 5 % of c, correlated by -0.4.
ERRORS = np.array([0.02 * PEDESTAL["k"], 0.05 * PEDESTAL["c"]])
NOISE = np.outer(ERRORS, ERRORS) * np.array([[1.0, -0.4], [-0.4, 1.0]])


def settings(**entries: object) -> PlanSettings:
    chosen: dict[str, object] = {
        **{
            "mass": 0.79,
            "band": (60.0, 72.0),
            "period": 2.0,
            "sample_rate": 500.0,
            "duration": 20.0,
            "force_limit": 1.0,
        },
        **{"expected": tuple(PEDESTAL.items()), "noise": NoiseSettings(force=0.02, displacement=0.3e-6)},
        **entries,
    }
    return PlanSettings("sdof", **chosen)  # type: ignore[arg-type]


def test_lines_of_the_band_without_those_that_are_left_out() -> None:
    """40 to 60 Hz every half a hertz: none of 44 to 45 Hz, within half a hertz of the mains' 50 Hz, or beside
    the speed.
    """
    kept = planned_lines(settings(band=(40.0, 60.0), exclude=((44.0, 45.0),), mains=50.0, speed=57.3)) / 2
    left_out = {44.0, 44.5, 45.0, 49.5, 50.0, 50.5, 57.0, 57.5}
    assert kept.tolist() == [f for f in np.arange(40, 60.5, 0.5) if f not in left_out]
    # No line at rest, and two are needed.
    assert planned_lines(settings(band=(0.0, 1.0))).tolist() == [1, 2]
    with pytest.raises(ConfigError, match="1 lines are left in the band"):
        planned_lines(settings(band=(0.0, 1.0), exclude=((0.9, 1.1),)))


def test_systematic_errors_that_both_tests_have_are_no_knowledge_of_one() -> None:
    # V = noise + changes of every source; a source in common adds nothing that another test could average
    # out.
    changes = np.array([[0.01 * PEDESTAL["k"], 0.0], [0.0, 0.03 * PEDESTAL["c"]]])
    earlier = Earlier(NAMES, NOISE, ("probe", "shaker"), changes)
    np.testing.assert_allclose(earlier.covariance(), NOISE + changes.T @ changes)
    np.testing.assert_allclose(earlier.covariance(["probe"]), NOISE + np.outer(changes[1], changes[1]))
    model = planned_model("sdof", PEDESTAL, 0.79)
    known = earlier.information_beside(model, 20.0, ["probe", "shaker"])
    np.testing.assert_allclose(relative_errors(known.information), [0.02, 0.05])
    # A typed coefficient is taken as it is.
    np.testing.assert_allclose(
        Earlier(("c",), NOISE[1:, 1:]).covariance_of(model), [[0, 0], [0, NOISE[1, 1]]]
    )
    with pytest.raises(ConfigError, match="states no errors"):
        Earlier(NAMES, np.full((2, 2), np.nan)).information_beside(model, 20.0)


@pytest.mark.long
def test_errors_of_both_tests_together() -> None:
    # Kalman's update of the covariance, V - V (V + W)^-1 V with W of the new test alone, is the inverse of
    # the sum of informations. An earlier result of the size of the new test's errors of k.
    tight = NOISE / 5000**2
    made = make_plan(
        settings(combine_earlier=True, earlier="x"), Expected(PEDESTAL, Earlier(NAMES, tight)), "both"
    )
    plan = made.plan
    scales = np.array([c.scale for c in plan.coefficients])
    own = np.linalg.inv(made.rig.rate(made.tests[0]) * plan.duration) * np.outer(scales, scales)
    both = tight - tight @ np.linalg.solve(tight + own, tight)
    np.testing.assert_allclose(
        [c.error * c.scale for c in plan.coefficients], np.sqrt(np.diagonal(both)), rtol=1e-9
    )
    assert np.all(np.diagonal(both) < 0.7 * np.diagonal(own))
    assert plan.combined and plan.gain_range is not None
    assert all(
        c.error_range is not None and c.error_range[0] <= c.error <= c.error_range[1]
        for c in plan.coefficients
    )


@pytest.mark.long
def test_a_mass_that_is_off_in_both_tests_does_not_move_the_resonance() -> None:
    # 2 % of k by a mass that the new test has as well are no uncertainty of where the resonance lies; 0.01 %
    # by noise are next to none.
    small = np.diag((1e-4 * np.array([PEDESTAL["k"], PEDESTAL["c"]])) ** 2)
    change = np.array([0.02 * PEDESTAL["k"], 0.0])
    budget = Budget(
        NAMES, np.sqrt(np.diagonal(small)), None, (Uncertainty("scale", 0.02, "1"),), change[None]
    )
    made = make_plan(
        settings(earlier="x"),
        Expected(PEDESTAL, Earlier(NAMES, small, ("scale",), change[None])),
        "both",
        lambda *_: budget,
    )
    (k, _), notes = made.plan.coefficients, made.plan.notes
    assert k.error_range is not None and k.error_range[1] < 1.01 * k.error
    assert not any("Spend a fifth" in note for note in notes)
    assert k.systematic == pytest.approx(0.02)


def test_time_that_goals_need_beside_an_earlier_result() -> None:
    # One number: 1 / limit^2 = I_0 + t I_1.
    rig, lines, _ = planned_rig("pedestal")
    earlier = Earlier(("k",), np.array([[(1e-4 * PEDESTAL["k"]) ** 2]]))
    known = earlier.information_beside(rig.model, 10.0)
    told = flat(replace(rig, earlier=known), lines[::4], ONE_BY_ONE, LEAST_CREST)
    inverse = np.linalg.inv(told.rate)
    of_k = 1 / inverse[0, 0]
    limit = 0.5 / np.sqrt(1e8 + 10 * of_k)
    needed = time_needed(told, np.array([limit, np.inf]), 10.0)
    assert needed == pytest.approx((limit**-2 - 1e8) / of_k, rel=1e-6)
    assert time_needed(told, np.array([1e-12, np.inf]), 10.0) == float("inf")


def _error_by_formula(
    omega: np.ndarray, force: np.ndarray, k: float, c: float, duration: float
) -> np.ndarray:
    """Errors of k and c of a pedestal: information 2 T |dD_i X|^2 / density per line, written out for one
    degree of freedom.
    """
    d = k - 0.79 * omega**2 + 1j * omega * c
    x = force / d
    density = 2 / 2000 * (0.02**2 + np.abs(d) ** 2 * 0.3e-6**2)
    change = np.stack([x, 1j * omega * x])
    information = duration * np.einsum("il,jl,l->ij", change.conj(), change, 1 / density).real
    return np.sqrt(np.diagonal(np.linalg.inv(information)))


@pytest.mark.long
def test_prediction_over_draws() -> None:
    # Another 4000 draws, through the errors of one degree of freedom written out.
    rig, lines, _ = planned_rig("pedestal")
    told = flat(rig, lines, ONE_BY_ONE, LEAST_CREST)
    found = spread(rig, told, told, NOISE, np.array([np.inf, 5e-4]), "minimax", 10.0)
    rng = np.random.default_rng(5)
    drawn = rng.multivariate_normal([PEDESTAL["k"], PEDESTAL["c"]], NOISE, 4000)
    (test,) = told.tests
    errors = (
        np.array([_error_by_formula(rig.omega(test), test.forces[:, 0], k, c, 10.0) for k, c in drawn])
        / rig.model.scales
    )
    np.testing.assert_allclose(found.errors, np.quantile(errors, [0.025, 0.975], axis=0), rtol=0.06)
    assert found.met == pytest.approx(np.mean(errors[:, 1] <= 5e-4), abs=0.1)
    # The plan is the flat test here.
    np.testing.assert_allclose(found.gain, 1.0)


def test_two_stages_are_advised_where_the_expectation_is_unsure() -> None:
    # A half-power width is 0.74 Hz, as much as 2 % of k; 5 % take the few lines of a plan off the resonance,
    # 0.2 % do not.
    rig, lines, wanted = planned_rig("pedestal")
    other, own = (
        flat(rig, lines, ONE_BY_ONE, LEAST_CREST),
        flat(rig, lines[(lines >= 128) & (lines <= 135)], ONE_BY_ONE, LEAST_CREST),
    )
    errors, gain = own.errors(10.0), float(other.errors(10.0).max() / own.errors(10.0).max())
    assert gain > 2
    notes = []
    for share in (0.002, 0.05):
        uncertainty = np.diag((share * rig.model.scales) ** 2)
        found = spread(rig, own, other, uncertainty, wanted.goals, wanted.criterion, 10.0)
        assert found.gain[0] < gain
        notes.append(spread_notes(found, errors, gain, False))
    assert notes[0] == ()
    assert "Spend a fifth of the time" in notes[1][0]

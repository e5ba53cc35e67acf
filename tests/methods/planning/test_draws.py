"""Predicted standard errors against the scatter of an estimator written here, over draws of the sensors'
noise; and two-stage plans.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.planning.campaigns import INTERLEAVED, ONE_BY_ONE, PlannedRig
from labpipe.methods.planning.search import best, flat
from tests.methods.planning.draws import SECONDS, estimates, planned_rig
from tests.methods.planning.rigs import RIGS
from tests.methods.planning.two_stages import two_stages

DRAWS = 400


@pytest.mark.long
@pytest.mark.parametrize("name", RIGS)
def test_predicted_errors_are_those_of_draws(name: str) -> None:
    # The largest of 12 ratios of 400 draws wanders by 3 / sqrt(2 n) = 10.6 %.
    rig, lines, wanted = planned_rig(name)
    lines = lines[::4]
    rig = PlannedRig(rig.model, rig.noise, rig.limits, rig.directions, rig.shakers, rig.spacing)
    told = best(rig, lines, wanted, (ONE_BY_ONE if rig.model.n_dof == 1 else INTERLEAVED,)).campaign
    found = np.concatenate(
        [estimates(rig, [(told, SECONDS)], rig.model.expected, DRAWS // 4, seed) for seed in range(4)]
    )
    ratio = found.std(axis=0) / (told.errors(SECONDS) * rig.model.scales)
    assert np.all(np.abs(ratio - 1) < 0.106), ratio
    assert np.all(np.abs(found.mean(axis=0) - rig.model.expected) < 0.2 * found.std(axis=0))


@pytest.mark.long
def test_the_remedy_of_forces_at_45_degrees_works() -> None:
    # On a symmetric rig 45 deg alone tells 4 of 8 coefficients; with a second direction simulated tests end
    # near the truth.
    expected = np.array([180e3, 0.0, 0.0, 180e3, 120.0, 0.0, 0.0, 120.0])
    rig, lines, _ = planned_rig("rotor", RIGS["rotor"]()[0].with_values(expected))
    oblique = np.array([[1.0, 1.0], [-1.0, 1.0]], complex) / np.sqrt(2)
    both = PlannedRig(rig.model, rig.noise, rig.limits, oblique, ("45 deg", "135 deg"), rig.spacing)
    told = flat(both, lines[::8], ONE_BY_ONE)
    found = estimates(both, [(told, SECONDS)], expected, 500, 4)
    # 500 draws know a standard deviation to 1 / sqrt(1000) = 3.2 %.
    np.testing.assert_allclose(found.std(axis=0), told.errors(SECONDS) * rig.model.scales, rtol=0.12)
    one = PlannedRig(rig.model, rig.noise, rig.limits, oblique[:1], ("45 deg",), rig.spacing)
    assert np.all(np.isinf(flat(one, lines[::8], ONE_BY_ONE).errors(SECONDS)))


@pytest.mark.long
@pytest.mark.parametrize(("name", "count"), [("pedestal", 3), ("rotor", 1)])
def test_two_stages_keep_the_gain_on_a_rig_that_is_not_as_expected(name: str, count: int) -> None:
    # Twenty rotors and seals take minutes: python -m tests.methods.planning.two_stages seal 20.
    kept, over_flat = two_stages(name, count)
    assert np.median(kept) >= 0.9
    assert min(over_flat) >= 1.0

"""Threshold and critical speeds of a pinned rotor on one bearing."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.rotor.pinned import Stability, resonance_speed, threshold_speed
from labpipe.methods.rotor.response import GROWTH_TOLERANCE, onset_speed
from labpipe.methods.rotor.shaft import NodeSupport
from tests.methods.rotor.falah_cases import LOAD, PINNED, ROTOR, RPM, film

STABILITY = Stability.of(PINNED, 3)
SPEEDS = np.arange(600.0, 4000, 200) * RPM


def test_the_threshold_equals_the_onset_of_the_rotor_on_stiff_springs() -> None:
    """An independent assembly: 20 dofs, pins as springs of 1e11 N/m, the general onset search."""
    coefficients = film()

    def supports(speed: float) -> list[NodeSupport]:
        stiffness, damping = (found[0] for found in coefficients(np.array([speed])))
        return [
            *(NodeSupport(node, 1e11 * np.eye(2), 10.0 * np.eye(2)) for node in (1, 5)),
            NodeSupport(3, stiffness, damping),
        ]

    ours = threshold_speed(STABILITY, coefficients, SPEEDS)
    theirs = onset_speed(ROTOR, supports, SPEEDS)
    assert ours is not None and theirs is not None
    np.testing.assert_allclose(ours, theirs, rtol=2e-5)
    # The independent calculation of tests/methods/run_ups/test_run_up_threshold.
    np.testing.assert_allclose(ours / RPM, 2814.33, rtol=1e-4)


def test_at_the_threshold_the_growth_rate_is_the_tolerance() -> None:
    coefficients = film()
    threshold = threshold_speed(STABILITY, coefficients, SPEEDS)
    assert threshold is not None
    place = np.array([threshold])
    np.testing.assert_allclose(STABILITY.growth(place, *coefficients(place)), GROWTH_TOLERANCE, atol=1e-4)


def test_whirl_at_the_threshold_is_about_half_the_speed() -> None:
    coefficients = film()
    threshold = threshold_speed(STABILITY, coefficients, SPEEDS)
    assert threshold is not None
    mode = STABILITY.least_stable(threshold, *(found[0] for found in coefficients(np.array([threshold]))))
    assert 0.45 < mode.eigenvalue.imag / threshold < 0.52


def test_undamped_antiphase_modes_decide_nothing() -> None:
    """The whole spectrum has undamped modes (a symmetric rotor never moves its journal in them).

    The growth rate leaves them out.
    """
    place = np.array([1000 * RPM])
    stiffness, damping = film()(place)
    assert np.max(np.linalg.eigvals(STABILITY.system(place, stiffness, damping)).real) > -1e-6
    assert STABILITY.growth(place, stiffness, damping)[0] < -1


@pytest.mark.parametrize("number", range(8))
def test_slopes_of_the_growth_rate_equal_differences(number: int) -> None:
    speed = 2800 * RPM
    stiffness, damping = (found[0] for found in film()(np.array([speed])))
    mode = STABILITY.least_stable(speed, stiffness, damping)
    np.testing.assert_allclose(
        mode.growth, STABILITY.growth(np.array([speed]), stiffness, damping)[0], rtol=1e-9
    )
    change = np.zeros(8)
    change[number] = 1e-4 * (np.abs(stiffness).mean() if number < 4 else np.abs(damping).mean())
    k, c = change.reshape(2, 2, 2)
    plus, minus = (STABILITY.least_stable(speed, stiffness + s * k, damping + s * c).growth for s in (1, -1))
    slope = np.stack([mode.by_stiffness, mode.by_damping]).ravel()[number]
    np.testing.assert_allclose(slope, (plus - minus) / (2 * change[number]), rtol=1e-4, atol=1e-9)


def test_slope_of_the_growth_rate_by_speed_equals_a_difference() -> None:
    """Through the gyroscopic matrix, the bearing held."""
    speed, step = 2800 * RPM, 0.1
    bearing = [found[0] for found in film()(np.array([speed]))]
    plus, minus = (STABILITY.least_stable(speed + sign * step, *bearing).growth for sign in (1, -1))
    slope = STABILITY.least_stable(speed, *bearing).by_speed
    np.testing.assert_allclose(slope, (plus - minus) / (2 * step), rtol=1e-5)


def test_no_threshold_within_the_range_is_none() -> None:
    assert threshold_speed(STABILITY, film(), SPEEDS[:5]) is None


def test_a_rotor_unstable_from_the_start_is_refused() -> None:
    with pytest.raises(FitError, match="unstable already"):
        threshold_speed(STABILITY, film(), np.array([3500.0, 4000]) * RPM)


def test_a_heavier_load_makes_it_stiffer_and_more_stable() -> None:
    thresholds = [threshold_speed(STABILITY, film(factor * LOAD), SPEEDS) for factor in (1.0, 1.6, 2.2)]
    critical = [resonance_speed(STABILITY, film(factor * LOAD), SPEEDS) for factor in (1.0, 1.6, 2.2)]
    for found in (thresholds, critical):
        assert all(one is not None for one in found)
        assert np.all(np.diff(np.array(found, float)) > 0)


def test_the_critical_speed_by_eigenvalues_is_where_a_mode_meets_the_speed() -> None:
    found = resonance_speed(STABILITY, film(), SPEEDS)
    assert found is not None
    place = np.array([found])
    roots = np.linalg.eigvals(STABILITY.system(place, *film()(place)))[0]
    assert np.min(np.abs(roots.imag - found)) < 1e-3
    assert resonance_speed(STABILITY, film(), SPEEDS[-3:]) is None


class TwoModes:
    """Modes at 100 and 101 rad/s whatever the speed, both of the journal."""

    def system(self, *_: object) -> np.ndarray:
        return np.diag([-0.1 + 100j, -0.1 + 101j])[None]

    def moving(self, *_: object) -> np.ndarray:
        return np.ones(2, bool)


def test_a_resonance_beside_another_one_is_found() -> None:
    """Between 95 and 100.6 rad/s only the mode at 100 is crossed; that at 101 is nearer to the upper end."""
    found = resonance_speed(TwoModes(), lambda _: (np.zeros(2), np.zeros(2)), [95.0, 100.6])  # type: ignore[arg-type]
    assert found == pytest.approx(100, abs=2e-4)

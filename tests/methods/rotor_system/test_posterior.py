"""The posterior of all tests: what it promises over drawn rotors, conflicts, alternatives, predictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.methods.rotor.theory import margin_above, margin_below, peaks
from labpipe.methods.rotor_system.build import PEDESTALS
from labpipe.methods.rotor_system.posterior import fit_system, is_normal, pulls
from labpipe.methods.rotor_system.predictions import (
    at_speed,
    campbell,
    critical_speeds,
    onset,
    unbalance_forces,
)
from tests.methods.rotor_system.two_discs import built, dof, drawn, four_tests, true_values


@pytest.fixture(scope="module")
def fitted():
    """A drawn rotor and the posterior of its four tests."""
    of, rng = built(), np.random.default_rng(11)
    truth = drawn(of, rng)
    return of, truth, fit_system(of.model, four_tests(of, truth, rng))


def test_without_noise_the_truth_is_found_as_far_as_tests_tell() -> None:
    of = built()
    found = fit_system(of.model, four_tests(of, true_values(of), None), estimate_sizes=False)
    told = found.shares < 0.05
    z = (found.values - true_values(of)) / found.standard_errors
    assert told.sum() >= 8 and np.abs(z[told]).max() < 1.5


def test_values_and_predictions_lie_in_their_intervals(fitted) -> None:
    """One rotor; the statistics over many are in tests/draws. 52 unknowns of one posterior: the largest of
    so many is beyond 4 in one rotor of three hundred, and the root mean square about 1 within .3.
    """
    of, truth, found = fitted
    z = (found.values - truth) / found.standard_errors
    assert np.abs(z).max() < 4 and 0.7 < np.sqrt(np.mean(z**2)) < 1.3
    diagram = campbell(found, np.array([60.0, 100.0]))
    roots = of.model.roots(at_speed(of.model, truth), 200 * np.pi, slopes=False).values
    for mode in range(4):
        near = np.abs(roots.imag / (2 * np.pi) - diagram.frequency[1, mode]).min()
        assert near < 4 * diagram.frequency_error[1, mode]


def test_two_halves_of_the_tests_are_one_whole(fitted) -> None:
    """Information adds up: linearised, the posterior of all tests is that of some as prior for the others."""
    of, _, found = fitted
    information = np.diag(found.errors**-2.0)
    for test in found.tests:
        jacobian = test.residual(of.model, found.values)[1]
        information = information + jacobian.T @ jacobian
    scale = found.standard_errors
    assert np.allclose(
        np.linalg.inv(information) / np.outer(scale, scale),
        found.covariance / np.outer(scale, scale),
        atol=1e-6,
    )
    assert is_normal(found)


def test_a_test_of_another_rotor_is_named(fitted) -> None:
    """The rotor that was weighed has 3 % more mass: fifteen of its standard uncertainties."""
    of, _, found = fitted
    wrong = [replace(test, mass=test.mass + 0.03) if test.name == "static" else test for test in found.tests]
    other = fit_system(of.model, wrong)
    worst = max(pulls(other), key=lambda pull: abs(pull.z))
    assert worst.test == "static" and abs(worst.z) > 5
    assert all(abs(pull.z) < 4 for pull in pulls(found))


def test_a_missing_pedestal_is_the_most_probable_alternative() -> None:
    of, rng = built(), np.random.default_rng(21)
    truth = true_values(of)
    tests = four_tests(of, truth, rng)

    def on(other, test):
        if test.name != "run":
            return test
        return replace(
            test, planes=tuple(other.planes.values()), gains=other.gains["run"], phases=other.phases["run"]
        )

    plain, alternative = built(False), built(False, PEDESTALS)
    without = fit_system(plain.model, [on(plain, test) for test in tests])
    with_them = fit_system(alternative.model, [on(alternative, test) for test in tests])
    assert without.misfits or without.enlarged
    assert with_them.ln_evidence > without.ln_evidence + 10


def test_critical_speed_and_amplification_of_draws(fitted) -> None:
    """The reduced basis against the whole model, and the truth in its interval."""
    of, truth, found = fitted
    output = dof("4 z")
    criticals = critical_speeds(found, of, (20.0, 90.0), 100.0, [output], n_draw=120)
    speed = np.linspace(20.0, 90.0, 4000)
    omega = 2 * np.pi * speed
    forces = unbalance_forces(of, truth)[:, None] * omega[:, None, None] ** 2
    motion, _, _ = of.model.response(at_speed(of.model, truth), omega, omega, forces, [output])
    true = max(peaks(speed, np.abs(motion[:, 0, 0])), key=lambda peak: peak.amplitude)
    best = min(criticals, key=lambda critical: abs(critical.speed - true.speed))
    low, high = best.speed_interval
    # Twice the half-width: one draw of a 95 % interval may lie outside.
    assert abs(true.speed - best.speed) < high - low
    assert best.amplification == pytest.approx(true.amplification, rel=0.5)


def test_onset_is_where_the_growth_rate_changes_its_sign(fitted) -> None:
    of, _, found = fitted
    speed, error = onset(found, 100.0)
    values = at_speed(of.model, found.values)
    below, above = (
        of.model.roots(values, 2 * np.pi * speed * f, slopes=False).values.real.max() for f in (0.99, 1.01)
    )
    assert below < 0 < above and 0 < error < 1


def test_margins_of_api_684() -> None:
    """17 (1 - 1 / (AF - 1.5)), at most 16, and ten more above; none below an amplification of 2.5."""
    assert [margin_below(a) for a in (2.0, 4.0, 8.0, 25.0)] == pytest.approx([0, 10.2, 14.384615, 16.0])
    assert [margin_above(a) for a in (2.0, 2.5, 8.0, 25.0)] == pytest.approx([0, 10.0, 24.384615, 26.0])

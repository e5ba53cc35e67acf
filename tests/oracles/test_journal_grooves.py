"""A bearing of L / D = 0.5 with two axial grooves of 20 deg against the table of Lund and Thomsen (1978).

Source: J. W. Lund, K. K. Thomsen, A calculation method and data for the dynamic coefficients of oil-lubricated journal bearings, ASME
Topics in fluid film bearing and rotor bearing system design (1978); the numbers as reprinted in lecture material of the Technical
University of Denmark (table 1a). Frame: x along the load, y a quarter turn further with the spin; K c / W, C c Omega / W.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.bearings.journal_curve import JournalCurve, journal_curve

# S, eccentricity, attitude [deg], Kxx Kxy Kyx Kyy, Cxx Cxy Cyx Cyy.
LUND_THOMSEN = np.array(
    [
        [6.43, 0.071, 81.89, 1.55, 14.41, -6.6, 1.88, 28.75, 1.89, 1.89, 13.31],
        [3.937, 0.114, 77.32, 1.57, 9.27, -4.2, 1.89, 18.44, 1.93, 1.93, 8.58],
        [2.634, 0.165, 72.36, 1.61, 6.74, -3.01, 1.91, 13.36, 2.0, 2.0, 6.28],
        [2.03, 0.207, 68.75, 1.65, 5.67, -2.5, 1.93, 11.18, 2.07, 2.07, 5.33],
        [1.656, 0.244, 65.85, 1.69, 5.06, -2.2, 1.95, 9.93, 2.15, 2.15, 4.8],
        [0.917, 0.372, 57.45, 2.12, 4.01, -1.3, 1.85, 7.7, 2.06, 2.06, 3.23],
        [0.58, 0.477, 51.01, 2.67, 3.7, -0.78, 1.75, 6.96, 1.94, 1.94, 2.4],
        [0.378, 0.57, 45.43, 3.33, 3.64, -0.43, 1.68, 6.76, 1.87, 1.87, 1.89],
        [0.244, 0.655, 40.25, 4.21, 3.74, -0.13, 1.64, 6.87, 1.82, 1.82, 1.54],
        [0.194, 0.695, 37.72, 4.78, 3.84, 0.01, 1.62, 7.03, 1.8, 1.8, 1.4],
        [0.151, 0.734, 35.2, 5.48, 3.98, 0.15, 1.61, 7.26, 1.79, 1.79, 1.27],
        [0.133, 0.753, 33.93, 5.89, 4.07, 0.22, 1.6, 7.41, 1.79, 1.79, 1.2],
        [0.126, 0.761, 33.42, 6.07, 4.11, 0.25, 1.6, 7.48, 1.79, 1.79, 1.18],
        [0.116, 0.772, 32.65, 6.36, 4.17, 0.3, 1.6, 7.59, 1.79, 1.79, 1.15],
        [0.086, 0.809, 30.04, 7.51, 4.42, 0.47, 1.59, 8.03, 1.79, 1.79, 1.03],
        [0.042, 0.879, 24.41, 11.45, 5.23, 0.92, 1.6, 9.48, 1.8, 1.8, 0.82],
    ]
)


@pytest.fixture(scope="module")
def curve() -> JournalCurve:
    return journal_curve(0.5, np.deg2rad(20))


def test_the_journal_rests_where_lund_and_thomsen_print_it(curve: JournalCurve) -> None:
    """Printed to three figures: eccentricity within .001, attitude within .2 deg."""
    eccentricity, attitude = curve.rest(LUND_THOMSEN[:, 0])
    np.testing.assert_allclose(eccentricity, LUND_THOMSEN[:, 1], atol=0.001)
    np.testing.assert_allclose(np.degrees(attitude), LUND_THOMSEN[:, 2], atol=0.2)


def test_coefficients_are_within_two_and_a_half_per_cent_rms(curve: JournalCurve) -> None:
    """Each against itself, those near their zero crossing (K_yx about S = .19) left to the rms over all eight."""
    found = curve.coefficients(LUND_THOMSEN[:, 0])
    ours = np.concatenate([found.stiffness.reshape(-1, 4), found.damping.reshape(-1, 4)], axis=1)
    printed = LUND_THOMSEN[:, 3:]
    clear = np.abs(printed) > 0.3
    assert np.sqrt(np.mean((ours[clear] / printed[clear] - 1) ** 2)) < 0.025
    rms = np.sqrt(np.sum((ours - printed) ** 2, axis=1) / np.sum(printed**2, axis=1))
    assert rms.max() < 0.025


def test_the_cross_stiffness_changes_its_sign_near_a_sommerfeld_number_of_019(curve: JournalCurve) -> None:
    numbers = np.linspace(0.15, 0.25, 101)
    k_yx = curve.coefficients(numbers).stiffness[:, 1, 0]
    assert 0.18 < numbers[np.argmin(np.abs(k_yx))] < 0.20


def test_without_grooves_single_coefficients_differ_by_half() -> None:
    """A whole film is another bearing: at S = 6.43 it lacks most of the direct stiffness."""
    plain = journal_curve(0.5, 0.0).coefficients(LUND_THOMSEN[:1, 0])
    printed = LUND_THOMSEN[0, 3:7]
    assert np.max(np.abs(plain.stiffness.ravel() / printed - 1)) > 0.5

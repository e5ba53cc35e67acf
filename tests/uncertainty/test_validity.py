"""Up to which amplitude coefficients are those of small motions."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.uncertainty.settings import MatrixSettings
from tests.uncertainty.test_matrix import a_matrix


@pytest.mark.parametrize("over", [("amplitude", "speed"), ("speed", "amplitude")])
def test_the_amplitude_up_to_which_coefficients_hold_is_said(over: tuple[str, ...]) -> None:
    """k is 1e6 up to 20 um and 2 % more at 40 um, twenty standard errors; c never differs."""
    settings = MatrixSettings(fit="axial", over=over, name="tm")
    tests = [
        (
            {"k": (1e6 * (1.02 if size > 30 else 1.0), 1e3), "c": (50.0, 1.0)},
            {"amplitude": f"{size} um", "speed": speed},
        )
        for size in (10, 20, 40)
        for speed in ("50 Hz", "60 Hz")
    ]
    assert a_matrix(tests, settings).statement.endswith(
        "hold up to amplitude 20 um; at amplitude 40 um k differ."
    )
    same = [({"k": (1e6, 1e3), "c": (50.0, 1.0)}, conditions) for _, conditions in tests]
    assert a_matrix(same, settings).statement.endswith("No coefficient differs up to amplitude 40 um.")
    # Without errors nothing is tested, and nothing said.
    bare = [({"k": (1e6 * (2.0 if "40" in on["amplitude"] else 1.0), 0.0)}, on) for _, on in tests]
    assert "differ" not in a_matrix(bare, settings).statement


def test_chance_alone_seldom_ends_the_range(rng) -> None:
    """300 matrices of sound coefficients: at most 5 % + 3.5 binomial standard deviations name an
    amplitude.
    """
    settings = MatrixSettings(fit="axial", over=("amplitude",), name="tm")
    named = 0
    for _ in range(300):
        tests = [
            ({"k": (1e6 + 1e3 * rng.standard_normal(), 1e3)}, {"amplitude": f"{size} um"})
            for size in (10, 20, 40, 80)
        ]
        named += "differ." in a_matrix(tests, settings).statement
    assert named <= 300 * 0.05 + 3.5 * np.sqrt(300 * 0.05 * 0.95)

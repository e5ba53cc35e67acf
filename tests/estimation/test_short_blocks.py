"""Blocks of random data too short for a mode of 20 Hz with a damping ratio of 0.05, whose half-power width is
2 Hz.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from labpipe.estimation.diagnostics import leakage_findings
from labpipe.estimation.estimators import ML
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import Matrices
from labpipe.records.response import Blocks
from labpipe.spectra.joint import ESTIMATOR

OMEGA_N = 2 * np.pi * 20.0
ONE = np.ones((1, 1))
MODE = Matrices(OMEGA_N**2 * ONE, 0.1 * OMEGA_N * ONE, ONE, ONE)


def said(
    length: float,
    degree: int = 0,
    *,
    modelled: bool = False,
    by: str = "H1",
    band: tuple[float, float] = (10.0, 30.0),
) -> str:
    """The message on blocks of a *length* [s]; empty for none."""
    blocks = Blocks(length, "hann", 0.5, 20, by, degree, 0)
    measured = Measured(
        omega=2 * np.pi * np.linspace(*band, 50), matrix=np.ones((50, 1, 1), complex), covariance=None,
        noise_dof=np.inf, noise_lines=1.0,
        outputs=(), inputs=(), blocks=blocks, leakage=cast("Any", object()) if modelled else None,
    )  # fmt: skip
    return "".join(finding.message for finding in leakage_findings(measured, MODE, ML))


@pytest.mark.parametrize(
    ("enough", "needed", "keys"),
    [
        # Ten lines of a window, one and a half where the leakage is part of the model, 30 over the degree of
        # polynomials, three where what they smear is part of it.
        (5.0, "5 s", {}),
        (0.75, "0.75 s", {"modelled": True}),
        (7.5, "7.5 s", {"degree": 2}),
        (3.75, "3.8 s", {"degree": 4}),
        (1.5, "1.5 s", {"degree": 4, "modelled": True}),
    ],
)
def test_the_width_in_lines_decides(enough: float, needed: str, keys: dict[str, Any]) -> None:
    assert said(enough, **keys) == "" and f"use blocks of at least {needed}" in said(0.99 * enough, **keys)


def test_the_message_says_what_the_bias_is() -> None:
    """14 % at one line in the width, less by the power of 1.6 of their number: 4.6 % at two, one block of 1
    s.
    """
    assert "its damping comes out up to 5 % too large" in said(1.0)
    assert "2 lines of blocks of 1 s" in said(1.0) and "the mode at 20 Hz is 2 Hz wide" in said(1.0)
    assert "do not follow its peak" in said(1.0, 2) and "more than from the measurement" in said(
        0.5, modelled=True
    )


def test_what_no_window_smears_is_not_said() -> None:
    """A mode beside the band, and a loop with a reference, whose poles are those that leak."""
    assert said(1.0, band=(21.0, 30.0)) == said(1.0, band=(10.0, 19.0)) == said(1.0, by=ESTIMATOR) == ""

"""A film without grooves is another bearing than the one with two of 20 deg whose table Lund and Thomsen
(1978) print.

The table itself, sixteen Sommerfeld numbers at L / D = 0.5, is held by the validation manual
(tests/validation/journal.py).
"""

from __future__ import annotations

import numpy as np

from labpipe.methods.journal_bearing.curve import journal_curve
from labpipe.methods.journal_bearing.film import FilmMesh
from tests.validation.journal import LUND_THOMSEN


def test_without_grooves_single_coefficients_differ_by_half() -> None:
    """A whole film is another bearing: at S = 6.43 it lacks most of the direct stiffness."""
    plain = journal_curve(0.5, 0.0, FilmMesh(72, 12), 60).coefficients(LUND_THOMSEN[:1, 0])
    printed = LUND_THOMSEN[0, 3:7]
    assert np.max(np.abs(plain[0][0, :4] / printed - 1)) > 0.5

"""The series correction of a measured radial stiffness over the preloads of Knaapen (1997).

His natural frequencies, one-dof fits and bending stiffness are rows of the validation manual
(tests/validation/rolling.py).
"""

from __future__ import annotations

import pytest

from labpipe.methods.rolling_bearing.loads import without_shaft
from labpipe.records.uncertain import Uncertain
from tests.validation.rolling import PRINTED, preloaded


@pytest.mark.parametrize(("name", "shaft"), [("6208", 1.176e8), ("7208", 1.2902e8)])
def test_amplification_of_the_series_correction(name: str, shaft: float) -> None:
    """1.5 to 3.5 over the preloads of both bearings."""
    for bearing, force in PRINTED:
        if bearing != name:
            continue
        k = preloaded(name, force).stiffness[0][0, 0]
        corrected = without_shaft(Uncertain(1 / (1 / k + 1 / shaft), 1e6), Uncertain(shaft, 1e6))
        assert corrected.bearing.value == pytest.approx(k, rel=1e-9)
        assert 1.5 <= corrected.amplification < 3.55

"""The stator's spectra in a band."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.floating_bearing.stator import stator_of
from tests.methods.floating_bearing.floating_rig import SEAL, FloatingRig, kcm


def test_three_lines_are_the_fewest() -> None:
    spectra = FloatingRig(kcm(**SEAL)).draw(np.random.default_rng(1))
    third, second = (float(spectra.frequency[n]) for n in (2, 1))
    found = stator_of(spectra, (0.0, third), (), ())
    np.testing.assert_allclose(found.omega, 2 * np.pi * spectra.frequency[:3])
    with pytest.raises(FitError, match=r"^2 lines in the band"):
        stator_of(spectra, (0.0, second), (), ())

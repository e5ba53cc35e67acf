"""Whirl directions of a spinning shaft.

Its frequencies and those of other beams are in the validation manual (validation/rotors.py).
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.rotor.response import modes
from labpipe.methods.rotor.shaft import NodeSupport
from tests.validation.rotors import NO_DAMPING, RIGID, beam


@pytest.mark.parametrize("mode", [1, 2, 3])
def test_pairs_of_a_spinning_shaft_whirl_backward_and_forward(mode: int) -> None:
    """Pinned, l 1 m, d .1 m, 3000 rad/s: circles, the lower one against the spin."""
    supports = [NodeSupport(node, RIGID, NO_DAMPING) for node in (1, 13)]
    found = modes(beam(1.0, 0.1, 12), supports, 3000.0)
    np.testing.assert_allclose(found.whirl[2 * mode - 2 : 2 * mode], [-1, 1], atol=1e-3)

"""Receptance <-> mobility <-> accelerance: one factor j w per time derivative of the response."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import ConfigError

DERIVATIVES = {"receptance": 0, "mobility": 1, "accelerance": 2}


def receptance_factor(form: str, frequency: NDArray[np.floating]) -> NDArray[np.complexfloating]:
    """(j w)^n by which a receptance is multiplied to give *form*, (n_frequency,); ConfigError for a form that is no such FRF."""
    if form not in DERIVATIVES:
        raise ConfigError(f"a response of the form '{form}' cannot be identified", hint="displacement, velocity or acceleration per force")
    factor: NDArray[np.complexfloating] = (2j * np.pi * frequency) ** DERIVATIVES[form]
    return factor

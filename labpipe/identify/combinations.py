"""Combinations of parameters in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import FloatArray


def combination_text(names: Sequence[str], direction: FloatArray, least: float = 0.2) -> str:
    """A *direction* (n_parameter,) [-] as text: "clearance +1.00, viscosity +2.00" where both change; without parts below *least*."""
    # Sorted as printed: parts that look alike keep the order of their names, whatever their last digits.
    order = np.argsort(-np.round(np.abs(direction) / np.max(np.abs(direction)), 2), kind="stable")
    direction = direction / direction[order[0]]
    parts = [f"{names[n]} {direction[n]:+.2f}" for n in order if abs(direction[n]) >= least]
    return ", ".join(parts)

"""A model between the measured lines: so many frequencies that straight lines from one to the next show its resonances as they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray

# Parts of the step between two lines, least number of frequencies in a band, and the largest.
PARTS, FEWEST, MOST = 2, 200, 2000
# Largest distance of the model from a straight line between two neighbours, as part of its size.
FLATNESS = 0.005
ROUNDS = 12

Model = Callable[[FloatArray], ComplexArray]


def drawn_densely(model: Model, lines: FloatArray) -> tuple[FloatArray, ComplexArray]:
    """Frequencies (n,) [Hz] from the first to the last of *lines*, all of which they hold, and the model there (n, n_output, n_input).

    Between two lines stand PARTS - 1 more, or as many as make FEWEST in all; where the model still bends by more than FLATNESS from
    one to the next, as at a light resonance, the step is halved again, up to MOST frequencies.
    """
    frequency = between(lines)
    values = model(frequency)
    for _ in range(ROUNDS):
        middle = (frequency[:-1] + frequency[1:]) / 2
        if not middle.size or frequency.size >= MOST:
            break
        at_middle = model(middle)
        bend = _bend(values, at_middle)
        # The most bent steps first, as many as there is room for.
        ranked = np.argsort(-bend, kind="stable")[: MOST - frequency.size]
        chosen = np.sort(ranked[bend[ranked] > FLATNESS])
        if not chosen.size:
            break
        frequency = np.insert(frequency, chosen + 1, middle[chosen])
        values = np.insert(values, chosen + 1, at_middle[chosen], axis=0)
    return frequency, values


def between(lines: FloatArray) -> FloatArray:
    """The lines (n_line,) [Hz] with equal parts of every step between them, (n,) [Hz]."""
    steps = max(lines.size - 1, 1)
    parts = max(1, min(max(PARTS, -(-(FEWEST - 1) // steps)), (MOST - 1) // steps))
    places = np.arange((lines.size - 1) * parts + 1) / parts
    return np.interp(places, np.arange(lines.size), lines)


def _bend(values: ComplexArray, at_middle: ComplexArray) -> FloatArray:
    """(n - 1,) largest distance of any element from the straight line across each step, as part of its size there."""
    across = np.abs(at_middle - (values[:-1] + values[1:]) / 2)
    size = np.maximum(np.abs(at_middle), np.finfo(float).tiny)
    return np.asarray((across / size).max(axis=(1, 2)))

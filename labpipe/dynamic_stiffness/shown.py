"""What is drawn of a fitted dynamic stiffness: H line by line with its noise, the model and the baseline over frequency."""

from __future__ import annotations

import numpy as np

from labpipe.dynamic_stiffness.effective import effective
from labpipe.dynamic_stiffness.given import Given
from labpipe.dynamic_stiffness.likelihood import Balance
from labpipe.dynamic_stiffness.lines import shown_stiffness
from labpipe.dynamic_stiffness.values import Doubted
from labpipe.dynamic_stiffness.whirl import LIMIT
from labpipe.records.dynamic_stiffness import DynamicStiffness, GivenDoubt

# Frequencies at which the model is drawn.
N_DRAWN = 60


def shown_course(balance: Balance, found: Doubted, doubts: tuple[GivenDoubt, ...], given: Given, sense: float) -> DynamicStiffness:
    """The record of a fit for figures and for later fits that take it as their baseline."""
    lines, variance = shown_stiffness(balance, found.model.stiffness(found.values, balance.omega))
    omega = np.linspace(balance.omega[0], balance.omega[-1], N_DRAWN)
    course = effective(found.model, found.values, found.whole, omega, sense)

    def ends(value: np.ndarray, error: np.ndarray) -> np.ndarray:
        return np.stack([value, value - LIMIT * error, value + LIMIT * error], axis=-1)

    return DynamicStiffness(
        found.model.form.name,
        found.model.symmetry,
        found.values,
        found.noise,
        doubts,
        frequency=lines.omega / (2 * np.pi),
        measured=lines.stiffness,
        variance=variance,
        paired=lines.paired,
        drawn_frequency=omega / (2 * np.pi),
        fitted=found.model.stiffness(found.values, omega),
        effective_stiffness=ends(course.stiffness, course.stiffness_error),
        effective_damping=ends(course.damping, course.damping_error),
        baseline=None if given.baseline is None else given.baseline.stiffness(omega),
        bands=found.model.form.bands,
        absolute=given.absolute,
    )

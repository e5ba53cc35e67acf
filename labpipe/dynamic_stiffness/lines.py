"""The dynamic stiffness line by line without a model, for figures and for least squares as in the literature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.dynamic_stiffness.likelihood import Balance, times, whitened
from labpipe.errors import FitError

# Condition number of the motions of all runs beyond which they are one direction.
ONE_DIRECTION = 1e3


@dataclass(frozen=True)
class LineStiffness:
    """H = G m^-1 (n_line, 2, 2) [N/m] at omega (n_line,) [rad/s]; inverse (n_line, n_run, 2) [1/m]: rows of m^-1, by run.

    *paired*: the vectors of two neighbouring lines taken together, each line having one only.
    """

    omega: FloatArray
    stiffness: ComplexArray
    inverse: ComplexArray
    paired: bool = False


def line_stiffness(balance: Balance) -> LineStiffness:
    """H of every line from two or more runs; FitError where the runs of a line move in one direction. Equation (ds-line)."""
    n_run = balance.motion.shape[1]
    if n_run < 2:
        raise FitError(
            "least squares needs two runs with independent forces at every line, there is one", hint="estimator: ml needs one run only"
        )
    motion = balance.motion.swapaxes(-1, -2)
    if np.any(np.linalg.cond(motion) > ONE_DIRECTION):
        raise FitError("the runs move the stator in one direction at a line", hint="two independent directions of force, or estimator: ml")
    inverse = np.linalg.pinv(motion)
    return LineStiffness(balance.omega, balance.right.swapaxes(-1, -2) @ inverse, inverse)


def shown_stiffness(balance: Balance, stiffness: ComplexArray) -> tuple[LineStiffness, FloatArray]:
    """H line by line and its variance (n_line, 2, 2) [(N/m)^2], lines left out that do not tell H; of one run by pairs of lines.

    stiffness (n_line, 2, 2) [N/m] of a model gives the noise of the balance, and the course between the two lines of a pair: H is the
    model in their middle and what both lines leave.
    """
    state = whitened(balance, stiffness)
    noise = np.stack([state.l_xx**2, np.abs(state.l_yx) ** 2 + state.l_yy**2], axis=-1)
    residual, motion, omega = balance.right - times(stiffness[:, None], balance.motion), balance.motion, balance.omega
    paired = motion.shape[1] < 2
    if paired:
        omega, stiffness = (
            _pairs(omega[:, None, None]).mean(axis=(1, 2)),
            _pairs(stiffness.reshape(-1, 1, 4)).mean(axis=1).reshape(-1, 2, 2),
        )
        residual, motion, noise = _pairs(residual), _pairs(motion), _pairs(noise)
    vectors = motion.swapaxes(-1, -2)
    is_determined = np.linalg.cond(vectors) < ONE_DIRECTION
    inverse = np.linalg.pinv(vectors[is_determined])
    h = stiffness[is_determined] + residual[is_determined].swapaxes(-1, -2) @ inverse
    variance = np.einsum("lri,lrj->lij", noise[is_determined], np.abs(inverse) ** 2)
    return LineStiffness(omega[is_determined], h, inverse, paired), variance


def _pairs(values: NDArray[Any]) -> NDArray[Any]:
    """(n_line, 1, n) as (n_line // 2, 2, n): two neighbouring lines as two runs."""
    n = values.shape[0] // 2
    return values[: 2 * n].reshape(n, 2, values.shape[2])

"""What another excitation of the same time and peak force would have given, from the information that every line brought.

The information of a line about the coefficients goes with the square of its force, whatever the rest does. A spectrum of the same r.m.s.
and crest factor shifts it among the lines; both forces at once, with the opposite sign of one of them in the second run, bring twice as
much of it as one after the other.
"""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.dynamic_stiffness.estimate import Estimate
from labpipe.dynamic_stiffness.stator import Stator
from labpipe.records.dynamic_stiffness import OtherExcitation

# Share of the power of the forces below which a line or a direction does not act.
QUIET = 1e-4
SHAPES = (("amplitude ~ 1/f", -1), ("amplitude the same at all lines", 0), ("amplitude ~ f", 1))
LETTERS = ("k", "c", "m")


def other_excitations(stator: Stator, found: Estimate, columns: FloatArray) -> tuple[OtherExcitation, ...]:
    """Ratios of standard errors by noise to those of this test; columns (n_equation, n_parameter) [1/parameter unit] of the Jacobian.

    Equation (ds-excitation).
    """
    n_line, n_run = stator.channels.shape[:2]
    rows = columns.reshape(2, n_line, 2 * n_run, -1).transpose(1, 0, 2, 3).reshape(n_line, 4 * n_run, -1)
    scale = np.linalg.norm(columns, axis=0)
    rows = rows / np.where(scale > 0, scale, 1.0)
    information = rows.swapaxes(1, 2) @ rows
    power = np.sum(np.abs(stator.axes[..., :2]) ** 2, axis=(1, 2))
    acting = power > QUIET * power.max()
    per_power = information[acting] / power[acting, None, None]
    here = _errors(np.sum(information[acting], axis=0))
    letters = [name[0] for name in found.model.names]
    others = []
    for name, exponent in SHAPES:
        shape = stator.omega[acting] ** (2 * exponent)
        planned = shape * power[acting].sum() / shape.sum()
        others.append(_ratios(name, _errors(np.tensordot(planned, per_power, 1)) / here, letters))
    if one_at_a_time(stator):
        others.append(_ratios("both forces at once, + + and + -", np.full(here.size, np.sqrt(0.5)), letters))
    return tuple(others)


def _errors(information: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(np.diag(np.linalg.pinv(information, hermitian=True)), np.finfo(float).tiny))


def _ratios(name: str, ratios: FloatArray, letters: list[str]) -> OtherExcitation:
    """Geometric mean over the elements of K, of C and of M."""
    means = [
        (letter, float(np.exp(np.mean(np.log(ratios[[one == letter for one in letters]]))))) for letter in LETTERS if letter in letters
    ]
    return OtherExcitation(name, tuple(letter for letter, _ in means), tuple(ratio for _, ratio in means))


def one_at_a_time(stator: Stator) -> bool:
    """Whether every run has forces in one direction only, and not all the same."""
    power = np.sum(np.abs(stator.axes[..., :2]) ** 2, axis=0)
    single = np.min(power, axis=1) < QUIET * np.max(power, axis=1)
    return bool(np.all(single) and np.unique(np.argmax(power, axis=1)).size == 2)


def motion_note(stator: Stator) -> str:
    """The amplitude that the coefficients hold for."""
    size = np.sqrt(np.mean(np.sum(np.abs(stator.axes[..., 2:4]) ** 2, axis=0) / 2, axis=0))
    x, y = (f"{1e6 * value:.3g} um" for value in size)
    return f"dynamic-stiffness: the coefficients hold for motions of this size: r.m.s. of the displacements {x} in x, {y} in y."

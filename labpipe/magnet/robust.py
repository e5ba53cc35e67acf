"""Hand-over to robust control design: the levitated rotor as state space, and the smallest band that covers the measured scatter."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.magnet.balance import MagnetModel
from labpipe.magnet.estimate import MagnetEstimate
from labpipe.records.identification import FittedCurve
from labpipe.records.robust import RobustPlant

# Corner frequencies of an overbound that are tried, per decade and beyond the lines [decades].
PER_DECADE, BEYOND = 12, 1.5


def robust_plant(best: MagnetEstimate, curve: FittedCurve, dof: float, confidence: float) -> RobustPlant:
    """The band of radius |G^ - G_nominal| + r, r of the measured scatter, which holds the true plant at all lines with *confidence*.

    |G^ - G|^2 / var is F with 2 and 2 nu degrees of freedom, of which the quantile of one line is that of all by their number (Sidak).
    *dof* nu: complex ones behind the variance.
    """
    assert curve.variance is not None
    radius = np.abs(curve.measured - curve.fitted) + np.sqrt(curve.variance) * scatter_radius(dof, curve.variance.size, confidence)
    # An element that the model lacks has no size of its own.
    weight = radius / np.linalg.norm(curve.fitted, 2, axis=(1, 2))[:, None, None]
    a, b, c, d = state_space(best.model, best.values)
    n_output, n_input = weight.shape[1:]
    bounds = [[overbound(curve.frequency, weight[:, row, column]) for column in range(n_input)] for row in range(n_output)]
    return RobustPlant(
        frequency=curve.frequency,
        nominal=curve.fitted,
        radius=radius,
        weight=weight,
        a=a,
        b=b,
        c=c,
        d=d,
        overbound=np.array(bounds),
        confidence=confidence,
        unit="m/A",
        outputs=curve.outputs,
        inputs=curve.inputs,
    )


def scatter_radius(dof: float, count: int, confidence: float) -> float:
    """sqrt of the quantile of |e|^2 / var of *count* independent complex values together [1]; closed form of F with 2 and 2 nu.

    Equation (mag-radius).
    """
    beyond = -np.expm1(np.log(confidence) / count)
    return float(np.sqrt(-np.log(beyond) if not np.isfinite(dof) else dof * np.expm1(-np.log(beyond) / dof)))


def state_space(model: MagnetModel, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A (2 n, 2 n), B (2 n, n), C (n, 2 n), D (n, n) [SI] of displacements and velocities under the currents."""
    matrices, n = model.matrices(values), len(model.mass)
    a, b, c = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, n)), np.zeros((n, 2 * n))
    a[:n, n:], c[:, :n] = np.eye(n), np.eye(n)
    a[n:] = np.linalg.solve(model.mass, np.hstack([-matrices["k_s"], -matrices["c"]]))
    b[n:] = np.linalg.solve(model.mass, matrices["k_i"])
    return a, b, c, np.zeros((n, n))


def overbound(frequency: FloatArray, weight: FloatArray) -> tuple[float, float, float]:
    """k [1], zero and pole [Hz] of the weight of first order with the least mean logarithm that is nowhere below *weight* (n_line,) [1].

    Equation (mag-overbound).
    """
    low, high = np.log10(frequency[0]) - BEYOND, np.log10(frequency[-1]) + BEYOND
    corners = np.logspace(low, high, int(PER_DECADE * (high - low)) + 1)
    shapes = np.log(np.abs(1 + 1j * frequency / corners[:, None]))
    ratio = shapes[:, None] - shapes[None]
    gain = np.max(np.log(weight) - ratio, axis=2)
    zero, pole = np.unravel_index(int(np.argmin(gain + np.mean(ratio, axis=2))), gain.shape)
    return float(np.exp(gain[zero, pole])), float(corners[zero]), float(corners[pole])

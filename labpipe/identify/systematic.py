"""What systematic errors do to a minimum of squares: one more step of Gauss-Newton, and the part of chi-square that they explain."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray


def steps_by(changes: FloatArray, slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """-C J^T dr (n_source, n_parameter) [parameter units] by changes dr (n_source, n_datum) [1] of the residual of slopes J.

    slopes (n_datum, n_parameter) [1/parameter unit]; covariance (n_parameter, n_parameter) [parameter units] (J^T J)^-1.
    Equation (unc-step).
    """
    return np.asarray(-changes @ slopes @ covariance)


def explained(residual: FloatArray, changes: FloatArray, slopes: FloatArray, covariance: FloatArray) -> float:
    """The part of chi-square [1] that systematic errors explain, each of them 0 +- 1 standard uncertainty.

    residual (n_datum,) [1] at the minimum; changes (n_source, n_datum) [1], with what the fit follows of them taken out; slopes
    (n_datum, n_parameter) [1/parameter unit] and covariance (n_parameter, n_parameter) [parameter units] as for the steps.
    Equation (unc-explained).
    """
    if not len(changes):
        return 0.0
    left = changes + steps_by(changes, slopes, covariance) @ slopes.T
    projected = changes @ residual
    return float(projected @ np.linalg.solve(np.eye(len(left)) + left @ changes.T, projected))

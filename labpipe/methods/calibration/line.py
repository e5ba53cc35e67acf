"""Calibration lines: slope with standard error, test of curvature, linear range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.distributions import student_tail
from labpipe.errors import FitError
from labpipe.estimation.regression import solve_scaled
from labpipe.estimation.statistics import condition_number, correlation, estimated
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import STRAIGHT_LINE, Fit, Goodness

CURVATURE_P = 0.01


@dataclass(frozen=True)
class Line:
    """y = slope x + intercept: values (1 or 2,) and covariance (2, 2) in this order (slope alone through the
    origin), residual (n_point,).

    Units: slope [y unit / x unit], intercept and residual [y unit].
    """

    values: FloatArray
    covariance: FloatArray
    residual: FloatArray
    r2: float
    dof: int
    condition_number: float

    @property
    def slope(self) -> float:
        return float(self.values[0])


def fit_line(x: FloatArray, y: FloatArray, *, through_origin: bool = False) -> Line:
    """Least-squares line through points x, y (n_point,) [any unit]; standard errors from the residual.

    R^2 about the mean, or about zero through the origin. Raises FitError with fewer points than parameters +
    1, or when x does not vary. Equation (spec-line).
    """
    columns = x[:, None] if through_origin else np.column_stack([x, np.ones_like(x)])
    n_parameter = columns.shape[1]
    if x.size <= n_parameter:
        raise FitError(
            f"{x.size} points cannot determine a line with its uncertainty",
            hint=f"at least {n_parameter + 1} are needed",
        )
    if not np.ptp(x) > 0:
        raise FitError("all points have the same x")
    values, inverse = solve_scaled(columns, y)
    residual = y - columns @ values
    dof = x.size - n_parameter
    total = float(np.sum(y**2) if through_origin else np.sum((y - y.mean()) ** 2))
    r2 = 1 - float(residual @ residual) / total if total > 0 else 0.0
    scaled = columns / np.linalg.norm(columns, axis=0)
    return Line(
        values, inverse * float(residual @ residual) / dof, residual, r2, dof, condition_number(scaled)
    )


def curvature_p(x: FloatArray, y: FloatArray) -> float | None:
    """p-value [1] of a quadratic term beside the line (t-test) for points x, y (n_point,); None with too few
    points.

    Equation (spec-curvature).
    """
    if x.size < 5:
        return None
    centred = (x - x.mean()) / np.ptp(x)
    columns = np.column_stack([centred**2, centred, np.ones_like(x)])
    values, inverse = solve_scaled(columns, y)
    residual = y - columns @ values
    variance = float(residual @ residual) / (x.size - 3)
    if variance == 0:
        return None
    return 2 * student_tail(abs(values[0]) / np.sqrt(variance * inverse[0, 0]), x.size - 3)


def linear_range(positions: FloatArray, slopes: FloatArray, tolerance: float) -> float:
    """Largest |position| [unit of positions] up to which every slope is within *tolerance* [1] of that at the
    smallest |position|.

    positions, slopes (n_position,).
    """
    order = np.argsort(np.abs(positions))
    within = np.abs(slopes[order] / slopes[order[0]] - 1) <= tolerance
    last = int(np.argmin(within)) - 1 if not np.all(within) else within.size - 1
    return float(np.abs(positions[order[last]]))


def linear_range_of_curve(x: FloatArray, y: FloatArray, tolerance: float) -> float:
    """Largest range of x [its unit], from the smallest up, with a slope within *tolerance* [1] of the line
    through the first third.

    x, y (n_point,).
    """
    order = np.argsort(x)
    x, y = x[order], y[order]
    start = max(3, x.size // 3)
    reference = fit_line(x[:start], y[:start]).slope
    reach = start
    for end in range(start + 1, x.size + 1):
        local = fit_line(x[end - start : end], y[end - start : end]).slope
        if abs(local / reference - 1) > tolerance:
            break
        reach = end
    return float(x[reach - 1] - x[0])


def line_fit(
    name: str,
    test: str,
    line: Line,
    units: tuple[str, str],
    x: FloatArray,
    y: FloatArray,
    extra: tuple[Parameter, ...] = (),
) -> Fit:
    """A line through x, y (n_point,) as a Fit: parameters slope and intercept [*units*], a warning for curved
    points.
    """
    names = ("slope", "intercept")[: line.values.size]
    std_errors = np.sqrt(np.diag(line.covariance))
    parameters = tuple(
        estimated(parameter, unit, float(value), float(error), line.dof, None)
        for parameter, unit, value, error in zip(names, units, line.values, std_errors, strict=False)
    )
    n = x.size
    adjusted = 1 - (1 - line.r2) * (n - 1) / line.dof
    return Fit(
        name=name,
        model=STRAIGHT_LINE,
        estimator="ls",
        band_hz=(0.0, 0.0),
        lines=n,
        equations=n,
        dof=line.dof,
        gof=Goodness(line.r2, adjusted),
        parameters=(*parameters, *extra),
        condition_number=line.condition_number,
        correlation=correlation(line.covariance),
        findings=_curvature_findings(curvature_p(x, y), line, y),
        test=test,
    )


def _curvature_findings(p_value: float | None, line: Line, y: FloatArray) -> tuple[Finding, ...]:
    if p_value is None or p_value >= CURVATURE_P:
        return ()
    share = 100 * np.max(np.abs(line.residual)) / np.ptp(y)
    message = (
        f"the points bend (p = {p_value:.2g} for a straight line); the largest deviation is "
        f"{share:.2g} % of the range"
    )
    return (Finding("model-mismatch", message),)

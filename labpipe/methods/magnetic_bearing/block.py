"""Model block: an amplifier, a sensor or a whole chain as gain, delay and low-pass of an order that the data
ask for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.derived import reported_fit, without_intervals
from labpipe.estimation.descent import Minimum, minimise, sum_of_squares
from labpipe.estimation.diagnostics import MISMATCH_P, estimate_findings, goodness_findings
from labpipe.estimation.measured import Measured, measured_part, select_ports
from labpipe.estimation.regression import triangle_of
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate, determination, estimated, inflation_factors, widened
from labpipe.estimation.weights import has_noise, weight_uncertainty
from labpipe.methods.magnetic_bearing.settings import AUTO, ORDERS, BlockSettings
from labpipe.records.finding import Finding
from labpipe.records.identification import Candidate, Fit, FittedCurve, Goodness
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.bands import lines_in

# Corner frequencies of starts over the highest line, and the damping ratio of theirs.
CORNERS, DAMPING = (0.5, 3.0), 0.7
# Logarithm beyond which a parameter has run off.
FARTHEST = 40.0
STEP = 1e-6
LEAST_LINES = 4


@dataclass(frozen=True)
class Block:
    """K e^{-j w tau} times low-passes: values (n,) are ln |K|, tau scaled by the highest line, then ln f and
    ln zeta.
    """

    order: int
    sign: float
    highest: float

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of every parameter, as they are reported."""
        real = (("corner_frequency", "Hz"),) if self.order in (1, 3) else ()
        pair = (("f_n", "Hz"), ("zeta", "1")) if self.order >= 2 else ()
        return (("gain", "1"), ("delay", "s"), *real, *pair)

    def response(self, values: FloatArray, omega: FloatArray) -> ComplexArray:
        """G (n_line,) [1] of values (n,) [1] at omega (n_line,) [rad/s]. Equation (mag-block)."""
        s = 1j * omega
        total = self.sign * np.exp(np.clip(values[0], -FARTHEST, FARTHEST) - s * values[1] / self.highest)
        rest = list(np.exp(np.clip(values[2:], -FARTHEST, FARTHEST)))
        if self.order in (1, 3):
            total = total / (1 + s / (2 * np.pi * rest.pop(0)))
        if self.order >= 2:
            natural = 2 * np.pi * rest[0]
            total = total / (1 + 2 * rest[1] * s / natural + (s / natural) ** 2)
        return total

    def reported(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Parameters (n,) [their units] and their slopes (n,) over the values."""
        shown = np.exp(values)
        shown[0], shown[1] = self.sign * shown[0], values[1] / self.highest
        slopes = np.abs(shown)
        slopes[1] = 1 / self.highest
        return shown, slopes


class _Problem:
    """The whitened residual of a block, with Re and Im of unit variance."""

    def __init__(self, measured: Measured, block: Block) -> None:
        assert measured.covariance is not None
        self.block, self.omega, self.matrix = block, measured.omega, measured.matrix[:, 0, 0]
        self.weight = np.sqrt(2 / measured.covariance[:, 0, 0].real)

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.weight * self.matrix))

    def residual(self, parameters: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            left = self.weight * (self.matrix - self.block.response(parameters, self.omega))
        return np.concatenate([left.real, left.imag])

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        steps = STEP * np.eye(parameters.size)
        pairs = [(self.residual(parameters + step), self.residual(parameters - step)) for step in steps]
        return np.column_stack([(ahead - behind) / (2 * STEP) for ahead, behind in pairs])

    def chi2(self, parameters: FloatArray) -> float:
        return sum_of_squares(self.residual, parameters)


def block_fits(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    """One fit, or one per band.

    ConfigError for more than one input or output, FitError for lines without noise or too few.
    """
    rows, columns = select_ports(response, settings.input, settings.output)
    if len(rows) != 1 or len(columns) != 1:
        raise ConfigError(
            f"a block has one input and one output, not {len(columns)} and {len(rows)}",
            hint="name them: input, output",
        )
    fits = []
    for band in settings.bands or (settings.band,):
        lines = np.ones(response.frequency.size, bool) if band is None else lines_in(response.frequency, band)
        measured = measured_part(replace(response, form="receptance"), rows, columns, lines)
        fits.append(_fit(measured, response, settings))
    return tuple(fits)


def _fit(measured: Measured, response: FrequencyResponse, settings: FitSettings) -> Fit:
    block_settings: BlockSettings = settings.model_settings
    if not has_noise(measured):
        raise FitError("the noise of the response is not known", hint="average several periods or blocks")
    if measured.omega.size < LEAST_LINES:
        raise FitError(
            f"{measured.omega.size} lines in the band", hint=f"{LEAST_LINES} or more: widen `band`"
        )
    orders = ORDERS[1:] if block_settings.order == AUTO else [block_settings.order]
    minima = [minimum for order in orders if (minimum := _most_likely(measured, int(order))) is not None]
    if not minima:
        raise FitError("no block can be determined by these lines", hint="widen the band")
    pairs = sorted(
        ((_candidate(measured, *minimum), minimum) for minimum in minima), key=lambda pair: pair[0].bic or 0.0
    )
    candidates = tuple(candidate for candidate, _ in pairs) if block_settings.order == AUTO else ()
    return _reported(measured, response, settings, *pairs[0][1], candidates)


def _most_likely(measured: Measured, order: int) -> tuple[_Problem, Minimum] | None:
    """The best of the descents from several corner frequencies."""
    sign = float(np.sign(measured.matrix[0, 0, 0].real)) or 1.0
    problem = _Problem(measured, Block(order, sign, float(measured.omega[-1])))
    level = float(np.log(np.abs(measured.matrix[0, 0, 0])))
    highest = float(measured.omega[-1]) / (2 * np.pi)
    ends = []
    for share in CORNERS if order else (1.0,):
        corner = np.log(share * highest)
        shape = [[], [corner], [corner, np.log(DAMPING)], [corner, corner, np.log(DAMPING)]][order]
        ends.append(minimise(problem, np.array([level, 0.0, *shape])))
    ends = [end for end in ends if end.converged and np.linalg.cond(problem.jacobian(end.values)) < 1 / STEP]
    return (problem, min(ends, key=lambda end: problem.chi2(end.values))) if ends else None


def _candidate(measured: Measured, problem: _Problem, minimum: Minimum) -> Candidate:
    n = minimum.values.size
    dof = measured.n_equation - n
    uncertainty = weight_uncertainty(measured, dof)
    squares = problem.chi2(minimum.values) / uncertainty.excess
    bic = squares + n * float(np.log(measured.n_equation))
    chi2_p = uncertainty.p_value(squares / dof, dof)
    return Candidate(f"order {problem.block.order}", n, squares, dof, squares + 2 * n, bic=bic, chi2_p=chi2_p)


def _reported(
    measured: Measured,
    response: FrequencyResponse,
    settings: FitSettings,
    problem: _Problem,
    minimum: Minimum,
    candidates: Sequence[Candidate],
) -> Fit:
    best = _candidate(measured, problem, minimum)
    jacobian = problem.jacobian(minimum.values)
    covariance = weight_uncertainty(measured, best.dof).inflation * np.linalg.pinv(
        jacobian.T @ jacobian, hermitian=True
    )
    assert best.chi2_p is not None
    factor = float(np.sqrt(best.chi2 / best.dof)) if best.chi2_p < MISMATCH_P else 1.0
    design = triangle_of(jacobian)
    values, slopes = problem.block.reported(minimum.values)
    fitted = problem.block.response(minimum.values, measured.omega)[:, None, None]
    r2, adjusted = determination(measured.matrix, measured.matrix - fitted, values.size)
    gof = Goodness(r2, adjusted, best.chi2 / best.dof, best.chi2_p)
    names = tuple(name for name, _ in problem.block.names)
    vifs, errors = inflation_factors(design), slopes * np.sqrt(np.diag(covariance))
    plain = [
        estimated(name, unit, float(value), float(error), best.dof, float(vif))
        for (name, unit), value, error, vif in zip(problem.block.names, values, errors, vifs, strict=True)
    ]
    parameters = [widened(parameter, factor) if factor > 1 else parameter for parameter in plain]
    as_estimate = Estimate(
        values=values,
        covariance=covariance,
        scaled_design=design,
        gof=gof,
        dof=best.dof,
        converged=minimum.converged,
        iterations=minimum.steps,
    )
    excess = (
        f"the residual is {factor:.3g} times the noise: the block has zeros or a higher order, or the "
        "loop biases its FRF"
    )
    cure = "`frf: {reference: r}` where the loop is closed"
    mismatch = [Finding("model-mismatch", f"{excess}; {cure}")] if factor > 1 else []
    frequency = measured.omega / (2 * np.pi)
    assert measured.covariance is not None
    band = (float(frequency[0]), float(frequency[-1]))
    shown = tuple(parameters) if minimum.converged else without_intervals(parameters)
    ports = (measured.outputs, measured.inputs)
    outputs, inputs = (tuple(port.label for port in side) for side in ports)
    return replace(
        reported_fit(settings, as_estimate, shown, band, frequency.size),
        findings=(
            *estimate_findings(as_estimate, names, frequency.size),
            *goodness_findings(gof),
            *mismatch,
            *response.findings,
        ),
        candidates=tuple(candidates),
        curve=FittedCurve(
            frequency,
            measured.matrix,
            fitted,
            variance=measured.covariance[:, :1, :1].real,
            outputs=outputs,
            inputs=inputs,
            form=response.form,
        ),
    )

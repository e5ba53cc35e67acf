"""A residual that is not noise, and the intervals that hold in spite of it.

It is judged at the minimum of the output error, whatever the estimator: by chi-square where the noise is
known, else by its structure. Where it is not noise, the model error stands in values and intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import chance_text
from labpipe.errors import FitError
from labpipe.estimation.budget import Case
from labpipe.estimation.coefficient_error import CoefficientError, coefficient_error
from labpipe.estimation.descent import minimise
from labpipe.estimation.diagnostics import MISMATCH_P, excess, excess_text
from labpipe.estimation.leakage import shared_residual
from labpipe.estimation.likelihood import Assessed, assess
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import FittedModel, ReceptanceModel
from labpipe.estimation.model_error import MOVED_FREQUENCY, SECOND_MODE, ModelError, model_error
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.regression import inverse_of
from labpipe.estimation.residual import GROWING, LOCAL, Null, Structure, line_scatter, residual_structure
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate, Stated, orthonormal, student_limit
from labpipe.estimation.weights import NOISE_FREE, Weights, complex_rows, has_noise
from labpipe.records.finding import Finding
from labpipe.records.identification import Goodness
from labpipe.spectra.bands import MAINS

MOST_STEPS = 40
# Distance from ml in standard errors at which another estimator counts as biased.
BIASED = 4.0
# A line is left out by so much more variance; of fewer lines one is too large a part. It is named with so
# many hertz to either side.
OUT, FEWEST_LINES, EITHER = 1e12, 10, 0.01

# What a missing or moved mode leaves in a few lines is not noise, though noise of their power explains it.
OF_A_MODE = (MOVED_FREQUENCY, SECOND_MODE)
WEIGH = "Measure several averages, or give their number and the coherence, so that lines count by their noise"
RICHER = "Use a richer model, or narrow the band"
# How a cause of a residual ends that is another law of damping, or of stiffness, or cross terms.
LAW, RELAXES, CROSS = " damping", "(relaxation)", "cross terms of x and y"
BY_BANDS = "Fit `sliding` bands, each with its own k and c"
# Where nothing could tell whether a residual is noise.
NOT_JUDGED = Finding(
    "not-judged",
    "whether the residual is noise could not be judged: the noise is not known, and for the structure of the "
    "residual the lines are too few, or the output error has no minimum here. The intervals hold only if the "
    "model is right",
)


@dataclass(frozen=True)
class Judgement:
    """Findings on a residual; the *covariance* (n_parameter, n_parameter) [parameter units] that intervals
    allow for, None where those of noise hold; the *model_error* that stands in values and intervals, and
    *by_cause*: the findings where something else that has a name alone explains the residual.
    """

    findings: tuple[Finding, ...] = ()
    covariance: FloatArray | None = None
    model_error: ModelError | CoefficientError | None = None
    by_cause: Callable[[str], tuple[Finding, ...]] | None = None


@dataclass(frozen=True)
class _Minimum:
    problem: OutputError[ReceptanceModel]
    values: FloatArray
    assessed: Assessed
    p_value: float
    structure: Structure | None = None


@dataclass(frozen=True)
class _Judge:
    """Judges minima of the output error of one measurement; the parameters of `judge`."""

    measured: Measured
    model: FittedModel
    estimate: Estimate
    settings: FitSettings
    n_band: int
    leaking: bool
    stated: Stated | None

    @property
    def factor(self) -> float | None:
        """The excess over the measured noise, or None."""
        return excess(self.estimate.gof.chi2_reduced, self.estimate.gof.chi2_p)

    def finding(self, text: str, remedy: str, line_hz: float | None = None) -> tuple[Finding, ...]:
        """The finding: leakage of short blocks looks like a wrong model; a narrower band would not help."""
        if self.leaking:
            text = f"leakage of the short blocks, or a wrong model: {text}"
            remedy = "Use longer blocks first: a narrower band leaves the leakage as it is"
        return (Finding("model-mismatch", f"{text}. {remedy}", line_hz=line_hz),)

    def minimum(self, problem: OutputError[ReceptanceModel], start: FloatArray) -> _Minimum | None:
        """The minimum from *start* (n_parameter,); None where there is none, or it cannot be judged."""
        try:
            minimum = minimise(problem, start, most_steps=MOST_STEPS, linearise=problem.linearise)
            if not minimum.converged:
                return None
            assessed = assess(self.measured, self.model, problem, minimum.values, stated=self.stated)
        except (FitError, np.linalg.LinAlgError):
            return None
        structure = None
        p_value = 1.0 if _is_exact(problem, minimum.values) else assessed.p_value
        if p_value is None:
            structure = self.structure(problem, minimum.values, Null(self.measured.line_noise))
            if structure is None:
                return None
            p_value = min(1.0, structure.p_value * self.n_band)
        return _Minimum(problem, minimum.values, assessed, p_value, structure)

    def structure(
        self, problem: OutputError[ReceptanceModel], values: FloatArray, null: Null
    ) -> Structure | None:
        """The structure of the residual at *values* (n_parameter,) [parameter units] against noise."""
        measured = self.measured
        size = np.abs(measured.form_size[:, None, None] * measured.matrix).reshape(measured.omega.size, -1)
        residual, jacobian = problem.residual(values), problem.jacobian(values)
        if self.stated is not None:
            # What stated numbers change is not a structure of a wrong model, of whatever size.
            jacobian = orthonormal(np.column_stack([jacobian, self.stated.changes.T]))
            residual = residual - jacobian @ (jacobian.T @ residual)
        return residual_structure(residual, jacobian, size, null)

    def explains(self, best: _Minimum, power: str) -> bool:
        """True where noise of this *power* along the lines explains the residual of unknown noise."""
        if best.structure is None:
            return False
        # The p-value only has to be above MISMATCH_P.
        null = Null(self.measured.line_noise, power, few=True)
        structure = self.structure(best.problem, best.values, null)
        return structure is not None and structure.p_value >= MISMATCH_P


def _is_exact(problem: OutputError[ReceptanceModel], values: FloatArray) -> bool:
    """True for a residual at *values* (n_parameter,) [parameter units] that is rounding."""
    try:
        return bool(np.linalg.norm(problem.residual(values)) <= NOISE_FREE * problem.size)
    except FitError:
        return False


def judge(
    measured: Measured,
    model: FittedModel,
    estimate: Estimate,
    settings: FitSettings,
    n_band: int = 1,
    *,
    leaking: bool = False,
    stated: Stated | None = None,
) -> Judgement:
    """Whether the residual of *estimate* is noise, and the intervals that hold if it is not.

    p-values are for the best of *n_band* bands (Bonferroni); *leaking*: a finding says that blocks are short;
    *stated*: numbers that it allows for. Without convergence, or of amplitudes alone, nothing is judged but a
    measured excess over the noise.
    """
    judged = _Judge(measured, model, estimate, settings, n_band, leaking, stated)
    if (has_noise(measured) and judged.factor is None) or not estimate.converged:
        return Judgement()
    problem = OutputError.of(measured, model)
    if _is_exact(problem, estimate.values):
        return Judgement()
    minimum = judged.minimum(problem, estimate.values) if settings.estimates.phase else None
    if minimum is None:
        return Judgement((NOT_JUDGED,)) if judged.factor is None else _judge_by_factor(judged, estimate.gof)
    if minimum.p_value >= MISMATCH_P:
        return _judge_by_bias(judged, minimum)
    if judged.explains(minimum, GROWING):
        return _with_model_error(judged, minimum, OF_A_MODE) or _judge_uneven_noise(judged, minimum, GROWING)
    if judged.explains(minimum, LOCAL):
        return _judge_uneven_noise(judged, minimum, LOCAL)
    return (
        _judge_one_line(judged, minimum)
        or _with_model_error(judged, minimum)
        or _with_coefficient_error(judged, minimum)
        or _judge_by_excess(judged, minimum)
    )


def _judge_by_bias(judged: _Judge, best: _Minimum) -> Judgement:
    """The model is right: what another estimator is away from ml is its bias."""
    estimate, estimator = judged.estimate, judged.settings.estimator
    away = best.values - estimate.values
    errors = np.sqrt(np.diag(estimate.covariance))
    ratios = np.divide(np.abs(away), errors, out=np.zeros_like(away), where=errors > 0)
    if np.max(ratios) < BIASED:
        return Judgement()
    worst, covariance = int(np.argmax(ratios)), _with_distance(estimate.covariance, away)
    text = (
        f"{estimator} is biased by the noise of the FRF: {judged.model.names[worst]} is {ratios[worst]:.2g} "
        "standard errors from what the same model gives by ml, whose residual is noise. "
        f"{_growth(estimate, covariance)} since they include the distance"
    )
    return Judgement(judged.finding(text, "Use the estimator ml"), covariance)


def errors_by_lines(case: Case) -> Estimate:
    """The estimate of ml with errors from the scatter of every line by itself, where the noise is unknown: if
    it grows with the response, its mean is too small where lines say most of damping. What lines share
    enlarges errors as it does those of even noise.
    """
    measured, estimate, of_ml = case.measured, case.estimate, case.setup.settings.estimates.likelihood
    if has_noise(measured) or not (of_ml and estimate.converged):
        return estimate
    problem, n_line = OutputError.of(measured, case.model), measured.omega.size
    jacobian, residual = problem.jacobian(estimate.values), problem.residual(estimate.values)
    covariance = line_scatter(jacobian, residual, n_line, alone=True).covariance
    if measured.line_noise is not None:
        inverse = inverse_of(problem.linearise(estimate.values))
        shared = shared_residual(measured.line_noise, complex_rows(jacobian, n_line), inverse)
        larger = np.sqrt(np.diag(shared.covariance) / np.diag(inverse))
        covariance = covariance * np.outer(larger, larger)
    return replace(estimate, covariance=covariance)


def _judge_uneven_noise(judged: _Judge, best: _Minimum, power: str) -> Judgement:
    """Lines of different noise: the scatter of every line stands for its own noise."""
    measured, estimate = judged.measured, judged.estimate
    jacobian, residual = best.problem.jacobian(best.values), best.problem.residual(best.values)
    scatter = line_scatter(jacobian, residual, measured.omega.size, alone=True)
    limits = [student_limit(max(int(dof), 1)) / student_limit(estimate.dof) for dof in scatter.dof]
    covariance = measured.shared_noise * scatter.covariance * np.outer(limits, limits)
    covariance = _with_distance(_raise_to(covariance, estimate.covariance), best.values - estimate.values)
    growth = f"{_growth(estimate, covariance)} since they come from the scatter of every line by itself"
    if power == LOCAL:
        text = f"the noise, which is not known, differs along the band: that explains the residual. {growth}"
        return Judgement((Finding("uneven-noise", f"{text}. {WEIGH}"),), covariance)
    text = (
        f"{_wording(best)}; noise that grows with the response explains it, as from gains that scatter from "
        f"line to line. {growth}"
    )
    cure = "Look for a gain that is not steady, or a response that is not linear"
    return Judgement(judged.finding(text, cure), covariance)


def _judge_one_line(judged: _Judge, best: _Minimum) -> Judgement | None:
    """One line alone is off, as by a hum that repeats with the periods; None where others are as well."""
    measured, estimate = judged.measured, judged.estimate
    n_line = measured.omega.size
    if best.structure is not None or measured.covariance is None or measured.noise is not None:
        return None
    if n_line <= FEWEST_LINES:
        return None
    squares = np.sum(best.problem.residual(best.values).reshape(2, n_line, -1) ** 2, axis=(0, 2))
    line = int(np.argmax(squares))
    covariance = np.array(measured.covariance)
    covariance[line] *= OUT
    without = replace(judged, measured=replace(measured, covariance=covariance))
    other = without.minimum(OutputError.of(without.measured, judged.model), best.values)
    if other is None or other.p_value < MISMATCH_P:
        return None
    line_hz = float(measured.omega[line] / (2 * np.pi))
    alone, remedy = line_alone(line_hz)
    away = other.values - estimate.values
    wide = _with_distance(_raise_to(other.assessed.covariance, estimate.covariance), away)
    ratios = np.abs(away) / np.sqrt(np.maximum(np.diag(other.assessed.covariance), np.finfo(float).tiny))
    worst = int(np.argmax(ratios))
    text = (
        f"{_wording(best)}, and {alone}. Without it the fit is good (p = {other.p_value:.2g}) and "
        f"{judged.model.names[worst]} is {ratios[worst]:.2g} standard errors away. {_growth(estimate, wide)} "
        "since they include the distance"
    )
    return Judgement(judged.finding(text, remedy, line_hz), wide)


def line_alone(frequency: float) -> tuple[str, str]:
    """That one line [Hz] alone makes a residual what it is, and the remedy."""
    mains = next((base for base in MAINS if abs(frequency / base - round(frequency / base)) < 0.01), None)
    hum = "" if mains is None else f", a multiple of the mains' {mains:g} Hz"
    return (
        f"the line at {frequency:.6g} Hz alone makes it so{hum}: something that repeats with the periods "
        "acts there besides the force",
        f"Leave the line out, `exclude: [{frequency - EITHER:.6g}-{frequency + EITHER:.6g} Hz]`",
    )


def _with_model_error(judged: _Judge, best: _Minimum, causes: Sequence[str] = ()) -> Judgement | None:
    """None where the evidence for *causes* is less than for all others."""
    error = model_error(judged.measured, judged.model, best.values, judged.settings)
    if error is None or (causes and sum(error.discrepancy.shares.get(cause, 0.0) for cause in causes) < 0.5):
        return None
    factor = max(float(np.max([error.growth_of(name) for name in error.rows])), 1.0)
    return _state(judged, best, error, "Values and intervals", factor)


def _state(
    judged: _Judge, best: _Minimum, error: ModelError | CoefficientError, what: str, growth: float
) -> Judgement:
    def findings(cause: str) -> tuple[Finding, ...]:
        of_law = ", or wider by that law's values" if cause.endswith((LAW, RELAXES, CROSS)) else ""
        text = (
            f"{_wording(best)}; most likely {cause}. {what} include what the model leaves unexplained, "
            f"and are up to {growth:.3g} times as wide as noise alone makes them{of_law}"
        )
        return judged.finding(text, BY_BANDS if cause.endswith(RELAXES) else RICHER)

    return Judgement(findings(error.reason), model_error=error, by_cause=findings)


def _with_coefficient_error(judged: _Judge, best: _Minimum) -> Judgement | None:
    weights = _noise_weights(judged, best)
    if weights is None:
        return None
    larger = judged.measured.shared_noise
    if best.assessed.reduced is not None:
        larger = float(np.max(np.diag(best.assessed.covariance) / np.diag(best.assessed.inverse)))
    error = coefficient_error(judged.measured, best.problem.model, best.values, weights, larger)
    return None if error is None else _state(judged, best, error, "Intervals", error.growth)


def _noise_weights(judged: _Judge, best: _Minimum) -> Weights | None:
    """Of the measured noise; where it is not known, of that between neighbouring lines of the residual."""
    if best.structure is None:
        return best.problem.weights
    measured = judged.measured
    residual = measured.matrix - best.problem.model.receptance(best.values, measured.omega)
    scatter = measured.scatter(measured.form_size[:, None, None] * residual).ravel()
    return (
        np.outer(measured.form_size, 1 / np.sqrt(scatter)).astype(np.complex128)
        if np.all(scatter > 0)
        else None
    )


def _judge_by_excess(judged: _Judge, best: _Minimum) -> Judgement:
    """The excess over the noise counts as noise; of unknown noise, neighbours that are alike count as one."""
    away = best.values - judged.estimate.values
    if best.structure is None:
        gof, assessed = judged.estimate.gof, best.assessed
        at_minimum = replace(gof, chi2_reduced=assessed.reduced, chi2_p=assessed.p_value)
        return _judge_by_factor(judged, at_minimum if judged.factor is None else judged.estimate.gof, away)
    covariance = _with_distance(judged.measured.omega.size / 2 * best.assessed.covariance, away)
    text = (
        f"{_wording(best)}. {_growth(judged.estimate, covariance)} since the lines are too few to tell a "
        "wrong model from noise, and all of them count as two"
    )
    return Judgement(judged.finding(text, "Use a model with more modes, or more lines"), covariance)


def _judge_by_factor(judged: _Judge, gof: Goodness, away: FloatArray | None = None) -> Judgement:
    """The excess over the measured noise taken as noise, beside the distance *away* from ml."""
    assert gof.chi2_reduced is not None
    estimate, estimator = judged.estimate, judged.settings.estimator
    covariance = gof.chi2_reduced * estimate.covariance
    if away is not None:
        covariance = _with_distance(covariance, away)
    # Equation errors exceed the noise for a correct model as well.
    biased = "" if judged.settings.estimates.unbiased else f", or {estimator} is biased"
    text = (
        f"{excess_text(gof.chi2_reduced, gof.chi2_p)}: the model is incomplete{biased}. "
        f"{_growth(estimate, covariance)} since the excess counts as noise; a mode missing within the band "
        "can be worse than that"
    )
    return Judgement(judged.finding(text, RICHER), covariance)


def _wording(best: _Minimum) -> str:
    if best.structure is None:
        return excess_text(best.assessed.reduced, best.p_value)
    said, p_value = best.structure.said, best.p_value
    return f"the residual is not noise: {said} ({chance_text(p_value)} for noise under the same fit)"


def _with_distance(covariance: FloatArray, away: FloatArray) -> FloatArray:
    """The covariance (n, n) with the distance (n,) of two fits as one standard error, wholly correlated."""
    return covariance + np.outer(away, away)


def _raise_to(covariance: FloatArray, least: FloatArray) -> FloatArray:
    ratio = np.sqrt(np.maximum(np.diag(least) / np.maximum(np.diag(covariance), np.finfo(float).tiny), 1.0))
    return covariance * np.outer(ratio, ratio)


def _growth(estimate: Estimate, covariance: FloatArray) -> str:
    before, after = np.sqrt(np.diag(estimate.covariance)), np.sqrt(np.diag(covariance))
    factors = after[before > 0] / before[before > 0]
    if not factors.size:
        return "The intervals that are printed are wider than those of noise alone,"
    low, high = float(np.min(factors)), float(np.max(factors))
    by = f"{high:.3g}" if high < 1.01 * low else f"{low:.3g} to {high:.3g}"
    return f"The intervals that are printed are {by} times those of noise alone,"

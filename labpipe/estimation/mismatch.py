"""A residual that is not noise, and the intervals that hold in spite of it.

A residual that is not noise, and the intervals that hold in spite of it.

The residual is judged at the minimum of the output error, whatever the estimator: by chi-square where the
noise is known, else by its structure. Where it is not noise, the residual terms of modes outside the band are
added and the fit is judged again. What explains the residual is what the intervals then allow for; where
nothing does, there are none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.estimation.descent import minimise
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.estimation.leakage import expected
from labpipe.estimation.likelihood import Assessed, assess
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import FittedModel, ReceptanceModel
from labpipe.estimation.model_error import ModelError, model_error
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.residual import DRAWS, Null, Structure, line_scatter, residual_structure
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate, Stated, orthonormal, student_limit
from labpipe.estimation.weights import NOISE_FREE, Weights, fit_weights, has_noise
from labpipe.records.finding import Finding

# A model with residual terms: a smooth complex curve per FRF for the modes outside the band, which a local
# model leaves out.


@dataclass(frozen=True)
class OutsideModes:
    """H(w) = model + sum_n C_n T_n(x): T_n the Chebyshev polynomials of the frequency mapped on -1 ... 1, C_n
    complex, one per FRF.

    Parameters: the *n_own* ones of *model*, then Re C, then Im C, each (n_term, n_element), in units of
    *size* (n_element,) [m/N]. *curves* (n_line, n_term) [1] on the lines of the fit. C is complex since modes
    outside the band need not be real (Ewins 2000, 4.6). Equation (est-outside).
    """

    model: ReceptanceModel
    n_own: int
    curves: FloatArray
    size: FloatArray

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H [m/N] at *parameters* (n_parameter,), (n_line, n_dof, n_input); *omega* (n_line,) [rad/s]."""
        receptance = self.model.receptance(parameters[: self.n_own], omega)
        amounts = parameters[self.n_own :].reshape(2, self.curves.shape[1], -1)
        return receptance + (self.curves @ ((amounts[0] + 1j * amounts[1]) * self.size)).reshape(
            receptance.shape
        )

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp, (n_parameter, n_line, n_dof, n_input) [m/N per parameter unit]."""
        jacobian = self.model.jacobian(parameters[: self.n_own], omega)
        # Parameters last in memory, as the fit wants them.
        slopes = np.empty((*jacobian.shape[1:], parameters.size), np.complex128)
        slopes[..., : self.n_own] = jacobian.transpose(1, 2, 3, 0)
        slopes[..., self.n_own :] = self._of_terms.reshape(*jacobian.shape[1:], -1)
        return slopes.transpose(3, 0, 1, 2)

    @cached_property
    def _of_terms(self) -> ComplexArray:
        """dH/dC of all terms, which no parameter changes, (n_line, n_element, 2 n_term n_element) [m/N]."""
        n_line, n_term = self.curves.shape
        terms = self.curves[:, None, :, None] * np.diag(self.size)[:, None, :]
        real = terms.reshape(n_line, self.size.size, n_term * self.size.size)
        return np.concatenate([real, 1j * real], axis=2)

    def start(self, values: FloatArray) -> FloatArray:
        """Start values (n_parameter,) [parameter units]: those of the model (n_own,) without residual
        terms.
        """
        return np.concatenate([values, np.zeros(2 * self.curves.shape[1] * self.size.size)])


def with_outside_modes(model: ReceptanceModel, measured: Measured, n_own: int, n_term: int) -> OutsideModes:
    """*model* of *n_own* parameters with *n_term* residual terms on the lines of *measured*."""
    w = measured.omega
    place = (2 * w - w[0] - w[-1]) / (w[-1] - w[0])
    size = np.sqrt(np.mean(np.abs(measured.matrix.reshape(w.size, -1)) ** 2, axis=0))
    return OutsideModes(model, n_own, np.polynomial.chebyshev.chebvander(place, n_term - 1), size)


# A residual that is not noise, and the intervals that hold in spite of it.

# Complex residual terms per FRF that are tried one after the other: constant and slope, then polynomials of
# higher degree.
TERMS = (2, 4, 6, 8)
MOST_STEPS = 40
# Draws of noise where a p-value only has to be above MISMATCH_P.
FEW_DRAWS = 299
# Terms that make an estimate this much less certain are not told apart from the model: their fit says nothing
# about it.
LEAST_CERTAIN = 4.0
# Real numbers in the largest Jacobian for which terms are added: of a matrix of many FRFs they would take
# longer than all the rest.
MOST_VALUES = 300_000
# Distance from ml in standard errors at which another estimator counts as biased.
BIASED = 4.0
# A line is left out by so much more variance; of fewer lines one is too large a part. It is named with so
# many hertz to either side, and where it is a multiple of the mains' frequency [Hz].
OUT, FEWEST_LINES, EITHER, MAINS = 1e12, 10, 0.01, (50.0, 60.0)


@dataclass(frozen=True)
class Judgement:
    """Findings on a residual, and what its intervals become.

    *covariance* (n_parameter, n_parameter) [parameter units]: what they allow for, None where those of noise
    hold. *refused*: no interval holds. *judged*: whether anything could tell that the residual is noise.
    *model_error*: what stands in values and intervals.
    """

    findings: tuple[Finding, ...] = ()
    covariance: FloatArray | None = None
    refused: bool = False
    judged: bool = True
    model_error: ModelError | None = None


@dataclass(frozen=True)
class _Minimum:
    """A fit of the output error judged: its minimum, its uncertainty, and the residual's p-value and
    structure (of unknown noise).
    """

    problem: OutputError[ReceptanceModel]
    values: FloatArray
    assessed: Assessed
    p_value: float
    structure: Structure | None = None


@dataclass(frozen=True)
class _Judge:
    """Judges minima of the output error of one measurement.

    *n_band*: bands that share the chance of a false alarm; *leaking*: a finding says that blocks are short;
    *stated*: numbers that the judgement allows for; *factor*: the excess over the measured noise, or None.
    """

    measured: Measured
    model: FittedModel
    estimate: Estimate
    settings: FitSettings
    n_band: int
    leaking: bool
    stated: Stated | None
    factor: float | None

    def finding(self, said: str, remedy: str) -> tuple[Finding, ...]:
        """The finding in words: leakage of short blocks looks like a wrong model, and a narrower band would
        not help.
        """
        if self.leaking:
            said = f"leakage of the short blocks, or a wrong model: {said}"
            remedy = "Use longer blocks first: a narrower band leaves the leakage as it is"
        return (Finding("model-mismatch", f"{said}. {remedy}"),)

    def minimum(self, model: ReceptanceModel, start: FloatArray, n_smooth: int = 0) -> _Minimum | None:
        """The minimum from *start* (n_parameter,) [parameter units] of a model with *n_smooth* residual
        terms.

        None where there is none, or it cannot be judged.
        """
        problem: OutputError[ReceptanceModel] = OutputError(self.measured, model, self._whitener)
        try:
            minimum = minimise(problem, start, most_steps=MOST_STEPS, linearise=problem.linearised)
            if not minimum.converged:
                return None
            assessed = assess(self.measured, self.model, problem, minimum.values, stated=self.stated)
        except (FitError, np.linalg.LinAlgError):
            return None
        if self.exact(model, minimum.values):
            return _Minimum(problem, minimum.values, assessed, 1.0)
        if assessed.p_value is not None:
            return _Minimum(problem, minimum.values, assessed, assessed.p_value)
        null = Null(self.measured.line_noise, n_smooth=n_smooth, n_draw=FEW_DRAWS if n_smooth else DRAWS)
        structure = self.structure(problem, minimum.values, null)
        if structure is None:
            return None
        p_value = structure.p_value if n_smooth else min(1.0, structure.p_value * self.n_band)
        return _Minimum(problem, minimum.values, assessed, p_value, structure)

    def structure(
        self, problem: OutputError[ReceptanceModel], values: FloatArray, null: Null
    ) -> Structure | None:
        """The structure of the residual at *values* (n_parameter,) [parameter units] against noise."""
        size = np.abs(self.measured.matrix).reshape(self.measured.omega.size, -1)
        residual, jacobian = problem.residual(values), problem.jacobian(values)
        if self.stated is not None:
            # What stated numbers change is no structure of a wrong model, of whatever size: the noise that
            # would limit it is not known.
            jacobian = orthonormal(np.column_stack([jacobian, self.stated.changes.T]))
            residual = residual - jacobian @ (jacobian.T @ residual)
        return residual_structure(residual, jacobian, size, null)

    def uneven(self, own: _Minimum) -> bool:
        """True where noise that grows with the response explains the residual of unknown noise."""
        if own.structure is None:
            return False
        structure = self.structure(
            own.problem, own.values, Null(self.measured.line_noise, uneven=True, n_draw=FEW_DRAWS)
        )
        return structure is not None and structure.p_value >= MISMATCH_P

    @cached_property
    def _whitener(self) -> Weights:
        return fit_weights(self.measured)

    def exact(self, model: ReceptanceModel, values: FloatArray) -> bool:
        """True for a residual at *values* (n_parameter,) [parameter units] that is rounding."""
        problem: OutputError[ReceptanceModel] = OutputError(self.measured, model, self._whitener)
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
    judged = _Judge(measured, model, estimate, settings, n_band, leaking, stated, excess(estimate))
    if (has_noise(measured) and judged.factor is None) or not estimate.converged:
        return Judgement()
    if judged.exact(expected(measured, model), estimate.values):
        return Judgement()
    minimum = (
        None if not settings.estimates.phase else judged.minimum(expected(measured, model), estimate.values)
    )
    if minimum is None:
        return Judgement(judged=False) if judged.factor is None else _by_factor(judged, judged.factor)
    if minimum.p_value >= MISMATCH_P:
        return _biased(judged, minimum)
    if judged.uneven(minimum):
        return _of_uneven_noise(judged, minimum)
    return (
        _of_one_line(judged, minimum)
        or _with_model_error(judged, minimum)
        or _explained(judged, minimum)
        or _unexplained(judged, minimum)
    )


def excess(estimate: Estimate) -> float | None:
    """sqrt(chi-square per degree of freedom) [1] where it is significantly above 1, else None.

    Equation (est-excess).
    """
    reduced, p_value = estimate.gof.chi2_reduced, estimate.gof.chi2_p
    return (
        float(np.sqrt(reduced))
        if reduced is not None and p_value is not None and p_value < MISMATCH_P
        else None
    )


def _biased(judged: _Judge, own: _Minimum) -> Judgement:
    """The model is right: what another estimator than ml is away from it is its bias."""
    estimate, estimator = judged.estimate, judged.settings.estimator
    away = own.values - estimate.values
    errors = np.sqrt(np.diag(estimate.covariance))
    ratios = np.divide(np.abs(away), errors, out=np.zeros_like(away), where=errors > 0)
    if np.max(ratios) < BIASED:
        return Judgement()
    worst, covariance = int(np.argmax(ratios)), _apart(estimate.covariance, away)
    said = (
        f"{estimator} is biased by the noise of the FRF: {judged.model.names[worst]} is {ratios[worst]:.2g} "
        "standard errors from what the same model gives by ml, whose residual is noise. "
        f"{_grown(estimate, covariance)} since they include the distance"
    )
    return Judgement(judged.finding(said, "Use the estimator ml"), covariance)


def _of_uneven_noise(judged: _Judge, own: _Minimum) -> Judgement:
    """Lines of different noise: the scatter of every line stands for its own noise."""
    measured, estimate = judged.measured, judged.estimate
    scatter = line_scatter(
        own.problem.jacobian(own.values), own.problem.residual(own.values), measured.omega.size, alone=True
    )
    limits = [student_limit(max(int(dof), 1)) / student_limit(estimate.dof) for dof in scatter.dof]
    covariance = measured.shared_noise * scatter.covariance * np.outer(limits, limits)
    covariance = _apart(_not_below(covariance, estimate.covariance), own.values - estimate.values)
    said = (
        f"{_said(own)}; noise that grows with the response explains it, as from gains that scatter from line "
        f"to line. {_grown(estimate, covariance)} since they come from the scatter of every line by itself"
    )
    return Judgement(
        judged.finding(said, "Look for a gain that is not steady, or a response that is not linear"),
        covariance,
    )


def _of_one_line(judged: _Judge, own: _Minimum) -> Judgement | None:
    """One line alone is what the model does not follow, as a hum that repeats with the periods leaves it;
    None where the fit without it is not good either.
    """
    measured, estimate = judged.measured, judged.estimate
    n_line = measured.omega.size
    if own.structure is not None or measured.covariance is None or measured.noise is not None:
        return None
    if n_line <= FEWEST_LINES:
        return None
    squares = np.sum(own.problem.residual(own.values).reshape(2, n_line, -1) ** 2, axis=(0, 2))
    line = int(np.argmax(squares))
    covariance = np.array(measured.covariance)
    covariance[line] *= OUT
    without = replace(judged, measured=replace(measured, covariance=covariance))
    other = without.minimum(own.problem.model, own.values)
    if other is None or other.p_value < MISMATCH_P:
        return None
    frequency = float(measured.omega[line] / (2 * np.pi))
    mains = next((base for base in MAINS if abs(frequency / base - round(frequency / base)) < 0.01), None)
    hum = "" if mains is None else f", a multiple of the mains' {mains:g} Hz"
    away = other.values - estimate.values
    wide = _apart(_not_below(other.assessed.covariance, estimate.covariance), away)
    ratios = np.abs(away) / np.sqrt(np.maximum(np.diag(other.assessed.covariance), np.finfo(float).tiny))
    worst = int(np.argmax(ratios))
    said = (
        f"{_said(own)}, and the line at {frequency:.6g} Hz alone makes it so{hum}: something that repeats "
        "with the periods acts there besides the force. Without it the fit is good "
        f"(p = {other.p_value:.2g}) and {judged.model.names[worst]} is {ratios[worst]:.2g} standard errors "
        "away. "
        f"{_grown(estimate, wide)} since they include the distance"
    )
    remedy = f"Leave the line out, `exclude: [{frequency - EITHER:.6g}-{frequency + EITHER:.6g} Hz]`"
    return Judgement(judged.finding(said, remedy), wide)


def _with_model_error(judged: _Judge, own: _Minimum) -> Judgement | None:
    """The model error of one mode inside the interval; None for other models."""
    error = model_error(judged.measured, judged.model, own.values, judged.settings)
    if error is None:
        return None
    factor = max(float(np.max([error.growth_of(name) for name in error.rows])), 1.0)
    said = (
        f"{_said(own)}; most likely {error.reason}. Values and intervals include what the model leaves "
        f"unexplained, and are up to {factor:.3g} times as wide as noise alone makes them"
    )
    return Judgement(judged.finding(said, "Use a richer model, or narrow the band"), model_error=error)


def _explained(judged: _Judge, own: _Minimum) -> Judgement | None:
    """Modes outside the band explain the residual; None where they do not."""
    estimate, n = judged.estimate, judged.estimate.values.size
    for n_term in TERMS:
        other = _with_terms(judged, own, n_term)
        if other is not None and other.p_value >= MISMATCH_P:
            covariance = _apart(
                _not_below(other.assessed.covariance[:n, :n], estimate.covariance),
                other.values[:n] - estimate.values,
            )
            said = (
                f"{_said(own)}. A smooth residual term, as modes beside the band leave it, explains it. "
                f"{_grown(estimate, covariance)} "
                "since they include how far the values are from those with this term"
            )
            return Judgement(
                judged.finding(said, "Use the model modal, which has such terms, or narrow the band"),
                covariance,
            )
    return None


def _with_terms(judged: _Judge, own: _Minimum, n_term: int) -> _Minimum | None:
    """The fit with residual terms.

    None where the lines are too few for it, or do not tell the terms from the model.
    """
    n, measured = own.values.size, judged.measured
    n_parameter = n + 2 * n_term * measured.matrix[0].size
    if measured.n_equation < 2 * n_parameter or measured.n_equation * n_parameter > MOST_VALUES:
        return None
    model = with_outside_modes(own.problem.model, measured, n, n_term)
    other = judged.minimum(model, model.start(own.values), n_term)
    if other is None:
        return None
    before, after = (np.diag(fit.assessed.inverse)[:n] for fit in (own, other))
    return other if np.all(after <= LEAST_CERTAIN**2 * before) else None


def _unexplained(judged: _Judge, own: _Minimum) -> Judgement:
    """Nothing explains the residual: a measured excess is counted as noise.

    Without a measure of noise there is no interval.
    """
    if own.structure is None:
        assert own.assessed.reduced is not None
        return _by_factor(
            judged, judged.factor or float(np.sqrt(own.assessed.reduced)), own.values - judged.estimate.values
        )
    said = (
        f"{_said(own)}, and smooth residual terms do not explain it: a mode is missing within the band, or "
        "gain or stiffness changed during the measurement. No interval is given, since none would hold"
    )
    return Judgement(judged.finding(said, "Use a model with more modes, or narrow the band"), refused=True)


def _by_factor(judged: _Judge, factor: float, away: FloatArray | None = None) -> Judgement:
    """The excess over the measured noise taken as noise, and the distance *away* of another estimator from ml
    beside it.
    """
    estimate, estimator = judged.estimate, judged.settings.estimator
    covariance = factor**2 * estimate.covariance
    if away is not None:
        covariance = _apart(covariance, away)
    # Equation errors are biased and inefficient: their residual exceeds the noise for a correct model as
    # well.
    cause = (
        "the model is incomplete"
        if judged.settings.estimates.unbiased
        else (f"the model is incomplete, or {estimator} is biased")
    )
    said = (
        f"the residual is {factor:.3g} times what the measured noise explains (chi-square per degree of "
        f"freedom {estimate.gof.chi2_reduced:.3g}, p = {estimate.gof.chi2_p:.2g}): {cause}. "
        f"{_grown(estimate, covariance)} since the excess counts as noise; a mode missing within the band "
        "can be worse than that"
    )
    return Judgement(judged.finding(said, "Use a richer model, or narrow the band"), covariance)


def _said(own: _Minimum) -> str:
    """What is wrong with the residual."""
    if own.structure is None:
        assert own.assessed.reduced is not None
        return (
            f"the residual is {np.sqrt(own.assessed.reduced):.3g} times what the measured noise explains "
            f"(chi-square per degree of freedom {own.assessed.reduced:.3g}, p = {own.p_value:.2g})"
        )
    return (
        f"the residual is not noise: {own.structure.said} (p = {own.p_value:.2g} for noise under the "
        "same fit)"
    )


def _apart(covariance: FloatArray, away: FloatArray) -> FloatArray:
    """The covariance (n, n) with the distance (n,) between two fits counted as one standard error, wholly
    correlated.
    """
    return covariance + np.outer(away, away)


def _not_below(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """The covariance (n, n) enlarged so far that no variance is below that of *least* (n, n)."""
    ratio = np.sqrt(np.maximum(np.diag(least) / np.maximum(np.diag(covariance), np.finfo(float).tiny), 1.0))
    return np.asarray(covariance * np.outer(ratio, ratio))


def _grown(estimate: Estimate, covariance: FloatArray) -> str:
    """By how much the intervals are wider than those of noise alone."""
    before, after = np.sqrt(np.diag(estimate.covariance)), np.sqrt(np.diag(covariance))
    factors = after[before > 0] / before[before > 0]
    if not factors.size:
        return "The intervals that are printed are wider than those of noise alone,"
    low, high = float(np.min(factors)), float(np.max(factors))
    by = f"{high:.3g}" if high < 1.01 * low else f"{low:.3g} to {high:.3g}"
    return f"The intervals that are printed are {by} times those of noise alone,"

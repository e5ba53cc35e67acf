"""Model worn-bearing: depth and angle of wear from the response of a rotor (Mendes et al. 2017), each with its doubt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.identify.dense_curve import drawn_densely
from labpipe.identify.diagnostics import MISMATCH_P, collinear_groups, estimate_findings, quality_findings
from labpipe.identify.regression import triangle_of
from labpipe.identify.settings import FitSettings
from labpipe.identify.statistics import (
    Estimate,
    condition_number,
    correlation,
    derived,
    determination,
    estimated,
    inflation_factors,
    student_limit,
)
from labpipe.identify.weights import weight_doubt
from labpipe.records.finding import Finding
from labpipe.records.identification import Fit, FittedCurve, Goodness, Parameter, Region
from labpipe.records.response import FrequencyResponse
from labpipe.wear.findings import (
    angle_findings,
    bound_findings,
    bounds_reached,
    healthy_findings,
    is_identifiable,
    rival_findings,
    search_note,
)
from labpipe.wear.healthy import UNFELT, healthy_minimum, healthy_probability
from labpipe.wear.measured import WornData, worn_data
from labpipe.wear.misfit import MISFITS, Misfit
from labpipe.wear.model import WornModel, worn_model
from labpipe.wear.profile import Interval, joint_region, profile_interval
from labpipe.wear.search import Minimum, merged, minima, refined, start_mesh
from labpipe.wear.settings import ANGLE, DEPTH, UNITS, WearSettings

# Rival minima are refined as the best one is, up to so many, while their chi-square is this near in units of the whole.
MOST_RIVALS, NEAR = 3, 0.5
LEAST_FELT = 1e-6
# Increase of chi-square below which a bearing without wear explains the response as well as the best wear.
ALIKE = 1e-3
# Rounds in which the residual tells its own standard deviation; one where nothing is known beforehand, since no minimum moves then.
SIZINGS = 2
REGION_LEVEL = 0.95
NAMES = {"complex": "ml", "log": "log-amplitude"}


@dataclass(frozen=True)
class _Solved:
    """The best minimum with its misfit in units of standard deviations, the others, and the least misfit without wear."""

    misfit: Misfit
    found: tuple[Minimum, ...]
    covariance: FloatArray
    healthy_chi2: float | None = None

    @property
    def best(self) -> Minimum:
        return self.found[0]

    @property
    def dof(self) -> int:
        """Real equations of the response less the parameters that it alone determines."""
        n_response = self.misfit.residual(self.best.parameters).size - self.misfit.n_known
        return n_response - (len(self.misfit.model.names) - self.misfit.n_known)


def worn_fit(response: FrequencyResponse, settings: FitSettings) -> Fit:
    """Depth and angle of wear (or, of a healthy rig, its viscosity, clearance, ...) that explain a response, as one Fit.

    ConfigError where settings, rotor and response do not fit together, FitError where the response cannot support the fit.
    """
    wear: WearSettings = settings.model_settings
    data = worn_data(response, settings, wear)
    solved = _solve(data, wear)
    estimate = _estimate(solved)
    parameters, findings = _reported(solved, estimate)
    frequency = data.frequency
    lines = np.isin(response.frequency, frequency)
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator=NAMES[wear.objective],
        band_hz=settings.band or (float(frequency[0]), float(frequency[-1])),
        lines=frequency.size,
        equations=estimate.dof + len(solved.misfit.model.names) - solved.misfit.n_known,
        dof=estimate.dof,
        gof=estimate.gof,
        parameters=parameters,
        condition_number=condition_number(estimate.scaled_design),
        correlation=correlation(solved.covariance),
        converged=estimate.converged,
        iterations=estimate.iterations,
        findings=(
            *_own_findings(solved, estimate, NAMES[wear.objective]),
            *findings,
            *quality_findings(response, [0, 1], [0, 1], lines),
        ),
        notes=(search_note(solved.found, wear),),
        curve=_curve(data, solved),
        region=_region(solved, parameters),
    )


def _solve(data: WornData, wear: WearSettings) -> _Solved:
    """Search on the tables, refine on the films; where the noise is not known, the residual tells it and the search is done again."""
    misfit = MISFITS[wear.objective](worn_model(wear, data.frequency), data)
    n_response = misfit.residual(start_mesh(wear, misfit)[0]).size - misfit.n_known
    if n_response <= len(misfit.model.names) - misfit.n_known:
        raise FitError(f"{n_response} equations cannot determine {len(misfit.model.names)} parameters", hint="use more lines or terms")
    found = minima(misfit, start_mesh(wear, misfit))
    for _ in range(0 if misfit.weighted else SIZINGS):
        own, ranked = _ranked(misfit, found[:1])
        ratio = _size(own, ranked[0])
        misfit = misfit.sized(misfit.size * ratio)
        if not misfit.n_known:
            found = [replace(one, chi2=one.chi2 / ratio**2) for one in found]
            break
        found = minima(misfit, start_mesh(wear, misfit))
    misfit, ranked = _ranked(misfit, found)
    healthy_chi2 = None
    if DEPTH in misfit.model.names:
        without, healthy = healthy_minimum(misfit, ranked[0])
        healthy_chi2 = healthy.chi2
        if healthy.chi2 < ranked[0].chi2 + ALIKE:
            misfit, ranked = without, merged([healthy, *ranked])
    jacobian = misfit.jacobian(ranked[0].parameters)
    return _Solved(misfit, tuple(ranked), np.linalg.inv(jacobian.T @ jacobian + UNFELT * np.eye(jacobian.shape[1])), healthy_chi2)


def _size(misfit: Misfit, best: Minimum) -> float:
    """Standard deviation of the response's part of the residual, 1e-12 at least."""
    residual = misfit.residual(best.parameters)[: -misfit.n_known or None]
    n_free = len(misfit.model.names) - misfit.n_known
    return max(float(np.sqrt(residual @ residual / (residual.size - n_free))), 1e-12)


def _ranked(misfit: Misfit, found: list[Minimum]) -> tuple[Misfit, list[Minimum]]:
    """The minima, the nearest rivals among them refined on the films, the lowest first with its own misfit."""
    near = [one for one in found[:MOST_RIVALS] if one.converged and one.chi2 <= found[0].chi2 + NEAR * (found[0].chi2 + 100)]
    pairs = [refined(misfit, one) for one in near] or [refined(misfit, found[0])]
    pairs.sort(key=lambda pair: (not pair[1].converged, pair[1].chi2))
    others = [one for one in found if not any(one is other for other in near)]
    return pairs[0][0], merged([*(pair[1] for pair in pairs), *others])


def _estimate(solved: _Solved) -> Estimate:
    """The estimate with its goodness, as the diagnostics know it."""
    misfit, best, dof = solved.misfit, solved.best, solved.dof
    data, names = misfit.data, misfit.model.names
    jacobian, felt = misfit.jacobian(best.parameters), list(_felt(solved))
    measured = data.terms(data.measured.matrix)
    modelled = data.terms(misfit.model.response(best.parameters)[0])
    r2, adjusted = determination(measured, measured - modelled, len(names))
    reduced, p_value = None, None
    if misfit.weighted:
        reduced = best.chi2 / misfit.excess / dof
        p_value = weight_doubt(data.measured, dof).p_value(reduced, dof)
    return Estimate(
        values=best.parameters,
        covariance=solved.covariance,
        scaled_design=triangle_of(jacobian[:, felt]) if felt else np.eye(1),
        gof=Goodness(r2, adjusted, reduced, p_value),
        dof=dof,
        converged=best.converged,
        iterations=sum(one.evaluations for one in solved.found),
    )


def _reported(solved: _Solved, estimate: Estimate) -> tuple[tuple[Parameter, ...], list[Finding]]:
    """Parameters in SI units and what must be said of them."""
    misfit, best = solved.misfit, solved.best
    at = bounds_reached(misfit, best)
    intervals = _intervals(solved)
    identifiable = ANGLE not in intervals or is_identifiable(intervals[ANGLE])
    factors = dict(zip(_felt(solved), inflation_factors(estimate.scaled_design).tolist(), strict=False))
    plain = [
        _parameter(solved, number, factors.get(number), intervals.get(name), identifiable) for number, name in enumerate(misfit.model.names)
    ]
    findings = [*bound_findings([name for name in at if identifiable or name != ANGLE]), *rival_findings(solved.found, misfit)]
    if solved.healthy_chi2 is None:
        return tuple(plain), findings
    probability = healthy_probability(misfit, best, solved.healthy_chi2)
    plain.append(derived("healthy_probability", "1", probability, 0.0, solved.dof))
    plain[-1] = replace(plain[-1], std_error=None, ci95=None)
    mismatch = estimate.gof.chi2_p is not None and estimate.gof.chi2_p < MISMATCH_P
    return tuple(plain), [*findings, *angle_findings(identifiable), *healthy_findings(probability, mismatch)]


def _intervals(solved: _Solved) -> dict[str, Interval]:
    """Profile intervals of depth and angle."""
    errors = np.sqrt(np.diag(solved.covariance))
    limit = student_limit(solved.dof)
    return {
        name: profile_interval(solved.misfit, solved.best, number, float(errors[number]), limit)
        for number, name in enumerate(solved.misfit.model.names)
        if name in (DEPTH, ANGLE)
    }


def _parameter(solved: _Solved, number: int, vif: float | None, interval: Interval | None, identifiable: bool) -> Parameter:
    """One parameter; an angle that is not identifiable and a parameter at its bound have no standard error."""
    model = solved.misfit.model
    name, scale = model.names[number], float(model.scale[number])
    value = scale * float(solved.best.parameters[number])
    error = scale * float(np.sqrt(solved.covariance[number, number]))
    at_bound = name in bounds_reached(solved.misfit, solved.best)
    found = estimated(name, UNITS[name], value, error, solved.dof, vif)
    if interval is not None:
        found = replace(found, ci95=(scale * interval.low, scale * interval.high))
    if at_bound or (name == ANGLE and not identifiable):
        ends = None if name == ANGLE and not identifiable else found.ci95 if interval is not None else None
        found = replace(found, std_error=None, t_ratio=None, significant=None, ci95=ends, at_bound=at_bound)
    return found


def _own_findings(solved: _Solved, estimate: Estimate, estimator: str) -> list[Finding]:
    """Findings on the estimate; parameters that are only estimated along may resemble each other, their prior holds them apart."""
    names = [solved.misfit.model.names[number] for number in _felt(solved)]
    found = estimate_findings(estimate, names, solved.misfit.data.frequency.size, estimator)
    group = {name for own in (collinear_groups(estimate.scaled_design, names) if names else []) for name in own}
    along = DEPTH in solved.misfit.model.names and not group & {DEPTH, ANGLE}
    return [finding for finding in found if finding.code != "collinear" or not along]


def _felt(solved: _Solved) -> tuple[int, ...]:
    """Numbers of the parameters that are inside their bounds and change the response."""
    misfit, best = solved.misfit, solved.best
    lengths = np.linalg.norm(misfit.jacobian(best.parameters), axis=0)
    at = bounds_reached(misfit, best)
    return tuple(n for n, name in enumerate(misfit.model.names) if lengths[n] > LEAST_FELT and name not in at)


def _region(solved: _Solved, parameters: tuple[Parameter, ...]) -> Region | None:
    """The joint region of depth and angle; None where neither is looked for, or the angle is not identifiable."""
    model = solved.misfit.model
    if DEPTH not in model.names or next(one for one in parameters if one.name == ANGLE).ci95 is None:
        return None
    outline = joint_region(solved.misfit, solved.best, solved.covariance, REGION_LEVEL)
    return Region((DEPTH, ANGLE), outline * model.scale[:2], REGION_LEVEL)


def _curve(data: WornData, solved: _Solved) -> FittedCurve:
    """Measured and fitted receptance in the fit's frame, all terms, between the lines too; of a tuning also the model before it."""
    measured = data.measured
    variance = None
    if measured.covariance is not None:
        variance = np.einsum("lii->li", measured.covariance).real.reshape(measured.matrix.shape)
    model, parameters = solved.misfit.model, solved.best.parameters
    fitted = model.response(parameters)[0]
    before = None if DEPTH in model.names else _untuned(model)

    def at(frequency: FloatArray) -> ComplexArray:
        return replace(model, frequency=tuple(frequency.tolist())).response(parameters)[0]

    dense = drawn_densely(at, data.frequency)
    return FittedCurve(data.frequency, measured.matrix, fitted, variance, data.names, data.names, "receptance", before, *dense)


def _untuned(model: WornModel) -> ComplexArray:
    """The response with what was known beforehand, on the films themselves."""
    mean = np.array(model.known.mean) / model.scale
    return model.refined(mean, with_slopes=False).response(mean)[0]

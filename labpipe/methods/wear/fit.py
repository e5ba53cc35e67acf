"""Model worn-bearing: depth and angle of wear from the response of a rotor (Mendes et al. 2017)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import amount_text, chance_text
from labpipe.distributions import chi2_tail
from labpipe.errors import ConfigError, FitError
from labpipe.estimation import diagnostics
from labpipe.estimation.budget import Source, with_sources
from labpipe.estimation.derived import drawn_densely, reported_fit
from labpipe.estimation.measured import changes_by
from labpipe.estimation.regression import triangle_of
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate, appraise, determination, inflation_factors, student_limit
from labpipe.estimation.weights import weight_uncertainty
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.wear import search
from labpipe.methods.wear.model import MISFITS, WornMisfit, WornReceptance, worn_model, worn_receptance
from labpipe.methods.wear.settings import ANGLE, DEPTH, UNITS, WearSettings
from labpipe.quantities import UnitError, parse_value
from labpipe.records.finding import Finding, Parameter
from labpipe.records.fit_details import Region
from labpipe.records.identification import Fit, FittedCurve, Goodness
from labpipe.records.response import FrequencyResponse
from labpipe.records.uncertain import Uncertainty

# Excess of chi-square below which further minima count: the 99 % quantile for two parameters.
RIVAL = 9.21
AT_BOUND = 1e-4
# Share by which the speeds of a test and of its rotor file may differ.
SAME_SPEED = 0.01
PROBABLY_HEALTHY, PROBABLY_WORN = 0.5, 0.05


def reached_bounds(misfit: WornMisfit, best: search.WearMinimum) -> tuple[str, ...]:
    model = misfit.model
    margin = AT_BOUND * (model.high - model.low)
    at = (best.parameters <= model.low + margin) | (best.parameters >= model.high - margin)
    return tuple(name for name, hit in zip(model.names, at, strict=True) if hit)


def bound_finding(name: str) -> Finding:
    reason = {
        DEPTH: "no wear is visible, or it is deeper than depth_limit",
        ANGLE: "the wear is farther from the bottom than angle_limit, or the angle is not identifiable",
    }.get(name, "the best fit lies outside the prior range; the model may lack another effect")
    return Finding("at-bound", f"{name} lies at its bound: {reason}. No standard error is given for it")


def rival_findings(minima: Sequence[search.WearMinimum], misfit: WornMisfit) -> list[Finding]:
    best = minima[0]
    rivals = [minimum for minimum in minima[1:] if minimum.converged and minimum.chi2 - best.chi2 < RIVAL]
    if not rivals or DEPTH not in misfit.model.names:
        return []
    places = "; ".join(
        f"{_place(misfit, minimum)} (chi-square {minimum.chi2 - best.chi2:+.2g})" for minimum in rivals
    )
    message = (
        f"the misfit has further minima of nearly the same chi-square: {places}. Use more lines, all terms, "
        "or the complex objective; prior knowledge of the bearing may select one"
    )
    return [Finding("multi-modal", message)]


def _place(misfit: WornMisfit, minimum: search.WearMinimum) -> str:
    values = misfit.model.values(minimum.parameters)
    return f"{values[DEPTH] * 1e6:.3g} um at {np.degrees(values[ANGLE]):.3g} deg"


NO_ANGLE = Finding(
    "not-identifiable",
    "angle not identifiable: every angle in the range fits equally well, as is usual with shallow wear",
)


def healthy_findings(probability: float, mismatch: bool) -> list[Finding]:
    """Where a healthy bearing is not ruled out; *mismatch*: the residual exceeds the noise."""
    if probability < PROBABLY_WORN:
        return []
    odds = f"the probability of no wear is {probability:.3g} (prior: even odds, wear uniform over the range)"
    if probability >= PROBABLY_HEALTHY and not mismatch:
        return [Finding("healthy", f"the bearing is probably healthy: {odds}")]
    given = ", given a right model, which chi-square rejects" if mismatch else ""
    return [Finding("perhaps-healthy", f"the bearing may be healthy: {odds}{given}")]


def search_note(minima: Sequence[search.WearMinimum], settings: WearSettings, mesh: FilmMesh) -> str:
    total = sum(minimum.starts for minimum in minima)
    return (
        f"{minima[0].starts} of {total} starts lead to this minimum, {len(minima)} minima in all; refined on "
        f"oil films of {mesh.around} x {mesh.across} cells around tables of {settings.cells_around} x "
        f"{settings.cells_across}."
    )


# Further minima that are refined as the best one is, at most, and their relative excess of chi-square.
MOST_RIVALS, NEAR = 3, 0.5
LEAST_SENSITIVITY = 1e-6
# Share of a standard error that is none of noise.
ROUNDING = 1e-6
# Increase of chi-square below which zero wear fits as well as the best wear.
ALIKE = 1e-3
# Rounds that estimate the residual's standard deviation; one without a prior, since no minimum moves then.
SIZINGS = 2
REGION_LEVEL = 0.95
# Share of a prior's variance below which the lines say nothing of it, and the chance of what contradicts it.
SAYS_NOTHING, CONTRADICTED_P = 1e-3, 1e-3
NAMES = {"complex": "ml", "log": "log-amplitude"}


@dataclass(frozen=True)
class _Solved:
    misfit: WornMisfit
    minima: tuple[search.WearMinimum, ...]
    noise_covariance: FloatArray
    film_covariance: FloatArray
    healthy_chi2: float | None = None

    @property
    def covariance(self) -> FloatArray:
        return self.noise_covariance + self.film_covariance

    @property
    def best(self) -> search.WearMinimum:
        return self.minima[0]

    @property
    def dof(self) -> int:
        """Real equations of the response minus parameters without a prior."""
        n_response = self.misfit.residual(self.best.parameters).size - self.misfit.n_prior
        return n_response - (len(self.misfit.model.names) - self.misfit.n_prior)


def worn_fit(response: FrequencyResponse, settings: FitSettings) -> Fit:
    """Depth and angle of wear (or, of a healthy rig, its viscosity, clearance, ...) that explain a response.
    ConfigError where settings, rotor and response do not fit together, FitError where it cannot support them.
    """
    wear: WearSettings = settings.model_settings
    _check_speed(response, wear)
    measured = worn_receptance(response, settings, wear)
    solved = _solve(measured, wear)
    estimate = _estimate(solved)
    parameters, findings = _report(solved, estimate)
    frequency, name = measured.frequency, NAMES[wear.objective]
    band = settings.band or (float(frequency[0]), float(frequency[-1]))
    fit = replace(
        reported_fit(settings, estimate, parameters, band, frequency.size, solved.misfit.n_prior),
        estimator=name,
        findings=(
            *_estimate_findings(solved, estimate, "" if wear.objective == "complex" else name),
            *findings,
            *diagnostics.quality_findings(response, [0, 1], [0, 1], measured.lines),
        ),
        notes=(search_note(solved.minima, wear, solved.misfit.model.film_mesh),),
        curve=_curve(measured, solved),
        details=_region(solved, parameters),
    )
    sources = _sources(solved, measured, wear, len(parameters))
    mismatch = estimate.gof.chi2_p is not None and estimate.gof.chi2_p < diagnostics.MISMATCH_P
    if solved.misfit.n_prior and not mismatch:
        fit = replace(fit, findings=(*fit.findings, *_prior_findings(solved, sources, wear)))
    fit, of_prior = _fit_without_prior(fit, solved, wear)
    return with_sources(fit, [*of_prior, *sources])


def _prior_findings(solved: _Solved, sources: Sequence[Source], wear: WearSettings) -> list[Finding]:
    """Where the lines contradict the prior: its rows d = R (p - p_0) vary by 1 - R C R^T, of what the lines
    tell, and by the change of each of the *sources*.
    """
    misfit, model, n = solved.misfit, solved.misfit.model, solved.misfit.n_prior
    parameters, prior = solved.best.parameters, model.prior
    rows, off = (of(parameters)[-n:] for of in (misfit.jacobian, misfit.residual))
    moved = np.array([rows @ (change[: parameters.size] / model.scale) for _, change in sources])
    spread = np.eye(n) - rows @ solved.covariance @ rows.T + moved.reshape(-1, n).T @ moved.reshape(-1, n)
    sizes, axes = np.linalg.eigh(spread)
    clear = sizes > SAYS_NOTHING
    chance = chi2_tail(float(np.sum((off @ axes)[clear] ** 2 / sizes[clear])), int(np.sum(clear)))
    if chance >= CONTRADICTED_P:
        return []
    # The parameter that went farthest of what the lines may move it.
    root = np.linalg.inv(rows[:, -n:])
    shift, error = root @ off, np.sqrt(np.diag(root @ spread @ root.T))
    worst = int(np.argmax(np.abs(shift) / error))
    mean, unit = prior.mean[worst], UNITS[prior.names[worst]]
    middle = mean + float(shift[worst] * model.scale[-n:][worst])
    stated = amount_text(mean, float(prior.std[worst]), unit, "+-")
    of = f"the fit '{wear.prior}'" if wear.prior else "what was stated"
    message = (
        f"the lines contradict {of} ({chance_text(chance)}), most of all {prior.names[worst]} {stated}: both "
        f"together give {amount_text(middle, None, unit)}, which may be neither. The wear, the oil or the "
        "rig is another one than then, or what was stated is known worse"
    )
    return [Finding("stated-value", message)]


def _fit_without_prior(fit: Fit, solved: _Solved, wear: WearSettings) -> tuple[Fit, list[Source]]:
    """The fit with the errors that its lines leave, and those of the fit that `prior` names as sources, which
    all fits with it have in common: C R^T of the prior's rows R.
    """
    misfit, prior = solved.misfit, solved.misfit.model.prior
    if not wear.prior:
        return fit, []
    rows = misfit.jacobian(solved.best.parameters)[-misfit.n_prior :]
    changes = np.zeros((len(prior.names), len(fit.parameters)))
    changes[:, : len(misfit.model.names)] = misfit.model.scale * (rows @ solved.noise_covariance)
    parameters = list(fit.parameters)
    for number, parameter in enumerate(parameters):
        if (error := parameter.std_error) and (ends := parameter.ci95) is not None:
            of_prior = float(np.sum(changes[:, number] ** 2)) / error**2
            ratio, value = max(1 - of_prior, ROUNDING**2) ** 0.5, parameter.value
            low, high = (value + ratio * (end - value) for end in ends)
            parameters[number] = replace(parameter, std_error=ratio * error, ci95=(low, high))
    # Another tuning of the same name has other values, and errors of its own.
    names = [
        Uncertainty(f"{wear.prior}.{name} = {mean:.6g} {UNITS[name]}", error, UNITS[name])
        for name, mean, error in zip(prior.names, prior.mean, prior.std.tolist(), strict=True)
    ]
    return replace(fit, parameters=tuple(parameters)), list(zip(names, changes, strict=True))


def _check_speed(response: FrequencyResponse, wear: WearSettings) -> None:
    try:
        speed = parse_value(response.conditions.get("speed", "").partition("+-")[0], "Hz")
    except UnitError:
        return
    if wear.rig is not None and abs(speed - wear.rig.speed) > SAME_SPEED * wear.rig.speed:
        what = f"the test ran at {speed:g} Hz, the rotor of its fit turns at {wear.rig.speed:g} Hz"
        raise ConfigError(what, hint="name a rotor file of that speed with wear.rotor")


def _sources(solved: _Solved, measured: WornReceptance, wear: WearSettings, n_parameter: int) -> list[Source]:
    """Change (n_parameter,) [parameter units] by each error of the sensors and of the bearings' numbers that
    are not estimated: one step of the fit from its minimum, C J^T r.
    """
    misfit, best, objective = solved.misfit, solved.best.parameters, wear.objective
    uncertainties = misfit.model.rig.sources
    if not measured.errors and not uncertainties:
        return []
    response, slopes = misfit.model.response(best)
    modelled, of_parameters = measured.terms(response), measured.terms(slopes)
    step = solved.noise_covariance @ misfit.jacobian(best)[: -misfit.n_prior or None].T
    beside = np.zeros(n_parameter - len(misfit.model.names))

    def residual(of: WornReceptance, terms: ComplexArray) -> FloatArray:
        return MISFITS[objective](misfit.model, of).compared(terms, of_parameters)[0] / misfit.size

    def change_by(residual: FloatArray) -> FloatArray:
        return np.concatenate([-misfit.model.scale * (step @ residual), beside])

    def values(change: ComplexArray) -> FloatArray:
        moved = replace(measured.measured, matrix=measured.measured.matrix + change)
        return change_by(residual(replace(measured, measured=moved), modelled))

    def by_bearings(source: str) -> FloatArray:
        change = np.zeros(step.shape[1])
        for pair in misfit.model.rig.ends(source):
            for rig, half in zip(pair, (0.5, -0.5), strict=True):
                model = worn_model(replace(wear, rig=rig), measured.frequency).refine(best, False)
                change += half * residual(measured, measured.terms(model.response(best)[0]))
        return change_by(change)

    return [
        *changes_by(measured.errors, values),
        *((uncertainty, by_bearings(uncertainty.source)) for uncertainty in uncertainties),
    ]


def _solve(measured: WornReceptance, wear: WearSettings) -> _Solved:
    misfit = MISFITS[wear.objective](worn_model(wear, measured.frequency), measured)
    n_response = misfit.residual(search.start_mesh(wear, misfit)[0]).size - misfit.n_prior
    if n_response <= len(misfit.model.names) - misfit.n_prior:
        what = f"{n_response} equations cannot determine {len(misfit.model.names)} parameters"
        raise FitError(what, hint="use more lines or terms")
    candidates = search.minima(misfit, search.start_mesh(wear, misfit))
    for _ in range(0 if misfit.weighted else SIZINGS):
        refined_misfit, ranked = _rank(misfit, candidates[:1])
        residual = refined_misfit.residual(ranked[0].parameters)[: -refined_misfit.n_prior or None]
        n_free = len(refined_misfit.model.names) - refined_misfit.n_prior
        ratio = max(float(np.sqrt(residual @ residual / (residual.size - n_free))), 1e-12)
        misfit = misfit.resize(misfit.size * ratio)
        if not misfit.n_prior:
            candidates = [replace(minimum, chi2=minimum.chi2 / ratio**2) for minimum in candidates]
            break
        candidates = search.minima(misfit, search.start_mesh(wear, misfit))
    misfit, ranked = _rank(misfit, candidates)
    healthy_chi2 = None
    if DEPTH in misfit.model.names:
        without, healthy = search.healthy_minimum(misfit, ranked[0])
        healthy_chi2 = healthy.chi2
        if healthy.chi2 < ranked[0].chi2 + ALIKE:
            misfit, ranked = without, search.merge([healthy, *ranked])
    covariance = search.covariance_of(misfit, ranked[0])
    by_films = search.film_covariance(misfit, ranked[0].parameters, covariance)
    return _Solved(misfit, tuple(ranked), covariance, by_films, healthy_chi2)


def _rank(
    misfit: WornMisfit, candidates: list[search.WearMinimum]
) -> tuple[WornMisfit, list[search.WearMinimum]]:
    near = [
        candidate
        for candidate in candidates[:MOST_RIVALS]
        if candidate.converged and candidate.chi2 <= candidates[0].chi2 + NEAR * (candidates[0].chi2 + 100)
    ]
    pairs = [search.refine(misfit, candidate) for candidate in near] or [search.refine(misfit, candidates[0])]
    pairs.sort(key=lambda pair: (not pair[1].converged, pair[1].chi2))
    others = [candidate for candidate in candidates if not any(candidate is other for other in near)]
    return pairs[0][0], search.merge([*(pair[1] for pair in pairs), *others])


def _estimate(solved: _Solved) -> Estimate:
    misfit, best, dof = solved.misfit, solved.best, solved.dof
    measured, sensitive = misfit.receptance, list(_sensitive_parameters(solved))
    measured_terms = measured.terms(measured.measured.matrix)
    modelled = measured.terms(misfit.model.response(best.parameters)[0])
    r2, adjusted = determination(measured_terms, measured_terms - modelled, len(misfit.model.names))
    reduced, p_value = None, None
    if misfit.weighted:
        reduced = best.chi2 / misfit.excess / dof
        p_value = weight_uncertainty(measured.measured, dof).p_value(reduced, dof)
    return Estimate(
        values=best.parameters,
        covariance=solved.covariance,
        scaled_design=triangle_of(misfit.jacobian(best.parameters)[:, sensitive]) if sensitive else np.eye(1),
        gof=Goodness(r2, adjusted, reduced, p_value),
        dof=dof,
        converged=best.converged,
        iterations=sum(minimum.evaluations for minimum in solved.minima),
    )


def _report(solved: _Solved, estimate: Estimate) -> tuple[tuple[Parameter, ...], list[Finding]]:
    misfit, best = solved.misfit, solved.best
    at = reached_bounds(misfit, best)
    intervals = _intervals(solved)
    identifiable = not (ANGLE in intervals and intervals[ANGLE].open_low and intervals[ANGLE].open_high)
    inflation = inflation_factors(estimate.scaled_design).tolist()
    factors = dict(zip(_sensitive_parameters(solved), inflation, strict=False))
    plain = [
        _parameter(solved, number, factors.get(number), intervals.get(name), identifiable)
        for number, name in enumerate(misfit.model.names)
    ]
    findings = [
        *(bound_finding(name) for name in at if identifiable or name != ANGLE),
        *rival_findings(solved.minima, misfit),
    ]
    if solved.healthy_chi2 is None:
        return tuple(plain), findings
    probability = search.healthy_probability(misfit, best, solved.healthy_chi2)
    plain.append(Parameter("healthy_probability", probability, "1", derived=True))
    mismatch = estimate.gof.chi2_p is not None and estimate.gof.chi2_p < diagnostics.MISMATCH_P
    findings += [] if identifiable else [NO_ANGLE]
    return tuple(plain), [*findings, *healthy_findings(probability, mismatch)]


def _intervals(solved: _Solved) -> dict[str, search.Interval]:
    model, parameters, limit = solved.misfit.model, solved.best.parameters, student_limit(solved.dof)
    noise, reach = np.sqrt(np.diag(solved.noise_covariance)), limit * np.sqrt(np.diag(solved.film_covariance))
    intervals = {}
    for number, name in enumerate(model.names):
        if name in (DEPTH, ANGLE):
            error = float(noise[number])
            interval = search.profile_interval(solved.misfit, solved.best, number, error, limit)
            bounds = model.low[number], model.high[number]
            intervals[name] = search.widen(interval, parameters[number], reach[number], *bounds)
    return intervals


def _parameter(
    solved: _Solved, number: int, vif: float | None, interval: search.Interval | None, identifiable: bool
) -> Parameter:
    model = solved.misfit.model
    name, scale = model.names[number], float(model.scale[number])
    value = scale * float(solved.best.parameters[number])
    error = scale * float(np.sqrt(solved.covariance[number, number]))
    at_bound, open_angle = (
        name in reached_bounds(solved.misfit, solved.best),
        name == ANGLE and not identifiable,
    )
    ends = None if interval is None else (scale * interval.low, scale * interval.high)
    if at_bound or open_angle:
        ends = None if open_angle else ends
        return Parameter(name, value, UNITS[name], vif=vif, ci95=ends, at_bound=at_bound)
    parameter = appraise(name, UNITS[name], value, error, solved.dof, vif)
    return parameter if ends is None else replace(parameter, ci95=ends)


def _estimate_findings(solved: _Solved, estimate: Estimate, biased: str) -> list[Finding]:
    names = [solved.misfit.model.names[number] for number in _sensitive_parameters(solved)]
    findings = [
        *diagnostics.estimate_findings(estimate, names, solved.misfit.receptance.frequency.size),
        *diagnostics.excess_findings(estimate, biased),
    ]
    group = diagnostics.collinear_group(estimate.scaled_design, names) if names else []
    along = DEPTH in solved.misfit.model.names and not {*group} & {DEPTH, ANGLE}
    return [finding for finding in findings if finding.code != "collinear" or not along]


def _sensitive_parameters(solved: _Solved) -> tuple[int, ...]:
    misfit, best = solved.misfit, solved.best
    lengths = np.linalg.norm(misfit.jacobian(best.parameters), axis=0)
    at = reached_bounds(misfit, best)
    return tuple(
        n for n, name in enumerate(misfit.model.names) if lengths[n] > LEAST_SENSITIVITY and name not in at
    )


def _region(solved: _Solved, parameters: tuple[Parameter, ...]) -> tuple[Region, ...]:
    model, both = solved.misfit.model, slice(2)
    if DEPTH not in model.names or any(p.name == ANGLE and p.ci95 is None for p in parameters):
        return ()
    outline = search.joint_region(solved.misfit, solved.best, solved.noise_covariance, REGION_LEVEL)
    noise, film = solved.noise_covariance[both, both], solved.film_covariance[both, both]
    wide = search.widened_region(outline, solved.best.parameters[both], noise, film)
    inside = np.clip(wide, model.low[both], model.high[both]) * model.scale[both]
    return (Region((DEPTH, ANGLE), inside, REGION_LEVEL),)


def _curve(measured: WornReceptance, solved: _Solved) -> FittedCurve:
    receptance = measured.measured
    variance = None
    if receptance.covariance is not None:
        variance = np.einsum("lii->li", receptance.covariance).real.reshape(receptance.matrix.shape)
    model, parameters = solved.misfit.model, solved.best.parameters
    fitted = model.response(parameters)[0]
    before = None
    if DEPTH not in model.names:
        mean = np.array(model.prior.mean) / model.scale
        before = model.refine(mean, with_slopes=False).response(mean)[0]

    def at(frequency: FloatArray) -> ComplexArray:
        return replace(model, frequency=tuple(frequency.tolist())).response(parameters)[0]

    dense_frequency, dense = drawn_densely(at, measured.frequency)
    return FittedCurve(
        measured.frequency,
        receptance.matrix,
        fitted,
        variance=variance,
        outputs=measured.names,
        inputs=measured.names,
        form="receptance",
        before=before,
        dense_frequency=dense_frequency,
        dense=dense,
    )

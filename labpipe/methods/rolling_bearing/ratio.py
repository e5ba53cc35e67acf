"""Fit against theory: the theory's transfer function fitted like the measured one, and the ratio over all
tests.

A one-dof fit of a coupled transfer function is not K_ii, and a bending shaft makes radial fits softer still.
Therefore the theory's stiffness matrix is multiplied by a factor and put in series with the shaft, its curve
is fitted on the measured lines with the measured weights, and factor and damping are changed until that fit
gives the measured k and c.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import chance_text
from labpipe.errors import ConfigError, FitError, LabpipeError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import VISCOUS, FitSettings
from labpipe.methods.rolling_bearing.loads import DOFS, RigidShaft, transfer_matrix
from labpipe.project.bearing_file import open_bearing
from labpipe.records.comparison import ComparedPoint, Comparison, Overlay
from labpipe.records.finding import NORMAL, Parameter
from labpipe.records.identification import Fit, dofs_of
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.uncertain import Uncertain
from labpipe.spectra.bands import lines_in
from labpipe.spectra.convert import receptance_factor
from labpipe.uncertainty.amounts import (
    chance,
    change_in,
    common_changes,
    from_log,
    random_error,
    source_dofs,
    sources_in_common,
    with_error,
)
from labpipe.uncertainty.compare import OF_TESTS, Evidence
from labpipe.uncertainty.observations import Campaign
from labpipe.uncertainty.settings import CompareSettings, ComparisonKind, TheorySettings
from labpipe.uncertainty.weighted import WeightedFit, weighted_fit, weighted_mean

# ln beta = ln c - ln k of the logarithms of these.
COEFFICIENTS, BETA = ("k", "c"), np.array([-1.0, 1.0])
TILTS = (3, 4)
STEP = 1e-4
TOLERANCE = 1e-8
# Steps smaller than this use the slopes of the previous step.
NEAR = 1e-3
LOOPS = 20
LARGEST_MOVE = 1.0


Loaded = tuple[FloatArray, RigidShaft]


@dataclass(frozen=True)
class TheoryAt:
    """The theory at one condition: K (5, 5) [N/m, N/rad, N m/rad], K at a condition larger by the share
    *step*, and the shaft. ends: by source, K and shaft with an uncertain number of the bearing file one
    standard uncertainty above and below its value; dofs behind those sources that are not known.
    """

    stiffness: FloatArray
    near: FloatArray
    step: float
    shaft: RigidShaft
    ends: tuple[tuple[str, Loaded, Loaded], ...] = ()
    dofs: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RatioRig:
    """How the rig measures the bearing: bending stiffness of the shaft [N/m] (infinite: rigid), arm of tilts
    [m].
    """

    bending: Uncertain
    arm: float | None


@dataclass(frozen=True)
class Matched:
    """The factor on the theory's K at which its curve gives the measured fit: ln ratio and ln beta (2,) [1]
    with covariance (2, 2).

    *to_sources*: change (2,) [1] of both by one standard uncertainty of each source of the fit's budget and
    of the bearing file; *dofs* behind those sources that are not known.
    *to_bending*, *to_condition* (2,) [1]: change of both per relative change of the shaft's stiffness and of
    the condition. *theory*: (k, c) of the fit of the theory's curve, with the measured damping.
    """

    log: FloatArray
    covariance: FloatArray
    to_bending: FloatArray
    to_condition: FloatArray
    theory: FloatArray
    to_sources: Mapping[str, FloatArray] = field(default_factory=dict)
    dofs: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Curve:
    response: FrequencyResponse
    settings: FitSettings
    place: tuple[int, int]
    arms: float


def match(
    fit: Fit, response: FrequencyResponse, settings: FitSettings, theory: TheoryAt, rig: RatioRig
) -> Matched:
    """Solve ln(k, c)(ratio, beta) = ln(k, c) measured by Newton's method with numerical slopes.

    Raises ConfigError for a response whose dofs are not the bearing's, FitError where no ratio gives the
    measured fit. Equation (comp-match).
    """
    fit = fit.as_fitted
    curve = _curve(fit, response, settings, rig)
    bending = rig.bending.value

    def fit_ratio(
        log: FloatArray, stiffness: FloatArray, bends: float = bending, shaft: RigidShaft = theory.shaft
    ) -> FloatArray:
        ratio, beta = (float(value) for value in np.exp(log))
        matrix = _theory_curve(curve, shaft, ratio * stiffness, beta, bends)[:, None, None]
        (fit,) = identify(replace(curve.response, matrix=matrix), curve.settings, judging=False)
        return _logarithms(fit)

    measured = _logarithms(fit)
    start = np.array([0.0, measured[1] - measured[0]])
    log, slopes = solve_ratio(lambda u: fit_ratio(u, theory.stiffness), measured, start)
    inverse = np.linalg.inv(slopes)
    solution = fit_ratio(log, theory.stiffness)
    to_bending = np.zeros(2)
    if np.isfinite(bending):
        to_bending = (fit_ratio(log, theory.stiffness, bending * (1 + STEP)) - solution) / STEP
    to_condition = (fit_ratio(log, theory.near) - solution) / theory.step
    theoretical = np.exp(fit_ratio(np.array([0.0, log[1]]), theory.stiffness))
    covariance = inverse @ log_covariance(fit) @ inverse.T
    sources = () if fit.budget is None else fit.budget.sources
    to_sources = {of.source: inverse @ _log_change(fit, of.source) for of in sources}
    for source, *ends in theory.ends:
        high, low = (fit_ratio(log, stiffness, shaft=shaft) for stiffness, shaft in ends)
        to_sources[source] = to_sources.get(source, 0.0) - inverse @ (high - low) / 2
    by = {"to_bending": -inverse @ to_bending, "to_condition": -inverse @ to_condition}
    dofs = {**theory.dofs, **dofs_of(fit)}
    return Matched(log, covariance, **by, theory=theoretical, to_sources=to_sources, dofs=dofs)


def solve_ratio(
    function: Callable[[FloatArray], FloatArray], target: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """ln ratio and ln beta u (2,) [1] at which *function* is the *target* (2,) [1], and its slopes (2, 2) [1]
    there; from *start*, by Newton. FitError where there are none.
    """
    u, slopes, size = start, np.eye(2), np.inf
    for _ in range(LOOPS):
        here = function(u)
        if size > NEAR:
            slopes = np.column_stack([(function(u + STEP * unit) - here) / STEP for unit in np.eye(2)])
        move = np.linalg.solve(slopes, target - here)
        u = u + np.clip(move, -LARGEST_MOVE, LARGEST_MOVE)
        size = float(np.max(np.abs(move)))
        if size < TOLERANCE:
            return u, slopes
    hint = "check bearing, condition, arm and the shaft's bending stiffness"
    raise FitError("no multiple of the theory's stiffness gives the measured fit", hint=hint)


def _coefficient(fit: Fit, name: str) -> Parameter:
    for parameter in fit.parameters:
        if parameter.name == name:
            return parameter
    raise FitError(f"{name} of test {fit.test} is missing", hint="fit it without `eliminate`")


def _logarithms(fit: Fit) -> FloatArray:
    values = [_coefficient(fit, name).value for name in COEFFICIENTS]
    for name, value in zip(COEFFICIENTS, values, strict=True):
        if not value > 0:
            whose = f"of test {fit.test}" if fit.test else "of the theory's own curve"
            hint = "" if fit.test else "its resonance lies outside the band of the fit"
            raise FitError(f"{name} {whose} is {value:g}, impossible for a bearing", hint=hint)
    return np.log(values)


def _log_change(fit: Fit, source: str) -> FloatArray:
    return np.array([change_in(fit, source, name) / fit.parameter(name).value for name in COEFFICIENTS])


def log_covariance(fit: Fit) -> FloatArray:
    """Covariance of ln k and ln c, (2, 2) [1], from the errors of this test alone and the fit's correlation.
    FitError without standard errors.
    """
    chosen = [_coefficient(fit, name) for name in COEFFICIENTS]
    relative = []
    for parameter in chosen:
        error = random_error(fit, parameter)
        if error is None or parameter.derived:
            raise FitError(f"{parameter.name} of test {fit.test} has no standard error of its own")
        relative.append(error / parameter.value)
    places = [fit.estimated.index(parameter) for parameter in chosen]
    return fit.correlation[np.ix_(places, places)] * np.outer(relative, relative)


def overlay(
    fit: Fit,
    response: FrequencyResponse,
    settings: FitSettings,
    theory: TheoryAt,
    rig: RatioRig,
    matched: Matched,
) -> Overlay:
    """|H| of the fitted term on all lines of the response: measured, theory with the measured damping, theory
    times the ratio.
    """
    curve = _curve(fit, response, settings, rig, whole=True)
    beta = float(np.exp(matched.log[1]))
    curves = [
        _theory_curve(curve, theory.shaft, factor * theory.stiffness, beta, rig.bending.value)
        for factor in (1.0, float(np.exp(matched.log[0])))
    ]
    sizes = (tuple(np.abs(values).tolist()) for values in (curve.response.matrix[:, 0, 0], *curves))
    return Overlay(fit.test, response.form, tuple(curve.response.frequency.tolist()), *sizes)


def _theory_curve(
    curve: _Curve, shaft: RigidShaft, stiffness: FloatArray, beta: float, bending: float
) -> ComplexArray:
    frequency = curve.response.frequency
    receptance = transfer_matrix(shaft, stiffness, frequency, beta, bending)[:, *curve.place]
    return receptance * curve.arms * receptance_factor(curve.response.form, frequency)


def _curve(
    fit: Fit, response: FrequencyResponse, settings: FitSettings, rig: RatioRig, whole: bool = False
) -> _Curve:
    if not settings.kind.one_frf or fit.curve is None:
        hint = "only one-dof fits are compared with those of the theory"
        raise ConfigError(f"fit '{fit.name}' is not of the model sdof", hint=hint)
    if settings.damping != VISCOUS:
        raise ConfigError(f"fit '{fit.name}' has {settings.damping} damping", hint="the theory's is viscous")
    if settings.subtract is not None or settings.share != 1:
        hint = "compare the fit of the whole with the theory"
        raise ConfigError(f"fit '{fit.name}' is corrected for support or share", hint=hint)
    row = [port.label for port in response.outputs].index(fit.curve.outputs[0])
    column = [port.label for port in response.inputs].index(fit.curve.inputs[0])
    lines = lines_in(response.frequency, None if whole else fit.band_hz)
    element, covariance = [row * len(response.inputs) + column], response.covariance
    part = FrequencyResponse(
        response.frequency[lines],
        response.matrix[lines][:, [row]][:, :, [column]],
        # Fits of the theory's curve give values alone: no uncertainty of a sensor need be propagated in each
        # of them.
        (replace(response.outputs[row], uncertainties=()),),
        (replace(response.inputs[column], uncertainties=()),),
        form=response.form,
        covariance=None if covariance is None else covariance[lines][:, element][:, :, element],
        averages=response.averages,
        covariance_dof=response.covariance_dof,
    )
    places = (_place(response.outputs[row]), _place(response.inputs[column]))
    alone = replace(
        settings,
        peaks=(),
        bands=(fit.band_hz,),
        band=None,
        sliding=None,
        input=(),
        output=(),
        bootstrap=0,
        compare=False,
    )
    return _Curve(part, alone, places, _arm(rig, places[0]) * _arm(rig, places[1]))


def _place(port: Port) -> int:
    name = next((name for name in (port.dof, port.label) if name in DOFS), None)
    if name is None:
        hint = f"give its dof in the rig file: {', '.join(DOFS)}"
        raise ConfigError(f"'{port.label}' is not a dof of the bearing's theory", hint=hint)
    return DOFS.index(name)


def _arm(rig: RatioRig, place: int) -> float:
    if place not in TILTS:
        return 1.0
    if rig.arm is None:
        hint = "theory: {arm: 100 mm}, the place of the shaker"
        raise ConfigError(f"the tilt {DOFS[place]} is compared without an arm", hint=hint)
    return rig.arm


SERIES = "; corrected for the bending shaft"


def stiffness_ratio(
    campaign: Campaign, matched: Sequence[Matched], overlays: tuple[Overlay, ...], bending_error: float
) -> Comparison:
    """Mean of ln(measured / theory) over the tests by generalised least squares with `joint_errors_of`.

    *bending_error*: relative standard error of the shaft's stiffness. Equation (comp-ratio).
    """
    logs = np.array([test.log[0] for test in matched])
    errors, *sources = joint_errors_of(matched, 0, campaign.settings.setting_error, bending_error)
    mean = weighted_mean(logs, errors, *sources)
    ratio = from_log("ratio", "1", *mean.state())
    beta = float(np.exp(np.mean([test.log[1] for test in matched])))
    assert ratio.ci95 is not None
    low, high = ratio.ci95
    series = SERIES if any(test.to_bending.any() for test in matched) else ""
    result = (
        f"{campaign.subject}: measured / theory {ratio.value:.4f} (95 %: {low:.4f} to {high:.4f}), fit "
        f"against fit{series}."
    )
    amounts = (ratio, chance("scatter_p", mean.p_value), Parameter("beta", beta, "s", derived=True))
    verdict = "stiffer than theory" if low > 1 else "softer than theory" if high < 1 else "as theory"
    points = _points(campaign, matched, _single(errors, sources[0]))
    comparison = campaign.comparison(amounts, verdict, result + _factor_text(mean))
    return replace(comparison, points=points, overlays=overlays)


def joint_errors_of(
    matched: Sequence[Matched], number: int, setting_error: float, bending_error: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard errors (n,) and changes (n_source, n) [1] of the tests' ln ratio (*number* 0) or ln beta (1),
    and degrees of freedom (n_source,) [1] behind the sources.

    Noise and the setting of the condition are independent between tests; the errors of the shaft's stiffness,
    of sensors and of the bearing file's numbers are common. Equation (comp-joint).
    """
    fits = np.array([test.covariance[number, number] for test in matched])
    setting = np.array([test.to_condition[number] for test in matched]) * setting_error
    shared = np.array([test.to_bending[number] for test in matched]) * bending_error
    each = [{source: float(change[number]) for source, change in test.to_sources.items()} for test in matched]
    common, dofs = sources_in_common([(of, test.dofs) for of, test in zip(each, matched, strict=True)])
    return np.sqrt(fits + setting**2), np.vstack([shared, common]), np.append(np.inf, dofs)


def _single(errors: FloatArray, changes: FloatArray) -> FloatArray:
    return np.hypot(errors, np.linalg.norm(changes, axis=0))


def _factor_text(mean: WeightedFit) -> str:
    if mean.p_value is None:
        return ""
    if not mean.inflated:
        return f" One factor holds for all tests ({chance_text(mean.p_value)})."
    what = f"One factor does not hold for all tests ({chance_text(mean.p_value)})"
    return f" {what}; the interval is widened by their scatter."


def _points(campaign: Campaign, matched: Sequence[Matched], errors: FloatArray) -> tuple[ComparedPoint, ...]:
    points = []
    for point, test, error in zip(campaign.points(), matched, errors, strict=True):
        ratio = from_log("ratio", "1", float(test.log[0]), float(error), NORMAL)
        points.append(replace(point, theory=float(test.theory[0]), ratio=ratio.value, ratio_ci95=ratio.ci95))
    return tuple(points)


def rayleigh(campaign: Campaign, matched: Sequence[Matched] | None, bending_error: float = 0.0) -> Comparison:
    """Test of Rayleigh damping c = beta k: chi-square of the tests' beta = c / k about one value, and
    exponent of c over k. With a theory (*matched*), beta is the factor by which the theory's curve has the
    measured damping, without the influence of neighbouring modes and of the bending shaft; without, the fit's
    c / k. Equation (comp-rayleigh).
    """
    if matched is None:
        logs, errors, *sources = _log_betas([observation.fit for observation in campaign.observations])
    else:
        logs = np.array([test.log[1] for test in matched])
        errors, *sources = joint_errors_of(matched, 1, campaign.settings.setting_error, bending_error)
    mean = weighted_mean(logs, errors, *sources)
    stiffness = np.array([_logarithms(observation.fit)[0] for observation in campaign.observations])
    columns = np.column_stack([np.ones_like(stiffness), stiffness - np.mean(stiffness)])
    slope, *ends = weighted_fit(columns, logs, errors, *sources).state(1)
    exponent = with_error("exponent", "1", 1 + slope, *ends)
    if mean.p_value is None:
        raise FitError("one test cannot show whether damping is proportional to stiffness")
    verdict = "not proportional" if mean.p_value < campaign.settings.level else "proportional"
    beta = from_log("beta", "s", *mean.state())
    result = (
        f"c / k{campaign.subject[1:]}: beta = {1e6 * beta.value:.4g} us, c goes as k^{exponent.value:.3f}"
    )
    points = []
    for point, log, error in zip(campaign.points(), logs, _single(errors, sources[0]), strict=True):
        ratio = from_log("ratio", "1", float(log - np.log(beta.value)), float(error), NORMAL)
        theory = point.value / ratio.value
        points.append(replace(point, theory=theory, ratio=ratio.value, ratio_ci95=ratio.ci95))
    statement = f"{result} (Rayleigh damping: 1): {verdict} ({chance_text(mean.p_value)})."
    amounts = (beta, exponent, chance("p_value", mean.p_value))
    return replace(campaign.comparison(amounts, verdict, statement), points=tuple(points))


def _log_betas(fits: Sequence[Fit]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    logs = np.array([_logarithms(fit) @ BETA for fit in fits])
    variances = np.array([BETA @ log_covariance(fit) @ BETA for fit in fits])
    common = common_changes(fits, lambda fit, source: float(_log_change(fit, source) @ BETA))
    return logs, np.sqrt(variances), common, source_dofs(fits)


# The condition is raised by this share for the slope of the theory.
CONDITION_STEP = 1e-3

Theory = Callable[[Sequence[tuple[float, str]]], TheoryAt]
Solved = tuple[list[Matched], tuple[Overlay, ...]]


def theory_of(folder: Path, settings: TheorySettings) -> Theory:
    """The bearing file as a function of the condition [SI]. ConfigError for a bearing without five dofs, or
    without a shaft on it.
    """
    file = open_bearing(folder / settings.bearing)
    # That of the condition is `setting_error`.
    uncertain = {key: number for key, number in file.uncertainties.items() if key not in settings.entry}

    def at(conditions: Sequence[tuple[float, str]]) -> TheoryAt:
        # The error of setting is that of the first condition.
        raised = [(conditions[0][0] * (1 + CONDITION_STEP), conditions[0][1]), *conditions[1:]]
        high, low = (file.settings_at(settings.entry, pairs) for pairs in (raised, conditions))
        moved = [end for key in uncertain for end in file.ends(key)]
        here, near, *others = file.coefficients([low, high, *moved])
        shaft = getattr(low, "shaft", None)
        if here.dofs != DOFS or shaft is None:
            hint = "a ball or roller bearing with shaft: {mass, inertia_x} is needed"
            what = "the bearing file has no shaft on a bearing of five dofs"
            raise ConfigError(what, file.path, hint)
        loaded = [(k.stiffness, end.shaft.body) for k, end in zip(others, moved, strict=True)]
        sources = [number.source or key for key, number in uncertain.items()]
        ends = tuple(zip(sources, loaded[::2], loaded[1::2], strict=True))
        dofs = {of: x.dof for of, x in zip(sources, uncertain.values(), strict=True) if x.dof}
        return TheoryAt(here.stiffness, near.stiffness, CONDITION_STEP, shaft.body, ends, dofs)

    return at


def ratio_of_tests(settings: CompareSettings, evidence: Evidence) -> Comparison:
    if settings.theory is None:
        raise ConfigError("a ratio needs a theory", hint="theory: {bearing: FILE}")
    campaign = evidence.campaign(settings, "k")
    return stiffness_ratio(campaign, *_match(campaign, evidence), _bending_error(settings))


def rayleigh_of_tests(settings: CompareSettings, evidence: Evidence) -> Comparison:
    """Whether damping is proportional to stiffness, beside the theory where the settings name one."""
    campaign = evidence.campaign(settings, "c")
    if settings.theory is None:
        return rayleigh(campaign, None)
    return rayleigh(campaign, _match(campaign, evidence)[0], _bending_error(settings))


def _bending_error(settings: CompareSettings) -> float:
    shaft = None if settings.theory is None else settings.theory.shaft
    return shaft.std_error / shaft.value if shaft else 0.0


def _match(campaign: Campaign, evidence: Evidence) -> Solved:
    settings = campaign.settings
    named = settings.theory
    assert named is not None
    theory = evidence.theory or theory_of(evidence.folder, named)
    key = (settings.fit, settings.term, settings.over, settings.group, named)
    if key not in evidence.solved:
        evidence.solved[key] = _match_anew(campaign, evidence, theory, named)
    return evidence.solved[key]


def _match_anew(campaign: Campaign, evidence: Evidence, theory: Theory, named: TheorySettings) -> Solved:
    rig = RatioRig(named.shaft or Uncertain(float("inf")), named.arm)
    theory = cache(theory)
    matched, overlays = [], []
    last = len(campaign.observations) - 1
    for number, observation in enumerate(campaign.observations):
        pairs = ((observation.condition, campaign.condition_unit), (observation.second, campaign.second_unit))
        inputs = (
            observation.fit,
            evidence.response(observation.fit.test),
            evidence.settings_of(observation.fit.name),
            theory(pairs[: len(campaign.settings.over)]),
            rig,
        )
        try:
            matched.append(match(*inputs))
        except LabpipeError as error:
            error.what = f"test {observation.fit.test}: {error.what}"
            raise
        if number in (0, last):
            overlays.append(overlay(*inputs, matched[-1]))
    return matched, tuple(overlays)


RATIO = ComparisonKind(
    ratio_of_tests,
    keys=(*OF_TESTS, "setting_error", "theory"),
    needs=("fit", "over", "theory"),
    verdicts=("stiffer than theory", "softer than theory", "as theory"),
    conditions=2,
)
RAYLEIGH = ComparisonKind(
    rayleigh_of_tests,
    keys=(*OF_TESTS, "setting_error", "theory", "level"),
    needs=("fit", "over"),
    verdicts=("proportional", "not proportional"),
    conditions=2,
)

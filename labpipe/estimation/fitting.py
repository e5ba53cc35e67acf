"""identify: a frequency response and the settings of a fit -> one Fit per band or peak."""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError, LabpipeError, SettingError
from labpipe.estimation import causes, comparison, derived, diagnostics
from labpipe.estimation.budget import (
    Case,
    across_findings,
    budget_of,
    mass_uncertainty,
    most_likely,
    sources_of,
    with_contributions,
)
from labpipe.estimation.damping import HYSTERETIC, damp
from labpipe.estimation.draws import Budgeted, bootstrap, propagate
from labpipe.estimation.leakage import expected_model
from labpipe.estimation.likelihood import Assessed, assess, maximum_likelihood_from
from labpipe.estimation.linear_models import form_view
from labpipe.estimation.measured import Measured, measured_part, select_ports
from labpipe.estimation.mismatch import CROSS, LAW, Judgement, errors_by_lines, judge
from labpipe.estimation.model import DynamicModel, ReceptanceModel, Setup
from labpipe.estimation.model_error import ModelError
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.repeated import mean_over_repeats
from labpipe.estimation.settings import VISCOUS, FitSettings, check_kind
from labpipe.estimation.statistics import Estimate, Stated, student_limit
from labpipe.estimation.transfer_mode import DrivingMode, TransferMode, place_notes, transfer_of
from labpipe.estimation.weights import fit_weights, has_noise, weighted_by_model
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Candidate, Fit, FittedCurve
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import ESTIMATE
from labpipe.records.spectra import ChannelSpectra, FreeDecays
from labpipe.records.uncertain import Uncertainty
from labpipe.spectra.bands import EDGE, beyond_finding, lines_in
from labpipe.spectra.convert import FormView, is_directional
from labpipe.spectra.settings import DECAYS, RESPONSES, SPECTRA

Band = tuple[float, float]


def identify(
    measured: FrequencyResponse | FreeDecays | ChannelSpectra,
    settings: FitSettings,
    *,
    judging: bool = True,
    earlier: Sequence[Fit] = (),
) -> tuple[Fit, ...]:
    """Fit the settings' model to a response, free decays or spectra: one Fit, or one per band or chosen peak.

    *judging*: what a residual that is not noise shows widens the intervals, and the given mass is held
    against a free one; without it, as for studies and repeats, the intervals are those of the estimator
    alone, of unknown noise by the scatter of every line. *earlier*: fits that the settings name, such as the
    baseline of a floating bearing. ConfigError where settings and measurement do not fit together, FitError
    where the data cannot support the fit.
    """
    if earlier:
        settings = settings.kind.begin(settings, tuple(earlier))
    other_kind = DECAYS if isinstance(measured, FreeDecays) else SPECTRA
    check_kind(settings, RESPONSES if isinstance(measured, FrequencyResponse) else other_kind)
    if settings.peaks and isinstance(measured, FrequencyResponse):
        terms = (_diagonal_term(measured, settings, *peaks, judging) for peaks in settings.peaks)
        return tuple(itertools.chain(*terms))
    repeated = judging and settings.repeats == "each"
    if repeated and isinstance(measured, FrequencyResponse):
        _check_repeats(measured, settings)
    fits = _fits(measured, settings, judging)
    if isinstance(measured, FrequencyResponse):
        if repeated and measured.repeats is not None:
            fits = mean_over_repeats(fits, measured, settings, _fits)
        fits = tuple(
            derived.add_unstated(diagnostics.with_cautions(fit, measured.findings), measured, settings)
            for fit in fits
        )
    if not isinstance(measured, FreeDecays):
        fits = tuple(
            replace(fit, findings=(*fit.findings, *beyond_finding(measured.frequency, fit.band_hz)))
            for fit in fits
        )
    return tuple(with_contributions(fit, settings.coverage) for fit in fits)


def _diagonal_term(
    response: FrequencyResponse, settings: FitSettings, dof: str, bands: tuple[Band, ...], judging: bool
) -> tuple[Fit, ...]:
    of_term = replace(settings, peaks=(), bands=bands, input=(dof,), output=(dof,))
    try:
        fits = identify(response, of_term, judging=judging)
    except LabpipeError as error:
        error.what = f"term {dof}: {error.what}"
        raise
    return tuple(replace(fit, term=dof) for fit in fits)


def _check_repeats(measured: FrequencyResponse, settings: FitSettings) -> None:
    if measured.repeats is None:
        if settings.repeat_groups:
            what = f"'repeat_groups': '{measured.name}' has no recordings that are fitted alone"
            raise SettingError("repeat_groups", what, "several, each of which has all of the FRFs")
        return
    for key in ("bootstrap", "monte_carlo"):
        if getattr(settings, key):
            what = f"'{key}' draws the noise of one fit, and each of the {measured.repeats_are} has its own"
            raise SettingError(key, what, f"{key}: 0, or repeats: pool")


def _fits(
    measured: FrequencyResponse | FreeDecays | ChannelSpectra, settings: FitSettings, judging: bool
) -> tuple[Fit, ...]:
    if isinstance(measured, FrequencyResponse) and not settings.kind.any_input:
        form_view(measured.form, settings)
    if isinstance(measured, FrequencyResponse) and settings.kind.equations is not None:
        return fit_linear(measured, settings, judging=judging)
    return settings.kind.fit(measured, replace(settings, judged=judging))


def fit_linear(
    response: FrequencyResponse, settings: FitSettings, *, judging: bool = True
) -> tuple[Fit, ...]:
    """Fits of a model linear in its parameters, one per band; *judging* as for `identify`."""
    if is_directional(response) and not settings.kind.one_frf:
        what = f"model {settings.model} is of directions, not of forward and backward terms"
        raise ConfigError(what, hint="leave `directional` out of frf")
    rows, columns = select_ports(response, settings.input, settings.output)
    outputs = tuple(response.outputs[row] for row in rows)
    inputs = tuple(response.inputs[column] for column in columns)
    setup = Setup(outputs, inputs, settings, diagnostics.is_of_closed_loop(response.findings))
    view, model = form_view(response.form, settings), _model(setup)
    fits, bands = [], _bands(response, settings)
    for band, lines in bands:
        try:
            measured = measured_part(response, rows, columns, lines, view)
            fit = _fit_band(setup, model, measured, band, len(bands), judging)
        except FitError as error:
            what = f"band {band[0]:g}-{band[1]:g} Hz: {error.what}"
            raise FitError(what, error.where, error.hint) from None
        drift = causes.drift_findings(measured, fit.model, fit.values, len(bands))
        of_noise = diagnostics.covariance_findings(response)
        quality = (*diagnostics.quality_findings(response, rows, columns, lines), *of_noise, *drift)
        # Sliding bands are drawn as coefficients over frequency, what is only counted not at all.
        curve = _curve(view, measured, fit, dense=judging and len(bands) == 1)
        fits.append(replace(fit.fit, findings=(*fit.fit.findings, *quality), curve=curve))
    return tuple(fits)


def sliding_bands(whole: Band, width: float, step: float) -> list[Band]:
    """Bands of *width* every *step* [Hz] that lie in the whole band: 1-250 Hz by 15/3 Hz gives 79."""
    count = int(np.floor((whole[1] - whole[0] - width) / step + 1e-9)) + 1
    if count < 1:
        raise ConfigError(f"no band of {width:g} Hz fits into {whole[0]:g}-{whole[1]:g} Hz")
    return [(whole[0] + n * step, whole[0] + n * step + width) for n in range(count)]


def _bands(response: FrequencyResponse, settings: FitSettings) -> list[tuple[Band, BoolArray]]:
    frequency = response.frequency
    if settings.bands:
        return [(band, lines_in(frequency, band)) for band in settings.bands]
    whole = settings.band or (float(frequency[0]), float(frequency[-1]))
    if settings.sliding is None:
        return [(whole, lines_in(frequency, whole))]
    bands = sliding_bands(whole, settings.sliding.width, settings.sliding.step)
    return [(band, lines_in(frequency, band) & (frequency < band[1] * (1 - EDGE))) for band in bands]


@dataclass(frozen=True)
class _BandFit:
    fit: Fit
    fitted: ComplexArray
    model: derived.BandModel
    values: FloatArray


# Studies and repeats fit one model often.
@functools.lru_cache(maxsize=16)
def _model(setup: Setup) -> derived.BandModel:
    """The settings' model; the residue of a transfer FRF of unknown mass, of any sign and phase, and residual
    terms beside a mode need no linear equations.
    """
    # Whatever does not fit the model's ports is refused here for all of them.
    linear = setup.settings.kind.model(setup)
    if _may_have_residuals(setup):
        if transfer_of(setup):
            return TransferMode()
        if setup.settings.residuals:
            return DrivingMode()
    return damp(linear, setup.settings)


def _may_have_residuals(setup: Setup) -> bool:
    settings = setup.settings
    viscous_alone = settings.damping == VISCOUS and not (
        settings.fixed or settings.tied or settings.eliminate or derived.is_corrected(settings)
    )
    return (
        settings.kind.one_frf
        and settings.mass == ESTIMATE
        and not settings.estimates.linear
        and viscous_alone
    )


def _driving_mode(
    setup: Setup, measured: Measured, estimate: Estimate, band: Band
) -> tuple[DrivingMode, Estimate, str] | None:
    """The mode with residual terms, its estimate and a note, where a mode needs them; else None."""
    if not _may_have_residuals(setup) or transfer_of(setup) or setup.settings.sliding is not None:
        return None
    k, _, m = estimate.values[:3]
    if not estimate.converged or k * m > 0 or measured.matrix.shape[1:] != (1, 1):
        return None
    try:
        driving = _estimate(measured, DrivingMode(), setup.settings)
    except (FitError, np.linalg.LinAlgError):
        return None
    f_n = float(np.sqrt(max(driving.values[0] / driving.values[2], 0.0))) / (2 * np.pi)
    if not driving.converged or not np.all(driving.values[:3] > 0) or not band[0] <= f_n <= band[1]:
        return None
    text = (
        f"{setup.settings.model}: one mode alone has a mass of {m:.3g} kg and a stiffness of {k:.3g} N/m, "
        "which is not an oscillator: other modes are in the FRF. A constant stands for them beside the mode; "
        "`residuals: true` says so beforehand."
    )
    return DrivingMode(), driving, text


def _same_model(setup: Setup, names: tuple[str, ...]) -> derived.BandModel:
    model = _model(setup)
    for name in model.names:
        if name not in names and isinstance(model, DynamicModel):
            model = model.fix(name)
    return model


def _estimate(measured: Measured, model: derived.BandModel, settings: FitSettings) -> Estimate:
    return settings.estimates.fit(measured, model, settings.weight)


def _fit_band(
    setup: Setup, model: derived.BandModel, measured: Measured, band: Band, n_band: int, judging: bool
) -> _BandFit:
    settings, estimator = setup.settings, setup.settings.estimates
    estimate = _estimate(measured, model, settings)
    if estimator.likelihood and estimate.converged and not setup.closed_loop:
        by_model = weighted_by_model(measured, model.receptance(estimate.values, measured.omega))
        if by_model is not measured:
            # The minimum is beside that of the other weights: no other start is tried.
            again = maximum_likelihood_from(by_model, model, estimate.values, "")
            measured, estimate = by_model, replace(again, notes=estimate.notes)
    dropped: list[str] = []
    beside = None if isinstance(model, TransferMode) else _driving_mode(setup, measured, estimate, band)
    if beside is not None:
        model, estimate, text = beside
        settings = replace(settings, residuals=True)
        setup, dropped = replace(setup, settings=settings), [text]
    if settings.eliminate and isinstance(model, DynamicModel):
        model, estimate, dropped = _eliminate(measured, model, estimate, settings)
    shown = expected_model(measured, model) if estimator.models_leakage else model
    fitted = shown.receptance(estimate.values, measured.omega)
    leakage = diagnostics.leakage_findings(measured, model.whole(estimate.values), estimator)
    case = Case(setup, measured, model, estimate, functools.partial(_same_model, names=model.names))
    judged = _judge(case, n_band, leaking=bool(leakage)) if judging else _Judged(errors_by_lines(case))
    estimate, judgement = judged.estimate, judged.judgement
    parameters = derived.reported_parameters(estimate, model, setup)
    notes = (*estimate.notes, *dropped)
    if settings.bootstrap:
        parameters, note = bootstrap(parameters, case, fitted, _refit)
        notes = (*notes, note)
    parameters = _with_honest_intervals(parameters, judgement, estimate, model, setup)
    has_error = judgement.model_error is not None
    compared_models, of_comparison, law = _compare_variants(setup, measured, estimate, has_error)
    laws = _other_laws(case, estimate, law) if has_error else []
    if laws:
        parameters = comparison.hold_values(parameters, laws, budget_of(case, parameters))
    faults = _find_faults(case, judged, laws) if judging else {}
    cause = next((fault for fault in faults if fault), laws[0].words if laws else "")
    if cause and judgement.by_cause is not None:
        judgement = replace(judgement, findings=judgement.by_cause(cause))
        reason = cause.removeprefix("a ").partition(",")[0]
        parameters = tuple(replace(p, reason=reason) if p.reason else p for p in parameters)
    budgeted = _with_budget(case, parameters, fitted, judged.factors)
    notes = (*notes, *budgeted.notes, *diagnostics.motion_notes(measured), *place_notes(setup))
    fit = replace(
        derived.reported_fit(settings, estimate, budgeted.parameters, band, measured.omega.size),
        findings=(
            *diagnostics.estimate_findings(estimate, model.names, measured.omega.size, model.units),
            *judgement.findings,
            *diagnostics.goodness_findings(estimate.gof),
            *leakage,
            *judged.findings,
            *faults.values(),
            *_parameter_findings(budgeted.parameters, band, setup, measured, leaking=bool(leakage)),
            *budgeted.findings,
            *comparison.comparison_findings(compared_models),
        ),
        notes=(*notes, *of_comparison),
        candidates=compared_models,
        budget=budgeted.budget,
        discrepancy=None if judgement.model_error is None else judgement.model_error.discrepancy,
    )
    return _BandFit(fit, fitted, model, estimate.values)


def _compare_variants(
    setup: Setup, measured: Measured, estimate: Estimate, has_error: bool
) -> tuple[tuple[Candidate, ...], tuple[str, ...], str]:
    """Candidates that show whether a damping law is justified, or why the residual of viscous damping is not
    noise where the model *has_error*, their notes, and the law that alone leaves noise.
    """
    settings = setup.settings
    of_model = setup.settings.estimates.likelihood and not settings.eliminate
    is_viscous = settings.damping == VISCOUS
    seeks_law = of_model and has_error and "damping" in settings.kind.keys and settings.sliding is None
    if is_viscous and not settings.compare and not seeks_law:
        return (), (), ""
    compared, notes = comparison.candidates(measured, setup, estimate if of_model else None)
    law_explains = bool(compared) and is_viscous and not settings.compare
    return compared, notes, HYSTERETIC.name + LAW if law_explains else ""


def _other_laws(case: Case, estimate: Estimate, law: str) -> list[comparison.OtherLaw]:
    """The *law* of damping that explains the residual, cross terms that a model is without, and mounts, as of
    `relaxing_mounts`, that explain what a viscous fit of k and c, of known mass or with m, leaves over the
    noise; the likeliest first.
    """
    settings, chi2 = case.setup.settings, estimate.gof.chi2_reduced
    laws = [_law(case, law, damping=HYSTERETIC.name)] if law else []
    seeks = settings.damping == VISCOUS and settings.sliding is None and not settings.fixed
    if chi2 is None or not (seeks and settings.estimates.likelihood):
        return laws
    if settings.kind.richer and not settings.compare:
        with contextlib.suppress(ConfigError, FitError):
            crossed = _law(case, CROSS, model=settings.kind.richer)
            if crossed.aic < comparison.LITTLE * chi2 * estimate.dof:
                laws.append(crossed)
    is_plain = case.model.names in (("k", "c"), ("k", "c", "m")) and not derived.is_corrected(settings)
    if settings.kind.one_frf and is_plain:
        mass = None if settings.mass == ESTIMATE else float(settings.mass)  # type: ignore[arg-type]
        laws.extend(comparison.relaxing_mounts(case.measured, mass, chi2))
    return sorted(laws, key=lambda other: other.aic)


def _law(case: Case, words: str, **change: Any) -> comparison.OtherLaw:
    """The fit with a *change* of its settings; of c and zeta under hysteretic damping what dissipates as much
    at the resonance.
    """
    setup = replace(case.setup, settings=replace(case.setup.settings, **change))
    model = _model(setup)
    estimate = _estimate(case.measured, model, setup.settings)
    by_law = derived.reported_parameters(estimate, model, setup)
    values = {p.name: np.array([p.value, p.std_error or 0.0]) for p in by_law}
    if {"k", "eta", "f_n"} <= values.keys():
        values["zeta"] = values["eta"] / 2
        values["c"] = values["eta"] * values["k"][0] / (2 * np.pi * values["f_n"][0])
    left = estimate.gof.chi2_reduced or np.inf
    values = {name: value * [1.0, np.sqrt(max(left, 1.0))] for name, value in values.items()}
    return comparison.OtherLaw(words, values, left * estimate.dof + 2 * estimate.values.size)


def _with_budget(
    case: Case, parameters: tuple[Parameter, ...], fitted: ComplexArray, factors: Mapping[str, float]
) -> Budgeted:
    """The parameters with what given numbers add to their uncertainty, by first order and, if asked for, by
    draws. *factors* [1] by source: how much larger than stated its uncertainty counts.
    """
    if case.setup.settings.monte_carlo and not sources_of(case.setup, case.measured):
        what = "'monte_carlo' has nothing to draw: no given number has an uncertainty"
        hint = "bootstrap: 1000 draws the noise alone; or state an uncertainty, as mass: 0.92 kg +- 1 %"
        raise SettingError("monte_carlo", what, hint)
    budget = budget_of(case, parameters)
    if budget is None:
        return Budgeted(parameters)
    budget = budget.enlarge(factors)
    expanded = derived.with_systematic(parameters, budget)
    draws = case.setup.settings.monte_carlo
    budgeted = (
        propagate(case, expanded, budget, fitted, _refit, draws) if draws else Budgeted(expanded, budget)
    )
    return replace(budgeted, findings=(*budgeted.findings, *across_findings(case.setup, budget)))


def _parameter_findings(
    parameters: tuple[Parameter, ...], band: Band, setup: Setup, measured: Measured, *, leaking: bool
) -> list[Finding]:
    of_mode = diagnostics.mode_findings(parameters, band, setup)
    driving = setup.settings.mass != ESTIMATE or not transfer_of(setup)
    of_values = diagnostics.parameter_findings(parameters, driving=driving, held=setup.closed_loop)
    narrow: list[Finding] = []
    if measured.omega.size > 1 and not leaking and not setup.closed_loop:
        spacing = float(np.median(np.diff(measured.omega))) / (2 * np.pi)
        narrow = diagnostics.narrow_findings(parameters, spacing)
    kept = [finding for finding in of_values if not (of_mode and finding.code == "unphysical")]
    is_named = setup.closed_loop or any(finding.code == "unphysical" for finding in (*kept, *of_mode))
    return [*kept, *of_mode, *narrow, *([] if is_named else diagnostics.sign_findings(measured))]


def _with_honest_intervals(
    parameters: tuple[Parameter, ...],
    judgement: Judgement,
    estimate: Estimate,
    model: derived.BandModel,
    setup: Setup,
) -> tuple[Parameter, ...]:
    def report_parameters(values: FloatArray, covariance: FloatArray) -> tuple[Parameter, ...]:
        changed = replace(estimate, values=values, covariance=covariance)
        return derived.reported_parameters(changed, model, setup)

    error = judgement.model_error
    if isinstance(error, ModelError):
        return error.state(parameters)
    if error is not None:
        return error.state(parameters, report_parameters)
    if judgement.covariance is None:
        return parameters
    both = (report_parameters(estimate.values, c) for c in (estimate.covariance, judgement.covariance))
    return derived.widened_parameters(parameters, *both)


@dataclass(frozen=True)
class _Judged:
    """An estimate whose chi-square allows for stated numbers, and the judgement of its residual; *stated*:
    what these change of it, if any; findings: on those that the data contradict; factors [1] by source: how
    much larger their uncertainty counts.
    """

    estimate: Estimate
    judgement: Judgement = field(default_factory=Judgement)
    stated: Stated | None = None
    findings: tuple[Finding, ...] = ()
    factors: Mapping[str, float] = field(default_factory=dict)


def _judge(case: Case, n_band: int, *, leaking: bool) -> _Judged:
    """Chi-square and judgement with every stated number where data and statements together have it; of
    amplitudes alone and without convergence as if all numbers were exact.
    """
    estimate, settings = case.estimate, case.setup.settings
    unknown_noise = estimate.gof.chi2_reduced is None
    try:
        if not (settings.estimates.phase and estimate.converged) or (
            unknown_noise and has_noise(case.measured)
        ):
            raise FitError("no residual to judge stated numbers by")
        likely, uncertainties, stated = most_likely(case)
    except FitError:
        uncertainties = ()
    if not uncertainties:
        return _Judged(
            estimate, judge(case.measured, case.model, estimate, settings, n_band, leaking=leaking)
        )
    findings: tuple[Finding, ...] = ()
    factors: dict[str, float] = {}
    if not unknown_noise:
        model = (
            expected_model(likely.measured, likely.model)
            if settings.estimates.models_leakage
            else likely.model
        )
        problem: OutputError[ReceptanceModel] = OutputError(
            likely.measured, model, fit_weights(case.measured)
        )
        assessed = assess(likely.measured, likely.model, problem, likely.estimate.values, stated=stated)
        findings, factors = _contradict(case, uncertainties, assessed)
        if findings:
            # What is named is no sign of a wrong model besides.
            enlargement = np.array([factors[uncertainty.source] for uncertainty in uncertainties])
            stated = stated.enlarge(enlargement)
            assessed = assess(likely.measured, likely.model, problem, likely.estimate.values, stated=stated)
        gof = replace(estimate.gof, chi2_reduced=assessed.reduced, chi2_p=assessed.p_value)
        estimate = replace(estimate, gof=gof)
        likely = replace(likely, estimate=replace(likely.estimate, gof=gof))
    judgement = judge(
        likely.measured, likely.model, likely.estimate, settings, n_band, leaking=leaking, stated=stated
    )
    return _Judged(estimate, judgement, stated, findings, factors)


def _contradict(
    case: Case, uncertainties: tuple[Uncertainty, ...], assessed: Assessed
) -> tuple[tuple[Finding, ...], dict[str, float]]:
    """Findings on stated numbers that the data contradict, and by what their uncertainty grows, where
    chi-square then is that of noise, or most of its excess is gone: else something else is wrong. Not in
    sliding bands, where stiffness that changes with frequency looks like another mass, nor of a wrong sign.
    """
    settings, pulls = case.setup.settings, assessed.pulls
    before, after = case.estimate.gof.chi2_reduced, assessed.reduced
    assert before is not None and after is not None and assessed.p_value is not None and pulls is not None
    most_left = (1 - causes.EXPLAINED) * (before - 1)
    unexplained = assessed.p_value < diagnostics.MISMATCH_P and after - 1 > most_left
    wrong_sign = not case.setup.closed_loop and diagnostics.sign_findings(case.measured)
    if settings.sliding is not None or unexplained or wrong_sign:
        return (), {}
    mass = mass_uncertainty(settings)
    values = {} if mass is None else {mass.source: float(settings.mass)}  # type: ignore[arg-type]
    sources = (uncertainty.source for uncertainty in uncertainties)
    factors = dict(zip(sources, map(float, pulls.factors), strict=True))
    return tuple(causes.stated_findings(uncertainties, pulls, values)), factors


def _find_faults(case: Case, judged: _Judged, laws: Sequence[comparison.OtherLaw]) -> dict[str, Finding]:
    """Findings by the cause of the residual that they name: channels of a response to a force taken for
    others, or a channel that is late; else under "" on a mass without uncertainty: a late channel makes any
    mass look wrong. Both are of a model linear in its parameters, of reliable phases. A delay is not named
    where the first of *laws* is better supported, and with it where that has support as well.
    """
    settings, model, estimate = case.setup.settings, case.model, case.estimate
    # What stated numbers explain needs no other cause.
    p_value = judged.estimate.gof.chi2_p
    is_rejected = not estimate.converged or (p_value is not None and p_value < diagnostics.MISMATCH_P)
    if is_rejected and (misread := diagnostics.reading_findings(case.measured, case.setup, estimate)):
        return misread
    has_error = settings.kind.of_base or mass_uncertainty(settings) is not None
    if has_error or not (settings.estimates.phase and estimate.converged and isinstance(model, DynamicModel)):
        return {}
    delay = _delay_by_either_damping(case, model) if is_rejected else None
    of_law = laws[0].aic - 2 * (estimate.values.size + 1) if laws else np.inf
    if delay is not None and delay[0] < of_law + comparison.NO_SUPPORT:
        left, channel, finding = delay
        if left < of_law - comparison.NO_SUPPORT:
            return {f"a delay of {channel}": finding}
        also = f"{finding.message}; {laws[0].words} explains as much"
        return {f"a delay of {channel} or {laws[0].words}": replace(finding, message=also)}
    masses = causes.mass_findings(case.measured, model, estimate.values, case.setup, judged.stated)
    return {"": masses[0]} if masses else {}


def _delay_by_either_damping(case: Case, model: DynamicModel) -> causes.Delay | None:
    delay, setup = causes.likeliest_delay(case.measured, model, case.estimate.values), case.setup
    with contextlib.suppress(ConfigError, FitError, np.linalg.LinAlgError):
        if delay is not None and setup.settings.kind.one_frf:
            other = _model(replace(setup, settings=replace(setup.settings, damping=HYSTERETIC.name)))
            start = _estimate(case.measured, other, setup.settings)
            delay = causes.either_delay(case.measured, other, start.values, delay)
    return delay


def _refit(setup: Setup, model: derived.BandModel, measured: Measured) -> tuple[Parameter, ...]:
    estimate = _estimate(measured, model, setup.settings)
    if not estimate.converged:
        raise FitError("not converged")
    return derived.reported_parameters(estimate, model, setup)


def _eliminate(
    measured: Measured, model: DynamicModel, estimate: Estimate, settings: FitSettings
) -> tuple[DynamicModel, Estimate, list[str]]:
    """Backward elimination: the least significant parameter is set to zero until all are significant."""
    notes: list[str] = []
    while sum(term.droppable for term in model.terms) > 1:
        std_errors = np.sqrt(np.diag(estimate.covariance))
        t_ratios = {
            number: float(abs(estimate.values[number]) / std_errors[number])
            for number, term in enumerate(model.terms)
            if term.droppable and std_errors[number] > 0
        }
        weakest = min(t_ratios, key=t_ratios.__getitem__, default=None)
        if weakest is None or t_ratios[weakest] > student_limit(int(estimate.student_dof[weakest])):
            break
        name = model.terms[weakest].name
        t_ratio = f"|t| = {t_ratios[weakest]:.2f}"
        notes.append(f"{name} was dropped as insignificant ({t_ratio}) and is taken as zero")
        model = model.fix(name)
        estimate = _estimate(measured, model, settings)
    return model, estimate, notes


def _curve(view: FormView, measured: Measured, fit: _BandFit, *, dense: bool) -> FittedCurve:
    frequency = measured.omega / (2 * np.pi)
    factor = view.factor(frequency)[:, None, None]
    variance = measured.variance
    curve = FittedCurve(
        frequency,
        measured.matrix * factor + view.offset,
        fit.fitted * factor + view.offset,
        variance=None if variance is None else variance.reshape(measured.matrix.shape) * np.abs(factor) ** 2,
        outputs=tuple(port.label for port in measured.outputs),
        inputs=tuple(port.label for port in measured.inputs),
        form=view.form,
    )
    if not dense:
        return curve

    def model(at: FloatArray) -> ComplexArray:
        receptance = fit.model.receptance(fit.values, 2 * np.pi * at)
        return receptance * view.factor(at)[:, None, None] + view.offset

    between, values = derived.drawn_densely(model, frequency)
    return replace(curve, dense_frequency=between, dense=values)

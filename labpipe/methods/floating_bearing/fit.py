"""Model dynamic-stiffness: coefficients of a bearing or seal in a floating stator, with the uncertainty of
noise and of given numbers.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import chance_text
from labpipe.errors import ConfigError, FitError, SettingError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.estimation.regression import triangle_of
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import determination, inflation_factors
from labpipe.methods.floating_bearing.findings import (
    BalanceError,
    effective_forces,
    motion_findings,
    noise_findings,
    notes_on_given,
    physical_findings,
    remedy,
    shown_course,
    stator_error,
    whirl_findings,
)
from labpipe.methods.floating_bearing.forms import BANDS, FORMS, Form, StiffnessModel, banded_form
from labpipe.methods.floating_bearing.likelihood import (
    Balance,
    ErrorsInVariables,
    GivenErrors,
    Noise,
    Optimum,
    estimate,
)
from labpipe.methods.floating_bearing.settings import (
    COMPARED,
    Baseline,
    DynamicStiffnessSettings,
    Given,
    SmearedBalance,
    balance_of,
    changes_by_given,
    contradictions,
    given_errors,
    given_uncertainties,
    response_of,
    smeared_balance,
    smoothed_channels,
)
from labpipe.methods.floating_bearing.stator import (
    Stator,
    line_stiffness,
    motion_note,
    other_excitations,
    stator_of,
)
from labpipe.methods.floating_bearing.values import (
    FittedStiffness,
    Shaft,
    add_budget,
    balance_fit,
    coefficients,
    derived_values,
    dimensionless,
)
from labpipe.quantities import UnitError, parse_value
from labpipe.records.finding import Finding, Parameter
from labpipe.records.fit_details import DynamicStiffness, GivenUncertainty, OtherExcitation, systematic
from labpipe.records.identification import Candidate, Fit, Goodness
from labpipe.records.settings import ESTIMATE
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import Uncertain, is_uncertain, split_uncertainty
from labpipe.registry import nearest

NONE = Uncertain(0.0)


def with_baseline(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    """Settings with the result of the earlier fit (or of the only one of the test) that `baseline` names.
    ConfigError if there is none.
    """
    name: str = settings.model_settings.baseline
    if not name:
        return settings
    usable = [fit for fit in fits if fit.detail(DynamicStiffness) is not None]
    baselines = [fit for fit in usable if fit.name == name] or [fit for fit in usable if fit.test == name]
    if not baselines:
        hint = f"fits are made in their order; {nearest(name, [fit.name for fit in usable])}"
        raise ConfigError(f"baseline: no earlier fit '{name}' of model dynamic-stiffness", hint=hint)
    if len(baselines) > 1:
        what = f"{len(baselines)} results ({', '.join(fit.test for fit in baselines)})"
        hint = "say `test:` in the fit of the baseline"
        raise ConfigError(f"baseline: '{name}' has {what}", hint=hint)
    own = replace(settings.model_settings, fitted_baseline=baseline_of(baselines[0]))
    return replace(settings, model_settings=own)


def baseline_of(fit: Fit) -> Baseline:
    """The fitted stiffness of another fit as a baseline: its noise and its given numbers become uncertainties
    of this one. What its model leaves unexplained counts as its noise.
    """
    shown = fit.detail(DynamicStiffness)
    if shown is None or not fit.converged:
        raise ConfigError(f"the fit '{fit.name}' is not a baseline: it did not converge")
    label = f"noise of {fit.name}" + (f", test {fit.test}" if fit.test else "")
    errors = np.sqrt(np.diag(shown.noise))
    scale = np.where(errors > 0, errors, 1.0)
    values, vectors = np.linalg.eigh(shown.noise / np.outer(scale, scale))
    changes = (vectors * np.sqrt(np.maximum(values, 0.0))).T * scale
    uncertainties = (GivenUncertainty(label, changes), *shown.uncertainties)
    return Baseline(fitted_model(shown), shown.values, uncertainties, fit.test, fit.band_hz)


def fitted_model(shown: DynamicStiffness) -> StiffnessModel:
    form = banded_form(np.array(shown.bands)) if shown.form == BANDS else FORMS[shown.form]
    return StiffnessModel(form, shown.symmetry)


def given_baseline(section: DynamicStiffnessSettings) -> Baseline | None:
    """The baseline of given numbers, the same in x and y; else that of an earlier fit."""
    if section.baseline_stiffness is None and section.baseline_damping is None:
        return section.fitted_baseline
    stiffness, damping = section.baseline_stiffness or NONE, section.baseline_damping or NONE
    pairs = (("stiffness of the baseline", stiffness, "N/m"), ("damping of the baseline", damping, "N.s/m"))
    uncertainties = tuple(
        GivenUncertainty(
            number.source or f"{name}, {number.value:g} {unit} +- {number.std_error:g} {unit}",
            number.std_error * np.eye(2)[place][None],
            std_error=number.std_error,
            unit=unit,
        )
        for place, (name, number, unit) in enumerate(pairs)
        if number.std_error > 0
    )
    model = StiffnessModel(FORMS["kc"], "isotropic")
    return Baseline(model, np.array([stiffness.value, damping.value]), uncertainties)


# Functions of the real and of the imaginary part of H, by form.
REAL_PARTS = {"kc": 1, "kcm": 2}


def least_squares(
    balance: Balance, model: StiffnessModel
) -> tuple[Optimum, Callable[[ComplexArray], FloatArray]]:
    """The estimate, and how it responds to changes of e (n, n_line, n_run, 2) [N]: (n, n_parameter)
    [parameter units].

    ConfigError for other forms than kc and kcm, FitError where runs do not give H. Equation (ds-ls).
    """
    if model.form.name not in REAL_PARTS or model.symmetry == "seal":
        what = "least squares is for form kc or kcm without symmetry"
        raise SettingError("estimator", what, "estimator: ml")
    lines = line_stiffness(balance)
    basis = model.form.basis(np.empty(0), lines.omega)
    designs = basis[_rows_of(model, 0)].real.T, basis[_rows_of(model, 1)].imag.T
    for design in designs:
        if design.shape[0] <= design.shape[1]:
            hint = "widen the band"
            raise FitError(f"{design.shape[0]} lines cannot determine the coefficients", hint=hint)
    values, variance = _solve(model, lines.stiffness, designs)
    covariance, n_element = np.zeros((values.size, values.size)), model.elements.shape[0]
    numbers = np.arange(values.size).reshape(-1, n_element)
    for part, design in enumerate(designs):
        inverse = np.linalg.inv(design.T @ design)
        for element, rows in enumerate(numbers[_rows_of(model, part)].T):
            covariance[np.ix_(rows, rows)] = variance[part, element] * inverse
    dof = 2 * n_element * lines.omega.size - values.size
    columns = model.jacobian(values, lines.omega).reshape(values.size, -1)
    design = triangle_of(np.concatenate([columns.real, columns.imag], axis=1).T)
    estimate = Optimum(model, values, covariance, np.nan, dof, np.nan, True, 0, design)

    def respond(errors: ComplexArray) -> FloatArray:
        moved = errors.swapaxes(-1, -2) @ lines.inverse
        return np.stack([_solve(model, change, designs)[0] for change in moved])

    return estimate, respond


def _rows_of(model: StiffnessModel, part: int) -> list[int]:
    """Numbers of the matrices that the real (0) or imaginary part (1) of H tells: K and M, or C."""
    return [1] if part else [number for number in range(len(model.form.matrices)) if number != 1]


def _solve(
    model: StiffnessModel, stiffness: ComplexArray, designs: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    measured = np.einsum("...ij,cij->...c", stiffness, model.elements)
    solution = np.empty((len(model.form.matrices), measured.shape[-1]))
    variance = np.empty((2, measured.shape[-1]))
    for part, (design, side) in enumerate(zip(designs, (measured.real, measured.imag), strict=True)):
        coefficients = np.linalg.pinv(design) @ side
        solution[_rows_of(model, part)] = coefficients
        squares = np.sum((side - design @ coefficients) ** 2, axis=0)
        variance[part] = squares / (design.shape[0] - design.shape[1])
    return solution.reshape(-1), variance


# Difference in BIC beyond which the evidence is very strong (Kass and Raftery 1995, J. Am. Stat. Assoc.
# 90:773).
STRONG = 10.0


def compare(
    balance: Balance,
    symmetry: str,
    noise: Noise,
    forms: Sequence[str],
    of_form: Optimum | None = None,
    uncertain: GivenErrors | None = None,
) -> tuple[tuple[Candidate, ...], dict[str, Optimum]]:
    """Candidates in ascending BIC, and the estimates by form. Forms that the lines cannot determine are left
    out. Equation (ds-bic).
    """
    estimates = {} if of_form is None else {of_form.model.form.name: of_form}
    for form in forms:
        try:
            if form not in estimates:
                estimates[form] = estimate(balance, StiffnessModel(FORMS[form], symmetry), noise, uncertain)
        except FitError:
            continue
    candidates = [_candidate(form, fitted, balance.n_equation) for form, fitted in estimates.items()]
    return tuple(sorted(candidates, key=_bic)), estimates


def _bic(candidate: Candidate) -> float:
    assert candidate.bic is not None
    return candidate.bic


def _candidate(form: str, best: Optimum, n_equation: int) -> Candidate:
    n, chi2 = best.values.size, best.squares
    bic = chi2 + n * float(np.log(n_equation))
    return Candidate(form, n, chi2, best.dof, chi2 + 2 * n, bic=bic, chi2_p=best.p_value)


def choice_findings(candidates: Sequence[Candidate], form: str, given: bool) -> tuple[Finding, ...]:
    if not candidates:
        return ()
    findings = []
    if all(c.chi2_p is not None and c.chi2_p < MISMATCH_P for c in candidates):
        least = min(candidates, key=lambda candidate: candidate.chi2 / candidate.dof)
        names = ", ".join(candidate.name for candidate in candidates)
        message = (
            f"none of the compared forms ({names}) explains the data: the best, {least.name}, leaves "
            f"{least.chi2 / least.dof:.3g} times the squares that noise would ({chance_text(least.chi2_p)}). "
            "The bearing is not linear at this amplitude, a channel or the baseline is wrong, or its course "
            "over frequency is another one; look at the figure over frequency"
        )
        findings.append(Finding("no-model", message))
    best = candidates[0]
    this = next((candidate for candidate in candidates if candidate.name == form), None)
    if given and this is not None and _bic(this) - _bic(best) > STRONG:
        message = (
            f"another form is better supported by the data: '{best.name}' with {best.parameters} parameters "
            f"has BIC {_bic(best):.4g}, '{form}' with {this.parameters} parameters {_bic(this):.4g}"
        )
        findings.append(Finding("other-model", message))
    return tuple(findings)


BANDS_BY_DEFAULT = 10
# Rounds in which what leaks by the model of the last round is taken out of the balance.
LEAKAGE_ROUNDS = 3
LS_NOTE = (
    "ls: as in the literature: H of every line from two runs, then Re H on (1, -w^2) and Im H on w with "
    "equal weights. The noise of the motion is not regarded and that of the lines taken as equal: errors are "
    "up to several times those of ml, and intervals may be short."
)


@dataclass(frozen=True)
class SolvedStiffness:
    """An estimate, what given numbers do to it, its amplification (n_parameter,) [parameter units] of errors,
    compared forms, and findings on given numbers that the data contradict.
    """

    best: Optimum
    uncertainties: tuple[GivenUncertainty, ...]
    amplification: FloatArray | None
    excitations: tuple[OtherExcitation, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    findings: tuple[Finding, ...] = ()


def dynamic_stiffness_fits(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    """One fit, or one per band. ConfigError where settings and channels do not fit together, FitError where
    the lines cannot determine the coefficients.
    """
    if not isinstance(settings.mass, float) and settings.mass != ESTIMATE:
        raise SettingError("mass", "the stator has one mass", "for example stator_mass: 60 kg +- 0.6 kg")
    section: DynamicStiffnessSettings = settings.model_settings
    if settings.mass != ESTIMATE and section.stator_mass is not None:
        raise SettingError("mass", "the mass of the stator is given twice", "leave out mass or stator_mass")
    if section.forms != COMPARED and not settings.compare:
        raise SettingError("forms", "'forms' are those of `compare: true`", "form: NAME for one")
    if section.fitted_baseline is not None and section.fitted_baseline.test == spectra.name:
        return ()
    return tuple(_fit(spectra, settings, band) for band in settings.bands or (settings.band,))


def _fit(spectra: ChannelSpectra, settings: FitSettings, band: tuple[float, float] | None) -> Fit:
    section: DynamicStiffnessSettings = settings.model_settings
    stator = stator_of(spectra, band, settings.input, settings.output)
    given = _given_numbers(settings, stator)
    balance = balance_of(stator, given)
    smeared = smeared_balance(stator, given, balance)
    noise, solved = stator.noise, _solved_fit(stator, given, balance, settings, smeared)
    likely = settings.estimates.likelihood
    best = solved.best
    error = stator_error(best, balance, noise) if likely else BalanceError(best.covariance)
    of_given = systematic(solved.uncertainties, best.values.size)
    fitted = FittedStiffness(best.model, best.values, best.covariance, error.covariance + of_given, best.dof)
    speed = _statement(section.speed, spectra, "speed", "Hz")
    shaft = Shaft(speed, section.rotor_mass, section.rotor_stiffness)
    load = _statement(section.load, spectra, "load", "N") if section.clearance is not None else None
    main = coefficients(fitted, inflation_factors(best.design))
    others, turning = ((), None) if given.absolute else derived_values(fitted, stator.omega, shaft)
    whole_band = band or (float(stator.omega[0] / (2 * np.pi)), float(stator.omega[-1] / (2 * np.pi)))
    valued = (*main, *others, *dimensionless(main, section, load, speed))
    parameters, budget = add_budget(valued, solved.uncertainties, best.dof)
    fit = _report(settings, balance, solved, whole_band, error.name_reason(parameters))
    stiffness = functools.partial(best.model.stiffness, best.values)
    findings = (
        *fit.findings,
        *solved.findings,
        *error.finding,
        *(turned_channels(stator, given, best) if likely else ()),
        *choice_findings(solved.candidates, best.model.form.name, section.form is not None),
        *(noise_findings(best, noise) if likely else ()),
        *(() if smeared is None else smeared.finding(stiffness, modelled=likely)),
        *motion_findings(stator, given),
        *whirl_findings(turning, speed),
        *physical_findings(parameters),
    )
    notes = (
        *notes_on_given(given, solved.uncertainties, fitted),
        motion_note(stator),
        *_left_out(section, parameters),
        *_exact_conditions(section, spectra, parameters),
        *(() if likely else (LS_NOTE,)),
    )
    shown = shown_course(balance, fitted, solved.uncertainties, given, shaft.sense)
    shown = replace(shown, noise=error.covariance, excitations=solved.excitations)
    return replace(
        fit,
        findings=(*findings, *spectra.findings),
        notes=notes,
        details=(shown,),
        budget=budget if fit.converged else None,
        discrepancy=error.discrepancy,
    )


# Chi-square per degree of freedom from which a sign is asked for, and the share of it that is left then.
FAR_OFF, LEFT, DIRECT_DAMPING = 10.0, 0.1, ("c_xx", "c_yy")


def turned_channels(stator: Stator, given: Given, best: Optimum) -> list[Finding]:
    """The channel that explains a residual far from noise where its sign is turned, by a fit with each. Of a
    force and an acceleration that both do, the one that leaves fewer negative direct damping coefficients.
    """
    tried = []
    for number in np.flatnonzero(np.any(stator.to_axes, axis=0)) if best.reduced > FAR_OFF else ():
        signs = np.where(np.arange(stator.to_axes.shape[1]) == number, -1.0, 1.0)
        turned = replace(stator, to_axes=stator.to_axes * signs)
        uncertain = functools.partial(changes_by_given, turned, given)
        with contextlib.suppress(FitError, np.linalg.LinAlgError):
            other = estimate(balance_of(turned, given), best.model, stator.noise, uncertain)
            damping = [v for n, v in zip(best.model.names, other.values, strict=True) if n in DIRECT_DAMPING]
            if other.reduced < LEFT * best.reduced:
                name = stator.spectra.channels[number].name
                tried.append((int(np.sum(np.less(damping, 0))), other.reduced, name))
    if not tried:
        return []
    _, left, name = min(tried)
    what = f"channel {name} has the wrong sign: turned, it leaves {left:.3g} times the squares of noise"
    cure = f"in place of {best.reduced:.3g}; `invert: true` for it in the rig file"
    return [Finding("unphysical", f"{what}, {cure}")]


NO_DIMENSIONLESS = "no coefficients without dimension: they need a speed, a load, and another form than bands"
NO_ONSET = (
    "no onset speed: it needs form kc or kcm with cross terms, motion against the shaft, a speed, and a "
    "bearing that whirls"
)


def _left_out(section: DynamicStiffnessSettings, parameters: Sequence[Parameter]) -> list[str]:
    asked = (
        (section.clearance, "k_xx_dimensionless", NO_DIMENSIONLESS),
        (section.rotor_mass, "onset_speed", NO_ONSET),
    )
    names = {parameter.name for parameter in parameters}
    return [
        f"dynamic-stiffness: {note}."
        for given, name, note in asked
        if given is not None and name not in names
    ]


def _exact_conditions(
    section: DynamicStiffnessSettings, spectra: ChannelSpectra, parameters: Sequence[Parameter]
) -> list[str]:
    names = {parameter.name for parameter in parameters}
    uncertain = [
        f"{name}: {spectra.conditions[name]}"
        for name, value in (("speed", section.speed), ("load", section.load))
        if value is None and is_uncertain(spectra.conditions.get(name))
    ]
    if not uncertain or not names & {"whirl_frequency_ratio", "k_xx_synchronous", "k_xx_dimensionless"}:
        return []
    what = "values by the speed or the load are without the uncertainty of the condition"
    return [f"dynamic-stiffness: the intervals of {what} {', '.join(uncertain)}."]


def _given_numbers(settings: FitSettings, stator: Stator) -> Given:
    section: DynamicStiffnessSettings = settings.model_settings
    mass = section.stator_mass
    if mass is None and isinstance(settings.mass, float):
        mass = dict(settings.uncertainties).get("mass", Uncertain(settings.mass))
    mass = None if mass == NONE else mass
    given = Given(mass, given_baseline(section), section.motion == "absolute")
    _check_band(stator, given.baseline)
    if mass is not None and effective_forces(stator):
        what = "the forces are without the stator's inertia already"
        raise SettingError("stator_mass", what, "stator_mass: 0 kg")
    if given.accelerated and not stator.accelerated and not given.absolute:
        what = (
            f"the {'baseline' if mass is None else 'mass of the stator'} acts with the stator's absolute "
            "motion, and there are no accelerations: displacements against the shaft, which moves too, are "
            "not that"
        )
        hint = "measure accelerations in x and y; motion: absolute where the displacements are absolute"
        raise ConfigError(what, hint=hint)
    return given


def _check_band(stator: Stator, baseline: Baseline | None) -> None:
    if baseline is None:
        return
    lines, (low, high) = stator.omega / (2 * np.pi), baseline.band
    spacing = np.min(np.diff(lines))
    if lines[0] <= low - spacing or lines[-1] >= high + spacing:
        band = f"{low:.6g}-{high:.6g} Hz"
        what = f"the lines reach from {lines[0]:.6g} to {lines[-1]:.6g} Hz, the baseline was fitted in {band}"
        raise SettingError("baseline", what, f"band: {band}, or fit the baseline in a wider band")


def _statement(given: float | None, spectra: ChannelSpectra, condition: str, unit: str) -> float | None:
    if given is not None or condition not in spectra.conditions:
        return given
    try:
        return parse_value(split_uncertainty(str(spectra.conditions[condition]))[0], unit)
    except UnitError as error:
        hint = error.hint or f"a value in {unit}"
        raise ConfigError(f"conditions.{condition}: {error.what}", hint=hint) from None


def _solved_fit(
    stator: Stator, given: Given, balance: Balance, settings: FitSettings, smeared: SmearedBalance | None
) -> SolvedStiffness:
    section: DynamicStiffnessSettings = settings.model_settings
    noise = stator.noise
    if not settings.estimates.likelihood:
        model = StiffnessModel(_form(section, balance.omega), section.symmetry)
        best, respond = least_squares(balance, model)
        errors = given_errors(stator, given, best.model.stiffness(best.values, stator.omega), stator.channels)
        return SolvedStiffness(best, given_uncertainties(errors, respond), None)
    uncertain = functools.partial(changes_by_given, stator, given)
    best, candidates = _most_likely(balance, settings, noise, uncertain)
    if smeared is not None:
        measured = balance
        for _ in range(LEAKAGE_ROUNDS):
            balance = smeared.correct(measured, functools.partial(best.model.stiffness, best.values))
            best, candidates = _most_likely(balance, settings, noise, uncertain)
    problem = ErrorsInVariables(balance, best.model)
    stiffness = best.model.stiffness(best.values, stator.omega)
    state, columns = problem.at(best.values), problem.jacobian(best.values)
    errors = given_errors(stator, given, stiffness, smoothed_channels(stator, given, stiffness, state))
    uncertainties = given_uncertainties(errors, response_of(state.whiten, columns))
    contradicted: tuple[Finding, ...] = ()
    if best.pulls is not None:
        uncertainties, contradicted = contradictions(given, uncertainties, best.pulls)
    amplification = problem.size * np.sqrt(2 * np.diag(best.covariance) / noise.inflation)
    excitations = other_excitations(stator, best, columns)
    return SolvedStiffness(best, uncertainties, amplification, excitations, candidates, contradicted)


def _most_likely(
    balance: Balance, settings: FitSettings, noise: Noise, uncertain: GivenErrors
) -> tuple[Optimum, tuple[Candidate, ...]]:
    section: DynamicStiffnessSettings = settings.model_settings
    model = StiffnessModel(_form(section, balance.omega), section.symmetry)
    if not settings.compare:
        return estimate(balance, model, noise, uncertain), ()
    of_form = None if section.form is None else estimate(balance, model, noise, uncertain)
    candidates, estimates = compare(balance, section.symmetry, noise, section.forms, of_form, uncertain)
    if not candidates:
        raise SettingError("forms", "no compared form can be determined by these lines", "widen the band")
    return (of_form or estimates[candidates[0].name]), candidates


def _form(section: DynamicStiffnessSettings, omega: FloatArray) -> Form:
    if section.form != BANDS:
        return FORMS[section.form or "kcm"]
    low, high = omega[0] / (2 * np.pi), omega[-1] / (2 * np.pi)
    count = BANDS_BY_DEFAULT
    if section.band_width is not None:
        count = max(round((high - low) / section.band_width), 1)
    return banded_form(np.linspace(low, high, count + 1))


def _report(
    settings: FitSettings,
    balance: Balance,
    solved: SolvedStiffness,
    band: tuple[float, float],
    parameters: tuple[Parameter, ...],
) -> Fit:
    best = solved.best
    stiffness = best.model.stiffness(best.values, balance.omega)
    residual = balance.right - np.einsum("lij,lrj->lri", stiffness, balance.motion)
    r2, adjusted = determination(balance.right, residual, len(best.model.names))
    likely = settings.estimates.likelihood
    gof = Goodness(r2, adjusted, best.reduced if likely else None, best.p_value if likely else None)
    n_line = balance.omega.size
    fit = balance_fit(settings, best, gof, solved.amplification, parameters, band, n_line, remedy)
    if best.model.n_shape:
        # What is common to two terms of such a form is told by their correlation and intervals, which hold;
        # the lines are not a fault.
        fit = replace(fit, findings=tuple(f for f in fit.findings if f.code != "collinear"))
    return replace(fit, candidates=solved.candidates)

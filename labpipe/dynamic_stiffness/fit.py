"""Model dynamic-stiffness: coefficients of a bearing or seal in a floating stator, with the doubt of noise and of given numbers."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.dynamic_stiffness.baseline import given_baseline
from labpipe.dynamic_stiffness.budget import budgeted
from labpipe.dynamic_stiffness.choice import choice_findings, compared
from labpipe.dynamic_stiffness.dimensionless import Bearing, dimensionless
from labpipe.dynamic_stiffness.estimate import Estimate, GivenErrors, Noise, estimate
from labpipe.dynamic_stiffness.excitation import motion_note, other_excitations
from labpipe.dynamic_stiffness.findings import (
    effective_forces,
    given_notes,
    mismatch_factor,
    mismatch_findings,
    motion_findings,
    noise_findings,
    physical_findings,
    remedy,
    whirl_findings,
)
from labpipe.dynamic_stiffness.forms import BANDS, FORMS, Form, StiffnessModel, banded
from labpipe.dynamic_stiffness.given import (
    Given,
    balance_of,
    errors_by_given,
    given_doubts,
    given_errors,
    response_of,
    smoothed_channels,
)
from labpipe.dynamic_stiffness.least_squares import least_squares
from labpipe.dynamic_stiffness.likelihood import Balance, ErrorsInVariables
from labpipe.dynamic_stiffness.settings import DynamicStiffnessSettings
from labpipe.dynamic_stiffness.shown import shown_course
from labpipe.dynamic_stiffness.stator import Stator, stator_of
from labpipe.dynamic_stiffness.values import Doubted, Shaft, coefficients, derived_values
from labpipe.errors import ConfigError
from labpipe.identify import statistics
from labpipe.identify.diagnostics import estimate_findings, goodness_findings
from labpipe.identify.reported import without_intervals
from labpipe.identify.settings import ESTIMATE, FitSettings
from labpipe.identify.statistics import condition_number, correlation, determination, inflation_factors
from labpipe.quantities import UnitError, parse_value
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.dynamic_stiffness import GivenDoubt, OtherExcitation, systematic
from labpipe.records.finding import Finding
from labpipe.records.identification import Candidate, Fit, Goodness, Parameter
from labpipe.records.uncertain import Uncertain, split_doubt

BANDS_BY_DEFAULT = 10
LS_NOTE = (
    "ls: as in the literature: H of every line from two runs, then Re H on (1, -w^2) and Im H on w with equal weights. The noise of the "
    "motion is not regarded and that of the lines taken as equal: errors are up to several times those of ml, and intervals may be short."
)


@dataclass(frozen=True)
class Solved:
    """An estimate, what given numbers do to it, its amplification (n_parameter,) [parameter units] of errors, and compared forms."""

    best: Estimate
    doubts: tuple[GivenDoubt, ...]
    amplification: FloatArray | None
    excitations: tuple[OtherExcitation, ...] = ()
    candidates: tuple[Candidate, ...] = ()


def dynamic_stiffness_fits(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    """One fit, or one per band; none of the test that the baseline itself was fitted on.

    ConfigError where settings and channels do not fit together, FitError where the lines cannot determine the coefficients.
    """
    _check(settings)
    section: DynamicStiffnessSettings = settings.model_settings
    if section.known is not None and section.known.test == spectra.name:
        return ()
    return tuple(_fit(spectra, settings, band) for band in settings.bands or (settings.band,))


def _check(settings: FitSettings) -> None:
    """ConfigError for more than one mass."""
    if not isinstance(settings.mass, float) and settings.mass != ESTIMATE:
        raise ConfigError("the stator has one mass", hint="for example stator_mass: 60 kg +- 0.6 kg", field="mass")


def _fit(spectra: ChannelSpectra, settings: FitSettings, band: tuple[float, float] | None) -> Fit:
    section: DynamicStiffnessSettings = settings.model_settings
    stator = stator_of(spectra, band, settings.input, settings.output)
    given = _given(settings, stator)
    balance = balance_of(stator, given)
    noise = Noise(spectra.covariance_dof, stator.shared, stator.shared_power)
    solved = _solved(stator, given, balance, settings, noise)
    likely = settings.estimates.likelihood
    best, factor = solved.best, mismatch_factor(solved.best) if likely else 1.0
    of_given = systematic(solved.doubts, best.values.size)
    doubted = Doubted(best.model, best.values, best.covariance, factor**2 * best.covariance + of_given, best.dof)
    shaft = Shaft(_stated(section.speed, spectra, "speed", "Hz"), section.rotor_mass, section.rotor_stiffness)
    load = _stated(section.load, spectra, "load", "N") if section.clearance is not None else None
    bearing = Bearing(section.clearance, load, section.viscosity, section.diameter, section.length)
    main = coefficients(doubted, inflation_factors(best.design))
    # A baseline is no bearing of a shaft.
    others, turning = ((), None) if given.absolute else derived_values(doubted, stator.omega, shaft)
    whole_band = band or (float(stator.omega[0] / (2 * np.pi)), float(stator.omega[-1] / (2 * np.pi)))
    parameters, budget = budgeted((*main, *others, *dimensionless(main, bearing, shaft.speed)), solved.doubts, best.dof)
    fit = _reported(settings, balance, solved, whole_band, parameters)
    findings = (
        *fit.findings,
        *(mismatch_findings(best) if likely else ()),
        *choice_findings(solved.candidates, best.model.form.name, section.form is not None),
        *(noise_findings(best, noise) if likely else ()),
        *motion_findings(stator, given),
        *whirl_findings(turning, shaft.speed),
        *physical_findings(parameters),
    )
    notes = (*given_notes(given, solved.doubts, doubted), motion_note(stator), *(() if likely else (LS_NOTE,)))
    shown = shown_course(balance, doubted, solved.doubts, given, shaft.sense)
    shown = replace(shown, excitations=solved.excitations)
    return replace(
        fit, findings=(*findings, *spectra.findings), notes=notes, dynamic_stiffness=shown, budget=budget if fit.converged else None
    )


def _given(settings: FitSettings, stator: Stator) -> Given:
    """Mass and baseline of the settings; ConfigError where accelerations are missing, or the inertia is out already."""
    section: DynamicStiffnessSettings = settings.model_settings
    mass = section.stator_mass or (Uncertain(settings.mass) if isinstance(settings.mass, float) else None)
    if mass is not None and mass.value == 0:
        mass = None
    given = Given(mass, given_baseline(section), section.motion == "absolute")
    if mass is not None and effective_forces(stator):
        raise ConfigError("the forces are without the stator's inertia already", hint="stator_mass: 0 kg", field="stator_mass")
    if given.accelerated and not stator.accelerated and not given.absolute:
        what = "mass of the stator" if mass is not None else "baseline"
        raise ConfigError(
            f"the {what} acts with the stator's absolute motion, and there are no accelerations: displacements against the shaft, which "
            "moves too, are not that",
            hint="measure accelerations in x and y; motion: absolute where the displacements are absolute",
        )
    return given


def _stated(given: float | None, spectra: ChannelSpectra, condition: str, unit: str) -> float | None:
    """A number of the settings, else the test's condition of that name; ConfigError for one that cannot be read."""
    if given is not None or condition not in spectra.conditions:
        return given
    try:
        return parse_value(split_doubt(str(spectra.conditions[condition]))[0], unit)
    except UnitError as error:
        raise ConfigError(f"conditions.{condition}: {error.what}", hint=error.hint or f"a value in {unit}") from None


def _solved(stator: Stator, given: Given, balance: Balance, settings: FitSettings, noise: Noise) -> Solved:
    """The estimate by the settings' estimator."""
    section: DynamicStiffnessSettings = settings.model_settings
    if not settings.estimates.likelihood:
        best, respond = least_squares(balance, StiffnessModel(_form(section, balance.omega), section.symmetry))
        errors = given_errors(stator, given, best.model.stiffness(best.values, stator.omega), stator.channels)
        return Solved(best, given_doubts(errors, respond), None)
    best, candidates = _most_likely(balance, settings, noise, functools.partial(errors_by_given, stator, given))
    problem = ErrorsInVariables(balance, best.model)
    stiffness, state, columns = best.model.stiffness(best.values, stator.omega), problem.at(best.values), problem.columns(best.values)
    errors = given_errors(stator, given, stiffness, smoothed_channels(stator, given, stiffness, state))
    doubts = given_doubts(errors, response_of(state, columns))
    amplification = problem.size * np.sqrt(2 * np.diag(best.covariance) / noise.inflation)
    return Solved(best, doubts, amplification, other_excitations(stator, best, columns), candidates)


def _most_likely(balance: Balance, settings: FitSettings, noise: Noise, doubtful: GivenErrors) -> tuple[Estimate, tuple[Candidate, ...]]:
    """The estimate of the form that is given, or with `compare` and without one that of the best form."""
    section: DynamicStiffnessSettings = settings.model_settings
    model = StiffnessModel(_form(section, balance.omega), section.symmetry)
    if not settings.compare:
        return estimate(balance, model, noise, doubtful), ()
    of_form = None if section.form is None else estimate(balance, model, noise, doubtful)
    candidates, estimates = compared(balance, section.symmetry, noise, section.forms, of_form, doubtful)
    if not candidates:
        raise ConfigError("no compared form can be determined by these lines", hint="widen the band", field="forms")
    return (of_form or estimates[candidates[0].name]), candidates


def _form(section: DynamicStiffnessSettings, omega: FloatArray) -> Form:
    if section.form != BANDS:
        return FORMS[section.form or "kcm"]
    low, high = omega[0] / (2 * np.pi), omega[-1] / (2 * np.pi)
    count = BANDS_BY_DEFAULT if section.band_width is None else max(round((high - low) / section.band_width), 1)
    return banded(np.linspace(low, high, count + 1))


def _reported(settings: FitSettings, balance: Balance, solved: Solved, band: tuple[float, float], parameters: tuple[Parameter, ...]) -> Fit:
    """The fit with its goodness, and warnings on the estimate."""
    best = solved.best
    names = best.model.names
    stiffness = best.model.stiffness(best.values, balance.omega)
    residual = balance.right - np.einsum("lij,lrj->lri", stiffness, balance.motion)
    r2, adjusted = determination(balance.right, residual, len(names))
    likely = settings.estimates.likelihood
    gof = Goodness(r2, adjusted, best.reduced if likely else None, best.p_value if likely else None)
    as_estimate = statistics.Estimate(
        values=best.values,
        covariance=best.covariance,
        scaled_design=best.design,
        gof=gof,
        dof=best.dof,
        converged=best.converged,
        iterations=best.steps,
        amplification=solved.amplification,
    )
    warnings: list[Finding] = estimate_findings(as_estimate, names, balance.omega.size, best.model.units, remedy)
    if best.model.n_shape:
        # What is common to two terms of such a form is told by their correlation and intervals, which hold; the lines are no fault.
        warnings = [finding for finding in warnings if finding.code != "collinear"]
    if not best.converged:
        parameters = tuple(replace(parameter, std_error_inflated=None, systematic=None) for parameter in without_intervals(parameters))
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator=settings.estimator,
        band_hz=band,
        lines=balance.omega.size,
        equations=best.dof + len(names),
        dof=best.dof,
        gof=gof,
        parameters=parameters,
        condition_number=condition_number(best.design),
        correlation=correlation(best.covariance),
        converged=best.converged,
        iterations=best.steps,
        findings=(*warnings, *goodness_findings(gof)),
        candidates=solved.candidates,
    )

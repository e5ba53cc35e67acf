"""Model magnet: force per current and stiffness of magnetic bearings from a levitated rotor of known mass, in a closed loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.dynamic_stiffness.budget import budgeted
from labpipe.dynamic_stiffness.values import SAME, Valued
from labpipe.errors import ConfigError
from labpipe.identify import statistics
from labpipe.identify.diagnostics import MISMATCH_P, estimate_findings, goodness_findings
from labpipe.identify.reported import without_intervals
from labpipe.identify.settings import ESTIMATE, FitSettings
from labpipe.identify.statistics import condition_number, correlation, determination, estimated, inflation_factors, widened
from labpipe.magnet.balance import Between, MagnetModel, magnet_model
from labpipe.magnet.estimate import MagnetEstimate, magnet_estimate
from labpipe.magnet.findings import drawn, fit_notes, mismatch_findings, noise_findings, remedy
from labpipe.magnet.robust import robust_plant
from labpipe.magnet.rotor import Levitation, levitation_of, mass_matrix
from labpipe.magnet.settings import MagnetSettings
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.doubt import Doubt, doubt_of
from labpipe.records.dynamic_stiffness import systematic
from labpipe.records.identification import Fit, Goodness, Parameter
from labpipe.records.uncertain import Uncertain


def magnet_fits(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    """One fit, or one per band.

    ConfigError where settings and channels do not fit together, FitError where the lines cannot determine the parameters.
    """
    _check(settings)
    return tuple(_fit(spectra, settings, band) for band in settings.bands or (settings.band,))


def _check(settings: FitSettings) -> None:
    """ConfigError without the mass."""
    if settings.mass == ESTIMATE:
        hint = "mass: 4 kg +- 5 g, in the rig file or in the fit"
        raise ConfigError("the mass of the rotor must be known: all else is in proportion to it", hint=hint, field="mass")


def _fit(spectra: ChannelSpectra, settings: FitSettings, band: tuple[float, float] | None) -> Fit:
    magnet_settings: MagnetSettings = settings.model_settings
    mass = settings.mass if isinstance(settings.mass, float) else _matrix(settings.mass)
    rotor = levitation_of(spectra, band, (settings.input, settings.output), mass, magnet_settings)
    between = None if magnet_settings.hold is None else Between(magnet_settings.hold, magnet_settings.amplifier_bandwidth)
    model = magnet_model(rotor.labels, rotor.bearing, rotor.mass, magnet_settings.coupling, magnet_settings.passive_damping, between)
    best = magnet_estimate(rotor, model, _given(rotor, settings, mass))
    factor = float(np.sqrt(best.reduced)) if best.p_value < MISMATCH_P else 1.0
    whole = factor**2 * best.covariance + systematic(best.doubts, best.values.size)
    parameters, budget = budgeted(_valued(best, whole), best.doubts, best.dof)
    if not best.converged:
        parameters = tuple(replace(parameter, std_error_inflated=None, systematic=None) for parameter in without_intervals(parameters))
    gof = _goodness(rotor, model, best)
    as_estimate = statistics.Estimate(
        values=best.values,
        covariance=best.covariance,
        scaled_design=best.design,
        gof=gof,
        dof=best.dof,
        converged=best.converged,
        iterations=best.steps,
        amplification=best.amplification,
    )
    findings = (
        *estimate_findings(as_estimate, model.names, rotor.omega.size, model.units, remedy),
        *goodness_findings(gof),
        *mismatch_findings(best, factor),
        *noise_findings(rotor),
        *spectra.findings,
    )
    curve = drawn(rotor, best)
    plant = None if curve is None else robust_plant(best, curve, spectra.covariance_dof, magnet_settings.band_confidence)
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator=settings.estimator,
        band_hz=band or (float(rotor.omega[0] / (2 * np.pi)), float(rotor.omega[-1] / (2 * np.pi))),
        lines=rotor.omega.size,
        equations=best.dof + len(model.names),
        dof=best.dof,
        gof=gof,
        parameters=parameters,
        condition_number=condition_number(best.design),
        correlation=correlation(best.covariance),
        converged=best.converged,
        iterations=best.steps,
        findings=findings,
        notes=fit_notes(rotor, best, settings.doubts),
        curve=curve,
        robust=plant,
        budget=budget if best.converged else None,
    )


def _matrix(mass: object) -> FloatArray:
    """A list of masses as the diagonal of a matrix, rows as they are [kg]."""
    values = np.asarray(mass, float)
    return np.diag(values) if values.ndim == 1 else values


def _given(rotor: Levitation, settings: FitSettings, mass: FloatArray | float) -> list[tuple[Doubt, FloatArray]]:
    """Doubts of the mass and of the moment of inertia, with the change (n, n) [kg] of the mass matrix by one standard deviation."""
    magnet_settings: MagnetSettings = settings.model_settings
    given: list[tuple[Doubt, FloatArray]] = []
    of_mass = dict(settings.doubts).get("mass")
    if of_mass is not None and of_mass.std_error > 0 and isinstance(mass, float):
        source = f"mass of the rotor, {of_mass.value:g} kg +- {of_mass.std_error:g} kg"
        given.append((doubt_of(of_mass, source, "kg"), _mass_of(rotor, magnet_settings, mass + of_mass.std_error) - rotor.mass))
    if magnet_settings.inertia is not None and magnet_settings.inertia.std_error > 0:
        larger = replace(magnet_settings, inertia=Uncertain(magnet_settings.inertia.value + magnet_settings.inertia.std_error))
        change = _mass_of(rotor, larger, mass) - rotor.mass
        source = f"moment of inertia, {magnet_settings.inertia.value:g} kg.m^2 +- {magnet_settings.inertia.std_error:g} kg.m^2"
        given.append((doubt_of(magnet_settings.inertia, source, "kg.m^2"), change))
    return given


def _mass_of(rotor: Levitation, own: MagnetSettings, mass: FloatArray | float) -> FloatArray:
    return mass_matrix(rotor.currents, rotor.planes, mass, own)


def _valued(best: MagnetEstimate, whole: FloatArray) -> list[Valued]:
    """The parameters with their slopes; intervals by the *whole* covariance (n_parameter, n_parameter) [their units]."""
    vifs = inflation_factors(best.design)
    parameters = []
    for number, (name, unit) in enumerate(zip(best.model.names, best.model.units, strict=True)):
        noise, full = (float(np.sqrt(matrix[number, number])) for matrix in (best.covariance, whole))
        plain = estimated(name, unit, float(best.values[number]), noise, best.dof, float(vifs[number]))
        shown: Parameter = widened(plain, full / noise) if noise > 0 and full > SAME * noise else plain
        parameters.append(Valued(shown, np.eye(best.values.size)[number]))
    return parameters


def _goodness(rotor: Levitation, model: MagnetModel, best: MagnetEstimate) -> Goodness:
    """R^2 of the rotor's inertia explained by the magnets' forces, and chi-square."""
    axes, n = rotor.axes, rotor.n_axis
    inertia = rotor.omega[:, None, None] ** 2 * (axes[..., n:] @ rotor.mass.T)
    residual = (model.rows(best.values, rotor.omega)[:, None] @ axes[..., None])[..., 0]
    r2, adjusted = determination(inertia, residual, len(model.names))
    return Goodness(r2, adjusted, best.reduced, best.p_value)

"""identify: a frequency response and the settings of a fit -> one Fit per band. ESTIMATORS by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import ConfigError, FitError
from labpipe.identify.corrections import Estimated, corrected, derived_parameters
from labpipe.identify.diagnostics import estimate_findings, parameter_findings, quality_findings
from labpipe.identify.likelihood import maximum_likelihood
from labpipe.identify.measured import Measured, measured_part, select_ports
from labpipe.identify.model import DynamicModel
from labpipe.identify.models import MODELS, Setup
from labpipe.identify.regression import least_squares
from labpipe.identify.settings import FitSettings
from labpipe.identify.statistics import Estimate, condition_number, correlation, estimated, inflation_factors, student_limit
from labpipe.records.identification import Fit, FittedCurve, Parameter
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.bands import EDGE, lines_in
from labpipe.spectra.convert import receptance_factor

Estimator = Callable[[Measured, DynamicModel], Estimate]
ESTIMATORS: dict[str, Estimator] = {"ls": least_squares, "ml": maximum_likelihood}

Band = tuple[float, float]


def identify(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    """Fit the settings' model to a response: one Fit, or one per sliding band.

    Raises ConfigError where settings and response do not fit together, FitError where the data cannot support the fit.
    """
    rows, columns = select_ports(response, settings.input, settings.output)
    outputs = tuple(response.outputs[row] for row in rows)
    inputs = tuple(response.inputs[column] for column in columns)
    model = MODELS[settings.model](Setup(outputs, inputs, settings))
    fits = []
    for band, lines in _bands(response, settings):
        measured = measured_part(response, rows, columns, lines)
        try:
            fits.append(_fit_band(response, settings, model, measured, band, (rows, columns, lines)))
        except FitError as error:
            raise FitError(f"band {band[0]:g}-{band[1]:g} Hz: {error.what}", where=error.where, hint=error.hint) from None
    return tuple(fits)


def sliding_bands(whole: Band, width: float, step: float) -> list[Band]:
    """Bands of *width* every *step* [Hz] that lie in the whole band: 1-250 Hz by 15/3 Hz gives 79."""
    if width <= 0 or step <= 0:
        raise ConfigError("width and step of sliding bands must be positive")
    count = int(np.floor((whole[1] - whole[0] - width) / step + 1e-9)) + 1
    if count < 1:
        raise ConfigError(f"no band of {width:g} Hz fits into {whole[0]:g}-{whole[1]:g} Hz")
    return [(whole[0] + n * step, whole[0] + n * step + width) for n in range(count)]


def _bands(response: FrequencyResponse, settings: FitSettings) -> list[tuple[Band, NDArray[np.bool_]]]:
    """Every band with its lines; sliding bands hold the lines from their lower edge up to, not including, the upper one."""
    frequency = response.frequency
    whole = settings.band or (float(frequency[0]), float(frequency[-1]))
    if settings.sliding is None:
        return [(whole, lines_in(frequency, whole))]
    bands = sliding_bands(whole, settings.sliding.width, settings.sliding.step)
    return [(band, lines_in(frequency, band) & (frequency < band[1] * (1 - EDGE))) for band in bands]


def _fit_band(
    response: FrequencyResponse,
    settings: FitSettings,
    model: DynamicModel,
    measured: Measured,
    band: Band,
    chosen: tuple[list[int], list[int], NDArray[np.bool_]],
) -> Fit:
    estimator = ESTIMATORS[settings.estimator]
    estimate = estimator(measured, model)
    dropped: list[str] = []
    if settings.eliminate:
        model, estimate, dropped = _eliminated(measured, model, estimate, estimator)
    total = Estimated(model.names, model.units, estimate.values, estimate.covariance)
    reported = corrected(total, settings)
    parameters = (*_parameters(reported, estimate), *derived_parameters(total, settings, int(estimate.student_dof.min())))
    findings = (
        *estimate_findings(estimate, model.names, measured.n_equation, measured.omega.size),
        *parameter_findings(parameters),
        *quality_findings(response, *chosen),
    )
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator=settings.estimator,
        band_hz=band,
        lines=measured.omega.size,
        equations=measured.n_equation,
        dof=estimate.dof,
        gof=estimate.gof,
        parameters=parameters,
        condition_number=condition_number(estimate.scaled_design),
        correlation=correlation(reported.covariance),
        converged=estimate.converged,
        iterations=estimate.iterations,
        findings=findings,
        notes=(*estimate.notes, *dropped),
        curve=_curve(response, measured, model, estimate),
    )


def _parameters(reported: Estimated, estimate: Estimate) -> list[Parameter]:
    vifs = inflation_factors(estimate.scaled_design)
    return [
        estimated(name, unit, reported.value(name), reported.std_error(name), int(dof), float(vif))
        for name, unit, vif, dof in zip(reported.names, reported.units, vifs, estimate.student_dof, strict=True)
    ]


def _eliminated(
    measured: Measured, model: DynamicModel, estimate: Estimate, estimator: Estimator
) -> tuple[DynamicModel, Estimate, list[str]]:
    """Backward elimination: the least significant parameter is set to zero and the fit repeated until all are significant."""
    notes: list[str] = []
    while sum(term.droppable for term in model.terms) > 1:
        std_errors = np.sqrt(np.diag(estimate.covariance))
        droppable = [number for number, term in enumerate(model.terms) if term.droppable and std_errors[number] > 0]
        t_ratios = {number: float(abs(estimate.values[number]) / std_errors[number]) for number in droppable}
        weakest = min(t_ratios, key=lambda number: t_ratios[number], default=None)
        if weakest is None or t_ratios[weakest] > student_limit(int(estimate.student_dof[weakest])):
            break
        name = model.terms[weakest].name
        notes.append(f"{name} was dropped as insignificant (|t| = {t_ratios[weakest]:.2f}) and is taken as zero")
        model = model.without(name)
        estimate = estimator(measured, model)
    return model, estimate, notes


def _curve(response: FrequencyResponse, measured: Measured, model: DynamicModel, estimate: Estimate) -> FittedCurve:
    """Measured and fitted FRF in the measured form."""
    frequency = measured.omega / (2 * np.pi)
    factor = receptance_factor(response.form, frequency)[:, None, None]
    variance = None
    if measured.covariance is not None:
        diagonal = np.einsum("lii->li", measured.covariance).real.reshape(measured.matrix.shape)
        variance = diagonal * np.abs(factor) ** 2
    return FittedCurve(
        frequency,
        measured.matrix * factor,
        model.receptance(estimate.values, measured.omega) * factor,
        variance,
        tuple(port.label for port in measured.outputs),
        tuple(port.label for port in measured.inputs),
        response.form,
    )

"""Model modal: the modes of a band from any number of FRFs, found by p-LSCF and refined by maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.identify.budget import Source, mass_source, with_sources
from labpipe.identify.diagnostics import quality_findings
from labpipe.identify.measured import Measured, measured_part, select_ports
from labpipe.identify.reported import without_intervals
from labpipe.identify.settings import FitSettings
from labpipe.identify.statistics import determination
from labpipe.identify.weights import has_noise
from labpipe.modal.budget import modal_sources
from labpipe.modal.findings import mass_findings, mismatch, modal_findings, modal_notes, unexplained, width_findings
from labpipe.modal.growth import refine_with_terms
from labpipe.modal.likelihood import Refined
from labpipe.modal.lscf import NormalEquations, Poles, normal_equations
from labpipe.modal.missing import Completed, completed, kept_modes, with_real_modes
from labpipe.modal.residual_terms import Lines, ResidualTerms
from labpipe.modal.residual_test import LineNoise
from labpipe.modal.settings import LEAST_ORDER, ModalSettings
from labpipe.modal.shapes import shape_record
from labpipe.modal.stabilisation import Diagram, damping_ratio, nearest_modes, stabilisation
from labpipe.modal.values import DrivingPoint, frequency_correlation, modal_parameters, strongest_points
from labpipe.modal.whole_covariance import ModalEstimate, whole_covariance_fit
from labpipe.records.identification import Fit, FittedCurve, Goodness, Parameter
from labpipe.records.modes import StabilisationDiagram
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.bands import lines_in
from labpipe.spectra.convert import DERIVATIVES, receptance_factor

# Lines per order of the denominator below which a polynomial follows the noise.
LINES_PER_ORDER = 4


@dataclass(frozen=True)
class _Sides:
    """The FRFs with the smaller side, the references, as columns: as receptance, and in the measured form, whose noise is the more even.

    forces_move: the larger side are the forces (a roving hammer).
    """

    measured: Measured
    lines: Lines
    forces_move: bool

    @property
    def points(self) -> tuple[Port, ...]:
        return self.measured.outputs

    @property
    def references(self) -> tuple[Port, ...]:
        return self.measured.inputs

    @property
    def driving_points(self) -> tuple[DrivingPoint, ...]:
        """The points that are references as well."""
        dofs = [port.dof for port in self.references]
        return tuple(DrivingPoint(row, dofs.index(port.dof), port.dof) for row, port in enumerate(self.points) if port.dof in dofs)


def modal_fit(response: FrequencyResponse, settings: FitSettings) -> Fit:
    """The modes of the settings' band as one Fit.

    ConfigError where settings and response do not fit together, FitError where no mode is found or the lines are too few.
    """
    if not isinstance(settings.mass, float | str):
        raise ConfigError("a modal fit takes one mass", hint="for example mass: 0.92 kg", field="mass")
    modal: ModalSettings = settings.model_settings
    rows, columns = select_ports(response, settings.input, settings.output)
    band = settings.band or (float(response.frequency[0]), float(response.frequency[-1]))
    chosen = lines_in(response.frequency, band) & (response.frequency > 0)
    sides = _sides(measured_part(response, rows, columns, chosen), response.form)
    if modal.structure is not None:
        modal.structure.check([port.dof for port in sides.points])
    highest = _highest_order(sides.lines, modal)
    equations = normal_equations(sides.lines.omega, sides.lines.matrix, highest)
    edges = float(sides.lines.omega[0]), float(sides.lines.omega[-1])
    diagram = stabilisation(equations, edges, highest)
    start = _by_hand(equations, modal, edges, highest) if modal.poles else diagram.modes
    _check_start(start, sides.lines, highest)
    refined, terms = refine_with_terms(sides.lines, start.values, start.participation)
    refined, terms, dropped = kept_modes(sides.lines, refined, terms)
    # Lines that the band leaves out in its middle are no neighbours, which the correlation of a window would need.
    line_noise = LineNoise(response.line_correlation)
    whole = completed(sides.lines, refined, terms, line_noise, adding=not modal.poles)
    real = modal.shapes == "real"
    if real:
        whole = with_real_modes(sides.lines, whole, line_noise)
    terms = whole.terms
    estimate = whole_covariance_fit(sides.measured, terms, whole.refined, real=real)
    fit = _reported(settings, band, sides, whole, estimate)
    fit = with_sources(fit, _sources(settings, sides, terms, estimate))
    window_known = has_noise(sides.measured) or bool(response.line_correlation)
    narrow = width_findings(estimate.refined, sides.lines, window_known=window_known)
    fit = replace(fit, notes=(*fit.notes, *dropped), findings=(*fit.findings, *narrow))
    quality = quality_findings(response, rows, columns, chosen)
    modes = shape_record(estimate.refined, terms, sides.points, sides.references, sides.forces_move, _diagram_record(sides.lines, diagram))
    driving = tuple(place.dof for place in strongest_points(estimate.refined, sides.driving_points))
    modes = replace(modes, driving_points=driving, geometry=modal.structure)
    curve = _curve(response.form, sides, estimate)
    return replace(fit, findings=(*fit.findings, *quality), curve=curve, modes=modes)


def _sides(measured: Measured, form: str) -> _Sides:
    forces_move = len(measured.inputs) > len(measured.outputs)
    turned = _turned(measured) if forces_move else measured
    factor = receptance_factor(form, measured.omega / (2 * np.pi))
    matrix = turned.matrix * factor[:, None, None]
    return _Sides(turned, Lines(measured.omega, matrix, DERIVATIVES[form], _weight(turned, factor)), forces_move)


def _weight(measured: Measured, factor: ComplexArray) -> FloatArray:
    """Reciprocal noise along the lines (n_line,) in the measured form: of all elements together, each relative to its mean; else 1."""
    if not has_noise(measured):
        return np.ones(measured.omega.size)
    assert measured.covariance is not None
    variance = np.einsum("lii->li", measured.covariance).real * np.abs(factor[:, None]) ** 2
    return np.asarray(1 / np.sqrt(np.mean(variance / np.mean(variance, axis=0), axis=1)))


def _turned(measured: Measured) -> Measured:
    """Outputs and inputs exchanged: a linear structure answers alike (Maxwell and Betti)."""
    _, n_output, n_input = measured.matrix.shape
    order = np.arange(n_output * n_input).reshape(n_output, n_input).T.ravel()
    covariance = None if measured.covariance is None else measured.covariance[:, order][:, :, order]
    return replace(
        measured,
        matrix=measured.matrix.swapaxes(1, 2),
        errors=tuple(replace(error, change=error.change.swapaxes(1, 2)) for error in measured.errors),
        covariance=covariance,
        outputs=measured.inputs,
        inputs=measured.outputs,
    )


def _highest_order(lines: Lines, modal: ModalSettings) -> int:
    """The settings' order, less where the lines are few; FitError where they are too few for any choice."""
    highest = min(modal.order, lines.omega.size // LINES_PER_ORDER)
    if highest < LEAST_ORDER:
        raise FitError(
            f"{lines.omega.size} lines are too few for a stabilisation diagram",
            hint=f"widen the band to {LINES_PER_ORDER * LEAST_ORDER} lines or more",
        )
    return highest


def _by_hand(equations: NormalEquations, modal: ModalSettings, edges: tuple[float, float], highest: int) -> Poles:
    """The poles nearest to the named frequencies; ConfigError for one outside the band."""
    frequencies = 2 * np.pi * np.sort(np.array(modal.poles))
    outside = frequencies[(frequencies < edges[0]) | (frequencies > edges[1])]
    if outside.size:
        inside = f"{edges[0] / (2 * np.pi):g} to {edges[1] / (2 * np.pi):g} Hz"
        what = f"the pole {outside[0] / (2 * np.pi):g} Hz lies outside the band"
        raise ConfigError(what, hint=f"the lines go from {inside}", field="poles")
    return nearest_modes(equations, frequencies, highest)


def _check_start(start: Poles, lines: Lines, highest: int) -> None:
    if not start.values.size:
        raise FitError(
            f"no pole returns in a quarter of the orders up to {highest}: no mode stands out of the noise of this band",
            hint="choose another band, or name `poles` by hand",
        )
    if np.unique(start.values).size < start.values.size:
        raise FitError("two of the named poles are one and the same pole of the data", hint="name each mode once")
    if lines.omega.size < LINES_PER_ORDER * start.values.size:
        raise FitError(f"{lines.omega.size} lines cannot hold {start.values.size} modes", hint="widen the band")


def _parameters(settings: FitSettings, sides: _Sides, estimate: ModalEstimate, refined: Refined) -> tuple[Parameter, ...]:
    mass = settings.mass if isinstance(settings.mass, float) else None
    return modal_parameters(refined, estimate.dof, mass, sides.driving_points, mismatch(estimate))


def _sources(settings: FitSettings, sides: _Sides, terms: ResidualTerms, estimate: ModalEstimate) -> list[Source]:
    """What the sensors, sums of channels and a given mass make doubtful."""
    parameters = partial(_parameters, settings, sides, estimate)
    of_matrix = modal_sources(sides.measured, terms, estimate.refined, parameters, real=settings.model_settings.shapes == "real")
    return [*of_matrix, *mass_source(parameters(estimate.refined), settings)]


def _reported(settings: FitSettings, band: tuple[float, float], sides: _Sides, whole: Completed, estimate: ModalEstimate) -> Fit:
    """The Fit without shapes and curve."""
    refined, measured = estimate.refined, sides.measured
    matrix = frequency_correlation(refined)
    parameters = _parameters(settings, sides, estimate, refined)
    r2, adjusted = determination(measured.matrix, measured.matrix - estimate.fitted, measured.n_equation - estimate.dof)
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator="ml",
        band_hz=band,
        lines=measured.omega.size,
        equations=measured.n_equation,
        dof=estimate.dof,
        gof=Goodness(r2, adjusted, estimate.chi2_reduced, estimate.chi2_p),
        parameters=without_intervals(parameters) if unexplained(estimate, whole.p_noise) else parameters,
        condition_number=float(np.sqrt(np.linalg.cond(matrix))),
        correlation=matrix,
        converged=refined.converged,
        iterations=refined.steps,
        findings=(*modal_findings(estimate, whole.p_noise), *mass_findings(parameters)),
        notes=modal_notes(estimate, whole, len(sides.references), sides.forces_move),
    )


def _diagram_record(lines: Lines, diagram: Diagram) -> StabilisationDiagram:
    """The diagram in Hz, with the singular values of the FRFs on the lines."""
    poles = diagram.poles
    return StabilisationDiagram(
        np.abs(poles.values) / (2 * np.pi),
        damping_ratio(poles.values),
        poles.orders,
        diagram.group,
        indicator_frequency=lines.omega / (2 * np.pi),
        indicator=np.linalg.svd(lines.matrix, compute_uv=False),
    )


def _curve(form: str, sides: _Sides, estimate: ModalEstimate) -> FittedCurve:
    """Measured and fitted FRF in the measured form, with outputs as rows again."""
    measured = sides.measured
    frequency = measured.omega / (2 * np.pi)
    fitted, outputs, inputs = estimate.fitted, measured.outputs, measured.inputs
    factor = receptance_factor(form, frequency)[:, None, None]
    variance = None
    if measured.covariance is not None:
        variance = np.einsum("lii->li", measured.covariance).real.reshape(measured.matrix.shape) * np.abs(factor) ** 2
    shown, fitted = measured.matrix * factor, fitted * factor
    if sides.forces_move:
        shown, fitted, outputs, inputs = shown.swapaxes(1, 2), fitted.swapaxes(1, 2), inputs, outputs
        variance = None if variance is None else variance.swapaxes(1, 2)
    return FittedCurve(
        frequency,
        shown,
        fitted,
        variance=variance,
        outputs=tuple(port.label for port in outputs),
        inputs=tuple(port.label for port in inputs),
        form=form,
    )

"""Model modal: the modes of a band from any number of FRFs, found by p-LSCF and refined by maximum
likelihood.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import chance_text
from labpipe.errors import FitError, SettingError
from labpipe.estimation import diagnostics
from labpipe.estimation.budget import Source, mass_source, with_sources
from labpipe.estimation.measured import (
    SHARE,
    Measured,
    changes_by,
    matrix_errors,
    measured_part,
    select_ports,
)
from labpipe.estimation.model_error import ModelError
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.regression import inverse_of
from labpipe.estimation.settings import VISCOUS, FitSettings
from labpipe.estimation.statistics import determination
from labpipe.estimation.weights import NOISE_FREE, has_noise, whitener
from labpipe.methods.modal import model_error, poles as lscf
from labpipe.methods.modal.likelihood import FrfLines, Refined, ResidualTerms, refine, refine_one_step
from labpipe.methods.modal.moved import (
    FEWEST_POINTS,
    Moved,
    MovedMode,
    MovedReferences,
    add_moved_modes,
    align_measured,
    align_references,
    alignment,
)
from labpipe.methods.modal.settings import LEAST_ORDER, ModalSettings
from labpipe.methods.modal.whole_covariance import (
    ModalEstimate,
    ModalReceptance,
    ModalRows,
    covariance_fit,
    regular,
)
from labpipe.records.finding import NORMAL, Finding, Parameter, note
from labpipe.records.fit_details import Modes, StabilisationDiagram
from labpipe.records.identification import Fit, FittedCurve, Goodness
from labpipe.records.response import BlockCovariance, FrequencyResponse, shown_ports
from labpipe.spectra.bands import lines_in
from labpipe.spectra.convert import DERIVATIVES, receptance_factor


def _sources(
    settings: FitSettings, sides: _Sides, terms: ResidualTerms, estimate: ModalEstimate
) -> list[Source]:
    """By one step of Gauss-Newton from the estimate, p - (J^T J)^-1 J^T W dH, no fit is repeated; with the
    shapes eliminated where the fit has the weights of its residual. Directions count where two points or more
    of known direction tell the motion in their plane, likewise two forces.
    """
    refined, measured, lines = estimate.refined, sides.measured, sides.lines
    of_mass = mass_source(_parameters(settings, sides, estimate, refined), settings)
    errors = matrix_errors(measured, directions=True)
    real = settings.model_settings.shapes == "real"

    def values_of(again: Refined) -> FloatArray:
        return np.array([parameter.value for parameter in _parameters(settings, sides, estimate, again)])

    def eliminate(change: ComplexArray) -> FloatArray:
        moved = replace(lines, matrix=lines.matrix + (lines.s**lines.power)[:, None, None] * change)
        return values_of(refine_one_step(replace(terms, lines=moved), refined, real=real))

    if not errors or estimate.chi2_reduced is None:
        return [*changes_by(errors, eliminate), *of_mass]
    model = ModalReceptance.of(terms, refined, measured, real=real)
    values = model.join(refined, measured)
    problem = OutputError(measured, model, whitener(regular(measured)))
    rows = ModalRows(problem, values)
    projected = rows.project(np.array([error.change for error in errors]))
    steps = SHARE * (inverse_of(rows.linearise()) @ projected)

    def at(step: FloatArray) -> FloatArray:
        poles, participation, shapes, _ = model.split(values - step)
        return values_of(replace(refined, poles=poles, participation=participation, shapes=shapes))

    changes = [(at(step) - at(-step)) / (2 * SHARE) for step in steps.T]
    return [*zip((error.uncertainty for error in errors), changes, strict=True), *of_mass]


def mismatch(estimate: ModalEstimate) -> float | None:
    """sqrt(chi-square per degree of freedom) where it is significantly above 1, else None."""
    return diagnostics.excess(estimate.chi2_reduced, estimate.chi2_p)


def is_unexplained(estimate: ModalEstimate, p_noise: float) -> bool:
    """Whether the residual is not noise where the noise is not known."""
    return estimate.chi2_reduced is None and p_noise < diagnostics.MISMATCH_P


def modal_findings(
    estimate: ModalEstimate, p_noise: float, errors: Mapping[int, ModelError]
) -> tuple[Finding, ...]:
    """Warnings: no convergence, negative damping, a residual beyond the measured noise or alike on
    neighbouring lines.
    """
    warnings = []
    if not estimate.refined.converged:
        steps = f"the refinement of the modes did not converge in {estimate.refined.steps} steps"
        warnings.append(Finding("no-convergence", f"{steps}; its numbers are not a result"))
    unstable = estimate.refined.poles[estimate.refined.poles.real >= 0]
    if unstable.size:
        where = ", ".join(f"{abs(pole) / (2 * np.pi):.4g} Hz" for pole in unstable)
        mode = f"the mode at {where} has a negative damping ratio"
        warnings.append(Finding("unphysical", f"{mode}: it is noise, or energy enters the structure"))
    factor, what = mismatch(estimate), ""
    if factor is not None:
        what = diagnostics.excess_text(estimate.chi2_reduced, estimate.chi2_p)
    elif is_unexplained(estimate, p_noise):
        what = f"the residual is not noise: it is alike on neighbouring lines ({chance_text(p_noise)})"
    elif errors:
        modes = ", ".join(str(number) for number in errors)
        what = f"the FRFs, filtered for mode {modes} alone, show more than one mode and noise"
    if what:
        reasons = [f"mode {number}: {error.likely}" for number, error in errors.items()]
        likely = f"Most likely {'; '.join(reasons)}. " if reasons else ""
        message = (
            f"{what}. {likely}Values and intervals of each mode include what the model leaves unexplained "
            "in its band. Name a missing mode in `poles`, or narrow the band"
        )
        warnings.append(Finding("model-mismatch", message))
    return tuple(warnings)


def moved_pole_findings(named: Sequence[float], fit: Fit, modes: Modes) -> tuple[Finding, ...]:
    """A note of poles *named* by hand [Hz] that are modes elsewhere: farther than a half-power width, the
    interval of f_n, and the share by which named frequencies differ that are two modes.
    """
    frequency = modes.frequency
    places = linear_sum_assignment(np.abs(np.log(frequency[:, None] / np.array(named))))[1]
    moved = []
    for n, (place, f_n, ratio) in enumerate(zip(places, frequency, modes.damping_ratio, strict=True), 1):
        reach = NORMAL * (fit.parameter(f"f_n_{n}").full_error or 0.0)
        if abs(f_n - named[place]) > max(reach, 2 * ratio * f_n, lscf.APART * f_n):
            moved.append(f"the pole named at {named[place]:g} Hz is the mode at {f_n:.4g} Hz")
    hint = "No mode stands out where it was named; the diagram in the report shows the poles that return"
    return (note("moved-pole", f"{'; '.join(moved)}. {hint}"),) if moved else ()


def mass_findings(parameters: Sequence[Parameter]) -> tuple[Finding, ...]:
    """A warning of modal masses that are negative by more than their uncertainty: no structure has one."""
    modes = [p.name.removeprefix("m_") for p in parameters if p.name.startswith("m_") and p.is_negative]
    if not modes:
        return ()
    named = f"mode {modes[0]} has" if len(modes) == 1 else f"modes {', '.join(modes)} have"
    message = (
        f"{named} a negative mass at the driving point: force and response are not at one place and in one "
        "direction, a sign is wrong, or the pole stands for a part of its neighbours"
    )
    return (Finding("unphysical", message),)


def modal_notes(
    estimate: ModalEstimate, whole: lscf.Completed, n_reference: int, forces_move: bool
) -> tuple[str, ...]:
    """What a reader must know: where the noise comes from, residual terms, a single reference, moved
    forces.
    """
    terms = whole.terms
    residual = f"{terms.lower} for modes below the band, {terms.upper} for modes above it"
    without_test = (
        "the size of the noise comes from the residual of every FRF, its course along the lines from a "
        "measured covariance (without one it is the same at all lines); the chi-square test of the model is "
        "not possible"
    )
    chosen = "by AIC" if terms.lines.adds_terms else "as `residuals` asks"
    added = f"{whole.added} mode(s) were added that the diagram did not show"
    beside = " and ".join(f"the mode at {abs(pole) / (2 * np.pi):.4g} Hz" for pole in terms.lines.beside)
    notes = (
        (True, f"residual terms of every FRF: {residual}, {chosen}"),
        (estimate.unused, f"the measured covariance is not used: {estimate.unused}"),
        (estimate.chi2_reduced is None, without_test),
        (beside, f"{beside}, beyond the band: residual terms of their own, since a flank reaches into it"),
        (whole.added, f"{added}, since the residual was not noise, or terms stood for them"),
        (n_reference == 1, SINGLE),
        (forces_move, TURNED),
    )
    return tuple(f"modal: {note}." for holds, note in notes if holds)


SINGLE = "with one reference a mode with a node there is not seen, and modes of the same frequency are one"
TURNED = "the forces are the points of the shapes, the responses the references (reciprocity is assumed)"
# Share of the band by which lines on either side are looked at as well.
BEYOND = 0.15
RECEPTANCE = "receptance"
# Lines per order of the denominator below which a polynomial follows the noise.
LINES_PER_ORDER = 4


@dataclass(frozen=True)
class _Sides:
    """The FRFs with the smaller side, the references, as columns: as receptance, and in the measured form,
    whose noise is the more even.

    forces_move: the larger side are the forces (a roving hammer). by_force: the inputs are forces, which
    modal masses need.
    """

    measured: Measured
    lines: FrfLines
    forces_move: bool
    by_force: bool

    @property
    def driving_points(self) -> tuple[model_error.DrivingPoint, ...]:
        dofs = [port.dof for port in self.measured.inputs] if self.by_force else []
        return tuple(
            model_error.DrivingPoint(row, dofs.index(port.dof), port.dof)
            for row, port in enumerate(self.measured.outputs)
            if port.dof in dofs
        )


def modal_fit(response: FrequencyResponse, settings: FitSettings) -> Fit:
    """The modes of the settings' band as one Fit. ConfigError where settings and response do not fit
    together, FitError where no mode is found or the lines are too few.
    """
    if not settings.mass or not isinstance(settings.mass, float | str):
        raise SettingError("mass", "a modal fit takes one mass, above zero", "for example mass: 0.92 kg")
    modal: ModalSettings = settings.model_settings
    form = response.form
    # Poles and shapes need no unit of force; what powers of s the form holds are residual terms, as is what
    # blocks of hits cut off.
    blocks = None if response.blocks and response.blocks.after_hit else response.blocks
    response = replace(response, form=form if form in DERIVATIVES else RECEPTANCE, blocks=blocks)
    rows, columns = select_ports(response, settings.input, settings.output)
    band = settings.band or (float(response.frequency[0]), float(response.frequency[-1]))
    chosen = lines_in(response.frequency, band) & (response.frequency > 0)
    sides = _sides(
        measured_part(response, rows, columns, chosen),
        response.form,
        hysteretic=_is_hysteretic(settings, modal),
        by_force=form in DERIVATIVES,
        adds_terms=not settings.residuals,
    )
    points, references = sides.measured.outputs, sides.measured.inputs
    if modal.moving_mass is not None and len(points) <= FEWEST_POINTS:
        what = f"of {len(points)} point(s) 'moving_mass' cannot tell the structure without it"
        raise SettingError("moving_mass", what, f"measure more than {FEWEST_POINTS}")
    if modal.structure is not None:
        modal.structure.check([port.dof for port in points])
    diagram, start = _first_modes(sides.lines, modal)
    refined, terms = lscf.refine_with_terms(sides.lines, start.values, start.participation)
    refined, terms, dropped = lscf.kept_modes(refined, terms)
    whole = lscf.complete(refined, terms, adding=not modal.poles)
    sides, whole, moved, loaded = _move_to_mean_poles(sides, whole, modal)
    if real := modal.shapes == "real":
        refined = refine(whole.terms, whole.refined.poles, whole.refined.participation, real=True)
        whole = replace(whole, refined=refined)
    terms = whole.terms
    estimate = covariance_fit(sides.measured, terms, whole.refined, real=real)
    beyond = align_measured(_beyond(response, rows, columns, band, sides, estimate.refined), moved)
    fit = _report(settings, band, sides, whole, estimate, beyond, moved)
    fit = with_sources(fit, _sources(settings, sides, terms, estimate))
    if not (has_noise(sides.measured) or sides.lines.correlation):
        fit = _with_window(fit, estimate.refined, sides.lines)
    polynomials = _polynomial_findings(sides.measured, estimate.refined)
    if "order" in modal.written and diagram.counted[0] < modal.order[1]:
        dropped = (*dropped, f"modal: orders up to {diagram.counted[0]}, a quarter of the lines.")
    beside = (*loaded, *diagnostics.quality_findings(response, rows, columns, chosen), *polynomials)
    fit = replace(fit, notes=(*fit.notes, *dropped), findings=(*fit.findings, *beside))
    refined = estimate.refined
    returns = diagram.returns(refined.poles, refined.participation)
    record = _diagram_record(sides.lines, diagram)
    modes = replace(
        model_error.shape_record(
            refined, terms, points, references, sides.forces_move, record, returns, sides.driving_points
        ),
        geometry=modal.structure,
    )
    if modal.poles and not modal.ratios:
        fit = replace(fit, findings=(*fit.findings, *moved_pole_findings(modal.poles, fit, modes)))
    return replace(fit, curve=_curve(response.form, form, sides, estimate, moved), details=(modes,))


def _diagram_record(lines: FrfLines, diagram: lscf.Diagram) -> StabilisationDiagram:
    poles = diagram.poles
    return StabilisationDiagram(
        np.abs(poles.values) / (2 * np.pi),
        lscf.damping_ratio(poles.values),
        poles.orders,
        diagram.group,
        indicator_frequency=lines.omega / (2 * np.pi),
        indicator=np.linalg.svd(lines.matrix, compute_uv=False),
    )


def _move_to_mean_poles(
    sides: _Sides, whole: lscf.Completed, modal: ModalSettings
) -> tuple[_Sides, lscf.Completed, Moved, tuple[Finding, ...]]:
    if modal.poles:
        return sides, whole, (), ()
    names = [port.label for port in sides.measured.inputs]
    whole, apart, said = align_references(whole, names, lambda lines: _first_modes(lines, modal)[1])
    whole, modes, findings = add_moved_modes(whole, moving=modal.moving_mass is not None)
    moved: Moved = (*apart, *modes)
    measured = align_measured(sides.measured, moved)
    return replace(sides, lines=whole.terms.lines, measured=measured), whole, moved, (*said, *findings)


def _is_hysteretic(settings: FitSettings, modal: ModalSettings) -> bool:
    if settings.damping == VISCOUS:
        return False
    for written, is_set in (
        ("shapes: real", modal.shapes == "real"),
        ("moving_mass", modal.moving_mass is not None),
    ):
        if is_set:
            key = written.split(":")[0]
            what = f"'{written}' cannot be combined with {settings.damping} damping"
            raise SettingError(key, what, f"leave one of `{key}` and `damping` out")
    return True


def _sides(measured: Measured, form: str, *, hysteretic: bool, by_force: bool, adds_terms: bool) -> _Sides:
    forces_move = len(measured.inputs) > len(measured.outputs)
    turned = _turn(measured) if forces_move else measured
    factor = receptance_factor(form, measured.omega / (2 * np.pi))
    matrix = turned.matrix * factor[:, None, None]
    weight = _weight(turned, factor)
    shared, power = measured.shared_noise, DERIVATIVES[form]
    lines = FrfLines(measured.omega, matrix, power, weight, hysteretic, measured.leakage, shared, adds_terms)
    if measured.line_noise is not None:
        lines = replace(lines, correlation=tuple(measured.line_noise.correlation.tolist()))
    return _Sides(turned, lines, forces_move, by_force)


def _beyond(
    response: FrequencyResponse,
    rows: list[int],
    columns: list[int],
    band: tuple[float, float],
    sides: _Sides,
    refined: Refined,
) -> Measured:
    """The lines around the band that a mode must survive: BEYOND of it, or the largest half-power width that
    it does not hold three times.
    """
    whole = band[1] - band[0]
    widths = np.clip(-2 * refined.poles.real / (2 * np.pi), 0.0, whole)
    more = max(BEYOND * whole, 2 * float(np.max(widths[3 * widths > whole], initial=0.0)))
    lines = lines_in(response.frequency, (band[0] - more, band[1] + more)) & (response.frequency > 0)
    measured = measured_part(response, rows, columns, lines)
    return _turn(measured) if sides.forces_move else measured


def _weight(measured: Measured, factor: ComplexArray) -> FloatArray:
    """Reciprocal noise along the lines (n_line,), that of each element relative to its mean."""
    if not has_noise(measured):
        return np.ones(measured.omega.size)
    assert measured.variance is not None
    variance = measured.variance * np.abs(factor[:, None]) ** 2
    return 1 / np.sqrt(np.mean(variance / np.mean(variance, axis=0), axis=1))


def _turn(measured: Measured) -> Measured:
    """Outputs and inputs exchanged (Maxwell and Betti)."""
    _, n_output, n_input = measured.matrix.shape
    order = np.arange(n_output * n_input).reshape(n_output, n_input).T.ravel()
    covariance = measured.stored_covariance
    if isinstance(covariance, BlockCovariance):
        covariance = covariance.choose(np.ones(measured.omega.size, bool), order.tolist())
    elif measured.covariance is not None:
        covariance = measured.covariance[:, order][:, :, order]
    return replace(
        measured,
        matrix=measured.matrix.swapaxes(1, 2),
        errors=tuple(error.turn(lambda part: part.swapaxes(1, 2)) for error in measured.errors),
        covariance=covariance,
        outputs=measured.inputs,
        inputs=measured.outputs,
    )


def _first_modes(lines: FrfLines, modal: ModalSettings) -> tuple[lscf.Diagram, lscf.Poles]:
    """Where the noise of single lines hides every mode, the means of 2, 4, ... neighbouring ones are looked
    at.
    """
    edges = float(lines.omega[0]), float(lines.omega[-1])
    omega, matrix, highest = lines.omega, lines.matrix, _highest_order(lines.omega.size, modal)
    looks: list[tuple[lscf.Diagram, lscf.Poles]] = []
    while omega.size >= LINES_PER_ORDER * max(LEAST_ORDER, modal.order[0]):
        order = _highest_order(omega.size, modal)
        equations = lscf.normal_equations(omega, matrix, order)
        diagram = lscf.stabilisation(equations, edges, order, modal.order[0])
        looks.append(
            (diagram, _poles_by_hand(equations, modal, edges, order) if modal.poles else diagram.modes)
        )
        if diagram.modes.values.size:
            break
        half = omega.size // 2
        omega, matrix = (
            np.mean(values[: 2 * half].reshape(half, 2, *values.shape[1:]), axis=1)
            for values in (omega, matrix)
        )
    diagram, start = looks[-1] if looks[-1][0].modes.values.size else looks[0]
    if not start.values.size:
        what, hint = f"no order up to {highest} has a pole", "choose another band"
        if not modal.poles:
            what = f"no pole returns in a quarter of the orders up to {highest}"
            hint = f"{hint}, name `poles` by hand, or look whether force and response are swapped"
        raise FitError(f"{what}: no mode stands out of the noise of this band", hint=hint)
    start = start.at(np.sort(np.unique(start.values, return_index=True)[1]))
    if start.values.size < len(modal.poles):
        what = "two of the named poles are one and the same pole of the data"
        raise FitError(what, hint="name each mode once")
    if lines.omega.size < LINES_PER_ORDER * start.values.size:
        what = f"{lines.omega.size} lines cannot hold {start.values.size} modes"
        raise FitError(what, hint="widen the band")
    return diagram, start


def _highest_order(n_line: int, modal: ModalSettings) -> int:
    highest = min(modal.order[1], n_line // LINES_PER_ORDER)
    if highest < LEAST_ORDER:
        what = f"{n_line} lines are too few for a stabilisation diagram"
        raise FitError(what, "", f"widen the band to {LINES_PER_ORDER * LEAST_ORDER} lines or more")
    if highest < modal.order[0]:
        what = f"the lowest 'order' is {modal.order[0]}, and {n_line} lines take one up to {highest}"
        raise SettingError("order", what, "lower it, or widen the band")
    return highest


def _poles_by_hand(
    equations: lscf.DenominatorEquations, modal: ModalSettings, edges: tuple[float, float], highest: int
) -> lscf.Poles:
    low, high = (edge / (2 * np.pi) for edge in edges)
    for pole in sorted(modal.poles):
        if not low <= pole <= high:
            what = f"the pole {pole:g} Hz lies outside the band"
            raise SettingError("poles", what, f"the lines go from {low:g} to {high:g} Hz")
    order = np.argsort(modal.poles)
    omega = 2 * np.pi * np.array(modal.poles)[order]
    nearest = lscf.nearest_modes(equations, omega, highest)
    if not modal.ratios:
        return nearest
    ratios = np.array(modal.ratios)[order]
    return replace(nearest, values=omega * (-ratios + 1j * np.sqrt(1 - ratios**2)))


def _parameters(
    settings: FitSettings, sides: _Sides, estimate: ModalEstimate, refined: Refined
) -> tuple[Parameter, ...]:
    mass = settings.mass if isinstance(settings.mass, float) else None
    return model_error.modal_parameters(refined, estimate.dof, mass, sides.driving_points, mismatch(estimate))


def _report(
    settings: FitSettings,
    band: tuple[float, float],
    sides: _Sides,
    whole: lscf.Completed,
    estimate: ModalEstimate,
    beyond: Measured,
    moved: Moved,
) -> Fit:
    refined, measured = estimate.refined, sides.measured
    matrix = model_error.frequency_correlation(refined)
    parameters = _parameters(settings, sides, estimate, refined)
    # What rounding leaves looks like no noise.
    left = float(np.linalg.norm(measured.matrix - estimate.fitted))
    exact = left <= NOISE_FREE * float(np.linalg.norm(measured.matrix))
    p_noise = 1.0 if exact else whole.p_noise
    misfit = refined.converged and (mismatch(estimate) is not None or is_unexplained(estimate, p_noise))
    errors: dict[int, ModelError] = {}
    apart = [mode for mode in moved if isinstance(mode, MovedReferences)]
    both = [mode for mode in moved if isinstance(mode, MovedMode)]
    modes, instead = ([mode for mode in both if bool(mode.instead) is is_one] for is_one in (False, True))
    moving = settings.model_settings.moving_mass is not None
    shown = misfit or bool(modes) or moving
    # The mass that moves is taken off the points alone.
    judged = refined.converged and (settings.judged or moving)
    if judged and (shown or (estimate.chi2_reduced is None and not exact and p_noise > 0)):
        errors = model_error.model_errors(
            measured,
            beyond,
            estimate,
            parameters,
            misfit,
            modes,
            moving=moving,
            driving=model_error.strongest_points(refined, sides.driving_points),
        )
    loaded = model_error.loaded_findings(refined.poles.size, errors) if moving and refined.converged else ()
    # Points that differ are not a fault of the modes.
    named = errors if misfit or not shown else {}
    if judged and (misfit or errors):
        parameters = model_error.with_model_errors(
            parameters, errors, estimate, measured.omega / (2 * np.pi), instead
        )
    for references in apart:
        parameters = references.hold(parameters)
    n_parameter = measured.n_equation - estimate.dof
    r2, adjusted = determination(measured.matrix, measured.matrix - estimate.fitted, n_parameter)
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator="ml",
        band_hz=band,
        lines=measured.omega.size,
        equations=measured.n_equation,
        dof=estimate.dof,
        gof=Goodness(r2, adjusted, estimate.chi2_reduced, estimate.chi2_p),
        parameters=parameters,
        condition_number=float(np.sqrt(np.linalg.cond(matrix))),
        correlation=matrix,
        converged=refined.converged,
        iterations=refined.steps,
        findings=(*modal_findings(estimate, p_noise, named), *loaded, *mass_findings(parameters)),
        notes=modal_notes(estimate, whole, len(measured.inputs), sides.forces_move),
    )


def _curve(form: str, named: str, sides: _Sides, estimate: ModalEstimate, moved: Moved) -> FittedCurve:
    measured = sides.measured
    frequency = measured.omega / (2 * np.pi)
    away = alignment(measured.omega, measured.leakage, moved)
    outputs, inputs = measured.outputs, measured.inputs
    factor = receptance_factor(form, frequency)[:, None, None]
    parts: list[Any] = [(matrix - away) * factor for matrix in (measured.matrix, estimate.fitted)]
    if measured.variance is not None:
        parts.append(measured.variance.reshape(measured.matrix.shape) * np.abs(factor) ** 2)
    if sides.forces_move:
        parts, outputs, inputs = [part.swapaxes(1, 2) for part in parts], inputs, outputs
    if (ports := shown_ports(*parts[0].shape)) is not None:
        rows, columns = ports
        parts = [part[:, rows][:, :, columns] for part in parts]
        outputs, inputs = tuple(outputs[row] for row in rows), tuple(inputs[column] for column in columns)
    shown, fitted, *variance = parts
    return FittedCurve(
        frequency,
        shown,
        fitted,
        variance=variance[0] if variance else None,
        outputs=tuple(port.label for port in outputs),
        inputs=tuple(port.label for port in inputs),
        form=named,
    )


def _polynomial_findings(measured: Measured, refined: Refined) -> list[Finding]:
    if measured.blocks is None or not measured.blocks.degree:
        return []
    pole = refined.poles[np.argmax(refined.poles.real)]
    frequency, width = (np.array([abs(pole), -2 * pole.real]) / (2 * np.pi)).tolist()
    return diagnostics.short_block_findings(measured, frequency, width, True)


# Lines in the half-power width below which a window is as wide as the mode.
LEAST_LINES = 2.0
# Half-power width of a Hann window [lines], and what is said of a damping that it may have made.
HANN_WIDTH = 1.44
WINDOW = "hardly wider than a line: a window of the analyser may make the damping larger"


def _with_window(fit: Fit, refined: Refined, lines: FrfLines) -> Fit:
    """The fit whose dampings of modes hardly wider than a line may be those of a window of the analyser, down
    to what that of Hann leaves: of a width W of a peak about (W^2 - 1.44^2) / W [lines] (Harris, Proc. IEEE
    66 (1978) 51; of convolved Lorentz and Gauss curves, Olivero and Longbothum 1977). Residues, and so
    masses, are areas, which a window leaves; c = 2 zeta w_n m follows zeta. A warning names the modes.
    """
    widths = (-2 * refined.poles.real / lines.spacing)[model_error.ascending(refined)]
    narrow = {number: float(width) for number, width in enumerate(widths, 1) if width < LEAST_LINES}
    if not narrow:
        return fit
    places = ", ".join(f"{fit.parameter(f'f_n_{n}').value:.6g} Hz ({w:.2g})" for n, w in narrow.items())
    message = (
        f"half-power widths of {LEAST_LINES:g} lines or less: {places}. The window of the analyser, and how "
        "much leaked, decide such a peak: its damping, and whether a second mode seems to stand beside it. "
        "The interval of the damping holds what a Hann window may add to it. Measure with finer lines (a "
        "longer `block`), or say `window:` in the entry of an FRF file under frfs:"
    )
    left = {
        f"{name}_{number}": max(1 - (HANN_WIDTH / width) ** 2, 0.0)
        for number, width in narrow.items()
        for name in ("zeta", "eta", "c")
    }
    parameters = tuple(
        replace(parameter, ci95=(left[parameter.name] * parameter.ci95[0], parameter.ci95[1]), reason=WINDOW)
        if parameter.name in left and parameter.ci95 is not None and parameter.ci95[0] > 0
        else parameter
        for parameter in fit.parameters
    )
    return replace(fit, parameters=parameters, findings=(*fit.findings, Finding("leakage", message)))

"""The uncertainty budget of a fit of a linear model: systematic errors of sensors, mass and directions, and
repeats.

An estimate is the root of a score s(p, q) = 0 in its parameters p; q are numbers that were given. By implicit
differentiation dp/dq = -(ds/dp)^-1 ds/dq, one more step of the estimator from its result on data changed by
dq, with the weights as they were: no fit is repeated. (GUM, JCGM 100:2008, 5.1; Gauss-Newton's form of
ds/dp.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import amount_text
from labpipe.distributions import coverage_factor, factor_at_coverage
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.derived import DIVIDED, BandModel, reported_parameters, with_systematic
from labpipe.estimation.estimators import Step
from labpipe.estimation.leakage import expected_model
from labpipe.estimation.measured import SHARE, Measured, across_ports, turn
from labpipe.estimation.model import DynamicModel, Setup
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.regression import equation_solution, instrument_step, regression, solve_scaled
from labpipe.estimation.settings import FitSettings, Support
from labpipe.estimation.statistics import Estimate, Stated, pulls_of
from labpipe.estimation.weights import Weights, fit_weights, has_noise, weight_uncertainty
from labpipe.records import uncertain
from labpipe.records.finding import Contribution, Finding, IntervalParts, Parameter
from labpipe.records.identification import Fit
from labpipe.records.response import Port
from labpipe.records.settings import ESTIMATE

# Standard errors from a minimum below which an estimate is the minimum.
AT_MINIMUM = 1e-3
# From a setup with changed numbers to its model.
ModelOf = Callable[[Setup], BandModel]
# A source, and the change (n_parameter,) of reported parameters by one standard uncertainty of it.
Source = tuple[uncertain.Uncertainty, FloatArray]
# From a setup, its model and data to the reported parameters of a whole fit.
Refit = Callable[[Setup, BandModel, Measured], tuple[Parameter, ...]]


@dataclass(frozen=True)
class Case:
    """A fit as it was made: ports and settings, measured data, model and estimate. *model_of* makes the model
    anew from other numbers.
    """

    setup: Setup
    measured: Measured
    model: BandModel
    estimate: Estimate
    model_of: ModelOf


def budget_of(case: Case, parameters: Sequence[Parameter]) -> uncertain.Budget | None:
    """The budget of reported *parameters*; None where no number has an uncertainty, or without convergence.
    Equation (unc-implicit).
    """
    sources = sources_of(case.setup, case.measured)
    if not sources or not case.estimate.converged:
        return None
    step, names = _step_of(case), tuple(parameter.name for parameter in parameters)

    def values(changed: Case) -> FloatArray:
        model = _model_of(case, changed)
        estimate = replace(case.estimate, values=step(model, changed.measured))
        reported = {p.name: p.value for p in reported_parameters(estimate, model, changed.setup)}
        if missing := [name for name in names if name not in reported]:
            what = f"within the stated uncertainties {missing[0]} can have no value"
            hint = "a stiffness or mass about zero has no frequency: another model or band"
            raise FitError(what, hint=hint)
        return np.array([reported[name] for name in names])

    changes = _slopes(case, sources, values)
    kept = np.flatnonzero(np.any(changes != 0, axis=1))
    if not kept.size:
        return None
    dof = float(np.min(case.estimate.student_dof))
    kept_sources = tuple(sources[n][0] for n in kept)
    return uncertain.Budget(names, full_errors(parameters), dof, kept_sources, changes[kept])


def full_errors(parameters: Sequence[Parameter]) -> FloatArray:
    """Their full standard errors (n_parameter,) [parameter units], NaN where there is none."""
    return np.array([parameter.full_error for parameter in parameters], np.float64)


def _model_of(case: Case, changed: Case) -> BandModel:
    return case.model if changed.setup is case.setup else case.model_of(changed.setup)


def _slopes(
    case: Case, sources: Sequence[tuple[uncertain.Uncertainty, Change]], values: Callable[[Case], FloatArray]
) -> FloatArray:
    sizes = [SHARE * uncertainty.std_error for uncertainty, _ in sources]
    pairs = zip(sizes, sources, strict=True)
    ends = [(values(change(case, size)), values(change(case, -size))) for size, (_, change) in pairs]
    return np.array([(above - below) / (2 * SHARE) for above, below in ends])


# Change of chi-square below which stated numbers stay where they are, and most steps on the way.
NEGLIGIBLE, MOST_ROUNDS = 1e-2, 8


def most_likely(case: Case) -> tuple[Case, tuple[uncertain.Uncertainty, ...], Stated]:
    """The fit with stated numbers where data and statements together have them, the sources, and what these
    still change of its residual.

    Gauss-Newton of |r|^2 / s + |t|^2 over the changes t of the numbers, which far above the noise is not
    linear: steps that do not lower it are halved. Of unknown noise as it was made. FitError as
    `solve_scaled`.
    """
    sources, is_noisy = sources_of(case.setup, case.measured), has_noise(case.measured)
    noise = weight_uncertainty(case.measured, case.estimate.dof).inflation if is_noisy else 1.0
    weights, uncertainties = fit_weights(case.measured), tuple(uncertainty for uncertainty, _ in sources)
    moved, at, before, by_noise = case, np.zeros(len(sources)), np.inf, _shared_noise(case.measured, sources)
    likely = case, uncertainties, Stated.of(np.zeros((0, case.measured.n_equation)))
    followed = np.zeros(case.estimate.values.size)
    for number in range(MOST_ROUNDS if sources else 0):
        problem = OutputError(moved.measured, expected_model(moved.measured, moved.model), weights)
        values = moved.estimate.values
        residual, jacobian = problem.residual(values), problem.jacobian(values)
        inverse = solve_scaled(jacobian, residual)[1]
        along = inverse @ (jacobian.T @ residual)
        # What an estimate other than ml is away from the minimum stays.
        followed = along if number == 0 else followed
        across = residual - jacobian @ along
        squares = float(across @ across + noise * at @ at)
        if squares < before:
            before, origin, base = squares, at, values - along + followed
            stated = Stated(_residual_changes(moved, sources, weights), at, by_noise)
            likely = moved, uncertainties, stated
            move = pulls_of(across, stated, jacobian, inverse, noise).likely - at
            change = move @ stated.changes
            step = inverse @ (jacobian.T @ change)
            left = change - jacobian @ step
            if not is_noisy or left @ left < NEGLIGIBLE:
                break
        elif squares < before + NEGLIGIBLE:
            break
        else:
            # Beyond where the numbers act linearly.
            move, step = move / 2, step / 2
        at = origin + move
        moved = _move(case, sources, at, base - step)
    return likely


def _move(
    case: Case, sources: Sequence[tuple[uncertain.Uncertainty, Change]], at: FloatArray, values: FloatArray
) -> Case:
    moved = case
    for (uncertainty, change), amount in zip(sources, at, strict=True):
        moved = change(moved, amount * uncertainty.std_error)
    model = _model_of(case, moved)
    return replace(moved, model=model, estimate=replace(case.estimate, values=values))


def _shared_noise(measured: Measured, sources: Sequence[tuple[uncertain.Uncertainty, Change]]) -> FloatArray:
    """Of each source what noise in its change of the matrix may make of the product with the residual
    (n_source,) [1]: a complex number of the residual has the square 2.
    """
    whole = measured.plus_offset(measured.matrix)
    sizes: dict[str, float] = {}
    for error in measured.errors:
        relative = np.abs(error.change) / np.where(whole == 0, np.inf, np.abs(whole))
        name, size = error.uncertainty.source, 2 * float(np.sum(relative))
        # What differs between repeats is in the residual.
        sizes[name] = sizes.get(name, 0.0) + (0.0 if error.by_repeat else size)
    return np.array([sizes.get(uncertainty.source, 0.0) for uncertainty, _ in sources])


def _residual_changes(
    case: Case, sources: Sequence[tuple[uncertain.Uncertainty, Change]], weights: Weights
) -> FloatArray:
    """Changes of the whitened residual (n_source, n_equation) [1] by one standard uncertainty of each source.
    A gain acts on the fitted response: with the measured one the residual's own noise would be an error.
    """
    values = case.estimate.values
    fitted = expected_model(case.measured, case.model).receptance(values, case.measured.omega)
    case = replace(case, measured=replace(case.measured, matrix=fitted))

    def residual(changed: Case) -> FloatArray:
        model = expected_model(changed.measured, _model_of(case, changed))
        return OutputError(changed.measured, model, weights).residual(values)

    return _slopes(case, sources, residual)


def mass_source(parameters: Sequence[Parameter], settings: FitSettings) -> list[Source]:
    """The given mass as a source of stiffness and damping in proportion to it; none without uncertainty."""
    mass = mass_uncertainty(settings)
    if mass is None or not settings.mass:
        return []
    relative = mass.std_error / dict(settings.uncertainties)["mass"].value
    times_mass = [p.value if p.unit in DIVIDED else 0.0 for p in parameters]
    return [(mass, relative * np.array(times_mass))]


def mass_uncertainty(settings: FitSettings) -> uncertain.Uncertainty | None:
    """The uncertainty of a given mass; None where it has none, or is estimated."""
    number = dict(settings.uncertainties).get("mass")
    if number is None or settings.mass == ESTIMATE or not number.std_error > 0:
        return None
    return uncertain.uncertainty_of(number, f"mass {number.value:g} kg", "kg")


def with_sources(fit: Fit, sources: Sequence[Source]) -> Fit:
    """The fit with what further *sources* add to its uncertainty; as it is where none changes an interval."""
    before = full_errors(fit.parameters)
    counted = [source for source in sources if np.any(source[1][np.isfinite(before)])]
    if not counted:
        return fit
    names = tuple(parameter.name for parameter in fit.parameters)
    uncertainties, changes = zip(*counted, strict=True)
    added = uncertain.Budget(names, before, float(fit.error_dof), uncertainties, np.array(changes))
    budget = added if fit.budget is None else fit.budget.with_sources(added.sources, added.changes)
    widened = with_systematic(fit.parameters, added, budget.dof)
    stated = zip(widened, budget.systematic, strict=True)
    parameters = tuple(
        entry if entry.systematic is None else replace(entry, systematic=float(size))
        for entry, size in stated
    )
    return replace(fit, parameters=parameters, budget=budget)


def with_contributions(fit: Fit, coverage: float) -> Fit:
    """The fit with combined and expanded uncertainty, and the sources, of parameters that given numbers make
    uncertain. *coverage* [1] of the expanded one, by Student's t with the effective degrees of freedom. That
    of the others is half the 95 % interval, which need not be said.
    """
    stated = fit.parameters if fit.budget is None else contribute(fit.parameters, fit.budget, coverage)
    if coverage != FitSettings.coverage:
        stated = tuple(_expand(parameter, coverage) for parameter in stated)
    return replace(fit, parameters=tuple(map(_with_interval_parts, stated)))


def _expand(parameter: Parameter, coverage: float) -> Parameter:
    """A parameter of which no expanded uncertainty is stated, with that of its interval for a *coverage*."""
    error, ends = parameter.full_error, parameter.ci95
    if parameter.expanded is not None or ends is None or not error:
        return parameter
    factor = factor_at_coverage((ends[1] - ends[0]) / (2 * error), coverage)
    return replace(parameter, expanded=factor * error, coverage_factor=factor)


def _with_interval_parts(parameter: Parameter) -> Parameter:
    """What is neither noise, repeats nor given numbers in an interval is model error."""
    noise, systematic = parameter.std_error, parameter.systematic or 0.0
    if noise is None or parameter.ci95 is None:
        return parameter
    repeats = 0.0 if parameter.interval is None else parameter.interval.repeats
    full = parameter.full_error or noise
    rest = max(full**2 - noise**2 - systematic**2 - repeats**2, 0.0)
    # What rounding leaves of equal squares is not a model error.
    discrepancy = float(np.sqrt(rest)) if rest > 1e-9 * full**2 else 0.0
    return replace(parameter, interval=IntervalParts(noise, discrepancy, repeats, systematic))


def contribute(
    parameters: Sequence[Parameter], budget: uncertain.Budget, coverage: float
) -> tuple[Parameter, ...]:
    """The same of *parameters* by a *budget* of all of them. One without a systematic part stays as it is."""
    stated = []
    for parameter in parameters:
        if parameter.systematic is None:
            stated.append(parameter)
            continue
        column = budget.names.index(parameter.name)
        combined, dof = float(budget.combined[column]), float(budget.dof[column])
        factor = coverage_factor(coverage, dof)
        shares = budget.shares(parameter.name).items()
        parts = tuple(Contribution(name, combined * float(np.sqrt(share)), share) for name, share in shares)
        expanded = replace(parameter, combined=combined, expanded=factor * combined, budget=parts)
        stated.append(replace(expanded, coverage_factor=factor))
    return tuple(stated)


# From a case and an error of a source to the case with the setup and the data that this gives.
Change = Callable[[Case, float], Case]


def sources_of(setup: Setup, measured: Measured) -> list[tuple[uncertain.Uncertainty, Change]]:
    """Every source with what an error of it does; numbers of one source change together."""
    entries: list[tuple[uncertain.Uncertainty, Change]] = [
        (calibration.uncertainty, partial(_miscalibrate, calibration.effect, number, sign))
        for ports, sign in ((setup.outputs, 1.0), (setup.inputs, -1.0))
        for number, port in enumerate(ports)
        for calibration in port.uncertainties
    ]
    whole = measured.plus_offset(measured.matrix)
    entries += [(error.uncertainty, partial(_add_error, error, whole)) for error in measured.errors]
    if (mass := mass_uncertainty(setup.settings)) is not None:
        entries.append((mass, _add_mass))
    for name, uncertainty in support_uncertainties(setup.settings.subtract):
        entries.append((uncertainty, partial(_change_support, name)))
    by_source: dict[str, list[tuple[uncertain.Uncertainty, Change]]] = {}
    for entry in entries:
        by_source.setdefault(entry[0].source, []).append(entry)
    return [(of_one[0][0], partial(_change_together, of_one)) for of_one in by_source.values()]


def _change_together(
    entries: Sequence[tuple[uncertain.Uncertainty, Change]], case: Case, error: float
) -> Case:
    for uncertainty, change in entries:
        case = change(case, error * uncertainty.std_error / entries[0][0].std_error)
    return case


def _with_matrix(case: Case, matrix: ComplexArray) -> Case:
    return replace(case, measured=replace(case.measured, matrix=matrix))


def _miscalibrate(effect: str, number: int, sign: float, case: Case, error: float) -> Case:
    """What the error of a channel does: X (1 - d), X e^{jwd}, X e^{jd}, or another direction. *sign* -1 for a
    force, which divides.
    """
    if effect == "direction":
        return _misalign(number, sign, case, error)
    slope, power = uncertain.COURSES[effect]
    measured = case.measured
    matrix = measured.plus_offset(measured.matrix).copy()
    at = (slice(None), number) if sign > 0 else (..., number)
    matrix[at] *= np.exp(sign * error * slope * measured.omega**power)[:, None]
    offset = 0.0 if measured.offset is None else measured.offset[:, None, None]
    return _with_matrix(case, matrix - offset)


def _misalign(number: int, sign: float, case: Case, error: float) -> Case:
    """Another direction of a force, of which the model knows; or of a sensor, which then reads the motion
    across it too. Without another one to tell that, the motion counts as alike in all directions.
    """
    across = across_ports(case.measured.outputs) if sign > 0 else None
    if across is None or not np.any(across[number]):
        side = "outputs" if sign > 0 else "inputs"
        ports = list(getattr(case.setup, side))
        angle = ports[number].angle
        ports[number] = replace(ports[number], angle=None if angle is None else angle + error)
        changed: dict[str, Any] = {side: tuple(ports)}
        return replace(case, setup=replace(case.setup, **changed))
    measured, matrix = case.measured, case.measured.matrix
    ports = list(measured.outputs)
    ports[number] = replace(ports[number], angle=float(ports[number].angle or 0.0) + error)
    moved = replace(measured, outputs=tuple(ports))
    stated, before, after = (_plane(of.outputs) for of in (case.setup, measured, moved))
    if len(stated) == 2 == len(ports):
        # Two sensors tell the motion whatever their directions, so that it is turned without a first order.
        matrix = stated @ np.linalg.solve(after, before @ np.linalg.solve(stated, matrix))
        return replace(case, measured=replace(moved, matrix=matrix))
    return _with_matrix(case, matrix + error * turn(matrix, number, across, of_forces=False))


def _plane(ports: Sequence[Port]) -> FloatArray:
    """Directions (n_port, 2) [1] of the ports that have one."""
    angles = np.array([port.angle for port in ports if port.angle is not None], float)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _add_error(matrix_error: uncertain.MatrixError, whole: ComplexArray, case: Case, error: float) -> Case:
    """What the error of a number in a sum of channels, or noise of a force, does to each element of the
    matrix, which was *whole* (n_line, n_output, n_input) [m/N] when measured.
    """
    measured, size = case.measured, error / matrix_error.uncertainty.std_error
    ratio = measured.plus_offset(measured.matrix) / np.where(whole == 0, 1.0, whole)
    return _with_matrix(case, measured.matrix + size * matrix_error.at(ratio))


def across_findings(setup: Setup, budget: uncertain.Budget) -> Iterator[Finding]:
    """A note on the direction of a single sensor."""
    turned = {of.uncertainty.source for of in setup.outputs[0].uncertainties if of.effect == "direction"}
    if len(setup.outputs) == 1 and turned & {source.source for source in budget.sources}:
        what = (
            f"direction of {setup.outputs[0].label}: no other output measures the motion across, which counts"
        )
        yield Finding("number-uncertainty", f"{what} as if it were alike")


def _with_settings(case: Case, **changed: Any) -> Case:
    settings = replace(case.setup.settings, **changed)
    return replace(case, setup=replace(case.setup, settings=settings))


def _add_mass(case: Case, error: float) -> Case:
    mass = case.setup.settings.mass
    assert isinstance(mass, (int, float))
    if mass + error < 0:
        what = f"the uncertainty of the mass {mass:g} kg reaches zero: {mass + error:.3g} kg is not a mass"
        raise FitError(
            what, hint="limits above zero such as 0.8 kg +- 0.5 kg (rectangular), or mass: estimate"
        )
    return _with_settings(case, mass=mass + error)


def support_uncertainties(support: Support | None) -> Iterator[tuple[str, uncertain.Uncertainty]]:
    """Uncertainties of a support's stiffness and damping by name: the same errors in all its tests."""
    for name, unit in (("stiffness", "N/m"), ("damping", "N.s/m")):
        number: uncertain.Uncertain | None = None if support is None else getattr(support, name)
        if number is not None and number.std_error > 0:
            source = f"{name} of the support, {amount_text(number.value, None, unit)}"
            yield name, uncertain.uncertainty_of(number, source, unit)


def _change_support(name: str, case: Case, error: float) -> Case:
    support = case.setup.settings.subtract
    assert support is not None
    number: uncertain.Uncertain = getattr(support, name)
    moved = replace(support, **{name: replace(number, value=number.value + error)})
    return _with_settings(case, subtract=moved)


def _step_of(case: Case) -> Step:
    """The estimator's step; without one that of ml, where the estimate is that of ml, else the fit anew."""
    settings = case.setup.settings
    estimator = settings.estimates
    if estimator.step is not None:
        return estimator.step(case)
    if estimator.phase:
        _, jacobian, residual = _linearise(case)
        away = np.abs(solve_scaled(jacobian, residual)[0])
        if np.all(away <= AT_MINIMUM * np.sqrt(np.diag(case.estimate.covariance))):
            return likelihood_step(case)
    return lambda model, measured: estimator.fit(measured, model, settings.weight).values


def instrumental_step(case: Case) -> Step:
    """One more step of the instrumental variables from their estimate, on changed data and model."""
    weight, values = case.setup.settings.weight, case.estimate.values
    by_instruments = instrument_step(case.measured, _linear(case.model), weight, values)
    return lambda model, measured: by_instruments(_linear(model), measured)


def least_squares_step(case: Case) -> Step:
    """Least squares, which needs no estimate to step from."""
    weight = case.setup.settings.weight
    return lambda model, measured: equation_solution(
        regression(measured, _linear(model), weight), _linear(model)
    )[0]


def _linear(model: BandModel) -> DynamicModel:
    assert isinstance(model, DynamicModel)
    return model


def likelihood_step(case: Case) -> Step:
    """p - (J^T J)^-1 J^T (r(q + dq) - r(q)), the weighted residual r and its Jacobian J at the estimate."""
    problem, jacobian, residual = _linearise(case)
    _, inverse = solve_scaled(jacobian, residual)

    def step(model: BandModel, changed: Measured) -> FloatArray:
        moved_problem = OutputError(changed, expected_model(changed, model), problem.whitener)
        moved = moved_problem.residual(case.estimate.values)
        return case.estimate.values - inverse @ (jacobian.T @ (moved - residual))

    return step


def _linearise(case: Case) -> tuple[OutputError[Any], FloatArray, FloatArray]:
    problem, values = OutputError.of(case.measured, case.model), case.estimate.values
    return problem, problem.jacobian(values), problem.residual(values)


# Scatter between repeats of a test as sources of its uncertainty: drift between days, remounting.


def with_repeat_sources(
    fit: Fit,
    sources: Sequence[uncertain.RepeatSource],
    test: str,
    conditions: Mapping[str, Any],
    coverage: float,
) -> Fit:
    """The fit with the scatter between repeats in its budget, of one parameter each; *coverage* [1] of
    expanded uncertainties. ConfigError for a test without the condition that its errors go by.
    """
    names = [parameter.name for parameter in fit.parameters]
    counted = [_source(source, fit, test, conditions) for source in sources if source.parameter in names]
    return with_contributions(with_sources(fit, counted), coverage) if counted else fit


def _source(source: uncertain.RepeatSource, fit: Fit, test: str, conditions: Mapping[str, Any]) -> Source:
    if source.per and source.per not in conditions:
        what = (
            f"{source.name} goes by the condition '{source.per}', which "
            f"{f'test {test}' if test else 'the test'} does not have"
        )
        raise ConfigError(what, hint=f"conditions: {{{source.per}: ...}}, or leave `per` out")
    same = f"{source.per} {conditions[source.per]}" if source.per else test or "this test"
    changed = fit.parameter(source.parameter)
    amount = source.relative * changed.value
    changes = np.array([amount if p.name == source.parameter else 0.0 for p in fit.parameters])
    return uncertain.Uncertainty(f"{source.name} ({same})", abs(amount), changed.unit, source.dof), changes

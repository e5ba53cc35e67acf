"""Causes of a mismatch that the data show: a stated number, a wrong given mass, a late channel, drift within
the record.

Near a resonance the curve knows k / m much better than k and m, so that k follows a wrong mass in proportion
and the goodness of fit hardly changes. The height of the curve under a known force still tells the mass.

Drift is what changed between the two halves of a record. To first order a changed parameter changes H by
dH/dp, a changed gain by its own row or column of H. The change of H is projected on these shapes, whitened
with the noise of H, whose own level between all lines is the measure of chance.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.display import amount_text, chance_text, change_text, difference_in, per_cent, shown_unit
from labpipe.distributions import f_tail
from labpipe.errors import FitError
from labpipe.estimation.derived import Estimated, correct
from labpipe.estimation.descent import minimise, scaled_triangle
from labpipe.estimation.leakage import expected_model
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import DynamicModel, FittedModel, Setup, Term, no_matrices
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.regression import equation_solution, inverse_of, regression
from labpipe.estimation.residual import line_scatter
from labpipe.estimation.statistics import Pulls, Stated, pulls_of, steps_by
from labpipe.estimation.weights import fit_weights, has_noise, weight_uncertainty, whiten_values, whitener
from labpipe.records.finding import Finding
from labpipe.records.uncertain import Uncertainty


def stated_findings(
    uncertainties: Sequence[Uncertainty], pulls: Pulls, values: Mapping[str, float]
) -> list[Finding]:
    """Findings that name every stated number that the data contradict, with the value that they ask for;
    masses by the code `mass`. *uncertainties*: source of each pull; *values* [SI]: numbers by source.
    """
    text: dict[str, list[str]] = {"mass": [], "stated-value": []}
    for number in map(int, np.flatnonzero(pulls.far)):
        code = "mass" if uncertainties[number].unit == "kg" else "stated-value"
        text[code].append(_contradiction(uncertainties[number], pulls, number, values))
    what = (
        "Each is judged with all others within what was stated, and counts in the intervals with its "
        "distance. One of these numbers is wrong, or its uncertainty is larger than stated: weigh or "
        "calibrate again"
    )
    stated = {code: "; ".join(named) for code, named in text.items() if named}
    return [Finding(code, f"the data contradict {named}. {what}") for code, named in stated.items()]


def _contradiction(uncertainty: Uncertainty, pulls: Pulls, number: int, values: Mapping[str, float]) -> str:
    size, unit = uncertainty.std_error, uncertainty.unit
    asked, error = pulls.asked[number] * size, pulls.error[number] * size
    relative = unit == "1"
    stated = per_cent(size) if relative else amount_text(size, None, unit)
    if uncertainty.source in values:
        wanted = amount_text(values[uncertainty.source] + asked, error, unit, "+-")
    elif relative:
        wanted = f"a change by {change_text(100 * asked, 100 * error, '%')}"
    else:
        wanted = f"a change by {_change(asked, error, unit)}"
    return (
        f"{uncertainty.source} (stated +- {stated}): they ask for {wanted}, {pulls.sizes[number]:.2g} "
        "standard uncertainties of both from what was stated"
    )


def _change(amount: float, error: float, si_unit: str) -> str:
    unit = shown_unit(si_unit, amount, error)
    return change_text(difference_in(amount, unit), difference_in(error, unit), unit)


CONTRADICTED_P = 0.01
# Share of the excess chi-square that a free mass explains where the mass is what is wrong.
EXPLAINED = 0.5
MOST_STEPS = 40
# A given mass is taken as known to this share: calibrations are hardly better, and a window's resolution at a
# sharp resonance, which no covariance holds, moves a free mass by tenths of a per cent.
TOLERANCE = 0.01


# What a mass is wrong by where the unit of force or response is another one, within SAME_FACTOR.
UNIT_FACTORS = {
    9.80665: "the factor is that of g and m/s^2, or of kgf and N",
    1e3: "the factor is that of kN and N, or of mm and m",
    1e6: "the factor is that of um and m",
    25.4: "the factor is that of in and mm",
    4.44822: "the factor is that of lbf and N",
}
SAME_FACTOR = 0.03


# A fit with free mass: all values, their covariance, and the degrees of freedom behind it.
_FreeFit = tuple[FloatArray, FloatArray, float]


def mass_findings(
    measured: Measured, model: DynamicModel, values: FloatArray, setup: Setup, stated: Stated | None = None
) -> list[Finding]:
    """A finding where the data contradict the given mass; *values* (n_parameter,) [parameter units] of the
    fit with it.

    The mass is freed in an output-error fit, which noise does not bias. None where the forces' factors are
    estimated too: the curve knows ratios only then; nor in sliding bands, where stiffness that changes with
    frequency looks like another mass. *stated* numbers add to its uncertainty. Equation (est-mass).
    """
    freed = _free(model, setup)
    if freed is None or setup.settings.sliding is not None:
        return []
    free, given = freed
    fit = _free_fit(measured, free, np.concatenate([values, given]), stated)
    if fit is None:
        return []
    p_value = mass_p_value(fit, given)
    if p_value >= CONTRADICTED_P:
        return []
    return [Finding("mass", _message(free, given, fit, values, p_value, setup))]


def _free(model: DynamicModel, setup: Setup) -> tuple[DynamicModel, FloatArray] | None:
    """The model with a term per mass, and the given masses (n_mass,) [kg]: one, or one per dof where they are
    a list. None without given mass or force.
    """
    given, force = model.constant.mass, model.constant.force
    diagonal = np.diag(given)
    if not np.any(diagonal > 0) or not np.any(force):
        return None
    empty = no_matrices(*force.shape)
    if isinstance(setup.settings.mass, float | int):
        parts = {"m": given / diagonal[0]}
    else:
        dofs = [port.dof or port.label for port in setup.outputs]
        units = zip(dofs, np.eye(diagonal.size), diagonal, strict=True)
        parts = {f"m_{dof}_{dof}": np.diag(unit) for dof, unit, mass in units if mass > 0}
    amounts = np.array([float(np.max(given * part)) for part in parts.values()])
    rest = given - np.tensordot(amounts, np.array(list(parts.values())), 1)
    terms = tuple(Term(name, "kg", replace(empty, mass=part)) for name, part in parts.items())
    return replace(model, terms=(*model.terms, *terms), constant=replace(model.constant, mass=rest)), amounts


def _free_fit(
    measured: Measured, model: DynamicModel, start: FloatArray, stated: Stated | None
) -> _FreeFit | None:
    """None where the data cannot tell the mass. The covariance is of the measured noise where this explains
    the residual, else of the residual's scatter along the lines; of a measured excess the free mass must
    explain most, or something else is wrong.
    """
    weighted = has_noise(measured)
    if measured.n_equation <= start.size:
        return None
    try:
        problem = OutputError.of(measured, model)
        minimum = minimise(problem, start, most_steps=MOST_STEPS, linearise=problem.linearise)
        left = problem.chi2(minimum.values)
        if not minimum.converged or left > (1 - EXPLAINED) * problem.chi2(start):
            # A mass that is wrong by a power of ten is too far away: from the equation of motion.
            near = equation_solution(regression(measured, model, "none"), model)[0]
            other = minimise(problem, near, most_steps=MOST_STEPS, linearise=problem.linearise)
            if other.converged and not (minimum.converged and left <= problem.chi2(other.values)):
                minimum = other
        if not minimum.converged:
            return None
        linear = problem.linearise(minimum.values)
        inverse, dof = inverse_of(linear), linear.n_equation - minimum.values.size
        jacobian, residual = problem.jacobian(minimum.values), problem.residual(minimum.values)
        steps = np.zeros((0, start.size)) if stated is None else steps_by(stated.changes, jacobian, inverse)
        if weighted:
            uncertainty, by_stated = weight_uncertainty(measured, dof), 0.0
            if stated is not None:
                changes = Stated.of(stated.changes)
                by_stated = pulls_of(residual, changes, jacobian, inverse, uncertainty.inflation).explained
            after, of_noise = linear.chi2 - by_stated, dof * uncertainty.excess
            if uncertainty.p_value(after / of_noise, dof) >= CONTRADICTED_P:
                return minimum.values, uncertainty.inflation * inverse + steps.T @ steps, dof
            if after - of_noise > (1 - EXPLAINED) * (problem.chi2(start) - of_noise):
                return None
        scatter = line_scatter(jacobian, residual, measured.omega.size)
    except (FitError, np.linalg.LinAlgError):
        return None
    return minimum.values, scatter.covariance + steps.T @ steps, float(np.min(scatter.dof))


def _least_square(whiten: FloatArray, off: FloatArray, limits: FloatArray) -> float:
    """The least |whiten (off - x)|^2 [1] of shifts x (n_mass,) [kg] within +- *limits* [kg]."""
    if off.size == 1:
        return float((whiten[0, 0] * max(abs(off[0]) - limits[0], 0.0)) ** 2)
    return 2 * float(scipy.optimize.lsq_linear(whiten, whiten @ off, (-limits, limits)).cost)


def mass_p_value(fit: _FreeFit, given: FloatArray) -> float:
    """Chance of masses so far from the *given* ones (n_mass,) [kg] if these are right within TOLERANCE:
    Hotelling's T^2 of all together.
    """
    n, (values, whole, dof) = given.size, fit
    covariance, off, limits = whole[-n:, -n:], values[-n:] - given, TOLERANCE * given
    if not np.any(covariance):
        # FRFs that the model meets to the last digit.
        return 1.0 if np.all(np.abs(off) <= limits) else 0.0
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    square, rest = _least_square(whiten, off, limits), dof - n + 1
    return f_tail(square * rest / (dof * n), n, rest) if rest > 0 and square > 0 else 1.0


def _message(
    model: DynamicModel, given: FloatArray, fit: _FreeFit, values: FloatArray, p_value: float, setup: Setup
) -> str:
    n = given.size
    free = correct(Estimated(model.names, model.units, *fit[:2]), setup.settings)
    exact = np.zeros((values.size, values.size))
    before = correct(Estimated(model.names[:-n], model.units[:-n], values, exact), setup.settings)
    masses = ", ".join(
        f"{name} = {_amount(mass, 'kg')} was given, free it comes out as "
        f"{_amount(free.value(name), 'kg', free.std_error(name))}"
        for name, mass in zip(model.names[-n:], given, strict=True)
    )
    stiffness = [name for name, unit in zip(before.names, before.units, strict=True) if unit == "N/m"]
    changed = max(stiffness, key=lambda name: abs(free.value(name) - before.value(name)), default=None)
    becomes = ""
    if changed is not None:
        error = free.std_error(changed)
        becomes = (
            f" {changed} is then {_amount(free.value(changed), 'N/m', error)} instead of "
            f"{_amount(before.value(changed), 'N/m')}."
        )
    ratio = free.value(model.names[-1]) / given[-1] if n == 1 else 0.0
    units = "".join(
        f" ({what})"
        for factor, what in UNIT_FACTORS.items()
        if ratio > 0 and abs(abs(np.log(ratio)) - np.log(factor)) < SAME_FACTOR
    )
    return (
        f"the data contradict the given mass by more than {100 * TOLERANCE:g} % ({chance_text(p_value)}): "
        f"{masses}.{becomes} Either the mass or the calibration{units} is wrong, or stiffness changes with "
        "frequency in the band. Weigh what moves, calibrate, fit with `mass: estimate`, or narrow the band"
    )


def _amount(value: float, si_unit: str, std_error: float | None = None) -> str:
    return amount_text(value, std_error, si_unit, "+-")


# Delays are looked for up to so many periods of the highest line, in steps of this share of its period.
MOST_PERIODS, DELAY_STEP = 5.0, 0.1
# Share of the excess chi-square that a delay explains where it is what is wrong.
BY_DELAY = 0.9
# Channels, or places of one, by the least chi-square of their grids, whose delay is fitted.
LIKELIEST = 2
# Phase [rad] at the highest line, and standard errors, from which a delay is named.
LEAST_PHASE, SURE_DELAY = 0.01, 5.0


@dataclass(frozen=True)
class DelayedModel:
    """A model one of whose channels is late: H(w) exp(-j w tau) in a row or a column; tau [s], the last
    parameter. *late* (n_output, n_input): which elements are.
    """

    model: FittedModel
    late: BoolArray

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H [m/N] with its delay, (n_line, n_output, n_input), at parameters (n_parameter + 1,)."""
        return self.model.receptance(parameters[:-1], omega) * self.phase_factor(parameters[-1], omega)

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """Its derivatives, (n_parameter + 1, n_line, n_output, n_input) [m/N per parameter unit]."""
        slope = np.where(self.late, -1j * omega[:, None, None], 0.0) * self.receptance(parameters, omega)
        others = self.model.jacobian(parameters[:-1], omega) * self.phase_factor(parameters[-1], omega)
        return np.concatenate([others, slope[None]])

    def phase_factor(self, delay: float, omega: FloatArray) -> ComplexArray:
        """exp(-j w tau) of a *delay* [s] at late elements, else 1, (n_line, n_output, n_input) [1]."""
        return np.where(self.late, np.exp(-1j * omega[:, None, None] * delay), 1.0)


# The chi-square that a delay leaves, its channel and the finding; the difference of two chi-squares, a ratio
# of likelihoods of 150, from which one is the better.
Delay = tuple[float, str, Finding]
APART = 10.0


def either_delay(measured: Measured, model: FittedModel, values: FloatArray, viscous: Delay) -> Delay:
    """The delay beside *viscous* damping, or that beside the loss factor of *model*, which turns phases too,
    from its *values* (n_parameter,) [parameter units]; both where the data support both.
    """
    late = dict(late_channels(measured))[viscous[1]]
    problem = OutputError(measured, DelayedModel(model, late), whitener(measured))
    fitted = _delay(measured, model, values, problem, np.append(values, 0.0), viscous[1])
    if fitted is None or fitted[0] > viscous[0] + APART:
        return viscous
    message = f"with a loss factor in place of viscous damping {fitted[1].message}"
    if fitted[0] > viscous[0] - APART:
        message = f"{viscous[2].message}. Or, and the data do not tell these apart, {message}"
    return min(viscous[0], fitted[0]), viscous[1], Finding("delay", message)


def likeliest_delay(measured: Measured, model: DynamicModel, values: FloatArray) -> Delay | None:
    """The chi-square [1] that a delay leaves of a residual that is far from noise, its channel, and the
    finding; *values* (n_parameter,) [parameter units] of the fit.

    The delay of each response, of several forces too, is fitted beside all parameters from the best of a
    grid. None of unknown noise, nor without most of the excess. Equation (est-delay).
    """
    if not has_noise(measured):
        return None
    try:
        grids = [
            (*start, name)
            for name, late in late_channels(measured)
            for start in _best_of_grid(measured, model, values, late)
        ]
    except (FitError, np.linalg.LinAlgError):
        return None
    grids.sort(key=lambda grid: grid[0])
    tried = [(_delay(measured, model, values, *grid[1:]), grid[-1]) for grid in grids[:LIKELIEST]]
    explained = [(fitted[0], name, fitted[1]) for fitted, name in tried if fitted is not None]
    return min(explained, key=lambda entry: entry[0], default=None)


def _best_of_grid(
    measured: Measured, model: DynamicModel, values: FloatArray, late: BoolArray
) -> list[tuple[float, OutputError[DelayedModel], FloatArray]]:
    """The least chi-square of a grid of delays, its problem, and its place.

    Of one FRF beside least squares with each delay as well, and a second place a quarter of a period and more
    away: half a period off, a mode has the same course with the other signs.
    """
    omega = measured.omega
    delayed = DelayedModel(expected_model(measured, model), late)
    problem = OutputError(measured, delayed, fit_weights(measured))

    def chi2(receptance: ComplexArray) -> float:
        residual = problem.whiten(measured.matrix - receptance)
        return float(residual @ residual)

    # H without a delay is the same all over the grid.
    still = delayed.model.receptance(values, omega)
    delays = delays_of_grid(float(omega[-1]))
    places = [
        (chi2(still * delayed.phase_factor(delay, omega)), np.append(values, delay)) for delay in delays
    ]
    if late.size == 1:
        least = np.column_stack([least_squares_at_delays(measured, model, delays), delays])
        places += [(chi2(delayed.receptance(place, omega)), place) for place in least]
    places.sort(key=lambda entry: entry[0])
    apart = np.array([abs(place[-1] - places[0][1][-1]) * omega[-1] for _, place in places])
    starts = [0] if late.size > 1 else [0, int(np.argmax(apart > np.pi / 2))]
    return [(places[n][0], problem, places[n][1]) for n in starts]


def least_squares_at_delays(measured: Measured, model: DynamicModel, delays: FloatArray) -> FloatArray:
    """Least squares of the equation of motion of one FRF turned back by *delays* (n_delay,) [s], (n_delay,
    n_parameter) [parameter units]. Its terms turn alike, and their products stay; the force turns back.
    """
    equation, force = regression(measured, model, "none"), model.constant.force[0, 0]
    terms = equation.terms[:, :, 0, 0].conj()
    still = (terms @ (equation.right_side[:, 0, 0] - force)).real
    turned = (np.exp(-1j * np.outer(delays, measured.omega)) @ (terms * force).T).real
    scale, triangle, _ = scaled_triangle(equation.rows.T)
    values = np.linalg.solve(triangle, np.linalg.solve(triangle.T, ((still + turned) / scale).T))
    return values.T / scale


def delays_of_grid(highest: float) -> FloatArray:
    """Delays (n,) [s] that are tried of lines up to *highest* [rad/s]."""
    return 2 * np.pi / highest * np.arange(-MOST_PERIODS, MOST_PERIODS + DELAY_STEP / 2, DELAY_STEP)


def is_late(delay: float, error: float, highest: float) -> bool:
    """Whether a delay [s] with its standard *error* turns the *highest* line [rad/s] enough to be named."""
    return abs(delay) * highest >= LEAST_PHASE and abs(delay) >= SURE_DELAY * error


def late_channels(measured: Measured) -> list[tuple[str, BoolArray]]:
    """Channels whose delay would explain a fit, and the elements (n_output, n_input) that each delays."""
    shape = measured.matrix.shape[1:]
    outputs, inputs = ([port.channel for port in ports] for ports in (measured.outputs, measured.inputs))
    row, column = np.indices(shape)
    if shape == (1, 1):
        return [(f"{outputs[0]} against {inputs[0]}", row == 0)]
    of_outputs = [(name, row == number) for number, name in enumerate(outputs)]
    of_inputs = [(name, column == number) for number, name in enumerate(inputs)]
    return of_outputs + (of_inputs if len(inputs) > 1 else [])


def _delay(
    measured: Measured,
    model: FittedModel,
    values: FloatArray,
    problem: OutputError[DelayedModel],
    start: FloatArray,
    name: str,
) -> tuple[float, Finding] | None:
    highest = float(measured.omega[-1])
    if measured.n_equation <= start.size:
        return None
    try:
        minimum = minimise(problem, start, most_steps=MOST_STEPS)
        linear = problem.linearise(minimum.values)
        inverse, dof = inverse_of(linear), linear.n_equation - minimum.values.size
        of_noise = dof * weight_uncertainty(measured, dof).excess
    except (FitError, np.linalg.LinAlgError):
        return None
    beyond = problem.chi2(np.append(values, 0.0)) - of_noise
    delay, scale = float(minimum.values[-1]), np.sqrt(max(linear.chi2 / of_noise, 1.0))
    error = float(np.sqrt(inverse[-1, -1])) * scale
    if linear.chi2 - of_noise > (1 - BY_DELAY) * beyond or not is_late(delay, error, highest):
        return None
    of_fit = zip(model.names, model.units, minimum.values, scale * np.sqrt(np.diag(inverse)), strict=False)
    reduced = (beyond + of_noise) / of_noise, linear.chi2 / of_noise
    return linear.chi2, delay_finding(name, (delay, error), reduced, of_fit)


def delay_finding(
    name: str,
    delay: tuple[float, float],
    reduced: tuple[float, float],
    of_fit: Iterable[tuple[str, str, float, float]],
    cure: str = "",
) -> Finding:
    """A channel *name* that is late by *delay* [s] with its error; *reduced*: chi-square per degree of
    freedom without and with it; *of_fit*: name, unit, value and error of every parameter; *cure*: what else
    may explain it.
    """
    changed = ", ".join(
        f"{name} = {_amount(value, unit, std_error)}"
        for name, unit, value, std_error in of_fit
        if unit in ("N/m", "N.s/m", "N/A")
    )
    side = "late" if delay[0] > 0 else "early"
    message = (
        f"{name} is {side} by {_amount(abs(delay[0]), 's', delay[1])}: with that delay chi-square per degree "
        f"of freedom is {reduced[1]:.3g} instead of {reduced[0]:.3g}, and {changed}. State `delay:` of "
        f"that channel in the rig file, or record all channels at the same time{cure}"
    )
    return Finding("delay", message)


# A drift that matters is far beyond chance; a gain that changes by more [1] is that of a lost signal.
DRIFT_P, LOST = 1e-3, 1.0
# Singular values of shapes below which they are one: a common gain of all outputs is that of all forces.
SAME_SHAPE = 1e-8
KINDS = {"N/m": "all stiffness", "N.s/m": "all damping"}


# What changes by 1 or 1 s, the unit in which it is shown, and the whitened change of H (n_equation,) [1].
_Shape = tuple[str, str, FloatArray]


@dataclass(frozen=True)
class _Chance:
    """Variance of a projection on a smooth shape by noise alone [1], and its degrees of freedom."""

    variance: float
    dof: float

    def p_value(self, square: float, n: int) -> float:
        """Chance of a projection on *n* dimensions with so large a *square*."""
        return f_tail(square / (n * self.variance), n, self.dof)


def drift_findings(
    measured: Measured, model: FittedModel, values: FloatArray, n_band: int = 1
) -> list[Finding]:
    """A finding where the halves of the record differ by more than noise; *values* (n_parameter,) [parameter
    units] of the fit.

    Shapes: gain and delay of every channel, all stiffness or all damping by one factor, and all parameters
    together; p-values are for the best of all in *n_band* bands (Bonferroni). None where the halves or the
    noise are not known. Equation (est-drift).
    """
    if measured.change is None or not has_noise(measured):
        return []
    try:
        whiten = whitener(measured)
        jacobian = whiten_values(whiten, model.jacobian(values, measured.omega))
        fitted = measured.plus_offset(model.receptance(values, measured.omega))
    except FitError:
        return []
    change = whiten_values(whiten, measured.change)
    shapes = [*_kinds(jacobian, model, values), *_of_channels(measured, whiten, fitted)]
    chance = _chance(change, np.vstack([jacobian, *(shape for *_, shape in shapes)]), measured)
    if chance is None:
        return []
    # By what it explains: the p-values of large drifts are all zero.
    name, unit, shape = max(shapes, key=lambda entry: abs(_along(change, entry[-1])))
    best = chance.p_value(_along(change, shape) ** 2, 1)
    basis = _basis(jacobian)
    together = chance.p_value(float(np.sum((basis @ change) ** 2)), basis.shape[0])
    p_value = min(1.0, min(best, together) * (len(shapes) + 1) * n_band)
    if p_value >= DRIFT_P:
        return []
    if best <= together:
        length = float(np.linalg.norm(shape))
        amount, error = _along(change, shape) / length, np.sqrt(chance.variance) / length
        text = f"it looks like {name} changed by {_change(amount, error, unit)}"
        if unit == "s":
            text += ", as where the clocks of two loggers run apart"
        elif abs(amount) > LOST and "gain" in name:
            text += " of its mean: in one half its signal is hardly there"
    else:
        text = _parameter_cause(jacobian, model, values, change, chance)
    message = (
        f"the second half of the record differs from the first ({chance_text(p_value)}): {text}. An even "
        "drift is twice that from the beginning to the end. The parameters are means over a changing rig, "
        "and their standard errors do not hold. Wait until temperature and amplifiers have settled, or "
        "record in shorter pieces"
    )
    return [Finding("drift", message)]


def _kinds(jacobian: FloatArray, model: FittedModel, values: FloatArray) -> list[_Shape]:
    places = {
        name: [number for number, other in enumerate(model.units) if other == unit and values[number] != 0]
        for unit, name in KINDS.items()
    }
    return [(name, "%", values[chosen] @ jacobian[chosen]) for name, chosen in places.items() if chosen]


def _of_channels(measured: Measured, whiten: np.ndarray, fitted: np.ndarray) -> list[_Shape]:
    """Gain and delay of every channel; of one output and one input only what is between them is seen."""
    outputs, inputs = ([port.channel for port in ports] for ports in (measured.outputs, measured.inputs))
    rows, columns = np.eye(len(outputs))[:, None, :, None], np.eye(len(inputs))[:, None, None, :]
    # A force that shows more, or late, makes the response to it smaller, or early.
    masks = [*zip(outputs, rows, strict=True), *zip(inputs, -columns, strict=True)]
    if len(masks) == 2:
        masks = [(f"{outputs[0]} or {inputs[0]}", np.ones(1))]
    late = -1j * measured.omega[:, None, None] * fitted
    return [
        (f"the {what} of {name}", unit, whiten_values(whiten, change * mask))
        for what, unit, change in (("gain", "%", fitted), ("delay", "s", late))
        for name, mask in masks
    ]


def _basis(shapes: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(shapes, axis=1)
    _, singular, rows = np.linalg.svd(shapes[lengths > 0] / lengths[lengths > 0, None], full_matrices=False)
    return rows[singular > SAME_SHAPE * singular[0]]


def _chance(change: FloatArray, shapes: FloatArray, measured: Measured) -> _Chance | None:
    """From what no shape explains; noise that lines share makes projections larger, with fewer degrees."""
    basis = _basis(shapes)
    rest = change - (basis @ change) @ basis
    dof = change.size - basis.shape[0]
    square = float(rest @ rest)
    if dof < 1 or square == 0:
        return None
    return _Chance(measured.shared_noise * square / dof, dof / measured.shared_power)


def _along(change: FloatArray, shape: FloatArray) -> float:
    length = float(np.linalg.norm(shape))
    return float(change @ shape) / length if length > 0 else 0.0


def _parameter_cause(
    jacobian: FloatArray, model: FittedModel, values: FloatArray, change: FloatArray, chance: _Chance
) -> str:
    inverse = np.linalg.pinv(jacobian @ jacobian.T)
    changes = inverse @ (jacobian @ change)
    errors = np.sqrt(chance.variance * np.maximum(np.diag(inverse), np.finfo(float).tiny))
    n = int(np.argmax(np.abs(changes) / errors))
    share = f" ({100 * changes[n] / values[n]:+.2g} %)" if values[n] else ""
    by = _change(changes[n], errors[n], model.units[n])
    return f"its parameters changed, most of all {model.names[n]} by {by}{share}"

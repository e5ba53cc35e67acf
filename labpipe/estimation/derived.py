"""What is derived from estimates: corrections, modes, resonance, reported parameters and a dense curve."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import coverage_factor
from labpipe.estimation import statistics
from labpipe.estimation.damping import FactorModel
from labpipe.estimation.linear_models import stiffness_and_damping
from labpipe.estimation.measured import select_ports
from labpipe.estimation.model import DynamicModel, Matrices, Setup
from labpipe.estimation.settings import VISCOUS, FitSettings, Support
from labpipe.estimation.transfer_mode import TransferMode, transfer_of
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Unstated
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.settings import COEFFICIENT_UNITS
from labpipe.records.uncertain import Budget
from labpipe.spectra.convert import TRANSMISSIBILITY

# Units of coefficients that equal bearings in parallel share.
DIVIDED = ("N/m", "N.s/m")


@dataclass(frozen=True)
class Estimated:
    """Estimates (n_parameter,) by name, with their covariance (n_parameter, n_parameter), in *units* [SI]."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray

    def index(self, name: str) -> int:
        return self.names.index(name)

    def std_error(self, name: str) -> float:
        return float(np.sqrt(self.covariance[self.index(name), self.index(name)]))

    def value(self, name: str) -> float:
        return float(self.values[self.index(name)])


def reported_fit(
    settings: FitSettings,
    estimate: statistics.Estimate,
    parameters: tuple[Parameter, ...],
    band: tuple[float, float],
    n_line: int,
    n_prior: int = 0,
) -> Fit:
    """*estimate* and *parameters* as the Fit of results, without findings, notes and curve. band [Hz];
    n_line: frequency lines used; n_prior: equations that are no measurement.
    """
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator=settings.estimator,
        band_hz=band,
        lines=n_line,
        equations=estimate.dof + estimate.values.size - n_prior,
        dof=estimate.dof,
        noise_dof=None if estimate.dof else int(estimate.student_dof.min()),
        gof=estimate.gof,
        parameters=parameters,
        condition_number=statistics.condition_number(estimate.scaled_design),
        correlation=statistics.correlation(estimate.covariance),
        converged=estimate.converged,
        iterations=estimate.iterations,
    )


def is_direct(name: str) -> bool:
    """True for a coefficient in the direction of its own motion: k, c, m, k_xx, c_yy, k_1_1, m_2_2."""
    letter, _, place = name.partition("_")
    half = len(place) // 2
    between = "_" if "_" in place else ""
    return letter in ("k", "c", "m") and place == f"{place[:half]}{between}{place[:half]}"


def correct(total: Estimated, settings: FitSettings) -> Estimated:
    """(total - support) / share for stiffness and damping: k_bearing = (k_total - k_support) / n. The
    uncertainty of the support is a source of its own. Equation (est-corrected).
    """
    of_support = np.array([_support_mass(name, settings) for name in total.names])
    divisor = np.array([float(settings.share) if unit in DIVIDED else 1.0 for unit in total.units])
    covariance = total.covariance / np.outer(divisor, divisor)
    return replace(total, values=(total.values - of_support) / divisor, covariance=covariance)


def _support_mass(name: str, settings: FitSettings) -> float:
    support = settings.subtract or Support()
    amounts = {"k": support.stiffness.value, "c": support.damping.value}
    return amounts.get(name[0], 0.0) if is_direct(name) else 0.0


def is_corrected(settings: FitSettings) -> bool:
    """True if the reported coefficients differ from the measured totals."""
    return settings.share > 1 or (settings.subtract or Support()) != Support()


# A shape is scaled by its first entry above this share of the largest, which is random among equal ones.
LEADING = 0.8
# Name -> (unit, value of every case).
Quantities = dict[str, tuple[str, FloatArray]]


@dataclass(frozen=True)
class SystemModes:
    """Oscillating modes in ascending order of frequency, of (n_case,) systems.

    frequency (n_case, n_mode) [Hz] = |lambda| / 2 pi, with a loss factor sqrt(-Re lambda^2) / 2 pi; damping
    -Re lambda / |lambda|; of the undamped system shapes (n_case, n_dof, n_mode), the first large entry 1, and
    participation (n_case, n_mode, n_input) [1/kg]: H = sum_r shape_r participation_r / (w_r^2 - w^2).
    """

    frequency: FloatArray
    damping: FloatArray
    shapes: FloatArray
    participation: FloatArray


def modes(matrices: Matrices) -> SystemModes | None:
    """Eigenvalues of (lambda^2 M + lambda C + K) x = 0, matrices (n_case, n_dof, n_dof).

    With a loss factor K is complex, with a meaning for positive frequencies alone: of each pair of
    eigenvalues the one that decays. None where a mass is singular, or a mode does not oscillate. Equation
    (est-modes).
    """
    k, c, m = matrices.stiffness, matrices.damping, matrices.mass
    n_case, n = k.shape[0], k.shape[1]
    if np.any(np.linalg.cond(m) > 1 / np.finfo(float).eps):
        return None
    by_mass = np.linalg.solve(m, np.concatenate([k, c], axis=2))
    identity = np.broadcast_to(np.eye(n), k.shape)
    state = np.block([[np.zeros_like(k), identity], [-by_mass[:, :, :n], -by_mass[:, :, n:]]])
    values = np.linalg.eigvals(state)
    undamped, right = np.linalg.eig(by_mass[:, :, :n].real)
    is_still = (undamped.real <= 0) | (undamped.imag != 0)
    if np.any(np.sum(values.imag > 0, axis=1) != n) or np.any(is_still):
        return None
    upper = values[values.imag > 0].reshape(n_case, n)
    upper = np.take_along_axis(upper, np.argsort(np.abs(upper), axis=1), axis=1)
    frequency = np.sqrt(-(upper**2).real) if np.iscomplexobj(k) else np.abs(upper)
    shapes = np.take_along_axis(right.real, np.argsort(undamped.real, axis=1)[:, None], axis=2)
    size = np.abs(shapes)
    leading = np.argmax(size >= LEADING * np.max(size, axis=1, keepdims=True), axis=1)
    shapes = shapes / np.take_along_axis(shapes, leading[:, None], axis=1)
    # Rows of (M Phi)^-1 are the left vectors with y^T M x = 1.
    participation = np.linalg.solve(m @ shapes, matrices.force)
    return SystemModes(frequency / (2 * np.pi), -upper.real / np.abs(upper), shapes, participation)


def modal_quantities(matrices: Matrices, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> Quantities:
    """f_n_r, zeta_r, shape_r_dof and participation_r_force of every mode r; empty without modes."""
    mode_set = modes(matrices)
    if mode_set is None:
        return {}
    quantities: Quantities = {}
    for r in range(mode_set.frequency.shape[1]):
        quantities[f"f_n_{r + 1}"] = ("Hz", mode_set.frequency[:, r])
        quantities[f"zeta_{r + 1}"] = ("1", mode_set.damping[:, r])
    for r in range(mode_set.frequency.shape[1]):
        for row, dof in enumerate(outputs):
            quantities[f"shape_{r + 1}_{dof}"] = ("1", mode_set.shapes[:, row, r])
        for i, force in enumerate(inputs):
            quantities[f"participation_{r + 1}_{force}"] = ("1/kg", mode_set.participation[:, r, i])
    return quantities


# What one band is fitted with.
BandModel = DynamicModel | FactorModel | TransferMode

# Steps of numerical slopes: in standard errors, and as a share of the value where there is no noise.
STEP, SMALLEST_STEP = 1e-3, 1e-7


def derived_parameters(
    total: Estimated, every: Estimated, model: BandModel, setup: Setup, dof: int
) -> list[Parameter]:
    """f_n and zeta (sdof, base), modes (mdof), forcing angle (rotor-2dof, one force), coefficients of
    proportional damping, and totals beside support or share. *every*: *total* with all coefficients that are
    tied or given. Equation (est-resonance).
    """
    settings = setup.settings
    parameters: list[Parameter] = []
    if settings.kind.one_mode:
        parameters.extend(_resonance(every, setup, dof))
    if isinstance(model, FactorModel) and model.law.viscous:
        parameters.extend(
            _propagated_all(total, lambda values: _damping_coefficients(model, values, settings), dof)
        )
    if settings.kind.matrix_modes:
        outputs = tuple(port.dof or port.label for port in setup.outputs)
        inputs = tuple(port.label for port in setup.inputs)
        parameters.extend(
            _propagated_all(total, lambda values: modal_quantities(model.whole(values), outputs, inputs), dof)
        )
    if "b_x" in total.names and "b_y" in total.names:
        x, y = total.value("b_x"), total.value("b_y")
        error = propagate(total, {"b_x": -y / (x**2 + y**2), "b_y": x / (x**2 + y**2)})
        parameters.append(statistics.derive("forcing_angle", "rad", float(np.arctan2(y, x)), error, dof))
    given = dict(settings.fixed)
    for name, unit in zip(every.names, every.units, strict=True):
        if is_corrected(settings) and unit in DIVIDED and name not in given:
            value, error = every.value(name), every.std_error(name)
            parameters.append(statistics.derive(f"{name}_total", unit, value, error, dof))
    return parameters


def _damping_coefficients(model: FactorModel, values: FloatArray, settings: FitSettings) -> Quantities:
    """c_i_j = alpha m_i_j + beta k_i_j of every stiffness coefficient, less the support's and of one bearing;
    *values* (n_case, n_parameter).
    """
    damping = model.whole(values).damping
    coefficients, totals = Quantities(), Quantities()
    for term in model.terms:
        places = np.argwhere(term.matrices.stiffness != 0)
        if places.size:
            name, total = f"c{term.name[1:]}", damping[:, places[0][0], places[0][1]]
            coefficients[name] = ("N.s/m", (total - _support_mass(name, settings)) / settings.share)
            totals[f"{name}_total"] = ("N.s/m", total)
    return coefficients | totals if is_corrected(settings) else coefficients


def _propagated_all(
    total: Estimated, quantities: Callable[[FloatArray], Quantities], dof: int
) -> list[Parameter]:
    """Functions of the estimates with their standard errors to first order, by centred differences; without
    errors where they do not exist on both sides of the estimate.
    """
    steps = np.maximum(STEP * np.sqrt(np.diag(total.covariance)), SMALLEST_STEP * np.abs(total.values))
    places = [total.values, total.values + np.diag(steps), total.values - np.diag(steps)]
    quantities_at_steps = quantities(np.vstack(places))
    if not quantities_at_steps or np.any(steps == 0):
        centre = quantities(total.values[None])
        return [Parameter(name, float(of[0]), unit, derived=True) for name, (unit, of) in centre.items()]
    n = steps.size
    values = np.array([of for _, of in quantities_at_steps.values()])
    slopes = (values[:, 1 : n + 1] - values[:, n + 1 :]) / (2 * steps)
    errors = np.sqrt(np.maximum(np.vecdot(slopes @ total.covariance, slopes), 0.0))
    named = zip(quantities_at_steps.items(), values[:, 0].tolist(), errors.tolist(), strict=True)
    return [statistics.derive(name, unit, value, error, dof) for (name, (unit, _)), value, error in named]


def _resonance(total: Estimated, setup: Setup, dof: int) -> list[Parameter]:
    """f_n = sqrt(k/m) / 2 pi [Hz] and zeta = c / (2 m w_n) of the measured system, of a transfer FRF also its
    modal constant 1/m [1/kg].

    k and m of a transfer FRF, or of a sensor of the wrong sign, are negative together: the resonance is the
    same. None of it where k and m have different signs or are eliminated, and no f_n of given numbers alone.
    """
    stiffness, damping = stiffness_and_damping(total.names)
    if not stiffness:
        return []
    given: Any = setup.settings.mass if stiffness == "k" else 1.0
    k, m = total.value(stiffness), total.value("m") if "m" in total.names else float(given)

    def derive(name: str, unit: str, value: float, slopes: dict[str, float]) -> Parameter:
        return statistics.derive(name, unit, float(value), propagate(total, slopes), dof)

    resonance = []
    if k * m > 0:
        w_n = np.sqrt(k / m)
        f_n = w_n / (2 * np.pi)
        if {stiffness, "m"} & {*total.names} - {*dict(setup.settings.fixed)}:
            resonance.append(derive("f_n", "Hz", f_n, {stiffness: f_n / (2 * k), "m": -f_n / (2 * m)}))
        if damping:
            zeta = total.value(damping) / (2 * m * w_n)
            slopes = {damping: 1 / (2 * m * w_n), stiffness: -zeta / (2 * k), "m": -zeta / (2 * m)}
            resonance.append(derive("zeta", "1", zeta, slopes))
    if "m" in total.names and m != 0 and transfer_of(setup):
        resonance.append(derive("modal_constant", "1/kg", 1 / m, {"m": -1 / m**2}))
    return resonance


def propagate(total: Estimated, slopes: dict[str, float]) -> float:
    """Standard error of a function of the estimates to first order: sqrt(g^T cov g), g its derivatives by
    name. Equation (est-delta).
    """
    gradient = np.array([slopes.get(name, 0.0) for name in total.names])
    return float(np.sqrt(max(gradient @ total.covariance @ gradient, 0.0)))


# Probability of the intervals of parameters.
INTERVAL = 0.95
# Sides of an interval that differ by less than this share are alike.
EVEN = 1e-3


def reported_parameters(
    estimate: statistics.Estimate, model: BandModel, setup: Setup
) -> tuple[Parameter, ...]:
    """Estimated and derived parameters with the uncertainty that noise leaves them. Without convergence the
    values of the last step, without standard errors.
    """
    settings, vifs = setup.settings, statistics.inflation_factors(estimate.scaled_design)
    total = Estimated(model.names, model.units, estimate.values, estimate.covariance)
    # A law's factors come behind the terms, and have no coefficients tied to them.
    aliases = [(number, alias) for number, term in enumerate(model.terms) for alias in term.aliases]
    places = [*range(vifs.size), *(number for number, _ in aliases)]
    every = _add_given(total, places, [alias for _, alias in aliases], settings.fixed)
    reported = correct(every, settings)
    coefficients = []
    for number, (name, place) in enumerate(zip(reported.names, places, strict=False)):
        value, error, dof = reported.value(name), reported.std_error(name), int(estimate.student_dof[place])
        of_place = value, error, dof, float(vifs[place]), number >= vifs.size
        coefficients.append(statistics.appraise(name, reported.units[number], *of_place))
    derived = derived_parameters(total, every, model, setup, int(estimate.student_dof.min()))
    given = [
        Parameter(name + end, of.value(name), COEFFICIENT_UNITS[name[0]], derived=True)
        for of, end in ((reported, ""), (every, "_total"))
        for name, _ in settings.fixed
        if not end or (is_corrected(settings) and COEFFICIENT_UNITS[name[0]] in DIVIDED)
    ]
    parameters = (*coefficients, *derived, *given)
    return parameters if estimate.converged else tuple(p.without_interval for p in parameters)


def _add_given(
    total: Estimated, places: list[int], tied: list[str], given: tuple[tuple[str, float], ...]
) -> Estimated:
    """The estimates at *places* among *total*, those behind it under the names *tied*, then the *given*
    coefficients, which have no error.
    """
    n = len(places)
    covariance = np.zeros((n + len(given),) * 2)
    covariance[:n, :n] = total.covariance[np.ix_(places, places)]
    return Estimated(
        (*total.names, *tied, *(name for name, _ in given)),
        (*(total.units[place] for place in places), *(COEFFICIENT_UNITS[name[0]] for name, _ in given)),
        np.concatenate([total.values[places], [value for _, value in given]]),
        covariance,
    )


def widened_parameters(
    parameters: Sequence[Parameter], plain: Sequence[Parameter], wide: Sequence[Parameter]
) -> tuple[Parameter, ...]:
    """Intervals and significance as much wider as standard errors of *wide* are than those of *plain*; none
    narrower, as where errors of two parameters compensate in a derived one.
    """
    pairs = zip(plain, wide, strict=True)
    factors = [(after.std_error or 0.0) / (before.std_error or np.inf) for before, after in pairs]
    return tuple(
        statistics.widen(p, max(factor, 1.0)) if factor > 0 else p
        for p, factor in zip(parameters, factors, strict=True)
    )


def with_systematic(
    parameters: Sequence[Parameter], budget: Budget, dof: FloatArray | None = None
) -> tuple[Parameter, ...]:
    """The parameters with combined standard uncertainties and expanded intervals, by Student's t with the
    effective *dof* (n_parameter,) [1], by default those of the budget. Sides of a lopsided interval are each
    widened by squares. Equation (unc-interval).
    """
    return tuple(
        _expand(parameter, float(systematic), float(of_parameter))
        for parameter, systematic, of_parameter in zip(
            parameters, budget.systematic, budget.dof if dof is None else dof, strict=True
        )
    )


def _expand(parameter: Parameter, systematic: float, dof: float) -> Parameter:
    noise = parameter.full_error
    if noise is None:
        return parameter
    # Declared uncertainties that do not move a parameter are stated as zero.
    if systematic == 0:
        return replace(parameter, systematic=0.0)
    combined = math.hypot(noise, systematic)
    reach = combined * coverage_factor(INTERVAL, dof)
    value, interval = parameter.value, parameter.ci95
    if interval is None:
        ratio = None if parameter.t_ratio is None else value / combined
        without = replace(parameter, std_error_inflated=combined, systematic=systematic)
        return replace(without, t_ratio=ratio, significant=None)
    low, high = value - interval[0], interval[1] - value
    if math.isclose(low, high, rel_tol=EVEN):
        low = high = reach
    else:
        low, high = (math.hypot(side, reach * systematic / combined) for side in (low, high))
    return statistics.restate(parameter, value, combined, (value - low, value + high), systematic=systematic)


# Parts of the step between two lines, least number of frequencies in a band, and the largest.
PARTS, FEWEST, MOST = 2, 200, 2000
# Largest distance of the model from a straight line between two neighbours, as part of its size.
FLATNESS = 0.005
ROUNDS = 12

Model = Callable[[FloatArray], ComplexArray]


def drawn_densely(model: Model, lines: FloatArray) -> tuple[FloatArray, ComplexArray]:
    """Frequencies (n,) [Hz] on and between the *lines*, and the model there (n, n_output, n_input).

    Between two lines stand PARTS - 1 more, or as many as make FEWEST in all; where the model bends by more
    than FLATNESS, as at a light resonance, the step is halved again, up to MOST frequencies.
    """
    frequency = lines_between(lines)
    values = model(frequency)
    for _ in range(ROUNDS):
        middle = (frequency[:-1] + frequency[1:]) / 2
        if not middle.size or frequency.size >= MOST:
            break
        at_middle = model(middle)
        # Largest distance of any element from the straight line across each step, over its size.
        size = np.maximum(np.abs(at_middle), np.finfo(float).tiny)
        bend = np.max(np.abs(at_middle - (values[:-1] + values[1:]) / 2) / size, axis=(1, 2))
        # The most bent steps first, as many as there is room for.
        ranked = np.argsort(-bend, kind="stable")[: MOST - frequency.size]
        chosen = np.sort(ranked[bend[ranked] > FLATNESS])
        if not chosen.size:
            break
        frequency = np.insert(frequency, chosen + 1, middle[chosen])
        values = np.insert(values, chosen + 1, at_middle[chosen], axis=0)
    return frequency, values


def lines_between(lines: FloatArray) -> FloatArray:
    """The lines (n_line,) [Hz] with equal parts of every step between them, (n,) [Hz]."""
    steps = max(lines.size - 1, 1)
    parts = max(1, min(max(PARTS, -(-(FEWEST - 1) // steps)), (MOST - 1) // steps))
    places = np.arange((lines.size - 1) * parts + 1) / parts
    return np.interp(places, np.arange(lines.size), lines)


# What no residual can show, and no number states, is listed by name: type B of the GUM.
GAIN = "gain"


def add_unstated(fit: Fit, response: FrequencyResponse, settings: FitSettings) -> Fit:
    """The fit of a *response* with what it takes for granted."""
    rows, columns = select_ports(response, settings.input, settings.output)
    ports = [*(response.inputs[n] for n in columns), *(response.outputs[n] for n in rows)]
    of_base = response.form == TRANSMISSIBILITY
    kinds = {parameter.name.partition("_")[0] for parameter in fit.parameters}
    entries = list(_gains(ports, settings, kinds, of_base=of_base))
    if settings.frees_mass and not of_base and kinds & {"k", "f"}:
        what = "m by m_t; f_n and zeta of the structure alone by m_t / 2 m of themselves"
        entries.append(Unstated("mass m_t of what is attached to the structure", what))
    what = "what changes with the amplitude: repeat the test at half the force"
    entries += [Unstated("level of the force", what), *_law(fit, settings)]
    return replace(fit, not_stated=tuple(entries))


def _gains(
    ports: Sequence[Port], settings: FitSettings, kinds: Set[str], *, of_base: bool
) -> Iterator[Unstated]:
    """*kinds* of parameters: k of stiffnesses, f of natural frequencies."""
    silent = [port.label for port in ports if all(entry.effect != GAIN for entry in port.uncertainties)]
    if not silent:
        return
    what = "gain of " + ", ".join(dict.fromkeys(silent))
    if of_base:
        yield Unstated(what, "k and c by about as much")
    elif not settings.frees_mass:
        yield Unstated(what, "the resonance against the given mass: c by as much, k less near resonance")
    elif "k" in kinds:
        yield Unstated(what, "k, c and m each by as much; f_n and zeta not at all")
    elif "f" in kinds:
        yield Unstated(what, "the size of the mode shapes; f_n and zeta not at all")
    else:
        yield Unstated(what, "every parameter, as far as the residual does not show it")


def _law(fit: Fit, settings: FitSettings) -> Iterator[Unstated]:
    """k - m w^2 is what a resonance shows: the split follows the law of damping."""
    values = {parameter.name: parameter.value for parameter in fit.parameters}
    zeta = values.get("zeta")
    if settings.damping == VISCOUS and settings.frees_mass and zeta and {"k", "m"} <= set(values):
        yield Unstated("law of damping", f"k and m together by about zeta, {100 * abs(zeta):.2g} %")

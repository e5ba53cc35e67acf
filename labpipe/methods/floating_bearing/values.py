"""What people read of a fitted dynamic stiffness: coefficients, whirl, crossover, effective and dimensionless
coefficients.

A rotor whirls undamped where det(K - k I + jw C - w^2 M) = 0 for a real stiffness k and frequency w: the
imaginary part gives k, linear in x = w^2, and the real part then is a quadratic in x (Lund 1987; San Andres
2006 for seals). A negative x is not a whirl. On a circular orbit the force is that of H_f = (H_xx + H_yy - j
(H_xy - H_yx)) / 2: K_eff = Re H_f, C_eff = Im H_f / w.

*std_error* is what noise leaves, *std_error_inflated* with it what given numbers add (and a residual beyond
the noise); intervals are by the latter.

S = mu N L D / W (R / c)^2 with N in revolutions per second (Someya 1989, Journal-Bearing Databook).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.estimation import statistics
from labpipe.estimation.derived import reported_fit
from labpipe.estimation.diagnostics import estimate_findings, goodness_findings
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import appraise, derive, student_limit, widen
from labpipe.methods.floating_bearing.forms import DAMPING, STIFFNESS, StiffnessModel
from labpipe.methods.floating_bearing.settings import DynamicStiffnessSettings
from labpipe.records.finding import Parameter
from labpipe.records.fit_details import GivenUncertainty
from labpipe.records.identification import Fit, Goodness
from labpipe.records.uncertain import Budget, Uncertain, Uncertainty

# Imaginary step of derivatives: exact to rounding.
STEP = 1e-30
LIMIT = 1.959964
# Share of a complex root's size below which its imaginary part is rounding.
REAL = 1e-6
FORMS_WITH_WHIRL = ("kc", "kcm")


@dataclass(frozen=True)
class Whirl:
    """x = w^2 [(rad/s)^2] of the whirl frequency w, its slopes (n_parameter,) [per parameter unit] and its 95
    % interval (Fieller). stiffness k [N/m] at which a rotor whirls, with its slopes (n_parameter,).
    """

    square: float
    slopes: FloatArray
    interval: tuple[float, float]
    stiffness: float
    stiffness_slopes: FloatArray


def whirl(
    model: StiffnessModel, values: FloatArray, covariance: FloatArray, limit: float = LIMIT
) -> Whirl | None:
    """The whirl of K, C and M of values (n_parameter,) with their covariance [parameter units], *limit*
    standard errors to either side of 95 %; None where there is no real solution. Equation (ds-whirl).
    """
    polynomial, stiffness = (part.real for part in _polynomial(model, values))
    square = _root(polynomial)
    if square is None:
        return None
    steps = STEP * np.where(values != 0, np.abs(values), 1.0)
    stepped = [_polynomial(model, values + 1j * step) for step in np.diag(steps)]
    slopes, of_stiffness = (
        np.stack([parts[place].imag for parts in stepped]) / steps[:, None] for place in (0, 1)
    )
    along = float(2 * polynomial[0] * square + polynomial[1])
    square_slopes = -(slopes @ np.array([square**2, square, 1.0])) / along
    # All x around the root where phi(x)^2 < limit^2 var phi(x) of the quadratic phi
    slope = 2 * polynomial[0] * square + polynomial[1]
    powers = slopes @ np.array([square**2, square, 1.0])
    error = float(np.sqrt(powers @ covariance @ powers)) / abs(float(slope))
    unit = max(abs(square), error, np.finfo(float).tiny)
    scales = np.array([unit**2, unit, 1.0])
    scaled = polynomial * scales
    spread = (slopes * scales).T @ covariance @ (slopes * scales)
    variance = np.zeros(5)
    for (i, j), part in np.ndenumerate(spread):
        variance[i + j] += part
    roots = np.roots(np.convolve(scaled, scaled) - limit**2 * variance)
    real = unit * np.sort(roots[np.abs(roots.imag) <= REAL * np.maximum(np.abs(roots), 1e-9)].real)
    below, above = real[real <= square], real[real >= square]
    return Whirl(
        square,
        square_slopes,
        (float(below[-1]) if below.size else -np.inf, float(above[0]) if above.size else np.inf),
        float(stiffness[0] + stiffness[1] * square),
        np.asarray(of_stiffness @ np.array([1.0, square]) + stiffness[1] * square_slopes),
    )


def _polynomial(
    model: StiffnessModel, values: ComplexArray | FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Coefficients (3,) of the quadratic in x, highest first, and (2,) of k = k_0 + k_1 x."""
    # Linear in the values, so that complex steps pass.
    matrices: NDArray[Any] = model.matrices(values)  # type: ignore[arg-type]
    k, c = matrices[0], matrices[1]
    m = matrices[2] if len(matrices) > 2 else np.zeros_like(k)
    # Every element of K - x M as (constant, slope).
    (xx, xy), (yx, yy) = [[np.array([k[i, j], -m[i, j]], np.complex128) for j in (0, 1)] for i in (0, 1)]
    level = (xx * c[1, 1] + yy * c[0, 0] - xy * c[1, 0] - yx * c[0, 1]) / (c[0, 0] + c[1, 1])
    quadratic = _product(xx - level, yy - level) - _product(xy, yx)
    quadratic[1] -= c[0, 0] * c[1, 1] - c[0, 1] * c[1, 0]
    return quadratic, level


def _product(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    return np.array([a[1] * b[1], a[0] * b[1] + a[1] * b[0], a[0] * b[0]])


def _root(polynomial: FloatArray) -> float | None:
    second, first, constant = (float(value) for value in polynomial)
    inside = first**2 - 4 * second * constant
    if inside < 0 or first == 0:
        return None
    return -2 * constant / (first + np.copysign(np.sqrt(inside), first))


# Frequencies at which a change of sign is looked for: from this share of the lowest line to that of the
# highest.
SHARES = (0.05, 1.5)
N_FREQUENCY = 4000


@dataclass(frozen=True)
class StiffnessCourse:
    """K_eff [N/m] and C_eff [N.s/m] (n_line,) at omega (n_line,) [rad/s], with standard errors of the same
    shape and unit.
    """

    omega: FloatArray
    stiffness: FloatArray
    stiffness_error: FloatArray
    damping: FloatArray
    damping_error: FloatArray


def forward(stiffness: ComplexArray, sense: float = 1.0) -> ComplexArray:
    """H_f (...,) [N/m] of H (..., 2, 2); *sense*: 1 for a shaft that turns from x to y, -1 against it.
    Equation (ds-forward).
    """
    direct = stiffness[..., 0, 0] + stiffness[..., 1, 1]
    return (direct - 1j * sense * (stiffness[..., 0, 1] - stiffness[..., 1, 0])) / 2


def effective(
    model: StiffnessModel, values: FloatArray, covariance: FloatArray, omega: FloatArray, sense: float = 1.0
) -> StiffnessCourse:
    """The course at omega (n_line,) [rad/s] of values (n_parameter,) with their covariance (n_parameter,
    n_parameter) [parameter units].

    Equation (ds-effective).
    """
    h = forward(model.stiffness(values, omega), sense)
    slopes = forward(model.jacobian(values, omega), sense)
    variances = (np.sum(part * (covariance @ part), axis=0) for part in (slopes.real, slopes.imag))
    errors = [np.sqrt(np.maximum(variance, 0.0)) for variance in variances]
    return StiffnessCourse(omega, h.real, errors[0], h.imag / omega, errors[1] / omega)


@dataclass(frozen=True)
class Crossover:
    """Frequency w [rad/s] above which damping is positive, its slopes (n_parameter,) [per parameter unit] and
    95 % interval (Fieller).
    """

    omega: float
    slopes: FloatArray
    interval: tuple[float, float]


def crossover(
    model: StiffnessModel,
    values: FloatArray,
    covariance: FloatArray,
    band: FloatArray,
    sense: float = 1.0,
    limit: float = LIMIT,
) -> Crossover | None:
    """The highest frequency at which C_eff turns from negative to positive, *limit* standard errors to either
    side of 95 %; None where it does not. *band* omega (n_line,) [rad/s].
    """
    omega = np.geomspace(SHARES[0] * band[0], SHARES[1] * band[-1], N_FREQUENCY)
    course = effective(model, values, covariance, omega, sense)
    signs = np.sign(course.damping)
    turns = np.flatnonzero((signs[:-1] < 0) & (signs[1:] >= 0))
    if not turns.size:
        return None
    at = int(turns[-1])
    frequency = _zero(omega, course.damping, at)
    slopes = forward(model.jacobian(values, np.array([frequency])), sense).imag[:, 0] / frequency
    along = float((course.damping[at + 1] - course.damping[at]) / (omega[at + 1] - omega[at]))
    upper, lower = (course.damping + sign * limit * course.damping_error for sign in (1, -1))
    below = np.flatnonzero(upper[: at + 1] < 0)
    above = np.flatnonzero(lower[at + 1 :] > 0)
    low = _zero(omega, upper, int(below[-1])) if below.size else -np.inf
    high = _zero(omega, lower, at + int(above[0])) if above.size else np.inf
    return Crossover(frequency, -slopes / along, (low, high))


def _zero(omega: FloatArray, values: FloatArray, at: int) -> float:
    step = values[at + 1] - values[at]
    return float(omega[at] - values[at] * (omega[at + 1] - omega[at]) / step) if step else float(omega[at])


# Ratio of the whole standard error to that of noise below which they are the same.
SAME = 1 + 1e-9


@dataclass(frozen=True)
class FittedStiffness:
    """Estimated values (n_parameter,) as they are fitted, covariance by noise and in all (n_parameter,
    n_parameter) [their units].
    """

    model: StiffnessModel
    values: FloatArray
    noise: FloatArray
    whole: FloatArray
    dof: int

    @property
    def limit(self) -> float:
        """Standard errors to either side of a 95 % interval."""
        return student_limit(self.dof)

    def error(self, slopes: FloatArray, *, whole: bool) -> float:
        """Standard error [its unit] of what has *slopes* (n_parameter,) over the values."""
        covariance = self.whole if whole else self.noise
        return float(np.sqrt(max(float(slopes @ covariance @ slopes), 0.0)))


@dataclass(frozen=True)
class Shaft:
    """The shaft: *speed* [Hz], negative where it turns from y to x. Mass [kg] and stiffness [N/m] of a rotor
    whose onset is asked for.
    """

    speed: float | None = None
    rotor_mass: Uncertain | None = None
    rotor_stiffness: float | None = None

    @property
    def sense(self) -> float:
        return -1.0 if self.speed is not None and self.speed < 0 else 1.0


@dataclass(frozen=True)
class Valued:
    """A reported parameter and its *slopes* (n_parameter,) [its unit per parameter unit] over the fitted
    values.
    """

    parameter: Parameter
    slopes: FloatArray


def coefficients(fitted: FittedStiffness, vifs: FloatArray) -> tuple[Valued, ...]:
    """The estimated parameters with variance inflation factors (n_parameter,) [1], then those that a symmetry
    ties to them.
    """
    model = fitted.model
    names, covariances = model.names[: model.n_linear], (fitted.noise, fitted.whole)
    plain = plain_values(names, model.units, fitted.values, covariances, fitted.dof, vifs)
    shaped = [_shape(fitted, number, float(vifs[model.n_linear + number])) for number in range(model.n_shape)]
    return (*plain, *shaped, *(tied_element(valued) for valued in plain if model.symmetry == "seal"))


def plain_values(
    names: Sequence[str],
    units: Sequence[str],
    values: FloatArray,
    covariances: tuple[FloatArray, FloatArray],
    dof: int,
    vifs: FloatArray,
) -> list[Valued]:
    """Estimated *values* (n_parameter,) by name, with covariances by noise and in all (n_parameter,
    n_parameter) [their units] and variance inflation factors (n_parameter,) [1].
    """
    rows = zip(names, units, values, vifs, *(np.sqrt(np.diag(c)) for c in covariances), strict=False)
    parameters = [
        _wide(appraise(name, unit, float(value), float(noise), dof, float(vif)), float(noise), float(whole))
        for name, unit, value, vif, noise, whole in rows
    ]
    return [Valued(shown, row) for shown, row in zip(parameters, np.eye(values.size), strict=False)]


def _wide(parameter: Parameter, noise: float, whole: float) -> Parameter:
    return widen(parameter, whole / noise) if noise > 0 and whole > SAME * noise else parameter


def _shape(fitted: FittedStiffness, number: int, vif: float) -> Valued:
    declared, place = fitted.model.form.shape[number], fitted.model.n_linear + number
    inner, slope = float(fitted.values[place]), declared.slope(float(fitted.values[place]))
    noise, whole = (float(np.sqrt(matrix[place, place])) for matrix in (fitted.noise, fitted.whole))
    shape = appraise(declared.name, declared.unit, declared.show(inner), slope * noise, fitted.dof, vif)
    plain = _wide(shape, noise, whole)
    reach = fitted.limit * whole
    shown = replace(plain, ci95=_finite(declared.show(inner - reach), declared.show(inner + reach)))
    return Valued(shown, slope * np.eye(fitted.values.size)[place])


def _finite(low: float, high: float) -> tuple[float, float] | None:
    return (float(low), float(high)) if np.isfinite(low) and np.isfinite(high) else None


def tied_element(valued: Valued) -> Valued:
    """That which a seal's symmetry ties to an element: yy to xx, yx with the other sign to xy."""
    parameter = valued.parameter
    parts = [{"xx": "yy", "xy": "yx"}.get(part, part) for part in parameter.name.split("_")]
    name = "_".join(parts)
    if "yy" in parts:
        return Valued(replace(parameter, name=name, derived=True), valued.slopes)
    interval = None if parameter.ci95 is None else (-parameter.ci95[1], -parameter.ci95[0])
    ratio = None if parameter.t_ratio is None else -parameter.t_ratio
    turned = replace(parameter, name=name, value=-parameter.value, ci95=interval, t_ratio=ratio, derived=True)
    return Valued(turned, -valued.slopes)


def derived_values(
    fitted: FittedStiffness, omega: FloatArray, shaft: Shaft
) -> tuple[tuple[Valued, ...], Whirl | None]:
    """Whirl, crossover and coefficients at the speed, as far as they exist, and the whirl itself. Omega
    (n_line,) [rad/s] of the fit.
    """
    full = fitted.model.symmetry != "direct" and fitted.model.form.name in FORMS_WITH_WHIRL
    turning = whirl(fitted.model, fitted.values, fitted.whole, fitted.limit) if full else None
    parts = [
        *_whirl_values(fitted, turning, shaft),
        *_crossover(fitted, omega, shaft),
        *_synchronous(fitted, omega, shaft),
    ]
    return tuple(parts), turning


def _whirl_values(fitted: FittedStiffness, turning: Whirl | None, shaft: Shaft) -> list[Valued]:
    if turning is None or turning.square <= 0 or not shaft.speed:
        return []
    speed = 2 * np.pi * abs(shaft.speed)
    ratio = float(np.sqrt(turning.square)) / speed
    slopes = turning.slopes / (2 * ratio * speed**2)
    low, high = (float(np.sqrt(max(end, 0.0)) / speed) for end in turning.interval)
    values = [_derive(fitted, "whirl_frequency_ratio", "1", ratio, slopes, _finite(low, high))]
    if shaft.rotor_mass is not None and turning.stiffness > 0:
        values.append(_onset(fitted, turning, shaft, ratio, slopes))
    return values


def _onset(
    fitted: FittedStiffness, turning: Whirl, shaft: Shaft, ratio: float, ratio_slopes: FloatArray
) -> Valued:
    """Speed [Hz] W = sqrt(k / m) / WFR of whirl of a rotor, k in series with its shaft."""
    mass = shaft.rotor_mass
    assert mass is not None
    softer = 1 + turning.stiffness / shaft.rotor_stiffness if shaft.rotor_stiffness else 1.0
    value = float(np.sqrt(turning.stiffness / softer / mass.value) / ratio / (2 * np.pi))
    slopes = value * (turning.stiffness_slopes / (2 * turning.stiffness * softer) - ratio_slopes / ratio)
    of_mass = value * mass.std_error / (2 * mass.value)
    reach = fitted.limit * np.hypot(fitted.error(slopes, whole=True), of_mass) / value
    interval = _finite(value * np.exp(-reach), value * np.exp(reach))
    return _derive(fitted, "onset_speed", "Hz", value, slopes, interval, of_mass)


def _derive(
    fitted: FittedStiffness,
    name: str,
    unit: str,
    value: float,
    slopes: FloatArray,
    interval: tuple[float, float] | None,
    besides: float = 0.0,
) -> Valued:
    noise = fitted.error(slopes, whole=False)
    whole = float(np.hypot(fitted.error(slopes, whole=True), besides))
    inflated = whole if whole > SAME * noise else None
    plain = derive(name, unit, value, noise, fitted.dof)
    return Valued(replace(plain, ci95=interval, std_error_inflated=inflated), slopes)


def _crossover(fitted: FittedStiffness, omega: FloatArray, shaft: Shaft) -> list[Valued]:
    if fitted.model.symmetry == "direct":
        return []
    found_at = crossover(fitted.model, fitted.values, fitted.whole, omega, shaft.sense, fitted.limit)
    if found_at is None:
        return []
    turn = 2 * np.pi
    value, slopes, (low, high) = found_at.omega / turn, found_at.slopes / turn, found_at.interval
    return [_derive(fitted, "crossover_frequency", "Hz", value, slopes, _finite(low / turn, high / turn))]


def _synchronous(fitted: FittedStiffness, omega: FloatArray, shaft: Shaft) -> list[Valued]:
    """Re H and Im H / W at the shaft's speed W, where it lies in the band and H is not K and C."""
    if not shaft.speed or fitted.model.form.name == "kc":
        return []
    speed = 2 * np.pi * abs(shaft.speed)
    if not omega[0] <= speed <= omega[-1]:
        return []
    at, model = np.array([speed]), fitted.model
    h, slopes = model.stiffness(fitted.values, at)[0], model.jacobian(fitted.values, at)[:, 0]
    values = []
    for letter, unit, factor in (("k", STIFFNESS, 1.0), ("c", DAMPING, 1 / (1j * speed))):
        for i, j in np.ndindex(2, 2):
            if model.symmetry == "direct" and i != j:
                continue
            value, change = float((factor * h[i, j]).real), (factor * slopes[:, i, j]).real
            reach = fitted.limit * fitted.error(change, whole=True)
            name, ends = f"{letter}_{'xy'[i]}{'xy'[j]}_synchronous", _finite(value - reach, value + reach)
            values.append(_derive(fitted, name, unit, value, change, ends))
    return values


LETTERS = "kcm"


def dimensionless(
    coefficients: Sequence[Valued], section: DynamicStiffnessSettings, load: float | None, speed: float | None
) -> tuple[Valued, ...]:
    """k_xx_dimensionless ... and the Sommerfeld number, as far as what they need is given; *load* [N] and
    *speed* [Hz] of either sign. Equation (ds-dimensionless).
    """
    if not section.clearance or not load or not speed:
        return ()
    clearance, load, speed = section.clearance, abs(load), abs(speed)
    scaled = [
        _scale(valued, clearance / load * (2 * np.pi * speed) ** LETTERS.index(letter))
        for valued in coefficients
        if (letter := valued.parameter.name.split("_")[0]) in LETTERS
        and len(valued.parameter.name) == len("k_xx")
    ]
    if section.viscosity is None or section.length is None or section.diameter is None:
        return tuple(scaled)
    number = section.viscosity * speed * section.length * section.diameter / load
    number *= (section.diameter / (2 * clearance)) ** 2
    sommerfeld = Parameter("sommerfeld", number, "1", derived=True)
    return (*scaled, Valued(sommerfeld, np.zeros_like(coefficients[0].slopes)))


def _scale(valued: Valued, factor: float) -> Valued:
    parameter = valued.parameter
    low, high = parameter.ci95 or (np.nan, np.nan)
    errors = {
        name: factor * error
        for name in ("std_error", "std_error_inflated")
        if (error := getattr(parameter, name)) is not None
    }
    scaled = replace(
        parameter,
        name=f"{parameter.name}_dimensionless",
        value=factor * parameter.value,
        unit="1",
        ci95=_finite(factor * low, factor * high),
        vif=None,
        derived=True,
        **errors,
    )
    return Valued(scaled, factor * valued.slopes)


# Share of a variance below which an independent error is not listed by itself and stays with the noise.
UNSEEN = 1e-3


def add_budget(
    valued: Sequence[Valued], uncertainties: Sequence[GivenUncertainty], dof: int
) -> tuple[tuple[Parameter, ...], Budget | None]:
    """The parameters with their systematic part, which may be zero, and the budget; none without
    uncertainties.
    """
    parameters = tuple(quantity.parameter for quantity in valued)
    slopes = np.stack([quantity.slopes for quantity in valued])
    whole = np.array([parameter.full_error or np.nan for parameter in parameters])
    sources, changes = [], []
    for uncertainty in uncertainties:
        for number, row in enumerate(uncertainty.changes, start=1):
            change, alone = slopes @ row, len(uncertainty.changes) == 1
            if alone or np.nanmax(change**2 / whole**2) > UNSEEN:
                name = uncertainty.source if alone else f"{uncertainty.source} ({number})"
                sources.append(Uncertainty(name, uncertainty.std_error, uncertainty.unit))
                changes.append(change)
    if not sources:
        return parameters, None
    systematic = np.sqrt(np.sum(np.square(changes), axis=0))
    random = np.sqrt(np.maximum(whole**2 - systematic**2, 0.0))
    budget = Budget(tuple(p.name for p in parameters), random, float(dof), tuple(sources), np.array(changes))
    stated = tuple(
        p if p.full_error is None else replace(p, systematic=float(size))
        for p, size in zip(parameters, systematic, strict=True)
    )
    return stated, budget


def balance_fit(
    settings: FitSettings,
    best: Any,
    gof: Goodness,
    amplification: FloatArray | None,
    parameters: Sequence[Parameter],
    band: tuple[float, float],
    n_line: int,
    remedy: Callable[[Sequence[str]], str],
) -> Fit:
    """A minimum of a balance as a fit, with the findings that all fits have; amplification (n_parameter,)
    [parameter units]. Without convergence its parameters have no uncertainty.
    """
    stated = statistics.Estimate(
        values=best.values,
        covariance=best.covariance,
        scaled_design=best.design,
        gof=gof,
        dof=best.dof,
        converged=best.converged,
        iterations=best.steps,
        amplification=amplification,
    )
    if not best.converged:
        parameters = [replace(shown.without_interval, systematic=None) for shown in parameters]
    warnings = estimate_findings(stated, best.model.names, n_line, best.model.units, remedy)
    fit = reported_fit(settings, stated, tuple(parameters), band, n_line)
    return replace(fit, findings=(*warnings, *goodness_findings(gof)))

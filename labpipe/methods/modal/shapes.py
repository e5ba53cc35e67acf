"""What people read of refined modes: frequencies, damping, shapes, and stiffness and mass where a mass or a
driving point is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.estimation.statistics import correlation, derived, widened
from labpipe.methods.modal.likelihood import Refined, ResidualTerms
from labpipe.methods.modal.poles import damping_ratio, similarity
from labpipe.records.finding import Parameter
from labpipe.records.fit_details import Modes, StabilisationDiagram
from labpipe.records.response import Port


def shape_record(
    refined: Refined,
    terms: ResidualTerms,
    points: Sequence[Port],
    references: Sequence[Port],
    forces_move: bool,
    diagram: StabilisationDiagram | None,
) -> Modes:
    """The record of the modes in ascending frequency, every shape 1 at its largest point."""
    order = np.argsort(np.abs(refined.poles))
    poles, raw, participation = refined.poles[order], refined.shapes[:, order], refined.participation[order]
    scale = raw[np.argmax(np.abs(raw), axis=0), np.arange(order.size)]
    shapes = raw / scale
    variance = np.einsum("omm->om", refined.shape_covariance)
    std = np.sqrt(variance[:, 0::2] + variance[:, 1::2])[:, order]
    return Modes(
        np.abs(poles) / (2 * np.pi),
        damping_ratio(poles),
        shapes=shapes,
        shape_std_errors=std / np.abs(scale),
        participation=participation,
        scale=scale,
        points=tuple(port.label for port in points),
        references=tuple(port.label for port in references),
        dofs=tuple(port.dof for port in points),
        forces_move=forces_move,
        mac=similarity(shapes.T, shapes.T),
        collinearity=phase_collinearity(shapes),
        lower=terms.lower,
        upper=terms.upper,
        diagram=diagram,
    )


def phase_collinearity(shapes: ComplexArray) -> FloatArray:
    """Modal phase collinearity (n_mode,) [1] of *shapes* (n_point, n_mode): 1 where all points move in one
    phase, 0 for no phase at all.

    ((S_xx - S_yy)^2 + 4 S_xy^2) / (S_xx + S_yy)^2 of real and imaginary part (Juang and Pappa 1985). Equation
    (modal-collinearity).
    """
    xx, yy = np.sum(shapes.real**2, axis=0), np.sum(shapes.imag**2, axis=0)
    xy = np.sum(shapes.real * shapes.imag, axis=0)
    return np.asarray(((xx - yy) ** 2 + 4 * xy**2) / (xx + yy) ** 2)


Function = Callable[[FloatArray], float]
# Of the pole x_0 + j x_1; with a loss factor its square is -w_n^2 (1 + j eta).
VISCOUS: tuple[tuple[str, str, Function], ...] = (
    ("f_n", "Hz", lambda x: float(np.hypot(x[0], x[1]) / (2 * np.pi))),
    ("zeta", "1", lambda x: float(-x[0] / np.hypot(x[0], x[1]))),
)
HYSTERETIC: tuple[tuple[str, str, Function], ...] = (
    ("f_n", "Hz", lambda x: float(np.sqrt(x[1] ** 2 - x[0] ** 2) / (2 * np.pi))),
    ("eta", "1", lambda x: float(-2 * x[0] * x[1] / (x[1] ** 2 - x[0] ** 2))),
)
# Relative step of the central differences of functions of pole and residue.
STEP = 1e-6


@dataclass(frozen=True)
class DrivingPoint:
    """An output and an input at the same place: their numbers in the FRF matrix, and its dof."""

    output: int
    input: int
    dof: str


def modal_parameters(
    refined: Refined, dof: int, mass: float | None, driving: Sequence[DrivingPoint], inflation: float | None
) -> tuple[Parameter, ...]:
    """f_n, zeta (eta) of every mode, ascending; then k, c with the given *mass* [kg], else m, k, c of the
    modes at a driving point.

    k = m w_n^2, c = 2 zeta w_n m. At the driving point of its largest residue the modal mass is that with the
    shape 1 there: the residue is R = 1 / (2 j w_d m) for a real mode, m = Re(1 / (2 j w_d R)) for any.
    Hysteretic modes have eta in place of zeta, no c, and m = Re(1 / (2 lambda R)). Equation
    (modal-loss-factor). *inflation*: factor on the standard errors where the residual exceeds the noise.
    Equation (modal-frequency).
    """
    weigh = _at_driving_point(refined.hysteretic) if mass is None else (lambda _: mass)
    functions: list[tuple[str, str, Function]] = []
    if (mass is not None or driving) and refined.hysteretic:
        functions = [("k", "N/m", lambda x: weigh(x) * float(x[1] ** 2 - x[0] ** 2))]
    elif mass is not None or driving:
        functions = [
            ("k", "N/m", lambda x: weigh(x) * float(x[0] ** 2 + x[1] ** 2)),
            ("c", "N.s/m", lambda x: -2 * weigh(x) * float(x[0])),
        ]
    if mass is None and driving:
        functions.insert(0, ("m", "kg", weigh))
    strongest = strongest_points(refined, driving)
    ordered = list(enumerate(_ascending(refined), start=1))
    main = [
        _value(refined, mode, None, f"{name}_{n}", unit, of, dof)
        for n, mode in ordered
        for name, unit, of in _of_pole(refined)
    ]
    rest = [
        _value(refined, mode, strongest[n - 1] if strongest else None, f"{name}_{n}", unit, of, dof)
        for n, mode in ordered
        for name, unit, of in functions
    ]
    parameters = [replace(parameter, derived=False) for parameter in main] + rest
    if not refined.converged:
        return tuple(replace(parameter, std_error=None, ci95=None) for parameter in parameters)
    if inflation is None:
        return tuple(parameters)
    return tuple(widened(parameter, inflation) for parameter in parameters)


def strongest_points(refined: Refined, driving: Sequence[DrivingPoint]) -> tuple[DrivingPoint, ...]:
    """For every mode, ascending, the driving point with its largest residue; none without driving points."""
    if not driving:
        return ()

    def size(place: DrivingPoint, mode: int) -> float:
        return float(abs(refined.shapes[place.output, mode] * refined.participation[mode, place.input]))

    return tuple(max(driving, key=lambda place: size(place, mode)) for mode in _ascending(refined))


def frequency_correlation(refined: Refined) -> FloatArray:
    """Correlation (2 n_mode, 2 n_mode) [1] of f_n_1, zeta_1, f_n_2, zeta_2 ..."""
    n = refined.poles.size
    slopes = np.zeros((2 * n, refined.covariance.shape[0]))
    for row, mode in enumerate(_ascending(refined)):
        values, _ = _pole_and_residue(refined, mode, None)
        for number, (_, _, function) in enumerate(_of_pole(refined)):
            slopes[2 * row + number, 2 * mode : 2 * mode + 2] = _gradient(function, values)
    return correlation(slopes @ refined.covariance @ slopes.T)


def _value(
    refined: Refined,
    mode: int,
    driving: DrivingPoint | None,
    name: str,
    unit: str,
    function: Function,
    dof: int,
) -> Parameter:
    """A function of pole and residue with its standard error."""
    values, covariance = _pole_and_residue(refined, mode, driving)
    gradient = _gradient(function, values)
    return derived(
        name, unit, function(values), float(np.sqrt(max(float(gradient @ covariance @ gradient), 0.0))), dof
    )


def _at_driving_point(hysteretic: bool) -> Function:
    """Modal mass [kg] of pole x_0 + j x_1 with residue (x_2 + j x_3)(x_4 + j x_5)."""

    def mass(x: FloatArray) -> float:
        residue = (x[2] + 1j * x[3]) * (x[4] + 1j * x[5])
        return float((1 / (2 * ((x[0] if hysteretic else 0.0) + 1j * x[1]) * residue)).real)

    return mass


def _of_pole(refined: Refined) -> tuple[tuple[str, str, Function], ...]:
    return HYSTERETIC if refined.hysteretic else VISCOUS


def _pole_and_residue(
    refined: Refined, mode: int, driving: DrivingPoint | None
) -> tuple[FloatArray, FloatArray]:
    """Re, Im of the pole, and of shape and participation at the driving point, (2,) or (6,), with their
    covariance.
    """
    pole = refined.poles[mode]
    at = [2 * mode, 2 * mode + 1]
    if driving is None:
        return np.array([pole.real, pole.imag]), refined.covariance[np.ix_(at, at)]
    psi, factor = refined.shapes[driving.output, mode], refined.participation[mode, driving.input]
    values = np.array([pole.real, pole.imag, psi.real, psi.imag, factor.real, factor.imag])
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = refined.covariance[np.ix_(at, at)]
    of_shape = refined.crossed[driving.output][at]
    covariance[2:4, 2:4] = refined.shape_covariance[driving.output][np.ix_(at, at)]
    covariance[2:4, :2], covariance[:2, 2:4] = of_shape[:, at], of_shape[:, at].T
    place = refined.place(mode, driving.input)
    if place is not None:
        free = [place, place + 1]
        covariance[4:, 4:] = refined.covariance[np.ix_(free, free)]
        covariance[4:, :2], covariance[:2, 4:] = (
            refined.covariance[np.ix_(free, at)],
            refined.covariance[np.ix_(at, free)],
        )
        covariance[2:4, 4:], covariance[4:, 2:4] = of_shape[:, free], of_shape[:, free].T
    return values, covariance


def _gradient(function: Function, x: FloatArray) -> FloatArray:
    """Central differences (n,) with a step relative to the pair (Re, Im) that a number belongs to."""
    slopes = np.empty(x.size)
    for number in range(x.size):
        pair = x[2 * (number // 2) : 2 * (number // 2) + 2]
        step = STEP * float(np.hypot(*pair))
        change = np.zeros(x.size)
        change[number] = step
        slopes[number] = (function(x + change) - function(x - change)) / (2 * step)
    return slopes


def _ascending(refined: Refined) -> list[int]:
    """Numbers of the modes in ascending natural frequency."""
    return sorted(range(refined.poles.size), key=lambda mode: float(abs(refined.poles[mode])))

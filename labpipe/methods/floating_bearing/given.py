"""What is given, not estimated: the stator's mass and the baseline (hoses, stingers), each with its
uncertainty and where that comes from.

F - M_s A - Z_b X_s = H D with the absolute motion X_s = -A / w^2 of the stator. To subtract Z_b from H
instead is wrong by Z_b X_r D^-1 as soon as the shaft moves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.estimation.causes import stated_findings
from labpipe.estimation.statistics import Pulls
from labpipe.methods.floating_bearing.forms import StiffnessModel
from labpipe.methods.floating_bearing.likelihood import Balance, Whitened, real_rows, times
from labpipe.methods.floating_bearing.stator import Stator
from labpipe.records.finding import Finding
from labpipe.records.fit_details import GivenUncertainty
from labpipe.records.uncertain import Uncertain, Uncertainty, uncertainty_of

MASS = "mass of the stator"

Respond = Callable[[ComplexArray], NDArray[Any]]


@dataclass(frozen=True)
class Baseline:
    """Dynamic stiffness of what holds the stator beside the bearing: values (n,) [parameter units] of a
    *model*, with *uncertainties*.
    """

    model: StiffnessModel
    values: FloatArray
    uncertainties: tuple[GivenUncertainty, ...]
    name: str = ""
    test: str = ""

    def stiffness(self, omega: FloatArray) -> ComplexArray:
        """Z_b (n_line, 2, 2) [N/m] at omega (n_line,) [rad/s]."""
        return self.model.stiffness(self.values, omega)


@dataclass(frozen=True)
class Given:
    """The given part of the balance. *absolute*: the model moves with the stator's absolute motion, as a
    baseline does.
    """

    mass: Uncertain | None = None
    baseline: Baseline | None = None
    absolute: bool = False

    @property
    def accelerated(self) -> bool:
        """Whether the balance needs accelerations."""
        return self.mass is not None or self.baseline is not None

    def side(self, omega: FloatArray) -> ComplexArray:
        """What stands before A in the force side: -M_s I + Z_b / w^2 (n_line, 2, 2) [kg].

        Equation (ds-balance).
        """
        mass = 0.0 if self.mass is None else self.mass.value
        side = np.broadcast_to(-mass * np.eye(2, dtype=np.complex128), (omega.size, 2, 2))
        return (
            side
            if self.baseline is None
            else side + self.baseline.stiffness(omega) / omega[:, None, None] ** 2
        )


def projection(stator: Stator, given: Given) -> ComplexArray:
    """(n_line, 4, 6) [SI units]: from [F; D; A] to [G; m]."""
    n_line = stator.omega.size
    matrix = np.zeros((n_line, 4, 6), np.complex128)
    matrix[:, :2, :2] = np.eye(2)
    absolute = np.asarray(stator.omega, float)[:, None, None] ** 2
    if stator.accelerated:
        matrix[:, :2, 4:] = given.side(stator.omega)
    elif given.accelerated:
        # Only where the displacement is the absolute motion itself: A = -w^2 D.
        matrix[:, :2, 2:4] = -absolute * given.side(stator.omega)
    if given.absolute and stator.accelerated:
        matrix[:, 2:, 4:] = -np.eye(2) / absolute
    else:
        matrix[:, 2:, 2:4] = np.eye(2)
    return matrix


def balance_of(stator: Stator, given: Given) -> Balance:
    """Force side and motion of the stator with what is given."""
    to_balance = projection(stator, given)[:, None]
    sides = (to_balance @ stator.axes[..., None])[..., 0]
    covariance = to_balance @ stator.axes_covariance @ to_balance.conj().swapaxes(-1, -2)
    return Balance(
        stator.omega,
        sides[..., :2],
        sides[..., 2:],
        covariance[..., :2, :2],
        covariance[..., 2:, :2],
        covariance[..., 2:, 2:],
    )


def smoothed_channels(stator: Stator, given: Given, stiffness: ComplexArray, state: Whitened) -> ComplexArray:
    """All channels (n_line, n_run, n_channel) [SI units] without the noise that the residual tells: z - C_z
    B^H S^-1 e.

    Equation (ds-smoothed).
    """
    to_balance = projection(stator, given) @ stator.to_axes
    rows = to_balance[:, :2] - stiffness @ to_balance[:, 2:]
    pulled = (rows.conj().swapaxes(-1, -2)[:, None] @ state.weighted()[..., None])[..., 0]
    return stator.channels - (stator.covariance @ pulled[..., None])[..., 0]


def given_errors(
    stator: Stator, given: Given, stiffness: ComplexArray, clean: ComplexArray
) -> list[tuple[Uncertainty, ComplexArray]]:
    """By source, the change of e [N] by one standard deviation of the given number, (n, n_line, n_run, 2) for
    n independent ones.

    stiffness (n_line, 2, 2) [N/m] of the model, *clean* (n_line, n_run, n_channel) [SI units] the channels
    with as little noise as may be.
    """
    axes = clean @ stator.to_axes.T
    omega = stator.omega[:, None, None]
    acceleration = axes[..., 4:] if stator.accelerated else -(omega**2) * axes[..., 2:4]
    errors: list[tuple[Uncertainty, ComplexArray]] = []
    if given.mass is not None and given.mass.std_error > 0:
        errors.append(
            (
                uncertainty_of(given.mass, mass_source(given.mass), "kg"),
                -given.mass.std_error * acceleration[None],
            )
        )
    if given.baseline is not None:
        slopes = given.baseline.model.jacobian(given.baseline.values, stator.omega) / omega**2
        by_value = times(slopes[:, :, None], acceleration)
        errors.extend(
            (
                Uncertainty(uncertainty.source, uncertainty.std_error, uncertainty.unit),
                np.tensordot(uncertainty.changes, by_value, 1),
            )
            for uncertainty in given.baseline.uncertainties
        )
    to_balance = projection(stator, given) @ stator.to_axes
    rows = (to_balance[:, :2] - stiffness @ to_balance[:, 2:])[:, None]
    for factor in stator.spectra.factors:
        error = omega**factor.power * (rows @ (clean @ factor.derivative.T)[..., None])[..., 0]
        if factor.std_error > 0 and np.any(error):
            errors.append(
                (Uncertainty(factor.source, factor.std_error, factor.unit), factor.std_error * error[None])
            )
    return joined(errors)


def joined(errors: Sequence[tuple[Uncertainty, ComplexArray]]) -> list[tuple[Uncertainty, ComplexArray]]:
    """Errors (..., n_line, n_run, n) [N] of one source added with their signs, each source once."""
    sources: dict[str, tuple[Uncertainty, ComplexArray]] = {}
    for uncertainty, error in errors:
        first, before = sources.get(uncertainty.source, (uncertainty, 0.0))
        sources[uncertainty.source] = (first, before + error)
    return list(sources.values())


def errors_by_given(
    stator: Stator, given: Given, model: StiffnessModel, values: FloatArray, state: Whitened
) -> ComplexArray:
    """All changes of e [N] by given numbers (n, n_line, n_run, 2), of whatever source, at values
    (n_parameter,) of a model.
    """
    stiffness = model.stiffness(values, stator.omega)
    errors = given_errors(stator, given, stiffness, smoothed_channels(stator, given, stiffness, state))
    return np.concatenate(
        [np.empty((0, *stator.channels.shape[:2], 2), np.complex128), *(error for _, error in errors)]
    )


def given_uncertainties(
    errors: Sequence[tuple[Uncertainty, ComplexArray]], respond: Respond
) -> tuple[GivenUncertainty, ...]:
    """What given numbers do to the estimates, by source; *respond*: (n, n_parameter) by changes of e (n,
    n_line, n_run, 2) [N].
    """
    return tuple(
        GivenUncertainty(
            uncertainty.source, respond(error), std_error=uncertainty.std_error, unit=uncertainty.unit
        )
        for uncertainty, error in errors
    )


def response_of(whiten: Respond, columns: FloatArray) -> Callable[[ComplexArray], FloatArray]:
    """dp = -(J^T J)^-1 J^T L^-1 de of the most likely estimates; *whiten*: L^-1 of forces, *columns* J
    (n_equation, n_parameter) [1/parameter unit]. Equation (ds-given).
    """
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    gain = -np.linalg.pinv(columns / scale) / scale[:, None]

    def respond(errors: ComplexArray) -> FloatArray:
        return np.asarray(real_rows(whiten(errors).reshape(len(errors), -1)) @ gain.T)

    return respond


def mass_source(mass: Uncertain) -> str:
    """The same number with the same uncertainty is the same error, in whichever fit it stands."""
    return f"{MASS}, {mass.value:g} kg +- {mass.std_error:g} kg"


def contradictions(
    given: Given, uncertainties: Sequence[GivenUncertainty], pulls: Pulls
) -> tuple[tuple[GivenUncertainty, ...], tuple[Finding, ...]]:
    """The uncertainties, of numbers that the data contradict as large as the distance to what they ask for,
    and the findings that name these numbers.

    pulls: of all independent errors of all sources, one after the other.
    """
    sources = [
        Uncertainty(uncertainty.source, uncertainty.std_error, uncertainty.unit)
        for uncertainty in uncertainties
        for _ in uncertainty.changes
    ]
    ends = np.cumsum([len(uncertainty.changes) for uncertainty in uncertainties])[:-1]
    widened = tuple(
        replace(uncertainty, changes=uncertainty.changes * factors[:, None])
        for uncertainty, factors in zip(uncertainties, np.split(pulls.factors, ends), strict=True)
    )
    values = {} if given.mass is None else {mass_source(given.mass): given.mass.value}
    return widened, tuple(stated_findings(sources, pulls, values))

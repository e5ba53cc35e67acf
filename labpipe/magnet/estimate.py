"""The most likely K_i and K_s, what noise leaves of them, and what the doubts of given numbers do to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.dynamic_stiffness.estimate import Noise, inverse_information
from labpipe.errors import FitError
from labpipe.identify.regression import triangle_of
from labpipe.magnet.balance import MagnetModel
from labpipe.magnet.likelihood import MagnetLikelihood, real_rows, start
from labpipe.magnet.rotor import Levitation
from labpipe.optimise.levenberg import minimise
from labpipe.records.doubt import Doubt
from labpipe.records.dynamic_stiffness import GivenDoubt

NEAR, MOST_STEPS = 1e-4, 60
# Relative noise below which a covariance is rounding.
NOISE_FREE = 1e-20


@dataclass(frozen=True)
class MagnetEstimate:
    """Values (n_parameter,), covariance by noise (n_parameter, n_parameter) [their units], 2 V corrected for an estimated covariance.

    design: triangle (n_parameter, n_parameter) [1] of the Jacobian with columns of length 1; doubts: what given numbers do.
    """

    model: MagnetModel
    values: FloatArray
    covariance: FloatArray
    squares: float
    dof: int
    p_value: float
    converged: bool
    steps: int
    design: FloatArray
    doubts: tuple[GivenDoubt, ...] = ()
    amplification: FloatArray | None = None

    @property
    def reduced(self) -> float:
        """Chi-square per degree of freedom, 1 if the model is right."""
        return self.squares / self.dof


def noise_of(rotor: Levitation) -> Noise:
    """How far the covariance of the channels is known, for as many equations as there are axes."""
    return Noise(rotor.spectra.covariance_dof, rotor.shared, rotor.shared_power, rotor.n_axis)


def magnet_estimate(rotor: Levitation, model: MagnetModel, given: Sequence[tuple[Doubt, FloatArray]] = ()) -> MagnetEstimate:
    """The most likely parameters; *given*: doubts of the mass matrix with its change (n, n) [kg] by one standard deviation.

    FitError for too few lines, a covariance from too few periods, channels without noise.
    """
    noise, n = noise_of(rotor), len(model.names)
    n_equation = 2 * rotor.omega.size * rotor.channels.shape[1] * rotor.n_axis
    if n_equation <= n:
        raise FitError(f"{n_equation} real equations cannot determine {n} parameters", hint="widen the band, or `coupling: direct`")
    _check_noise(rotor, noise)
    problem = MagnetLikelihood(rotor, model)
    try:
        best = minimise(problem, start(problem), NEAR, MOST_STEPS)
    except np.linalg.LinAlgError:
        raise FitError("the covariance of the channels is singular on a line", hint="leave out lines without noise") from None
    jacobian = problem.jacobian(best.values)
    dof = n_equation - n
    squares = 2 * problem.chi2(best.values) / noise.excess
    doubts = _doubts(problem, best.values, jacobian, given)
    squares -= _explained(problem, best.values, jacobian, doubts, given, noise.excess) if doubts else 0.0
    information = inverse_information(jacobian)
    return MagnetEstimate(
        model=model,
        values=best.values,
        covariance=noise.inflation * information,
        squares=squares,
        dof=dof,
        p_value=noise.p_value(squares, dof),
        converged=best.converged,
        steps=best.steps,
        design=triangle_of(jacobian),
        doubts=doubts,
        amplification=problem.size * np.sqrt(2 * np.diag(information)),
    )


def _check_noise(rotor: Levitation, noise: Noise) -> None:
    variance = np.einsum("lrcc->lrc", rotor.covariance).real
    if np.sum(variance) <= NOISE_FREE * np.sum(np.abs(rotor.channels) ** 2):
        raise FitError("the noise of the channels is not known, so ml cannot weigh them", hint="measure several periods or blocks")
    if noise.dof <= noise.least_dof:
        raise FitError(
            f"the covariance of the channels was estimated from {noise.dof:.3g} degrees of freedom only",
            hint="average more periods or blocks, or let neighbouring lines share their noise",
        )


def errors_by_given(
    problem: MagnetLikelihood, values: FloatArray, given: Sequence[tuple[Doubt, FloatArray]]
) -> list[tuple[Doubt, ComplexArray]]:
    """Changes (n_line, n_run, n) [N] of the residual by one standard deviation of every given number, each source once.

    The mass, and numbers of the rig that stand in sums of channels or calibrate them.
    """
    rotor, model = problem.rotor, problem.model
    smoothed = problem.at(values).smoothed
    axes = smoothed @ rotor.to_axes.T
    rows = model.rows(values, rotor.omega)
    errors = []
    for doubt, change in given:
        changed = model.rows(values, rotor.omega, model.mass + change) - rows
        errors.append((doubt, (changed[:, None] @ axes[..., None])[..., 0]))
    to_balance, w = (rows @ rotor.to_axes)[:, None], rotor.omega[:, None, None]
    for factor in rotor.spectra.factors:
        error = w**factor.power * (to_balance @ (smoothed @ factor.derivative.T)[..., None])[..., 0]
        if factor.std_error > 0 and np.any(error):
            errors.append((Doubt(factor.source, factor.std_error, factor.unit), factor.std_error * error))
    sources: dict[str, tuple[Doubt, ComplexArray]] = {}
    for doubt, error in errors:
        source = sources.get(doubt.source)
        sources[doubt.source] = (doubt, error) if source is None else (source[0], source[1] + error)
    return list(sources.values())


def _doubts(
    problem: MagnetLikelihood, values: FloatArray, jacobian: FloatArray, given: Sequence[tuple[Doubt, FloatArray]]
) -> tuple[GivenDoubt, ...]:
    """dp = -J^+ L^-1 de of every source."""
    state = problem.at(values)
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    gain = -np.linalg.pinv(jacobian / scale) / scale[:, None]
    doubts = []
    for doubt, error in errors_by_given(problem, values, given):
        changes = real_rows(state.whiten(error).reshape(1, -1)) @ gain.T
        doubts.append(GivenDoubt(doubt.source, changes, std_error=doubt.std_error, unit=doubt.unit))
    return tuple(doubts)


def _explained(
    problem: MagnetLikelihood,
    values: FloatArray,
    jacobian: FloatArray,
    doubts: Sequence[GivenDoubt],
    given: Sequence[tuple[Doubt, FloatArray]],
    excess: float,
) -> float:
    """What chi-square loses if given numbers take their most likely values, each standard deviation of theirs counting as one."""
    state = problem.at(values)
    white = np.stack([state.whiten(error).reshape(-1) for _, error in errors_by_given(problem, values, given)])
    changes = real_rows(white)
    # What the parameters can follow is theirs already.
    changes = changes + np.concatenate([doubt.changes for doubt in doubts]) @ jacobian.T
    along = 2 * changes @ problem.residual(values) / excess
    stiff = np.eye(len(changes)) + 2 * changes @ changes.T / excess
    return float(excess * along @ np.linalg.solve(stiff, along))

"""What a force balance states where its residual is not noise: a covariance that includes the model error.

Beside noise they hold courses of discrepancy of three types: a force of its own on every axis of every run
(another force, other modes), the gain of every channel, and an error of every element of the dynamic
stiffness (its law).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.estimation.coefficient_error import CoefficientError, Patterns, averaged_error
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.floating_bearing.likelihood import Balance, ErrorsInVariables, Estimate, Noise, times
from labpipe.records.finding import Discrepancy, Finding, Parameter


@dataclass(frozen=True)
class BalanceMisfit:
    """A balance whose residual is not noise, on omega (n_line,) [rad/s]; *larger*: what the covariance of the
    noise counts more for being estimated [1].

    white (n_line, n_run, n_axis) [1]: the residual over its noise; whiten: forces (..., n_line, n_run,
    n_axis) [N] over it. added, slopes: from values to the forces that they add to those at the minimum, and
    to the slopes of these (n, n_line, n_run, n_axis) [N per parameter unit]. motion (n_line, n_run, n_axis)
    [m]; size (n_axis,) [N]: r.m.s. force of each axis; gains (n_channel, n_line, n_run, n_axis) [N]: what
    every channel adds to the balance.
    """

    names: tuple[str, ...]
    values: FloatArray
    omega: FloatArray
    white: ComplexArray
    whiten: Callable[[ComplexArray], ComplexArray]
    added: Callable[[FloatArray], ComplexArray]
    slopes: Callable[[FloatArray], ComplexArray]
    motion: ComplexArray
    size: FloatArray
    gains: ComplexArray
    larger: float

    def linearised(self, at: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Whitened residual (n_line, n_equation) [1] and what takes it away, (n_line, n_equation, n)."""
        residual = (self.white - self.whiten(self.added(at))) / np.sqrt(self.larger)
        return residual.reshape(self.omega.size, -1), self._white(self.slopes(at))

    def patterns(self) -> Patterns:
        """Whitened b (n_line, n_equation, n_pattern) [1] of the three types."""
        n_run, n = self.motion.shape[1:]
        alone = np.zeros((n_run * n, *self.motion.shape), np.complex128)
        laws = np.zeros((n * n, *self.motion.shape), np.complex128)
        moved = np.sqrt(np.mean(np.abs(self.motion) ** 2, axis=(0, 1)))
        for a in range(n):
            for run in range(n_run):
                alone[run * n + a, :, run, a] = self.size[a]
            for b in range(n):
                laws[a * n + b, :, :, a] = self.size[a] * self.motion[..., b] / moved[b]
        return {"a": self._white(alone), "m": self._white(self.gains), "z": self._white(laws)}

    def _white(self, forces: ComplexArray) -> ComplexArray:
        white = self.whiten(forces) / np.sqrt(self.larger)
        return np.moveaxis(white.reshape(len(forces), self.omega.size, -1), 0, -1)


@dataclass(frozen=True)
class BalanceError:
    """Covariance (n, n) [parameter units] of noise and of what the model leaves unexplained, which is named
    as *error*, else counts as noise.
    """

    covariance: FloatArray
    error: CoefficientError | None = None
    finding: tuple[Finding, ...] = ()

    @property
    def discrepancy(self) -> Discrepancy | None:
        """Shares of what explains the residual."""
        return None if self.error is None else self.error.discrepancy

    def named(self, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
        """The parameters with the reason for the width of their intervals."""
        if self.error is None:
            return tuple(parameters)
        return tuple(
            replace(p, reason=self.error.reason, discrepancy=self.discrepancy, fitted=p.value)
            if p.std_error
            else p
            for p in parameters
        )


def balance_error(
    covariance: FloatArray, reduced: float, p_value: float, misfit: BalanceMisfit, cause: str, cure: str
) -> BalanceError:
    """The covariance of an estimate where chi-square speaks against its model, averaged over model errors.

    *covariance* (n, n) [parameter units] by noise, *reduced* chi-square per degree of freedom [1], p_value.
    *cause*, *cure*: what is usually wrong, and what to do. Equation (unc-coefficients).
    """
    if p_value >= MISMATCH_P:
        return BalanceError(covariance)
    factor = float(np.sqrt(reduced))
    said = (
        f"the residual is {factor:.3g} times what the measured noise explains (chi-square per degree of "
        f"freedom {reduced:.3g}, p = {p_value:.2g})"
    )
    error = averaged_error(misfit)
    if error is None:
        width = (
            f"Standard errors are {factor:.3g} times those of noise alone, since the excess counts as noise"
        )
        finding = Finding("model-mismatch", f"{said}: {cause}. {width}. {cure}")
        return BalanceError(factor**2 * covariance, None, (finding,))
    # The value stays that of the fit, which others can repeat; its distance to the average is an error.
    away = error.mean - misfit.values
    whole = error.covariance + np.outer(away, away)
    growth = float(np.sqrt(np.max(np.diag(whole) / np.diag(covariance))))
    finding = Finding(
        "model-mismatch",
        f"{said}; most likely {error.reason}: {cause}. Intervals include what the model leaves unexplained, "
        f"and are up to {growth:.3g} times as wide as noise alone makes them. {cure}",
    )
    return BalanceError(whole, error, (finding,))


def stator_error(best: Estimate, balance: Balance, noise: Noise) -> BalanceError:
    """The covariance of noise and, where the form is not the course, of what it leaves unexplained."""
    model, omega = best.model, balance.omega
    h, state = model.stiffness(best.values, omega), ErrorsInVariables(balance, model).at(best.values)
    motion = state.smoothed
    gains = np.zeros((4, *motion.shape), np.complex128)
    for axis in (0, 1):
        gains[2 + axis] = h[:, None, :, axis] * motion[..., axis, None]
    for axis in (0, 1):
        gains[axis, ..., axis] = -gains[2:, ..., axis].sum(axis=0)
    misfit = BalanceMisfit(
        names=model.names,
        values=best.values,
        omega=omega,
        white=state.white,
        whiten=state.whiten,
        added=lambda at: times((model.stiffness(at, omega) - h)[:, None], motion),
        slopes=lambda at: times(model.jacobian(at, omega)[:, :, None], motion),
        motion=motion,
        size=np.sqrt(np.mean(np.abs(balance.right) ** 2, axis=(0, 1))),
        gains=gains,
        larger=noise.inflation,
    )
    cause = (
        f"form {best.model.form.name} is not the course over frequency, the bearing is not linear at this "
        "amplitude, or a channel is wrong"
    )
    return balance_error(
        best.covariance,
        best.reduced,
        best.p_value,
        misfit,
        cause,
        "Hold forms against each other with `compare: true`, or narrow the band",
    )

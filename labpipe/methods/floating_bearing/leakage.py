"""Leakage of random data in the balance of a floating stator: the stiffness that finite blocks show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.estimation.diagnostics import ENOUGH_LINES, FEWEST_LINES, rounded_up
from labpipe.estimation.leakage import Leakage
from labpipe.methods.floating_bearing.given import Given
from labpipe.methods.floating_bearing.likelihood import Balance, times
from labpipe.methods.floating_bearing.stator import ONE_DIRECTION, Stator
from labpipe.records.finding import Finding
from labpipe.spectra.windows import has_kernel, kernel_of

# H (n_line, 2, 2) [N/m] at omega (n_line,) [rad/s].
Stiffness = Callable[[FloatArray], ComplexArray]
# Frequencies at which the resonance of the stator is looked for.
N_SOUGHT = 20_000


@dataclass(frozen=True)
class SmearedBalance:
    """What blocks of random data do to the balance of a *stator* with what is *given*; *leakage* of the lines
    of the fit.

    ratio (n_line, 2, 2) [1/s^2]: acceleration per motion of the model, at the lines.
    """

    stator: Stator
    given: Given
    leakage: Leakage
    ratio: ComplexArray

    @property
    def by_acceleration(self) -> bool:
        """Whether the motion of the model is that of the accelerometers over -w^2."""
        return self.given.absolute and self.stator.accelerated

    def motion_per_force(self, stiffness: Stiffness, omega: FloatArray, ratio: ComplexArray) -> ComplexArray:
        """(H - side * ratio)^-1 (n, 2, 2) [m/N] at omega (n,) [rad/s]; *ratio* (n, 2, 2) [1/s^2] there."""
        return np.asarray(np.linalg.inv(stiffness(omega) - self.given.side(omega) @ ratio))

    def shown(self, stiffness: Stiffness) -> ComplexArray:
        """The dynamic stiffness (n_line, 2, 2) [N/m] that the averages over blocks show of H.

        Equation (ds-smeared).
        """
        omega, place = self.leakage.grid
        lines = self.stator.omega
        at = omega[place]
        weights = self.leakage.kernel.weights
        squared = (at / lines[:, None]) ** 2
        n_line, n_point = place.shape
        flat = at.ravel()
        ratio = (self.ratio[:, None] * squared[..., None, None]).reshape(-1, 2, 2)
        motion = self.motion_per_force(stiffness, flat, ratio)
        side = np.repeat(self.given.side(lines), n_point, axis=0) - self.given.side(flat)
        forces = (stiffness(flat) @ motion + side @ ratio @ motion).reshape(n_line, n_point, 2, 2)
        moved = motion.reshape(n_line, n_point, 2, 2)
        seen = squared if self.by_acceleration else np.ones_like(squared)
        mean_force = np.einsum("p,lpij->lij", weights, forces)
        return np.asarray(mean_force @ np.linalg.inv(np.einsum("p,lp,lpij->lij", weights, seen, moved)))

    def corrected(self, balance: Balance, stiffness: Stiffness) -> Balance:
        """The balance whose force side is without what leaks by the model's own H."""
        leaked = self.shown(stiffness) - stiffness(balance.omega)
        return replace(balance, right=balance.right - times(leaked[:, None], balance.motion))

    def finding(self, stiffness: Stiffness, modelled: bool) -> tuple[Finding, ...]:
        """A warning where the blocks are too short for the resonance of the stator in the band; *modelled*:
        what leaks is part of the fit.
        """
        lines = self.stator.omega
        omega = np.linspace(lines[0], lines[-1], N_SOUGHT)
        every = np.arange(lines.size)
        ratio = np.array(
            [[np.interp(omega, lines, self.ratio[every, i, j].real) for j in range(2)] for i in range(2)]
        ).transpose(2, 0, 1)
        motion = self.motion_per_force(stiffness, omega, ratio.astype(np.complex128))
        widths = [
            half_power
            for axis in range(2)
            if (half_power := _half_power(omega, np.abs(motion[:, axis, axis]))) is not None
        ]
        if not widths:
            return ()
        frequency, width = min(widths, key=lambda half_power: half_power[1])
        length = self.leakage.kernel.blocks.length
        enough = FEWEST_LINES if modelled else ENOUGH_LINES
        if length * width >= enough:
            return ()
        why = (
            "its damping comes from the window's leakage more than from the measurement"
            if modelled
            else "it shifts stiffness and damping, which no standard error shows"
        )
        cure = "" if modelled else ", or the estimator ml, which takes the leakage into the model"
        message = (
            f"the stator's resonance at {frequency:.4g} Hz is {width:.2g} Hz wide (half power), "
            f"{length * width:.2g} lines of blocks of {length:.3g} s: {why}; use blocks of at least "
            f"{rounded_up(enough / width):g} s{cure}"
        )
        return (Finding("leakage", message),)


def _half_power(omega: FloatArray, size: FloatArray) -> tuple[float, float] | None:
    """Frequency and half-power width [Hz] of the highest maximum of *size* (n,) at omega (n,) [rad/s]."""
    top = int(np.argmax(size))
    below = np.flatnonzero(size < size[top] / np.sqrt(2))
    before, after = below[below < top], below[below > top]
    if not before.size or not after.size:
        return None
    return float(omega[top] / (2 * np.pi)), float((omega[after[0]] - omega[before[-1]]) / (2 * np.pi))


def smeared_balance(stator: Stator, given: Given, balance: Balance) -> SmearedBalance | None:
    """What leaks into the balance."""
    blocks = stator.spectra.blocks
    if blocks is None or not has_kernel(blocks):
        return None
    numbers = np.round(stator.omega / (2 * np.pi) * blocks.length).astype(np.intp)
    leakage = Leakage(kernel_of(blocks), numbers, np.empty(0), 0)
    ratio = np.asarray(-(stator.omega**2)[:, None, None] * np.eye(2), np.complex128)
    if not given.absolute and stator.accelerated and balance.motion.shape[1] > 1:
        # The shaft moves too: acceleration per motion against it, where both runs tell it.
        motion = balance.motion.swapaxes(-1, -2)
        tells = np.linalg.cond(motion) < ONE_DIRECTION
        ratio[tells] = stator.axes[tells, :, 4:].swapaxes(-1, -2) @ np.linalg.pinv(motion[tells])
    return SmearedBalance(stator, given, leakage, ratio)

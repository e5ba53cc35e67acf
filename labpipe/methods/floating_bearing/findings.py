"""Findings, notes and curves of a floating-bearing fit.

Beside noise they hold courses of discrepancy of three types: a force of its own on every axis of every run
(another force, other modes), the gain of every channel, and an error of every element of the dynamic
stiffness (its law).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import per_cent
from labpipe.estimation.coefficient_error import CoefficientError, Patterns, averaged_error
from labpipe.estimation.diagnostics import MISMATCH_P, excess_text
from labpipe.estimation.mismatch import FEWEST_LINES, line_alone
from labpipe.methods.floating_bearing.likelihood import Balance, ErrorsInVariables, Noise, Optimum, times
from labpipe.methods.floating_bearing.settings import Given
from labpipe.methods.floating_bearing.stator import Stator, shown_stiffness
from labpipe.methods.floating_bearing.values import FittedStiffness, Whirl, effective
from labpipe.records.finding import Discrepancy, Finding, Parameter, note
from labpipe.records.fit_details import DynamicStiffness, GivenUncertainty

N_DRAWN = 60


def shown_course(
    balance: Balance,
    fit: FittedStiffness,
    uncertainties: tuple[GivenUncertainty, ...],
    given: Given,
    sense: float,
) -> DynamicStiffness:
    """The record of a fit for figures and for later fits that take it as their baseline."""
    lines, variance = shown_stiffness(balance, fit.model.stiffness(fit.values, balance.omega))
    omega = np.linspace(balance.omega[0], balance.omega[-1], N_DRAWN)
    course = effective(fit.model, fit.values, fit.whole, omega, sense)

    def ends(value: np.ndarray, error: np.ndarray) -> np.ndarray:
        return np.stack([value, value - fit.limit * error, value + fit.limit * error], axis=-1)

    return DynamicStiffness(
        fit.model.form.name,
        fit.model.symmetry,
        fit.values,
        fit.noise,
        uncertainties,
        frequency=lines.omega / (2 * np.pi),
        measured=lines.stiffness,
        variance=variance,
        paired=lines.paired,
        drawn_frequency=omega / (2 * np.pi),
        fitted=fit.model.stiffness(fit.values, omega),
        effective_stiffness=ends(course.stiffness, course.stiffness_error),
        effective_damping=ends(course.damping, course.damping_error),
        baseline=None if given.baseline is None else given.baseline.stiffness(omega),
        bands=fit.model.form.bands,
        absolute=given.absolute,
    )


# Ends of the names of coefficients: force in the first direction per motion in the second.
AXES = ("xx", "xy", "yx", "yy")
# Standard errors of noise beyond which the shaft is said to move, and the share of the relative motion from
# which it matters.
SEEN, MOVES = 3.0, 0.002
AGAINST = "the motion of the stator against it (accelerations against displacements)"
# Motion of the shaft from which displacements may be turned (1.1 deg), the share of it that is left then, and
# how near to an axis [deg] a turn is one of signs or names.
TURNED, LEFT, ALONG = 0.02, 0.25, 10.0
# Standard deviations of chi-square below its mean beyond which the residual is too small.
SURE = 5.0
# Share of the standard error of noise below which an error has cancelled against that of the baseline.
CANCELS = 1e-6
CANCELLED = "nothing, since the baseline was measured with the same number and takes its error back"
# Loss of the standard errors to few degrees of freedom beyond which it is said.
LOSS = 1.1


def remedy(group: Sequence[str]) -> str:
    """What separates the parameters of a collinear group: forces of another pattern, where both directions of
    the motion are in it.
    """
    ends = [name.partition("_")[2][:2] for name in group]
    if len({end[1] for end in ends if end in AXES}) > 1:
        return (
            "let the forces act in two ways, since x and y move in proportion here: a recording with the "
            "force in x and one in y, two with both of one sign and of opposite signs, or one with every "
            "other line in x and in y (zipper); or set fewer coefficients free, `symmetry: seal`"
        )
    return (
        "widen the band, so that K and -w^2 M differ in their course over it, or fit a form with fewer "
        "coefficients, `form: kc`"
    )


def noise_findings(fit: Optimum, noise: Noise) -> tuple[Finding, ...]:
    """Notes where the intervals hold but are wider than the data would allow: scatter that is not noise, few
    periods.
    """
    findings = few_averages(noise)
    if fit.reduced < 1 - SURE * noise.spread(fit.dof):
        message = (
            f"the residual is only {np.sqrt(fit.reduced):.2g} times what the scatter of the channels would "
            "leave: something that differs from period to period and averages out, such as runout of a "
            "turning shaft under a probe, counts as noise, and the intervals are too wide. Take it out with "
            "`frf: {remove: {speed: ..., harmonics: 2}}`"
        )
        findings = (note("scatter-not-noise", message), *findings)
    return findings


def few_averages(noise: Noise) -> tuple[Finding, ...]:
    if noise.loss < LOSS:
        return ()
    message = (
        f"the covariance of the channels has {noise.dof:.3g} degrees of freedom: standard errors are "
        f"{noise.loss:.3g} times those with a known one. Average more periods, or let neighbouring lines "
        "share their noise"
    )
    return (note("few-averages", message),)


def shaft_motion(stator: Stator) -> tuple[float, float] | None:
    """Motion of the shaft X_r = -A / w^2 - D over the relative motion, r.m.s. over all lines by their noise,
    and how many standard errors it is [1].
    """
    if not stator.accelerated or not np.any(stator.to_axes[2:4]):
        return None
    absolute = stator.omega[:, None, None] ** 2
    axes = stator.axes
    relative = axes[..., 2:4]
    shaft = -axes[..., 4:] / absolute - relative
    to_shaft = np.zeros((stator.omega.size, 2, 6))
    to_shaft[:, :, 2:4], to_shaft[:, :, 4:] = -np.eye(2), -np.eye(2) / absolute
    covariance = to_shaft[:, None] @ stator.axes_covariance @ to_shaft.swapaxes(-1, -2)[:, None]
    # -A / w^2 is noisier the lower the line: every line and run counts by its own noise.
    noise = np.trace(covariance, axis1=-2, axis2=-1).real
    weight = 1 / np.maximum(noise, np.finfo(float).tiny)
    size = np.sum(np.abs(shaft) ** 2, axis=-1)
    dof = stator.spectra.covariance_dof
    excess = float(np.sum(weight * size)) - noise.size * (dof / (dof - 1) if np.isfinite(dof) else 1.0)
    # |X|^2 of complex noise of covariance C has the variance tr C^2; lines share noise, and its estimate.
    square = np.sum(np.abs(covariance) ** 2, axis=(-2, -1)) * weight**2
    lines = stator.omega.size
    shared = stator.noise.shared_power * (1 + 1 / dof if np.isfinite(dof) else 1.0)
    spread = float(np.sqrt(shared * np.sum(square) + noise.size**2 / min(dof * lines, 1e300)))
    relatively = float(np.sum(weight * np.sum(np.abs(relative) ** 2, axis=-1)))
    return float(np.sqrt(max(excess, 0.0) / relatively)), excess / spread


def motion_findings(stator: Stator, given: Given) -> tuple[Finding, ...]:
    """How far the shaft moves: a note where the accelerations take care of it, a warning where nothing
    does.
    """
    moved = shaft_motion(stator)
    if moved is None or moved[1] < SEEN or moved[0] < MOVES:
        return ()
    if moved[0] > TURNED and (turned := turned_displacements(stator, moved[0])) is not None:
        return (turned,)
    share = f"{per_cent(moved[0])} of {AGAINST}"
    if given.accelerated or effective_forces(stator):
        what = (
            f"the shaft moves by {share}; the balance is of the stator, so that no coefficient is wrong by it"
        )
        return (note("shaft-moves", what),)
    message = (
        f"the shaft moves by {share}, and the inertia of the stator is not taken out of the forces: mass and "
        "stiffness are wrong. Give `stator_mass`, or forces less mass times acceleration as derived channels"
    )
    return (Finding("shaft-moves", message),)


def turned_displacements(stator: Stator, moved: float) -> Finding | None:
    """A warning where the displacements stand turned or mirrored against the accelerations: by the orthogonal
    Q that brings D next to X_s = -A / w^2 (Procrustes problem, Schoenemann 1966), nothing is left of the most
    of the motion *moved* [1] of the shaft. Equation (floating-turned).

    A shaft that moves follows the film's force G H D, whose course over frequency no Q has.
    """
    axes = stator.axes
    absolute, relative = -axes[..., 4:] / stator.omega[:, None, None] ** 2, axes[..., 2:4]
    # Every line counts alike: amplitudes fall by decades over the band.
    sizes = np.sum(np.abs(absolute) ** 2 + np.abs(relative) ** 2, axis=(1, 2))
    left, _, right = np.linalg.svd(np.einsum("lri,lrj,l->ij", absolute, relative.conj(), 1 / sizes).real)
    turn = left @ right
    rows = np.vstack([stator.to_axes[:2], turn @ stator.to_axes[2:4], stator.to_axes[4:]])
    after = shaft_motion(replace(stator, to_axes=rows))
    if after is None or after[0] > LEFT * moved:
        return None
    angle = float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
    if np.linalg.det(turn) > 0:
        what, cure = f"turned by {angle:.3g} deg", "add that to their `dof`"
        if abs(angle) > 180 - ALONG:
            cure = "`invert: true` for both, or for both accelerations"
    else:
        what, cure = (
            f"mirrored about the axis at {round(angle / 2) % 180} deg",
            "compare `dof` with the wiring",
        )
        if abs(angle) < ALONG or abs(angle) > 180 - ALONG:
            cure = f"`invert: true` for the one along {'y' if abs(angle) < ALONG else 'x'}"
        elif abs(angle - 90) < ALONG:
            cure = "the channels of x and y are swapped"
    message = (
        f"the displacements stand {what} against the accelerations: with that the shaft moves by "
        f"{per_cent(after[0])} of {AGAINST}, in place of {per_cent(moved)}. Coefficients are wrong by "
        f"it; {cure}"
    )
    return Finding("shaft-moves", message)


def effective_forces(stator: Stator) -> bool:
    """Whether the forces are sums that hold accelerations already."""
    channels = stator.spectra.channels
    accelerations = {channels[number].name for number in stator.spectra.columns("acceleration")}
    forces = np.flatnonzero(np.any(stator.to_axes[:2], axis=0))
    return any(term.channel in accelerations for number in forces for term in channels[number].terms)


def notes_on_given(
    given: Given, uncertainties: tuple[GivenUncertainty, ...], fit: FittedStiffness
) -> tuple[str, ...]:
    """Which given numbers the intervals hold, and how much of the variance is theirs."""
    if not uncertainties:
        pairs = (("the mass of the stator", given.mass), ("the baseline", given.baseline))
        numbers = [name for name, number in pairs if number is not None]
        if not numbers:
            return ()
        stated = f"{' and '.join(numbers)} {'counts' if len(numbers) == 1 else 'count'} as exact"
        return (f"dynamic-stiffness: {stated}: give the uncertainty where there is one (60 kg +- 0.6 kg).",)
    variance, lines = np.maximum(np.diag(fit.noise), np.finfo(float).tiny), []
    for uncertainty in uncertainties:
        share = np.sqrt(np.sum(uncertainty.changes**2, axis=0) / variance)
        most, size = int(np.argmax(share)), CANCELLED
        if share[most] > CANCELS:
            size = f"{share[most]:.2g} times the standard error of noise in {fit.model.names[most]}"
        lines.append(f"{uncertainty.source}: {size}")
    return (
        "dynamic-stiffness: the intervals hold the uncertainty of given numbers, common to all lines and "
        f"runs. {'; '.join(lines)}.",
    )


def whirl_findings(turning: Whirl | None, speed: float | None) -> tuple[Finding, ...]:
    """In words where there is no whirl, or where it cannot be told from none."""
    if turning is None or not speed:
        return ()
    per_speed = (2 * np.pi * speed) ** 2
    square, (low, high) = turning.square / per_speed, (end / per_speed for end in turning.interval)
    if square > 0 and low > 0:
        return ()
    what, ends = (
        "the whirl frequency ratio cannot be told from zero: its square is",
        f"{low:.3g} to {high:.3g}",
    )
    if square > 0:
        return (note("no-whirl", f"{what} {square:.3g}, 95 % {ends}"),)
    message = (
        f"there is no whirl: the square of the whirl frequency ratio is {square:.3g} (95 % {ends}). The "
        "cross-coupled stiffness does not drive a forward or backward whirl at any frequency"
    )
    return (note("no-whirl", message),)


def physical_findings(parameters: tuple[Parameter, ...]) -> tuple[Finding, ...]:
    """A warning for direct damping or added mass that is negative beyond its uncertainty."""
    judged = ("c_xx", "c_yy", "m_xx", "m_yy")
    wrong = [p.name for p in parameters if p.name in judged and not p.derived and p.is_negative]
    if not wrong:
        return ()
    what = f"{', '.join(wrong)} {'is' if len(wrong) == 1 else 'are'} negative"
    check = "check the signs of the channels, the stator's mass, the baseline and the band"
    return (Finding("unphysical", f"{what}; {check}"),)


@dataclass(frozen=True)
class BalanceMisfit:
    """A balance whose residual is not noise, on omega (n_line,) [rad/s]; *larger*: what the covariance of the
    noise counts more for being estimated [1]. white (n_line, n_run, n_axis) [1]: the residual over its noise;
    whiten: forces (..., n_line, n_run, n_axis) [N] over it. added, slopes: from values to the forces that
    they add to those at the minimum, and to the slopes of these (n, n_line, n_run, n_axis) [N per parameter
    unit]. motion (n_line, n_run, n_axis) [m]; size (n_axis,) [N]: r.m.s. force of each axis; gains
    (n_channel, n_line, n_run, n_axis) [N]: what every channel adds to the balance.
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

    def linearise(self, at: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Whitened residual (n_line, n_equation) [1] and what takes it away, (n_line, n_equation, n)."""
        residual = (self.white - self.whiten(self.added(at))) / np.sqrt(self.larger)
        return residual.reshape(self.omega.size, -1), self._white(self.slopes(at))

    def patterns(self) -> Patterns:
        """Whitened b (n_line, n_equation, n_pattern) [1] of the three types."""
        n_run, n = self.motion.shape[1:]
        alone = np.zeros((n_run, n, *self.motion.shape), np.complex128)
        laws = np.zeros((n, n, *self.motion.shape), np.complex128)
        moved = self.motion / np.sqrt(np.mean(np.abs(self.motion) ** 2, axis=(0, 1)))
        for a, size in enumerate(self.size):
            for run in range(n_run):
                alone[run, a, :, run, a] = size
            laws[a, :, :, :, a] = size * np.moveaxis(moved, -1, 0)
        alone, laws = (part.reshape(-1, *self.motion.shape) for part in (alone, laws))
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

    def name_reason(self, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
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
    excess = excess_text(reduced, p_value)
    error = averaged_error(misfit)
    if error is None:
        width = f"Standard errors are {factor:.3g} times those of noise alone"
        message = f"{excess}: {cause}. {width}, since the excess counts as noise. {cure}"
        return BalanceError(factor**2 * covariance, None, (Finding("model-mismatch", message),))
    # The value stays that of the fit, which others can repeat; its distance to the average is an error.
    away = error.mean - misfit.values
    whole = error.covariance + np.outer(away, away)
    growth = float(np.sqrt(np.max(np.diag(whole) / np.diag(covariance))))
    cause_text = f"; most likely {error.reason}: {cause}"
    if (frequency := _line_alone(misfit, reduced)) is not None:
        alone, cure = line_alone(frequency)
        cause_text = f", and {alone}"
    finding = Finding(
        "model-mismatch",
        f"{excess}{cause_text}. Intervals include what the model leaves "
        f"unexplained, and are up to {growth:.3g} times as wide as noise alone makes them. {cure}",
        line_hz=frequency,
    )
    return BalanceError(whole, error, (finding,))


def _line_alone(misfit: BalanceMisfit, reduced: float) -> float | None:
    """The only line [Hz] without which chi-square, *reduced* per degree of freedom, speaks for the model, by
    one step of the fit to the others.
    """
    residual, slopes = misfit.linearise(misfit.values)
    squares = np.sum(np.abs(residual) ** 2, axis=1)
    line, n_line = int(np.argmax(squares)), squares.size
    if n_line <= FEWEST_LINES:
        return None
    others = np.arange(n_line) != line
    e, j = residual[others].ravel(), slopes[others].reshape(-1, slopes.shape[-1])
    e, j = np.concatenate([e.real, e.imag]), np.concatenate([j.real, j.imag])
    left = np.sum((e - j @ np.linalg.lstsq(j, e)[0]) ** 2) / squares.sum()
    dof = e.size - misfit.values.size
    alone = chi2.sf(reduced * left * (2 * residual.size - misfit.values.size), dof) >= MISMATCH_P
    return float(misfit.omega[line] / (2 * np.pi)) if alone else None


def stator_error(best: Optimum, balance: Balance, noise: Noise) -> BalanceError:
    """The covariance of noise and, where the form is not the course, of what it leaves unexplained."""
    model, omega = best.model, balance.omega
    h, state = model.stiffness(best.values, omega), ErrorsInVariables(balance, model).at(best.values)
    motion = state.smoothed
    gains = np.zeros((4, *motion.shape), np.complex128)
    gains[2:] = np.einsum("lij,lrj->jlri", h, motion)
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
    cure = "Compare forms with `compare: true`, or narrow the band"
    return balance_error(best.covariance, best.reduced, best.p_value, misfit, cause, cure)

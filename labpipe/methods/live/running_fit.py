"""A fit that follows the averages of a running test, with intervals that hold at the moment of stopping.

The equation of motion e = B F - Z X of one average is linear in the coefficients; its weighted squares have
an exact gradient, and a warm start needs few Gauss-Newton steps per average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.distributions import f_tail
from labpipe.estimation.model import Equation
from labpipe.records.finding import Finding
from labpipe.spectra import impact, windows
from labpipe.spectra.covariance import noise_shape
from labpipe.spectra.period_average import neighbourhood_mean

# Lines to either side over which the scatter is averaged: it makes the first averages usable.
HALF_WIDTH = 7
# Gauss-Newton steps from a cold start, and from the estimate before.
COLD, WARM = 25, 4
# Rounds of reweighted least squares that bring a cold start inside the bandwidth of every mode.
REWEIGHTED = 6
# A fit is judged from so many averages on, and with so many degrees of freedom: before, the scale that the
# stopping rule looks at is too uncertain for its expansion.
LEAST_AVERAGES, LEAST_DOF = 3, 20.0
# Probability of chi-square beyond which no precision is claimed from noise alone.
MISFIT_P = 1e-3
# Determinant-free bound on what cannot be told apart: condition of the scaled information.
SINGULAR = 1e10


def moving_mean(values: NDArray[Any]) -> NDArray[Any]:
    """Mean over lines l - h ... l + h of *values* (n_line, ...) [any unit], the window cut at the ends."""
    return neighbourhood_mean(values, np.ones(values.shape[0], bool), HALF_WIDTH)


class PeriodSums:
    """Running mean and scatter of the amplitudes z = [X; F] of equal averages, by Welford's algorithm."""

    def __init__(self) -> None:
        self.n = 0
        self.mean, self._scatter = (np.zeros(1, np.complex128) for _ in range(2))

    def add(self, z: ComplexArray, sign: int = 1) -> None:
        """The average *z* (n_line, n_experiment, n_channel) [channels' units]; *sign* -1 takes it out."""
        self.n += sign
        here = z - self.mean
        self.mean = self.mean + sign * here / self.n
        self._scatter = self._scatter + sign * here[..., :, None] * (z - self.mean)[..., None, :].conj()

    def covariance(self) -> ComplexArray:
        """Of the mean, over neighbouring lines, (n_line, n_experiment, n_channel, n_channel) [units^2];
        relative to the course of a channel's motion where its noise follows that, as in a run.
        """
        variance = np.einsum("lecc->lec", self._scatter).real
        flat = variance.reshape(len(variance), -1), self.mean.reshape(len(variance), -1, 1)
        root = np.sqrt(noise_shape(*flat, 1 / (self.n - 1), HALF_WIDTH)).reshape(variance.shape)
        scale = root[..., :, None] * root[..., None, :]
        return np.asarray(moving_mean(self._scatter / scale) * scale / ((self.n - 1) * self.n))


@dataclass(frozen=True)
class ForceLines:
    """Which *lines* (n_line,) of an average a fit has, and the *scale* (n_line,) [1] of squared forces there:
    that of a sensor's response. *shapes* (n_line, n) [1] of noise under a force window, none where these are
    too many; None without a window.
    """

    lines: IntArray
    scale: FloatArray
    shapes: ComplexArray | None = None


class HitSums:
    """Sums of products of hits or blocks with one force: H = S_xf / S_ff, the noise on the responses.

    An average counts by the energy of its force. The mean is [H; 1], its covariance that of H; *force_power*
    (n_line, n_experiment) [squared force unit]: the sum of |F|^2 over the averages. Noise of the force is
    taken off H as in a run, where it makes H low; within a force window hits are aligned as in a run.
    """

    def __init__(self, at: ForceLines | None = None) -> None:
        self.n, self._at, self._windowed = 0, at, at is not None and at.shapes is not None
        self._xf = self._xx = np.zeros(1, np.complex128)
        self.force_power = self._noise = np.zeros(1)
        # Averages under a force window, and their sums once they are aligned.
        self._hits: list[ComplexArray] = []
        self._low: tuple[FloatArray, float] | None = None
        self._aligned: HitSums | None = None

    def add(self, z: ComplexArray, sign: int = 1) -> None:
        """Take *z* (n_line, n_experiment, n_channel) [channels' units], the force last, in, or out (-1)."""
        x, f = z[..., :-1], z[..., -1]
        self.n += sign
        self._xf = self._xf + sign * x * f[..., None].conj()
        self.force_power = self.force_power + sign * np.abs(f) ** 2
        self._xx = self._xx + sign * x[..., :, None] * x[..., None, :].conj()
        if self._windowed and sign > 0:
            self._hits.append(z)
        elif self._windowed:
            self._hits = [hit for hit in self._hits if hit is not z]
        self._low = self._aligned = None

    def add_noise(self, power: FloatArray, sign: int = 1) -> None:
        """Of the force in an average, (n_line_of_average,) [squared force unit], likewise."""
        self._noise = self._noise + sign * power
        self._low = self._aligned = None

    def _error(self) -> tuple[FloatArray, float]:
        """Relative error (n_line,) [1] of H by noise of the force, and how many standard errors of a gain
        common to all lines that is.
        """
        if self._low is None and (self.n < 2 or not self._noise.any()):
            self._low = np.zeros(len(self.force_power)), 0.0
        elif self._low is None:
            noise = self._noise_power()
            error = impact.force_error(noise, self.force_power[:, 0], self.n, windowed=self._windowed)
            h = self._xf / self.force_power[..., None]
            weight = np.abs(h) ** 2 / np.einsum("leoo->leo", self._covariance(h)).real
            common = np.sum(error[:, None, None] * weight, axis=0) * np.sqrt(2 / np.sum(weight, axis=0))
            self._low = error, float(np.max(common))
        return self._low

    def _noise_power(self) -> FloatArray:
        """That of the force (n_line,) [squared force unit] over all averages."""
        noise = impact.noise_around(self._noise, self.n)
        return noise if self._at is None else noise[self._at.lines] * self._at.scale

    def _shapes(self) -> ComplexArray:
        """Amplitudes (n_line, n) [force unit] of the force's noise within the window of a hit, by independent
        numbers of variance 1; n of 0 where it does not count.
        """
        if self._at is None or self._at.shapes is None or self._error()[1] <= impact.MOST_COMMON:
            return np.empty((self.force_power.shape[0], 0), np.complex128)
        return np.asarray(np.sqrt(self._noise_power() / self.n)[:, None] * self._at.shapes)

    def common(self, hits: Sequence[ComplexArray] = ()) -> ComplexArray:
        """Errors of the mean [H; 1] of these *hits* (n_line, 1, n_channel), of all without any, that lines
        have in common, (n, n_line, 1, n_channel) [units of H], by noise of the force within its window, as of
        *force_courses*.
        """
        shapes, hits = self._shapes(), hits or self._hits
        if not shapes.shape[1]:
            return np.empty((0, *self.mean.shape), np.complex128)
        force = np.array(hits)[:, :, 0, -1]
        towards, power = np.sum(force, axis=0), np.sum(np.abs(force) ** 2, axis=0)
        size = np.maximum(np.abs(towards) * np.sqrt(power), np.finfo(float).tiny)
        changes = (-shapes * (towards.conj() / size)[:, None]).T[:, :, None, None] * self.mean
        changes[..., -1] = 0.0
        return changes

    def _without_window_noise(self) -> HitSums:
        """The sums of the hits as they are without noise of the force within their window, as in a run."""
        if self._aligned is None:
            shapes, self._aligned = self._shapes(), self
            if shapes.shape[1]:
                hits, h = np.array(self._hits), self._xf[:, 0] / self.force_power
                noise = np.einsum("leoo->lo", self._covariance(h[:, None])).real * self.force_power
                low = impact.force_error(self._noise_power(), self.force_power[:, 0], self.n, windowed=False)
                force, of = hits[:, :, 0, -1], (h / (1 - low)[:, None], noise, shapes)
                hits[:, :, 0, :-1], hits[:, :, 0, -1] = windows.without_window_noise(
                    hits[:, :, 0, :-1], force, *of
                )
                self._aligned = HitSums()
                for hit in hits:
                    self._aligned.add(hit)
        return self._aligned

    @property
    def _factor(self) -> FloatArray:
        """By which H is larger without noise of the force, (n_line,) [1]."""
        error, common = self._error()
        return 1 / (1 - error * (common > impact.MOST_COMMON and not self._windowed))

    @property
    def mean(self) -> ComplexArray:
        """[H; 1], (n_line, n_experiment, n_channel) [response units per force unit]."""
        sums = self._without_window_noise()
        h = sums._xf * (self._factor[:, None] / sums.force_power)[..., None]
        return np.pad(h, [(0, 0), (0, 0), (0, 1)], constant_values=1)

    def covariance(self) -> ComplexArray:
        """The same of [H; 1], (n_line, n_experiment, n_channel, n_channel) [squared units of H]. Noise of the
        force, or a force that is not recorded, makes it follow |H|^2, which changes within a few lines: it is
        smoothed over the likeliest 1 + rho |H|^2, rho of 0 where that is little better.
        """
        sums = self._without_window_noise()
        h = sums._covariance(sums._xf / sums.force_power[..., None]) * self._factor[:, None, None, None] ** 2
        return np.pad(h, [(0, 0), (0, 0), (0, 1), (0, 1)])

    def _covariance(self, h: ComplexArray) -> ComplexArray:
        power = self.force_power[..., None, None]
        noise = (self._xx - power * h[..., :, None] * h[..., None, :].conj()) / (self.n - 1)
        gain = np.abs(h) ** 2
        gain, plain = gain / gain.mean(axis=0), np.einsum("leoo->leo", noise).real
        courses = 1 + SHARES[:, None, None, None] * gain
        scale = np.maximum(np.mean(plain / courses, axis=1), np.finfo(float).tiny)
        misfit = (self.n - 1) * (len(gain) * np.log(scale) + np.sum(np.log(courses), axis=1))
        best = np.where(misfit.min(axis=0) < misfit[0] - SEEN, misfit.argmin(axis=0), 0)
        root = np.sqrt(1 + SHARES[best] * gain)
        root = root[..., :, None] * root[..., None, :]
        return np.asarray(moving_mean(noise / root) * root / power)

    def findings(self, fit: str) -> list[Finding]:
        """A warning, as of a run, of noise of the force that moves H."""
        error, common = self._error()
        what, hint = (
            (impact.IN_WINDOW, impact.COUNTED if self._shapes().shape[1] else impact.SHORTEN)
            if self._windowed
            else (impact.AFTER_HITS, f"{impact.TAKEN_OFF}; {impact.WINDOW}")
        )
        message = f"{fit}: noise of the force {what}"
        return [impact.force_noise(message, [(error, common)], hint)] if common > impact.MOST_COMMON else []


# Noise that follows |H|^2 over that which does not, in the mean of the lines; what the logarithm of their
# likelihood gains where there is some.
SHARES, SEEN = np.append(0.0, np.geomspace(1e-2, 1e3, 21)), 4.0
Sums = PeriodSums | HitSums


class Directions:
    """The sums of every direction that was shaken, one experiment each, once it has two averages."""

    def __init__(self, hits: bool, at: ForceLines | None = None) -> None:
        self._hits, self._at = hits, at
        self._sums: dict[int, Sums] = {}

    def of(self, direction: int) -> Sums:
        return self._sums.setdefault(direction, HitSums(self._at) if self._hits else PeriodSums())

    @property
    def shaken(self) -> dict[int, Sums]:
        """Those with two averages or more."""
        return {direction: sums for direction, sums in self._sums.items() if sums.n >= 2}

    @property
    def counts(self) -> IntArray:
        """Averages of each direction, (n_experiment,)."""
        return np.array([sums.n for sums in self.shaken.values()])

    @property
    def mean(self) -> ComplexArray:
        """(n_line, n_experiment, n_channel) [channels' units]."""
        return np.concatenate([sums.mean for sums in self.shaken.values()], axis=1)

    def findings(self, fit: str) -> list[Finding]:
        """What noise of the force does to the mean of hits."""
        return [f for sums in self.shaken.values() if isinstance(sums, HitSums) for f in sums.findings(fit)]

    def common(self) -> ComplexArray:
        """Errors of the mean that lines have in common, (n, n_line, n_experiment, n_channel) [its units]."""
        mean, every = self.mean, []
        for number, sums in enumerate(self.shaken.values()):
            if isinstance(sums, HitSums):
                errors = sums.common()
                every.append(np.zeros((len(errors), *mean.shape), np.complex128))
                every[-1][:, :, number] = errors[:, :, 0]
        return np.concatenate(every) if every else np.empty((0, *mean.shape), np.complex128)

    def covariance(self) -> ComplexArray:
        """Of the mean, (n_line, n_experiment, n_channel, n_channel) [products of the channels' units]."""
        return np.concatenate([sums.covariance() for sums in self.shaken.values()], axis=1)


@dataclass(frozen=True)
class RunningEstimate:
    """Where a running fit stands after *n* averages, the *least* in one direction.

    values, std_error, dof (n_parameter,) [parameter units]: of noise; reduced: chi-square per degree of
    freedom, *misfit* whether it speaks against the model; information and covariance (n_parameter,
    n_parameter), the latter of noise.
    """

    n: int
    least: int
    values: FloatArray
    std_error: FloatArray
    dof: FloatArray
    reduced: float
    misfit: bool
    identifiable: bool
    information: FloatArray
    covariance: FloatArray

    @property
    def judged(self) -> bool:
        """Whether there are enough averages for a stop by the width."""
        return self.least >= LEAST_AVERAGES and bool(np.all(self.dof >= LEAST_DOF))


class RunningFit:
    """The coefficients of one model by the sums of a running test."""

    def __init__(self, equation: Equation) -> None:
        self.equation = equation
        self.values: FloatArray | None = None

    def update(self, sums: Directions) -> RunningEstimate:
        """The estimate after the averages in *sums*, of which a direction has two."""
        mean, covariance = sums.mean, sums.covariance()
        cold = self.values is None
        start = self._cold(mean, covariance) if self.values is None else self.values
        self.values = self._descend(mean, covariance, start, COLD if cold else WARM)
        return self._judge(sums.counts, mean, covariance, self.values, sums.common())

    def parts(
        self, mean: ComplexArray, covariance: ComplexArray, values: FloatArray
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
        """Residual e (n_line, n_experiment, n_output) [N], the inverse of its covariance, their product, the
        slopes (n_line, n_experiment, n_output, n_parameter) [N per parameter unit] at the likeliest
        amplitudes, and the inverse times these.
        """
        residual, inverse, multiplier, spread = self._weight(mean, covariance, values)
        slopes = self.equation.slopes(mean - (spread @ multiplier[..., None])[..., 0])
        return residual, inverse, multiplier, slopes, inverse @ slopes

    def _weight(
        self, mean: ComplexArray, covariance: ComplexArray, values: FloatArray
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
        """The first three of the *parts*, and the covariance of amplitudes and residual."""
        gain = self.equation.gain(values)[:, None]
        residual = (gain @ mean[..., None])[..., 0]
        spread = covariance @ gain.conj().swapaxes(-1, -2)
        inverse = np.linalg.inv(gain @ spread)
        return residual, inverse, (inverse @ residual[..., None])[..., 0], spread

    def _cost(self, mean: ComplexArray, covariance: ComplexArray, values: FloatArray) -> float:
        residual, _, multiplier, _ = self._weight(mean, covariance, values)
        return float(np.sum((residual.conj() * multiplier).real))

    def _descend(
        self, mean: ComplexArray, covariance: ComplexArray, values: FloatArray, steps: int
    ) -> FloatArray:
        cost = self._cost(mean, covariance, values)
        for _ in range(steps):
            _, _, multiplier, slopes, weighted = self.parts(mean, covariance, values)
            information, gradient = normal_equations(slopes, weighted, multiplier)
            unit, scale = rescale(information)
            step = np.linalg.lstsq(unit, gradient / scale, rcond=1e-12)[0] / scale
            share = 1.0
            while share > 1e-3:
                trial = values - share * step
                trial_cost = self._cost(mean, covariance, trial)
                if trial_cost <= cost * (1 + 1e-12):
                    break
                share /= 2
            else:
                break
            values, moved = trial, cost - trial_cost
            cost = trial_cost
            if steps == COLD and moved < 1e-10 * cost and share == 1.0:
                break
        return values

    def _cold(self, mean: ComplexArray, covariance: ComplexArray) -> FloatArray:
        n_parameter = len(self.equation.model.names)
        slopes = self.equation.slopes(mean)
        # What the equation leaves without its coefficients, in which it is linear.
        side = (self.equation.gain(np.zeros(n_parameter))[:, None] @ mean[..., None])[..., 0]
        values = np.zeros(n_parameter)
        design, right = slopes, side
        for number in range(REWEIGHTED):
            if number:
                inverse = self._weight(mean, covariance, values)[1]
                weight = np.linalg.cholesky(inverse).conj().swapaxes(-1, -2)
                design, right = weight @ slopes, (weight @ side[..., None])[..., 0]
            rows = np.concatenate([part.reshape(-1, n_parameter) for part in (design.real, design.imag)])
            sides = np.concatenate([right.real.ravel(), right.imag.ravel()])
            size = np.linalg.norm(rows, axis=0)
            size[size == 0] = 1.0
            values = -np.linalg.lstsq(rows / size, sides, rcond=None)[0] / size
        return values

    def _judge(
        self,
        counts: IntArray,
        mean: ComplexArray,
        covariance: ComplexArray,
        values: FloatArray,
        common: ComplexArray,
    ) -> RunningEstimate:
        residual, weight, multiplier, slopes, weighted = self.parts(mean, covariance, values)
        # Errors that lines have in common are more unknowns, each of the size 1.
        moved = np.moveaxis((self.equation.gain(values)[:, None] @ common[..., None])[..., 0], 0, -1)
        both = np.concatenate([slopes, moved], axis=-1)
        of_both, pull = normal_equations(both, weight @ both, multiplier)
        n_parameter, n_output = values.size, self.equation.n_output
        information, beside = of_both[:n_parameter, :n_parameter], of_both[n_parameter:, :n_parameter]
        unit, scale = rescale(information)
        identifiable = bool(np.linalg.cond(unit) < SINGULAR)
        inverse = np.linalg.pinv(unit, hermitian=True) / np.outer(scale, scale)
        n, least = int(counts.sum()), int(counts.min())
        # Of the direction with the fewest averages, whose weights cost the most.
        smoothed = (least - 1) * (2 * HALF_WIDTH + 1)
        inflation = smoothed**2 / ((smoothed - n_output) ** 2 - 1)
        covariance_of_values = inflation * inverse
        shifts = beside @ inverse
        of_noise, of_common = np.diag(covariance_of_values), shifts.T @ shifts
        covariance_of_values = covariance_of_values + of_common
        std_error = np.sqrt(np.diag(covariance_of_values))
        shares = moving_mean(2 * np.sum(((slopes @ inverse).conj() * (weighted @ inverse)).real, axis=2))
        spread = np.sum(shares**2, axis=0) / (counts - 1)[:, None]
        dof = 2 * np.sum(shares, axis=(0, 1)) ** 2 / np.sum(spread, axis=0) * (std_error**2 / of_noise) ** 2
        if len(shifts):
            whole, size = rescale(inverse + of_common)
            information = np.linalg.pinv(whole, hermitian=True) / np.outer(size, size)
        freedom = 2 * residual.size - n_parameter
        chi2 = float(2 * np.sum((multiplier.conj() * residual).real))
        if len(shifts):
            left = of_both[n_parameter:, n_parameter:] - beside @ inverse @ beside.T + np.eye(len(shifts))
            pull = pull[n_parameter:] - shifts @ pull[:n_parameter]
            chi2 -= float(pull @ np.linalg.solve(left, pull))
        reduced = chi2 / freedom
        misfit = bool(f_tail(reduced, freedom, smoothed) < MISFIT_P)
        of_fit = (reduced, misfit, identifiable, information, covariance_of_values)
        return RunningEstimate(n, least, values, std_error, dof, *of_fit)


def rescale(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """An information (n_parameter, n_parameter) [1/unit^2] with the diagonal 1, and its scale [1/unit]."""
    scale = np.sqrt(np.diag(information))
    scale[scale == 0] = 1.0
    return information / np.outer(scale, scale), scale


def normal_equations(
    slopes: ComplexArray, weighted: ComplexArray, multiplier: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Information 2 Re J^H Lambda^-1 J (n_parameter, n_parameter) and gradient 2 Re J^H lambda [1/unit]."""
    flat, of = (np.reshape(part, (multiplier.size, slopes.shape[-1])) for part in (slopes, weighted))
    information = 2 * (flat.conj().T @ of).real
    return information, 2 * (flat.conj().T @ multiplier.reshape(-1)).real

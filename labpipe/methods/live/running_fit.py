"""A fit that follows the averages of a running test, with intervals that hold at the moment of stopping.

The equation of motion e = B F - Z X of one average is linear in the coefficients; its weighted squares have
an exact gradient, and a warm start needs few Gauss-Newton steps per average.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.distributions import f_tail
from labpipe.errors import DataError
from labpipe.estimation.model import Equation
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel
from labpipe.spectra import impact
from labpipe.spectra.bands import line_range
from labpipe.spectra.channels import Lags
from labpipe.spectra.covariance import noise_shape
from labpipe.spectra.period_average import neighbourhood_mean, samples_per_period
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.windows import force_window

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
    that of a sensor's response. *windowed*: under a force window.
    """

    lines: IntArray
    scale: FloatArray
    windowed: bool


class HitSums:
    """Sums of products of hits or blocks with one force: H = S_xf / S_ff, the noise on the responses.

    An average counts by the energy of its force. The mean is [H; 1], its covariance that of H; *force_power*
    (n_line, n_experiment) [squared force unit]: the sum of |F|^2 over the averages. Noise of the force is
    taken off H as in a run, where it makes H low.
    """

    def __init__(self, at: ForceLines | None = None) -> None:
        self.n, self._at, self._windowed = 0, at, at is not None and at.windowed
        self._xf = self._xx = np.zeros(1, np.complex128)
        self.force_power = self._noise = np.zeros(1)
        self._low: tuple[FloatArray, float] | None = None

    def add(self, z: ComplexArray, sign: int = 1) -> None:
        """Take *z* (n_line, n_experiment, n_channel) [channels' units], the force last, in, or out (-1)."""
        x, f = z[..., :-1], z[..., -1]
        self.n += sign
        self._xf = self._xf + sign * x * f[..., None].conj()
        self.force_power = self.force_power + sign * np.abs(f) ** 2
        self._xx = self._xx + sign * x[..., :, None] * x[..., None, :].conj()
        self._low = None

    def add_noise(self, power: FloatArray, sign: int = 1) -> None:
        """Of the force in an average, (n_line_of_average,) [squared force unit], likewise."""
        self._noise = self._noise + sign * power
        self._low = None

    def _error(self) -> tuple[FloatArray, float]:
        """Relative error (n_line,) [1] of H by noise of the force, and how many standard errors of a gain
        common to all lines that is.
        """
        if self._low is None and (self.n < 2 or not self._noise.any()):
            self._low = np.zeros(len(self.force_power)), 0.0
        elif self._low is None:
            noise = impact.noise_around(self._noise, self.n)
            noise = noise if self._at is None else noise[self._at.lines] * self._at.scale
            error = impact.force_error(noise, self.force_power[:, 0], self.n, windowed=self._windowed)
            h = self._xf / self.force_power[..., None]
            weight = np.abs(h) ** 2 / np.einsum("leoo->leo", self._covariance(h)).real
            common = np.sum(error[:, None, None] * weight, axis=0) * np.sqrt(2 / np.sum(weight, axis=0))
            self._low = error, float(np.max(common))
        return self._low

    @property
    def _factor(self) -> FloatArray:
        """By which H is larger without noise of the force, (n_line,) [1]."""
        error, common = self._error()
        return 1 / (1 - error * (common > impact.MOST_COMMON and not self._windowed))

    @property
    def mean(self) -> ComplexArray:
        """[H; 1], (n_line, n_experiment, n_channel) [response units per force unit]."""
        h = self._xf * (self._factor[:, None] / self.force_power)[..., None]
        return np.pad(h, [(0, 0), (0, 0), (0, 1)], constant_values=1)

    def covariance(self) -> ComplexArray:
        """The same of [H; 1], (n_line, n_experiment, n_channel, n_channel) [squared units of H]. Noise of the
        force, or a force that is not recorded, makes it follow |H|^2, which changes within a few lines: it is
        smoothed over the likeliest 1 + rho |H|^2, rho of 0 where that is little better.
        """
        h = self._covariance(self._xf / self.force_power[..., None]) * self._factor[:, None, None, None] ** 2
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
        (error, common), windowed = self._error(), self._at is not None and self._at.windowed
        what, hint = (
            (impact.IN_WINDOW, impact.SHORTEN)
            if windowed
            else (impact.AFTER_HITS, f"{impact.TAKEN_OFF}; {impact.WINDOW}")
        )
        message = f"{fit}: noise of the force {what}"
        return [impact.force_noise(message, error, common, hint)] if common > impact.MOST_COMMON else []


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

    def covariance(self) -> ComplexArray:
        """Of the mean, (n_line, n_experiment, n_channel, n_channel) [products of the channels' units]."""
        return np.concatenate([sums.covariance() for sums in self.shaken.values()], axis=1)


@dataclass(frozen=True)
class Estimate:
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

    def update(self, sums: Directions) -> Estimate:
        """The estimate after the averages in *sums*, of which a direction has two."""
        mean, covariance = sums.mean, sums.covariance()
        cold = self.values is None
        start = self._cold(mean, covariance) if self.values is None else self.values
        self.values = self._descend(mean, covariance, start, COLD if cold else WARM)
        return self._judge(sums.counts, mean, covariance, self.values)

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
            unit, scale = scaled(information)
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
        self, counts: IntArray, mean: ComplexArray, covariance: ComplexArray, values: FloatArray
    ) -> Estimate:
        residual, _, multiplier, slopes, weighted = self.parts(mean, covariance, values)
        information, _ = normal_equations(slopes, weighted, multiplier)
        n_parameter, n_output = values.size, self.equation.n_output
        unit, scale = scaled(information)
        identifiable = bool(np.linalg.cond(unit) < SINGULAR)
        inverse = np.linalg.pinv(unit, hermitian=True) / np.outer(scale, scale)
        n, least = int(counts.sum()), int(counts.min())
        # Of the direction with the fewest averages, whose weights cost the most.
        smoothed = (least - 1) * (2 * HALF_WIDTH + 1)
        inflation = smoothed**2 / ((smoothed - n_output) ** 2 - 1)
        covariance_of_values = inflation * inverse
        std_error = np.sqrt(np.diag(covariance_of_values))
        shares = moving_mean(2 * np.sum(((slopes @ inverse).conj() * (weighted @ inverse)).real, axis=2))
        spread = np.sum(shares**2, axis=0) / (counts - 1)[:, None]
        dof = 2 * np.sum(shares, axis=(0, 1)) ** 2 / np.sum(spread, axis=0)
        freedom = 2 * residual.size - n_parameter
        reduced = float(2 * np.sum((multiplier.conj() * residual).real) / freedom)
        misfit = bool(f_tail(reduced, freedom, smoothed) < MISFIT_P)
        of_fit = (reduced, misfit, identifiable, information, covariance_of_values)
        return Estimate(n, least, values, std_error, dof, *of_fit)


def scaled(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """An information (n_parameter, n_parameter) [1/unit^2] with the diagonal 1, and its scale [1/unit]."""
    scale = np.sqrt(np.diag(information))
    scale[scale == 0] = 1.0
    return information / np.outer(scale, scale), scale


def normal_equations(
    slopes: ComplexArray, weighted: ComplexArray, multiplier: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Information 2 Re J^H Lambda^-1 J (n_parameter, n_parameter) and gradient 2 Re J^H lambda [1/unit]."""
    n_parameter = slopes.shape[-1]
    flat = slopes.reshape(-1, n_parameter)
    information = 2 * (flat.conj().T @ weighted.reshape(-1, n_parameter)).real
    return information, 2 * (flat.conj().T @ multiplier.reshape(-1)).real


# Share of the cross spectrum of two forces that one delay explains where they are the same signal.
SAME_SIGNAL = 0.7
# Likeness of the proportions of two forces from which on they shake the same direction, and share of the
# largest one's amplitude with which a force acts.
SAME_FORCES, ACTS = 0.8, 0.1
# Least growth of the energy of a force that begins to shake its direction.
GROWN = 4.0
# A first hit stands out of the noise before it by so many times its rms.
FIRST_HIT = 20.0
# Hits below this share of the usual one tell little.
WEAK = 0.1


@dataclass(frozen=True)
class Average:
    """One period or hit: *amplitude* (n_line, n_channel) [units of channels] on the lines, its first sample
    *start*, *number* from 1, the *fault* for which it is left out, and its *peaks* (n_channel,) [SI]. *noise*
    (n_line,) [squared unit of the force] of the force in a hit; *direction*: number of that of its forces.
    """

    number: int
    start: int
    amplitude: ComplexArray
    peaks: FloatArray
    fault: str = ""
    noise: FloatArray | None = None
    direction: int = 0


class _Cutter:
    """Cuts calibrated blocks into averages; *frequency* (n_line,) [Hz] of their lines."""

    def __init__(
        self, channels: tuple[Channel, ...], sample_rate: float, n_sample: int, settings: FrfSettings
    ) -> None:
        self.channels, self.sample_rate, self.n_sample = channels, sample_rate, n_sample
        self._forces = [number for number, channel in enumerate(channels) if channel.role == "input"]
        self._lines = line_range(n_sample, sample_rate, settings.band)
        self.frequency = np.arange(self._lines.start, self._lines.stop) * (sample_rate / n_sample)
        self._number = 0

    def _average(
        self, start: int, samples: FloatArray, peaks: FloatArray, spectrum_of: FloatArray, fault: str
    ) -> Average:
        """The average of *samples* (n_sample, n_channel) [SI], by those of *spectrum_of*, ready for it."""
        there = np.isfinite(samples).all(axis=0)
        if not there.all():
            fault = f"no number in channel '{self.channels[int(np.argmin(there))].name}'"
        whole = fft.rfft(spectrum_of.T, axis=1)[:, self._lines].T * (2 / self.n_sample)
        return Average(self._number, start, np.asarray(whole), peaks, fault)


class PeriodCutter(_Cutter):
    """Whole periods, the transient ones dropped at the start of each recording, and where another direction
    is shaken after several periods of one.
    """

    def __init__(self, channels: tuple[Channel, ...], sample_rate: float, settings: FrfSettings) -> None:
        assert settings.period is not None
        super().__init__(channels, sample_rate, samples_per_period(settings.period, sample_rate), settings)
        self._skip = self._left = settings.skip
        self._rest, self._begin = np.empty((0, len(channels))), 0
        # Energies of the forces in the last period, and for how many the strongest has been the same.
        self._energies: FloatArray = np.zeros(len(self._forces))
        self._alike = 0
        # The first forces of each direction, and what turns those of the present recording to their phases.
        self._first: dict[int, ComplexArray] = {}
        self._turns: dict[int, ComplexArray] = {}

    def restart(self) -> None:
        """The samples that follow belong to another recording: what is not complete is lost."""
        self._begin, self._rest = self._begin + self._rest.shape[0], self._rest[:0]
        self._left, self._turns = self._skip, {}

    def add(self, block: FloatArray) -> Iterator[Average]:
        """The averages that the next samples (n, n_channel) [SI] complete."""
        self._rest = np.concatenate([self._rest, block])
        while self._rest.shape[0] >= self.n_sample:
            period, start = self._rest[: self.n_sample], self._begin
            self._rest, self._begin = self._rest[self.n_sample :], self._begin + self.n_sample
            moved = np.nan_to_num(period - np.nan_to_num(period.mean(axis=0)))
            if self._turned(np.sum(moved[:, self._forces] ** 2, axis=0)):
                self._left = self._skip
            if self._left:
                self._left -= 1
                continue
            self._number += 1
            yield self._turn(self._average(start, period, np.max(np.abs(moved), axis=0), moved, ""))

    def _turned(self, energies: FloatArray) -> bool:
        """Whether another force than in several periods before is the strongest now, and grew to be it; by
        their *energies* (n_force,) [squared SI].
        """
        strongest = int(np.argmax(energies))
        same = strongest == int(np.argmax(self._energies))
        turned = self._alike > 1 and not same and energies[strongest] > GROWN * self._energies[strongest]
        self._energies, self._alike = energies, self._alike + 1 if same else 1
        return bool(turned)

    def _direction(self, forces: ComplexArray) -> int:
        """The number of the direction whose *forces* (n_line, n_force) were in the same proportion to each
        other, line by line, at first; of hardly any force the nearest, of another proportion a new one.
        """
        likeness = {
            number: np.sum(np.abs(np.sum(first * forces.conj(), axis=1)))
            / max(np.linalg.norm(first, axis=1) @ np.linalg.norm(forces, axis=1), np.finfo(float).tiny)
            for number, first in self._first.items()
        }
        nearest = max(likeness, key=likeness.__getitem__, default=0)
        weak = any(np.linalg.norm(forces) < ACTS * np.linalg.norm(first) for first in self._first.values())
        return nearest if weak or likeness.get(nearest, 0.0) > SAME_FORCES else len(likeness)

    def _turn(self, average: Average) -> Average:
        """A period by its direction, turned to the phases that the forces of this had first: a recording that
        was begun anew begins elsewhere in the period. exp(-j w tau) by the delay tau of the cross-correlation
        of the forces; line by line where these are other phases.
        """
        forces = average.amplitude[:, self._forces]
        direction = self._direction(forces)
        if self._first.setdefault(direction, forces) is forces or not forces.any():
            self._turns[direction] = np.ones(len(forces), np.complex128)
        if direction not in self._turns:
            cross = np.sum(self._first[direction] * forces.conj(), axis=1)
            delay = np.argmax(fft.irfft(np.pad(cross, (self._lines.start, 0)), self.n_sample))
            w, size = 2 * np.pi * self.frequency / self.sample_rate, np.abs(cross)
            rest = np.angle(cross * np.exp(1j * w * delay))
            turn = np.exp(-1j * w * (delay - np.sum(size * w * rest) / np.sum(size * w**2)))
            alike = np.sum((cross * turn.conj()).real) > SAME_SIGNAL * np.sum(size)
            self._turns[direction] = turn if alike else np.exp(1j * np.angle(cross))
        turned = average.amplitude * self._turns[direction][:, None]
        return replace(average, amplitude=turned, direction=direction)


class HitCutter(_Cutter):
    """Hits of one hammer, sought as they come: by the noise before the first, then by the hits so far."""

    def __init__(self, channels: tuple[Channel, ...], sample_rate: float, settings: FrfSettings) -> None:
        assert settings.block is not None
        # As in a run: of a late channel the block holds the hit, too.
        self._lags = Lags(channels, sample_rate)
        super().__init__(self._lags.channels, sample_rate, round(settings.block * sample_rate), settings)
        if len(self._forces) != 1:
            what = f"hits need one force, the rig has {len(self._forces)}"
            raise DataError(what, hint="one hammer per recording")
        self._force, self._impact = self._forces[0], settings.impact
        self._before = round(self._impact.pretrigger * self.n_sample)
        self._search = impact.HitSearch(self._force, self.n_sample, self._before, len(channels))
        self._sizes: list[float] = []
        self._noise, self._rest = 0.0, np.zeros(len(channels))

    def restart(self) -> None:
        self._search.restart()
        self._lags.restart()

    def _level(self) -> float:
        usual = self._impact.trigger * max(self._sizes) if self._sizes else 0.0
        return max(usual, FIRST_HIT * self._noise)

    def add(self, block: FloatArray) -> Iterator[Average]:
        """The averages that the next samples (n, n_channel) [SI] complete."""
        self._search.add(self._lags.add(block))
        if not self._noise and not self._is_quiet_known():
            return
        for start, trigger, samples in self._search.hits(self._rest[self._force], self._level):
            yield self._hit(start, samples, trigger)

    def _is_quiet_known(self) -> bool:
        """Whether the rest position of the force and the noise about it are known, by the first samples."""
        window, n = self._search.window, max(self._before, 16)
        if window.shape[0] < n:
            return False
        self._rest = np.nan_to_num(np.median(window[:n], axis=0))
        distance = np.abs(window[:, self._force] - self._rest[self._force])
        # Of a recording that begins within a hit the median is still the rest position.
        self._noise = float(1.4826 * np.median(distance[:n])) or 1e-6 * float(np.max(distance))
        return self._noise > 0.0

    def _hit(self, start: int, samples: FloatArray, trigger: int) -> Average:
        self._number += 1
        raw = np.nan_to_num(samples)
        hit = impact.judged_hit(self._number, start, raw, trigger, self.channels, self._impact, self._rest)
        fault = hit.fault
        size = float(np.max(np.abs(hit.samples[:, self._force])))
        usual = float(np.median(self._sizes)) if self._sizes else 0.0
        if not fault and size < WEAK * usual:
            fault = f"weak: {100 * size / usual:.0f} % of the usual force"
        if not fault and np.isfinite(samples).all():
            self._sizes.append(size)
        windowed, window = hit.samples.copy(), np.ones((self.n_sample, 1))
        if self._impact.force_window is not None:
            length = self._impact.force_window * self.sample_rate
            window[:, 0] = force_window(self.n_sample, trigger, length)
            windowed[:, [self._force]] *= window
        noise = (
            impact.noise_power(hit, self._force, self._lines) * np.sum(window**2) * (2 / self.n_sample) ** 2
        )
        average = self._average(start, samples, np.max(np.abs(hit.samples), axis=0), windowed, fault)
        return replace(average, noise=noise)


Cutter = PeriodCutter | HitCutter
CUTTERS: dict[str, type[Cutter]] = {"periodic": PeriodCutter, "impact": HitCutter}

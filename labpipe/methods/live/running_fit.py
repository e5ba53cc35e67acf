"""A fit that follows the averages of a running test, with intervals that hold at the moment of stopping.

The equation of motion e = B F - Z X of one average is linear in the coefficients; its weighted squares have
an exact gradient, and a warm start needs few Gauss-Newton steps per average.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, stats

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError, FitError
from labpipe.estimation.model import DynamicModel
from labpipe.records.recording import Channel
from labpipe.spectra.bands import line_range
from labpipe.spectra.impact import force_window, judged_hit
from labpipe.spectra.period_average import samples_per_period
from labpipe.spectra.settings import FrfSettings

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


def moving_mean(values: NDArray[Any], half_width: int = HALF_WIDTH) -> NDArray[Any]:
    """Mean over lines l - h ... l + h of *values* (n_line, ...) [any unit], the window cut at the ends."""
    n_line = values.shape[0]
    sums = np.zeros((n_line + 1, *values.shape[1:]), values.dtype)
    np.cumsum(values, axis=0, out=sums[1:])
    low = np.maximum(np.arange(n_line) - half_width, 0)
    high = np.minimum(np.arange(n_line) + half_width + 1, n_line)
    count = (high - low).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((sums[high] - sums[low]) / count)


class PeriodSums:
    """Running mean and scatter of the amplitudes z = [X; F] of equal averages, by Welford's algorithm."""

    def __init__(self) -> None:
        self.n = 0
        self.mean = np.empty((0, 0, 0), np.complex128)
        self._scatter = np.empty((0, 0, 0, 0), np.complex128)

    def add(self, z: ComplexArray, sign: int = 1) -> None:
        """The average *z* (n_line, n_experiment, n_channel) [channels' units]; *sign* -1 takes it out."""
        if not self.n:
            self.mean = np.zeros(z.shape, np.complex128)
            self._scatter = np.zeros((*z.shape, z.shape[2]), np.complex128)
        self.n += sign
        here = z - self.mean
        self.mean += sign * here / self.n
        self._scatter += sign * here[..., :, None] * (z - self.mean)[..., None, :].conj()

    def covariance(self) -> ComplexArray:
        """Of the mean, averaged over neighbouring lines, (n_line, n_experiment, n_channel, n_channel)
        [products of the channels' units].
        """
        return np.asarray(moving_mean(self._scatter) / ((self.n - 1) * self.n))

    @property
    def counts(self) -> IntArray:
        """Averages of each experiment, (n_experiment,)."""
        return np.full(self.mean.shape[1], self.n)


class HitSums:
    """Sums of products of hits or blocks with one force: H = S_xf / S_ff, the noise on the responses.

    An average counts by the energy of its force. The mean is [H; 1], its covariance that of H.
    """

    def __init__(self) -> None:
        self.n = 0
        self._xf = self._xx = np.empty(0, np.complex128)
        self._ff = np.empty(0)

    def add(self, z: ComplexArray, sign: int = 1) -> None:
        """The next hit or block *z* (n_line, n_experiment, n_channel) [channels' units], the force last;
        *sign* -1 takes it out.
        """
        x, f = z[..., :-1], z[..., -1]
        if not self.n:
            self._xf = np.zeros(x.shape, np.complex128)
            self._ff = np.zeros(f.shape)
            self._xx = np.zeros((*x.shape, x.shape[2]), np.complex128)
        self.n += sign
        self._xf += sign * x * f[..., None].conj()
        self._ff += sign * np.abs(f) ** 2
        self._xx += sign * x[..., :, None] * x[..., None, :].conj()

    @property
    def mean(self) -> ComplexArray:
        """[H; 1], (n_line, n_experiment, n_channel) [response units per force unit]."""
        h = self._xf / self._ff[..., None]
        return np.concatenate([h, np.ones((*h.shape[:2], 1))], axis=2)

    @property
    def force_power(self) -> FloatArray:
        """Sum of |F|^2 over the averages, (n_line, n_experiment) [squared force unit]."""
        return self._ff

    def covariance(self) -> ComplexArray:
        """Of [H; 1], the noise averaged over neighbouring lines, (n_line, n_experiment, n_channel, n_channel)
        [squared units of H].
        """
        h = self._xf / self._ff[..., None]
        noise = self._xx - self._ff[..., None, None] * h[..., :, None] * h[..., None, :].conj()
        smooth = moving_mean(noise / (self.n - 1)) / self._ff[..., None, None]
        n_channel = h.shape[2] + 1
        whole = np.zeros((*h.shape[:2], n_channel, n_channel), np.complex128)
        whole[..., :-1, :-1] = smooth
        return whole

    @property
    def counts(self) -> IntArray:
        """Averages of each experiment, (n_experiment,)."""
        return np.full(self.force_power.shape[1], self.n)


Sums = PeriodSums | HitSums


class Directions:
    """The sums of every direction that was shaken, one experiment each; of those with two averages or more
    what a running fit asks of sums.
    """

    def __init__(self, hits: bool) -> None:
        self._hits = hits
        self._sums: dict[int, Sums] = {}

    def of(self, direction: int) -> Sums:
        return self._sums.setdefault(direction, HitSums() if self._hits else PeriodSums())

    @property
    def _known(self) -> list[Sums]:
        return [sums for sums in self._sums.values() if sums.n >= 2]

    @property
    def n(self) -> int:
        """Averages of all directions together."""
        return sum(sums.n for sums in self._known)

    @property
    def counts(self) -> IntArray:
        """Averages of each direction, (n_experiment,)."""
        return np.array([sums.n for sums in self._known])

    @property
    def mean(self) -> ComplexArray:
        """(n_line, n_experiment, n_channel) [channels' units]."""
        return np.concatenate([sums.mean for sums in self._known], axis=1)

    def covariance(self) -> ComplexArray:
        """Of the mean, (n_line, n_experiment, n_channel, n_channel) [products of the channels' units]."""
        return np.concatenate([sums.covariance() for sums in self._known], axis=1)


class Equation:
    """e = B F - Z X of a model on its lines, and its derivatives by the coefficients.

    *view* (n_line,) [1/s^n] and *offset* [1] make receptance of the measured form: X = (Y - offset F) / view.
    """

    def __init__(
        self, model: DynamicModel, omega: FloatArray, view: ComplexArray | None = None, offset: float = 0.0
    ) -> None:
        self.model, self.omega = model, omega
        self._view = np.ones(omega.size, np.complex128) if view is None else view
        self._offset = offset
        self.n_output, self.n_force = model.constant.force.shape

    @cached_property
    def _terms(self) -> tuple[ComplexArray, FloatArray]:
        """Z_p(w) (n_parameter, n_line, n_output, n_output) and B_p (n_parameter, n_output, n_force)."""
        w = self.omega[:, None, None]
        stiffness = [
            t.matrices.stiffness + 1j * w * t.matrices.damping - w**2 * t.matrices.mass
            for t in self.model.terms
        ]
        return np.array(stiffness, np.complex128), np.array([t.matrices.force for t in self.model.terms])

    def split(self, z: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Displacement (n_line, n_experiment, n_output) [m], force (n_line, n_experiment, n_force) [N]."""
        force = z[..., self.n_output :]
        shift = self._offset * force[..., : self.n_output] if self._offset else 0.0
        return (z[..., : self.n_output] - shift) / self._view[:, None, None], force

    def gain(self, values: FloatArray) -> ComplexArray:
        """G of e = G z at the coefficients, (n_line, n_output, n_channel) [N per channel's unit]."""
        stiffness = self.model.dynamic_stiffness(values, self.omega)
        force = np.broadcast_to(
            self.model.whole(values).force.astype(np.complex128),
            (self.omega.size, self.n_output, self.n_force),
        )
        of_motion = -stiffness / self._view[:, None, None]
        if self._offset:
            force = force + self._offset * stiffness / self._view[:, None, None]
        return np.concatenate([of_motion, force], axis=2)

    def slopes(self, z: ComplexArray) -> ComplexArray:
        """de/dp of *z*, (n_line, n_experiment, n_output, n_parameter) [N per parameter unit]."""
        motion, force = self.split(z)
        stiffness, factors = self._terms
        moved = np.einsum("plij,lej->leip", stiffness, motion)
        if np.any(factors):
            moved = moved - np.einsum("pij,lej->leip", factors, force)
        return np.asarray(-moved)


@dataclass(frozen=True)
class Estimate:
    """Where a running fit stands after *n* averages, the *least* in one direction.

    values, std_error, dof, half (n_parameter,) [parameter units]: the 95 % interval is values +- half, of
    noise and, beyond its limit, misfit; reduced: chi-square per degree of freedom, *misfit* whether it speaks
    against the model; information and covariance (n_parameter, n_parameter), the latter of noise.
    """

    n: int
    least: int
    values: FloatArray
    std_error: FloatArray
    dof: FloatArray
    half: FloatArray
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

    def __init__(self, equation: Equation, coverage: float = 0.95) -> None:
        self.equation, self.coverage = equation, coverage
        self.values: FloatArray | None = None

    def update(self, sums: Sums | Directions, start: FloatArray | None = None) -> Estimate:
        """The estimate after the averages in *sums*; from *start* (n_parameter,) [parameter units] instead of
        a cold start.

        FitError before the second average, and where the lines cannot tell the coefficients apart at all.
        """
        if sums.n < 2:
            raise FitError("one average leaves the noise unknown")
        mean, covariance = sums.mean, sums.covariance()
        if self.values is None:
            values, steps = (self._cold(mean, covariance) if start is None else start), COLD
        else:
            values, steps = self.values, WARM
        values = self._descend(mean, covariance, values, steps)
        estimate = self._judged(sums.counts, mean, covariance, values)
        self.values = values
        return estimate

    def parts(
        self, mean: ComplexArray, covariance: ComplexArray, values: FloatArray
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
        """Residual e (n_line, n_experiment, n_output) [N], the inverse of its covariance, their product, the
        slopes (n_line, n_experiment, n_output, n_parameter) [N per parameter unit] at the likeliest
        amplitudes, and the inverse times these.
        """
        gain = self.equation.gain(values)[:, None]
        residual = (gain @ mean[..., None])[..., 0]
        spread = covariance @ gain.conj().swapaxes(-1, -2)
        inverse = np.linalg.inv(gain @ spread)
        multiplier = (inverse @ residual[..., None])[..., 0]
        likely = mean - (spread @ multiplier[..., None])[..., 0]
        slopes = self.equation.slopes(likely)
        return residual, inverse, multiplier, slopes, inverse @ slopes

    def _cost(self, mean: ComplexArray, covariance: ComplexArray, values: FloatArray) -> float:
        gain = self.equation.gain(values)[:, None]
        residual = (gain @ mean[..., None])[..., 0]
        spread = gain @ covariance @ gain.conj().swapaxes(-1, -2)
        return float(np.sum((residual.conj() * np.linalg.solve(spread, residual[..., None])[..., 0]).real))

    def _descend(
        self, mean: ComplexArray, covariance: ComplexArray, values: FloatArray, steps: int
    ) -> FloatArray:
        cost = self._cost(mean, covariance, values)
        for _ in range(steps):
            _, _, multiplier, slopes, weighted = self.parts(mean, covariance, values)
            information, gradient = _normal(slopes, weighted, multiplier)
            scale = np.sqrt(np.diag(information))
            scale[scale == 0] = 1.0
            step = np.asarray(
                np.linalg.lstsq(information / np.outer(scale, scale), gradient / scale, rcond=1e-12)[0]
                / scale
            )
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
        motion, force = self.equation.split(mean)
        constant = self.equation.model.constant
        w = self.equation.omega[:, None, None]
        held = constant.stiffness + 1j * w * constant.damping - w**2 * constant.mass
        side = force @ constant.force.T - np.einsum("lij,lej->lei", held, motion)
        values = np.zeros(n_parameter)
        design, right = slopes, side
        for number in range(REWEIGHTED):
            if number:
                gain = self.equation.gain(values)[:, None]
                inverse = np.linalg.inv(gain @ covariance @ gain.conj().swapaxes(-1, -2))
                weight = np.linalg.cholesky(inverse).conj().swapaxes(-1, -2)
                design, right = np.asarray(weight @ slopes), (weight @ side[..., None])[..., 0]
            rows = np.concatenate(
                [design.real.reshape(-1, n_parameter), design.imag.reshape(-1, n_parameter)]
            )
            sides = np.concatenate([right.real.ravel(), right.imag.ravel()])
            size = np.linalg.norm(rows, axis=0)
            size[size == 0] = 1.0
            values = -np.linalg.lstsq(rows / size, sides, rcond=None)[0] / size
        return values

    def _judged(
        self, counts: IntArray, mean: ComplexArray, covariance: ComplexArray, values: FloatArray
    ) -> Estimate:
        residual, _, multiplier, slopes, weighted = self.parts(mean, covariance, values)
        information, _ = _normal(slopes, weighted, multiplier)
        n_parameter, n_output = values.size, self.equation.n_output
        scale = np.sqrt(np.diag(information))
        scale[scale == 0] = 1.0
        scaled = information / np.outer(scale, scale)
        identifiable = bool(np.linalg.cond(scaled) < SINGULAR)
        inverse = np.linalg.pinv(scaled, hermitian=True) / np.outer(scale, scale)
        n, least = int(counts.sum()), int(counts.min())
        # Of the direction with the fewest averages, whose weights cost the most.
        smoothed = (least - 1) * (2 * HALF_WIDTH + 1)
        inflation = smoothed**2 / ((smoothed - n_output) ** 2 - 1)
        covariance_of_values = inflation * inverse
        std_error = np.sqrt(np.diag(covariance_of_values))
        shares = moving_mean(2 * np.sum(((slopes @ inverse).conj() * (weighted @ inverse)).real, axis=2))
        spread = np.sum(shares**2, axis=0) / (counts - 1)[:, None]
        dof = np.asarray(2 * np.sum(shares, axis=(0, 1)) ** 2 / np.sum(spread, axis=0))
        freedom = 2 * residual.size - n_parameter
        reduced = float(2 * np.sum((multiplier.conj() * residual).real) / freedom)
        misfit = bool(stats.f.sf(reduced, freedom, smoothed) < MISFIT_P)
        half = stats.t.ppf((1 + self.coverage) / 2, dof) * np.sqrt(1 + 2 / dof) * std_error
        if misfit:
            half = half * np.sqrt(reduced)
        return Estimate(
            n,
            least,
            values,
            std_error,
            dof,
            half,
            reduced,
            misfit,
            identifiable,
            information,
            covariance_of_values,
        )


def _normal(
    slopes: ComplexArray, weighted: ComplexArray, multiplier: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Information 2 Re J^H Lambda^-1 J and gradient 2 Re J^H lambda."""
    n_parameter = slopes.shape[-1]
    flat = slopes.reshape(-1, n_parameter)
    information = 2 * (flat.conj().T @ weighted.reshape(-1, n_parameter)).real
    return information, 2 * (flat.conj().T @ multiplier.reshape(-1)).real


# A first hit stands out of the noise before it by so many times its rms.
FIRST_HIT = 20.0
# Hits below this share of the usual one tell little.
WEAK = 0.1


@dataclass(frozen=True)
class Average:
    """One period or hit: *amplitude* (n_line, n_channel) [unit of each channel] on the cutter's lines.

    *start*: its first sample in the stream; *number* from 1; *fault*: why it is left out, '' where it is
    good; *peaks* (n_channel,) [SI]: largest sizes, by which levels are shown.
    """

    number: int
    start: int
    amplitude: ComplexArray
    peaks: FloatArray
    fault: str = ""


class Cutter:
    """Cuts calibrated blocks into averages; *frequency* (n_line,) [Hz] of their lines."""

    frequency: FloatArray
    n_sample: int

    def __init__(
        self, channels: tuple[Channel, ...], sample_rate: float, n_sample: int, lines: slice
    ) -> None:
        self.channels, self.sample_rate, self.n_sample, self._lines = channels, sample_rate, n_sample, lines
        self.frequency = np.arange(lines.start, lines.stop) * (sample_rate / n_sample)
        self._rest = np.empty((0, len(channels)))
        self._begin = 0
        self._number = 0

    def add(self, block: FloatArray) -> Iterator[Average]:
        """The averages that the next samples (n, n_channel) [SI] complete."""
        self._rest = np.concatenate([self._rest, block])
        yield from self._complete()

    def restart(self) -> None:
        """The samples that follow belong to another recording: what is not complete is lost."""
        self._begin += self._rest.shape[0]
        self._rest = self._rest[:0]

    def _complete(self) -> Iterator[Average]:
        raise NotImplementedError

    def _missing(self, samples: FloatArray) -> str:
        there = np.isfinite(samples).all(axis=0)
        return "" if there.all() else f"no number in channel '{self.channels[int(np.argmin(there))].name}'"

    def _transformed(self, samples: FloatArray) -> ComplexArray:
        whole = fft.rfft(samples.T, axis=1)
        return np.asarray(whole[:, self._lines].T * (2 / self.n_sample))


class PeriodCutter(Cutter):
    """Whole periods, the transient ones dropped at the start of each recording."""

    def __init__(self, channels: tuple[Channel, ...], sample_rate: float, settings: FrfSettings) -> None:
        assert settings.period is not None
        n_sample = samples_per_period(settings.period, sample_rate)
        super().__init__(channels, sample_rate, n_sample, line_range(n_sample, sample_rate, settings.band))
        self._skip = self._left = settings.skip

    def restart(self) -> None:
        super().restart()
        self._left = self._skip

    def _complete(self) -> Iterator[Average]:
        while self._rest.shape[0] >= self.n_sample:
            period, start = self._rest[: self.n_sample], self._begin
            self._rest, self._begin = self._rest[self.n_sample :], self._begin + self.n_sample
            if self._left:
                self._left -= 1
                continue
            self._number += 1
            fault = self._missing(period)
            moved = period - np.nan_to_num(period.mean(axis=0))
            peaks = np.max(np.abs(moved), axis=0)
            yield Average(self._number, start, self._transformed(np.nan_to_num(moved)), peaks, fault)


class HitCutter(Cutter):
    """Hits of one hammer, found as they come: by the noise before the first, then by the hits so far."""

    def __init__(self, channels: tuple[Channel, ...], sample_rate: float, settings: FrfSettings) -> None:
        assert settings.block is not None
        n_sample = round(settings.block * sample_rate)
        super().__init__(channels, sample_rate, n_sample, line_range(n_sample, sample_rate, settings.band))
        forces = [number for number, channel in enumerate(channels) if channel.role == "input"]
        if len(forces) != 1:
            raise DataError(
                f"hits need one force, the rig has {len(forces)}", hint="one hammer per recording"
            )
        self._force, self._impact = forces[0], settings.impact
        self._before = round(self._impact.pretrigger * n_sample)
        self._search = 0
        self._sizes: list[float] = []
        self._noise = self._zero = np.nan

    def restart(self) -> None:
        super().restart()
        self._search = self._begin

    def _level(self) -> float:
        usual = self._impact.trigger * max(self._sizes) if self._sizes else 0.0
        return max(usual, FIRST_HIT * self._noise)

    def _complete(self) -> Iterator[Average]:
        if np.isnan(self._noise):
            if self._rest.shape[0] < max(self._before, 16):
                return
            quiet = self._rest[: max(self._before, 16), self._force]
            self._zero = float(np.median(quiet))
            # Of a recording that begins within a hit the median is still the rest position.
            self._noise = float(1.4826 * np.median(np.abs(quiet - self._zero)))
            largest = float(np.max(np.abs(self._rest[:, self._force] - self._zero)))
            if self._noise == 0.0 and largest == 0.0:
                self._noise = np.nan
                return
            self._noise = self._noise or 1e-6 * largest
        while True:
            at = self._search - self._begin
            size = np.abs(self._rest[at:, self._force] - self._zero)
            above = np.flatnonzero(size >= self._level())
            if not above.size:
                self._search = self._begin + self._rest.shape[0]
                break
            trigger = self._search + int(above[0])
            start = max(trigger - self._before, self._begin)
            if start + self.n_sample > self._begin + self._rest.shape[0]:
                self._search = trigger
                break
            first = start - self._begin
            yield self._hit(start, self._rest[first : first + self.n_sample], trigger - start)
            self._search = start + self.n_sample
        keep = max(min(self._search - self._before - self._begin, self._rest.shape[0]), 0)
        self._rest, self._begin = self._rest[keep:], self._begin + keep

    def _hit(self, start: int, samples: FloatArray, trigger: int) -> Average:
        self._number += 1
        hit = judged_hit(self._number, start, np.nan_to_num(samples), trigger, self._force, self._impact)
        what, _, column = hit.fault.rpartition(" ")
        fault = f"{what} '{self.channels[int(column) - 1].name}'" if column.isdigit() else hit.fault
        fault = self._missing(samples) or fault
        size = float(np.max(np.abs(hit.samples[:, self._force])))
        if not fault and self._sizes and size < WEAK * float(np.median(self._sizes)):
            fault = f"weak: {100 * size / float(np.median(self._sizes)):.0f} % of the usual force"
        if not fault:
            self._sizes.append(size)
        windowed = hit.samples.copy()
        if self._impact.force_window is not None:
            length = self._impact.force_window * self.sample_rate
            windowed[:, self._force] *= force_window(self.n_sample, trigger, length)
        peaks = np.max(np.abs(hit.samples), axis=0)
        return Average(self._number, start, self._transformed(windowed), peaks, fault)


CUTTERS = {"periodic": PeriodCutter, "impact": HitCutter}

"""Periodic excitation: whole periods averaged line by line, the noise taken from the scatter between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, stats

from labpipe.errors import ConfigError, DataError

# A line whose own scatter exceeds its neighbours' at this level is not broadband noise (a shaft-speed line, say).
OUTLIER_LEVEL = 1e-3


@dataclass(frozen=True)
class LineSpectrum:
    """Fourier amplitudes of all channels averaged over periods, and the noise of the averages.

    frequency  (n_line,) [Hz]
    mean       (n_line, n_channel) complex amplitudes, X = 2/N sum x exp(-j w t) [unit of the channel]
    noise      (n_line, n_channel, n_channel) complex covariance of the mean, E[e e^H], or None with a single period
    dof        complex degrees of freedom behind each line of the noise
    """

    frequency: NDArray[np.floating]
    mean: NDArray[np.complexfloating]
    noise: NDArray[np.complexfloating] | None
    n_period: int
    dof: float

    def select(self, lines: NDArray[np.bool_]) -> LineSpectrum:
        """The spectrum on the chosen lines."""
        noise = None if self.noise is None else self.noise[lines]
        return LineSpectrum(self.frequency[lines], self.mean[lines], noise, self.n_period, self.dof)


def samples_per_period(period: float, sample_rate: float) -> int:
    """The whole number of samples in a period [s]; ConfigError when the period does not hold a whole number."""
    exact = period * sample_rate
    n_sample = round(exact)
    if n_sample < 2 or abs(exact - n_sample) > 1e-6 * exact:
        hint = f"the nearest period that does is {max(n_sample, 2) / sample_rate:.9g} s"
        raise ConfigError(f"a period of {period:g} s holds {exact:.6g} samples at {sample_rate:g} Hz, not a whole number", hint=hint)
    return n_sample


class PeriodAverage:
    """Running mean and scatter of the Fourier amplitudes over whole periods, fed block by block in any size.

    The mean and the scatter are updated as by Welford, so that a small noise on a large signal does not cancel.
    """

    def __init__(self, n_sample: int, n_channel: int, skip: int) -> None:
        self._n_sample = n_sample
        self._skip = skip
        self._rest: NDArray[np.floating] = np.empty((0, n_channel))
        n_line = n_sample // 2 + 1
        self._mean = np.zeros((n_line, n_channel), np.complex128)
        self._scatter = np.zeros((n_line, n_channel, n_channel), np.complex128)
        self.n_period = 0

    def add(self, block: NDArray[np.floating]) -> None:
        """Take a block (n, n_channel) that follows the one before."""
        samples = np.concatenate([self._rest, block]) if self._rest.size else block
        n_whole = samples.shape[0] // self._n_sample
        for number in range(n_whole):
            self._add_period(samples[number * self._n_sample : (number + 1) * self._n_sample])
        self._rest = samples[n_whole * self._n_sample :].copy()

    def _add_period(self, period: NDArray[np.floating]) -> None:
        if self._skip > 0:
            self._skip -= 1
            return
        amplitude = fft.rfft(period, axis=0) * (2 / self._n_sample)
        self.n_period += 1
        before = amplitude - self._mean
        self._mean += before / self.n_period
        after = amplitude - self._mean
        self._scatter += before[:, :, None] * after[:, None, :].conj()

    def spectrum(self, sample_rate: float) -> LineSpectrum:
        """The averaged lines from the fundamental on; DataError when not even one period is left."""
        n = self.n_period
        if n == 0:
            raise DataError(
                "the recording is too short for one period after the transient ones",
                hint=f"a period is {self._n_sample / sample_rate:g} s; shorten `skip` or `period`, or record longer",
            )
        frequency = np.arange(self._mean.shape[0]) * (sample_rate / self._n_sample)
        noise = None if n == 1 else self._scatter[1:] / (n * (n - 1))
        return LineSpectrum(frequency[1:], self._mean[1:], noise, n, float(n - 1))


def smoothed_noise(spectrum: LineSpectrum, half_width: int) -> LineSpectrum:
    """The spectrum with its noise averaged over neighbouring lines: S_s(k) = mean of S over k-h ... k+h.

    Few periods leave few degrees of freedom per line (n_period - 1), too few for weights: a maximum-likelihood fit with weights
    from 4 degrees of freedom is less efficient and understates its errors. Measurement noise is broadband, so neighbouring lines
    share it. A line whose own scatter in any channel exceeds that of its neighbours (F-test at 0.1 %) keeps its own and is left
    out of theirs.
    """
    if spectrum.noise is None or half_width == 0:
        return spectrum
    power = np.einsum("fii->fi", spectrum.noise).real
    around = _neighbourhood_mean(power, np.ones(power.shape[0], bool), half_width, own=False)
    limit = stats.f.ppf(1 - OUTLIER_LEVEL, 2 * spectrum.dof, 4 * half_width * spectrum.dof)
    broadband = ~np.any(power > limit * around, axis=1)
    smooth = _neighbourhood_mean(spectrum.noise, broadband, half_width, own=True)
    noise = np.where(broadband[:, None, None], smooth, spectrum.noise)
    count = _neighbourhood_count(broadband, half_width, own=True)
    dof = spectrum.dof * float(np.median(count[broadband])) if np.any(broadband) else spectrum.dof
    return LineSpectrum(spectrum.frequency, spectrum.mean, noise, spectrum.n_period, dof)


def _window_sum(values: NDArray[Any], half_width: int) -> NDArray[Any]:
    """Sum over k-h ... k+h along axis 0, cut at the ends."""
    n = values.shape[0]
    total = np.concatenate([np.zeros((1, *values.shape[1:]), values.dtype), np.cumsum(values, axis=0)])
    index = np.arange(n)
    return total[np.minimum(index + half_width + 1, n)] - total[np.maximum(index - half_width, 0)]


def _neighbourhood_count(chosen: NDArray[np.bool_], half_width: int, own: bool) -> NDArray[np.floating]:
    count = _window_sum(chosen.astype(np.float64), half_width)
    return np.maximum(count - (0 if own else chosen), 1)


def _neighbourhood_mean(values: NDArray[Any], chosen: NDArray[np.bool_], half_width: int, own: bool) -> NDArray[Any]:
    """Mean over the chosen lines k-h ... k+h, with or without line k itself."""
    shape = (-1,) + (1,) * (values.ndim - 1)
    used = np.where(chosen.reshape(shape), values, 0)
    total = _window_sum(used, half_width) - (0 if own else used)
    mean: NDArray[Any] = total / _neighbourhood_count(chosen, half_width, own).reshape(shape)
    return mean


def excited_lines(spectrum: LineSpectrum, inputs: list[int], signal_to_noise: float = 5.0, floor: float = 1e-3) -> NDArray[np.bool_]:
    """The lines at which a force really acts: above its noise, and above *floor* of the strongest line.

    With smoothed noise the chance that an empty line passes at a signal-to-noise ratio of 5 is exp(-25).
    """
    force = np.abs(spectrum.mean[:, inputs])
    excited = force > floor * np.max(force, axis=0)
    if spectrum.noise is not None:
        std = np.sqrt(np.einsum("fii->fi", spectrum.noise).real[:, inputs])
        excited &= force > signal_to_noise * std
    return np.any(excited, axis=1)

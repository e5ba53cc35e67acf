"""Phases for the least peak of several signals that share their lines: forces and the motions that they cause, each against its limit.

Source s, a shaker say, has the phase phi_ls at line l, and signal c is s_c(t) = Re sum_ls g_lsc exp(j (phi_ls + 2 pi k_l t)), t in periods.
The peak is approached by 2p-norms of all signals, p rising (Guillaume, Schoukens, Pintelon and Kollar 1991, IEEE Trans. Instrum. Meas. 40,
982).
"""

from __future__ import annotations

import numpy as np
from scipy import fft
from scipy.optimize import minimize

from labpipe.arrays import ComplexArray, FloatArray, IntArray

# Samples per period of the highest line, while searching and for the peak that is stated.
SEARCHED, STATED = 8, 192
HALF_NORMS, STEPS = (4, 16, 64, 256), 200
# The same for a first look.
QUICK_NORMS, QUICK_STEPS = (4, 32), 40


def peaks(lines: IntArray, amplitudes: ComplexArray) -> FloatArray:
    """Largest |s_c(t)|, (n_signal,) [unit of amplitudes], of amplitudes (n_line, n_signal) [any unit] at lines (n_line,) [multiples].

    Of all times, whatever the sampling rate: never below the true one, and above it by 0.013 % at most. Equation (plan-highest).
    """
    signals = one_period(lines, amplitudes, STATED)
    # Around its peak S a sum of sines up to line k is at least S cos(2 pi k (t - t_S)), and a sample is no farther than half a step.
    between = np.cos(np.pi * int(lines.max()) / signals.shape[1])
    return np.asarray(np.abs(signals).max(axis=1) / between)


def one_period(lines: IntArray, amplitudes: ComplexArray, oversampling: int) -> FloatArray:
    """Signals over a period, (n_signal, n_sample) [unit of amplitudes], with *oversampling* samples or more per period of the highest line.

    Arguments as of `peaks`.
    """
    return _signals(lines, amplitudes, int(fft.next_fast_len(oversampling * int(lines.max()), real=True)))


def schroeder_phases_of(power: FloatArray) -> FloatArray:
    """Schroeder's phases [rad] of lines with *power* (n_line,) [any unit]: phi_n = -2 pi sum_{l<n} (n - l) p_l, p summing to 1.

    Equation (spec-schroeder-power).
    """
    share = power / power.sum()
    return np.asarray(-2 * np.pi * np.cumsum(np.concatenate([[0.0], np.cumsum(share)[:-1]])))


def least_peak_phases(
    lines: IntArray, gains: ComplexArray, groups: IntArray | None = None, *, seed: int = 0, random_starts: int = 1, quick: bool = False
) -> FloatArray:
    """Phases (n_line, n_source) [rad] that make the largest peak of all signals small.

    gains (n_line, n_source, n_signal) [1]: amplitudes over the limit of their signal; lines (n_line,) [multiples]. The sources of a line
    differ in phase by as much as on all lines of the same number in *groups* (n_line,), by default of a line alone. Starts from
    Schroeder's phases and from *random_starts* random ones; never worse than Schroeder's. *quick*: a first look, a few per cent above.
    Equation (plan-peak).
    """
    n_line, n_source, _ = gains.shape
    group = np.arange(n_line) if groups is None else np.unique(groups, return_inverse=True)[1]
    schroeder = schroeder_phases_of(np.sum(np.abs(gains) ** 2, axis=(1, 2)))
    rng = np.random.default_rng(seed)
    n_difference = (n_source - 1) * (int(group.max()) + 1)
    begins = [np.concatenate([schroeder, np.zeros(n_difference)])]
    begins.extend(rng.uniform(0, 2 * np.pi, n_line + n_difference) for _ in range(random_starts))
    if random_starts and n_difference:
        begins.append(np.concatenate([schroeder, rng.uniform(0, 2 * np.pi, n_difference)]))
    problem = _Problem(lines, gains, group)
    best, least = begins[0], problem.peak(begins[0])
    for start in begins:
        unknowns = start
        for p in QUICK_NORMS if quick else HALF_NORMS:
            unknowns = problem.descended(unknowns, p, QUICK_STEPS if quick else STEPS)
            peak = problem.peak(unknowns)
            if peak < least:
                best, least = unknowns, peak
    return np.asarray(np.mod(problem.phases(best), 2 * np.pi))


def _signals(lines: IntArray, amplitudes: ComplexArray, n_sample: int) -> FloatArray:
    """(n_signal, n_sample): one period."""
    spectrum = np.zeros((amplitudes.shape[1], n_sample // 2 + 1), np.complex128)
    spectrum[:, lines] = amplitudes.T * (n_sample / 2)
    return np.asarray(fft.irfft(spectrum, n_sample, axis=1))


class _Problem:
    """The peak as a function of the unknowns: phases of the first source (n_line,), then differences of the others by group."""

    def __init__(self, lines: IntArray, gains: ComplexArray, group: IntArray) -> None:
        self.lines, self.gains, self.group = lines, gains, group
        self.n_line, self.n_source, _ = gains.shape
        self.n_group = int(group.max()) + 1
        self.n_sample = fft.next_fast_len(SEARCHED * int(lines.max()), real=True)

    def phases(self, unknowns: FloatArray) -> FloatArray:
        first = unknowns[: self.n_line, None]
        others = unknowns[self.n_line :].reshape(self.n_group, self.n_source - 1)
        return np.concatenate([first, first + others[self.group]], axis=1)

    def amplitudes(self, unknowns: FloatArray) -> ComplexArray:
        """By source, (n_line, n_source, n_signal)."""
        return np.asarray(self.gains * np.exp(1j * self.phases(unknowns))[:, :, None])

    def peak(self, unknowns: FloatArray) -> float:
        return float(peaks(self.lines, self.amplitudes(unknowns).sum(axis=1)).max())

    def norm(self, unknowns: FloatArray, p: int) -> tuple[float, FloatArray]:
        """Logarithm of the 2p-norm of all signals together, and its slope."""
        amplitudes = self.amplitudes(unknowns)
        signals = _signals(self.lines, amplitudes.sum(axis=1), self.n_sample)
        largest = np.abs(signals).max()
        scaled = signals / largest
        powers = scaled ** (2 * p - 1)
        total = float(np.sum(powers * scaled))
        spectrum = fft.rfft(powers, axis=1)[:, self.lines].T
        slope = np.sum((1j * amplitudes * spectrum.conj()[:, None]).real, axis=2) / largest / total
        differences = np.zeros((self.n_group, self.n_source - 1))
        np.add.at(differences, self.group, slope[:, 1:])
        return float(np.log(largest) + np.log(total) / (2 * p)), np.concatenate([slope.sum(axis=1), differences.reshape(-1)])

    def descended(self, unknowns: FloatArray, p: int, steps: int) -> FloatArray:
        return np.asarray(minimize(self.norm, unknowns, args=(p,), jac=True, method="L-BFGS-B", options={"maxiter": steps}).x)

"""Sines of one frequency in samples: frequency, complex amplitudes, and their scatter from block to block."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray

# Steps of Gauss and Newton for the frequency: the error shrinks by orders of magnitude with each.
STEPS = 6


def design(frequency: float, n_sample: int) -> FloatArray:
    """cos, -sin and 1 (n_sample, 3) [1] at a *frequency* [periods per sample], so that the first two factors are Re and Im of X."""
    phase = 2 * np.pi * frequency * np.arange(n_sample)
    return np.column_stack([np.cos(phase), -np.sin(phase), np.ones(n_sample)])


def amplitudes(samples: FloatArray, frequency: float) -> ComplexArray:
    """X (n_channel,) of x = Re(X exp(j 2 pi f n)) + offset by least squares in *samples* (n_sample, n_channel) [unit of the channel].

    Equation (spec-sine).
    """
    factors = np.linalg.lstsq(design(frequency, samples.shape[0]), samples, rcond=None)[0]
    amplitude: ComplexArray = factors[0] + 1j * factors[1]
    return amplitude


def sine_frequency(signal: FloatArray, frequency: float) -> float:
    """Frequency [periods per sample] of a sine with offset in white noise, by least squares (n_sample,) [any unit] from a first guess.

    Its variance is the bound of Cramer and Rao, 6 s^2 / (pi^2 A^2 N^3) [periods^2 per sample^2] for the amplitude A and the noise s
    (Rife and Boorstyn 1974, IEEE Trans. Inf. Theory 20, for large N).
    """
    n = signal.size
    time = np.arange(n) - (n - 1) / 2
    for _ in range(STEPS):
        phase = 2 * np.pi * frequency * time
        cos, sin = np.cos(phase), np.sin(phase)
        basis = np.column_stack([cos, sin, np.ones(n)])
        a, b, _ = np.linalg.lstsq(basis, signal, rcond=None)[0]
        slope = 2 * np.pi * time * (b * cos - a * sin)
        frequency += float(np.linalg.lstsq(np.column_stack([basis, slope]), signal, rcond=None)[0][3])
    return frequency


def block_amplitudes(samples: FloatArray, frequency: float, length: float, count: int) -> ComplexArray:
    """X (count, n_channel) [unit of the channel] in blocks of *length* samples one after the other, of *samples* (n_sample, n_channel).

    Their phase is that of the first sample of all.
    """
    blocks = []
    for number in range(count):
        start, stop = round(number * length), round((number + 1) * length)
        blocks.append(amplitudes(samples[start:stop], frequency) * np.exp(-2j * np.pi * frequency * start))
    return np.array(blocks)


def frequency_variance(signal: FloatArray, frequency: float) -> float:
    """The bound of Cramer and Rao on the variance of sine_frequency [periods^2 per sample^2], of a *signal* (n_sample,) [any unit].

    Equation (spec-sine-variance).
    """
    n = signal.size
    basis = design(frequency, n)
    factors = np.linalg.lstsq(basis, signal, rcond=None)[0]
    noise = float(np.sum((signal - basis @ factors) ** 2)) / max(n - 4, 1)
    return 6 * noise / (np.pi**2 * float(factors[0] ** 2 + factors[1] ** 2) * n**3)

"""Windows of random data: their values, the band they let through, and how much overlapping blocks repeat each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from labpipe.errors import ConfigError


def window_values(name: str, n_sample: int) -> NDArray[np.floating]:
    """The periodic (DFT-even) window of that name; "tukey 0.25" gives a parameter. ConfigError when scipy does not know it."""
    kind, *parameters = name.split()
    try:
        chosen: Any = (kind, *(float(parameter) for parameter in parameters)) if parameters else kind
        values: NDArray[np.floating] = signal.get_window(chosen, n_sample, fftbins=True)
    except (ValueError, TypeError):
        raise ConfigError(f"unknown window '{name}'", hint="for example hann, hamming, blackman, flattop, boxcar, 'tukey 0.25'") from None
    return values


def noise_bandwidth(window: NDArray[np.floating]) -> float:
    """Equivalent noise bandwidth n sum w^2 / (sum w)^2 in lines [1]; times the line spacing it is in Hz (Harris 1978, eq. 11).

    White noise reads as much on a line as through a rectangular filter of this width: boxcar 1, Hann 1.5.
    """
    return float(window.size * np.dot(window, window) / np.sum(window) ** 2)


def overlap_correlation(window: NDArray[np.floating], step: int) -> NDArray[np.floating]:
    """rho_k = (sum w(n) w(n + k step) / sum w^2)^2 of the powers of blocks k steps apart, k = 1 ... (Welch 1967)."""
    n = window.size
    products = [np.dot(window[:-shift], window[shift:]) for shift in range(step, n, step)]
    return (np.array(products) / np.dot(window, window)) ** 2


def effective_averages(window: NDArray[np.floating], step: int, n_block: int) -> float:
    """n_e = K / (1 + 2 sum_k (1 - k/K) rho_k): overlapping blocks are correlated and average less than their number (Welch 1967)."""
    rho = overlap_correlation(window, step)
    k = np.arange(1, rho.size + 1)
    return float(n_block / (1 + 2 * np.sum(np.maximum(1 - k / n_block, 0) * rho)))

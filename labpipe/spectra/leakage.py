"""Leakage of random data: what the finite blocks of Welch's method do to H1, from the spectrum of their window alone.

A block is u w and y w, and the response to forces before it is missing while part of that to its own comes too late. For a force
with a smooth spectrum E[S_yu] / E[S_uu] = sum |W(w - v)|^2 H(v) / sum |W|^2: the impulse response times the window's autocorrelation.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.records.response import Blocks
from labpipe.spectra.windows import window_values

# Samples of a window that show its shape, and points per line: an impulse response is followed over as many blocks.
SHAPE_SAMPLES, POINTS = 512, 4
# Share of the window's power outside of the lines that count, and their largest number to either side.
OUTSIDE, MOST_LINES = 1e-6, 64


@dataclass(frozen=True)
class LeakageKernel:
    """Spectrum of the window of *blocks*, phase taken out: *amplitude* W (n_point,) [1] at *offsets* (n_point,) [1 / POINTS line].

    sum W^2 = 1.
    """

    blocks: Blocks
    offsets: FloatArray
    amplitude: FloatArray

    @property
    def weights(self) -> FloatArray:
        """|W|^2, (n_point,) [1]: the mean of H over the points is the expected H1."""
        return self.amplitude**2

    def shifts(self) -> list[tuple[float, ComplexArray]]:
        """(weight [1], phases (n_point,) [1]) of the pairs of blocks that overlap: 1 - |t| / K, and exp(j v t step)."""
        step = 1 - self.blocks.overlap
        most = min(int(np.ceil(1 / step)) - 1, self.blocks.number - 1)
        return [(1 - abs(t) / self.blocks.number, np.exp(2j * np.pi * self.offsets * (t * step / POINTS))) for t in range(-most, most + 1)]


def has_kernel(blocks: Blocks) -> bool:
    """Whether what leaks is known: in H1 of whole blocks, whose kernel is that of their window."""
    return blocks.estimator == "H1" and not blocks.degree


@functools.cache
def kernel_of(blocks: Blocks) -> LeakageKernel:
    """The spectrum of the blocks' window; ConfigError for an unknown window. Equation (frf-leakage-kernel)."""
    window = window_values(blocks.window, SHAPE_SAMPLES)
    # About the middle of the block the transform of a symmetric window is real.
    place = np.arange(SHAPE_SAMPLES) - SHAPE_SAMPLES / 2
    offsets = np.arange(-MOST_LINES * POINTS, MOST_LINES * POINTS + 1)
    amplitude = (np.exp(-2j * np.pi * np.outer(offsets, place) / (SHAPE_SAMPLES * POINTS)) @ window).real
    nearest = np.argsort(np.abs(offsets), kind="stable")
    share = np.cumsum(amplitude[nearest] ** 2) / np.dot(amplitude, amplitude)
    furthest = abs(offsets[nearest[np.argmax(share > 1 - OUTSIDE)]])
    inside = np.abs(offsets) <= furthest
    return LeakageKernel(blocks, offsets[inside].astype(float), amplitude[inside] / np.linalg.norm(amplitude[inside]))

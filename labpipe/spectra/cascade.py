"""Waterfall (cascade) spectra of a run, block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import SampleSource
from labpipe.spectra.reading import checked_blocks
from labpipe.spectra.settings import ShaftLines
from labpipe.spectra.shaft import shaft_motion

MOST_BLOCKS = 40


@dataclass(frozen=True)
class CascadeSpectra:
    """speed (n_block,) [Hz], frequency (n_line,) [Hz], amplitude (n_block, n_line, n_output) 0-to-peak [SI], labels (n_output,)."""

    speed: FloatArray
    frequency: FloatArray
    amplitude: FloatArray
    labels: tuple[str, ...]


def cascade_spectra(source: SampleSource, lines: ShaftLines, *, resolution: float = 1.0, orders: float = 4.0) -> CascadeSpectra:
    """Amplitude spectra of blocks of 1 / *resolution* [s], at most MOST_BLOCKS of them (Hann window, scaled to a sine's amplitude).

    Frequencies up to *orders* times the highest speed. DataError when the recording is shorter than two blocks. Equation (spec-cascade).
    """
    length = round(source.sample_rate / resolution)
    motion = shaft_motion(source, lines)
    outputs = [number for number, channel in enumerate(source.channels) if channel.role == "output"]
    samples = np.concatenate(list(checked_blocks(source)))[:, outputs]
    count = samples.shape[0] // length
    if count < 2:
        raise DataError(f"recording '{source.name}' is shorter than two blocks of {1 / resolution:g} s", hint="a cascade needs a run")
    window = np.hanning(length + 1)[:-1]
    starts = [int(start) for start in np.linspace(0, samples.shape[0] - length, min(count, MOST_BLOCKS))]
    blocks = np.stack([samples[start : start + length] for start in starts])
    amplitude = 2 * np.abs(np.fft.rfft((blocks - blocks.mean(axis=1, keepdims=True)) * window[:, None], axis=1)) / window.sum()
    ends = [motion.angle(np.array([start, start + length]) / source.sample_rate) for start in starts]
    speed = np.array([float(np.diff(pair)[0]) for pair in ends]) * source.sample_rate / (2 * np.pi * length)
    frequency = np.arange(amplitude.shape[1]) * source.sample_rate / length
    inside = frequency <= orders * speed.max()
    labels = tuple(source.channels[number].name for number in outputs)
    return CascadeSpectra(speed, frequency[inside], amplitude[:, inside], labels)

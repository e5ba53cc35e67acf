"""Synchronous part of a recording (harmonics of the shaft speed): least-squares fit and subtraction in all channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import plain_text
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import Channel, SampleSource
from labpipe.spectra.reading import READ_SAMPLES, checked_blocks
from labpipe.spectra.settings import ShaftLines
from labpipe.spectra.shaft import STRETCH, ShaftMotion, shaft_motion, steady
from labpipe.spectra.windows import hann


@dataclass(frozen=True)
class WithoutSynchronous:
    """A recording minus its synchronous part; satisfies SampleSource. amplitude (n_harmonic, n_channel) complex, 0-to-peak [SI]."""

    source: SampleSource
    motion: ShaftMotion
    amplitude: ComplexArray

    @property
    def channels(self) -> tuple[Channel, ...]:
        return self.source.channels

    @property
    def sample_rate(self) -> float:
        return self.source.sample_rate

    @property
    def n_sample(self) -> int:
        return self.source.n_sample

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def findings(self) -> tuple[Finding, ...]:
        return (*self.source.findings, *_removed(self.source.channels, self.motion, self.amplitude))

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks of at most *n_sample* samples, (n, n_channel) [SI]: x - Re sum_h X_h exp(j h theta)."""
        start = 0
        for block in self.source.blocks(n_sample):
            turns = shaft_turns(self.motion, start, block.shape[0], self.sample_rate, self.amplitude.shape[0])
            yield block - turns.real @ self.amplitude.real + turns.imag @ self.amplitude.imag
            start += block.shape[0]


def without_synchronous(source: SampleSource, lines: ShaftLines) -> WithoutSynchronous:
    """The recording minus the first harmonics of the shaft speed, with amplitudes fitted to the whole recording.

    Time-synchronous averaging is the least-squares fit of all multiples of the speed (McFadden 1987); here of the first `harmonics`.
    A given speed is refined first, since an error of 0.01 Hz turns 1x by a revolution within 100 s. DataError for fewer than two
    revolutions. Equation (spec-synchronous).
    """
    motion = shaft_motion(source, lines)
    duration = source.n_sample / source.sample_rate
    turned = np.diff(motion.angle(np.array([0.0, duration])))[0] / (2 * np.pi)
    if turned < 2:
        raise DataError(f"recording '{source.name}' is shorter than two revolutions", hint="give the speed in Hz or rpm")
    amplitude = _fitted(source, motion, lines.harmonics)
    if lines.speed is not None:
        refined = steady(_refined(source, motion, lines.speed), duration)
        better = _fitted(source, refined, lines.harmonics)
        # Without 1x in the responses the refinement follows noise; then the given speed fits better.
        if np.sum(_shares(source, better)) > np.sum(_shares(source, amplitude)):
            motion, amplitude = refined, better
    return WithoutSynchronous(source, motion, amplitude * [is_cleaned(channel) for channel in source.channels])


def is_cleaned(channel: Channel) -> bool:
    """Whether a channel's synchronous part is taken out: not that of the tacho and of other references that are no force or motion."""
    return channel.role != "reference" or channel.quantity in ("force", "displacement", "velocity", "acceleration")


def _shares(source: SampleSource, amplitude: ComplexArray) -> FloatArray:
    """Power of the fitted harmonics of every output over that of the first block."""
    outputs = [number for number, channel in enumerate(source.channels) if channel.role == "output"]
    power = next(iter(source.blocks(READ_SAMPLES)))[:, outputs].var(axis=0)
    return np.sum(np.abs(amplitude[:, outputs]) ** 2, axis=0) / np.where(power > 0, power, 1.0)


def shaft_turns(motion: ShaftMotion, start: int, n_sample: int, sample_rate: float, n_harmonic: int) -> ComplexArray:
    """exp(j h theta) of h = 1 ... n_harmonic, (n_sample, n_harmonic) [1], from sample *start* on at *sample_rate* [Hz]."""
    angle = motion.angle((start + np.arange(n_sample)) / sample_rate)
    return np.exp(1j * angle[:, None] * np.arange(1, n_harmonic + 1))


def _fitted(source: SampleSource, motion: ShaftMotion, n_harmonic: int) -> ComplexArray:
    """Least squares of x = c + Re sum_h X_h exp(j h theta) over the whole recording, (n_harmonic, n_channel)."""
    n = 2 * n_harmonic + 1
    normal, right = np.zeros((n, n)), np.zeros((n, len(source.channels)))
    start = 0
    for block in checked_blocks(source):
        turns = shaft_turns(motion, start, block.shape[0], source.sample_rate, n_harmonic)
        columns = np.column_stack([np.ones(block.shape[0]), turns.real, -turns.imag])
        normal += columns.T @ columns
        right += columns.T @ block
        start += block.shape[0]
    solution = np.linalg.solve(normal, right)
    return solution[1 : n_harmonic + 1] + 1j * solution[n_harmonic + 1 :]


def _refined(source: SampleSource, motion: ShaftMotion, speed: float) -> float:
    """The speed [Hz] near *speed* at which 1x keeps its phase: d phi per STRETCH, every output weighted with its own power."""
    stretch = min(max(1, round(STRETCH / speed * source.sample_rate)), source.n_sample // 2)
    window = hann(stretch)
    outputs = [number for number, channel in enumerate(source.channels) if channel.role == "output"]
    amplitudes, rest, start = [], np.empty((0, len(outputs))), 0
    for block in source.blocks(READ_SAMPLES):
        samples = np.concatenate([rest, block[:, outputs]])
        n_whole = samples.shape[0] // stretch
        turns = shaft_turns(motion, start, n_whole * stretch, source.sample_rate, 1).conj().reshape(n_whole, stretch)
        pieces = samples[: n_whole * stretch].reshape(n_whole, stretch, len(outputs))
        amplitudes.append(np.einsum("s,ks,ksc->kc", window, turns, pieces - pieces.mean(axis=1, keepdims=True)))
        rest, start = samples[n_whole * stretch :], start + n_whole * stretch
    joined = np.concatenate(amplitudes)
    size = np.linalg.norm(joined, axis=0)
    joined = joined / np.where(size > 0, size, 1.0)
    turn = np.angle(np.sum(joined[1:] * joined[:-1].conj()))
    return speed + float(turn) / (2 * np.pi * stretch / source.sample_rate)


def _removed(channels: Sequence[Channel], motion: ShaftMotion, amplitude: ComplexArray) -> tuple[Finding, ...]:
    """Notes on the subtracted amplitudes of every channel, 0-to-peak."""
    low, high = motion.speed_range
    speed = f"{low:.6g} Hz" if high - low < 1e-9 * high else f"{low:.6g}-{high:.6g} Hz"
    return tuple(
        note(
            "synchronous-removed",
            f"channel {channel.name}: the part synchronous with {speed} was taken out, "
            + ", ".join(f"{order}x {plain_text(abs(value), channel.unit, 3)}" for order, value in enumerate(amplitudes, 1))
            + " 0-to-peak",
        )
        for channel, amplitudes in zip(channels, amplitude.T, strict=True)
        if is_cleaned(channel)
    )

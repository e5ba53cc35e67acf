"""Envelope and spectrum fed block by block, against the whole signal at once (envelope) and scipy's Welch
(spectrum).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from labpipe.raw_files.first_look import EnvelopeTrack, SpectrumTrack

RATE = 500.0


def fed(track: EnvelopeTrack | SpectrumTrack, rows: np.ndarray, cuts: list[int]) -> None:
    for block in np.split(rows, cuts):
        track.add(block)


@pytest.mark.parametrize(
    ("n", "stretches"), [(10, 16), (64, 16), (65, 16), (1000, 16), (4097, 64), (5000, 15)]
)
def test_the_envelope_is_that_of_the_whole_signal_however_it_is_cut(
    rng: np.random.Generator, n: int, stretches: int
) -> None:
    """Independent: smallest and largest of every step samples of the whole array.

    The step is the least power of two that suffices.
    """
    rows = rng.normal(size=(n, 2))
    track = EnvelopeTrack(2, stretches)
    fed(track, rows, sorted(rng.integers(0, n, 5).tolist()))
    for number, envelope in enumerate(track.envelopes()):
        step = envelope.step
        parts = [rows[start : start + step, number] for start in range(0, n, step)]
        np.testing.assert_array_equal(envelope.low, [part.min() for part in parts])
        np.testing.assert_array_equal(envelope.high, [part.max() for part in parts])
        assert envelope.low.size <= stretches + 1 and (step == 1 or n / step >= stretches / 2)


def test_a_long_recording_needs_no_more_than_a_short_one(rng: np.random.Generator) -> None:
    envelope, spectrum = EnvelopeTrack(1), SpectrumTrack(1)
    held = []
    for _ in range(300):
        block = rng.normal(size=(5000, 1))
        envelope.add(block)
        spectrum.add(block)
        held.append(
            sum(
                part.nbytes
                for track in (envelope, spectrum)
                for part in vars(track).values()
                if isinstance(part, np.ndarray)
            )
        )
    assert max(held[150:]) <= 2 * max(held[:10])


def test_missing_numbers_are_passed_over_by_the_envelope_and_their_blocks_by_the_spectrum(
    rng: np.random.Generator,
) -> None:
    rows = rng.normal(size=(4 * 256, 2))
    rows[300, 0] = np.nan
    envelope, spectrum = EnvelopeTrack(2, 8), SpectrumTrack(2, 256)
    envelope.add(rows)
    spectrum.add(rows)
    assert np.isfinite(envelope.envelopes()[0].low).all()
    assert [one.blocks for one in spectrum.spectra(RATE)] == [3, 4]


def test_the_spectrum_is_welch_s(rng: np.random.Generator) -> None:
    """Independent: scipy.signal.welch with the same blocks."""
    rows = rng.normal((3.0, -1.0), size=(10 * 256 + 100, 2))
    track = SpectrumTrack(2, 256)
    fed(track, rows, [7, 1000, 1001])
    for number, one in enumerate(track.spectra(RATE)):
        frequency, power = signal.welch(rows[: 10 * 256, number], RATE, "hann", 256, noverlap=0)
        np.testing.assert_allclose(one.frequency, frequency[1:])
        np.testing.assert_allclose(one.density, np.sqrt(power[1:]), rtol=1e-10)
        assert one.blocks == 10


def test_a_short_recording_is_one_block(rng: np.random.Generator) -> None:
    """Parseval: the densities' squares sum to the mean square of the windowed signal."""
    rows = rng.normal(size=(101, 1))
    track = SpectrumTrack(1)
    track.add(rows)
    (one,) = track.spectra(RATE)
    frequency, power = signal.welch(rows[:, 0], RATE, "hann", 101)
    np.testing.assert_allclose(one.density, np.sqrt(power[1:]), rtol=1e-10)
    assert one.frequency[-1] == pytest.approx(frequency[-1]) and one.blocks == 1


def test_nothing_recorded_gives_nothing() -> None:
    track = SpectrumTrack(1)
    track.add(np.empty((0, 1)))
    assert track.spectra(None)[0].blocks == 0
    assert EnvelopeTrack(1).envelopes()[0].low.size == 0

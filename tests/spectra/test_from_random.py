"""The spectra of random data over a recording, and those over its first half."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.random import welch_average
from labpipe.spectra.random_lines import lower_of_drives
from labpipe.spectra.settings import FrfSettings

CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))
SETTINGS = FrfSettings(excitation="random", block=0.5, band=(4.0, 60.0))
BLOCK, RATE = 64, 128.0


@pytest.mark.parametrize("blocks", [2, 3, 5])
def test_the_first_half_is_that_of_the_recording_cut_there(rng: np.random.Generator, blocks: int) -> None:
    whole = Recording(CHANNELS, rng.normal(size=(blocks * BLOCK, 2)), RATE, "run")
    _, half = welch_average(whole, SETTINGS)
    first, _ = welch_average(replace(whole, samples=whole.samples[: blocks * BLOCK // 2]), SETTINGS)
    assert half is not None
    np.testing.assert_allclose(half.matrix, first.matrix, rtol=1e-12, atol=1e-15)


def test_half_a_recording_shorter_than_a_block_has_no_spectra(rng: np.random.Generator) -> None:
    recording = Recording(CHANNELS, rng.normal(size=(2 * BLOCK - 1, 2)), RATE, "run")
    assert welch_average(recording, SETTINGS)[1] is None
    with pytest.raises(DataError, match="holds 3 samples"):
        welch_average(recording, replace(SETTINGS, block=0.02))


def test_a_drive_that_is_silent_or_follows_from_others_is_named() -> None:
    """L L^H of independent drives is their spectrum; two without power, and three of which one is the sum."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(5, 3, 3)) + 1j * rng.normal(size=(5, 3, 3))
    power = root @ root.conj().swapaxes(1, 2)
    lower = lower_of_drives(power, "abc")
    np.testing.assert_allclose(lower @ lower.conj().swapaxes(1, 2), power, rtol=1e-12)
    silent = power.copy()
    silent[3, 1:] = silent[3, :, 1:] = 0
    with pytest.raises(DataError, match="the drive b is silent in the band"):
        lower_of_drives(silent, "abc")
    mixed = np.array([[1, 0, 0], [0, 1, 0], [1, 1, 0]]) @ root
    with pytest.raises(DataError, match="the references a, b, c are not independent"):
        lower_of_drives(mixed @ mixed.conj().swapaxes(1, 2), "abc", "reference")

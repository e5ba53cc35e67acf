"""The spectra of random data over a recording, and those over its first half."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.random import welch_average
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

"""Blocks on their way to the spectra: what is wrong with them is named."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.channels import READ_SAMPLES, checked_blocks

CHANNELS = (Channel("f", "force", "input", "x"), Channel("x", "displacement", "output", "x"))


class Stored(Recording):
    """A recording on disk may hold what one in memory is refused for: the fault is put in on reading."""

    def blocks(self, n_sample: int) -> Iterator[np.ndarray]:
        for number, block in enumerate(super().blocks(n_sample)):
            changed = block.copy()
            if number == 1:
                changed[2, 1] = self.conditions["value"]
            yield changed


def stored(rng: np.random.Generator, value: float) -> Stored:
    return Stored(
        CHANNELS, rng.normal(size=(READ_SAMPLES + 10, 2)), 100.0, "run", conditions={"value": value}
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_sample_that_is_no_number_is_named(rng: np.random.Generator, value: float) -> None:
    where = (
        rf"channel 'x' of 'run' has no number at sample {READ_SAMPLES + 2} \({(READ_SAMPLES + 2) / 100:g} s\)"
    )
    with pytest.raises(DataError, match=where):
        list(checked_blocks(stored(rng, value)))


def test_huge_numbers_are_numbers(rng: np.random.Generator) -> None:
    # Their sum is beyond the largest number; each of them is not.
    samples = rng.normal(size=(100, 2))
    samples[[3, 4], 1] = 1.7e308
    blocks = list(checked_blocks(Recording(CHANNELS, samples, 100.0, "run")))
    np.testing.assert_array_equal(np.concatenate(blocks), samples)


def test_a_force_that_never_moves_is_named_a_response_is_not() -> None:
    samples = np.zeros((READ_SAMPLES + 5, 2))
    with pytest.raises(DataError, match="force channel 'f' of 'run' does not vary"):
        list(checked_blocks(Recording(CHANNELS, samples, 100.0, "run")))
    samples[-1, 0] = 1e-30
    assert (
        sum(block.shape[0] for block in checked_blocks(Recording(CHANNELS, samples, 100.0, "run")))
        == READ_SAMPLES + 5
    )

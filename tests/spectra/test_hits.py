"""Where a hit begins, ends, is double or overloaded: by hand-made samples whose answer is counted on
fingers.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.records.recording import Channel, Recording
from labpipe.spectra.impact import find_hits, find_overloaded, is_double
from labpipe.spectra.settings import ImpactSettings
from labpipe.spectra.windows import exponential_window, force_window


@pytest.mark.parametrize(
    ("force", "double"),
    [
        # Share 0.4: contact has ended below 0.2.
        ([0, 1, 0.3, 0.5, 0], False),
        ([0, 1, 0.21, 0.5, 0], False),
        ([0, 1, 0.19, 0.5, 0], True),
        ([0, -2, -0.38, 1.0, 0], True),
        ([0, 1, 0.1, 0.39, 0], False),
        ([0, 1, 0.1, 0.4, 0], True),
        ([0, 0.5, 0.1, 1, 0], True),
        ([0, 1, 0.9, 0.8, 0.1, 0], False),
        ([0, 1, 0.3, 0.5, 0.1, 0.5, 0], True),
    ],
)
def test_a_double_hit_ends_and_comes_again(force: list[float], double: bool) -> None:
    assert is_double(np.array(force, float), 0.4) is double


@pytest.mark.parametrize(
    ("column", "clipped"),
    [
        ([0, 1, 5, 5, 5, 1, 0], True),
        ([0, 1, 5, 5, 1, 5, 0], False),
        ([0, -1, -5, -5, -5, -1, 0], True),
        # Three equal ones at the smaller end: beyond half the peak they count, at the zero level they do not.
        ([0, 8, -5, -5, -5, 1, 0], True),
        ([0, 10, -5, -5, -5, 1, 0], False),
        ([0, 0, 0, 5, 4, 3, 2], False),
    ],
)
def test_an_overload_stands_at_the_end_of_the_range(column: list[float], clipped: bool) -> None:
    beside = np.linspace(0, 1, len(column))
    assert find_overloaded(np.column_stack([beside, column])).tolist() == [False, clipped]


def test_windows_at_their_corners() -> None:
    """One up to 10 samples after the hit at 2, half at the middle of a flank of one sample, zero from 13 on.

    1/e after the constant.
    """
    window = force_window(20, 2, 10.0)
    assert window[:13].tolist() == [1.0] * 13 and np.allclose(window[13:], 0)
    assert force_window(20, 2, 9.5)[12] == pytest.approx(0.5 + 0.5 * np.cos(np.pi * 0.5 / 0.95))
    assert exponential_window(9, 4.0)[[0, 4, 8]] == pytest.approx([1, np.exp(-1), np.exp(-2)])


def test_blocks_begin_before_their_hits_and_lose_their_offset() -> None:
    """Hits at samples 100 and 300 of 500, blocks of 50 with a tenth before.

    A zero level of 3 N and of 7 m is taken away.
    """
    force, x = np.full(500, 3.0), np.full(500, 7.0)
    for hit in (100, 300):
        force[hit : hit + 3] += (8.0, 10.0, 6.0)
        x[hit + 1] += 2.0
    channels = Channel("f", "force", "input", "x"), Channel("x", "displacement", "output", "x")
    recording = Recording(channels, np.column_stack([force, x]), 100.0, "hits")
    settings = ImpactSettings(trigger=0.5, pretrigger=0.1)
    hits = list(find_hits(recording, 0, 50, settings))
    assert [(hit.number, hit.start, hit.trigger) for hit in hits] == [(1, 95, 5), (2, 295, 5)]
    assert [hit.fault for hit in hits] == ["", ""]
    assert (
        hits[0].samples[:, 0].max() == 10.0 and hits[0].samples[6, 1] == 2.0 and not hits[0].samples[:5].any()
    )

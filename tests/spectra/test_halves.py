"""The change between the halves of a record: the FRF of the one cut out less that of the other, whatever the
blocks it is read in.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.convert import convert, directional
from labpipe.spectra.measurement import measure
from labpipe.spectra.random import cut_at
from labpipe.spectra.settings import FrfSettings

RATE, N = 100.0, 4000
RANDOM = FrfSettings(excitation="random", block=2.0, overlap=0.0, band=(5.0, 40.0))
PERIODIC = FrfSettings(excitation="periodic", period=2.0, skip=2, smooth=0)


def recording(samples: np.ndarray, name: str, dof: str = "x") -> Recording:
    channels = (
        Channel("f", "force", "input", dof, 0.0 if dof == "x" else np.pi / 2),
        Channel("x", "displacement", "output", "x", 0.0),
        Channel("y", "displacement", "output", "y", np.pi / 2),
    )
    return Recording(channels, samples, RATE, name)


def samples_of(seed: int, period: int = N) -> np.ndarray:
    """A force, periodic in *period* samples, and two responses that follow it with a delay and noise.

    X grows by 10 % on the way.
    """
    rng = np.random.default_rng(seed)
    force = np.tile(rng.normal(size=period), N // period)
    x = (np.roll(force, 1) + 0.5 * np.roll(force, 2)) * np.linspace(1, 1.1, N)
    return np.column_stack([force, x, -np.roll(force, 3)]) + 0.01 * rng.normal(size=(N, 3))


def two_directions(period: int = N) -> list[Recording]:
    return [
        recording(samples_of(1, period), "along x", "x"),
        recording(samples_of(2, period), "along y", "y"),
    ]


def halves(recordings: list[Recording], first: int = 0) -> tuple[list[Recording], list[Recording]]:
    """Both halves of what comes after *first* samples, each with these samples before it."""
    middle = (N + first) // 2
    before = [replace(one, samples=one.samples[:middle]) for one in recordings]
    after = [
        replace(one, samples=np.vstack([one.samples[:first], one.samples[middle:]])) for one in recordings
    ]
    return before, after


@pytest.mark.parametrize("estimator", ["H1", "Hv"])
def test_random(estimator: str) -> None:
    settings = replace(RANDOM, estimator=estimator)
    whole, (before, after) = measure(two_directions(), settings), halves(two_directions())
    expected = measure(after, settings).matrix - measure(before, settings).matrix
    assert whole.change is not None
    np.testing.assert_allclose(whole.change, expected, rtol=1e-9, atol=1e-12)
    # Twice the mean of 10 % over half of the record: x changes by 5 % of itself, y does not.
    ratio = np.mean((whole.change / whole.matrix)[:, :, 0].real, axis=0)
    np.testing.assert_allclose(ratio, [0.05 / 1.05, 0.0], atol=0.005)


def test_periodic() -> None:
    """Two periods of 20 are skipped, nine are in each half."""
    recordings = two_directions(period=200)
    whole, (before, after) = measure(recordings, PERIODIC), halves(recordings, first=400)
    expected = measure(after, PERIODIC).matrix - measure(before, PERIODIC).matrix
    assert whole.change is not None and whole.averages == 18
    np.testing.assert_allclose(whole.change, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("overlap", [0.5, 0.75])
def test_blocks_over_the_middle_belong_to_the_second_half(overlap: float) -> None:
    """The first half is exactly a record of half the length; the rest is what the whole has beyond it."""
    settings = replace(RANDOM, overlap=overlap)
    whole, (before, _) = measure(two_directions(), settings), halves(two_directions())
    first = measure(before, settings)
    assert whole.change is not None
    # H of the whole lies between those of its parts: nearly in the middle, since their numbers of blocks are
    # nearly the same.
    middle = first.matrix + whole.change / 2
    assert np.linalg.norm(whole.matrix - middle) < 0.1 * np.linalg.norm(whole.change)


@pytest.mark.parametrize(
    "lengths", [[4000], [1999, 1, 2000], [2000, 2000], [1500, 1000, 1500], [7] * 571 + [3]]
)
def test_blocks_are_cut_where_the_half_ends(lengths: list[int]) -> None:
    samples = np.arange(4000.0)[:, None]
    blocks = np.split(samples, np.cumsum(lengths)[:-1])
    pieces = list(cut_at(blocks, 2000))
    np.testing.assert_array_equal(np.vstack([piece for piece, _ in pieces]), samples)
    (end,) = [number for number, (_, ends) in enumerate(pieces) if ends]
    assert sum(piece.shape[0] for piece, _ in pieces[: end + 1]) == 2000


def test_a_short_record_has_no_change() -> None:
    short = [replace(one, samples=one.samples[:1200]) for one in two_directions()]
    assert measure(short, RANDOM).change is None
    single = [replace(one, samples=one.samples[:600]) for one in two_directions(period=200)]
    assert measure(single, PERIODIC).change is None


def whole_response() -> FrequencyResponse:
    return measure(two_directions(), RANDOM)


def test_it_is_turned_and_converted_as_the_response_is() -> None:
    """Both are linear in H, so the change of the turned response is the turned change."""
    whole, (before, after) = whole_response(), halves(two_directions())
    for turned in (directional, lambda response: convert(response, "accelerance")):
        expected = turned(measure(after, RANDOM)).matrix - turned(measure(before, RANDOM)).matrix
        change = turned(whole).change
        assert change is not None
        np.testing.assert_allclose(change, expected, rtol=1e-9, atol=1e-9 * np.max(np.abs(expected)))


def test_it_is_kept_in_the_file_of_the_response(tmp_path: Path) -> None:
    whole = whole_response()
    write_response(tmp_path / "a.frf.parquet", whole, Header("frf", {}, inputs=()))
    change = read_response(tmp_path / "a.frf.parquet").change
    assert change is not None and whole.change is not None
    np.testing.assert_array_equal(change, whole.change)
    write_response(tmp_path / "b.frf.parquet", replace(whole, change=None), Header("frf", {}, inputs=()))
    assert read_response(tmp_path / "b.frf.parquet").change is None

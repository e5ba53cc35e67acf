"""Speed of the spectra as ratios within one run, on the white-noise measurement of a rotor: 860,000 samples
of 2 forces and 2 responses.

The figures are printed; a test fails only where a ratio is grossly missed, about twice what the page of costs
states, since other work on the same machine and on its neighbours disturbs them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy import fft, signal

from labpipe.cli.main import run_command
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.welch import WelchAverage
from labpipe.spectra.windows import window_values
from tests.benchmarks.raw_files import WHOLE, bare, write_raw
from tests.benchmarks.test_identify_ratios import cpu_time
from tests.spectra.roving import hits

RATE, BLOCK = 1024.0, 5120
STEP = BLOCK // 2
CHANNELS = (
    Channel("f_y", "force", "input", "x", 0.0),
    Channel("f_z", "force", "input", "y", np.pi / 2),
    Channel("y", "displacement", "output", "x", 0.0),
    Channel("z", "displacement", "output", "y", np.pi / 2),
)
SETTINGS = FrfSettings(excitation="random", block=5.0)


@pytest.fixture(scope="module")
def samples() -> np.ndarray:
    return np.random.default_rng(1).normal(size=(860_000, 4))


def ratios(
    floor: Callable[[], object],
    *actions: Callable[[], object],
    repeats: int = 9,
    clock: Callable[[], float] = time.process_time,
) -> list[float]:
    """Least time of each action, of the processor or by another *clock*, over the least of *floor*, all
    measured in turns.
    """
    everything = (floor, *actions)
    times = np.empty((repeats, len(everything)))
    for turn in range(repeats):
        for number, action in enumerate(everything):
            start = clock()
            action()
            times[turn, number] = clock() - start
    least = times.min(axis=0)
    return [float(value) for value in least[1:] / least[0]]


def bare_ffts(columns: np.ndarray, block: int = BLOCK) -> None:
    """scipy.fft.rfft of every segment of every channel, (n_channel, n_sample), and nothing else."""
    for start in range(0, columns.shape[1] - block + 1, block // 2):
        fft.rfft(columns[:, start : start + block], axis=1)


@pytest.mark.parametrize(("block", "most", "least"), [(BLOCK, 8, 6), (25_600, 6, 4)])
def test_mimo_frf_in_memory_against_the_bare_ffts_and_scipy(
    samples: np.ndarray, capsys: pytest.CaptureFixture[str], block: int, most: float, least: float
) -> None:
    recording, columns = Recording(CHANNELS, samples, RATE, "run"), np.ascontiguousarray(samples.T)
    settings = FrfSettings(excitation="random", block=block / RATE)

    def pair_by_pair() -> None:
        for a in range(4):
            for b in range(a, 4):
                signal.csd(columns[a], columns[b], fs=RATE, nperseg=block, noverlap=block // 2)

    own, peer = ratios(
        lambda: bare_ffts(columns, block), lambda: measure([recording], settings), pair_by_pair, repeats=9
    )
    with capsys.disabled():
        print(
            f"\nMIMO FRF with covariance, blocks of {block}: {own:.2f} times the bare FFTs; "
            f"scipy.signal.csd {peer:.1f} times"
        )
    assert own < most
    assert peer > least * own


def test_frf_of_many_channels_in_memory_against_the_bare_ffts(capsys: pytest.CaptureFixture[str]) -> None:
    # 8 responses to 2 forces; the covariance of the 16 elements stays in its factors, as long as nobody reads
    # it.
    forces = tuple(Channel(f"f{n}", "force", "input", f"d{n}") for n in range(2))
    responses = tuple(Channel(f"y{n}", "displacement", "output", f"d{n}") for n in range(8))
    samples = np.random.default_rng(2).normal(size=(1_200_000, 10))
    recording, columns = (
        Recording((*forces, *responses), samples, RATE, "run"),
        np.ascontiguousarray(samples.T),
    )
    settings = FrfSettings(excitation="random", block=25_600 / RATE)
    (own,), (by_clock,) = (
        ratios(
            lambda: bare_ffts(columns, 25_600), lambda: measure([recording], settings), repeats=3, clock=clock
        )
        for clock in (time.process_time, time.perf_counter)
    )
    with capsys.disabled():
        print(
            f"\nFRF of 8 responses to 2 forces, blocks of 25,600: {own:.2f} times the bare FFTs; "
            f"{by_clock:.2f} times by the clock"
        )
    assert own < 9


def test_the_matrix_is_that_of_scipy_to_1e10(samples: np.ndarray) -> None:
    average = WelchAverage(window_values("hann", BLOCK), STEP, 4)
    for start in range(0, samples.shape[0], 50_000):
        average.add(samples[start : start + 50_000])
    matrix = average.spectra(RATE).matrix
    for a, b in ((0, 0), (2, 1), (3, 2), (3, 3)):
        _, expected = signal.csd(samples[:, b], samples[:, a], fs=RATE, nperseg=BLOCK, noverlap=BLOCK - STEP)
        np.testing.assert_allclose(
            matrix[:-1, a, b], expected[1:-1], rtol=0, atol=1e-10 * np.abs(expected).max()
        )


def test_block_size_of_the_reader_changes_nothing_but_rounding(samples: np.ndarray) -> None:
    matrices = []
    for size in (7_777, 65_536, samples.shape[0]):
        average = WelchAverage(window_values("hann", BLOCK), STEP, 4)
        for start in range(0, samples.shape[0], size):
            average.add(samples[start : start + size])
        matrices.append(average.spectra(RATE).matrix)
    for matrix in matrices[1:]:
        np.testing.assert_allclose(matrix, matrices[0], rtol=0, atol=1e-14 * np.abs(matrices[0]).max())


def test_from_parquet_against_bare_read_and_bare_ffts(
    samples: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from labpipe.artefacts.header import Header
    from labpipe.artefacts.recording_file import RecordingWriter, open_recording, recording_contents

    path = tmp_path / "run.recording.parquet"
    with RecordingWriter(path, CHANNELS) as writer:
        for start in range(0, samples.shape[0], 1 << 16):
            writer.write(samples[start : start + (1 << 16)])
        writer.finish(Header("recording", {}, inputs=(), contents=recording_contents(CHANNELS, RATE, "run")))
    recording, columns = open_recording(path), np.ascontiguousarray(samples.T)

    def bare() -> None:
        read: pa.Table = pq.read_table(path, use_threads=False)
        assert read.num_rows == samples.shape[0]
        bare_ffts(columns)

    (own,) = ratios(bare, lambda: measure([recording], SETTINGS), repeats=5)
    with capsys.disabled():
        print(f"\nMIMO FRF from Parquet: {own:.2f} times a bare read and the bare FFTs")
    assert own < 6


@pytest.mark.parametrize(("kind", "most"), [("parquet", 4), ("tdms", 6), ("csv", 4)])
def test_a_raw_file_to_its_frf_by_the_command_against_bare_read_and_bare_ffts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, most: float
) -> None:
    """What users run: a logger's file is read, screened, calibrated and measured; of CSV by way of a
    calibrated recording.

    Of fewer rows what a command costs at least, about 0.2 s, is most of it; `python -m
    tests.benchmarks.raw_files` takes large files.
    """
    write_raw(tmp_path, kind, 860_000 if kind == "csv" else 2_580_000, BLOCK)
    turn = count()

    def by_command() -> None:
        assert (
            run_command(
                ["frf", "-c", str(tmp_path / f"{kind}.yaml"), "-o", str(tmp_path / f"out{next(turn)}"), "-q"]
            )
            == 0
        )

    (own,) = ratios(lambda: bare(str(tmp_path / f"raw.{kind}"), BLOCK, WHOLE), by_command, repeats=7)
    with capsys.disabled():
        print(f"\nRaw {kind} to FRF by the command: {own:.2f} times a bare read and the bare FFTs")
    assert own < most


def test_a_roving_hammer_costs_in_proportion_to_its_hits(record_property) -> None:  # type: ignore[no-untyped-def]
    """Time of 80 hits over that of 20: an exponent of 1 is in proportion."""
    recordings, settings = hits(80, 3, 2048), FrfSettings(excitation="impact", block=0.5, band=(80.0, 1250.0))
    few, many = (cpu_time(lambda some=recordings[:n]: measure(some, settings), 3) for n in (20, 80))
    exponent = float(np.log(many / few) / np.log(4))
    record_property("roving_hits_exponent", round(exponent, 2))
    assert exponent < 1.3

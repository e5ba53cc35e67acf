"""A roving hammer: columns of their own, memory that grows with the hits, modes from raw files."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.records.recording import Recording
from labpipe.records.response import BlockCovariance, shown_part
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, ImpactSettings
from tests.conftest import Command
from tests.spectra.roving import DAMPING, FREQUENCIES, hits, write_pipeline


def twice(recordings: list[Recording], rng: np.random.Generator, noise: float = 1.0) -> list[Recording]:
    """Every point hit twice: the second time with other noise, *noise* times usual."""
    both = []
    for first in recordings:
        again = (
            first.samples
            + noise
            * rng.normal(0, 1, first.samples.shape)
            * np.r_[0.05, 4e-3 * np.abs(first.samples[:, 1:]).max(axis=0)]
        )
        # The block of a hit begins shortly before it, so that of the last ends beyond its samples.
        rest = again[-64:]
        both.append(
            Recording(first.channels, np.vstack([first.samples, again, rest]), first.sample_rate, first.name)
        )
    return both


def settings(n_sample: int, decay: float | None = None) -> FrfSettings:
    impact = ImpactSettings(decay=decay)
    return FrfSettings(excitation="impact", block=n_sample / 4096, band=(80.0, 1250.0), impact=impact)


@pytest.mark.parametrize("decay", [None, 0.1])
def test_columns_are_those_of_their_hits_alone(decay: float | None, rng: np.random.Generator) -> None:
    """H and, with the noise of all hits and as many degrees of freedom, the covariance of a column are those
    of its recording. Of little noise, so that every column has two poles under the window, as one whose
    noise is not known.
    """
    recordings = twice(hits(4, 2, 1024, noise=0.02), rng, 0.02)
    together = measure(recordings, settings(1024, decay))
    assert isinstance(together.stored_covariance, BlockCovariance)
    for column, recording in enumerate(recordings):
        alone = measure([recording], settings(1024, decay))
        np.testing.assert_allclose(together.matrix[:, :, column], alone.matrix[:, :, 0], rtol=1e-9)
    covariance = together.covariance
    assert covariance is not None
    # Nothing couples the columns.
    other = np.arange(8)[:, None] % 4 != np.arange(8) % 4
    assert not np.any(covariance[:, other]) and np.all(np.einsum("lii->li", covariance).real > 0)
    np.testing.assert_allclose(covariance, covariance.conj().swapaxes(1, 2), rtol=1e-12)


@pytest.mark.long
def test_the_predicted_variance_is_the_scatter_of_repeats(rng: np.random.Generator) -> None:
    """Noise of one level on all responses: variance over 30 repeats of three points hit three times each,
    over its mean prediction.
    """
    plain = hits(3, 2, 4096, noise=0.0)

    def drawn(recording: Recording) -> Recording:
        samples = np.vstack([*[recording.samples] * 3, recording.samples[-64:]])
        noise = rng.normal(size=samples.shape) * [0.0, 3.0, 3.0]
        return Recording(recording.channels, samples + noise, recording.sample_rate, recording.name)

    measured = [measure([drawn(recording) for recording in plain], settings(4096)) for _ in range(30)]
    scatter = np.mean(np.var([part.matrix for part in measured], axis=0, ddof=1), axis=0)
    predicted = np.mean([part.variance for part in measured], axis=(0, 1))
    assert np.mean(scatter / predicted) == pytest.approx(1.0, abs=0.1)


def test_blocks_read_as_the_whole_covariance(tmp_path: Path, rng: np.random.Generator) -> None:
    """Selection, scaling, elements, file: against the dense matrix."""
    response = measure(twice(hits(3, 2, 1024), rng), settings(1024))
    held = response.stored_covariance
    assert isinstance(held, BlockCovariance)
    whole = held.whole()
    index, lines = [5, 3, 2, 0], np.arange(len(whole)) % 2 == 0
    np.testing.assert_array_equal(held.choose(lines, index).whole(), whole[lines][:, index][:, :, index])
    factor = rng.normal(size=(len(whole), 6)) + 1j
    np.testing.assert_allclose(
        held.times(factor).whole(), whole * factor[:, :, None] * factor[:, None].conj(), rtol=1e-12
    )
    np.testing.assert_array_equal(held.element(1, 4), whole[:, 1, 4])
    np.testing.assert_array_equal(held.element(1, 3), np.zeros(len(whole)))
    write_response(tmp_path / "r.frf.parquet", response, Header("frf", {}, inputs=()))
    again = read_response(tmp_path / "r.frf.parquet")
    assert isinstance(again.stored_covariance, BlockCovariance)
    np.testing.assert_array_equal(again.covariance, whole)


def test_a_large_response_is_shown_in_part(rng: np.random.Generator) -> None:
    n = 60
    response = measure(hits(n, 2, 4096), settings(4096))
    part = shown_part(response)
    assert part.matrix.size <= 10_000 and len(part.outputs) == 2
    assert [finding.code for finding in part.findings if finding.code == "part-shown"]
    column = [port.label for port in response.inputs].index(part.inputs[-1].label)
    np.testing.assert_array_equal(part.matrix[:, :, -1], response.matrix[:, :, column])


@pytest.mark.long
def test_memory_grows_with_the_number_of_hits() -> None:
    """Bytes at the peak beyond those of the samples, 10 against 40 hits: in proportion to the hits, not to
    their square.
    """

    def peak(n_hit: int) -> int:
        recordings = hits(n_hit, 3, 1024)
        measure(recordings[:2], settings(1024))
        tracemalloc.start()
        measure(recordings, settings(1024))
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    assert np.log(peak(40) / peak(10)) / np.log(4) < 1.15


@pytest.mark.long
def test_nine_modes_from_raw_files(tmp_path: Path, labpipe: Command) -> None:
    """From CSV to modes, result and report: the closed-form frequencies and damping ratios.

    A result below 5 MB.
    """
    path = write_pipeline(tmp_path, hits(40), 30)
    labpipe("run", path, "-o", tmp_path / "out")
    fit = json.loads((tmp_path / "out" / "identification.json").read_text())["fits"][0]
    values = {parameter["name"]: parameter["value"] for parameter in fit["parameters"]}
    frequencies = [values[f"f_n_{n}"] for n in range(1, 10)]
    assert "f_n_10" not in values
    np.testing.assert_allclose(frequencies, FREQUENCIES, rtol=2e-4)
    np.testing.assert_allclose([values[f"zeta_{n}"] for n in range(1, 10)], DAMPING, rtol=0.03)
    assert (tmp_path / "out" / "identification.json").stat().st_size < 5e6
    assert (tmp_path / "out" / "report.html").stat().st_size < 3e6

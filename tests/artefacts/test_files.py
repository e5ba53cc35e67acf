"""Recordings, responses and fits on disk: round trips by generated examples, freshness, and what is
refused.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.header import Header, SourceRef
from labpipe.artefacts.identification_file import has_fresh_fits, read_fits, read_identification, write_fits
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.artefacts.parquet import HEADER_KEY
from labpipe.artefacts.recording_file import RecordingWriter, open_recording, recording_contents
from labpipe.errors import DataError
from labpipe.estimation.settings import FitSettings
from labpipe.records.finding import Finding, note
from labpipe.records.identification import Fit, Goodness
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import Blocks, FrequencyResponse, Port
from tests.artefacts.any_record import complex_arrays, fits, responses, same

CHECKS = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]
HEADER = Header("frf", {"period": 1.0}, inputs=(SourceRef("a.csv", "00"),))


# recordings


CHANNELS = (
    Channel("f", "force", "input", "45 deg", math.pi / 4),
    Channel(
        "y [um]", "displacement", "output", "y", math.pi / 2, 2e-5, ((10.0, 1.0, 0.0), (100.0, 0.9, -0.1))
    ),
    Channel("t", "temperature", "reference", "t"),
)


def written(folder: Path, samples: np.ndarray, block: int, *findings: Finding) -> Path:
    path = folder / "a.recording.parquet"
    with RecordingWriter(path, CHANNELS) as writer:
        for start in range(0, len(samples), block):
            writer.write(samples[start : start + block])
        writer.finish(
            Header(
                "recording",
                {"name": "rig"},
                inputs=HEADER.inputs,
                findings=findings,
                contents=recording_contents(CHANNELS, 200.0, "run 7"),
            )
        )
    return path


@settings(max_examples=30, suppress_health_check=CHECKS)
@given(st.integers(1, 50), st.integers(1, 60), st.integers(1, 60))
def test_a_recording_is_the_same_however_it_was_cut(
    tmp_path: Path, n_sample: int, written_block: int, read_block: int
) -> None:
    samples = np.random.default_rng(n_sample).normal(size=(n_sample, 3))
    stored = open_recording(written(tmp_path, samples, written_block))
    parts = list(stored.blocks(read_block))
    assert stored.n_sample == n_sample and all(1 <= len(part) <= read_block for part in parts)
    np.testing.assert_array_equal(np.concatenate(parts), samples)
    np.testing.assert_array_equal(stored.in_memory().samples, samples)


def test_a_recording_keeps_its_channels_rate_name_and_findings(tmp_path: Path) -> None:
    findings = (Finding("gap", "12 samples at 3 s"), note("masked", "50 Hz"))
    stored = open_recording(written(tmp_path, np.zeros((4, 3)), 4, *findings))
    assert (stored.channels, stored.sample_rate, stored.name, stored.findings) == (
        CHANNELS,
        200.0,
        "run 7",
        findings,
    )
    whole = stored.in_memory()
    assert isinstance(whole, Recording) and (whole.channels, whole.name, whole.findings) == (
        CHANNELS,
        "run 7",
        findings,
    )


def test_the_unit_stands_beside_each_channel_for_other_programs(tmp_path: Path) -> None:
    stored = open_recording(written(tmp_path, np.zeros((1, 3)), 1))
    assert [entry["unit"] for entry in stored.header.contents["channels"]] == ["N", "m", "K"]


def test_the_same_samples_give_the_same_bytes(tmp_path: Path) -> None:
    samples = np.random.default_rng(1).normal(size=(100, 3))
    contents = [written(tmp_path, samples, 40).read_bytes() for _ in range(2)]
    assert contents[0] == contents[1]


def test_a_recording_without_a_column_of_its_channel_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, np.zeros((4, 3)), 4)
    header = {HEADER_KEY: open_recording(path).header.to_json().encode()}
    pq.write_table(pq.read_table(path).drop_columns(["f", "t"]).replace_schema_metadata(header), path)
    with pytest.raises(DataError, match="lacks the column of channel f, t"):
        open_recording(path)


def test_samples_that_are_no_number_are_found_in_memory(tmp_path: Path) -> None:
    samples = np.zeros((4, 3))
    samples[2, 0] = np.nan
    with pytest.raises(DataError, match=r"recording 'run 7' is not finite at index \(2, 0\)"):
        open_recording(written(tmp_path, samples, 4)).in_memory()


# responses


@st.composite
def correlated(draw: st.DrawFn) -> FrequencyResponse:
    """A response with a full Hermitian covariance."""
    plain = draw(responses())
    n = plain.matrix[0].size
    root = draw(complex_arrays(plain.n_frequency, n, n).map(lambda part: part / (1 + np.abs(part))))
    covariance = root @ root.conj().swapaxes(1, 2)
    # The lower triangle is the conjugate of the upper one to the last digit, as the file keeps one of them.
    upper = np.triu(covariance, 1)
    diagonal = np.einsum("fii->fi", covariance).real[:, :, None] * np.eye(n)
    correlation, n_gain = draw(st.sampled_from([((), 0), ((0.4, 0.1), 0), ((0.5 - 0.4j, 0.2j), 3)]))
    gains = np.stack([plain.matrix / (place + 1) for place in range(n_gain)], axis=1) if n_gain else None
    whole = upper + upper.conj().swapaxes(1, 2) + diagonal
    blocks = draw(st.sampled_from([None, Blocks(0.5, "hann", 0.5, 40, "H1", 2, -2)]))
    return replace(plain, covariance=whole, line_correlation=correlation, line_gains=gains, blocks=blocks)


@pytest.mark.long
@settings(max_examples=20, suppress_health_check=CHECKS)
@given(correlated(), st.permutations(["x", "y", "bearing2.y", "45 deg"]))
def test_a_response_keeps_everything_it_has(
    tmp_path: Path, response: FrequencyResponse, labels: list[str]
) -> None:
    outputs = tuple(replace(port, label=label) for port, label in zip(response.outputs, labels, strict=False))
    inputs = tuple(
        replace(port, label=f"f{label}") for port, label in zip(response.inputs, labels, strict=False)
    )
    channels = tuple(f"ch{n}" for n in range(len(response.snr_channels)))
    whole = replace(response, outputs=outputs, inputs=inputs, snr_channels=channels)
    write_response(tmp_path / "a.frf.parquet", whole, HEADER)
    assert same(read_response(tmp_path / "a.frf.parquet"), whole)


def plain_response() -> FrequencyResponse:
    matrix = np.arange(1.0, 4.0)[:, None, None] * (1 + 2j)
    return FrequencyResponse(
        np.array([1.0, 2.0, 3.0]), matrix, (Port("y", "y", "y"),), (Port("f", "f", "y"),), name="427N"
    )


def test_real_and_imaginary_parts_are_columns_that_any_program_reads(tmp_path: Path) -> None:
    write_response(tmp_path / "a.frf.parquet", plain_response(), HEADER)
    table = pq.read_table(tmp_path / "a.frf.parquet")
    assert table.column_names == ["frequency_hz", "y/f:re", "y/f:im"]
    assert table["y/f:im"].to_pylist() == [2.0, 4.0, 6.0]


def test_a_response_of_the_first_files_has_real_correlations_and_no_gains(tmp_path: Path) -> None:
    path = tmp_path / "a.frf.parquet"
    write_response(path, replace(plain_response(), line_correlation=(0.45, 0.03)), HEADER)
    table = pq.read_table(path)
    header = json.loads(table.schema.metadata[HEADER_KEY])
    assert header["contents"]["line_correlation"] == [0.45, 0.03]
    del header["contents"]["line_gains"], header["contents"]["blocks"]
    pq.write_table(table.replace_schema_metadata({HEADER_KEY: json.dumps(header)}), path)
    response = read_response(path)
    assert (
        response.line_correlation == (0.45, 0.03) and response.line_gains is None and response.blocks is None
    )


def test_the_same_response_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_response(tmp_path / name, plain_response(), HEADER)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_response_is_no_recording_and_the_other_way_round(tmp_path: Path) -> None:
    write_response(tmp_path / "a.frf.parquet", plain_response(), HEADER)
    with pytest.raises(DataError, match="is a frf file, a recording file is needed"):
        open_recording(tmp_path / "a.frf.parquet")
    recording = written(tmp_path, np.zeros((1, 3)), 1)
    with pytest.raises(DataError, match="is a recording file, a frf file is needed"):
        read_response(recording)


def test_a_table_that_was_edited_is_checked_like_any_record(tmp_path: Path) -> None:
    """Rows in another order: the digest no longer matches.

    Without it, frequencies that do not increase are refused.
    """
    path = tmp_path / "a.frf.parquet"
    write_response(path, plain_response(), HEADER)
    table = pq.read_table(path)
    pq.write_table(table.take(pa.array([2, 1, 0])), path)
    with pytest.raises(DamagedError, match="content does not match its digest"):
        read_response(path)
    header = {HEADER_KEY: pq.ParquetFile(path).metadata.metadata[HEADER_KEY]}
    pq.write_table(table.take(pa.array([2, 1, 0])).replace_schema_metadata(header), path)
    with pytest.raises(DataError, match="the frequencies of '427N' do not increase"):
        read_response(path)


# fits of one test


SETTINGS = (
    FitSettings("sdof", mass=0.79, band=(60.0, 70.0), name="direct"),
    FitSettings("sdof", name="free"),
)
RESPONSES = (SourceRef("a.frf.parquet", "00"),)
FIT = Fit(
    "direct",
    "sdof",
    "ml",
    band_hz=(60.0, 70.0),
    lines=15,
    equations=30,
    dof=28,
    gof=Goodness(0.99, 0.98),
    parameters=(),
    condition_number=12.0,
    correlation=np.eye(1),
    test="427N",
)


@pytest.mark.long
@settings(max_examples=10, suppress_health_check=CHECKS)
@given(st.lists(fits(), max_size=2))
def test_fits_of_a_test_come_back(tmp_path: Path, made: list[Fit]) -> None:
    write_fits(tmp_path / "a.json", made, SETTINGS, RESPONSES)
    again = read_fits(tmp_path / "a.json")
    ordered = [
        replace(fit, findings=tuple(sorted(fit.findings, key=lambda finding: finding.level, reverse=True)))
        for fit in made
    ]
    assert len(again) == len(made) and all(map(same, again, ordered))


def test_a_fit_without_an_estimate_has_a_matrix_of_none(tmp_path: Path) -> None:
    """Its file says [], which is a row."""
    write_fits(tmp_path / "a.json", [replace(FIT, correlation=np.empty((0, 0)))], SETTINGS, RESPONSES)
    assert read_fits(tmp_path / "a.json")[0].correlation.shape == (0, 0)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_fits(tmp_path / "427N.json", [FIT], SETTINGS, RESPONSES)
    return tmp_path / "427N.json"


def test_fits_are_fresh_for_the_same_settings_and_response(path: Path) -> None:
    assert has_fresh_fits(path, SETTINGS, RESPONSES)
    assert has_fresh_fits(path, tuple(replace(one) for one in SETTINGS), RESPONSES)


@pytest.mark.parametrize(
    "changed",
    [
        (replace(SETTINGS[0], mass=0.8), SETTINGS[1]),
        (replace(SETTINGS[0], band=(60.0, 71.0)), SETTINGS[1]),
        (replace(SETTINGS[0], name="other"), SETTINGS[1]),
        (replace(SETTINGS[0], estimator="ls"), SETTINGS[1]),
        (SETTINGS[1], SETTINGS[0]),
        SETTINGS[:1],
        (),
    ],
    ids=["mass", "band", "name", "estimator", "order", "fewer", "none"],
)
def test_fits_of_other_settings_are_stale(path: Path, changed: tuple[FitSettings, ...]) -> None:
    assert not has_fresh_fits(path, changed, RESPONSES)


@pytest.mark.parametrize(
    "changed", [(), (SourceRef("a.frf.parquet", "01"),), (SourceRef("b.frf.parquet", "00"),), 2 * RESPONSES]
)
def test_fits_of_another_response_are_stale(path: Path, changed: tuple[SourceRef, ...]) -> None:
    assert not has_fresh_fits(path, SETTINGS, changed)


@pytest.mark.parametrize("key", ["schema", "labpipe"])
def test_fits_of_another_version_are_stale(path: Path, key: str) -> None:
    entries = json.loads(path.read_text("utf-8"))
    del entries["digest"]
    path.write_text(json.dumps({**entries, key: "0.0.0"}), "utf-8")
    assert not has_fresh_fits(path, SETTINGS, RESPONSES)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"3", b"\xff\xfe", b'{"schema": "labpipe/fits/1"'])
def test_a_damaged_file_is_said_to_be_damaged(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(DamagedError, match="is not a readable file of fits"):
        has_fresh_fits(path, SETTINGS, RESPONSES)


def test_fits_that_were_edited_are_said_to_be_edited(path: Path) -> None:
    """A list without its fits once lost a test in silence."""
    entries = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps({**entries, "fits": []}), "utf-8")
    with pytest.raises(DamagedError, match="content does not match its digest"):
        has_fresh_fits(path, SETTINGS, RESPONSES)
    del entries["digest"]
    path.write_text(json.dumps({**entries, "fits": []}), "utf-8")
    with pytest.raises(DamagedError, match="carries no digest"):
        has_fresh_fits(path, SETTINGS, RESPONSES)


def test_a_missing_file_is_stale(tmp_path: Path) -> None:
    assert not has_fresh_fits(tmp_path / "none.json", SETTINGS, RESPONSES)
    with pytest.raises(DamagedError, match="is a folder, a file is needed"):
        has_fresh_fits(tmp_path, SETTINGS, RESPONSES)


# identification.json that is none


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is not a readable identification.json"),
        (b"{", "is not a readable identification.json"),
        (b"\xff\xfe\x00", "is not a readable identification.json"),
        (b"[1, 2]", "is not a readable identification.json"),
        (b"null", "is not a readable identification.json"),
        (b"{}", "is not of schema labpipe/identification/2"),
        (b'{"schema": "labpipe/identification/4"}', "is not of schema labpipe/identification/2"),
        (b'{"schema": "labpipe/identification/1"}', "was written by labpipe ?, or edited"),
        (
            b'{"schema": "labpipe/identification/1", "labpipe": "9.9", "fits": [{}]}',
            "was written by labpipe 9.9, or edited",
        ),
    ],
)
def test_what_is_no_result_is_said_in_plain_words(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "identification.json"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_identification(path)
    assert said in caught.value.what and caught.value.where == str(path)


def test_a_result_that_is_not_there_says_what_makes_one(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file; run `labpipe identify` first"):
        read_identification(tmp_path / "identification.json")
    with pytest.raises(DataError, match="is a folder, a file is needed"):
        read_identification(tmp_path)


def test_quantised_channels_keep_a_dictionary_and_others_are_split_into_byte_planes(tmp_path: Path) -> None:
    """16-bit numbers take half the room by a dictionary, noise of full precision a fifth of the time without
    one.
    """
    rng = np.random.default_rng(1)
    samples = np.column_stack([np.round(rng.normal(size=40_000) * 4000) * 1e-9, rng.normal(size=40_000)])
    path = tmp_path / "a.recording.parquet"
    with RecordingWriter(path, CHANNELS[:2]) as writer:
        for start in range(0, 40_000, 10_000):
            writer.write(samples[start : start + 10_000])
        writer.finish(
            Header("recording", {}, inputs=(), contents=recording_contents(CHANNELS[:2], 1000.0, "a"))
        )
    group = pq.ParquetFile(path).metadata.row_group(0)
    encodings = [set(group.column(number).encodings) for number in range(2)]
    assert "RLE_DICTIONARY" in encodings[0] and "BYTE_STREAM_SPLIT" not in encodings[0]
    assert "BYTE_STREAM_SPLIT" in encodings[1] and "RLE_DICTIONARY" not in encodings[1]
    np.testing.assert_array_equal(open_recording(path).in_memory().samples, samples)

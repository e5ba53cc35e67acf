"""Recordings become a response, made once.

Ready responses are known by their content, whatever program they come from.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, strategies as st

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import write_response
from labpipe.artefacts.recording_file import (
    RecordingWriter,
    StoredRecording,
    open_recording,
    recording_contents,
)
from labpipe.artefacts.writing import output_folder
from labpipe.errors import DataError, LabpipeError
from labpipe.project.measured import measure_test, measured_file_name
from labpipe.project.ready_response import is_response, load_response
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.records.recording import Channel
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.settings import FrfSettings

CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))
SETTINGS = FrfSettings("periodic", period=1.0, band=(1.0, 20.0))
STIFFNESS, DAMPING, MASS = 2e4, 10.0, 2.0


def receptance(frequency: np.ndarray) -> np.ndarray:
    w = 2 * np.pi * frequency
    return 1 / (STIFFNESS - MASS * w**2 + 1j * DAMPING * w)


def stored(folder: Path, n_sample: int = 400, name: str = "a", gain: float = 1.0) -> StoredRecording:
    """Periods of 1 s at 100 Hz of lines 1-20 Hz, steady state, no noise."""
    t = np.arange(n_sample) / 100
    lines = np.arange(1.0, 21.0)
    phasors = np.exp(1j * (2 * np.pi * np.outer(t, lines) - np.pi * lines * (lines - 1) / 20))
    samples = np.column_stack([phasors.real.sum(1), gain * (phasors * receptance(lines)).real.sum(1)])
    path = folder / f"{name}.recording.parquet"
    with RecordingWriter(path, CHANNELS) as writer:
        writer.write(samples)
        writer.finish(Header("recording", {}, inputs=(), contents=recording_contents(CHANNELS, 100.0, name)))
    return open_recording(path)


def made(folder: Path, *recordings: StoredRecording, **changes: object) -> FrequencyResponse:
    with output_folder(folder / "out") as output:
        return measure_test(recordings, replace(SETTINGS, **changes), output, "427N", {"preload": "427 N"})  # type: ignore[arg-type]


def test_the_receptance_of_the_recording_is_found(tmp_path: Path) -> None:
    """Without noise to rounding: 1 / (k - m w^2 + j c w)."""
    response = made(tmp_path, stored(tmp_path))
    np.testing.assert_allclose(response.frequency, np.arange(1.0, 21.0), rtol=1e-12)
    np.testing.assert_allclose(response.matrix[:, 0, 0], receptance(response.frequency), rtol=1e-9)
    assert (response.form, response.name, response.conditions) == ("receptance", "427N", {"preload": "427 N"})


def test_a_response_is_made_once(tmp_path: Path) -> None:
    recording = stored(tmp_path)
    first = made(tmp_path, recording)
    path = tmp_path / "out/427N.frf.parquet"
    number = path.stat().st_ino
    again = made(tmp_path, recording)
    assert path.stat().st_ino == number
    np.testing.assert_array_equal(again.matrix, first.matrix)


@pytest.mark.parametrize(
    "changes", [{"skip": 2}, {"band": (1.0, 19.0)}, {"smooth": 3}, {"exclude": ((5.0, 6.0),)}]
)
def test_other_settings_make_it_again(tmp_path: Path, changes: dict) -> None:
    recording = stored(tmp_path)
    made(tmp_path, recording)
    number = (tmp_path / "out/427N.frf.parquet").stat().st_ino
    made(tmp_path, recording, **changes)
    assert (tmp_path / "out/427N.frf.parquet").stat().st_ino != number


def test_another_recording_makes_it_again(tmp_path: Path) -> None:
    first = made(tmp_path, stored(tmp_path))
    second = made(tmp_path, stored(tmp_path, gain=2.0))
    np.testing.assert_allclose(second.matrix, 2 * first.matrix, rtol=1e-9)


def test_a_fault_names_the_recording_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(LabpipeError, match=r"a\.recording\.parquet.*too short"):
        made(tmp_path, stored(tmp_path, 50))
    assert not (tmp_path / "out").exists()


# names of files


@pytest.mark.parametrize(
    ("test", "name"),
    [
        ("", "frf.frf.parquet"),
        ("427N", "427N.frf.parquet"),
        ("427 N up", "427-N-up.frf.parquet"),
        ("a/b\\c", "a-b-c.frf.parquet"),
        ("../../etc", "..-..-etc.frf.parquet"),
        ("1.5", "1.5.frf.parquet"),
        ("Prüfling", "Prüfling.frf.parquet"),
        ("???", "frf.frf.parquet"),
    ],
)
def test_a_test_s_name_becomes_a_file_name(test: str, name: str) -> None:
    assert measured_file_name(test, None) == name


@given(st.text(max_size=20))
def test_no_test_s_name_leaves_the_folder(test: str) -> None:
    name = measured_file_name(test, None)
    assert not set(name) & set("/\\\0") and name.endswith(".frf.parquet")


# ready responses


@pytest.fixture
def response() -> FrequencyResponse:
    frequency = np.arange(1.0, 6.0)
    return FrequencyResponse(
        frequency,
        receptance(frequency)[:, None, None],
        (Port("x", "x", "x"),),
        (Port("f", "f", "x"),),
        name="own",
    )


@pytest.fixture
def files(tmp_path: Path, response: FrequencyResponse) -> dict[str, Path]:
    """A response in several kinds of files, and recordings beside them."""
    write_frf_csv(tmp_path / "h.csv", response)
    write_response(tmp_path / "h.frf.parquet", response, Header("frf", {}, inputs=()))
    (tmp_path / "run.csv").write_text("t [s],f\n0,1\n1,2\n")
    pq.write_table(pa.table({"f": [1.0, 2.0]}), tmp_path / "run.parquet")
    stored(tmp_path, name="run")
    return {path.name: path for path in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ("name", "is_one"),
    [
        ("h.csv", True),
        ("h.frf.parquet", True),
        ("run.csv", False),
        ("run.parquet", False),
        ("run.recording.parquet", False),
    ],
)
def test_responses_and_recordings_are_told_apart_by_their_content(
    files: dict[str, Path], name: str, is_one: bool
) -> None:
    assert is_response(files[name]) is is_one


def test_what_is_not_there_and_a_folder_are_no_responses(tmp_path: Path) -> None:
    assert not is_response(tmp_path / "none.csv") and not is_response(tmp_path)


@pytest.mark.parametrize("name", ["h.csv", "h.frf.parquet"])
def test_a_ready_response_is_what_it_was(
    files: dict[str, Path], name: str, response: FrequencyResponse
) -> None:
    loaded = load_response(files[name])
    np.testing.assert_allclose(loaded.matrix, response.matrix, rtol=1e-14)
    np.testing.assert_allclose(loaded.frequency, response.frequency, rtol=1e-14)


def test_name_and_conditions_of_the_test_take_the_place_of_its_own(files: dict[str, Path]) -> None:
    loaded = load_response(files["h.frf.parquet"], "427N", {"preload": "427 N"})
    assert (loaded.name, loaded.conditions) == ("427N", {"preload": "427 N"})
    assert load_response(files["h.frf.parquet"]).name == "own"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("none.csv", "no such file"),
        ("", "is a folder, a file is needed"),
        ("run.csv", "no column 'frequency_hz'"),
        ("run.parquet", "has no labpipe header"),
        ("run.recording.parquet", "is a recording file, a frf file is needed"),
        ("h.xyz", "FRF files with the ending '.xyz' cannot be read"),
    ],
)
def test_what_is_no_response_is_said_with_its_file(
    files: dict[str, Path], tmp_path: Path, name: str, said: str
) -> None:
    (tmp_path / "h.xyz").write_text("")
    with pytest.raises(DataError) as caught:
        load_response(tmp_path / name)
    assert said in str(caught.value) and caught.value.where.startswith(str(tmp_path))

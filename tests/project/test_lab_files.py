"""Files of other programs through the commands: identify, ingest, inspect and export, and how broken ones are
refused.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from nptdms import ChannelObject, TdmsWriter
from scipy.io import wavfile

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.project.ready_response import read_frf_file
from labpipe.records.response import FrequencyResponse, Port

RIG = """name: Test rig
channels:
  f: {column: f, quantity: force, unit: N, role: input, dof: y}
  y: {column: y, quantity: displacement, unit: um, role: output, dof: y}
"""
PIPELINE = """title: Ready FRFs
frfs: FILE
identify:
  support: {model: sdof, estimator: ls, input: y, output: y, band: 10-40 Hz, mass: 2 kg}
"""
FREQUENCY = np.arange(8.0, 50.0, 0.25)
K, C, MASS = 80e3, 40.0, 2.0


def receptance(form: str = "receptance") -> FrequencyResponse:
    """H = 1 / (k - m w^2 + j w c), as its n-th derivative."""
    omega = 2 * np.pi * FREQUENCY
    matrix = (1j * omega) ** ("receptance", "mobility", "accelerance").index(form) / (
        K - MASS * omega**2 + 1j * omega * C
    )
    ports = (Port("y", "y", "y", np.pi / 2),)
    return FrequencyResponse(FREQUENCY, matrix[:, None, None], ports, ports, form=form)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a rig, an artefact of an FRF and nothing else."""
    (tmp_path / "rig.yaml").write_text(RIG)
    write_response(tmp_path / "h.frf.parquet", receptance(), Header("frf", {}, inputs=()))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("target", "suffix"), [("uff", ".uff"), ("uff58b", ".unv"), ("mat", ".mat")])
@pytest.mark.parametrize("form", ["receptance", "accelerance"])
def test_an_exported_response_is_identified_as_it_was_made(
    project: Path, labpipe, target: str, suffix: str, form: str
) -> None:
    """Closed form: the coefficients from which the FRF was made."""
    write_response(project / "h.frf.parquet", receptance(form), Header("frf", {}, inputs=()))
    assert labpipe("export", "h.frf.parquet", "--to", target, "-o", f"h{suffix}").code == 0
    np.testing.assert_allclose(
        read_frf_file(project / f"h{suffix}").matrix,
        read_response(project / "h.frf.parquet").matrix,
        rtol=1e-11,
    )
    (project / "p.yaml").write_text(
        PIPELINE.replace("FILE", f"h{suffix}") + "accept: {support.k: 80 kN/m +- 0.0001 %}\n"
    )
    for arguments in (
        ["run", "p.yaml", "-o", "out"],
        ["identify", "-c", "p.yaml", "-o", "again", f"h{suffix}"],
    ):
        assert labpipe(*arguments).code == 0
    assert (project / "again" / "identification.json").exists()


def recorded(project: Path, labpipe) -> np.ndarray:
    """run.recording.parquet of two channels at 1 kHz, from CSV."""
    samples = np.random.default_rng(5).normal(size=(500, 2)).round(6)
    rows = "".join(f"{n / 1000},{f},{y}\n" for n, (f, y) in enumerate(samples))
    (project / "run.csv").write_text("t [s],f,y\n" + rows)
    (project / "timed.yaml").write_text(RIG.replace("channels:", 'time: "t [s]"\nchannels:'))
    assert labpipe("ingest", "run.csv", "-r", "timed.yaml", "-o", ".").code == 0
    return samples * [1.0, 1e-6]


@pytest.mark.parametrize(("target", "suffix"), [("uff", ".uff"), ("uff58b", ".uff"), ("mat", ".mat")])
def test_an_exported_recording_is_ingested_with_its_own_rate(
    project: Path, labpipe, target: str, suffix: str
) -> None:
    samples = recorded(project, labpipe)
    assert labpipe("export", "run.recording.parquet", "--to", target, "-o", f"again{suffix}").code == 0
    (project / "rig.yaml").write_text(RIG.replace("unit: um", "unit: m"))
    ended = labpipe("ingest", f"again{suffix}", "-r", "rig.yaml", "-o", "out")
    assert ended.code == 0 and "500 samples, 1000 Hz" in ended.out, ended
    table = pq.read_table(project / "out" / "again.recording.parquet")
    np.testing.assert_allclose(np.column_stack([table["f"], table["y"]]), samples, rtol=1e-11)


def test_rate_and_unit_are_held_against_the_rig(project: Path, labpipe) -> None:
    recorded(project, labpipe)
    labpipe("export", "run.recording.parquet", "--to", "uff", "-o", "again.uff")
    ended = labpipe("ingest", "again.uff", "-r", "rig.yaml", "-o", "out")
    assert (
        ended.code == 2 and "column 'y' is in m by the file's own header, in um by the rig file" in ended.err
    )
    (project / "rig.yaml").write_text(
        RIG.replace("unit: um", "unit: m").replace("channels:", "sample_rate: 2 kHz\nchannels:")
    )
    ended = labpipe("ingest", "again.uff", "-r", "rig.yaml", "-o", "out")
    assert (
        ended.code == 2
        and "is sampled at 1000 Hz by the file itself, at 2000 Hz by the rig file" in ended.err
    )
    assert not (project / "out").exists()


@pytest.mark.parametrize(
    ("file", "content", "fragment"),
    [
        ("h.uff", b"", "the file is empty"),
        ("h.uff", b"MZ\x90", "is not a universal file"),
        ("h.mat", b"", "the file is empty"),
        ("h.mat", b"MATLAB 5.0 MAT-file" + bytes(200), "is not a readable MATLAB file"),
        ("h.xyz", b"1", "FRF files with the ending '.xyz' cannot be read"),
    ],
)
def test_broken_response_files(project: Path, labpipe, file: str, content: bytes, fragment: str) -> None:
    (project / file).write_bytes(content)
    (project / "p.yaml").write_text(PIPELINE.replace("FILE", file))
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert (
        ended.code == 2 and fragment in ended.err and file in ended.err and len(ended.err.splitlines()) == 1
    ), ended
    assert not (project / "out").exists()


@pytest.mark.parametrize("target", ["uff", "mat"])
def test_inspect_shows_names_units_and_rate_of_the_file_itself(project: Path, labpipe, target: str) -> None:
    recorded(project, labpipe)
    labpipe("export", "run.recording.parquet", "--to", target, "-o", f"again.{target}")
    ended = labpipe("inspect", f"again.{target}")
    assert (
        ended.code == 0
        and f"again.{target}: 500 rows, 2 columns, 1000 Hz" in ended.out
        and "y [m] " in ended.out
    ), ended
    assert "warning" not in ended.out
    (project / "rig.yaml").write_text(
        RIG.replace("column: f", "column: force").replace("channels:", "sample_rate: 2 kHz\nchannels:")
    )
    ended = labpipe("inspect", f"again.{target}", "-r", "rig.yaml")
    assert ended.code == 0
    for warning in (
        "no column 'force'",
        "column 'y' is in m by the file's own header, in um",
        "is sampled at 1000 Hz by the file itself",
    ):
        assert f"warning rig: {warning}" in ended.out, ended.out


@pytest.mark.parametrize("target", ["uff", "mat", "frf.parquet"])
def test_inspect_shows_what_a_response_holds(project: Path, labpipe, target: str) -> None:
    if target != "frf.parquet":
        labpipe("export", "h.frf.parquet", "--to", target, "-o", f"h.{target}")
    ended = labpipe("inspect", f"h.{target}")
    assert (
        ended.code == 0
        and (f"h.{target}: receptance [m/N], 168 lines, 8 to 49.75 Hz\n  responses y\n  forces    y\n")
        in ended.out
    ), ended


def test_inspect_of_tdms_and_wav(project: Path, labpipe) -> None:
    samples = np.random.default_rng(5).normal(size=64)
    with TdmsWriter("r.tdms") as writer:
        writer.write_segment(
            [ChannelObject("g", "probe", samples, {"wf_increment": 1 / 20000, "unit_string": "um"})]
        )
    wavfile.write("r.wav", 44100, samples.astype(np.float32))
    assert "64 rows, 1 columns, 20000 Hz" in labpipe("inspect", "r.tdms").out
    assert "probe [um]" in labpipe("inspect", "r.tdms").out
    assert "64 rows, 1 columns, 44100 Hz" in labpipe("inspect", "r.wav").out


def test_a_wav_file_is_calibrated_by_the_sensitivity_per_full_scale(project: Path, labpipe) -> None:
    """50 m/s^2 at full scale: half of it is 25 m/s^2."""
    wavfile.write("r.wav", 8000, np.array([0.5, -0.25, 0.125], np.float32))
    (project / "wav.yaml").write_text(
        'channels:\n  a: {column: "1", quantity: acceleration, unit: "1", sensitivity: 50 m/s^2}\n'
    )
    assert labpipe("ingest", "r.wav", "-r", "wav.yaml", "-o", "out").code == 0
    assert pq.read_table(project / "out" / "r.recording.parquet")["a"].to_pylist() == [25.0, -12.5, 6.25]


BROKEN = [
    (f"r{suffix}", b"MZ")
    for suffix in (
        ".uff",
        ".mat",
        ".h5",
        ".tdms",
        ".wav",
        ".csv.gz",
        ".csv.zst",
        ".lvm",
        ".npy",
        ".npz",
        ".xlsx",
        ".mf4",
    )
]


@pytest.mark.parametrize(
    ("file", "content"), [*BROKEN, *((name, b"") for name, _ in BROKEN), ("r.xls", b"1")]
)
@pytest.mark.parametrize("command", ["ingest", "inspect"])
def test_broken_recordings_of_every_kind(
    project: Path, labpipe, file: str, content: bytes, command: str
) -> None:
    (project / file).write_bytes(content)
    ended = labpipe(
        *{"ingest": ["ingest", file, "-r", "rig.yaml", "-o", "out"], "inspect": ["inspect", file]}[command]
    )
    assert (
        ended.code == 2 and ended.err.startswith(f"error: {file}: ") and len(ended.err.splitlines()) == 1
    ), ended
    assert not (project / "out").exists()

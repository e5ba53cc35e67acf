"""Raw files measured as they are read: the same samples, findings, faults and responses as by way of a
calibrated recording.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from nptdms import ChannelObject, TdmsWriter

from labpipe.artefacts.measured_files import read_response
from labpipe.artefacts.parquet import read_header
from labpipe.artefacts.writing import output_folder
from labpipe.cli.main import run_command
from labpipe.errors import DataError
from labpipe.project import ingest as stage
from labpipe.project.ingest import SourceFile, ingest, raw_recording
from labpipe.project.rig_file import load_rig
from labpipe.raw_files import other_tables as parquet_table, tdms_table
from tests.conftest import Command

CHANNELS = """channels:
  f: {quantity: force, unit: mV, sensitivity: 22.5 mV/N, invert: true, dof: x}
  y: {quantity: displacement, unit: V, sensitivity: 8 V/mm, range: 5 V, dof: x}
  z: {quantity: displacement, unit: um, dof: y}
  T: {quantity: temperature, unit: degC, role: reference}
"""
RATED = "name: R\nsample_rate: 1024 Hz\n"
NAMES = ("f", "y", "z", "T")
PIPELINE = (
    "rig: rig.yaml\nrecordings: {}\nfrf: {{excitation: random, block: 0.25 s}}\nreport: {{formats: []}}\n"
)


def faulty(seed: int) -> np.ndarray:
    """Four channels of 3,000 samples with some of: clipped peaks, missing numbers, infinities, a channel at
    rest, coarse steps.
    """
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=(3000, 4)) * rng.choice([1e-3, 1.0, 1e4], 4) + rng.choice([0.0, 50.0], 4)
    for column, fault in enumerate(rng.integers(0, 7, 4)):
        x = samples[:, column]
        if fault == 1:
            samples[:, column] = np.clip(x, *np.quantile(x, [0.03, 0.96]))
        elif fault == 2:
            samples[rng.integers(0, 3000, 4), column] = rng.choice([np.nan, np.inf, -np.inf])
        elif fault == 3:
            samples[:, column] = 2.5
        elif fault == 4:
            samples[:, column] = np.round(x / x.std() * 3)
        elif fault == 5:
            samples[1200:1210, column] = x.max() + 1.0
    return samples


def write(folder: Path, kind: str, samples: np.ndarray, dtype: type = np.float64) -> Path:
    path = folder / f"raw.{kind}"
    if kind == "parquet":
        pq.write_table(
            pa.table({name: samples[:, n].astype(dtype) for n, name in enumerate(NAMES)}),
            path,
            row_group_size=1100,
        )
        return path
    with TdmsWriter(str(path)) as writer:
        for start in range(0, samples.shape[0], 700):
            part = samples[start : start + 700]
            writer.write_segment(
                [ChannelObject("g", name, part[:, n].astype(dtype)) for n, name in enumerate(NAMES)]
            )
    return path


@pytest.fixture
def short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of 500 samples, so that a short file has several."""
    monkeypatch.setattr(parquet_table, "CHUNK_ROWS", 500)
    monkeypatch.setattr(tdms_table, "CHUNK_ROWS", 500)


@pytest.mark.usefixtures("short_chunks")
@pytest.mark.parametrize("kind", ["parquet", "tdms"])
@pytest.mark.parametrize("seed", range(12))
def test_samples_and_findings_are_those_of_the_calibrated_recording(
    tmp_path: Path, kind: str, seed: int
) -> None:
    (tmp_path / "rig.yaml").write_text(RATED + CHANNELS)
    path = write(tmp_path, kind, faulty(seed), np.float32 if seed % 2 else np.float64)
    rig = load_rig(tmp_path / "rig.yaml")
    with output_folder(tmp_path / "out") as output:
        stored = ingest(SourceFile(path, rig), output, "run", tmp_path)
        raw = raw_recording(path, rig, tmp_path)
        assert raw is not None
        samples = np.concatenate(list(raw.blocks(333)))
        np.testing.assert_array_equal(samples, np.concatenate(list(stored.blocks(333))))
        assert raw.findings == stored.findings
        np.testing.assert_array_equal(np.concatenate(list(raw.blocks(1 << 17))), samples)
        assert (raw.channels, raw.sample_rate, raw.n_sample, raw.name) == (
            stored.channels,
            stored.sample_rate,
            3000,
            "raw",
        )
        assert (raw.source_ref(),) == stored.header.inputs


def test_every_kind_of_fault_is_drawn() -> None:
    """What the test above compares is not empty."""
    drawn = [faulty(seed) for seed in range(12)]
    assert any(np.isnan(samples).any() for samples in drawn) and any(
        np.isinf(samples).any() for samples in drawn
    )
    assert any(np.ptp(samples[:, n]) == 0 for samples in drawn for n in range(4))


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.int64, np.float16])
def test_numbers_of_other_kinds_are_exact(tmp_path: Path, dtype: type) -> None:
    samples = np.random.default_rng(1).integers(-1000, 1000, (3000, 4))
    (tmp_path / "rig.yaml").write_text(RATED + CHANNELS)
    raw = raw_recording(write(tmp_path, "parquet", samples, dtype), load_rig(tmp_path / "rig.yaml"), tmp_path)
    assert raw is not None
    expected = samples * np.array([-1 / 22.5, 1 / 8e3, 1e-6, 1.0]) + np.array([0, 0, 0, 273.15])
    np.testing.assert_allclose(np.concatenate(list(raw.blocks(1 << 17))), expected, rtol=1e-12)


def test_the_findings_are_there_before_the_samples_are_asked_for(tmp_path: Path) -> None:
    samples = np.random.default_rng(1).normal(size=(3000, 4))
    samples[7, 2] = np.nan
    (tmp_path / "rig.yaml").write_text(RATED + CHANNELS)
    raw = raw_recording(write(tmp_path, "parquet", samples), load_rig(tmp_path / "rig.yaml"), tmp_path)
    assert (
        raw is not None
        and [finding.code for finding in raw.findings] == ["gap"]
        and "sample 7" in raw.findings[0].message
    )


# By the command


def lab(folder: Path, seed: int = 1, kind: str = "parquet") -> Path:
    """A pipeline over a raw file of two responses to a force; the pipeline's path."""
    rng = np.random.default_rng(seed)
    force = rng.normal(size=6000)
    y, z = (
        np.convolve(force, np.exp(-np.arange(40) / decay), "same") + 0.2 * rng.normal(size=6000)
        for decay in (4.0, 9.0)
    )
    (folder / "rig.yaml").write_text(RATED + CHANNELS)
    write(
        folder, kind, np.column_stack([force, 0.2 * y, z, np.full(6000, 20.0) + 0.01 * rng.normal(size=6000)])
    )
    (folder / "p.yaml").write_text(PIPELINE.format(f"raw.{kind}"))
    return folder / "p.yaml"


def frf(folder: Path, out: str, *raw: Path) -> None:
    assert (
        run_command(["frf", "-c", str(folder / "p.yaml"), "-o", str(folder / out), "-q", *map(str, raw)]) == 0
    )


@pytest.mark.parametrize("kind", ["parquet", "tdms"])
@pytest.mark.parametrize(
    "frf_section", ["block: 0.25 s", "block: 0.5 s, local: polynomial", "block: 0.1 s, estimator: Hv"]
)
def test_the_response_is_that_of_the_calibrated_recording(
    tmp_path: Path, kind: str, frf_section: str
) -> None:
    """Within 1e-10 of its standard errors: blocks are cut elsewhere, nothing else differs."""
    pipeline = lab(tmp_path, kind=kind)
    pipeline.write_text(pipeline.read_text().replace("block: 0.25 s", frf_section))
    frf(tmp_path, "as-read")
    assert (
        run_command(
            ["ingest", str(tmp_path / f"raw.{kind}"), "-r", str(tmp_path / "rig.yaml"), "-o", str(tmp_path)]
        )
        == 0
    )
    frf(tmp_path, "calibrated", tmp_path / "raw.recording.parquet")
    direct, stored = (read_response(tmp_path / out / "frf.frf.parquet") for out in ("as-read", "calibrated"))
    assert direct.covariance is not None and stored.covariance is not None
    size = np.sqrt(np.einsum("fkk->fk", stored.covariance).real).reshape(stored.matrix.shape)
    assert np.max(np.abs(direct.matrix - stored.matrix) / size) < 1e-10
    np.testing.assert_allclose(direct.covariance, stored.covariance, rtol=0, atol=1e-10 * np.max(size) ** 2)
    assert direct.findings == stored.findings
    assert not (tmp_path / "as-read/recordings").exists()


def test_a_time_column_is_read_first(tmp_path: Path) -> None:
    """The rate of times printed to the microsecond, 1024 Hz, and a lost sample, which is named as by
    `ingest`.
    """
    samples = np.random.default_rng(1).normal(size=(3000, 4))
    times = np.round(np.arange(3000) / 1024, 6)
    columns = {name: samples[:, n] for n, name in enumerate(NAMES)}
    pq.write_table(pa.table({"t": times, **columns}), tmp_path / "raw.parquet")
    (tmp_path / "rig.yaml").write_text("name: R\ntime: t\n" + CHANNELS)
    raw = raw_recording(tmp_path / "raw.parquet", load_rig(tmp_path / "rig.yaml"), tmp_path)
    assert raw is not None and raw.sample_rate == 1024.0
    times[1000:] += 1 / 1024
    pq.write_table(pa.table({"t": times, **columns}), tmp_path / "raw.parquet")
    raw = raw_recording(tmp_path / "raw.parquet", load_rig(tmp_path / "rig.yaml"), tmp_path)
    assert raw is not None
    with pytest.raises(DataError, match=r"not equal.*sample 1000\b"):
        raw.sample_rate  # noqa: B018


def test_a_response_is_fresh_by_its_raw_file_and_its_rig(tmp_path: Path) -> None:
    lab(tmp_path)
    made = tmp_path / "out/frf.frf.parquet"

    def made_again(change: Callable[[], object]) -> bool:
        before = made.stat().st_ino
        change()
        frf(tmp_path, "out")
        return made.stat().st_ino != before

    frf(tmp_path, "out")
    header = read_header(made)
    assert [reference.path for reference in header.inputs] == ["raw.parquet"]
    assert not made_again(lambda: None) and not made_again(lambda: os.utime(tmp_path / "raw.parquet"))
    assert made_again(lambda: lab(tmp_path, 2))
    assert made_again(
        lambda: (tmp_path / "rig.yaml").write_text((RATED + CHANNELS).replace("22.5 mV/N", "22.6 mV/N"))
    )
    assert not made_again(lambda: None)


def test_a_calibrated_recording_of_an_earlier_run_goes(tmp_path: Path) -> None:
    """It would be that of another raw file one day."""
    lab(tmp_path)
    (tmp_path / "out/recordings").mkdir(parents=True)
    (tmp_path / "out/recordings/raw.recording.parquet").write_bytes(b"of earlier")
    frf(tmp_path, "out")
    assert not (tmp_path / "out/recordings/raw.recording.parquet").exists()


def test_results_name_the_raw_file_and_can_be_verified(tmp_path: Path, labpipe: Command) -> None:
    pipeline = lab(tmp_path)
    pipeline.write_text(
        pipeline.read_text() + "identify: {a: {model: sdof, input: f, output: y, mass: 1 kg}}\n"
    )
    assert labpipe("run", pipeline, "-o", tmp_path / "out").code == 0
    ended = labpipe("verify", tmp_path / "out", "-c", pipeline)
    assert ended.code == 0, ended.err
    lab(tmp_path, 2)
    changed = labpipe("verify", tmp_path / "out")
    assert (
        changed.code == 1 and "frf.frf.parquet: 'raw.parquet' is not the file" in changed.err + changed.out
    ), changed


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda path: (path.write_bytes(path.read_bytes() + b" "), os.utime(path, ns=(1, 1))), True),
        (lambda path: os.utime(path, ns=(1, 1)), True),
        (lambda path: None, False),
    ],
)
def test_a_file_that_changes_while_it_is_read_is_noticed(
    tmp_path: Path, change: Callable[[Path], object], said: bool
) -> None:
    lab(tmp_path)
    raw = raw_recording(tmp_path / "raw.parquet", load_rig(tmp_path / "rig.yaml"), tmp_path)
    assert raw is not None and len(raw.findings) == 0
    change(tmp_path / "raw.parquet")
    if said:
        with pytest.raises(DataError, match="changed while it was read"):
            raw.check_unchanged()
    else:
        raw.check_unchanged()


def test_a_young_file_is_digested_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clocks of file systems tick: a file may change twice at one time of change."""
    lab(tmp_path)
    path = tmp_path / "raw.parquet"
    raw = raw_recording(path, load_rig(tmp_path / "rig.yaml"), tmp_path)
    assert raw is not None and not raw.findings
    state, content = path.stat(), bytearray(path.read_bytes())
    content[100] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    with pytest.raises(DataError, match="changed while it was read"):
        raw.check_unchanged()
    monkeypatch.setattr(stage, "YOUNG", 0)
    raw.check_unchanged()


@pytest.mark.parametrize(
    ("columns", "said"),
    [(("f", "y", "q", "T"), "no column 'z'"), (("f", "y", "z", "z [mm]"), "no column 'T'")],
)
def test_a_fault_is_told_as_by_the_longer_way(
    tmp_path: Path, labpipe: Command, monkeypatch: pytest.MonkeyPatch, columns: Sequence[str], said: str
) -> None:
    lab(tmp_path)
    pq.write_table(
        pq.read_table(tmp_path / "raw.parquet").rename_columns(list(columns)), tmp_path / "raw.parquet"
    )
    ended = labpipe("frf", "-c", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 2 and said in ended.err and len(ended.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_missing_samples_are_told_as_by_the_longer_way(tmp_path: Path, labpipe: Command) -> None:
    lab(tmp_path)
    table = pq.read_table(tmp_path / "raw.parquet")
    broken = table["z"].to_numpy().copy()
    broken[4000] = np.nan
    pq.write_table(table.set_column(2, "z", [broken]), tmp_path / "raw.parquet")
    direct = labpipe("frf", "-c", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert labpipe("ingest", tmp_path / "raw.parquet", "-r", tmp_path / "rig.yaml", "-o", tmp_path).code == 0
    stored = labpipe(
        "frf", "-c", tmp_path / "p.yaml", "-o", tmp_path / "out", tmp_path / "raw.recording.parquet"
    )
    assert (
        direct.code == stored.code == 2
        and direct.err.split(": ", 2)[2] == stored.err.split(": ", 2)[2]
        and "has no number at sample 4000" in direct.err
    )

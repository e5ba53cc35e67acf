"""labpipe's own files: round trips, refusals, whole or nothing."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.header import Header, SourceRef
from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.artefacts.json_file import record_of
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.artefacts.recording_file import RecordingWriter, open_recording, recording_contents
from labpipe.artefacts.writing import output_file, output_folder
from labpipe.errors import DataError
from labpipe.raw_files.frf_csv import port_of, read_frf_csv, write_frf_csv
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Fit, FittedCurve, Goodness, Identification, RuleOutcome
from labpipe.records.recording import Channel
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

HEADER = Header("frf", {"period": 1.0}, inputs=(SourceRef("a.csv", "00"),))


def response(rng: np.random.Generator) -> FrequencyResponse:
    joint = rng.normal(size=(5, 4, 4)) + 1j * rng.normal(size=(5, 4, 4))
    return FrequencyResponse(
        frequency=np.arange(1.0, 6.0),
        matrix=rng.normal(size=(5, 2, 2)) + 1j * rng.normal(size=(5, 2, 2)),
        outputs=(Port("x", "x", "x", 0.0), Port("y", "y", "y")),
        inputs=(Port("f", "f", "45 deg", 0.785), Port("g", "g", "g")),
        form="accelerance",
        covariance=joint @ joint.conj().swapaxes(1, 2),
        coherence=rng.uniform(size=(5, 2, 2)),
        multiple_coherence=rng.uniform(size=(5, 2)),
        snr=rng.uniform(size=(5, 4)),
        snr_channels=("f", "g", "x", "y"),
        averages=5.0,
        covariance_dof=44.0,
        name="427N",
        findings=(Finding("clipped", "channel x"),),
        conditions={"preload": "427 N"},
    )


def assert_same(one: FrequencyResponse, other: FrequencyResponse) -> None:
    for field in dataclasses.fields(FrequencyResponse):
        np.testing.assert_equal(getattr(other, field.name), getattr(one, field.name), err_msg=field.name)


def test_response_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    whole = response(rng)
    bare = dataclasses.replace(
        whole,
        covariance=None,
        coherence=None,
        multiple_coherence=None,
        snr=None,
        snr_channels=(),
        covariance_dof=float("inf"),
    )
    for one in (whole, bare):
        write_response(tmp_path / "a.frf.parquet", one, HEADER)
        assert_same(one, read_response(tmp_path / "a.frf.parquet"))


def test_frf_table_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    one = response(rng)
    write_frf_csv(tmp_path / "a.csv", one)
    other = read_frf_csv(tmp_path / "a.csv")
    np.testing.assert_allclose(other.matrix, one.matrix, rtol=1e-15)
    np.testing.assert_allclose(other.variance, one.variance, rtol=1e-15)
    np.testing.assert_allclose(other.coherence, one.coherence, rtol=1e-15)
    assert (other.form, [p.label for p in other.outputs]) == ("accelerance", ["x", "y"])
    # A probe named y along 135 deg was read back along 90 deg.
    probes = tuple(
        replace(port_of(dof), label=name, channel=name) for name, dof in (("x", "45 deg"), ("y", "135 deg"))
    )
    write_frf_csv(tmp_path / "a.csv", replace(one, outputs=probes))
    assert read_frf_csv(tmp_path / "a.csv").outputs == probes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "# form: receptence\nfrequency_hz,x/f:re,x/f:im\n1,2,3\n",
            "unknown form 'receptence'; did you mean 'receptance'",
        ),
        ("frequency_hz,x/f:re\n1,2\n2,3\n", "no column 'x/f:im'"),
        ("frequency_hz,x\n1,2\n2,3\n", "no columns 'output/input:re'"),
        ("frequency_hz,x/f:re,x/f:im\n2,2,3\n1,2,3\n", "do not increase"),
        ("frequency_hz,x/f:re,x/f:im\n1,2,3\n2,NaN,3\n", "not finite at index"),
        ("frequency_hz,x/f:re,x/f:im,x/f:coh\n1,2,3,1\n2,3,3,-0.5\n", "holds the coherence -0.5"),
    ],
)
def test_frf_tables_that_are_none(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        read_frf_csv(tmp_path / "a.csv")


def test_names_in_an_frf_table(tmp_path: Path) -> None:
    """As Simcenter labels channels; a response named shaft/3 was read back as one named shaft."""
    one = FrequencyResponse(
        np.array([1.0, 2.0]),
        np.array([1j, 2j]).reshape(2, 1, 1),
        (Port("shaft:3:+X", "x", "x"),),
        (Port("hammer:1/a", "f", "x"),),
    )
    write_frf_csv(tmp_path / "a.csv", one)
    other = read_frf_csv(tmp_path / "a.csv")
    assert (other.outputs[0].label, other.inputs[0].label) == ("shaft:3:+X", "hammer:1/a")
    with pytest.raises(DataError, match="'shaft/3' cannot be a response in a table"):
        write_frf_csv(tmp_path / "b.csv", replace(one, outputs=(Port("shaft/3", "x", "x"),)))


def test_recording_round_trip_in_blocks(tmp_path: Path, rng: np.random.Generator) -> None:
    channels = (
        Channel("f", "force", "input", "x", 0.0),
        Channel("x", "displacement", "output", "x", 0.0, 1e-4),
    )
    samples = rng.normal(size=(1000, 2))
    with RecordingWriter(tmp_path / "a.recording.parquet", channels) as writer:
        for start in range(0, 1000, 300):
            writer.write(samples[start : start + 300])
        writer.finish(
            Header(
                "recording",
                {},
                inputs=(),
                findings=(Finding("gap", "g"),),
                contents=recording_contents(channels, 50.0, "a"),
            )
        )
    stored = open_recording(tmp_path / "a.recording.parquet")
    assert (stored.channels, stored.sample_rate, stored.n_sample, stored.findings) == (
        channels,
        50.0,
        1000,
        (Finding("gap", "g"),),
    )
    np.testing.assert_array_equal(np.concatenate(list(stored.blocks(64))), samples)
    np.testing.assert_array_equal(stored.in_memory().samples, samples)
    with pytest.raises(DataError, match="is a recording file, a frf file is needed"):
        read_response(tmp_path / "a.recording.parquet")


def test_identification_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    curve = FittedCurve(
        np.arange(3.0),
        np.ones((3, 1, 1)) * 1j,
        np.ones((3, 1, 1)),
        variance=None,
        outputs=("x",),
        inputs=("f",),
        form="receptance",
    )
    parameters = (
        Parameter("k", 1.0, "N/m", std_error=0.1, t_ratio=10.0, ci95=(0.8, 1.2), significant=True, vif=1.1),
        Parameter("f_n", 2.0, "Hz", derived=True),
    )
    fit = Fit(
        "a",
        "sdof",
        "ml",
        band_hz=(1.0, 2.0),
        lines=3,
        equations=6,
        dof=4,
        gof=Goodness(0.9, 0.8, 1.1, 0.3),
        parameters=parameters,
        condition_number=float("inf"),
        correlation=np.eye(1),
        curve=curve,
        test="t",
    )
    one = Identification(
        (fit,),
        "T",
        pipeline="p.yaml",
        sources=({"path": "a", "sha256": "b"},),
        settings={"frf": None},
        rig={},
        responses=(),
        outcomes=(RuleOutcome("accept", "a.k > 0", 1.0, True),),
        version="0.1.0",
    )
    write_identification(tmp_path / "i.json", one)
    other = read_identification(tmp_path / "i.json")
    for field in ("title", "pipeline", "sources", "settings", "outcomes", "version"):
        assert getattr(other, field) == getattr(one, field)
    assert other.fits[0].parameters == parameters
    assert other.fits[0].condition_number == float("inf")
    np.testing.assert_array_equal(other.fits[0].curve.measured, curve.measured)


def test_the_model_between_the_lines_travels_and_older_files_have_none(tmp_path: Path) -> None:
    lines, between = np.arange(3.0), np.linspace(0.0, 2.0, 5)
    plain = FittedCurve(
        lines,
        np.ones((3, 1, 1)) * 1j,
        np.ones((3, 1, 1)),
        variance=None,
        outputs=("x",),
        inputs=("f",),
        form="receptance",
    )
    dense = replace(plain, dense_frequency=between, dense=(between + 1j)[:, None, None])
    goodness = Goodness(0.9, 0.8)
    for name, curve in (("plain", plain), ("dense", dense)):
        fit = Fit(
            "a",
            "sdof",
            "ml",
            band_hz=(1.0, 2.0),
            lines=3,
            equations=6,
            dof=4,
            gof=goodness,
            parameters=(),
            condition_number=1.0,
            correlation=np.eye(1),
            curve=curve,
        )
        write_identification(tmp_path / name, Identification((fit,), version="1"))
    old, new = (read_identification(tmp_path / name).fits[0].curve for name in ("plain", "dense"))
    assert old is not None and old.dense is None and old.drawn[0].tolist() == lines.tolist()
    assert new is not None and new.drawn[0].tolist() == between.tolist()
    np.testing.assert_array_equal(new.drawn[1], dense.dense)
    assert '"dense": null' in (tmp_path / "plain").read_text(encoding="utf-8")


def test_a_folder_changes_only_if_all_succeeds(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), output_folder(tmp_path / "new" / "out") as folder:
        folder.write_path("sub/a.txt").write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with output_folder(tmp_path / "new" / "out") as folder:
        folder.write_path("sub/a.txt").write_text("whole")
        assert folder.read_path("sub/a.txt").read_text() == "whole"
    assert (tmp_path / "new/out/sub/a.txt").read_text() == "whole"
    assert [p.name for p in tmp_path.iterdir()] == ["new"]


def test_a_file_is_whole_or_absent(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("before")
    with pytest.raises(RuntimeError), output_file(tmp_path / "a.txt") as path:
        path.write_text("half")
        raise RuntimeError
    assert (tmp_path / "a.txt").read_text() == "before"
    with pytest.raises(DataError, match="is a folder"), output_file(tmp_path):
        pass


def test_records_are_read_only_and_checked_at_birth(rng: np.random.Generator) -> None:
    one = response(rng)
    with pytest.raises(ValueError, match="read-only"):
        one.matrix[0] = 0
    with pytest.raises(DataError, match="FRF matrix has the shape"):
        dataclasses.replace(one, matrix=one.matrix[:, :1])
    with pytest.raises(DataError, match="two rows or columns"):
        dataclasses.replace(one, outputs=(one.outputs[0], one.outputs[0]))
    with pytest.raises(DataError, match="unknown form"):
        dataclasses.replace(one, form="inertance")
    assert diagonal_covariance(one.variance).shape == (5, 4, 4)


# A text counts as true, so that a rule that fails would pass.
BAD_RULES = (
    [{"rule": "a.k >= 1", "value": 0.5, "passed": "no"}],
    [{"rule": "a", "value": [1], "passed": True}],
)


@pytest.mark.parametrize(
    "change",
    [
        {"fits": [{"name": "x"}]},
        {"studies": [{"later": 1}]},
        {"fits": 3},
        *({"accept": one} for one in BAD_RULES),
    ],
)
def test_a_result_with_other_entries_is_refused_in_plain_words(tmp_path: Path, change: dict) -> None:
    path = tmp_path / "identification.json"
    write_identification(path, Identification((), "empty", pipeline="p.yaml"))
    edited = {**json.loads(path.read_text("utf-8")), **change}
    path.write_text(json.dumps(edited), "utf-8")
    with pytest.raises(DamagedError, match="content does not match its digest"):
        read_identification(path)
    del edited["digest"]
    path.write_text(json.dumps(edited), "utf-8")
    with pytest.raises(DataError, match=r"was written by labpipe .*, or edited") as caught:
        read_identification(path)
    assert "run `labpipe identify` again" in str(caught.value.hint)


def test_fields_of_a_plugin_may_be_any_array_of_numpy() -> None:
    """From numpy 2.5 on NDArray is an alias of another kind than the arrays of labpipe's own records."""
    entry = {"re": [1.0, 0.0], "im": [0.0, -2.0]}
    np.testing.assert_array_equal(record_of(entry, NDArray[np.complex128]), [1.0, -2.0j])
    np.testing.assert_array_equal(record_of([1, 2], NDArray[np.float64] | None), np.array([1.0, 2.0]))

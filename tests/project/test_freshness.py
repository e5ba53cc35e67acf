"""What is made again when what changes, and nothing else: the rule by which nobody ever reads a stale
result.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import labpipe
from tests.project.laboratory import ALONE, PIPELINE, RIG, Witness, contents, done, laboratory, recording

RESULT = "identification.json"
OF_SOFT = {"recordings/soft.recording.parquet", "soft.frf.parquet", "fits/soft.json"}
OF_HARD = {"recordings/hard.recording.parquet", "hard.frf.parquet", "fits/hard.json"}
FITS = {"fits/soft.json", "fits/hard.json"}
RESPONSES = {"soft.frf.parquet", "hard.frf.parquet"}
ALL = OF_SOFT | OF_HARD | {RESULT}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A laboratory with its result, to be copied."""
    folder = tmp_path_factory.mktemp("finished")
    done(laboratory(folder), folder / "out")
    return folder


@pytest.fixture
def lab(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished laboratory that a test may change."""
    for name, content in contents(finished).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    return tmp_path


def made_again(lab: Path, *overrides: str) -> set[str]:
    witness = Witness(lab / "out")
    done(lab / "pipeline.yaml", lab / "out", overrides)
    return witness.made()


def replaced(name: str, old: str, new: str) -> Callable[[Path], None]:
    """A change of one place of one file."""

    def change(lab: Path) -> None:
        text = (lab / name).read_text()
        assert text.count(old) >= 1
        (lab / name).write_text(text.replace(old, new, 1))

    return change


def test_a_run_leaves_these_files_and_no_others(lab: Path) -> None:
    assert set(contents(lab / "out")) == ALL


def test_nothing_is_made_again_when_nothing_changed(lab: Path) -> None:
    assert made_again(lab) == set()


CHANGES = {
    "another sample": (lambda lab: (lab / "soft.csv").write_text(recording(18.1e3)), OF_SOFT | {RESULT}),
    "the sensor's delay": (replaced("rig.yaml", "unit: um,", "unit: um, delay: 10 ns,"), ALL),
    "the rig's mass": (replaced("rig.yaml", "mass: 0.79 kg", "mass: 0.79001 kg"), ALL),
    "skipped periods": (replaced("pipeline.yaml", "skip: 0", "skip: 1"), RESPONSES | FITS | {RESULT}),
    "a fit's band": (replaced("pipeline.yaml", "band: 10-40 Hz", "band: 11-40 Hz"), FITS | {RESULT}),
    "a fit's estimator": (replaced("pipeline.yaml", "estimator: ls", "estimator: iv"), FITS | {RESULT}),
    "a fit more": (
        replaced("pipeline.yaml", "accept:", "  more: {model: sdof, input: f, output: y}\naccept:"),
        FITS | {RESULT},
    ),
    "a rule": (replaced("pipeline.yaml", ">= 0.9", ">= 0.95"), {RESULT}),
    "the title": (replaced("pipeline.yaml", "title: Small", "title: Smaller"), {RESULT}),
    "one test's condition": (
        replaced("pipeline.yaml", "preload: 100 N", "preload: 101 N"),
        {"soft.frf.parquet", "fits/soft.json", RESULT},
    ),
    "a test less": (
        replaced(
            "pipeline.yaml", "  - {name: hard, recordings: hard.csv, conditions: {preload: 200 N}}\n", ""
        ),
        {RESULT},
    ),
    "a comment": (replaced("pipeline.yaml", "title: Small", "title: Small  # as before"), set()),
    "the report": (replaced("pipeline.yaml", "formats: []", "formats: [md]"), set()),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_depends_on_a_change_is_made_again(lab: Path, name: str) -> None:
    """And then all is fresh, and what was kept together with what is new is byte for byte a run from nothing,
    but for the files of a test that has gone.
    """
    change, expected = CHANGES[name]
    change(lab)
    assert made_again(lab) == expected
    assert made_again(lab) == set()
    if expected and name != "a test less":
        done(lab / "pipeline.yaml", lab / "new")
        assert contents(lab / "out") == contents(lab / "new")


def test_a_change_put_back_gives_the_old_bytes(lab: Path) -> None:
    before = contents(lab / "out")
    (lab / "soft.csv").write_text(recording(18.1e3))
    assert made_again(lab)
    (lab / "soft.csv").write_text(recording(18e3))
    assert made_again(lab) == OF_SOFT | {RESULT}
    assert contents(lab / "out") == before


def test_the_same_content_under_a_new_time_is_fresh(lab: Path) -> None:
    """Content counts, not the clock."""
    for name in ("soft.csv", "rig.yaml", "pipeline.yaml"):
        text = (lab / name).read_text()
        (lab / name).unlink()
        (lab / name).write_text(text)
    assert made_again(lab) == set()


def test_an_override_is_a_change_like_any_other(lab: Path) -> None:
    assert made_again(lab, "identify.plain.band=14-36 Hz") == FITS | {RESULT}
    assert made_again(lab, "identify.plain.band=14-36 Hz") == set()
    assert made_again(lab) == FITS | {RESULT}


@pytest.mark.parametrize("name", sorted(ALL))
def test_what_was_deleted_is_made_again_and_its_followers_stay(lab: Path, name: str) -> None:
    before = contents(lab / "out")
    (lab / "out" / name).unlink()
    assert made_again(lab) == {name}
    assert contents(lab / "out") == before


@pytest.mark.parametrize("name", [RESULT, "fits/soft.json"])
@pytest.mark.parametrize("content", [b"", b"{", b"[]"])
def test_a_damaged_result_is_made_again(lab: Path, name: str, content: bytes) -> None:
    before = contents(lab / "out")
    (lab / "out" / name).write_bytes(content)
    assert made_again(lab) == {name}
    assert contents(lab / "out") == before


def test_a_result_of_another_version_is_made_again(lab: Path) -> None:
    path = lab / "out" / RESULT
    path.write_text(path.read_text("utf-8").replace('"labpipe": "', '"labpipe": "0.', 1), "utf-8")
    assert made_again(lab) == {RESULT}


def test_the_header_of_a_response_says_what_it_was_made_from(lab: Path) -> None:
    header = json.loads(pq.ParquetFile(lab / "out/soft.frf.parquet").metadata.metadata[b"labpipe"])
    assert [entry["path"] for entry in header["inputs"]] == ["soft.recording.parquet"]
    assert header["parameters"]["frf"]["period"] == 1.0 and header["parameters"]["conditions"] == {
        "preload": "100 N"
    }


# a pipeline of one test


@pytest.fixture
def alone(tmp_path: Path) -> Path:
    done(laboratory(tmp_path, ALONE), tmp_path / "out")
    return tmp_path


def test_one_test_has_no_file_of_fits(alone: Path) -> None:
    assert set(contents(alone / "out")) == {"recordings/soft.recording.parquet", "frf.frf.parquet", RESULT}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            replaced("rig.yaml", "0.79 kg", "0.79001 kg"),
            {"recordings/soft.recording.parquet", "frf.frf.parquet", RESULT},
        ),
        (replaced("pipeline.yaml", "skip: 0", "skip: 1"), {"frf.frf.parquet", RESULT}),
        (replaced("pipeline.yaml", "band: 10-40 Hz", "band: 11-40 Hz"), {RESULT}),
        (replaced("pipeline.yaml", "formats: []", "formats: [md]"), set()),
    ],
    ids=["rig", "frf", "fit", "report"],
)
def test_one_test_is_fresh_by_the_same_rule(
    alone: Path, change: Callable[[Path], None], expected: set[str]
) -> None:
    assert made_again(alone) == set()
    change(alone)
    assert made_again(alone) == expected


def test_the_rig_of_a_single_recording_counts_as_well(lab: Path) -> None:
    """The second test's probe is turned around; no raw file, no fit and no other rig changes."""
    turned = "recordings: {file: hard.csv, channels: {y: {invert: true}}}"
    replaced("pipeline.yaml", "recordings: hard.csv", turned)(lab)
    assert made_again(lab) == OF_HARD | {RESULT}
    done(lab / "pipeline.yaml", lab / "new")
    assert contents(lab / "out") == contents(lab / "new")


def test_the_same_work_elsewhere_gives_the_same_bytes(
    alone: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = tmp_path_factory.mktemp("another laboratory")
    done(laboratory(other, ALONE), other / "out")
    assert contents(other / "out") == contents(alone / "out")
    assert str(alone).encode() not in b"".join(contents(alone / "out").values())


def test_the_texts_of_the_laboratory_are_those_that_are_changed() -> None:
    """The changes above would be no changes if the texts did not hold what they replace."""
    assert (
        "mass: 0.79 kg" in RIG
        and "skip: 0" in PIPELINE
        and "recordings: soft.csv" in ALONE
        and "tests:" not in ALONE
    )


def test_conditions_of_a_ready_response_reach_its_fits(tmp_path: Path) -> None:
    """The error between mountings went by the mounting of an earlier run."""
    jw = 2j * np.pi * np.arange(20.0, 40.0)
    h = 1 / (45e3 + 30 * jw + 0.92 * jw**2)
    rows = "".join(f"{20 + n},{x.real!r},{x.imag!r}\n" for n, x in enumerate(h.tolist()))
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text(f"# {name}\nfrequency_hz,x/f:re,x/f:im\n{rows}")
    for mounting in ("2", "1"):
        (tmp_path / "p.yaml").write_text(
            "tests:\n  - {name: a, frfs: a.csv, conditions: {mounting: 1}}\n"
            f"  - {{name: b, frfs: b.csv, conditions: {{mounting: {mounting}}}}}\n"
            "uncertainty: {repeatability: {remounting: {parameter: k, size: 1 %, per: mounting}}}\n"
            "identify: {s: {model: sdof, estimator: ls, mass: 0.92 kg}}\nreport: {formats: []}\n"
        )
        fits = labpipe.run(tmp_path / "p.yaml", tmp_path / "out").fits
    assert [fit.budget.sources[0].source for fit in fits] == ["remounting (mounting 1)"] * 2

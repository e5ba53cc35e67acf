"""labpipe verify, and what a run does with what was edited or damaged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.conftest import Command
from tests.project.laboratory import contents, done, laboratory, recording

RESULT = "out/identification.json"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    done(laboratory(folder), folder / "out")
    return folder


@pytest.fixture
def lab(finished: Path, tmp_path: Path) -> Path:
    """A finished laboratory: two recordings, responses, files of fits, one result."""
    for name, content in contents(finished).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    return tmp_path


def edited(path: Path, old: str, new: str) -> None:
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), "utf-8")


def inverted(path: Path, place: int = 400) -> None:
    content = bytearray(path.read_bytes())
    content[place : place + 20] = bytes(255 - byte for byte in content[place : place + 20])
    path.write_bytes(content)


def test_a_whole_archive_holds(lab: Path, labpipe: Command) -> None:
    """7 artefacts name 2 raw files twice, 2 recordings, 2 responses twice."""
    ended = labpipe("verify", lab / "out")
    assert ended.code == 0 and ended.err == ""
    assert ended.out.startswith(
        "7 artefacts: 0 do not hold; 0 without a digest; of the files that they "
        "name 10 are the same, 0 are not"
    )


@pytest.mark.parametrize(
    "name", ["identification.json", "fits/hard.json", "hard.frf.parquet", "recordings/soft.recording.parquet"]
)
def test_what_was_damaged_is_named_and_made_again(lab: Path, labpipe: Command, name: str) -> None:
    before = contents(lab / "out")
    inverted(lab / "out" / name)
    ended = labpipe("verify", lab / "out")
    assert ended.code == 1 and f"FAILED {lab}/out/{name}: " in ended.out
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out", "-q")
    assert ended.code == 0 and ended.err.count("\n") == 1
    assert ended.err.startswith(f"warning: {lab}/out/{name}: ") and ended.err.endswith("; it is made again\n")
    assert contents(lab / "out") == before


def test_an_edited_value_is_made_again_by_run_and_refused_by_the_others(lab: Path, labpipe: Command) -> None:
    before = contents(lab / "out")
    edited(lab / RESULT, '"name": "k", "value": ', '"name": "k", "value": 9')
    said = "content does not match its digest: edited or damaged after labpipe wrote it"
    for command in (
        ("report", lab / "out", "-o", lab / "r.html"),
        ("compare", lab / "out", lab / "out"),
        ("export", lab / RESULT, "--to", "csv", "-o", lab / "a.csv"),
    ):
        ended = labpipe(*command)
        assert (
            ended.code == 2
            and ended.err.count("\n") == 1
            and said in ended.err
            and ("have labpipe make it again") in ended.err
        )
    assert said in labpipe("list", lab).out
    assert said in labpipe("run", lab / "pipeline.yaml", "-o", lab / "out", "-q").err
    assert contents(lab / "out") == before | {
        name: (lab / "out" / name).read_bytes() for name in contents(lab / "out") if "catalogue" in name
    }


def test_a_removed_fit_is_found_in_a_file_of_fits(lab: Path, labpipe: Command) -> None:
    """An empty list once lost a test in silence."""
    path = lab / "out/fits/soft.json"
    entries = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps({**entries, "fits": []}), "utf-8")
    before = (lab / RESULT).read_bytes()
    (lab / RESULT).unlink()
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out", "-q")
    assert ended.code == 0 and "soft.json: content does not match its digest" in ended.err
    assert (lab / RESULT).read_bytes() == before


def test_a_result_without_a_digest_is_said_and_holds(lab: Path, labpipe: Command) -> None:
    path = lab / RESULT
    path.write_text(
        "".join(line for line in path.read_text("utf-8").splitlines(True) if not line.startswith('"digest"')),
        "utf-8",
    )
    ended = labpipe("verify", lab / "out")
    assert (
        ended.code == 0
        and f"note   {path}: carries no digest" in ended.out
        and "1 without a digest" in ended.out
    )
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out", "-q")
    assert "carries no digest; it is made again" in ended.err


def test_another_raw_file_is_named(lab: Path, labpipe: Command) -> None:
    (lab / "soft.csv").write_text(recording(18.1e3))
    ended = labpipe("verify", lab / "out", "-c", lab / "pipeline.yaml")
    assert ended.code == 1 and "'soft.csv' is not the file that it was made from" in ended.out
    (lab / "soft.csv").unlink()
    ended = labpipe("verify", lab / "out", "-v")
    assert ended.code == 0 and "'soft.csv' is not there to be compared" in ended.out


def test_a_rig_file_that_changed_since_is_named(lab: Path, labpipe: Command) -> None:
    """The mass of the rig is that of the fits; the result holds what it was made with."""
    before = labpipe("verify", lab / "out", "-c", lab / "pipeline.yaml")
    assert before.code == 0 and "something else" not in before.out
    edited(lab / "rig.yaml", "mass: ", "mass: 1")
    ended = labpipe("verify", lab / "out", "-c", lab / "pipeline.yaml")
    assert ended.code == 0
    assert "pipeline.yaml: says something else under 'identify' than the result in" in ended.out


def test_the_numbers_are_found_again_by_running(lab: Path, labpipe: Command) -> None:
    assert labpipe("verify", lab / "out", "-c", lab / "pipeline.yaml", "--again").code == 0
    ended = labpipe(
        "verify", lab / "out", "-c", lab / "pipeline.yaml", "--again", "--set", "identify.plain.band=14-36 Hz"
    )
    assert ended.code == 1 and f"FAILED {lab}/{RESULT}: running again gives another content" in ended.out
    edited(
        lab / "pipeline.yaml", "  - {name: hard, recordings: hard.csv, conditions: {preload: 200 N}}\n", ""
    )
    ended = labpipe("verify", lab / "out", "-c", lab / "pipeline.yaml", "--again")
    assert ended.code == 1 and "hard.frf.parquet: is not made by this pipeline" in ended.out


@pytest.mark.parametrize(
    ("arguments", "said"), [(("none",), "no such folder"), ((".",), "holds no artefact of labpipe")]
)
def test_what_cannot_be_verified(
    tmp_path: Path, labpipe: Command, arguments: tuple[str, ...], said: str
) -> None:
    ended = labpipe("verify", *(tmp_path / argument for argument in arguments))
    assert ended.code == 2 and said in ended.err
    ended = labpipe("verify", tmp_path, "--again")
    assert ended.code == 2 and "--again: needs the pipeline" in ended.err

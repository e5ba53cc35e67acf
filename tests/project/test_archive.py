"""labpipe archive and the verification of what it wrote: round trips, what RO-Crate 1.1 demands, and
everything that can be wrong with it.

Digests and sizes are computed here by hashlib from what unzipping gives; the demands on the metadata are
those of the sections "Root Data Entity", "Data Entities" and "Provenance" of RO-Crate 1.1, and of the
specification of .eln files.
"""

from __future__ import annotations

import datetime
import hashlib
import io
import json
import os
import random
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from labpipe.cli.main import run_command
from labpipe.errors import DataError
from labpipe.project.archive import contents as archived, pack
from labpipe.project.pipeline_file import load_pipeline
from tests.conftest import Command
from tests.hostile.mutations import mutated_bytes
from tests.project.laboratory import PIPELINE, contents, done, laboratory, recording

METADATA = "ro-crate-metadata.json"
PROJECT, RESULTS = "experiment/project/", "experiment/results/"
Members = dict[str, bytes]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    done(laboratory(folder), folder / "out")
    return folder


@pytest.fixture
def lab(finished: Path, tmp_path: Path) -> Path:
    """A finished laboratory: pipeline, rig, two recordings, and their results in out."""
    return shutil.copytree(finished, tmp_path / "lab")


@pytest.fixture(scope="module")
def whole(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of the laboratory's archive."""
    path = tmp_path_factory.mktemp("whole") / "a.zip"
    assert run_command(["archive", str(finished / "out"), "-o", str(path)]) == 0
    return path.read_bytes()


@pytest.fixture
def packed(lab: Path, whole: bytes) -> Path:
    (lab / "a.zip").write_bytes(whole)
    return lab / "a.zip"


@pytest.fixture(scope="module")
def one(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of an archive without recordings, which is not run again."""
    scratch = tmp_path_factory.mktemp("scratch")
    pipeline = load_pipeline(finished / "pipeline.yaml")
    packed = archived(finished / "out", pipeline, scratch, digests_only=True)
    pack(packed, finished / "one.zip", "2026-11-03")
    content = (finished / "one.zip").read_bytes()
    (finished / "one.zip").unlink()
    return content


def members(path: Path) -> Members:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def graph(content: bytes) -> dict[str, dict[str, Any]]:
    return {entity["@id"]: entity for entity in json.loads(content)["@graph"]}


def rewritten(path: Path, files: Members, *, digests: bool = False) -> Path:
    """The archive with other members; *digests*: the metadata say what is in them, as one would write who
    wants to deceive.
    """
    if digests:
        crate = json.loads(files[METADATA])
        for entity in crate["@graph"]:
            if entity["@type"] == "File":
                content = files[entity["@id"]]
                entity |= {"contentSize": str(len(content)), "sha256": hashlib.sha256(content).hexdigest()}
        files = {**files, METADATA: json.dumps(crate).encode()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


@pytest.mark.long
def test_an_archive_is_verified_far_from_where_it_was_made(
    packed: Path, tmp_path: Path, labpipe: Command
) -> None:
    """Nothing but the file itself is left."""
    alone = tmp_path / "elsewhere" / "b.zip"
    alone.parent.mkdir()
    packed.rename(alone)
    shutil.rmtree(tmp_path / "lab")
    ended = labpipe("verify", alone)
    assert ended.code == 0 and ended.err == ""
    assert ended.out.splitlines() == [
        "12 files: 0 do not hold",
        "7 artefacts: 0 do not hold; 0 without a digest; of the files that they name 10 are the same, 0 are "
        "not there",
        "run again: the same bytes",
    ]
    assert [path.name for path in tmp_path.rglob("*")] == ["elsewhere", "b.zip"]


def test_the_metadata_are_what_ro_crate_demands(packed: Path, lab: Path) -> None:
    files = members(packed)
    crate = json.loads(files[METADATA])
    assert crate["@context"] == [
        "https://w3id.org/ro/crate/1.1/context",
        {"sha256": "http://schema.org/sha256"},
    ]
    entities = graph(files[METADATA])
    assert len(entities) == len(crate["@graph"])
    descriptor, root = entities[METADATA], entities["./"]
    assert descriptor["@type"] == "CreativeWork" and descriptor["about"] == {"@id": "./"}
    assert descriptor["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    assert (
        root["@type"] == "Dataset" and root["name"] == "Small" and root["description"].startswith("Small: ")
    )
    assert datetime.date.fromisoformat(root["datePublished"]).isoformat() == root["datePublished"]
    assert root["license"].startswith("Not stated.")
    # Every file of the ZIP is an entity with its size and digest, and part of the root.
    parts = {part["@id"] for part in root["hasPart"]}
    assert parts - {"experiment/"} == set(files) - {METADATA}
    for name, content in files.items():
        if name != METADATA:
            entity = entities[name]
            assert (
                entity["@type"] == "File"
                and entity["contentSize"] == str(len(content))
                and "/" in entity["encodingFormat"]
            )
            assert entity["sha256"] == hashlib.sha256(content).hexdigest()
    assert files[PROJECT + "soft.csv"] == (lab / "soft.csv").read_bytes()
    assert files[RESULTS + "identification.json"] == (lab / "out/identification.json").read_bytes()


def test_the_metadata_name_the_run_and_nobody(packed: Path) -> None:
    """Every reference leads to an entity; nobody is named whom nobody named."""
    text = members(packed)[METADATA]
    entities = graph(text)
    run = entities["#run"]
    software = entities[run["instrument"]["@id"]]
    assert (
        run["@type"] == "CreateAction"
        and software["@type"] == "SoftwareApplication"
        and software["name"] == "labpipe"
    )
    of, made = ({one["@id"] for one in run[key]} for key in ("object", "result"))
    assert of == {PROJECT + name for name in ("pipeline.yaml", "rig.yaml", "soft.csv", "hard.csv")}
    assert RESULTS + "identification.json" in made and RESULTS + "fits/soft.json" in made
    assert entities["./"]["mainEntity"] == {"@id": PROJECT + "pipeline.yaml"}

    def references(entry: Any) -> list[str]:
        if isinstance(entry, list):
            return [name for one in entry for name in references(one)]
        return [entry["@id"]] if isinstance(entry, dict) and set(entry) == {"@id"} else []

    named = {name for entity in entities.values() for entry in entity.values() for name in references(entry)}
    assert named - set(entities) == {"https://w3id.org/ro/crate/1.1"}
    assert not {"author", "creator", "agent", "publisher", "sdPublisher"} & {
        key for entity in entities.values() for key in entity
    }
    assert {"Person", "Organization"}.isdisjoint(entity["@type"] for entity in entities.values())


def test_the_same_results_give_the_same_bytes(
    lab: Path, packed: Path, tmp_path: Path, labpipe: Command
) -> None:
    """In another folder, on another day, of files with other times.

    The result's own day is the date, unless --date states one.
    """
    other = shutil.copytree(lab / "out", tmp_path / "other/out")
    for name in ("pipeline.yaml", "rig.yaml", "soft.csv", "hard.csv"):
        shutil.copy(lab / name, tmp_path / "other")
        os.utime(tmp_path / "other" / name, (1e9, 1e9))
    assert labpipe("archive", other, "-o", tmp_path / "b.zip").code == 0
    assert (tmp_path / "b.zip").read_bytes() == packed.read_bytes()
    with zipfile.ZipFile(packed) as archive:
        infos = archive.infolist()
    assert {info.date_time for info in infos} == {(1980, 1, 1, 0, 0, 0)}
    assert [info.filename for info in infos] == sorted(info.filename for info in infos)
    os.utime(other / "identification.json", (1e9, 1e9))
    assert labpipe("archive", other, "-o", tmp_path / "c.zip").code == 0
    # 10^9 seconds after 1970 began.
    assert graph(members(tmp_path / "c.zip")[METADATA])["./"]["datePublished"] == "2001-09-09"
    assert labpipe("archive", other, "-o", tmp_path / "d.zip", "--date", "2026-11-03").code == 0
    assert graph(members(tmp_path / "d.zip")[METADATA])["./"]["datePublished"] == "2026-11-03"


def test_an_eln_holds_the_same_in_one_folder_of_its_name(lab: Path, packed: Path, labpipe: Command) -> None:
    assert labpipe("archive", lab / "out", "-o", lab / "bench 3.eln").code == 0
    assert members(lab / "bench 3.eln") == {
        f"bench 3/{name}": content for name, content in members(packed).items()
    }
    assert labpipe("verify", lab / "bench 3.eln").code == 0


def test_digests_in_place_of_recordings(lab: Path, labpipe: Command) -> None:
    ended = labpipe("archive", lab / "out", "-o", lab / "d.zip", "--digests-only")
    assert ended.code == 0 and ended.out == f"written: {lab}/d.zip, 8 files; of 4 more the digests\n"
    files = members(lab / "d.zip")
    assert not [name for name in files if name.endswith((".csv", ".recording.parquet"))]
    entity = graph(files[METADATA])[f"#left-out/{PROJECT}soft.csv"]
    content = (lab / "soft.csv").read_bytes()
    assert entity["sha256"] == hashlib.sha256(content).hexdigest() and entity["contentSize"] == str(
        len(content)
    )
    assert entity["@type"] == "CreativeWork"
    absent = [
        one["@id"] for one in graph(files[METADATA]).values() if "not in the" in one.get("description", "")
    ]
    assert len(absent) == 4 and all(name.startswith("#left-out/") for name in absent)
    ended = labpipe("verify", lab / "d.zip")
    assert ended.code == 0 and ended.out.endswith(
        "not run again: of 4 files the archive holds only the digests\n"
    )
    ended = labpipe("verify", lab / "d.zip", "-c", lab / "pipeline.yaml", "--again")
    assert ended.code == 0 and ended.out.endswith("run again: the same bytes\n")


def test_digests_are_compared_with_recordings_at_hand(lab: Path, labpipe: Command) -> None:
    assert labpipe("archive", lab / "out", "-o", lab / "d.zip", "--digests-only").code == 0
    assert (
        "6 are the same, 2 are not there" in labpipe("verify", lab / "d.zip", "-c", lab / "pipeline.yaml").out
    )
    (lab / "soft.csv").write_text(recording(18.1e3))
    ended = labpipe("verify", lab / "d.zip", "-c", lab / "pipeline.yaml")
    assert ended.code == 1 and "'soft.csv' is not the file that it was made from" in ended.out


@pytest.mark.parametrize("results", ["whole", "dataset"])
def test_any_folders_and_names(tmp_path: Path, labpipe: Command, results: str) -> None:
    """Paths that go up and down again, spaces and signs in names.

    A dataset, whose tests are of the day of their files.
    """
    home = tmp_path / "lab of 3 % & more"
    for folder in ("rigs", "raw data", "pipelines"):
        (home / folder).mkdir(parents=True)
    laboratory(home)
    for name, place in (
        ("rig.yaml", "rigs"),
        ("soft.csv", "raw data"),
        ("hard.csv", "raw data"),
        ("pipeline.yaml", "pipelines"),
    ):
        (home / name).rename(home / place / name)
    for name in ("soft.csv", "hard.csv"):
        os.utime(home / "raw data" / name, (1e9, 1e9))
    text = (
        PIPELINE.replace("rig.yaml", "../rigs/rig.yaml").replace("recordings: ", "recordings: ../raw data/")
        + f"results: {results}\n"
    )
    (home / "pipelines/pipeline.yaml").write_text(text)
    assert labpipe("run", home / "pipelines/pipeline.yaml", "-o", home / "out", "-q").code == 0
    ended = labpipe("archive", home / "out", "-o", tmp_path / "a.zip", "-c", home / "pipelines/pipeline.yaml")
    assert ended.code == 0, ended.err
    names = set(members(tmp_path / "a.zip"))
    assert {
        PROJECT + "raw data/soft.csv",
        PROJECT + "rigs/rig.yaml",
        PROJECT + "pipelines/pipeline.yaml",
    } <= names
    assert any("date=2001-09-09" in name for name in names) is (results == "dataset")
    shutil.rmtree(home)
    ended = labpipe("verify", tmp_path / "a.zip")
    assert (ended.code, ended.err) == (0, "") and ended.out.endswith("run again: the same bytes\n")


def test_what_is_not_of_the_result_is_left_out(lab: Path, labpipe: Command) -> None:
    """What a pipeline of before left in the folder would be found by no run again."""
    shutil.copy(lab / "out/soft.frf.parquet", lab / "out/before.frf.parquet")
    (lab / "out/notes.txt").write_text("private")
    ended = labpipe("archive", lab / "out", "-o", lab / "a.zip")
    assert (
        ended.code == 0
        and f"left out: {lab}/out/before.frf.parquet, which does not belong to this result" in ended.out
    )
    assert not [name for name in members(lab / "a.zip") if "before" in name or "notes" in name]
    assert labpipe("verify", lab / "a.zip").code == 0


def changed(name: str, old: bytes, new: bytes) -> Callable[[Members], Members]:
    def change(files: Members) -> Members:
        assert old in files[name]
        return {**files, name: files[name].replace(old, new, 1)}

    return change


def without(name: str) -> Callable[[Members], Members]:
    return lambda files: {key: content for key, content in files.items() if key != name}


@pytest.mark.parametrize(
    ("change", "digests", "said"),
    [
        (
            changed(PROJECT + "rig.yaml", b"0.79", b"0.97"),
            False,
            PROJECT + "rig.yaml: is not the file that the archive lists",
        ),
        (changed(PROJECT + "rig.yaml", b"0.79", b"0.797"), False, "rig.yaml: has 209 bytes in place of 208"),
        (without(PROJECT + "soft.csv"), False, PROJECT + "soft.csv: is missing"),
        (lambda files: {**files, "more.txt": b"?"}, False, "more.txt: is not listed among the metadata"),
        # Who changes the digests of the archive as well meets those of the artefacts, and who changes the
        # settings another result.
        (
            changed(RESULTS + "identification.json", b'"k", "value": ', b'"k", "value": 9'),
            True,
            "content does not match its digest",
        ),
        (
            changed(PROJECT + "soft.csv", b"\n0.01,", b"\n0.01,1"),
            True,
            "'soft.csv' is not the file that it was made from",
        ),
        (
            changed(PROJECT + "pipeline.yaml", b"15-35", b"14-36"),
            True,
            "identification.json: running again gives another content",
        ),
        (
            changed(PROJECT + "rig.yaml", b"mass:", b"mess:"),
            True,
            f"{PROJECT}rig.yaml:6:1: mess: unknown key",
        ),
    ],
)
def test_what_was_changed_is_named(
    packed: Path, labpipe: Command, change: Any, digests: bool, said: str
) -> None:
    rewritten(packed, change(members(packed)), digests=digests)
    ended = labpipe("verify", packed)
    assert ended.code == 1 and ended.err == ""
    failed = [line for line in ended.out.splitlines() if line.startswith("FAILED ")]
    assert failed and all(line.startswith(f"FAILED {packed}: ") for line in failed)
    assert any(said in line for line in failed), failed


def test_a_damaged_member_is_named(packed: Path, labpipe: Command) -> None:
    content = packed.read_bytes()
    place = content.index(b"force [N]")
    packed.write_bytes(content[:place] + b"F" + content[place + 1 :])
    ended = labpipe("verify", packed)
    assert (
        ended.code == 1
        and f"FAILED {packed}: {PROJECT}" in ended.out
        and "is damaged (Bad CRC-32" in ended.out
    )


def linked(files: Members) -> bytes:
    """A ZIP with a symbolic link."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
        info = zipfile.ZipInfo("link")
        info.create_system, info.external_attr = 3, 0o120777 << 16
        archive.writestr(info, "/etc/passwd")
    return stream.getvalue()


def zipped(files: Members) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


def described(change: Callable[[dict[str, Any]], Any]) -> Callable[[Members], bytes]:
    """A ZIP with other metadata."""

    def change_metadata(files: Members) -> bytes:
        crate = json.loads(files[METADATA])
        change(crate)
        return zipped({**files, METADATA: json.dumps(crate).encode()})

    return change_metadata


def unsized(crate: dict[str, Any]) -> None:
    next(entity for entity in crate["@graph"] if entity["@type"] == "File")["contentSize"] = "many"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (lambda files: zipped(files)[:-40], "a.zip: is not a ZIP file, or a damaged one"),
        (lambda files: b"", "a.zip: is not a ZIP file, or a damaged one"),
        (
            lambda files: zipped({**files, "../../out.txt": b"slipped"}),
            "'../../out.txt': has a name that is empty or leads out of the archive",
        ),
        (
            lambda files: zipped({**files, "/etc/x": b"slipped"}),
            "'/etc/x': has a name that is empty or leads out of the archive",
        ),
        (
            lambda files: zipped({**files, "C:/x": b"slipped"}),
            "'C:/x': has a name that is empty or leads out of the archive",
        ),
        (lambda files: zipped({**files, "a\\b": b"slipped"}), "is empty or leads out of the archive"),
        (linked, "'link': is not a regular file"),
        (lambda files: zipped({**files, "experiment": b"?"}), "'experiment': is a file and a folder"),
        (lambda files: zipped(without(METADATA)(files)), f"a.zip: holds no {METADATA}"),
        (lambda files: zipped({}), f"a.zip: holds no {METADATA}"),
        (lambda files: zipped({**files, METADATA: b"{"}), f"{METADATA}: is not an RO-Crate of labpipe"),
        (
            lambda files: zipped({**files, METADATA: b"[" * 100_000}),
            f"{METADATA}: is not an RO-Crate of labpipe",
        ),
        (described(lambda crate: crate["@graph"].pop(0)), f"{METADATA}: is not an RO-Crate of labpipe"),
        (
            described(lambda crate: crate["@graph"][1].pop("mainEntity")),
            f"{METADATA}: is not an RO-Crate of labpipe",
        ),
        (
            described(lambda crate: crate["@graph"][1].update(mainEntity={"@id": "x.yaml"})),
            "names the pipeline 'x.yaml', which is not a file",
        ),
        (described(unsized), "without its size and digest"),
    ],
)
def test_what_is_no_archive_is_refused(packed: Path, labpipe: Command, content: Any, said: str) -> None:
    packed.write_bytes(content(members(packed)))
    before = contents(packed.parent.parent)
    ended = labpipe("verify", packed)
    assert (
        ended.code == 2 and ended.out == "" and ended.err.count("\n") == 1 and ended.err.startswith("error: ")
    )
    assert said in ended.err
    assert contents(packed.parent.parent) == before


def test_a_listed_name_that_leads_out_is_written_nowhere(packed: Path, labpipe: Command) -> None:
    """Only what is in the ZIP, under names that are safe, is unpacked."""

    def lead_out(crate: dict[str, Any]) -> None:
        entity = next(entity for entity in crate["@graph"] if entity["@id"] == PROJECT + "rig.yaml")
        entity["@id"] = "../../rig.yaml"

    packed.write_bytes(described(lead_out)(members(packed)))
    ended = labpipe("verify", packed)
    assert ended.code == 1 and "../../rig.yaml: is missing" in ended.out
    assert not (packed.parent.parent / "rig.yaml").exists()


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(lab: Path) -> None:
        text = (lab / name).read_text("utf-8")
        assert old in text
        (lab / name).write_text(text.replace(old, new, 1), "utf-8")

    return change


def absolute(lab: Path) -> None:
    edit("pipeline.yaml", "rig: rig.yaml", f"rig: {lab}/rig.yaml")(lab)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda lab: (lab / "soft.csv").write_text(recording(18.1e3)),
            "'soft.csv' is not the file that it was made from",
        ),
        (
            lambda lab: (lab / "soft.csv").unlink(),
            "pipeline.yaml:4:18: tests.1.recordings: no such file 'soft.csv'",
        ),
        (lambda lab: (lab / "rig.yaml").unlink(), "no such file 'rig.yaml'"),
        (
            lambda lab: (lab / "pipeline.yaml").unlink(),
            "out: no pipeline 'pipeline.yaml' is in or above the results; name it with -c",
        ),
        (
            lambda lab: (lab / "out/identification.json").unlink(),
            "out: holds no identification.json; results appear with",
        ),
        (lambda lab: shutil.rmtree(lab / "out"), "out: holds no identification.json"),
        (
            edit("out/identification.json", '"k", "value": ', '"k", "value": 9'),
            "identification.json: content does not match its digest",
        ),
        (
            edit("out/fits/soft.json", '"k", "value": ', '"k", "value": 9'),
            "soft.json: content does not match its digest",
        ),
        (
            edit("pipeline.yaml", "15-35 Hz", "14-36 Hz"),
            "pipeline.yaml: says something else under 'identify' than the result in",
        ),
        (
            edit("rig.yaml", "Small rig", "Other rig"),
            "pipeline.yaml: says something else under 'rig' than the result in",
        ),
        (absolute, "pipeline.yaml:2:6: '"),
        (
            lambda lab: (lab / "out/report.html").write_text("<p>Passed"),
            "report.html: was not drawn from this result, or edited since",
        ),
        (lambda lab: (lab / "a.zip").write_text("dear"), "a.zip: is there already; name another file"),
        (lambda lab: (lab / "a.zip").mkdir(), "a.zip: is there already"),
    ],
)
def test_what_cannot_be_archived_is_refused(lab: Path, labpipe: Command, change: Any, said: str) -> None:
    change(lab)
    before = contents(lab)
    ended = labpipe("archive", lab / "out", "-o", lab / "a.zip")
    assert (
        ended.code == 2 and ended.out == "" and ended.err.count("\n") == 1 and ended.err.startswith("error: ")
    )
    assert said in ended.err
    assert contents(lab) == before and not list(lab.rglob(".labpipe-*"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("out", "-o", "a.tar"), "a.tar: no archive has the ending '.tar'; known: .zip, .eln"),
        (
            ("out", "-o", "a.zip", "--date", "yesterday"),
            "--date: 'yesterday' is not a day; write it as 2026-11-03",
        ),
        (("s3://bench/out", "-o", "a.zip"), "'s3://bench/out' is not a path of this machine"),
        (("out", "-o", "s3://bench/a.zip"), "'s3://bench/a.zip' is not a path of this machine"),
        (("rig.yaml", "-o", "a.zip"), "rig.yaml: holds no identification.json"),
    ],
)
def test_what_is_asked_for_wrongly(
    lab: Path, labpipe: Command, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(lab)
    ended = labpipe("archive", *arguments)
    assert ended.code == 2 and said in ended.err and not (lab / "a.zip").exists()


def test_a_watch_s_results_are_not_archived(lab: Path, labpipe: Command) -> None:
    """Their numbers lie in parts of a dataset that no run makes again, wherever the recordings are."""
    (lab / "data").mkdir()
    (lab / "data" / "soft.csv").write_text((lab / "soft.csv").read_text())
    text = (lab / "pipeline.yaml").read_text()
    for number, each in enumerate(("data/*.csv", "*.nowhere")):
        tests = f'tests:\n  - {{each: "{each}", pattern: "{{name}}"}}\n'
        kept = [part for part in text.split("\n") if part.startswith(("rig", "frf", "  direct", "identify"))]
        (lab / f"bench{number}.yaml").write_text(tests + "\n".join(kept) + "\n")
        out = lab / f"watched{number}"
        ended = labpipe(
            "watch", lab / "data", "-c", lab / f"bench{number}.yaml", "-o", out, "--once", "--settle", "0"
        )
        assert ended.code == 0, ended
        ended = labpipe("archive", out, "-o", lab / "w.zip", "-c", lab / f"bench{number}.yaml")
        assert ended.code == 2 and "is of a watch" in ended.err and "run `labpipe run` over" in ended.err
        assert not (lab / "w.zip").exists()


def test_a_file_that_changes_meanwhile_leaves_no_archive(
    lab: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    scratch = tmp_path_factory.mktemp("scratch")
    packed = archived(lab / "out", load_pipeline(lab / "pipeline.yaml"), scratch, digests_only=False)
    (lab / "soft.csv").write_text(recording(18.1e3))
    before = contents(lab)
    with pytest.raises(DataError, match="changes while it is archived") as raised:
        pack(packed, lab / "a.zip", "2026-11-03")
    assert raised.value.where == str(lab / "soft.csv") and contents(lab) == before


def test_an_archive_elsewhere_is_refused(labpipe: Command) -> None:
    ended = labpipe("verify", "s3://bench/a.zip")
    assert (
        ended.code == 2
        and ("s3://bench/a.zip: is elsewhere; archives and signatures are verified here only; copy it here")
        in ended.err
    )


@pytest.mark.parametrize("seed", range(60))
def test_mutated_archives_are_refused_or_named(
    one: bytes, tmp_path: Path, labpipe: Command, seed: int
) -> None:
    """Anywhere in the file, and among the metadata, where mutations of the whole file hardly ever come: never
    a traceback.
    """
    rng = random.Random(seed)
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(io.BytesIO(one)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    text = mutated_bytes(files[METADATA], rng)
    path.write_bytes(mutated_bytes(one, rng) if seed % 2 else zipped({**files, METADATA: text}))
    ended = labpipe("verify", path)
    assert ended.code in (0, 1, 2) and "labpipe-archive-" not in ended.out + ended.err
    assert ended.err.count("\n") == (ended.code == 2)
    assert [found.name for found in tmp_path.rglob("*")] == ["a.zip"]


def test_another_build_is_said(
    packed: Path, lab: Path, labpipe: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It makes other bytes, since these name the build; it is asked for by --again."""
    monkeypatch.setattr("labpipe.project.archive.code_digest", lambda: "another")
    ended = labpipe("verify", packed)
    assert ended.code == 0 and "not run again: it was made by another build of labpipe (0.1.0)" in ended.out
    assert labpipe("verify", packed, "--again").out.endswith("run again: the same bytes\n")
    ended = labpipe("archive", lab / "out", "-o", lab / "b.zip")
    assert (
        ended.code == 2
        and "was made by another build of labpipe (0.1.0); run `labpipe run` again" in ended.err
    )

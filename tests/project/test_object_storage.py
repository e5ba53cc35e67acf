"""Recordings and results in an object storage: an S3 server on loopback (moto), looked into by boto3, which
knows nothing of labpipe.
"""

from __future__ import annotations

import datetime
import hashlib
import socket
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pyarrow import fs

from labpipe.artefacts import mirrored, places as storage
from labpipe.artefacts.parquet import read_header
from tests.machine.s3_server import SECRET, s3_client, s3_server
from tests.project.laboratory import PIPELINE, RIG, contents, recording

TESTS = 3
BENCH = """title: Bench
rig: rig.yaml
results: dataset
tests:
  - {each: "s3://rigs/runs/*.csv", pattern: "{preload}-{serial}"}
""" + PIPELINE[PIPELINE.index("frf:") :]


@pytest.fixture(scope="module")
def server() -> Iterator[dict[str, str]]:
    with s3_server() as environment:
        yield environment


@pytest.fixture
def s3(server: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """A client of the server, which the environment names; a bucket with recordings of three tests."""
    for name, value in server.items():
        monkeypatch.setenv(name, value)
    client = s3_client()
    urllib.request.urlopen(
        urllib.request.Request(f"{server['AWS_ENDPOINT_URL']}/moto-api/reset", method="POST")
    ).close()
    client.create_bucket(Bucket="rigs")
    for number in range(TESTS):
        client.put_object(Bucket="rigs", Key=f"runs/{100 * number}N-{number}.csv", Body=content(number))
    return client


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "bench.yaml").write_text(BENCH)
    return tmp_path


def content(number: int) -> bytes:
    return recording(18e3 + 1e3 * number, seed=number).encode()


def objects(s3: Any, prefix: str) -> dict[str, bytes]:
    """Every object below a prefix, but for those that pyarrow leaves in the place of folders."""
    listed = s3.list_objects_v2(Bucket="rigs", Prefix=prefix).get("Contents", [])
    names = [one["Key"] for one in listed if not one["Key"].endswith("/")]
    return {
        name.removeprefix(prefix): s3.get_object(Bucket="rigs", Key=name)["Body"].read() for name in names
    }


def test_results_there_are_those_made_here(lab: Path, s3: Any, labpipe) -> None:
    assert labpipe("run", lab / "bench.yaml", "-o", "s3://rigs/out", "-q").code == 0
    assert labpipe("run", lab / "bench.yaml", "-o", f"file://{lab}/out", "-q").code == 0
    there = objects(s3, "out/")
    assert there == contents(lab / "out") and len(there) == 3 * TESTS + 2
    # Provenance: the URL, and the digest of what lies there.
    (named,) = read_header(lab / "out/recordings/100N-1.recording.parquet").inputs
    assert (named.path, named.sha256) == ("s3://rigs/runs/100N-1.csv", hashlib.sha256(content(1)).hexdigest())

    asked = (["list", "-p", "k"], ["list"], ["trend", "-p", "k", "--over", "preload"], ["verify"])
    for command, *options in asked:
        here, elsewhere = (labpipe(command, place, *options) for place in (lab / "out", "s3://rigs/out"))
        assert here == elsewhere and here.code == 0 and here.out, command
    compared = labpipe("compare", "s3://rigs/out", lab / "out")
    assert (
        compared.code == 0
        and compared.out.startswith("fit")
        and "\n0 of 24 parameters differ" in compared.out
    )
    for place, name in ((lab / "out", "here.md"), ("s3://rigs/out/identification.json", "there.md")):
        assert labpipe("report", place, "--test", "100N-1", "-o", lab / name).code == 0
    assert (lab / "here.md").read_bytes() == (lab / "there.md").read_bytes()

    # Nothing new is nothing written.
    def versions() -> list[tuple[str, object]]:
        return [(one["Key"], one["LastModified"]) for one in s3.list_objects_v2(Bucket="rigs")["Contents"]]

    before = versions()
    assert labpipe("run", lab / "bench.yaml", "-o", "s3://rigs/out", "-q").code == 0
    assert versions() == before


@pytest.mark.long
def test_an_upload_that_is_cut_short_leaves_the_earlier_result(
    lab: Path, s3: Any, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the part of the dataset, after it, between fits, before the index: nothing of it is left by the
    next run.
    """
    run = ("run", lab / "bench.yaml", "-o", "s3://rigs/out", "-q", "--set", "report.formats=[md]")
    assert labpipe(*run).code == 0
    listed, first = labpipe("list", "s3://rigs/out", "-p", "k"), set(objects(s3, "out/dataset/"))
    put, sent = mirrored.put, 0
    monkeypatch.setattr(mirrored, "AT_ONCE", 1)

    def cut_short(source: Path, path: Path) -> None:
        nonlocal sent
        if sent == 0:
            raise storage.StorageError("the storage does not answer", where=str(path))
        sent -= 1
        put(source, path)

    again = (*run, "--set", "identify.direct.band=12-40 Hz")
    with monkeypatch.context() as patch:
        patch.setattr(mirrored, "put", cut_short)
        for number in (0, 1, TESTS - 1, 1):
            sent = number
            assert labpipe(*again).code == 2
            assert labpipe("list", "s3://rigs/out", "-p", "k") == listed
        assert objects(s3, "out/report.") == {}, "no report contradicts the result"
    assert labpipe(*again).code == 0
    assert list(objects(s3, "out/report.")) == ["md"]
    assert "12-40 Hz" in labpipe("list", "s3://rigs/out", "-p", "k").out
    assert len(objects(s3, "out/dataset/")) == 1 and not first & set(objects(s3, "out/dataset/"))


def test_a_prefix_is_watched(lab: Path, s3: Any, labpipe) -> None:
    """Each recording once; a bad one stays where it is, and its reason goes to the results."""
    s3.put_object(Bucket="rigs", Key="runs/later/900N-9.csv", Body=b"t [s],force [N],y [um]\n0,1,x\n")
    command = (
        "watch",
        "s3://rigs/runs",
        "-c",
        lab / "bench.yaml",
        "-o",
        "s3://rigs/out",
        "--log",
        lab / "log",
        "--settle",
        "0 s",
        "--once",
    )
    for worked_on in (4, 0):
        ended = labpipe(*command)
        assert ended.code == 0 and f"3 tests in the dataset, 1 failed; {worked_on} worked on now" in ended.out
    s3.put_object(Bucket="rigs", Key="runs/later/300N-3.csv", Body=content(3))
    assert "4 tests in the dataset, 1 failed; 1 worked on now" in labpipe(*command).out
    assert len(labpipe("list", "s3://rigs/out", "-p", "k", "--fit", "direct").out.splitlines()) == 1 + 4
    assert len(objects(s3, "runs/")) == 5 and len((lab / "log/watch.log.jsonl").read_text().splitlines()) == 6
    (reason,) = objects(s3, "out/quarantine/").items()
    assert reason[0] == "later/900N-9.csv.reason.txt" and b"s3://rigs/runs/later/900N-9.csv" in reason[1]
    ended = labpipe(*command[:6], "--once")
    assert ended.code == 2 and "s3://rigs/out: --log: is needed" in ended.err


def test_a_bad_recording_beside_results_that_are_elsewhere_is_not_lost(lab: Path, s3: Any, labpipe) -> None:
    (lab / "runs").mkdir()
    (lab / "runs/1N-1.csv").write_text("no recording")
    ended = labpipe(
        "watch",
        lab / "runs",
        "-c",
        lab / "bench.yaml",
        "-o",
        "s3://rigs/out",
        "--log",
        lab,
        "--settle",
        "0 s",
        "--once",
    )
    assert (
        ended.code == 0
        and (lab / "runs/1N-1.csv").exists()
        and list(objects(s3, "out/quarantine/")) == ["1N-1.csv.reason.txt"]
    )


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ("s3://nobody/runs/*.csv", "s3://nobody/runs: there is no such bucket"),
        ("s3://nobody/a.csv", "s3://nobody/a.csv: there is no such bucket"),
        ("s3://rigs/none/*.csv", "tests.1.each: no object matches 's3://rigs/none/*.csv'"),
        ("s3://rigs/runs/none.csv", "tests.1.each: no such object 's3://rigs/runs/none.csv'"),
        ("s3://", "tests.1.each: 's3://' is not a URL of an object"),
        ("ftp://rigs/a.csv", "tests.1.each: 'ftp://rigs/a.csv' is a URL that cannot be read"),
    ],
)
def test_recordings_that_are_not_there_are_named(lab: Path, s3: Any, labpipe, change: str, what: str) -> None:
    (lab / "bench.yaml").write_text(BENCH.replace("s3://rigs/runs/*.csv", change))
    ended = labpipe("run", lab / "bench.yaml", "-o", lab / "out")
    assert (
        ended.code == 2
        and what in ended.err
        and len(ended.err.splitlines()) == 1
        and not (lab / "out").exists()
    )


def test_places_that_cannot_be_read_are_named(
    lab: Path, s3: Any, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No bucket, no result, no answer, no access: one line with the place, and nothing of the credentials."""

    def said(*arguments: object) -> str:
        ended = labpipe(*arguments)
        assert ended.code == 2 and len(ended.err.splitlines()) == 1 and SECRET not in ended.err
        return ended.err

    assert "s3://nobody/out: there is no such bucket" in said(
        "run", lab / "bench.yaml", "-o", "s3://nobody/out"
    )
    assert "s3://rigs/out: there are no results" in said("list", "s3://rigs/out")
    assert "is not a path of this machine" in said(
        "ingest", "s3://rigs/runs/0N-0.csv", "-r", lab / "rig.yaml", "-o", lab / "out"
    )
    assert "set TMPDIR" in said(
        "run", lab / "bench.yaml", "-o", "s3://rigs/out", "--cluster", "tcp://127.0.0.1:1"
    )
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "")
    storage._open.cache_clear()
    assert "s3://rigs/runs/0N-0.csv: the storage refuses access" in said(
        "run", lab / "bench.yaml", "-o", lab / "out"
    )
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    assert "s3://rigs/out: the storage does not answer" in said("list", "s3://rigs/out")


def test_a_storage_that_is_silent_is_given_up(labpipe, monkeypatch: pytest.MonkeyPatch, s3: Any) -> None:
    """A server that takes connections and says nothing: with the shipped limits half a minute, here 2 s."""
    monkeypatch.setattr(storage, "REQUEST_SECONDS", 1)
    monkeypatch.setattr(storage, "ATTEMPTS", 1)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        began = time.monotonic()
        ended = labpipe("list", "s3://rigs/out")
    assert ended.code == 2 and "does not answer" in ended.err and time.monotonic() - began < 20


def test_an_object_that_changes_while_it_is_read_is_refused(
    lab: Path, s3: Any, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    status, asked = storage.status, 0

    def replaced(path: Path) -> storage.Found | None:
        nonlocal asked
        asked += 1
        found = status(path)
        if asked == 1:
            s3.put_object(Bucket="rigs", Key="runs/0N-0.csv", Body=content(0) + b"\n")
        return found

    monkeypatch.setattr(storage, "status", replaced)
    ended = labpipe("run", lab / "bench.yaml", "-o", lab / "out")
    assert ended.code == 2 and "s3://rigs/runs/0N-0.csv: changed while it was read" in ended.err


def test_a_storage_that_fails_on_the_way_halts_the_run(
    lab: Path, s3: Any, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other recordings are not tried; what is finished is kept, here and there."""
    bring, brought = storage.status, 0

    def failing(path: Path) -> storage.Found | None:
        nonlocal brought
        brought += path.suffix == ".csv"
        if brought > 2:
            raise storage.StorageError("the storage does not answer", where="s3://rigs")
        return bring(path)

    with monkeypatch.context() as patch:
        patch.setattr(storage, "status", failing)
        ended = labpipe("run", lab / "bench.yaml", "-o", "s3://rigs/out")
    assert ended.code == 2 and "1 of 3 tests are finished and kept" in ended.err and brought == 3
    assert list(objects(s3, "out/fits/")) == ["0N-0.json"]


@pytest.mark.parametrize(
    ("scheme", "made"),
    [
        ("s3:", ("S3FileSystem", {"endpoint_override": "here:9000", "scheme": "http"})),
        ("gs:", ("GcsFileSystem", {"retry_time_limit": datetime.timedelta(seconds=storage.REQUEST_SECONDS)})),
        ("gcs:", ("GcsFileSystem", {})),
        ("abfs:", ("FileSystem", {"uri": "abfs://bench"})),
    ],
)
def test_every_storage_is_opened_by_its_own_file_system(
    scheme: str, made: tuple[str, dict[str, object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """None waits longer for an answer than is said; an endpoint of one's own belongs to s3 alone."""

    def system(name: str):
        return lambda **entries: (name, entries)

    monkeypatch.setattr(fs, "S3FileSystem", system("S3FileSystem"))
    monkeypatch.setattr(fs, "GcsFileSystem", system("GcsFileSystem"))
    from_uri = SimpleNamespace(from_uri=lambda uri: (("FileSystem", {"uri": uri}), ""))
    monkeypatch.setattr(fs, "FileSystem", from_uri)
    name, entries = storage._open.__wrapped__(scheme, "bench", "http://here:9000")
    assert name == made[0] and made[1].items() <= entries.items()
    assert ("connect_timeout" in entries) is (scheme == "s3:")

"""What a machine does to a run: it is killed, its disk is full, its folder is read-only, its inputs change,
its clock goes back.
"""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from labpipe.artefacts import writing
from labpipe.artefacts.writing import STAGING, output_folder, staging_folder
from tests.conftest import ROOT, Command
from tests.hostile.seeds import READS, write_seeds
from tests.machine.kills import alone, cluster, kills, prepared, scheduler_kills
from tests.project.laboratory import ALONE, contents, done, laboratory, recording

needs_proc = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="processes are found by /proc"
)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    laboratory(tmp_path, ALONE)
    return tmp_path


@pytest.mark.long
@needs_proc
def test_a_killed_run_is_finished_to_the_same_bytes(tmp_path: Path) -> None:
    """`python -m tests.machine.kills --count 100 --processes 2` does more of them."""
    assert kills(1, alone(2), tmp_path, seed=2) == []


@pytest.mark.long
@needs_proc
def test_a_run_on_a_cluster_whose_worker_is_killed_is_finished_to_the_same_bytes(tmp_path: Path) -> None:
    """`python -m tests.machine.kills --cluster` kills the run itself as well."""
    pytest.importorskip("distributed")
    with cluster(tmp_path) as way:
        assert kills(1, way, tmp_path, worker=True) == []


@pytest.mark.long
@needs_proc
def test_a_run_whose_scheduler_is_killed_says_so_and_is_finished_by_another(tmp_path: Path) -> None:
    """`python -m tests.machine.kills --scheduler --dataset` does more of them."""
    pytest.importorskip("distributed")
    prepared(tmp_path, "dataset")
    assert scheduler_kills(1, tmp_path) == []


def test_the_staging_folder_of_a_killed_run_goes_with_the_next_one(tmp_path: Path) -> None:
    code = """
import os, sys
from pathlib import Path
from labpipe.artefacts.writing import output_folder
with output_folder(Path(sys.argv[1])) as folder:
    folder.write_path("a").write_text("half")
    os.kill(os.getpid(), 9)
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert len(list(tmp_path.glob(f"{STAGING}*"))) == 1
    with output_folder(tmp_path) as folder:
        folder.write_path("b").write_text("whole")
        # That of a run beside this one stays.
        with staging_folder(tmp_path) as other:
            assert folder.staging.exists() and other.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_the_staging_folder_of_a_run_that_was_killed_before_it_was_locked_goes_as_well(
    tmp_path: Path,
) -> None:
    """One in fifty kills of a watch met this moment."""
    code = """
import os, sys
from pathlib import Path
from labpipe.artefacts import writing
writing._take_lock = lambda lock: (os.remove(lock.name), os.kill(os.getpid(), 9))
with writing.staging_folder(Path(sys.argv[1])):
    pass
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(STAGING) and not list(left.iterdir())
    # Of a process that runs, such as this one, it may be locked in a moment.
    fresh = tmp_path / left.name.replace(left.name.split("-")[-2], str(os.getpid()))
    fresh.mkdir()
    with staging_folder(tmp_path):
        assert not left.exists() and fresh.exists()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 200 kB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(disk)], capture_output=True, check=False
    ).returncode:
        pytest.skip("a file system can be mounted by the superuser only")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_full_disk_is_said_and_leaves_nothing_half_written(
    lab: Path, small_disk: Path, labpipe: Command
) -> None:
    """At every amount of free space from none on, until the run has enough."""
    filler = small_disk / "filler"
    ended = None
    refused = 0
    for used in range(200, -1, -12):
        filler.write_bytes(b"")
        try:
            filler.write_bytes(bytes(used << 10))
        except OSError:
            filler.write_bytes(bytes(max(used - 12, 0) << 10))
        ended = labpipe(
            "run", lab / "pipeline.yaml", "-o", small_disk / "out", "--set", "report.formats=[md]"
        )
        if ended.code == 0:
            break
        refused += 1
        assert (
            ended.code == 2 and len(ended.err.splitlines()) == 1 and "no space left" in ended.err.lower()
        ), ended.err
        assert not [path for path in small_disk.rglob("*") if path.name.startswith(STAGING)]
    assert ended is not None and ended.code == 0 and refused >= 3
    assert labpipe("verify", small_disk / "out").code == 0


def test_an_input_that_changes_while_it_is_read_is_refused(
    lab: Path, labpipe: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The digest in the header would be of another content than the numbers."""
    from labpipe.project import ingest

    sample_rate = ingest.TimeAxisScreen.sample_rate

    def changed(self: ingest.TimeAxisScreen) -> float:
        (lab / "soft.csv").write_text(recording(19e3))
        os.utime(lab / "soft.csv", ns=(1, 1))
        return sample_rate(self)

    monkeypatch.setattr(ingest.TimeAxisScreen, "sample_rate", changed)
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out")
    assert ended.code == 2 and "soft.csv: changed while it was read" in ended.err
    assert not (lab / "out/identification.json").exists()


def test_a_deleted_input_is_named(lab: Path, labpipe: Command) -> None:
    done(lab / "pipeline.yaml", lab / "out")
    (lab / "soft.csv").unlink()
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out")
    assert ended.code == 2 and "soft.csv" in ended.err and len(ended.err.splitlines()) == 1


def test_a_clock_that_goes_back_changes_nothing(lab: Path, labpipe: Command) -> None:
    done(lab / "pipeline.yaml", lab / "out")
    before = contents(lab / "out")
    for path in lab.rglob("*"):
        os.utime(path, (time.time() + 1e6, time.time() + 1e6))
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out", "-q").code == 0
    assert contents(lab / "out") == before


def test_files_are_on_the_disk_before_their_names_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then a cut of power leaves no name without its content; the folder's names follow."""
    done_in_turn: list[str] = []
    sync, replace = writing.sync_to_disk, os.replace
    monkeypatch.setattr(
        writing, "sync_to_disk", lambda path: (done_in_turn.append(f"sync {path.name}"), sync(path))
    )
    monkeypatch.setattr(
        os,
        "replace",
        lambda source, goal: (done_in_turn.append(f"name {Path(goal).name}"), replace(source, goal)),
    )
    with output_folder(tmp_path / "out") as folder:
        folder.write_path("a").write_text("a")
        folder.write_path("sub/b").write_text("b")
    assert done_in_turn == ["sync a", "sync b", "name a", "name b", "sync out", "sync sub"]


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_disk_that_fails_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def failing(_: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", failing)
    with pytest.raises(OSError, match=os.strerror(number)), output_folder(tmp_path / "out") as folder:
        folder.write_path("a").write_text("a")
    assert not (tmp_path / "out/a").exists()


@pytest.mark.long
def test_two_runs_and_a_list_at_once_on_one_folder(lab: Path, labpipe: Command) -> None:
    done(lab / "pipeline.yaml", lab / "whole")
    command = [sys.executable, "-m", "labpipe"]
    run = [*command, "run", str(lab / "pipeline.yaml"), "-o", str(lab / "out"), "-q"]
    # Of the listing only that it ends without a traceback: it may come before the first result.
    processes = [
        subprocess.Popen(line, stderr=subprocess.PIPE) for line in (run, run, [*command, "list", str(lab)])
    ]
    said = [process.communicate()[1] for process in processes]
    assert [process.returncode for process in processes[:2]] == [0, 0] and b"Traceback" not in b"".join(said)
    assert contents(lab / "out") == contents(lab / "whole")


READ_ALL = """
import hashlib, os, sys, warnings
from pathlib import Path
from tests.hostile.seeds import READS

warnings.simplefilter("ignore")
folder = Path(sys.argv[1])
print("at once", len(os.read(os.open(folder / "a.recording.parquet", os.O_RDONLY), 1 << 20)))
for kind, read in READS.items():
    print(kind, hashlib.sha256(repr(read(folder / kind)).encode()).hexdigest())
"""


@pytest.mark.long
def test_reads_that_return_less_than_was_asked_for_change_nothing(tmp_path: Path) -> None:
    """As from a network folder: every reader, ours and those of libraries, under a C library that reads half
    of it.
    """
    library = tmp_path / "short_reads.so"
    command = [
        "cc",
        "-shared",
        "-fPIC",
        "-o",
        str(library),
        str(Path(__file__).with_name("short_reads.c")),
        "-ldl",
    ]
    if shutil.which("cc") is None or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("a C compiler is needed")
    write_seeds(tmp_path)
    (tmp_path / "identification.json").write_bytes(
        (tmp_path / "laboratory/out/identification.json").read_bytes()
    )
    said = [
        subprocess.run(
            [sys.executable, "-c", READ_ALL, str(tmp_path)],
            env=environment,
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        for environment in (dict(os.environ), {**os.environ, "LD_PRELOAD": str(library)})
    ]
    (at_once, *whole), (less_at_once, *short) = (process.stdout.splitlines() for process in said)
    assert (
        at_once == f"at once {(tmp_path / 'a.recording.parquet').stat().st_size}"
        and less_at_once == "at once 4099"
    )
    assert short == whole and len(whole) == len(READS)

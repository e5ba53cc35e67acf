"""A folder is watched: recordings are worked on when they are complete, each once, bad ones are put aside
with their reason.
"""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from labpipe.artefacts.dataset_file import parts, read_rows
from labpipe.artefacts.identification_file import read_identification
from labpipe.project import watch as watching
from labpipe.project.pipeline_file import load_for_files_to_come
from labpipe.project.watch import LOG, METRICS, Watch, WatchSettings
from tests.project.laboratory import PIPELINE, RIG, recording

EACH = """title: Bench 3
rig: rig.yaml
tests:
  - {each: "runs/*.csv", pattern: "{preload}-{serial}", conditions: {speed: 0 rpm}}
"""
BENCH = EACH + PIPELINE[PIPELINE.index("frf:") :]
COMMAND = (sys.executable, "-c", "from labpipe.cli.main import main; main()")
ONCE = ("--once", "--settle", "0 s", "-q")


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """A bench whose logger has written three recordings."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "bench.yaml").write_text(BENCH)
    for number in range(3):
        (tmp_path / f"runs/{100 * number}N-{number}.csv").write_text(
            recording(18e3 + 1e3 * number, seed=number)
        )
    return tmp_path


def arguments(bench: Path, *more: str) -> list[str]:
    return ["watch", str(bench / "runs"), "-c", str(bench / "bench.yaml"), "-o", str(bench / "out"), *more]


def done_in(bench: Path) -> list[str]:
    rows = read_rows(bench / "out").to_pylist()
    return sorted(
        row["test"] for row in rows if (row["parameter"] == "k" and row["fit"] == "direct") or row["failed"]
    )


def log_of(bench: Path) -> list[tuple[str, str]]:
    return [
        (line["event"], line["test"])
        for line in map(json.loads, (bench / "out" / LOG).read_text().splitlines())
    ]


def test_results_are_those_of_a_run(bench: Path, labpipe) -> None:
    """The same numbers by `labpipe run` over the same files, which knows nothing of watching."""
    assert labpipe(*arguments(bench, *ONCE)).code == 0
    assert (
        labpipe("run", bench / "bench.yaml", "-o", bench / "run", "--set", "results=dataset", "-q").code == 0
    )
    watched, ran = (read_rows(bench / name).to_pylist() for name in ("out", "run"))
    assert len(watched) == len(ran) > 0
    for mine, other in zip(watched, ran, strict=True):
        assert mine.pop("test") == other.pop("test") + ".csv"
        # The digest of the file of fits, which names its test.
        assert mine.pop("digest") != other.pop("digest")
        assert mine == other
    summed = read_identification(bench / "out/identification.json")
    assert summed.dataset is not None and summed.dataset.tests == 3 and summed.accepted


def test_each_recording_is_worked_on_once(bench: Path, labpipe) -> None:
    for _ in range(2):
        assert labpipe(*arguments(bench, *ONCE)).code == 0
    assert done_in(bench) == ["0N-0.csv", "100N-1.csv", "200N-2.csv"] and len(log_of(bench)) == 3
    (bench / "runs/later").mkdir()
    (bench / "runs/later/300N-3.csv").write_text(recording(21e3, seed=3))
    assert "4 tests in the dataset, 0 failed; 1 worked on now" in labpipe(*arguments(bench, *ONCE[:-1])).out
    assert done_in(bench)[-1] == "later/300N-3.csv" and len(parts(bench / "out")) == 2


def test_a_changed_sensor_is_logged_and_its_tests_are_found(bench: Path, labpipe) -> None:
    """Two sensors of .5 %, one after the other, by the source of their uncertainty."""
    for number in (1234, 5678):
        (bench / "rig.yaml").write_text(
            RIG.replace("unit: um,", f"unit: um, uncertainty: {{gain: 0.5 % (source=sensor {number})}},")
        )
        (bench / f"runs/{number}N-9.csv").write_text(recording(20e3, seed=number))
        assert labpipe(*arguments(bench, *ONCE)).code == 0
    (remark,) = (
        line["remark"]
        for line in map(json.loads, (bench / "out" / LOG).read_text().splitlines())
        if line["event"] == "changed"
    )
    assert remark == "the rig file is another than before: results that are there keep theirs"
    assert labpipe("report", bench / "out", "-o", bench / "r.md").code == 0
    page = (bench / "r.md").read_text("utf-8")
    assert "This is the rig of the last tests; earlier ones rest on 1 other rig file." in page
    assert "gain 0.5 % (sensor 5678)" in page and "*Results*" not in page
    for _ in range(2):
        assert labpipe(*arguments(bench, *ONCE)).code == 0
        assert read_identification(bench / "out/identification.json").rig["rigs_before"] == 1
    asked = ("list", bench / "out", "--fit", "direct", "-p", "k", "--source")
    ended = labpipe(*asked, "sensor 5678")
    assert "5678N-9.csv" in ended.out and "1234N-9.csv" not in ended.out and "100N-1.csv" not in ended.out
    assert len(labpipe(*asked, "sensor*").out.splitlines()) == 1 + 5
    assert labpipe("list", bench / "out", "--source", "sensor 5678").out.count("5678N-9.csv") > 1
    ended = labpipe(*asked, "sensor 1243")
    assert ended.code == 2
    assert "no result has the source 'sensor 1243'; did you mean 'sensor 1234'?" in ended.err


def test_bad_recordings_are_put_aside_with_their_reason(bench: Path, labpipe) -> None:
    (bench / "runs/400N-4.csv").write_text("t [s],force [N],y [um]\n0,1,x\n")
    (bench / "runs/test.csv").write_text(recording(18e3))
    assert labpipe(*arguments(bench, *ONCE)).code == 0
    aside = bench / "out/quarantine"
    assert sorted(path.name for path in aside.iterdir()) == [
        "400N-4.csv",
        "400N-4.csv.reason.txt",
        "test.csv",
        "test.csv.reason.txt",
    ]
    assert "400N-4.csv" in (aside / "400N-4.csv.reason.txt").read_text()
    reason = (aside / "test.csv.reason.txt").read_text()
    assert "pattern '{preload}-{serial}': does not match 'test'" in reason
    assert not list((bench / "runs").glob("t*")) and len(done_in(bench)) == 5
    assert ("quarantined", "test.csv") in log_of(bench)


def test_a_move_that_a_kill_cut_short_is_finished(
    bench: Path, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    (bench / "runs/test.csv").write_text(recording(18e3))
    with monkeypatch.context() as patch:
        patch.setattr(watching.shutil, "move", lambda *_: None)
        assert labpipe(*arguments(bench, *ONCE)).code == 0
    assert (bench / "runs/test.csv").exists()
    assert labpipe(*arguments(bench, *ONCE)).code == 0
    assert not (bench / "runs/test.csv").exists() and done_in(bench).count("test.csv") == 1


def test_names_that_would_share_their_files_are_refused(bench: Path, labpipe) -> None:
    (bench / "runs/later").mkdir()
    for name in ("later/300N-3.csv", "later-300N-3.csv"):
        (bench / "runs" / name).write_text(recording(21e3, seed=3))
    assert labpipe(*arguments(bench, "--names", "*300N-3.csv", *ONCE)).code == 0
    (reason,) = (bench / "out/quarantine").rglob("*.reason.txt")
    assert "would have the file name of those of" in reason.read_text() and len(done_in(bench)) == 2


def test_a_full_disk_is_no_fault_of_a_recording(
    bench: Path, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The watch ends with exit code 2 and moves nothing; the next one does all."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(bench / "out"))

    with monkeypatch.context() as patch:
        patch.setattr("labpipe.project.one_test.write_fits", full)
        ended = labpipe(*arguments(bench, *ONCE))
    assert ended.code == 2 and "no space left on device" in ended.err
    assert len(list((bench / "runs").iterdir())) == 3 and not parts(bench / "out")
    assert labpipe(*arguments(bench, *ONCE)).code == 0 and len(done_in(bench)) == 3


def test_what_has_no_fits_is_done_all_the_same(bench: Path, labpipe) -> None:
    (bench / "bench.yaml").write_text(re.sub(r"identify:.*?accept:.*?\n", "", BENCH, flags=re.DOTALL))
    for _ in range(2):
        assert labpipe(*arguments(bench, *ONCE)).code == 0
    assert len(log_of(bench)) == 3 and len(read_rows(bench / "out")) == 3


class Bench:
    """A watch by a clock that is moved by hand: what happens at each look, in turn."""

    def __init__(self, folder: Path, looks: list[Callable[[], object]], **settings: object) -> None:
        pipeline, each = load_for_files_to_come(folder / "bench.yaml")
        self.now, self.looks = time.time() + 60, looks
        self.watch = Watch(
            pipeline,
            each,
            folder / "runs",
            folder / "out",
            WatchSettings(**settings),  # type: ignore[arg-type]
            stopped=lambda: not self.looks,
            clock=lambda: self.now,
            sleep=self.wait,
        )

    def wait(self, _seconds: float) -> None:
        self.now += self.watch.settings.every
        if self.looks:
            self.looks.pop(0)()


def test_a_recording_that_grows_is_waited_for(bench: Path) -> None:
    path = bench / "runs/0N-0.csv"
    whole = path.read_text()
    path.write_text(whole[:2000])
    looks = [
        lambda: path.write_text(whole[:3000]),
        lambda: path.write_text(whole),
        lambda: None,
        lambda: None,
    ]
    Bench(bench, looks, settle=0.0001, every=10.0).watch.run()
    assert "0N-0.csv" in done_in(bench) and not read_rows(bench / "out")["failed"].drop_null().to_pylist()


def test_a_recording_that_grows_after_it_was_worked_on_is_said_once(bench: Path) -> None:
    """The logger paused for longer than --settle: the result is that of a part."""
    path = bench / "runs/0N-0.csv"
    whole = path.read_text()
    path.write_text(whole[: whole.rfind("\n", 0, 20 * len(whole) // 21) + 1])
    looks = [lambda: None, lambda: path.write_text(whole), lambda: None, lambda: None]
    Bench(bench, looks, settle=0.0001, every=10.0).watch.run()
    assert [event for event in log_of(bench) if event[0] == "changed"] == [("changed", "0N-0.csv")]


def test_a_marker_says_what_is_complete(bench: Path) -> None:
    looks = [lambda: None, (bench / "runs/100N-1.csv.done").touch, lambda: None, lambda: None]
    Bench(bench, looks, marker=".done", every=10.0).watch.run()
    assert done_in(bench) == ["100N-1.csv"]


def test_results_wait_until_there_is_a_part_of_them(bench: Path) -> None:
    """Three recordings one by one within the time of a part: one part."""
    texts = {path: path.read_text() for path in sorted((bench / "runs").glob("*.csv"))}
    for path in texts:
        path.unlink()
    looks: list[Callable[[], object]] = [
        lambda path=path, text=text: path.write_text(text) for path, text in texts.items()
    ]
    Bench(bench, [*looks, int, int, int], settle=0.0, every=10.0, append=300.0).watch.run()
    assert len(done_in(bench)) == 3 and len(parts(bench / "out")) == 1


def test_metrics_are_those_of_prometheus(bench: Path, labpipe) -> None:
    """The text format: # HELP, # TYPE, then name and number."""
    assert labpipe(*arguments(bench, *ONCE)).code == 0
    lines = (bench / "out" / METRICS).read_text().splitlines()
    assert all(
        re.fullmatch(r"# HELP \w+ .+|# TYPE \w+ (counter|gauge)|[a-z_]+ [0-9.e+]+", line) for line in lines
    )
    assert "labpipe_dataset_tests 3" in lines and "labpipe_watch_results_waiting 0" in lines


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (
            lambda bench: (bench / "bench.yaml").write_text(BENCH.replace("10-40 Hz", "12-40 Hz")),
            "holds results of other settings",
        ),
        (
            lambda bench: (bench / "bench.yaml").write_text(
                BENCH.replace("- {each: ", "- {name: a, recordings: ")
            ),
            "recordings to come",
        ),
        (
            lambda bench: (bench / "bench.yaml").write_text(
                BENCH + "compare: {a: {kind: repeat, fit: direct}}\n"
            ),
            "compare",
        ),
        (lambda bench: (bench / "runs").rename(bench / "gone"), "no such folder"),
    ],
)
def test_what_cannot_be_watched_is_said(
    bench: Path, labpipe, change: Callable[[Path], object], what: str
) -> None:
    assert labpipe(*arguments(bench, *ONCE)).code == 0
    change(bench)
    ended = labpipe(*arguments(bench, *ONCE))
    assert ended.code == 2 and what in ended.err


def test_it_stops_when_asked_and_only_one_watches(bench: Path, labpipe) -> None:
    """SIGTERM ends a watch with what it has done appended; meanwhile another one is refused."""
    process = subprocess.Popen(
        [*COMMAND, *arguments(bench, "--settle", "0 s", "--every", "1 s", "--append", "1 h")]
    )
    try:
        end = time.monotonic() + 60
        while not (bench / "out" / METRICS).exists() and time.monotonic() < end:
            time.sleep(0.1)
        assert not parts(bench / "out"), "results wait for an hour"
        refused = labpipe(*arguments(bench, *ONCE))
        assert refused.code == 2 and "another process works on this folder" in refused.err
        os.kill(process.pid, signal.SIGTERM)
        assert process.wait(60) == 0
    finally:
        process.kill()
    assert len(done_in(bench)) == 3 and len(parts(bench / "out")) == 1

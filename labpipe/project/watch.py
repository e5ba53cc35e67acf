"""Recordings worked on as they arrive: each exactly once, whatever ends the watch in between. The dataset is
the only ledger: what has no rows is done again after a kill, from the artefacts on disk, with the same rows;
a part of the dataset appears whole or not at all.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from labpipe.artefacts.dataset_file import parts, read_part, read_summary, write_parts
from labpipe.artefacts.identification_file import NAME, read_identification, write_identification
from labpipe.artefacts.places import list_below
from labpipe.artefacts.writing import is_remote, output_file, output_folder
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.project.executors import Execute, serially
from labpipe.project.identify import rig_entry
from labpipe.project.ingest import SourceFile
from labpipe.project.many_tests import outcome_of, settings_of_many, summarise_tests
from labpipe.project.measured import fits_file_name
from labpipe.project.one_test import Done, Job, work
from labpipe.project.pipeline_file import Pipeline
from labpipe.project.tests import EachFile, Test
from labpipe.raw_files.table import READERS
from labpipe.raw_files.text_table import plain_suffix
from labpipe.records.dataset import DatasetSummary, TestResult, sum_summaries, summary_of
from labpipe.records.identification import RIGS_BEFORE, Failed


@dataclass(frozen=True)
class Arrived:
    """A recording that may still change; *marked*: a file beside it says that it is complete."""

    path: Path
    size: int
    changed: float
    marked: bool = False


def arrivals(folder: Path, names: str, marker: str) -> Iterator[Arrived]:
    """Readable files that fit the glob *names*, none hidden; *marker*: ending of files that mark others."""
    for arrival in _objects(folder, names, marker) if is_remote(folder) else _files(folder, names, marker):
        if plain_suffix(arrival.path) in READERS and not any(
            part.startswith(".") for part in arrival.path.relative_to(folder).parts
        ):
            yield arrival


def _files(folder: Path, names: str, marker: str) -> Iterator[Arrived]:
    for path in folder.rglob(names):
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        if path.is_file():
            marked = bool(marker) and path.with_name(path.name + marker).exists()
            yield Arrived(path, status.st_size, status.st_mtime, marked)


def _objects(folder: Path, names: str, marker: str) -> Iterator[Arrived]:
    objects = {status.path: status for status in list_below(folder)}
    for path, status in objects.items():
        if path.match(names):
            marked = bool(marker) and path.with_name(path.name + marker) in objects
            yield Arrived(path, status.size, status.changed, marked)


LOG, METRICS, QUARANTINE, REASON = "watch.log.jsonl", "watch.prom", "quarantine", ".reason.txt"
# A part of the dataset is written at so many tests, or at this age of the oldest one.
PART_TESTS = 500


@dataclass(frozen=True, kw_only=True)
class WatchSettings:
    """How a folder is watched. settle, every, append: seconds that a file must not have changed, between two
    looks, until results that wait are appended to the dataset. marker: ending of a file beside a recording
    that says it is complete, '' for none. names: glob of recordings.
    """

    settle: float = 5.0
    every: float = 10.0
    append: float = 300.0
    marker: str = ""
    names: str = "*"
    once: bool = False


@dataclass
class Counts:
    """Recordings since the watch began: worked on, failed, waiting to be appended, not yet complete."""

    evaluated: int = 0
    failed: int = 0
    waiting: int = 0
    arriving: int = 0


@dataclass
class Watch:
    """One watched folder, perhaps of an object storage, and its results. *stopped* is asked between
    recordings; *clock*: seconds since 1970. home: where results are kept, by default *results*; another place
    gets them by *publish*, then *forget* frees the disk. logs: by default *results*.
    """

    pipeline: Pipeline
    each: EachFile
    folder: Path
    results: Path
    settings: WatchSettings
    execute: Execute = serially
    stopped: Callable[[], bool] = lambda: False
    tell: Callable[[str], None] = lambda _: None
    clock: Callable[[], float] = time.time
    sleep: Callable[[float], None] = time.sleep
    counts: Counts = field(default_factory=Counts)
    home: Path | None = None
    publish: Callable[[], None] = lambda: None
    forget: Callable[[], None] = lambda: None
    logs: Path | None = None

    def __post_init__(self) -> None:
        self._done: set[str] = set()
        self._seen: dict[Path, Arrived] = {}
        self._worked: dict[Path, Arrived] = {}
        self._paths: dict[str, Path] = {}
        # Tests by the file name of their results.
        self._files: dict[str, str] = {}
        self._waiting: list[TestResult] = []
        self._since = self.clock()
        self._summary = DatasetSummary()
        self._rigs_before = 0

    def run(self) -> DatasetSummary:
        """Watch until stopped. ConfigError for other settings' results, DataError for damaged ones."""
        self._resume()
        while True:
            complete = list(self._complete())
            for done, job in self._work(complete):
                self._take(done, job)
            stopped = self.stopped()
            self._append(whole=self.settings.once or stopped)
            self.forget()
            self._write_metrics()
            if stopped or (self.settings.once and not complete):
                return self._summary
            if not complete:
                self._rest()

    def _rest(self) -> None:
        end = self.clock() + self.settings.every
        while self.clock() < end and not self.stopped():
            self.sleep(min(0.2, self.settings.every))

    def _resume(self) -> None:
        """What earlier watches did; the move of a bad recording that a kill cut short is finished."""
        before = self.results / NAME
        earlier = read_identification(before) if before.exists() else None
        if earlier is not None and earlier.settings != settings_of_many(self.pipeline):
            hint = "name another folder, or run the whole archive with `labpipe run`"
            raise ConfigError("holds results of other settings", self.results, hint)
        rig = {} if earlier is None else {**earlier.rig}
        self._rigs_before = rig.pop(RIGS_BEFORE, 0)
        if earlier is not None and rig != rig_entry(self.pipeline):
            self._rigs_before += 1
            remark = "the rig file is another than before: results that are there keep theirs"
            self._log("changed", "", remark=remark)
            self.tell(remark)
        written = parts(self.results)
        self._summary = sum_summaries(read_summary(part) for part in written)
        rows = [row for part in written for row in read_part(part, ("test", "failed")).to_pylist()]
        for arrived in self._iterate_arrivals():
            self._paths[self.name_of(arrived.path)] = arrived.path
        self._done.update(row["test"] for row in rows)
        for row in rows:
            self._files.setdefault(Path(fits_file_name(row["test"])).stem, row["test"])
            if row["failed"] is not None and not self._stays:
                self._quarantine(row["test"], row["failed"])
        if written:
            self._write_index()

    def _complete(self) -> Iterator[Arrived]:
        """New recordings that are marked complete, or old enough and the same as at the last look."""
        seen: dict[Path, Arrived] = {}
        self.counts.arriving = 0
        for arrived in self._iterate_arrivals():
            seen[arrived.path] = arrived
            still = not self.settings.marker and self.clock() - arrived.changed >= self.settings.settle
            at_once = self.settings.settle == 0 or self.settings.once
            if arrived.marked or (still and (at_once or self._seen.get(arrived.path) == arrived)):
                yield arrived
            else:
                self.counts.arriving += 1
        self._seen = seen

    def _iterate_arrivals(self) -> Iterator[Arrived]:
        home = self.home or self.results
        new = []
        for arrival in arrivals(self.folder, self.settings.names, self.settings.marker):
            if home not in arrival.path.parents:
                if self.name_of(arrival.path) in self._done:
                    self._tell_changed(arrival)
                else:
                    new.append(arrival)
        return iter(sorted(new, key=lambda arrived: (arrived.changed, arrived.path)))

    def _tell_changed(self, arrival: Arrived) -> None:
        """Say once of a recording that it was not complete when it was worked on."""
        before = self._worked.get(arrival.path, arrival)
        if (before.size, before.changed) != (arrival.size, arrival.changed):
            self._worked[arrival.path] = arrival
            remark = f"changed after it was worked on, {before.size} to {arrival.size} bytes: its result is "
            remark += "not that of the whole recording; a longer --settle, or --marker"
            self._log("changed", self.name_of(arrival.path), remark=remark)
            self.tell(f"{self.name_of(arrival.path)}: {remark}")

    def name_of(self, path: Path) -> str:
        """The name of the test of a recording: its path below the folder."""
        return path.relative_to(self.folder).as_posix()

    def _work(self, complete: Sequence[Arrived]) -> Iterator[tuple[Done, Job]]:
        """Outcomes as they come; what is not finished at a stop is left for the next watch."""
        if not complete:
            return
        with output_folder(self.results) as folder:
            jobs: dict[str, Job] = {}
            for arrived in complete:
                self._worked[arrived.path] = arrived
                try:
                    job = self._job(arrived.path, folder.staging)
                except LabpipeError as error:
                    self._refuse(arrived.path, str(error))
                    continue
                self._paths[job.test.name] = arrived.path
                jobs[job.test.name] = job
            for done in self.execute(work, list(jobs.values())):
                yield done, jobs[done.test]
                if self.stopped():
                    return

    def _job(self, path: Path, scratch: Path) -> Job:
        """The work on a recording. LabpipeError for no test, or results in place of another one's."""
        assert self.pipeline.rig is not None
        test = self.each.test(SourceFile(path, self.pipeline.rig), self.name_of(path))
        name = Path(fits_file_name(test.name)).stem
        other = self._files.setdefault(name, test.name)
        if other != test.name:
            what = f"its results would have the file name of those of '{other}'"
            raise DataError(what, test.name, "rename the recording")
        return Job(
            test,
            (name,),
            frf=test.frf or self.pipeline.frf,
            fits=self.pipeline.fits,
            rules=self.pipeline.rules,
            pipeline_path=self.pipeline.path,
            target=self.results,
            scratch=scratch,
        )

    def _refuse(self, path: Path, message: str) -> None:
        """A recording that is not a test, such as one of another name than the pattern's."""
        assert self.pipeline.rig is not None
        test = Test(self.name_of(path), (SourceFile(path, self.pipeline.rig),))
        self._paths[test.name] = path
        self._keep(outcome_of(Done(test.name, failed=Failed(test.name, message)), test))

    def _take(self, done: Done, job: Job) -> None:
        if done.halts and done.failed is not None:
            hint = "what was worked on is kept; start the watch again"
            raise DataError(done.failed.message, self.results, hint)
        self._keep(outcome_of(done, job.test))
        for remark in done.remarks:
            self._log("damaged", done.test, remark=remark)

    def _keep(self, result: TestResult) -> None:
        """Hold a result until it is appended; a part is written as soon as there is enough for one."""
        row = result.rows[0]
        if not self._waiting:
            self._since = self.clock()
        self._waiting.append(result)
        self._done.add(row.test)
        self.counts.waiting = len(self._waiting)
        self.counts.evaluated += 1
        self.counts.failed += row.failed is not None
        self.tell(f"{row.test}: {row.failed or row.warnings or 'done'}")
        said = {"failed": row.failed, "accepted": row.accepted, "warnings": row.warnings}
        self._log("failed" if row.failed else "evaluated", row.test, **said)
        if len(self._waiting) >= PART_TESTS:
            self._append(whole=True)

    def _append(self, whole: bool) -> None:
        """Append the waiting results as parts where it is time; then bad recordings go to the quarantine."""
        if not self._waiting or not (whole or self.clock() - self._since >= self.settings.append):
            return
        with output_folder(self.results) as folder:
            write_parts(self._waiting, folder)
        for result in self._waiting:
            self._summary = self._summary.with_more(summary_of(result))
            row = result.rows[0]
            if row.failed is not None:
                self._quarantine(row.test, row.failed)
        self._waiting.clear()
        self.counts.waiting = 0
        self._write_index()

    def _write_index(self) -> None:
        with output_folder(self.results) as folder:
            result = summarise_tests(self.pipeline, self._summary)
            if self._rigs_before:
                result = replace(result, rig={**result.rig, RIGS_BEFORE: self._rigs_before})
            write_identification(folder.write_path(NAME), result)
        self.publish()

    def _quarantine(self, test: str, reason: str) -> None:
        """Move a bad recording aside, its reason first; nothing where it has gone already. An object of a
        storage cannot be moved in one step and stays; by its rows it is not looked at again.
        """
        path = self._paths.get(test)
        if path is None or (not self._stays and not path.exists()):
            return
        aside = self.results / QUARANTINE / path.relative_to(self.folder)
        with output_file(aside.with_name(aside.name + REASON)) as file:
            file.write_text(reason + "\n")
        if not self._stays:
            shutil.move(path, aside)
        self._log("quarantined", test)

    @property
    def _stays(self) -> bool:
        return is_remote(self.folder) or self.home not in (None, self.results)

    def _log(self, event: str, test: str, **entries: object) -> None:
        now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self.clock()))
        line = {"time": now, "event": event, "test": test, **entries}
        line = {name: entry for name, entry in line.items() if entry not in (None, "")}
        logs = self.logs or self.results
        logs.mkdir(parents=True, exist_ok=True)
        with (logs / LOG).open("a") as log:
            log.write(json.dumps(line) + "\n")

    def _write_metrics(self) -> None:
        """Counters for Prometheus, as a text file of the node exporter's collector."""
        index, counts = self._summary.index, self.counts
        values = {
            "watch_recordings_evaluated_total": (counts.evaluated, "Recordings worked on since the start"),
            "watch_recordings_failed_total": (counts.failed, "Recordings not evaluated since the start"),
            "watch_results_waiting": (counts.waiting, "Results not yet appended to the dataset"),
            "watch_recordings_arriving": (counts.arriving, "Recordings that are not complete yet"),
            "dataset_tests": (index.tests, "Tests with a result in the dataset"),
            "dataset_tests_failed": (index.failed, "Tests without a result in the dataset"),
            "dataset_tests_not_accepted": (index.not_accepted, "Tests whose rules do not all hold"),
            "watch_cpu_seconds_total": (sum(os.times()[:4]), "Processor time of the watch"),
            "watch_last_look_seconds": (self.clock(), "Time of the last look, seconds since 1970"),
        }
        lines = []
        for name, (value, text) in values.items():
            # Totals are counters by the convention of Prometheus.
            kind = "counter" if name.endswith("_total") else "gauge"
            lines += [
                f"# HELP labpipe_{name} {text}",
                f"# TYPE labpipe_{name} {kind}",
                f"labpipe_{name} {value}",
            ]
        with output_file((self.logs or self.results) / METRICS) as file:
            file.write_text("\n".join([*lines, ""]))

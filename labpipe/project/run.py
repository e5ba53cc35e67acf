"""A whole pipeline: the stages in their order, what is fresh left as it is. A test is all or nothing; of
several tests one that fails is named and the others are finished.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from labpipe.artefacts.header import source_ref
from labpipe.artefacts.writing import OutputFolder, existing_home, staging_folder
from labpipe.errors import ConfigError, DataError
from labpipe.project import one_test
from labpipe.project.executors import Execute, serially
from labpipe.project.identify import MeasuredTests, identify_stage
from labpipe.project.ingest import unique_names
from labpipe.project.many_tests import Gathered, advice, identify, keeps_dataset
from labpipe.project.measured import file_stems
from labpipe.project.pipeline_file import Pipeline
from labpipe.project.rules import Rule
from labpipe.project.work import check_tested
from labpipe.records.identification import Identification
from labpipe.registry import nearest

AGAIN = "the same command goes on from there"
# Tests from which each has its own file of fits.
MANY = 2

# Called when a test is done: tests done, tests in all, name of the test.
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Manner:
    """How a run is done, which does not change its results. *execute* does the jobs of several tests;
    *processes*: for a study, 0 for one per processor; *measured_before*: the responses of `labpipe frf` are
    taken.
    """

    tell: one_test.Tell = one_test.silent
    progress: Progress = lambda _done, _total, _name: None
    execute: Execute = serially
    processes: int = 0
    measured_before: bool = False


def run(pipeline: Pipeline, output: OutputFolder, manner: Manner) -> Identification:
    """All stages up to the identification. DataError where responses that were *measured_before* are not
    there, or were made from other settings, rigs or recordings.
    """
    independent = independent_fits(pipeline)
    if keeps_dataset(pipeline, independent):
        with staging_folder(existing_home(output.target)) as scratch:
            jobs = _jobs(pipeline, output.target, scratch, independent, manner, pipeline.rules)
            gathered = Gathered(jobs, output)
            for outcome in _outcomes(jobs, manner):
                gathered.add(outcome)
        manner.tell(f"identify  {pipeline.title}")
        return identify(pipeline, gathered, output)
    output.remarks.extend(filter(None, [advice(pipeline, independent)]))
    measured = measure_tests(pipeline, output, manner, independent)
    manner.tell(f"identify  {pipeline.title}")
    return identify_stage(pipeline, measured, output, manner.tell, manner.processes)


def run_only(pipeline: Pipeline, target: Path, test: str, manner: Manner) -> one_test.Done:
    """One test of several up to its fits, into the folder that a run of all of them goes on from; several may
    be worked on at once, as schedulers of jobs do. ConfigError for a test that there is not.
    """
    names = [declared.name for declared in pipeline.tests]
    if test not in names or len(names) < MANY:
        raise ConfigError(f"no test '{test}' among several", pipeline.path, nearest(test, names))
    with staging_folder(existing_home(target)) as scratch:
        job = _jobs(pipeline, target, scratch, independent_fits(pipeline), manner)[names.index(test)]
        (done,) = _outcomes([job], manner)
    return done


def measure_tests(
    pipeline: Pipeline, output: OutputFolder, manner: Manner, fits: Sequence[str] = ()
) -> MeasuredTests:
    """ingest and frf of every test, ready responses as they are; of several tests also the named *fits*."""
    with staging_folder(existing_home(output.target)) as scratch:
        of_tests = fits if len(pipeline.tests) >= MANY else ()
        jobs = _jobs(pipeline, output.target, scratch, of_tests, manner)
        if len(jobs) > 1:
            done = {outcome.test: outcome for outcome in _outcomes(jobs, manner)}
        else:
            done = {}
            for job in jobs:
                # The only test of a pipeline, measured here.
                with one_test.fetch_recordings(job) as near:
                    done[job.test.name] = one_test.Done(
                        job.test.name, one_test.measure(near, output, manner.tell)
                    )
    output.remarks.extend(remark for outcome in done.values() for remark in outcome.remarks)
    finished = [job for job in jobs if done[job.test.name].failed is None]
    failed = tuple(failure for job in jobs if (failure := done[job.test.name].failed) is not None)
    if failed and not finished:
        raise DataError(f"{failed[0].message} (none of {len(failed)} tests could be evaluated)")
    sources = [source for job in finished for source in done[job.test.name].sources]
    sources.extend(source_ref(path, pipeline.folder) for path in pipeline.side_files)
    tests = [part for job in finished for part in one_test.load_measured_tests(job, output)]
    inputs = tuple(reference for job in finished for reference in one_test.measured_refs(job, output))
    digests = {test: frozenset(source.sha256 for source in outcome.sources) for test, outcome in done.items()}
    fits_before = one_test.finished_fits(finished, output)
    return MeasuredTests(tuple(tests), tuple(sources), digests, fits_before, failed, inputs)


def independent_fits(pipeline: Pipeline) -> list[str]:
    """Fits of a single test: all except those that start from another fit's result."""
    return [settings.name for settings in pipeline.fits if not settings.kind.earlier(settings)]


def _jobs(
    pipeline: Pipeline,
    target: Path,
    scratch: Path,
    fits: Sequence[str],
    manner: Manner,
    rules: tuple[Rule, ...] | None = None,
) -> list[one_test.Job]:
    file_stems([test.name for test in pipeline.tests], "tests", pipeline.path)
    test_names = [
        name
        for test in pipeline.tests
        for name in ([test.name] if test.recordings else [test.name or ready.name for ready in test.frfs])
    ]
    for settings in pipeline.fits:
        check_tested(settings, test_names)
    names = iter(unique_names([source.path for test in pipeline.tests for source in test.recordings]))
    return [
        one_test.Job(
            test,
            tuple(next(names) for _ in test.recordings),
            frf=test.frf or pipeline.frf,
            fits=tuple(
                settings
                for settings in pipeline.fits
                if settings.name in fits and (not settings.test or test.name in settings.test)
            ),
            pipeline_path=pipeline.path,
            target=target,
            scratch=scratch,
            rules=rules,
            measured_before=manner.measured_before,
        )
        for test in pipeline.tests
    ]


def _outcomes(jobs: Sequence[one_test.Job], manner: Manner) -> Iterator[one_test.Done]:
    count = 0
    try:
        for outcome in manner.execute(one_test.work, jobs):
            count += 1
            manner.progress(count, len(jobs), outcome.test)
            if outcome.halts and outcome.failed is not None:
                hint = f"{count - 1} of {len(jobs)} tests are finished and kept; {AGAIN}"
                raise DataError(outcome.failed.message, hint=hint)
            yield outcome
    except KeyboardInterrupt:
        remark = f"{count} of {len(jobs)} tests are finished and kept"
        raise DataError(f"interrupted; {remark}", hint=AGAIN) from None

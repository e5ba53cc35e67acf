"""labpipe run, check, tests, watch: whole pipelines."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import click

from labpipe.artefacts.identification_file import NAME
from labpipe.artefacts.mirrored import keep_results, make_results
from labpipe.artefacts.writing import hold_lock, is_remote, show
from labpipe.cli import options
from labpipe.cli.many import check_shared, executor, manner
from labpipe.cli.output import echo
from labpipe.cli.terminal import echo_failed, echo_result
from labpipe.errors import ConfigError, DataError
from labpipe.processes import pool_of, use_processes
from labpipe.project.many_tests import hindrance
from labpipe.project.measured import files_of_test
from labpipe.project.pipeline_file import load_for_files_to_come, load_pipeline
from labpipe.project.report import outdate_reports, write_reports
from labpipe.project.run import Manner, independent_fits, run as run_pipeline, run_only
from labpipe.project.run_record import record_run
from labpipe.project.watch import Watch, WatchSettings
from labpipe.quantities import UnitError, parse_value
from labpipe.records.identification import RuleOutcome


@click.command()
@click.argument("pipeline_path", metavar="PIPELINE", type=options.PATH)
@options.out_place
@options.jobs
@options.cluster
@click.option(
    "--only",
    default="",
    metavar="TEST",
    help="Work on this test alone, up to its fits; a run without --only then finishes.",
)
@options.usual
def run(
    pipeline_path: Path,
    output: Path,
    jobs: int,
    cluster: str | None,
    only: str,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> int:
    """Run all stages of PIPELINE: recordings -> FRFs -> identification.json -> report.

    identification.json is written before the report is drawn. Results and reports that are up to date are not
    made again. When a test fails, the others are finished and the failed one is named at the end (exit code
    2); an interrupted run continues where it stopped. Exit code 1 when an accept: or expect: rule fails.
    """
    how = manner(quiet, verbose, jobs, cluster)
    check_shared(output, cluster)
    if only:
        pipeline = load_pipeline(pipeline_path, overrides)
        with make_results(output, lambda name: name in files_of_test(only)) as here:
            done = run_only(pipeline, here, only, how)
        echo_failed([done.failed] if done.failed else [])
        return 2 if done.failed else 0
    with record_run(output, pipeline_path) as made:
        pipeline = load_pipeline(pipeline_path, overrides)
        with make_results(output) as here:
            with options.results_folder(here) as folder:
                identification = run_pipeline(pipeline, folder, how)
                outdate_reports(folder, pipeline.report.formats)
            with use_processes(jobs):
                write_reports(identification, here, pipeline.report.formats, how.tell)
        made.append(identification)
    reports = [f"report.{name}" for name in pipeline.report.formats]
    return echo_result(identification, quiet, show(output), NAME, *reports)


@click.command()
@click.argument("pipelines", nargs=-1, required=True, metavar="PIPELINE...", type=options.PATH)
@click.option(
    "-j", "--jobs", type=options.COUNT, default=1, help="Pipelines at the same time; 0: one per processor."
)
@options.path(
    "-o",
    "--output",
    metavar="DIR",
    help="Keep the results, those of each pipeline in DIR/NAME of its file; what is up to date there is not "
    "made again.",
)
@options.usual
def check(
    pipelines: tuple[Path, ...],
    jobs: int,
    output: Path | None,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> int:
    """Run each PIPELINE from scratch and test its expect: and accept: rules; exit code 1 when one fails."""
    alike = next((path for path in pipelines if [p.stem for p in pipelines].count(path.stem) > 1), None)
    if output and alike:
        raise ConfigError(f"{alike}: two pipelines of this name would share a folder of results")
    work = partial(outcomes_of, output=output, overrides=overrides, quiet=quiet, verbose=verbose)
    failed = 0
    for path, outcomes in _check(pipelines, overrides, jobs, work):
        wrong = [outcome for outcome in outcomes if not outcome.passed]
        failed += len(wrong)
        if not quiet:
            hold = f"{len(outcomes) - len(wrong)} of {len(outcomes)} rules hold"
            echo(f"{path}: {hold if outcomes else 'no rules under expect: or accept:, nothing was judged'}")
        for outcome in wrong:
            echo(f"{path}: {outcome.section}: {outcome.rule} fails, found {outcome.found}")
    return 1 if failed else 0


def _check(
    pipelines: Sequence[Path],
    overrides: tuple[str, ...],
    jobs: int,
    work: Callable[[Path], tuple[RuleOutcome, ...]],
) -> Iterator[tuple[Path, tuple[RuleOutcome, ...]]]:
    """The outcomes of each pipeline.

    In parallel, pipelines with a study run last, since a study uses all processors.
    """
    with pool_of(min(jobs or os.cpu_count() or 1, len(pipelines))) as pool:
        if pool is None:
            yield from zip(pipelines, map(work, pipelines), strict=True)
            return
        studies = [path for path in pipelines if "study" in load_pipeline(path, overrides).sections]
        others = [path for path in pipelines if path not in studies]
        yield from zip(others, pool.map(work, others), strict=True)
    yield from zip(studies, map(work, studies), strict=True)


def outcomes_of(
    path: Path, output: Path | None, overrides: tuple[str, ...], quiet: bool, verbose: bool
) -> tuple[RuleOutcome, ...]:
    """The outcomes of a pipeline's rules, its results kept in *output*; DataError when a test fails."""
    pipeline = load_pipeline(path, overrides)
    how = Manner(options.teller(quiet, verbose))
    with tempfile.TemporaryDirectory() as scratch:
        place = output / path.stem if output else Path(scratch) / "out"
        with make_results(place) as here, options.results_folder(here) as folder:
            identification = run_pipeline(pipeline, folder, how)
    for failure in identification.failed:
        raise DataError(failure.message)
    return identification.outcomes


@click.command()
@click.argument("pipeline_path", metavar="PIPELINE", type=options.PATH)
@options.overrides
def tests(pipeline_path: Path, overrides: tuple[str, ...]) -> None:
    """Print the names of the tests of PIPELINE, one in each line, for schedulers that run them one by one
    with `labpipe run --only`.
    """
    for test in load_pipeline(pipeline_path, overrides).tests:
        echo(test.name)


LOCK = ".labpipe-watch.lock"


def _seconds(text: str) -> float:
    try:
        seconds = parse_value(text, "s")
    except UnitError as error:
        raise click.BadParameter(f"{error.what}; write it as 10 s or 5 min") from None
    if not 0 <= seconds < float("inf"):
        raise click.BadParameter("a time of 0 s or more is needed")
    return seconds


_time = partial(click.option, type=_seconds, metavar="TIME", show_default=True)


@click.command()
@click.argument("folder", type=options.PLACE)
@options.pipeline_file
@options.out_place
@_time("--every", default="10 s", help="Time between two looks.")
@_time("--settle", default="5 s", help="A recording is complete when it has not changed for this long.")
@click.option(
    "--marker",
    default="",
    metavar="SUFFIX",
    help="A recording is complete when a file of its name and this suffix is there.",
)
@_time("--append", default="5 min", help="Results wait at most this long before they are appended.")
@click.option(
    "--names", default="*", show_default=True, metavar="GLOB", help="Only recordings of such names."
)
@options.path(
    "--log", "logs", metavar="DIR", help="Folder of watch.prom and watch.log.jsonl; default: RESULTS."
)
@click.option("--once", is_flag=True, help="Work on what is complete now, then end.")
@options.jobs
@options.cluster
@options.usual
def watch(
    folder: Path,
    pipeline_path: Path,
    output: Path,
    every: float,
    settle: float,
    marker: str,
    append: float,
    names: str,
    logs: Path | None,
    once: bool,
    jobs: int,
    cluster: str | None,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> int:
    """Watch FOLDER and work on every new recording once it is complete, each exactly once.

    The only entry of `tests:` in PIPELINE, one with `each:`, says what a recording becomes; which files are
    looked at, FOLDER and --names say. Results are appended to the dataset in RESULTS; a recording that cannot
    be evaluated is moved to RESULTS/quarantine with its reason. Beside them stand watch.prom (metrics) and
    watch.log.jsonl. FOLDER and RESULTS may be of an object storage, s3://bucket/prefix; bad recordings then
    stay where they are, and only the reason goes to RESULTS/quarantine.

    SIGTERM or Ctrl-C end the watch after the recording in work.
    """
    if not is_remote(folder) and not folder.is_dir():
        raise DataError("no such folder", folder, "name the folder that recordings arrive in")
    pipeline, per_file = load_for_files_to_come(pipeline_path, overrides)
    if what := hindrance(pipeline, independent_fits(pipeline)):
        what = f"{what}, which needs all tests at once"
        raise ConfigError(what, pipeline_path, "watch with a pipeline of fits alone")
    settings = WatchSettings(settle=settle, every=every, append=append, marker=marker, names=names, once=once)
    check_shared(output, cluster)
    log_folder = logs or output
    if is_remote(log_folder):
        what = "--log: is needed where the results are elsewhere"
        raise ConfigError(what, show(output), "name a folder of this machine")
    log_folder.mkdir(parents=True, exist_ok=True)
    with hold_lock(log_folder / LOCK), options.hold_signals() as asked, keep_results(output) as mirror:
        watched = Watch(
            pipeline,
            per_file,
            folder if is_remote(folder) else folder.resolve(),
            mirror.folder.resolve(),
            settings,
            executor(jobs, cluster),
            stopped=lambda: bool(asked),
            tell=options.teller(quiet, verbose),
            home=output if is_remote(output) else None,
            publish=mirror.publish,
            forget=mirror.forget,
            logs=log_folder.resolve(),
        )
        index = watched.run().index
    if not quiet:
        now = f"{watched.counts.evaluated} worked on now"
        echo(f"{index.tests} tests in the dataset, {index.failed} failed; {now}")
    return 0

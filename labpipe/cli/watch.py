"""labpipe watch FOLDER -c PIPELINE -o RESULTS"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from labpipe.artefacts.mirrored import results_kept
from labpipe.artefacts.writing import only_one
from labpipe.cli import options
from labpipe.cli.many import check_shared, executor
from labpipe.cli.output import echo
from labpipe.config.pipeline import load_for_files_to_come
from labpipe.errors import ConfigError, DataError
from labpipe.pipeline.many_tests import hindrance
from labpipe.pipeline.run import independent_fits
from labpipe.pipeline.watch import Watch, WatchSettings
from labpipe.places.address import is_remote, shown
from labpipe.quantities import UnitError, parse_value

LOCK = ".labpipe-watch.lock"


class _Seconds(click.ParamType[float]):
    """A time such as 5 s or 10 min, in seconds."""

    name = "time"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, float):
            return value
        try:
            seconds = parse_value(str(value), "s")
        except UnitError as error:
            self.fail(f"{error.what}; write it as 10 s or 5 min", param, ctx)
        if not 0 <= seconds < float("inf"):
            self.fail("a time from 0 s on is needed", param, ctx)
        return seconds


@contextmanager
def _asked_to_stop() -> Iterator[list[int]]:
    """The signals that asked the watch to end, instead of ending it at once."""
    asked: list[int] = []
    before = {number: signal.signal(number, lambda received, _frame: asked.append(received)) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@click.command()
@click.argument("folder", type=options.PLACE)
@options.pipeline_file
@options.out_place
@click.option("--every", type=_Seconds(), default="10 s", show_default=True, help="Time between two looks.")
@click.option(
    "--settle", type=_Seconds(), default="5 s", show_default=True, help="A recording is complete when it did not change for so long."
)
@click.option("--marker", default="", metavar="SUFFIX", help="A recording is complete when a file of its name and this suffix is there.")
@click.option("--append", type=_Seconds(), default="5 min", show_default=True, help="Results wait so long at most until they are appended.")
@click.option("--names", default="*", show_default=True, metavar="GLOB", help="Only recordings of such names.")
@click.option("--log", "logs", type=options.PATH, metavar="DIR", help="Folder of watch.prom and watch.log.jsonl; default: RESULTS.")
@click.option("--once", is_flag=True, help="Work on what is complete now, then end.")
@options.jobs
@options.cluster
@options.overrides
@options.quiet
@options.verbose
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

    The only entry of `tests:` in PIPELINE, one with `each:`, says what a recording becomes; which files are looked at, FOLDER and --names
    say. Results are appended to the dataset in RESULTS; a recording that cannot be evaluated is moved to RESULTS/quarantine with its
    reason. Beside them stand watch.prom (metrics) and watch.log.jsonl. FOLDER and RESULTS may be of an object storage, s3://bucket/prefix;
    bad recordings then stay where they are, and only the reason goes to RESULTS/quarantine.

    SIGTERM or Ctrl-C end the watch after the recording in work.
    """
    if not is_remote(folder) and not folder.is_dir():
        raise DataError("no such folder", where=str(folder), hint="name the folder that recordings arrive in")
    pipeline, per_file = load_for_files_to_come(pipeline_path, overrides)
    if what := hindrance(pipeline, independent_fits(pipeline)):
        raise ConfigError(f"{what}, which needs all tests at once", where=str(pipeline_path), hint="watch with a pipeline of fits alone")
    settings = WatchSettings(settle=settle, every=every, append=append, marker=marker, names=names, once=once)
    check_shared(output, cluster)
    log_folder = logs or output
    if is_remote(log_folder):
        raise ConfigError("--log: is needed where the results are elsewhere", where=shown(output), hint="name a folder of this machine")
    log_folder.mkdir(parents=True, exist_ok=True)
    with only_one(log_folder / LOCK), _asked_to_stop() as asked, results_kept(output) as mirror:
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
        echo(f"{index.tests} tests in the dataset, {index.failed} failed; {watched.counts.evaluated} worked on now")
    return 0

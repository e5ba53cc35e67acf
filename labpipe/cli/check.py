"""labpipe check PIPELINE..."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import click

from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.config.pipeline import load_pipeline
from labpipe.errors import DataError
from labpipe.pipeline.run import Manner, run
from labpipe.processes import end_with_parent
from labpipe.records.identification import RuleOutcome


@click.command()
@click.argument("pipelines", nargs=-1, required=True, metavar="PIPELINE...", type=options.PATH)
@click.option("-j", "--jobs", type=click.IntRange(min=0), default=1, help="Pipelines at the same time; 0: one per processor.")
@options.overrides
@options.quiet
@options.verbose
def check(pipelines: tuple[Path, ...], jobs: int, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> int:
    """Run each PIPELINE from scratch and test its expect: and accept: rules; exit code 1 when one fails."""
    failed = 0
    for path, outcomes in _checked(pipelines, overrides, jobs, quiet, verbose):
        wrong = [outcome for outcome in outcomes if not outcome.passed]
        failed += len(wrong)
        if not quiet:
            echo(f"{path}: {len(outcomes) - len(wrong)} of {len(outcomes)} rules hold")
        for outcome in wrong:
            echo(_failure(path, outcome))
    return 1 if failed else 0


def _checked(
    pipelines: Sequence[Path], overrides: tuple[str, ...], jobs: int, quiet: bool, verbose: bool
) -> Iterator[tuple[Path, tuple[RuleOutcome, ...]]]:
    """The outcomes of each pipeline; in parallel, pipelines with a study run last, since a study uses all processors."""
    work = partial(outcomes_of, overrides=overrides, quiet=quiet, verbose=verbose)
    processes = min(jobs or os.cpu_count() or 1, len(pipelines))
    if processes == 1:
        yield from zip(pipelines, map(work, pipelines), strict=True)
        return
    studies = [path for path in pipelines if "study" in load_pipeline(path, overrides).sections]
    others = [path for path in pipelines if path not in studies]
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"), initializer=end_with_parent) as pool:
        try:
            yield from zip(others, pool.map(work, others), strict=True)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    yield from zip(studies, map(work, studies), strict=True)


def outcomes_of(path: Path, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> tuple[RuleOutcome, ...]:
    """The outcomes of a pipeline's rules; DataError when one of its tests fails."""
    pipeline = load_pipeline(path, overrides)
    manner = Manner(options.teller(quiet, verbose))
    with tempfile.TemporaryDirectory() as scratch, output_folder(Path(scratch) / "out") as folder:
        identification = run(pipeline, folder, manner)
    for failure in identification.failed:
        raise DataError(failure.message)
    return identification.outcomes


def _failure(path: Path, outcome: RuleOutcome) -> str:
    return f"{path}: {outcome.section}: {outcome.rule} fails, found {outcome.found}"

"""labpipe archive RESULTS -o FILE"""

from __future__ import annotations

import datetime
from pathlib import Path

import click

from labpipe.archive.contents import contents
from labpipe.archive.zip_file import check_output, write_archive
from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.config.pipeline import load_pipeline
from labpipe.errors import ConfigError, DataError
from labpipe.stages.verification import pipeline_folder


@click.command()
@click.argument("results", type=options.PATH)
@click.option("-o", "--output", type=options.PATH, required=True, metavar="FILE", help="File to write: .zip, or .eln for notebooks.")
@click.option(
    "-c",
    "--config",
    "pipeline_path",
    type=options.PATH,
    metavar="PIPELINE",
    help="The pipeline that made the results; by default a file of its name in or above them.",
)
@click.option("--digests-only", is_flag=True, help="Of recordings, raw and calibrated, keep the digests and not the recordings.")
@click.option("--date", "date", metavar="DATE", help="Day of publication, e.g. 2026-11-03; by default that of the result (UTC).")
@options.quiet
def archive(results: Path, output: Path, pipeline_path: Path | None, digests_only: bool, date: str | None, quiet: bool) -> None:
    """Pack RESULTS with all they were made from into one file, an RO-Crate 1.1: pipeline, rig, recordings, result, report, digests.

    The same results give the same bytes. `labpipe verify FILE` checks every digest in it, runs the pipeline again and compares.

    \b
    labpipe run pipeline.yaml -o out/
    labpipe archive out/ -o evidence.zip
    labpipe verify evidence.zip
    """
    check_output(output)
    day = _day(date)
    folder = results.parent if results.name == NAME else results
    if not (folder / NAME).is_file():
        raise DataError(f"holds no {NAME}", where=str(folder), hint="results appear with `labpipe run PIPELINE -o FOLDER`")
    pipeline = load_pipeline(pipeline_path or _pipeline_of(folder))
    packed = contents(folder, pipeline, digests_only=digests_only)
    write_archive(packed, output, day or _written(folder / NAME))
    if quiet:
        return
    kept = [member for member in packed.members if member.kept]
    others = len(packed.members) - len(kept)
    echo(f"written: {output}, {len(kept)} files" + (f"; of {others} more the digests" if others else ""))
    for path in packed.left_out:
        echo(f"left out: {path}, which is not of this result")


def _pipeline_of(folder: Path) -> Path:
    """The pipeline that made a result, where a file of its name is near; ConfigError elsewhere."""
    name = read_identification(folder / NAME).pipeline
    home = pipeline_folder(folder)
    if home is None:
        raise ConfigError(f"no pipeline '{name}' is in or above the results", where=str(folder), hint="name it with -c PIPELINE")
    return home / name


def _day(text: str | None) -> str:
    """The day as ISO 8601 has it, empty for none; ConfigError for another text."""
    if text is None:
        return ""
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError:
        raise ConfigError(f"--date: '{text}' is no day", hint="write it as 2026-11-03") from None


def _written(path: Path) -> str:
    """The day [UTC] on which a file was written."""
    return datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC).date().isoformat()

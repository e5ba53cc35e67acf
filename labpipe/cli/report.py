"""labpipe report and export: results for people and for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import click

from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.mirrored import read_results, summary
from labpipe.artefacts.writing import output_file, without_staging
from labpipe.cli import options
from labpipe.cli.output import echo, message_line
from labpipe.errors import ConfigError, DataError
from labpipe.processes import use_processes
from labpipe.project.measured import files_of_test
from labpipe.project.report import write_campaign, write_report, write_test_report
from labpipe.registry import Registry

WRITERS = Registry("writer")


@click.command()
@click.argument("results", metavar="DIR|identification.json...", type=options.PLACE, nargs=-1, required=True)
@options.path(
    "-o", "--output", required=True, help="Report file; its suffix (.html, .pdf, .md) determines the format."
)
@options.path(
    "--figures", metavar="DIR", help="Also write every figure as SVG and PNG, and its numbers as CSV, to DIR."
)
@click.option("--test", default="", metavar="NAME", help="Only the pages of this test, of a result of many.")
@click.option(
    "-j",
    "--jobs",
    type=options.COUNT,
    default=1,
    help="Processes that draw a PDF of many figures; 0: one per processor.",
)
@options.quiet
@options.verbose
def report(
    results: tuple[Path, ...],
    output: Path,
    figures: Path | None,
    test: str,
    jobs: int,
    quiet: bool,
    verbose: bool,
) -> None:
    """Write the report of a result: verdict, parameters, figures, warnings, provenance.

    A result may be at s3://bucket/prefix. Several results, or a folder with results below it, give the report
    of a campaign: every coefficient over preload, speed, temperature and the condition `date` of its tests,
    control limits, and results that differ from the others.

    \b
    labpipe report out/ -o report.pdf --figures out/figures
    labpipe report monday/ tuesday/ wednesday/ -o campaign.html
    labpipe report out/ --test 1kN-3000rpm-2 -o one-test.html
    """
    wanted = (lambda name: summary(name) or name in files_of_test(test)) if test else summary
    with ExitStack() as stack:
        stack.enter_context(use_processes(jobs))
        heres = [stack.enter_context(read_results(place, wanted)) for place in results]
        paths = result_files(heres)
        tell = options.teller(quiet, verbose)
        identifications = []
        for path in list(paths):
            try:
                identifications.append(read_identification(path))
            except DataError as error:
                # One bad file among the many of a folder is named and passed over.
                if path in heres or path.parent in heres or len(paths) == 1:
                    raise
                paths.remove(path)
                echo(message_line(f"warning: {error}"), err=True)
        if test and len(paths) > 1:
            raise click.UsageError("--test takes one result; several are named")
        if test:
            tell(f"report    {test}")
            write_test_report(identifications[0], test, output, figures, paths[0].parent)
        elif len(paths) == 1:
            tell(f"report    {identifications[0].title}")
            write_report(identifications[0], output, figures=figures, result=paths[0])
        else:
            tell(f"report    {len(paths)} results together")
            write_campaign(list(zip(_names(paths), identifications, strict=True)), output, figures)
    if not quiet:
        echo(f"written: {output}" + (f", figures in {figures}" if figures is not None else ""), err=True)


def result_files(results: Sequence[Path]) -> list[Path]:
    """The identification.json files: a file itself, that of a folder, or all below a folder without one."""
    files: list[Path] = []
    for path in results:
        below = without_staging(path.rglob(NAME)) if path.is_dir() and not (path / NAME).exists() else []
        if path.is_dir() and not below and not (path / NAME).exists():
            what = f"holds no {NAME}, neither does a folder below it"
            raise DataError(what, path, "run `labpipe run` first")
        files.extend(below or [path / NAME if path.is_dir() else path])
    return list(dict.fromkeys(files))


def _names(paths: Sequence[Path]) -> list[str]:
    folders = [
        path.resolve().parent if path.name == NAME else path.resolve().with_suffix("") for path in paths
    ]
    for parts in range(1, max(len(folder.parts) for folder in folders) + 1):
        names = ["/".join(folder.parts[-parts:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return [f"{names[n]} ({n + 1})" for n in range(len(names))]


@click.command()
@click.argument("artefact", type=options.PATH)
@click.option(
    "--to", "target_format", type=click.Choice(WRITERS.names()), required=True, help="Format of the file."
)
@options.path("-o", "--output", required=True, help="File to write.")
def export(artefact: Path, target_format: str, output: Path) -> None:
    """Write a recording, free decays, a frequency response, or the parameters or mode shapes of an
    identification for other programs.

    Of an identification csv and parquet hold the parameters, shapes (a table) and uff (records 15, 82 and 55)
    the mode shapes.
    """
    table = WRITERS.load(target_format)
    endings = getattr(table, "endings", ())
    if output.suffix and endings and output.suffix.lower() not in endings and not output.is_char_device():
        what = f"'{output.suffix}' is no ending of a file in the format {target_format}"
        raise ConfigError(what, output, f"known: {', '.join(endings)}")
    with output_file(output) as target:
        table(artefact, target)

"""Options that several commands share."""

from __future__ import annotations

import functools
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from labpipe.artefacts.writing import OutputFolder, is_remote, output_folder, path_of
from labpipe.cli.output import echo
from labpipe.errors import ConfigError


class _PathType(click.Path):
    def __init__(self, *, elsewhere: bool) -> None:
        super().__init__(path_type=Path)
        self.elsewhere = elsewhere

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = path_of(str(value))
        if is_remote(path) and not self.elsewhere:
            self.fail(f"'{value}' is not a path of this machine, which is needed here", param, ctx)
        return path


PATH, PLACE = _PathType(elsewhere=False), _PathType(elsewhere=True)
COUNT = click.IntRange(min=0)
Command = Callable[..., Any]


def path(*names: str, metavar: str = "FILE", **more: Any) -> Callable[[Command], Command]:
    """An option that names a file or a folder of this machine."""
    return click.option(*names, type=PATH, metavar=metavar, **more)


overrides = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Override a config entry, e.g. identify.direct.band='60-70 Hz'.",
)
quiet = click.option("-q", "--quiet", is_flag=True, help="Print errors and warnings only.")
verbose = click.option(
    "-v", "--verbose", is_flag=True, help="Print every step, also when the output is not a terminal."
)


def refuse_given(names: Sequence[str], of: str) -> None:
    """ConfigError for an option among *names*, parameters of the command that runs, that was typed: what it
    is *of* is not there.
    """
    context = click.get_current_context()
    for parameter in context.command.params:
        if (
            parameter.name in names
            and context.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE
        ):
            raise ConfigError(f"{parameter.opts[0]}: is of {of}")


def usual(command: Command) -> Command:
    """The options --set, -q and -v."""
    return overrides(quiet(verbose(command)))


out_folder = path("-o", "--output", required=True, metavar="DIR", help="Folder for the results.")
out_place = click.option(
    "-o",
    "--output",
    type=PLACE,
    required=True,
    metavar="DIR",
    help="Folder for the results, or s3://bucket/prefix, gs://bucket/prefix.",
)
pipeline_file = path(
    "-c", "--config", "pipeline_path", required=True, metavar="PIPELINE", help="Pipeline file (YAML)."
)

jobs = click.option(
    "-j", "--jobs", type=COUNT, default=1, help="Processes for several tests; 0: one per processor."
)
cluster = click.option(
    "--cluster",
    metavar="ADDRESS|local|FILE",
    help="Run the tests on the workers of a Dask scheduler, e.g. tcp://10.0.0.1:8786, or tls://...; of this "
    "machine; of a cluster in YAML.",
)

_FILTERS = (
    click.option("--rig", default="", help="Only rigs whose name contains this."),
    click.option("--fit", default="", help="Only this fit; '*' matches any characters."),
    click.option("--test", default="", help="Only this test; '*' matches any characters."),
    click.option("--since", default="", metavar="DATE", help="Only from this day on, e.g. 2026-11-03."),
    click.option("--until", default="", metavar="DATE", help="Only up to this day."),
    click.option(
        "--source",
        default="",
        help="Only values whose uncertainty has this source, e.g. a sensor; '*' matches any characters.",
    ),
    click.option(
        "--where",
        multiple=True,
        metavar="CONDITION",
        help="Only tests at this condition, e.g. 'preload >= 400 N' (repeatable).",
    ),
)


def catalogue_filters(command: Command) -> Command:
    """Options that select results."""
    return functools.reduce(lambda decorated, option: option(decorated), reversed(_FILTERS), command)


@contextmanager
def results_folder(path: Path) -> Iterator[OutputFolder]:
    """The folder of a command's results; what was found damaged there is named on standard error."""
    remarks: list[str] = []
    try:
        with output_folder(path, remarks=remarks) as folder:
            yield folder
    finally:
        for remark in remarks:
            echo(f"warning: {remark}", err=True)


@contextmanager
def hold_signals() -> Iterator[list[int]]:
    """The signals that asked a command to end, instead of ending it at once."""
    asked: list[int] = []
    before = {
        number: signal.signal(number, lambda received, _frame: asked.append(received))
        for number in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def teller(quiet: bool, verbose: bool) -> Callable[[str], None]:
    """The output of progress messages: to a terminal, or anywhere with -v; none with -q."""
    if quiet or not (verbose or sys.stderr.isatty()):
        return lambda _message: None
    return lambda message: echo(message, err=True)

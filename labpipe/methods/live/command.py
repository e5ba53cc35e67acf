"""labpipe live PIPELINE SOURCE"""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from labpipe.cli import options
from labpipe.cli.output import echo, echo_table, printable
from labpipe.errors import ConfigError

if TYPE_CHECKING:
    from labpipe.methods.live.charts import Update
    from labpipe.methods.live.session import Session
    from labpipe.records.rig import Rig

# Seconds between two pictures of the terminal and the page.
PICTURE = 0.25
# Where frames of standard input are kept until the test is evaluated, below the folder of results.
FRAMES = "frames"


def _parse_positive(text: str) -> float:
    """A number above zero; BadParameter for another one."""
    with suppress(ValueError):
        if 0 < (number := float(text)) < math.inf:
            return number
    raise click.BadParameter("a number above zero is needed")


@click.command()
@click.argument("pipeline_path", metavar="PIPELINE", type=options.PATH)
@click.argument("source", metavar="[SOURCE]", required=False)
@click.option(
    "--until",
    "rules",
    multiple=True,
    metavar="RULE",
    help="End when an interval is this narrow, e.g. 'k.expanded<=1%' (repeatable); default: live.until.",
)
@click.option("--json", "as_json", is_flag=True, help="One line of JSON for every average.")
@click.option("--page", is_flag=True, help="Show the test in a browser of this machine as well.")
@click.option("--bell", is_flag=True, help="Ring when it is enough.")
@options.path("-o", "--output", metavar="DIR", help="Afterwards run the pipeline over the recording.")
@click.option(
    "--idle",
    type=_parse_positive,
    metavar="SECONDS",
    default="90",
    show_default=True,
    help="Seconds without samples that end the test.",
)
@options.path("--simulate", metavar="RIG", help="A virtual rig in place of SOURCE.")
@click.option("--run", "run_name", default="", help="Run of the virtual rig; default: the first.")
@click.option(
    "--speed",
    type=_parse_positive,
    metavar="NUMBER",
    default="1",
    show_default=True,
    help="How much faster than real time.",
)
@click.option("--seed", type=options.COUNT, default=1, show_default=True, help="Noise of the virtual rig.")
@options.overrides
@options.quiet
def live(
    pipeline_path: Path,
    source: str | None,
    rules: tuple[str, ...],
    as_json: bool,
    page: bool,
    bell: bool,
    output: Path | None,
    idle: float,
    simulate: Path | None,
    run_name: str,
    speed: float,
    seed: int,
    overrides: tuple[str, ...],
    quiet: bool,
) -> int:
    """Follow a test while it runs: SOURCE is a file that grows, a folder into which recordings fall, or - for
    frames on standard input.

    Each average moves the coefficients and their intervals, which hold at the moment of stopping. The
    recordings of PIPELINE are not read. Exit code 0 when every rule of --until holds (or there is none), 1
    when the test ended before.
    """
    from labpipe.methods.live.charts import Goal
    from labpipe.methods.live.session import Session
    from labpipe.methods.live.sources import Frames, open_source
    from labpipe.project.pipeline_file import load_for_stream

    _check_source(source, simulate)
    pipeline = load_for_stream(pipeline_path, overrides)
    rig = pipeline.rig
    if rig is None:
        raise ConfigError("rig: is missing", pipeline_path, "name the rig file")
    goals = [Goal.of(text) for rule in rules for text in rule.split(",")]
    if not goals and "live" in pipeline.sections:
        goals = pipeline.sections["live"].goals
    recording = None if source in (None, "-") else Path(source)
    with options.asked_to_stop() as stop_requests:
        if simulate is not None:
            stream: Any = _play(simulate, run_name, seed, speed, rig)
        elif recording is None:
            kept_frames = None if output is None else output / FRAMES
            if sys.stdin.isatty():
                raise ConfigError("standard input is a terminal", hint="pipe frames into it, or name a file")
            stream = Frames(sys.stdin.buffer, rig.columns, kept_frames)
            if stream.n_earlier and not quiet:
                echo(f"goes on with the {stream.n_earlier} frames that are kept in {kept_frames}", err=True)
        else:
            stream = open_source(recording, rig.columns)
        session = Session(pipeline, rig, stream, goals, idle, recording, stopped=lambda: bool(stop_requests))
        goals_hold = _follow(session, as_json, page, bell, quiet)
        if stop_requests and not quiet and not as_json:
            _echo_by_hand(session)
        if not quiet and not as_json:
            _echo_left_out(session)
        if output is not None:
            _finish(session, pipeline_path, overrides, output, quiet or as_json)
    return 0 if goals_hold or not goals else 1


def _check_source(source: str | None, simulate: Path | None) -> None:
    if (source is None) == (simulate is None):
        what = "one of SOURCE and --simulate is needed"
        raise ConfigError(what, hint="labpipe live PIPELINE recording.tdms")
    if simulate is None:
        options.refuse_given(("run_name", "speed", "seed"), "a virtual rig: name its file, --simulate RIG")


def _follow(session: Session, as_json: bool, page: bool, bell: bool, quiet: bool) -> bool:
    """Show every update; whether it was enough."""
    with _display(session, as_json, page, quiet) as show:
        update, drawn_at = None, 0.0
        for update in session.updates():
            if as_json:
                entry = {**update.as_json(), "without_scatter_of_hits": _without_scatter(session)}
                click.echo(json.dumps(entry, allow_nan=False))
            if update.stop or time.monotonic() - drawn_at > PICTURE:
                show(update)
                drawn_at = time.monotonic()
            if update.stop:
                break
        if update is not None:
            show(update)
    if update is not None and update.stop and bell:
        click.echo("\a", err=True, nl=False)
    return update is not None and update.stop


@contextmanager
def _display(session: Session, as_json: bool, page: bool, quiet: bool) -> Iterator[Callable[[Update], None]]:
    """What shows an update: a page, and a table on the terminal that is drawn anew, or lines elsewhere."""
    from labpipe.methods.live.view import Page, course, headline, rows_of

    silent, shown_averages = as_json or quiet, -1
    with ExitStack() as displays:
        server = displays.enter_context(closing(Page())) if page else None
        if server is not None:
            echo(f"page: {server.address}", err=True)
        console = None if silent else _console()
        if console is not None:
            displays.enter_context(console)

        def show(update: Update) -> None:
            nonlocal shown_averages
            if server is not None:
                server.show(course(session, update))
            if console is not None:
                console.update(_picture(session, update), refresh=True)
            elif not silent and (update.stop or update.averages != shown_averages):
                shown_averages = update.averages
                rows = rows_of(session, update)
                values = "; ".join(f"{name} {value}" for name, value, goal, _ in rows if goal)
                echo(f"{headline(session, update)} {values}".rstrip())

        yield show
    if console is None and not silent:
        _echo_last(session)


def _console() -> Any:
    """A display of the package rich on a terminal; None elsewhere, or where the extra is not installed."""
    if not sys.stdout.isatty():
        return None
    try:
        from rich.live import Live
    except ImportError:
        return None
    return Live(auto_refresh=False)


def _picture(session: Session, update: Update) -> Any:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from labpipe.methods.live.view import HEADER, headline, rows_of

    table = Table(*HEADER)
    for row in rows_of(session, update):
        table.add_row(*(Text(printable(cell)) for cell in row))
    colour = "green" if update.stop else ""
    parts: list[Any] = [Text(printable(headline(session, update)), style=colour), table]
    parts += [
        Text(printable(f"{finding.code}: {finding.message}"), style="yellow") for finding in update.findings
    ]
    parts += [Text(printable(event), style="dim") for event in update.events]
    return Group(*parts)


def _echo_last(session: Session) -> None:
    from labpipe.methods.live.view import HEADER, rows_of

    for update in session.seen[-1:]:
        echo_table(HEADER, rows_of(session, update))
        for finding in update.findings:
            echo(f"{finding.code}: {finding.message}")


def _echo_by_hand(session: Session) -> None:
    from labpipe.methods.live.bench import Bench

    intervals = session.bench.manual_intervals() if isinstance(session.bench, Bench) else {}
    if intervals:
        echo("Ended by hand: intervals that hold whenever one stops (95 % for all averages together)")
        for name, (low, high) in intervals.items():
            echo(f"  {name}  {low:.6g} ... {high:.6g}")


def _without_scatter(session: Session) -> list[str]:
    """Fits whose intervals a run widens by the scatter of hits, each of which it takes for a repeat."""
    from labpipe.methods.live.bench import Bench

    bench, frf = session.bench, session.pipeline.frf
    if not isinstance(bench, Bench) or frf is None or frf.excitation != "impact" or frf.damping_window:
        return []
    per_hit = [fit.settings.name for fit in bench.fits if fit.settings.repeats == "each"]
    return per_hit if len(bench.layout.inputs) == 1 else []


def _echo_left_out(session: Session) -> None:
    if fits := _without_scatter(session):
        what = "labpipe run takes each hit for a repeat and adds their scatter beyond noise to its intervals"
        where = "which these hold where noise cannot be all of it (p < .001, no force window)"
        echo(f"{', '.join(fits)}: {what}, {where}; repeats: pool leaves it out there as well")


def _play(rig_path: Path, run_name: str, seed: int, speed: float, rig: Rig) -> Any:
    import numpy as np

    from labpipe.methods.live.sources import Played
    from labpipe.project.simulate import load_virtual_rig
    from labpipe.raw_files.screening import TimeAxisScreen
    from labpipe.raw_files.table import check_names
    from labpipe.simulate.virtual_rigs import LoggedTable, simulate

    files = simulate(load_virtual_rig(rig_path), seed, [run_name] if run_name else None).files
    tables = [file.columns for file in files.values() if isinstance(file, LoggedTable)]
    recorded = next((table for table in tables if set(rig.columns) <= set(table)), tables[0])
    check_names(rig_path, rig.columns, list(recorded))
    samples = np.stack([recorded[name] for name in rig.columns], axis=1)
    rate = rig.sample_rate
    if rate is None:
        screen = TimeAxisScreen(rig.columns[0])
        screen.add(samples[:, 0] * rig.time_scale)
        rate = screen.sample_rate()
    return Played(samples, rate, speed)


def _finish(
    session: Session, pipeline_path: Path, overrides: tuple[str, ...], output: Path, quiet: bool
) -> None:
    """Run the pipeline over the recording as `labpipe run` does, with the course of the test."""
    from labpipe.artefacts.writing import output_folder
    from labpipe.cli.terminal import echo_identification
    from labpipe.methods.live.sources import Frames
    from labpipe.project.one_test import silent
    from labpipe.project.pipeline_file import load_pipeline
    from labpipe.project.report import outdate_reports, write_reports
    from labpipe.project.run import Manner, run

    files = session.recorded
    if isinstance(session.stream, Frames):
        with output_folder(output) as folder:
            files = session.stream.recordings(folder.write_path)
        files = [output / path.name for path in files]
    recordings = json.dumps([str(path.resolve()) for path in files])
    goals = json.dumps([goal.text for goal in session.goals])
    pipeline = load_pipeline(
        pipeline_path, (*overrides, f"recordings={recordings}", f"live={{until: {goals}}}")
    )
    with output_folder(output) as folder:
        identification = run(pipeline, folder, Manner(silent))
        outdate_reports(folder, pipeline.report.formats)
    write_reports(identification, output, pipeline.report.formats, silent)
    # From here on the recordings stand for the frames.
    shutil.rmtree(output / FRAMES, ignore_errors=True)
    echo_identification(identification, quiet)

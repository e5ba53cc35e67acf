"""labpipe init, inspect, excite, simulate: what comes before a result; and the shipped examples."""

from __future__ import annotations

import re
import sys
from functools import partial
from importlib.resources import files
from math import log2
from pathlib import Path
from typing import Any

import click
import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.writing import OutputFolder, output_folder
from labpipe.cli import options
from labpipe.cli.output import echo, echo_findings
from labpipe.errors import ConfigError
from labpipe.project.inspect import inspect as content_of, write_card
from labpipe.project.report import format_of
from labpipe.project.rig_file import load_rig
from labpipe.project.scaffold import MARK, scaffold
from labpipe.project.simulate import load_virtual_rig, simulate_files
from labpipe.quantities import locate_units, parse_value
from labpipe.raw_files.excitation import DIRECTIONS, LAWS, PHASES, Sweep, design_multisine
from labpipe.raw_files.uff import FileShapes
from labpipe.records.recording import Overview
from labpipe.records.response import FORMS, FrequencyResponse, Port
from labpipe.records.settings import Setting, to_band
from labpipe.records.spectra import ChannelSpectra
from labpipe.registry import few, nearest
from labpipe.simulate.virtual_rigs import VIRTUAL_RIGS

_SAMPLE = re.compile(r"\.\./sample_data/([\w.-]+)/")
_VIRTUAL = re.compile(r"\.\./configs/([\w.-]+)\.yaml")


def shipped_folder() -> Path:
    """Where pipelines and sample data are: in the checkout, or beside the package; ConfigError if nowhere."""
    for root in (Path(__file__).parents[2], Path(sys.prefix) / "share/labpipe"):
        if (root / "pipelines").is_dir() and (root / "sample_data").is_dir():
            return root
    hint = "they come with the repository: pipelines, configs and sample_data"
    raise ConfigError("the examples are not installed", hint=hint)


def examples() -> dict[str, list[Path]]:
    """The pipelines of every rig by the rig's name."""
    by_rig: dict[str, list[Path]] = {}
    for path in sorted((shipped_folder() / "pipelines").glob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        named = _SAMPLE.search(text) or _VIRTUAL.search(text)
        by_rig.setdefault((named[1] if named else path.stem), []).append(path)
    return dict(sorted(by_rig.items()))


SCAFFOLD = ("rig.yaml", "pipeline.yaml")
SCAFFOLD_RIG = "virtual-magnetic-rig"
# Files of a folder that cannot be read which are named one by one.
MOST_LEFT_OUT = 8


@click.command()
@click.argument("folder", metavar="DIR", type=options.PATH, required=False)
@click.argument("recordings", metavar="[RECORDING...]", nargs=-1, type=options.PATH)
@click.option(
    "--example",
    metavar="NAME",
    help="An example rig with its recordings and pipelines; `--example list` lists them.",
)
def init(folder: Path | None, recordings: tuple[Path, ...], example: str | None) -> None:
    """Scaffold a project in DIR: rig.yaml, pipeline.yaml and a sample recording; it runs as it is.

    With RECORDING... (or FRFs) the two files are filled in from the recording: channels, units, rate, kind of
    excitation, band. Entries that only a person can decide are marked, and labpipe names each of them until
    it is decided. A folder stands for all recordings in it: what their names (500rpm_1.csv), or a table
    beside them that names them, say of each becomes its conditions.
    """
    if example is not None and recordings:
        raise ConfigError("--example has its own recordings", hint="leave out one of the two")
    if example == "list":
        for name, pipelines in examples().items():
            echo(f"{name}: {', '.join(path.stem for path in pipelines)}")
        return
    if folder is None:
        raise click.UsageError("Missing argument 'DIR'.", click.get_current_context())
    existing = [name for name in (*SCAFFOLD, "pipelines") if (folder / name).exists()]
    if existing:
        raise ConfigError(f"already holds {', '.join(existing)}", folder, "name a new folder")
    with output_folder(folder) as output:
        if example is not None:
            following = _example(example, folder, output)
        elif recordings:
            following = _from_recordings(recordings, folder, output)
        else:
            following = _sample(folder, output)
        echo(f"next: labpipe {following}")


def _run(folder: Path, pipeline: str) -> str:
    return f"run {folder / pipeline} -o {folder / 'out'}"


def _example(name: str, folder: Path, output: OutputFolder) -> str:
    # Copy an example's pipelines with all they name; the command that runs the first, as of all below
    found = examples()
    if name not in found:
        raise ConfigError(f"no example '{name}'", hint=nearest(name, found))
    root = shipped_folder()
    files = [*found[name], *(path for path in (root / "configs").rglob("*") if path.is_file())]
    texts = [pipeline.read_text(encoding="utf-8") for pipeline in found[name]]
    for sample in sorted({sample for text in texts for sample in _SAMPLE.findall(text)}):
        files.extend(path for path in (root / "sample_data" / sample).rglob("*") if path.is_file())
    for path in files:
        output.write_path(path.relative_to(root).as_posix()).write_bytes(path.read_bytes())
    pipelines = [pipeline.name for pipeline in found[name]]
    echo(f"written to {folder}: {', '.join(pipelines)}, configs, sample_data")
    return _run(folder, f"pipelines/{pipelines[0]}")


def _from_recordings(recordings: tuple[Path, ...], folder: Path, output: OutputFolder) -> str:
    project = scaffold(recordings, folder)
    texts = dict(zip(SCAFFOLD, (project.rig, project.pipeline), strict=True))
    names = [name for name, text in texts.items() if text]
    for name in names:
        output.write_path(name).write_text(texts[name], encoding="utf-8")
    echo(f"written to {folder}: {', '.join(names)}")
    if project.left_out:
        echo(f"left out: {few(project.left_out, MOST_LEFT_OUT, '; ')}")
    if project.decisions:
        echo(f"to be decided, marked '{MARK}': {', '.join(project.decisions)}")
    if project.tacho:
        return (
            f"orders {recordings[0]} -r {folder / 'rig.yaml'} --tacho {project.tacho} -o {folder / 'orders'}"
        )
    return _run(folder, "pipeline.yaml")


def _sample(folder: Path, output: OutputFolder) -> str:
    for name in SCAFFOLD:
        output.write_path(name).write_bytes(files("labpipe.cli").joinpath("scaffold", name).read_bytes())
    simulate_files(VIRTUAL_RIGS.load(SCAFFOLD_RIG).settings(SCAFFOLD_RIG), 1, ["pedestal"], output)
    echo(f"written to {folder}: {', '.join(SCAFFOLD)}, pedestal.csv, truth.json")
    return _run(folder, "pipeline.yaml")


@click.command()
@click.argument("file", type=options.PATH)
@click.option(
    "-r", "--rig", "rig_path", type=options.PATH, help="Rig file to compare names, units and rate with."
)
@options.path("-o", "--output", metavar="CARD", help="Also write a card with small plots (.html, .pdf, .md).")
def inspect(file: Path, rig_path: Path | None, output: Path | None) -> None:
    """Show the content of a recording, an FRF or spectra: channels, units, rate, length, gaps, clipping,
    levels.

    \b
    labpipe inspect run.tdms -r rig.yaml -o card.html
    """
    if output is not None:
        format_of(output)
    content = content_of(file, None if rig_path is None else load_rig(rig_path))
    if output is not None:
        write_card(content, file.name, output)
    if isinstance(content, FrequencyResponse):
        echo(f"{file.name}: {content.form} [{FORMS[content.form]}], {_lines(content.frequency)}")
        forces = "bases" if content.form == "transmissibility" else "forces"
        for title, ports in (("responses", content.outputs), (forces, content.inputs)):
            echo(f"  {title:<9} " + ", ".join(_port(port) for port in ports))
        qualities = [name for name in ("covariance", "coherence") if getattr(content, name) is not None]
        echo(f"  with {' and '.join(qualities)}" if qualities else "  without covariance or coherence")
    elif isinstance(content, ChannelSpectra):
        runs = ", ".join(content.runs)
        echo(f"{file.name}: spectra of all channels, {_lines(content.frequency)}, runs {runs}")
        width = max(len("channel"), *(len(channel.name) for channel in content.channels))
        echo(f"  {'channel':<{width}}  {'rms of a line':>14}{'noise':>12}  unit")
        for number, channel in enumerate(content.channels):
            size = (abs(content.vectors[:, :, number]) ** 2).mean() ** 0.5 / 2**0.5
            noise = (content.covariance[:, :, number, number].real.mean() / 2) ** 0.5
            about = f"{channel.unit}, {channel.role} {channel.dof}"
            echo(f"  {channel.name:<{width}}  {size:>14.4g}{noise:>12.3g}  {about}")
        echo_findings(content.findings)
    elif isinstance(content, FileShapes):
        _echo_shapes(content, file.name)
    else:
        _echo_recording(content)
    if output is not None:
        echo(f"written: {output}", err=True)


def _lines(frequency: FloatArray) -> str:
    return f"{frequency.size} lines, {frequency[0]:g} to {frequency[-1]:g} Hz"


def _echo_shapes(shapes: FileShapes, file: str) -> None:
    n_mode = shapes.frequency.size
    more = f"; {shapes.others} further record(s) of another kind or other nodes" if shapes.others else ""
    echo(f"{file}: {n_mode} mode shape(s) at {len(shapes.points)} points and directions{more}")
    # A shape is not compared with itself.
    mac = shapes.mac - 2 * np.eye(n_mode)
    for n in range(n_mode):
        largest = shapes.points[int(np.argmax(np.abs(shapes.shapes[:, n])))]
        alike = f", MAC {mac[n].max():.2f} with mode {int(np.argmax(mac[n])) + 1}" if n_mode > 1 else ""
        pole = f"{shapes.frequency[n]:.6g} Hz, damping ratio {shapes.damping_ratio[n]:.4g}"
        echo(f"  mode {n + 1}: {pole}, largest at {largest}{alike}")


def _port(port: Port) -> str:
    return port.label if port.dof == port.label else f"{port.label} ({port.dof})"


def _echo_recording(overview: Overview) -> None:
    if overview.kind == "raw file":
        echo(f"{overview.file}: {overview.n_sample} rows, {len(overview.channels)} columns, {overview.rate}")
        labels = [channel.label for channel in overview.channels]
    else:
        echo(f"{overview.kind} {overview.file}: {overview.n_sample} samples, {overview.rate}")
        labels = [f"{channel.name} [{channel.unit}] {channel.about}" for channel in overview.channels]
    width = max(len(label) for label in labels)
    echo(f"  {'channel':<{width}}{'min':>13}{'max':>13}{'mean':>13}{'rms (ac)':>13}")
    for label, channel in zip(labels, overview.channels, strict=True):
        levels = (channel.minimum, channel.maximum, channel.mean, channel.rms)
        echo(f"  {label:<{width}}" + "".join(f"{level:>13.5g}" for level in levels))
    echo_findings(overview.findings)
    if not overview.findings:
        echo("  no gaps, no clipping")
    for contradiction in overview.contradictions or ():
        echo(f"  warning rig: {contradiction}")


OF_MULTISINES, OF_SWEEPS = ("spacing", "phases", "odd", "leave_out", "seed"), ("direction", "length", "pause")


_shown = partial(click.option, show_default=True)


@click.command()
@options.path("-o", "--output", required=True, help="Signal file: .csv, .parquet or .wav.")
@_shown("--band", default="1-100 Hz", help="Excited band.")
@_shown("--spacing", default="0.5 Hz", help="Spacing of the lines; one period lasts 1 / spacing.")
@_shown("--rate", default="20 kHz", help="Sampling rate.")
@_shown("--periods", type=click.IntRange(min=1), default=6, help="Periods or sweeps written.")
@_shown("--level", default="1 V", help="Root mean square of the signal.")
@_shown("--phases", type=click.Choice(list(PHASES)), default="schroeder", help="Method for the phases.")
@click.option("--odd", is_flag=True, help="Odd lines only: even lines then show even distortion.")
@click.option(
    "--leave-out",
    type=options.COUNT,
    default=0,
    metavar="N",
    help="Leave out one line of every N: these show odd distortion.",
)
@_shown("--seed", type=options.COUNT, default=0, help="Seed of random phases and of the lines left out.")
@click.option("--sweep", type=click.Choice(LAWS), help="A swept sine over the band in place of a multisine.")
@_shown("--direction", type=click.Choice(DIRECTIONS), default="up", help="Of the sweeps.")
@_shown("--length", default="60 s", help="Length of one sweep.")
@_shown("--pause", default="5 s", help="Pause after each sweep, in which the rig comes to rest.")
@options.quiet
def excite(
    output: Path,
    band: str,
    spacing: str,
    rate: str,
    periods: int,
    level: str,
    phases: str,
    odd: bool,
    leave_out: int,
    seed: int,
    sweep: str | None,
    direction: str,
    length: str,
    pause: str,
    quiet: bool,
) -> None:
    """Design a test signal, a multisine or sweeps, and print the crest factor (peak over rms) or the rate."""
    # Loads pandas, which no other command here needs.
    from labpipe.project.exports import write_signal

    if sweep is None:
        options.refuse_given(OF_SWEEPS, "a swept sine: name its --sweep")
    else:
        options.refuse_given(OF_MULTISINES, "a multisine: leave out --sweep")
    with locate_units("--band"):
        limits = to_band(band, Setting("band", "", unit="Hz"))
    line_spacing, sample_rate = _value("--spacing", spacing, "Hz"), _value("--rate", rate, "Hz")
    rms = _value("--level", level, "V")
    if sweep is not None:
        duration, rest = _value("--length", length, "s"), _value("--pause", pause, "s")
        swept = Sweep(limits, duration, rms, sweep, direction, rest)
        samples = swept.samples(sample_rate, periods)
        what = f"{periods} sweep(s) {direction}, {limits[0]:g}-{limits[1]:g} Hz, {sweep}, {_rate(swept)}"
        words = f"{what}; pauses of {rest:g} s"
    else:
        kind: Any = {"phases": phases, "odd_only": odd, "leave_out": leave_out, "seed": seed}
        signal = design_multisine(limits, line_spacing, rms, **kind)
        samples = signal.samples(sample_rate, periods)
        low, high = signal.lines[[0, -1]] * line_spacing
        words = f"{signal.lines.size} lines, {low:g}-{high:g} Hz, period {1 / line_spacing:g} s"
        words += f", {phases} phases: crest factor {signal.crest_factor:.3f}"
    write_signal(output, samples, sample_rate)
    if not quiet:
        echo(words)


def _rate(swept: Sweep) -> str:
    low, high = swept.band
    if swept.law == "linear":
        return f"{(high - low) / swept.duration:.3g} Hz/s"
    return f"{60 * log2(high / low) / swept.duration:.3g} octaves/min"


def _value(option: str, text: str, unit: str) -> float:
    with locate_units(option):
        return parse_value(text, unit)


@click.command()
@click.argument("rig_path", metavar="RIG", type=options.PATH)
@options.out_folder
@_shown("--seed", type=options.COUNT, default=1, help="Seed of the noise; the same seed, the same bytes.")
@click.option(
    "--run", "runs", multiple=True, metavar="NAME", help="Simulate this run only (repeatable); default: all."
)
@options.usual
def simulate(
    rig_path: Path,
    output: Path,
    seed: int,
    runs: tuple[str, ...],
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> None:
    """Simulate recordings of a virtual RIG with known truth (truth.json)."""
    rig = load_virtual_rig(rig_path, overrides)
    options.teller(quiet, verbose)(f"simulate  {rig.name}, seed {seed}")
    with output_folder(output) as folder:
        names = simulate_files(rig, seed, runs or None, folder)
    if not quiet:
        echo(f"written to {output}: {', '.join(names)}")

"""labpipe init DIR [RECORDING...]"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import click

from labpipe.artefacts.writing import OutputFolder, output_folder
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.errors import ConfigError
from labpipe.simulate.magnetic_settings import VirtualMagneticRig
from labpipe.stages.examples import copy_example, examples
from labpipe.stages.scaffold import MARK, scaffold
from labpipe.stages.simulate import simulate_files

SCAFFOLD = ("rig.yaml", "pipeline.yaml")


@click.command()
@click.argument("folder", metavar="DIR", type=options.PATH, required=False)
@click.argument("recordings", metavar="[RECORDING...]", nargs=-1, type=options.PATH)
@click.option("--example", metavar="NAME", help="An example rig with its recordings and pipelines; `--example list` lists them.")
def init(folder: Path | None, recordings: tuple[Path, ...], example: str | None) -> None:
    """Scaffold a project in DIR: rig.yaml, pipeline.yaml and a sample recording; it runs as it is.

    With RECORDING... (or FRFs) the two files are filled in from the recording: channels, units, rate, kind of excitation, band.
    Entries that only a person can decide are marked, and labpipe names each of them until it is decided.
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
        raise ConfigError(f"already holds {', '.join(existing)}", where=str(folder), hint="name a new folder")
    with output_folder(folder) as output:
        if example is not None:
            _example(example, folder, output)
        elif recordings:
            _from_recordings(recordings, folder, output)
        else:
            _sample(folder, output)


def _example(name: str, folder: Path, output: OutputFolder) -> None:
    pipelines = copy_example(name, output)
    echo(f"written to {folder}: {', '.join(pipelines)}, configs, sample_data")
    _next(folder / "pipelines" / pipelines[0], folder)


def _from_recordings(recordings: tuple[Path, ...], folder: Path, output: OutputFolder) -> None:
    project = scaffold(recordings, folder)
    for name, text in zip(SCAFFOLD, (project.rig, project.pipeline), strict=True):
        if text:
            output.write_path(name).write_text(text, encoding="utf-8")
    names = [name for name, text in zip(SCAFFOLD, (project.rig, project.pipeline), strict=True) if text]
    echo(f"written to {folder}: {', '.join(names)}")
    if project.decisions:
        echo(f"to be decided, marked '{MARK}': {', '.join(project.decisions)}")
    _next(folder / "pipeline.yaml", folder)


def _sample(folder: Path, output: OutputFolder) -> None:
    for name in SCAFFOLD:
        output.write_path(name).write_bytes(files("labpipe.cli").joinpath("scaffold", name).read_bytes())
    simulate_files(VirtualMagneticRig("virtual-magnetic-rig"), 1, ["pedestal"], output)
    echo(f"written to {folder}: {', '.join(SCAFFOLD)}, pedestal.csv, truth.json")
    _next(folder / "pipeline.yaml", folder)


def _next(pipeline: Path, folder: Path) -> None:
    echo(f"next: labpipe run {pipeline} -o {folder / 'out'}")

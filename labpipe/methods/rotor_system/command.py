"""labpipe rotor FILE"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from labpipe.cli import options
from labpipe.cli.output import echo, echo_table
from labpipe.errors import ConfigError

if TYPE_CHECKING:
    from labpipe.arrays import FloatArray
    from labpipe.methods.rotor_system.build import RotorSystem
    from labpipe.report.document import Document


@click.command()
@click.argument("rotor_path", metavar="FILE", type=options.PATH)
@click.option(
    "--speeds", default="", metavar="BAND", help="e.g. '10-120 Hz'; default: 5 % to twice the file's speed."
)
@click.option("--steps", type=click.IntRange(min=8), default=40, show_default=True, help="Speeds in it.")
@click.option(
    "--json", "json_path", type=options.PATH, metavar="FILE", help="Write the result as JSON as well."
)
@click.option("-o", "--output", type=options.PATH, metavar="FILE", help="Report: .html, .pdf or .md.")
@options.overrides
def rotor(
    rotor_path: Path,
    speeds: str,
    steps: int,
    json_path: Path | None,
    output: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """A rotor by theory alone: natural frequencies over speed, critical speeds with amplification factors and
    margins, stability, unbalance response. Uncertainties of the file's numbers, its pedestals and its
    internal damping count, and give intervals.
    """
    import numpy as np

    from labpipe.artefacts.writing import output_file
    from labpipe.document.render import DOCUMENTS
    from labpipe.methods.rotor_system.system_file import load_system

    render = None if output is None else DOCUMENTS.load(output.suffix.lstrip("."))
    system = load_system(rotor_path, overrides)
    result_of = _with_intervals if system.is_uncertain else _evaluate_theory
    entry, document = result_of(system, np.linspace(*_band(speeds, system.rig.speed), steps))
    if json_path is not None:
        with output_file(json_path) as path:
            path.write_text(json.dumps(entry, indent=1) + "\n", encoding="utf-8")
    if output is not None and render is not None:
        with output_file(output) as path:
            path.write_bytes(render(document))


def _evaluate_theory(system: RotorSystem, speeds: FloatArray) -> tuple[dict[str, Any], Document]:
    from labpipe.methods.rotor import theory

    rig = system.rig
    predicted = theory.rotor_theory(rig, speeds)
    echo(f"{rig.name}, {60 * rig.speed:g} rpm")
    echo_table(("critical speed", "damping", "whirl"), list(theory.crossing_rows(predicted)), (0, 1))
    for line in theory.sentences(predicted):
        echo(line)
    return theory.rotor_entry(predicted), theory.rotor_document(predicted)


def _with_intervals(system: RotorSystem, speeds: FloatArray) -> tuple[dict[str, Any], Document]:
    from labpipe.artefacts.json_file import entry_of, without_nan
    from labpipe.methods.rotor_system.evaluate import declared_result
    from labpipe.methods.rotor_system.section import result_blocks, sentences
    from labpipe.report.document import Document, Section

    result = declared_result(system, speeds)
    echo(f"{result.rotor}, {60 * system.rig.speed:g} rpm, as declared")
    for line in sentences(result):
        echo(line)
    entry = {"schema": "labpipe/rotor-declared/1", **without_nan(entry_of(result))}
    sections = (Section("Result", result_blocks(result)),)
    return entry, Document(result.rotor, "Rotor as declared", sections, to_sign=False)


def _band(text: str, speed: float) -> tuple[float, float]:
    from labpipe.quantities import locate_units
    from labpipe.records.settings import Setting, to_band

    if not text:
        if speed == 0:
            hint = "--speeds '5-200 Hz'"
            raise ConfigError("--speeds is needed, since the file's speed is zero", hint=hint)
        return 0.05 * speed, 2 * speed
    with locate_units("--speeds"):
        low, high = to_band(text, Setting("band", "speeds", unit="Hz"))
    if low <= 0:
        raise ConfigError("--speeds must begin above zero", hint="--speeds '5-200 Hz'")
    return low, high

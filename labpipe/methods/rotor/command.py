"""labpipe rotor FILE"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from labpipe.cli import options
from labpipe.cli.output import echo, echo_table
from labpipe.errors import ConfigError

if TYPE_CHECKING:
    from labpipe.methods.rotor.theory import RotorTheory
    from labpipe.report.document import Document

# Logarithmic decrement that API 617 level I asks for at the operating speed.
LEAST_DECREMENT = 0.1


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
    margins, stability, unbalance response.
    """
    import numpy as np

    from labpipe.artefacts.writing import output_file
    from labpipe.document.render import DOCUMENTS
    from labpipe.methods.rotor.rotor_file import load_rotor
    from labpipe.methods.rotor.theory import rotor_theory

    rig = load_rotor(rotor_path, overrides)
    low, high = _band(speeds, rig.speed)
    theory = rotor_theory(rig, np.linspace(low, high, steps))
    echo(f"{rig.name}, {60 * rig.speed:g} rpm")
    echo_table(("critical speed", "damping", "whirl"), list(_crossing_rows(theory)), (0, 1))
    for line in sentences(theory):
        echo(line)
    if json_path is not None:
        with output_file(json_path) as path:
            path.write_text(json.dumps(rotor_entry(theory), indent=1) + "\n", encoding="utf-8")
    if output is not None:
        render = DOCUMENTS.load(output.suffix.lstrip("."))
        with output_file(output) as path:
            path.write_bytes(render(rotor_document(theory)))


def _band(text: str, speed: float) -> tuple[float, float]:
    from labpipe.quantities import UnitError
    from labpipe.records.settings import Setting, to_band

    if not text:
        if speed == 0:
            raise ConfigError(
                "--speeds is needed, since the file's speed is zero", hint="--speeds '5-200 Hz'"
            )
        return 0.05 * speed, 2 * speed
    try:
        low, high = to_band(text, Setting("band", "speeds", unit="Hz"))
    except UnitError as error:
        raise ConfigError(f"--speeds: {error.what}", hint=error.hint) from None
    return low, high


def _crossing_rows(theory: RotorTheory) -> Iterator[tuple[str, str, str]]:
    """Where a damped natural frequency is that of the speed."""
    for speed, decrement, whirl in theory.crossings:
        word = "forward" if whirl > 0.3 else "backward" if whirl < -0.3 else "mixed"
        yield f"{60 * speed:.0f} rpm ({speed:.4g} Hz)", f"log decrement {decrement:.3g}", word


def sentences(theory: RotorTheory) -> Iterator[str]:
    """Peaks of the unbalance response with their margins, and stability."""
    operating = theory.rig.speed
    for critical in theory.criticals:
        text = (
            f"unbalance response: peak at {60 * critical.speed:.0f} rpm, {1e6 * critical.amplitude:.3g} um "
            f"at node {critical.node}"
        )
        margin = critical.margin(operating)
        if margin is None:
            yield f"{text}; no amplification factor within the speeds"
            continue
        there, asked = margin
        if not asked:
            yield f"{text}, amplification {critical.amplification:.3g}: below 2.5, no critical speed"
            continue
        word = "kept" if there >= asked else "NOT kept"
        yield (
            f"{text}, amplification {critical.amplification:.3g}; margin to {60 * operating:g} rpm "
            f"{there:.1f} %, {asked:.1f} % asked for: {word}"
        )
    least = theory.least_decrement()
    word = "above" if least > LEAST_DECREMENT else "NOT above"
    yield f"least log decrement at {60 * operating:g} rpm: {least:.3g}, {word} {LEAST_DECREMENT:g}"
    top = 60 * theory.speed[-1]
    yield (
        f"stable up to {top:.0f} rpm"
        if theory.onset is None
        else f"unstable from {60 * theory.onset:.0f} rpm on"
    )


def rotor_entry(theory: RotorTheory) -> dict[str, Any]:
    """The result as `labpipe rotor --json` writes it: speeds in Hz, null where a mode is gone."""
    import numpy as np

    def rows(matrix: Any) -> list[list[float | None]]:
        return [[None if np.isnan(value) else float(value) for value in row] for row in matrix]

    operating = theory.rig.speed
    return {
        "schema": "labpipe/rotor/1",
        "name": theory.rig.name,
        "speed_hz": operating,
        "campbell": {
            "speed_hz": theory.speed.tolist(),
            "frequency_hz": rows(theory.frequency),
            "log_decrement": rows(theory.log_decrement),
            "whirl": rows(theory.whirl),
        },
        "crossings": [
            {"speed_hz": speed, "log_decrement": decrement, "whirl": whirl}
            for speed, decrement, whirl in theory.crossings
        ],
        "critical_speeds": [
            {
                "speed_hz": critical.speed,
                "amplitude": critical.amplitude,
                "unit": "m",
                "node": critical.node,
                "amplification": critical.amplification,
                "margin_percent": None if (margin := critical.margin(operating)) is None else margin[0],
                "required_margin_percent": None if margin is None else margin[1],
            }
            for critical in theory.criticals
        ],
        "least_log_decrement": theory.least_decrement(),
        "onset_speed_hz": theory.onset,
    }


def rotor_document(theory: RotorTheory) -> Document:
    """The result as a report: what was found, Campbell diagram, damping and unbalance response over speed."""
    from labpipe.report.chart import Axis, Panel, curve, stacked, upright
    from labpipe.report.document import Block, Document, Figure, Paragraph, Section, Table

    speed, operating = theory.speed, theory.rig.speed
    table = Table(
        ("critical speed", "damping", "whirl"), tuple(_crossing_rows(theory)), "Where a mode meets the speed"
    )
    blocks: list[Block] = [Paragraph(line) for line in sentences(theory)]
    shown = [n for n in range(theory.frequency.shape[1]) if (theory.frequency[:, n] < 2.5 * speed[-1]).any()]
    lines = [curve(f"mode {n + 1}", speed, theory.frequency[:, n], n % 6) for n in shown]
    across = Axis("speed", "Hz")
    campbell = Panel(
        across,
        Axis("natural frequency", "Hz", low=0.0, high=float(2 * speed[-1])),
        (*lines, curve("1x", speed, speed, -1, "--"), upright(operating)),
    )
    damping = Panel(
        across,
        Axis("log decrement"),
        (
            *(curve(f"mode {n + 1}", speed, theory.log_decrement[:, n], n % 6) for n in shown),
            upright(operating),
        ),
    )
    figures: list[Block] = [
        Figure(
            stacked([campbell, damping], 5.2),
            "Campbell diagram, modes followed through crossings, and their logarithmic decrements; dashed: "
            "the speed itself; upright: the operating speed.",
            "Natural frequencies and logarithmic decrements over speed",
        )
    ]
    if theory.fine is not None and theory.amplitude is not None:
        responses = [
            curve(f"node {node}", theory.fine, 1e6 * theory.amplitude[:, n], n % 6)
            for n, node in enumerate(theory.nodes)
        ]
        panel = Panel(
            across, Axis("major semi-axis", "um", logarithmic=True), (*responses, upright(operating))
        )
        caption = "Response to the unbalances of the file: the major semi-axis of the orbit."
        figures.append(Figure(stacked([panel], 3.0), caption, "Unbalance response over speed"))
    sections = (Section("Result", (*blocks, table)), Section("Over speed", tuple(figures)))
    return Document(theory.rig.name, "Rotor by theory alone", sections, to_sign=False)

"""labpipe balance FILE"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from labpipe.cli import options
from labpipe.cli.output import echo

if TYPE_CHECKING:
    from labpipe.methods.balancing.balance_file import Balanced, OtherMark

# Share of what is left down to which one more run must lower it.
WORTHWHILE = 0.8


@click.command()
@click.argument("balance_path", metavar="FILE", type=options.PATH)
@click.option(
    "--json", "json_path", type=options.PATH, metavar="FILE", help="Write the result as JSON as well."
)
@options.overrides
def balance(balance_path: Path, json_path: Path | None, overrides: tuple[str, ...]) -> None:
    """Balance weights by trial runs, by a model of the rotor, or by both: what to set where, the vibration
    that is left with its interval, and whether one more run would pay.
    """
    from labpipe.artefacts.writing import output_file
    from labpipe.methods.balancing.balance_file import balance, balance_entry, load_balance

    result = balance(load_balance(balance_path, overrides))
    for line in sentences(result):
        echo(line)
    if json_path is not None:
        with output_file(json_path) as path:
            path.write_text(json.dumps(balance_entry(result), indent=1) + "\n", encoding="utf-8")


def _weight(result: Balanced, plane: int) -> str:
    """A weight with the 95 % interval of that which would leave nothing."""
    import numpy as np

    weight, degrees = result.weights[plane], np.degrees
    text = f"{1e6 * abs(weight):.4g} g mm at {degrees(np.angle(weight)) % 360:.1f} deg"
    if not result.intervals:
        return text
    size, angle = result.intervals[plane].size, result.intervals[plane].angle
    to = "any angle" if angle is None else " to ".join(f"{degrees(end) % 360:.1f}" for end in angle) + " deg"
    return f"{text} (95 %: {1e6 * size[0]:.4g} to {1e6 * size[1]:.4g} g mm, {to})"


def _by_other_mark(mark: OtherMark) -> str:
    weights = ", and those of the weights," if mark.weights else ""
    counted = ["counted in the other sense than those of the weights"] if mark.mirrored else []
    if mark.turned:
        counted.append(f"{math.degrees(mark.turned):.1f} deg larger, by the mark of the model")
    how = f"{weights} are {' and '.join(counted)}"
    return f"warning: the readings agree where their angles{how}; the weights above are wrong then"


def sentences(result: Balanced) -> Iterator[str]:
    import numpy as np

    from labpipe.display import number, shown_unit, unit_label
    from labpipe.quantities import to_display

    file, residual, knowledge = result.file, result.residual, result.knowledge

    def text(*values: float) -> str:
        unit = shown_unit(file.unit, *values)
        shown = " to ".join(number(to_display(value, unit), 3) for value in values)
        return f"{shown} {unit_label(unit)}".rstrip()

    for plane, name in enumerate(file.planes):
        yield f"plane {name}: {_weight(result, plane)}"
        for place, mass in result.masses.get(name, ()):
            yield f"  {1e3 * mass:.3g} g at {np.degrees(place) % 360:.1f} deg"
    low, high = residual.interval
    yield (
        f"vibration (rms of {len(file.lines)} readings): {text(residual.before)} as found, "
        f"{text(residual.rms)} expected with the weights (95 %: {text(low, high)})"
    )
    for name, middle, low, high in zip(
        file.lines, residual.amplitudes, residual.low, residual.high, strict=True
    ):
        yield f"  {name}: {text(middle)} (95 %: {text(low, high)})"
    if result.permissible is not None:
        most = float(np.sum(residual.unbalance))
        word, asked = "within" if most <= result.permissible else "beyond", 1e3 * (file.settings.grade or 0)
        yield (
            f"unbalance that is left: at most {1e6 * most:.3g} g mm (95 %), {word} the permissible "
            f"{1e6 * result.permissible:.3g} g mm of G {asked:g} (G {asked * most / result.permissible:.2g})"
        )
    if result.widened > 1:
        yield (
            f"warning: the readings scatter more than was stated (chi-square {knowledge.misfit:.3g} of "
            f"{knowledge.dof}): the rig is not linear, changed between runs, repeats less well, or its "
            "weights are known less well (`weight_uncertainty`). All intervals count "
            f"{result.widened:.3g} times the stated noise"
        )
        if result.mark.mirrored or result.mark.turned:
            yield _by_other_mark(result.mark)
    elif not knowledge.dof:
        yield (
            "note: no run is to spare, so that nothing shows whether readings scatter as stated and count "
            "their angles as weights do, and all intervals rest on the stated noise: one run more, with "
            "other weights, would show both"
        )
    best = min(result.next_runs, key=lambda name: result.next_runs[name])
    least = result.next_runs[best]
    if least < WORTHWHILE * residual.rms:
        share = 100 * least / residual.rms
        yield f"one more run with {best} first is expected to leave {text(least)}, {share:.0f} % of that"
    else:
        yield "one more run is not expected to lower it by a fifth"

"""labpipe bearing: coefficients of a bearing as tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import click
import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.writing import output_file, output_folder
from labpipe.bearings.kinds import Amount, BearingCoefficients, BearingUncertainties
from labpipe.cli import options
from labpipe.cli.output import echo, for_terminal
from labpipe.display import amount_text, per_cent, plain_text, significant
from labpipe.project.bearing import (
    Evaluated,
    bearing_entry,
    bearing_json,
    evaluate,
    sweep_bearing,
    write_bearing,
    write_sweep,
)
from labpipe.project.bearing_file import BearingFile, BearingSweep, open_bearing, parse_sweep

# Share of sqrt(K_ii K_jj) below which a coefficient is zero by structure, up to rounding.
STRUCTURAL_ZERO = 1e-9
LEAST_SPREAD = 1e-4
MAX_ROWS = 12
# Sources shown of a coefficient, and the least share in its variance.
MAX_SHARES, LEAST_SHARE = 3, 0.01
# Significant digits of coefficients without an uncertainty; amounts at rest that people think of as
# percentages.
DIGITS = 4
PERCENTAGES = ("mesh_error",)


def echo_bearing(name: str, kind: str, whole: Evaluated) -> None:
    """Matrices, uncertainties, equilibrium, range over one passage of an element, and warnings."""
    coefficients = whole.coefficients
    echo(f"{name}: {kind}")
    _echo_matrix("stiffness", coefficients, coefficients.stiffness, coefficients.relative)
    if coefficients.damping.any():
        _echo_matrix("damping", coefficients, coefficients.damping, None)
    if whole.uncertainties is not None:
        _echo_uncertainties(coefficients, whole.uncertainties)
    loads = tuple(amount for amount in coefficients.rest if amount.name.startswith("load_"))
    rest = tuple(amount for amount in coefficients.rest if amount not in loads)
    for title, amounts in (
        ("loads", loads),
        ("rest position", rest),
        ("shares", coefficients.shares),
        ("model", coefficients.notes),
        ("shaft", coefficients.shaft),
    ):
        if amounts:
            echo(f"{title}: {', '.join(_amount(amount, _rounding(amounts)) for amount in amounts)}")
    for word, verdict in coefficients.words.items():
        echo(f"{word.replace('_', ' ')}: {verdict}")
    if coefficients.poles is not None:
        poles = ", ".join(f"{pole.real:.4g} {pole.imag:+.4g}j" for pole in coefficients.poles)
        echo(f"poles [rad/s]: {poles}")
    if coefficients.shaft:
        echo(
            "(sdof_k: stiffness from a one-dof fit at the dof's main peak; coupled dofs make it differ "
            "from the diagonal term)"
        )
    _echo_passage(coefficients)
    for finding in coefficients.findings:
        echo(f"warning {finding.code}: {finding.message}")


def _echo_matrix(
    title: str, coefficients: BearingCoefficients, matrix: FloatArray, relative: FloatArray | None
) -> None:
    second = "" if title == "stiffness" else " s"
    tilts = "" if len(set(coefficients.dofs) & {"bx", "by"}) == 0 else f", N{second}/rad, N m{second}/rad"
    echo(f"{title} [N{second}/m{tilts}]: load of the row per displacement of the column")
    echo("      " + "".join(f"{dof:>12}" for dof in coefficients.dofs))
    for row, dof in enumerate(coefficients.dofs):
        numbers = [
            "0"
            if relative is not None and abs(relative[row, column]) < STRUCTURAL_ZERO
            else significant(float(matrix[row, column]), DIGITS)
            for column in range(len(coefficients.dofs))
        ]
        echo(f"  {dof:<4}" + "".join(f"{number:>12}" for number in numbers))


def _echo_uncertainties(coefficients: BearingCoefficients, uncertainties: BearingUncertainties) -> None:
    echo("with standard uncertainties, and the shares of their sources:")
    for kind, symbol in (("stiffness", "k"), ("damping", "c")):
        matrix, changes = getattr(coefficients, kind), getattr(uncertainties, kind)
        for (i, row), (j, column) in product(enumerate(coefficients.dofs), repeat=2):
            error = float(np.sqrt(np.sum(changes[:, i, j] ** 2)))
            if error <= STRUCTURAL_ZERO * np.max(np.abs(matrix), initial=0.0):
                continue
            largest = uncertainties.shares(changes[:, i, j])[:MAX_SHARES]
            shares = ", ".join(
                f"{name} {100 * share:.0f} %" for name, share in largest if share >= LEAST_SHARE
            )
            amount = amount_text(float(matrix[i, j]), error, coefficients.unit(i, j, kind))
            echo(f"  {f'{symbol}_{row}_{column}':<10}{amount:<32}{shares}".rstrip())


def _rounding(amounts: Sequence[Amount]) -> float:
    """Magnitude below which a load or displacement is rounding; zero for other quantities."""
    return STRUCTURAL_ZERO * max(
        (abs(amount.value) for amount in amounts if amount.unit in ("m", "rad", "N", "N.m")), default=0.0
    )


def _amount(amount: Amount, least: float) -> str:
    name, value = amount.name.removeprefix("load_"), amount.value if abs(amount.value) > least else 0.0
    if amount.name in PERCENTAGES:
        return f"{name} {significant(100 * value, 2)} %"
    return f"{name} {plain_text(value, amount.unit)}"


def _echo_passage(coefficients: BearingCoefficients) -> None:
    if coefficients.lowest is None or coefficients.highest is None:
        return
    low, high = np.diag(coefficients.lowest), np.diag(coefficients.highest)
    spread = np.divide(high - low, high + low, out=np.zeros_like(low), where=high + low > 0)
    if spread.max() < LEAST_SPREAD:
        what = "over one passage of a rolling element the direct stiffness varies by less than"
        echo(f"{what} {100 * LEAST_SPREAD:g} %")
        return
    ranges = ", ".join(
        f"{dof} +- {per_cent(part)}" for dof, part in zip(coefficients.dofs, spread, strict=True)
    )
    echo(for_terminal(f"over one passage of a rolling element the direct stiffness varies: {ranges}"))


def echo_sweep(name: str, sweep: BearingSweep, cases: Sequence[BearingCoefficients]) -> None:
    """The direct stiffness over the sweep, shortened in the middle; the table on disk is complete."""
    dofs = cases[0].dofs
    echo(f"{name}: direct stiffness over {sweep.label}, {len(cases)} values")
    echo(f"{sweep.label:>20}" + "".join(f"{f'k_{dof}_{dof}':>12}" for dof in dofs))
    numbers = list(range(len(cases)))
    if len(cases) > MAX_ROWS:
        numbers = [*numbers[: MAX_ROWS // 2], *numbers[-MAX_ROWS // 2 :]]
    for number in numbers:
        if len(cases) > MAX_ROWS and number == len(cases) - MAX_ROWS // 2:
            echo(f"{'...':>20}")
        diagonal = np.diag(cases[number].stiffness)
        cells = "".join(f"{significant(float(value), DIGITS):>12}" for value in diagonal)
        echo(f"{sweep.values[number]:>20.6g}{cells}")
    codes = sorted({finding.code for case in cases for finding in case.findings})
    for code in codes:
        affected = [case for case in cases if any(finding.code == code for finding in case.findings)]
        message = next(finding.message for finding in affected[0].findings if finding.code == code)
        echo(f"warning {code} (in {len(affected)} of {len(cases)} values; the first:) {message}")


@click.command()
@click.argument("bearing_path", metavar="BEARING", type=options.PATH)
@options.path("--json", "json_path", help="Write the coefficients as JSON; - for standard output.")
@click.option(
    "--sweep",
    "sweep_text",
    metavar="KEY=START:STOP:STEP",
    help="Vary one entry over a range of values, e.g. loads.z=0:2000:50.",
)
@options.path("-o", "--output", metavar="DIR", help="Folder for table and figures.")
@options.usual
def bearing(
    bearing_path: Path,
    json_path: Path | None,
    sweep_text: str | None,
    output: Path | None,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> None:
    """Stiffness and damping of a BEARING model at its load and speed.

    \b
    labpipe bearing configs/bearings/nsk-6208.yaml --set loads.z='700 N'
    labpipe bearing configs/bearings/nsk-6208.yaml --sweep loads.z=0:2000:50 -o out/6208
    """
    if sweep_text is not None and (output is None or json_path is not None):
        what = "--sweep needs -o DIR for its table, and has no --json"
        raise click.UsageError(what, click.get_current_context())
    file = open_bearing(bearing_path, overrides)
    if sweep_text is not None and output is not None:
        _sweep(file, sweep_text, output, quiet, options.teller(quiet, verbose))
        return
    name = file.settings().name or bearing_path.stem
    whole = evaluate(file)
    text = bearing_json(bearing_entry(file, name, whole))
    to_terminal = str(json_path) == "-"
    if json_path is not None and not to_terminal:
        with output_file(json_path) as target:
            target.write_text(text, encoding="utf-8")
    if output is not None:
        with output_folder(output) as folder:
            names = write_bearing(file, name, whole, folder)
    if to_terminal:
        echo(text, nl=False)
    elif not quiet:
        echo_bearing(name, file.kind_name, whole)
        if output is not None:
            echo(f"written to {output}: {', '.join(names)}")


def _sweep(
    file: BearingFile, sweep_text: str, output: Path, quiet: bool, tell: Callable[[str], None]
) -> None:
    sweep = parse_sweep(sweep_text, file.kind.settings)
    tell(f"bearing   {file.path}, {sweep.label}: {sweep.values.size} values")
    points = sweep_bearing(file, sweep)
    name = file.settings().name or file.path.stem
    with output_folder(output) as folder:
        names = write_sweep(name, sweep, points, folder)
    if not quiet:
        echo_sweep(name, sweep, [point.coefficients for point in points])
        echo(f"written to {output}: {', '.join(names)}")

"""A bearing's coefficients as tables on the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import click
import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.coefficients import Amount, BearingCoefficients
from labpipe.quantities import display_unit, to_display
from labpipe.report.wording import unit_text
from labpipe.stages.sweep import Sweep

# Below this part of sqrt(K_ii K_jj) a coefficient is zero by structure and rounding.
STRUCTURAL_ZERO = 1e-9
LEAST_SPREAD = 1e-4
MAX_ROWS = 12


def echo_bearing(name: str, kind: str, found: BearingCoefficients) -> None:
    """The matrices, the rest position, the range over one ball passage, and the warnings."""
    click.echo(f"{name}: {kind}")
    _echo_matrix("stiffness", found, found.stiffness, found.relative)
    if found.damping.any():
        _echo_matrix("damping", found, found.damping, None)
    loads = tuple(amount for amount in found.rest if amount.name.startswith("load_"))
    rest = tuple(amount for amount in found.rest if amount not in loads)
    for title, amounts in (
        ("loads", loads),
        ("rest position", rest),
        ("shares", found.shares),
        ("model", found.notes),
        ("shaft", found.shaft),
    ):
        if amounts:
            click.echo(f"{title}: {', '.join(_amount(amount, _rounding(amounts)) for amount in amounts)}")
    for name, said in found.words.items():
        click.echo(f"{name.replace('_', ' ')}: {said}")
    if found.poles is not None:
        click.echo(f"poles [rad/s]: {', '.join(f'{pole.real:.4g} {pole.imag:+.4g}j' for pole in found.poles)}")
    if found.shaft:
        click.echo("(sdof_k: what a one-dof fit finds at the dof's main peak; coupled dofs move along, so it is not the diagonal term)")
    _echo_passage(found)
    for finding in found.findings:
        click.echo(f"warning {finding.code}: {finding.message}")


def _echo_matrix(title: str, found: BearingCoefficients, matrix: FloatArray, relative: FloatArray | None) -> None:
    second = "" if title == "stiffness" else " s"
    tilts = "" if len(set(found.dofs) & {"bx", "by"}) == 0 else f", N{second}/rad, N m{second}/rad"
    click.echo(f"{title} [N{second}/m{tilts}]: load of the row per displacement of the column")
    click.echo("      " + "".join(f"{dof:>12}" for dof in found.dofs))
    for row, dof in enumerate(found.dofs):
        numbers = [
            "0" if relative is not None and abs(relative[row, column]) < STRUCTURAL_ZERO else f"{matrix[row, column]:.4g}"
            for column in range(len(found.dofs))
        ]
        click.echo(f"  {dof:<4}" + "".join(f"{number:>12}" for number in numbers))


def _rounding(amounts: Sequence[Amount]) -> float:
    """Below this a load or displacement is rounding beside the others; zero for numbers of other kinds."""
    return STRUCTURAL_ZERO * max((abs(each.value) for each in amounts if each.unit in ("m", "rad", "N", "N.m")), default=0.0)


def _amount(amount: Amount, least: float) -> str:
    """Name, value and unit; zero below *least* [SI]."""
    unit = display_unit(amount.unit)
    value = amount.value if abs(amount.value) > least else 0.0
    return f"{amount.name.removeprefix('load_')} {to_display(value, unit):.5g}{'' if unit == '1' else f' {unit_text(unit)}'}"


def _echo_passage(found: BearingCoefficients) -> None:
    """The spread of the direct coefficients while the cage turns by one element."""
    if found.lowest is None or found.highest is None:
        return
    low, high = np.diag(found.lowest), np.diag(found.highest)
    spread = np.divide(high - low, high + low, out=np.zeros_like(low), where=high + low > 0)
    if spread.max() < LEAST_SPREAD:
        click.echo(f"over one ball passage the direct stiffness varies by less than {100 * LEAST_SPREAD:g} %")
        return
    shown = ", ".join(f"{dof} +- {100 * part:.2g} %" for dof, part in zip(found.dofs, spread, strict=True))
    click.echo(f"over one ball passage the direct stiffness varies: {shown}")


def echo_sweep(name: str, sweep: Sweep, found: Sequence[BearingCoefficients]) -> None:
    """The direct stiffness over the sweep, cut in the middle; the table on disk has everything."""
    dofs = found[0].dofs
    click.echo(f"{name}: direct stiffness over {sweep.label}, {len(found)} values")
    click.echo(f"{sweep.label:>20}" + "".join(f"{f'k_{dof}_{dof}':>12}" for dof in dofs))
    shown = range(len(found)) if len(found) <= MAX_ROWS else [*range(MAX_ROWS // 2), *range(len(found) - MAX_ROWS // 2, len(found))]
    for number in shown:
        if len(found) > MAX_ROWS and number == len(found) - MAX_ROWS // 2:
            click.echo(f"{'...':>20}")
        diagonal = np.diag(found[number].stiffness)
        click.echo(f"{sweep.values[number]:>20.6g}" + "".join(f"{value:>12.4g}" for value in diagonal))
    codes = sorted({finding.code for each in found for finding in each.findings})
    for code in codes:
        marked = [each for each in found if any(finding.code == code for finding in each.findings)]
        message = next(finding.message for finding in marked[0].findings if finding.code == code)
        click.echo(f"warning {code} (in {len(marked)} of {len(found)} values; the first:) {message}")

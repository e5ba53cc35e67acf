"""The figures of a bearing model: its stiffness matrix as a heat map, its coefficients over a sweep."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.kinds import BearingCoefficients
from labpipe.quantities import display_unit, to_display
from labpipe.report.chart import PALETTE_SIZE, Axis, Chart, Panel, Series, cells, curve, named_ticks, stacked
from labpipe.report.document import Figure
from labpipe.report.figures import scale_of
from labpipe.report.wording import unit_text

DASHES = ("-", "--", ":", "-.")
# Below this part of sqrt(K_ii K_jj) a coefficient is zero by structure and rounding.
STRUCTURAL_ZERO = 1e-9


def stiffness_figure(name: str, bearing: BearingCoefficients) -> Figure:
    """Heat map of the stiffness matrix: the colour is K_ij / sqrt(K_ii K_jj), the number the coefficient in
    its unit.
    """
    n, ticks = len(bearing.dofs), named_ticks(bearing.dofs)
    texts = [[_coefficient_text(bearing, row, column) for column in range(n)] for row in range(n)]
    matrix = cells(bearing.relative, texts, "k_ij / sqrt(k_ii k_jj)")
    panel = Panel(Axis("displacement in", ticks=ticks), Axis("load in", ticks=ticks), (matrix,))
    chart = Chart((panel,), size=(1.15 * n + 1.3, 0.62 * n + 0.9))
    caption = (
        f"{name}: stiffness matrix. Colour: coupling relative to the diagonal, so that all units compare."
    )
    return Figure(chart, caption, f"Stiffness matrix of {name} as a heat map")


def _coefficient_text(bearing: BearingCoefficients, row: int, column: int) -> str:
    """A coefficient in the unit people read, which stands below it; 0 where it is zero by structure."""
    if abs(bearing.relative[row, column]) < STRUCTURAL_ZERO:
        return "0"
    unit = bearing.unit(row, column)
    return f"{to_display(bearing.stiffness[row, column], display_unit(unit)):.4g}\n{unit_text(unit)}"


def sweep_figures(
    title: str, label: str, values: FloatArray, swept: Sequence[BearingCoefficients]
) -> dict[str, Figure]:
    """The figures "stiffness" and, where there is any, "damping": every coefficient over the swept entry, one
    panel per unit.

    *label*: the entry with its unit, as in "speed [Hz]"; *values* (n,) in that unit.
    """
    figures = {"stiffness": _sweep_figure(title, label, values, swept, "stiffness")}
    if any(bearing.damping.any() for bearing in swept):
        figures["damping"] = _sweep_figure(title, label, values, swept, "damping")
    return figures


def _sweep_figure(
    title: str, label: str, values: FloatArray, swept: Sequence[BearingCoefficients], kind: str
) -> Figure:
    groups = _coefficients_by_unit(swept, np.stack([getattr(bearing, kind) for bearing in swept]))
    name, _, unit = label.rstrip("]").partition(" [")
    panels = []
    for si_unit, entries in groups.items():
        series = [_curve(values, swept, kind, entry, number) for number, entry in enumerate(entries)]
        force, _, motion = display_unit(si_unit).partition("/")
        panels.append(
            Panel(
                Axis(name, unit),
                Axis(kind, f"{force}.s/{motion}" if kind == "damping" else f"{force}/{motion}"),
                tuple(series),
            )
        )
    band = (
        "; shaded: range over one ball passage" if kind == "stiffness" and swept[0].lowest is not None else ""
    )
    caption = f"{title}: {kind} over {label}{band}. Coefficients that are zero throughout are left out."
    return Figure(
        stacked(panels, 0.7 + 2.3 * len(panels)),
        caption,
        f"{kind.capitalize()} coefficients of {title} over {label}",
    )


def _coefficients_by_unit(
    swept: Sequence[BearingCoefficients], matrices: FloatArray
) -> dict[str, list[tuple[int, int]]]:
    """unit -> the (row, column) that are not zero throughout.

    One of each pair that is the same by symmetry.
    """
    relative = np.max([np.abs(bearing.relative) for bearing in swept], axis=0)
    symmetric = np.allclose(
        matrices, np.swapaxes(matrices, 1, 2), rtol=1e-9, atol=1e-9 * np.abs(matrices).max()
    )
    groups: dict[str, list[tuple[int, int]]] = {}
    for (row, column), size in np.ndenumerate(relative):
        if (size >= STRUCTURAL_ZERO or row == column) and not (symmetric and column < row):
            groups.setdefault(swept[0].unit(row, column), []).append((row, column))
    return groups


def _curve(
    values: FloatArray, swept: Sequence[BearingCoefficients], kind: str, entry: tuple[int, int], number: int
) -> Series:
    """One coefficient over the sweep, with its range over a ball passage where the model gives one."""
    dofs, factor = swept[0].dofs, scale_of(swept[0].unit(*entry))

    def over_sweep(name: str) -> FloatArray:
        return factor * np.array([getattr(bearing, name)[entry] for bearing in swept])

    ranged = kind == "stiffness" and all(
        bearing.lowest is not None and bearing.highest is not None for bearing in swept
    )
    band = (over_sweep("lowest"), over_sweep("highest")) if ranged else None
    title = f"{'k' if kind == 'stiffness' else 'c'} {dofs[entry[0]]},{dofs[entry[1]]}"
    line = DASHES[number % len(DASHES)]
    return curve(title, values, over_sweep(kind), number % PALETTE_SIZE, line, width=1.5, band=band)

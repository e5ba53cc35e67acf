"""The figures of a bearing model: its stiffness matrix as a heat map, its coefficients over a sweep."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from labpipe.bearings.coefficients import BearingCoefficients
from labpipe.quantities import display_unit, to_display
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.wording import unit_text

WIDTH = 7.2
DASHES = ("-", "--", ":", "-.")
# Below this part of sqrt(K_ii K_jj) a coefficient is zero by structure and rounding.
STRUCTURAL_ZERO = 1e-9


def stiffness_figure(name: str, found: BearingCoefficients) -> Figure:
    """Heat map of the stiffness matrix: the colour is K_ij / sqrt(K_ii K_jj), the number the coefficient in its unit."""
    n = len(found.dofs)
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        canvas = Canvas(figsize=(1.15 * n + 1.3, 0.62 * n + 0.9), layout="constrained")
        axes = canvas.subplots()
        image = axes.imshow(found.relative, vmin=-1, vmax=1, cmap="PuOr", aspect="auto")
        axes.set_xticks(range(n), found.dofs)
        axes.set_yticks(range(n), found.dofs)
        for (row, column), relative in np.ndenumerate(found.relative):
            text = _coefficient_text(found, row, column) if abs(relative) >= STRUCTURAL_ZERO else "0"
            axes.text(column, row, text, ha="center", va="center", fontsize=7, color="white" if abs(relative) > 0.6 else "black")
        axes.set_ylabel("load in")
        axes.set_xlabel("displacement in")
        canvas.colorbar(image, ax=axes, shrink=0.9).set_label("k_ij / sqrt(k_ii k_jj)")
    caption = f"{name}: stiffness matrix. Colour: coupling relative to the diagonal, so that all units compare."
    return Figure(canvas, caption, f"Stiffness matrix of {name} as a heat map")


def _coefficient_text(found: BearingCoefficients, row: int, column: int) -> str:
    """A coefficient in the unit people read, which stands below it."""
    unit = found.unit(row, column)
    return f"{to_display(found.stiffness[row, column], display_unit(unit)):.4g}\n{unit_text(unit)}"


def sweep_figures(name: str, label: str, values: NDArray[np.float64], found: Sequence[BearingCoefficients]) -> dict[str, Figure]:
    """The figures "stiffness" and, where there is any, "damping": every coefficient over the swept entry, one panel per unit."""
    figures = {"stiffness": _sweep_figure(name, label, values, found, "stiffness")}
    if any(each.damping.any() for each in found):
        figures["damping"] = _sweep_figure(name, label, values, found, "damping")
    return figures


def _sweep_figure(name: str, label: str, values: NDArray[np.float64], found: Sequence[BearingCoefficients], kind: str) -> Figure:
    matrices = np.stack([getattr(each, kind) for each in found])
    groups = _coefficients_by_unit(found, matrices)
    with mpl.rc_context(STYLE):
        canvas = Canvas(figsize=(WIDTH, 0.7 + 2.3 * len(groups)), layout="constrained")
        panels = canvas.subplots(len(groups), 1, squeeze=False, sharex=True)[:, 0]
        for axes, (unit, entries) in zip(panels, groups.items(), strict=True):
            for number, entry in enumerate(entries):
                _curve(axes, values, found, kind, entry, number)
            force, _, motion = display_unit(unit).partition("/")
            axes.set_ylabel(f"{kind} [{force}.s/{motion}]" if kind == "damping" else f"{kind} [{force}/{motion}]")
            axes.legend(ncols=3, fontsize=8)
        panels[-1].set_xlabel(label)
    band = "; shaded: range over one ball passage" if kind == "stiffness" and found[0].lowest is not None else ""
    caption = f"{name}: {kind} over {label}{band}. Coefficients that are zero throughout are left out."
    return Figure(canvas, caption, f"{kind.capitalize()} coefficients of {name} over {label}")


def _coefficients_by_unit(found: Sequence[BearingCoefficients], matrices: NDArray[np.floating]) -> dict[str, list[tuple[int, int]]]:
    """unit -> the (row, column) that are not zero throughout; one of each pair that is the same by symmetry."""
    relative = np.max([np.abs(each.relative) for each in found], axis=0)
    symmetric = np.allclose(matrices, np.swapaxes(matrices, 1, 2), rtol=1e-9, atol=1e-9 * np.abs(matrices).max())
    groups: dict[str, list[tuple[int, int]]] = {}
    for (row, column), size in np.ndenumerate(relative):
        if (size >= STRUCTURAL_ZERO or row == column) and not (symmetric and column < row):
            groups.setdefault(found[0].unit(row, column), []).append((row, column))
    return groups


def _curve(
    axes: Axes, values: NDArray[np.float64], found: Sequence[BearingCoefficients], kind: str, entry: tuple[int, int], number: int
) -> None:
    """One coefficient over the sweep, with its range over a ball passage where known."""
    unit, dofs = found[0].unit(*entry), found[0].dofs
    factor = to_display(1.0, display_unit(unit))
    style = {"color": COLOURS[number % len(COLOURS)], "linestyle": DASHES[number % len(DASHES)]}
    title = f"{'k' if kind == 'stiffness' else 'c'} {dofs[entry[0]]},{dofs[entry[1]]}"
    axes.plot(values, factor * np.array([getattr(each, kind)[entry] for each in found]), label=title, **style)
    if kind == "stiffness" and all(each.lowest is not None and each.highest is not None for each in found):
        lowest, highest = (factor * np.array([getattr(each, name)[entry] for each in found]) for name in ("lowest", "highest"))
        axes.fill_between(values, lowest, highest, color=style["color"], alpha=0.15, linewidth=0)

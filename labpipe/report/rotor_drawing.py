"""The rotor of worn-bearing fits as a drawing: shaft elements, sleeves, discs, bearings, and where it is excited and measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import stacked_axes

MM = 1e3
SHAFT, SLEEVE, DISC, BEARING = "0.85", COLOURS[5], COLOURS[4], COLOURS[0]


def rotor_figures(settings: Mapping[str, Any]) -> list[Figure]:
    """One drawing for every rotor that an identification's settings name, each once: of its fits and of its response to unbalance."""
    rigs = [fit["wear"]["rig"] for fit in settings.get("identify", []) if fit.get("wear") and fit["wear"].get("rig")]
    rigs += [settings["unbalance"]["rig"]] if "unbalance" in settings else []
    distinct = [rig for number, rig in enumerate(rigs) if rig not in rigs[:number]]
    return [rotor_figure(rig) for rig in distinct]


def rotor_figure(rig: Mapping[str, Any]) -> Figure:
    """A rotor from its entries (elements, discs, sleeves, bearings; SI units), lengths in mm, nodes numbered from 1."""
    rotor, stations = rig["rotor"], node_positions(rig["rotor"])
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        canvas, (axes,) = stacked_axes(1, 2.9)
        for entry, left in zip(rotor["elements"], stations, strict=False):
            _ring(axes, left, entry["length"], entry["inner_diameter"], entry["outer_diameter"], facecolor=SHAFT, label="shaft")
        for sleeve in rotor["sleeves"]:
            shaft = rotor["elements"][sleeve["element"] - 1]
            left, inner = stations[sleeve["element"] - 1], shaft["outer_diameter"]
            _ring(axes, left, shaft["length"], inner, sleeve["outer_diameter"], facecolor=SLEEVE, label="sleeve")
        for disc in rotor["discs"]:
            inner, outer, length = disc_dimensions(disc, shaft_diameter(rotor, disc["node"]))
            _ring(axes, stations[disc["node"] - 1] - length / 2, length, inner, outer, facecolor=DISC, label="disc")
        _stations(axes, rig, stations)
    discs = " Discs have the outline of a cylinder with their mass and moments of inertia." if rotor["discs"] else ""
    caption = f"{rig['name']}: the rotor, its nodes numbered from the left. Diameters are drawn larger than lengths.{discs}"
    return Figure(canvas, caption, f"Drawing of the rotor {rig['name']} with its bearings")


def node_positions(rotor: Mapping[str, Any]) -> list[float]:
    """Position of every node along the shaft [m], the first at zero."""
    return [0.0, *np.cumsum([entry["length"] for entry in rotor["elements"]]).tolist()]


def shaft_diameter(rotor: Mapping[str, Any], node: int) -> float:
    """The larger of the shaft's diameters at a node [m]."""
    return max(float(entry["outer_diameter"]) for entry in rotor["elements"][max(node - 2, 0) : node])


def disc_dimensions(disc: Mapping[str, Any], bore: float) -> tuple[float, float, float]:
    """(bore, outer diameter, length) [m] of the hollow cylinder with a disc's mass and inertia.

    From I_p = m/8 (D^2 + d^2) and I_t = I_p/2 + m l^2/12; a disc of less inertia is drawn a little larger than its bore, to be seen.
    """
    outer = np.sqrt(max(8 * disc["polar_inertia"] / disc["mass"] - bore**2, 0.0))
    length = np.sqrt(max(12 * (disc["transverse_inertia"] - disc["polar_inertia"] / 2) / disc["mass"], 0.0))
    return bore, max(float(outer), 1.2 * bore), float(length)


def _ring(axes: Axes, left: float, length: float, inner: float, outer: float, **look: Any) -> None:
    """The section of a tube: above and below its bore, or one rectangle where it has none."""
    if inner > 0:
        height = (outer - inner) / 2
        boxes = [(inner / 2, height), (-outer / 2, height)]
    else:
        boxes = [(-outer / 2, outer)]
    for bottom, height in boxes:
        axes.add_patch(Rectangle((MM * left, MM * bottom), MM * length, MM * height, edgecolor="0.25", linewidth=0.8, **look))


def _stations(axes: Axes, rig: Mapping[str, Any], stations: list[float]) -> None:
    """Bearings with their names, nodes with their numbers, force and response."""
    reach = max(abs(edge) for patch in axes.patches for edge in (patch.get_y(), patch.get_y() + patch.get_height()))  # type: ignore[attr-defined]
    for place in rig["bearings"]:
        bearing, centre = place["bearing"], stations[place["node"] - 1]
        bore = bearing["diameter"]
        look = {"facecolor": BEARING, "alpha": 0.55, "hatch": "///", "label": "bearing"}
        _ring(axes, centre - bearing["length"] / 2, bearing["length"], bore, bore + 0.4 * reach / MM, **look)
        axes.annotate(place["name"], (MM * centre, -1.12 * reach), ha="center", va="top", fontsize=8)
    for number, x in enumerate(stations, 1):
        axes.plot([MM * x], [0.0], ".", color="black", markersize=3)
        axes.annotate(str(number), (MM * x, -1.75 * reach if number % 2 else -2.05 * reach), ha="center", va="center", fontsize=6)
    for name, node, height in (("force", rig["force"], 1.45), ("response", rig["response"], 1.45)):
        _arrow(axes, name, MM * stations[node - 1], reach, height)
    axes.axhline(0.0, color="0.4", linewidth=0.6, linestyle="-.")
    axes.set_ylim(-2.3 * reach, 2.1 * reach)
    axes.set_xlim(-0.03 * MM * stations[-1], 1.03 * MM * stations[-1])
    axes.set_xlabel("along the shaft [mm]")
    axes.set_ylabel("radius [mm]")
    handles = {str(patch.get_label()): patch for patch in axes.patches}
    axes.legend(list(handles.values()), list(handles), ncols=4, fontsize=8, loc="upper left")


def _arrow(axes: Axes, name: str, x: float, reach: float, height: float) -> None:
    """An arrow from above to the shaft with its name."""
    arrow = {"arrowstyle": "->", "color": COLOURS[1]}
    axes.annotate(name, (x, 1.02 * reach), (x, height * reach), ha="center", fontsize=8, color=COLOURS[1], arrowprops=arrow)

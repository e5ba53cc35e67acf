"""One chart with every kind of series, and one drawing of every kind."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.bearings.kinds import PressureField
from labpipe.methods.journal_bearing.kind import film_figure
from labpipe.methods.run_ups.figures import CoefficientSurfaces
from labpipe.records.fit_details import Modes
from labpipe.records.rig import Geometry
from labpipe.report.chart import (
    GREY,
    Axis,
    Chart,
    Drawing,
    Panel,
    arrow,
    cells,
    curve,
    dots,
    labels,
    level,
    named_ticks,
    outline,
    span,
    stack,
    upright,
)
from labpipe.report.figures import shape_figures

X = np.array([1.0, 2.0, 4.0])


@pytest.fixture(scope="session")
def every_kind() -> Chart:
    """Two panels over one speed: curves with bands and bars, lines and a span across, an outline, an arrow, a
    gap, hollow dots, words.
    """
    above = (
        curve("k", X, X**2, 0, marker=".", band=(X**2 - 0.5, X**2 + 1)),
        curve("gap", X, [1.0, np.nan, 100.0], 1, "--"),
        level(10.0, name="limit"),
        upright(3.0, line=":"),
        span(2.0, 3.0, 2),
    )
    below = (
        dots("c", X, X, 1, marker="o", size=4.0, bars=(0.9 * X, 1.2 * X)),
        dots("outside", X[:1], X[:1], 4, marker="s", hollow=True, size=8.0),
        outline("region", [1.0, 2.0, 2.0], [1.0, 1.0, 2.0]),
        arrow([1.0, 1.0], [2.0, 2.0], GREY),
        labels([1.5, 3.0], [2.0, 3.0], ["start", "end"], size=6.0),
    )
    speed = Axis("speed", "rpm")
    panels = (
        Panel(speed, Axis("k", "kN/m", logarithmic=True), above, "stiffness", share=3.0),
        Panel(speed, Axis("c", "N s/m", low=0.0), below, share=1.0),
    )
    return stack(panels, 4.0)


@pytest.fixture(scope="session")
def heat_map() -> Chart:
    """A correlation of two parameters."""
    axis = Axis(ticks=named_ticks(["k", "c"]))
    return Chart(
        (
            Panel(
                axis,
                axis,
                (cells([[1.0, 0.5], [-0.5, 1.0]], [["1", "half"], ["-half", "1"]], "correlation"),),
            ),
        ),
        size=(3.0, 2.5),
    )


@pytest.fixture(scope="session")
def drawings() -> dict[str, Drawing]:
    """kind -> a drawing of that kind."""
    theta = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    film = PressureField(
        theta,
        np.array([-0.005, 0.0, 0.005]),
        np.outer(1.5 + np.sin(theta), [1e5, 3e5, 1e5]),
        5e-5 + 1e-5 * np.cos(theta),
    )
    values = np.arange(24.0).reshape(4, 2, 3)
    surfaces = CoefficientSurfaces(
        np.array([500.0, 1000.0, 1500.0]), np.array([3.0, 6.0]), values, ("k_xx", "k_xy", "k_yx", "k_yy")
    )
    geometry = Geometry(("1", "2", "3"), 0.1 * np.eye(3), np.array([[0, 1], [1, 2]]))
    modes = Modes(
        np.array([20.0, 30.0]),
        np.array([0.01, 0.02]),
        shapes=np.array([[1.0, 1j], [0.5, -1]]),
        shape_std_errors=np.full((2, 2), 0.01),
        participation=np.ones((2, 1), complex),
        scale=np.ones(2, complex),
        points=("1", "3"),
        references=("f",),
        forces_move=False,
        mac=np.eye(2),
        collinearity=np.ones(2),
        lower=0,
        upper=1,
        dofs=("1.x", "3.z"),
        geometry=geometry,
    )
    (shapes,) = shape_figures("modes", modes)
    surface = Drawing("surfaces", surfaces, (7.2, 6.2))
    graphics = (film_figure("journal", film).graphic, surface, shapes.graphic)
    return {graphic.kind: graphic for graphic in graphics if isinstance(graphic, Drawing)}

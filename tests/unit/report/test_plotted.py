"""Drawings read back into numbers: every kind of thing that is drawn, and the plain statement where something is not numbers."""

from __future__ import annotations

import json

import matplotlib as mpl
import numpy as np
import pytest
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figure_numbers import figure_json
from labpipe.report.plotted import Plotted, plotted
from matplotlib.patches import Rectangle

from labpipe.report.figures import logarithmic, stacked_axes

X = np.array([1.0, 2.0, 4.0])


def test_lines_bands_and_bars_keep_their_numbers() -> None:
    with mpl.rc_context(STYLE):
        canvas, (above, below) = stacked_axes(2, 4.0, sharex=True, height_ratios=(3, 1))
        above.plot(X, X**2, ".-", color=COLOURS[0], label="k")
        above.fill_between(X, X**2 - 1, X**2 + 1, color=COLOURS[0], alpha=0.2)
        above.set_ylabel("k [kN/m]")
        below.errorbar(X, X, (X / 10, X / 5), fmt="o", color=COLOURS[1], label="c")
        below.plot(X, -X, "-", color=COLOURS[0])
        below.set_xlabel("speed [rpm]")
    drawn = plotted(canvas)
    (k,), (plain, c) = (panel.series for panel in drawn.panels)
    assert drawn.complete and [panel.share for panel in drawn.panels] == [0.75, 0.25]
    assert k.low is not None and k.low.tolist() == [0.0, 3.0, 15.0] and k.interval == "shaded" and k.marker == "."
    assert c.high is not None and c.high == pytest.approx(1.2 * X) and c.interval == "bar" and c.name == "c"
    # Drawn in the colour of k, and so taken for it.
    assert plain.name == "k"
    assert [panel.x.group for panel in drawn.panels] == [0, 0] and drawn.panels[0].x.label == "speed [rpm]"
    assert (drawn.panels[0].y.title, drawn.panels[0].y.unit) == ("k", "kN/m")


def test_gaps_logarithmic_axes_and_lines_across_are_told() -> None:
    canvas, (axes,) = stacked_axes(1, 3.0)
    axes.plot(X, [1.0, np.nan, 100.0], "--")
    logarithmic(axes)
    axes.axhline(10.0)
    axes.axvspan(2.0, 3.0)
    entry = json.loads(figure_json(plotted(canvas)))
    series = {one["kind"]: one for one in entry["panels"][0]["series"]}
    assert entry["panels"][0]["y"]["log"] and not entry["panels"][0]["x"]["log"]
    assert entry["numbers"][series["line"]["y"]] == [1, None, 100] and series["line"]["line"] == "--"
    assert entry["numbers"][series["hline"]["y"]] == [10] and entry["numbers"][series["vspan"]["x"]] == [2, 3]


def test_an_outline_without_a_label_has_no_name_of_its_own() -> None:
    canvas, (axes,) = stacked_axes(1, 3.0)
    axes.fill(X, X**2, color=COLOURS[0])
    axes.plot(X, X**2, color=COLOURS[0], label="region")
    assert plotted(canvas).names == ("region",)


def test_a_heat_map_keeps_its_texts_and_names() -> None:
    canvas, (axes,) = stacked_axes(1, 3.0)
    axes.imshow([[1.0, 0.5], [0.5, 1.0]], cmap="PuOr", vmin=-1, vmax=1)
    axes.set_xticks(range(2), ["k", "c"])
    axes.text(1, 0, "half")
    (cells,) = plotted(canvas).panels[0].series
    assert cells.texts == (("1", "half"), ("0.5", "1")) and len(cells.fills) == 2
    assert plotted(canvas).panels[0].x.ticks == ((0.0, "k"), (1.0, "c"))


def test_what_is_not_numbers_is_left_as_a_drawing() -> None:
    canvas, (axes,) = stacked_axes(1, 3.0)
    axes.add_patch(Rectangle((0, 0), 1, 1))
    assert not plotted(canvas).complete
    twin, (left,) = stacked_axes(1, 3.0)
    left.twinx().plot(X, X)
    assert not plotted(twin).complete


def test_no_text_of_a_figure_ends_the_element_it_stands_in() -> None:
    canvas, (axes,) = stacked_axes(1, 3.0)
    axes.plot(X, X, label="</script><b>&")
    text = figure_json(plotted(canvas))
    assert not set("<>&") & set(text) and json.loads(text)["panels"][0]["series"][0]["name"] == "</script><b>&"


def test_curves_of_one_figure_share_their_abscissa_and_nothing_gives_nothing() -> None:
    canvas, (axes,) = stacked_axes(1, 3.0)
    axes.plot(X, X**2)
    axes.plot(X, X**3)
    assert len(json.loads(figure_json(plotted(canvas)))["numbers"]) == 3
    assert figure_json(Plotted((), False)).startswith("{")

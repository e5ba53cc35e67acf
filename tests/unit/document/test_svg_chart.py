"""Charts as SVG: what is drawn stands where the numbers along its axes say, words have their room, names stand once."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.font_manager import FontProperties, findfont
from matplotlib.ft2font import FT2Font
from matplotlib.textpath import TextPath

from labpipe.document.chart_place import Scale
from labpipe.document.letters import text_width
from labpipe.document.palette import PALETTE
from labpipe.document.svg_chart import DEPTHS, chart_svg
from labpipe.document.svg_elements import _thinned, joined, runs, stamped
from labpipe.document.svg_file import svg_file
from labpipe.document.svg_series import PAINTERS
from labpipe.report.chart import KINDS, Axis, Chart, Drawing, Panel, cells, curve, dots, named_ticks, stacked
from labpipe.report.document import Figure
from labpipe.report.rotor_figure import Ring, RotorSketch, rotor_chart

SVG = "{http://www.w3.org/2000/svg}"
X = np.array([1.0, 2.0, 4.0])
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def drawn(chart: Chart) -> ElementTree.Element:
    return ElementTree.fromstring(chart_svg(chart, "f1", "a <chart>"))


def words(root: ElementTree.Element) -> list[str]:
    return ["\n".join(text.itertext()) for text in root.iter(f"{SVG}text")]


def corners(path: str) -> list[tuple[float, float]]:
    """The points of a path of M and l, H, V, h and v, as the SVG recommendation reads them."""
    points: list[tuple[float, float]] = []
    x = y = 0.0
    for letter, text in re.findall(r"([MmLlHhVvz])([^A-Za-z]*)", path):
        numbers = [float(number) for number in NUMBER.findall(text)]
        if letter in "MmLl":
            for across, down in zip(numbers[0::2], numbers[1::2], strict=True):
                x, y = (across, down) if letter in "ML" else (x + across, y + down)
                points.append((x, y))
        elif letter != "z":
            x, y = {"H": (numbers[0], y), "V": (x, numbers[0]), "h": (x + numbers[0], y), "v": (x, y + numbers[0])}[letter]
            points.append((x, y))
    return points


def box(text: ElementTree.Element) -> tuple[float, float, float, float]:
    """(left, top, right, bottom) of a text that is not turned, its letters as wide as matplotlib's DejaVu Sans draws them."""
    x, y, size = (float(text.attrib[name]) for name in ("x", "y", "font-size"))
    width = max(TextPath((0, 0), line, size, prop=FontProperties(family="DejaVu Sans")).get_extents().width for line in text.itertext())
    left = {"middle": x - width / 2, "end": x - width}.get(text.attrib.get("text-anchor", ""), x)
    return left, y - 0.73 * size, left + width, y


def test_every_kind_of_series_has_its_painter_and_its_depth() -> None:
    assert set(PAINTERS) == set(DEPTHS) == set(KINDS)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_a_curve_stands_where_the_numbers_of_its_axes_say(logarithmic: bool) -> None:
    """Places of the numbers along the axes, read from the drawing, against those of the curve's corners."""
    x, y = np.array([1.0, 2.0, 5.0, 9.0, 40.0]), np.array([3.0, 1.0, 200.0, 70.0, 5.0])
    axes = Axis("x", logarithmic=logarithmic), Axis("y", logarithmic=logarithmic)
    root = drawn(stacked([Panel(*axes, (curve("one", x, y),))], 3.0))
    texts = list(root.iter(f"{SVG}text"))
    straight = np.log10 if logarithmic else np.asarray
    (path,) = [one.attrib["d"] for group in root.iter(f"{SVG}g") if "clip-path" in group.attrib for one in group.iter(f"{SVG}path")]
    seen = np.array(corners(path))
    for anchor, place, values in (("middle", 0, x), ("end", 1, y)):
        numbers = [one for one in texts if one.attrib.get("text-anchor") == anchor and NUMBER.fullmatch(one.text or "")]
        told = straight([float(one.text or "") for one in numbers])
        at = [float(one.attrib["xy"[place]]) for one in numbers]
        slope, offset = np.polyfit(told, at, 1)
        # Words stand beside their line by a part of their height; half a unit is rounding.
        away = seen[:, place] - (slope * straight(values) + offset)
        assert np.ptp(away) < 1.5 and abs(away.mean()) < (1.5 if place == 0 else 40)


def test_names_titles_and_notes_stand_once(every_kind: Chart) -> None:
    found = words(drawn(every_kind))
    for name in ("k", "gap", "c", "outside", "region", "limit", "stiffness", "speed [rpm]", "k [kN/m]", "c [N s/m]", "start", "end"):
        assert found.count(name) == 1, name
    panel = Panel(Axis("frequency", "Hz"), Axis(), (), note="no doubt is stated")
    assert "no doubt is stated" in words(drawn(stacked([panel], 2.0)))
    assert drawn(every_kind).attrib["aria-label"] == "a <chart>"


def test_the_legend_stands_above_or_nowhere_where_asked(every_kind: Chart) -> None:
    assert "gap" not in words(drawn(replace(every_kind, legend="none")))
    above = drawn(replace(every_kind, legend="above"))
    feet = {text.text: float(text.attrib["y"]) for text in above.iter(f"{SVG}text")}
    assert max(feet[name] for name in ("k", "gap", "c", "outside", "region")) < feet["stiffness"]


def test_a_legend_hides_no_curve_where_there_is_room() -> None:
    """A falling curve leaves the right upper corner free, a rising one the left."""
    for values, free in ((X[::-1], "right"), (X, "left")):
        root = drawn(stacked([Panel(Axis("x"), Axis("y"), (curve("the only curve", X, values),))], 3.0))
        (name,) = [text for text in root.iter(f"{SVG}text") if text.text == "the only curve"]
        assert (float(name.attrib["x"]) > 2592) == (free == "right") and float(name.attrib["y"]) < 600


def grid(number: int, *, equal: bool = False) -> Chart:
    axes = Axis("x", "um"), Axis("y", "um")
    orbit = curve("orbit", X if equal else 1e3 * X, X)
    panels = tuple(Panel(*axes, (orbit,), title=f"run {n}", equal=equal) for n in range(number))
    return Chart(panels, 2, 4, (7.2, 4.0), "xy", "above")


def long_names() -> Chart:
    axis = Axis(ticks=named_ticks([f"a test with a long name {n}" for n in range(5)]))
    return stacked([Panel(axis, Axis("k", "N/m"), (dots("k", range(5), range(5)),))], 3.0)


def matrix(size: int) -> Chart:
    axis = Axis(ticks=named_ticks([f"wear_depth_{n}" for n in range(size)]))
    texts = [["-0.5\n+- 0.2"] * size for _ in range(size)]
    return Chart((Panel(axis, axis, (cells(np.full((size, size), -0.5), texts, "correlation"),)),), size=(4.0, 4.0))


CHARTS = {
    "grid": grid(7),
    "one scale": grid(8, equal=True),
    "long names": long_names(),
    "cells": matrix(5),
    "rotor": rotor_chart(RotorSketch((Ring("shaft", 0, 90, 0, 10),), (0.0, 45.0, 90.0), (("bearing 1", 10.0),), (("force", 45.0),), 5.0)),
    "large numbers": stacked([Panel(Axis("x"), Axis("y"), (curve("k", X, 1e5 + X),))] * 3, 5.0),
}


@pytest.mark.parametrize("name", CHARTS)
def test_words_stand_within_the_drawing_and_not_on_each_other(name: str) -> None:
    root = drawn(CHARTS[name])
    _, _, width, height = (float(part) for part in root.attrib["viewBox"].split())
    level = [text for text in root.iter(f"{SVG}text") if "transform" not in text.attrib]
    boxes = [box(text) for text in level if not list(text)]
    assert len(boxes) > 4
    for left, top, right, bottom in boxes:
        assert left >= -1 and top >= -1 and right <= width + 1 and bottom <= height + 1
    for number, (left, top, right, bottom) in enumerate(boxes):
        others = np.array(boxes[number + 1 :]).reshape(-1, 4)
        hidden = (others[:, 0] < right) & (others[:, 2] > left) & (others[:, 1] < bottom) & (others[:, 3] > top)
        assert not hidden.any()


def test_axes_of_one_scale_have_one(every_kind: Chart) -> None:
    """A circle is drawn as one, whether the panel or its limits give way."""
    turn = np.linspace(0, 2 * np.pi, 60)
    panel = Panel(Axis("x", "um"), Axis("y", "um"), (curve("orbit", 3 * np.cos(turn), 3 * np.sin(turn)),), equal=True)
    for chart in (Chart((panel,) * 2, 1, 2, shared="xy"), Chart((panel,) * 2, 1, 2)):
        root = drawn(chart)
        for group in root.iter(f"{SVG}g"):
            if "clip-path" in group.attrib:
                (path,) = [one.attrib["d"] for one in group.iter(f"{SVG}path")]
                size = np.ptp(np.array(corners(path)), axis=0)
                assert size[0] == pytest.approx(size[1], abs=4) and size[0] > 500


def test_ids_are_the_panels_own(every_kind: Chart) -> None:
    text = chart_svg(every_kind, "f7", "")
    named = re.findall(r' id="([^"]+)"', text)
    assert len(named) == len(set(named)) == 2 and all(one.startswith("f7-") for one in named)
    assert set(re.findall(r"url\(#([^)]+)\)", text)) == set(named)


def test_what_is_not_finite_or_has_no_logarithm_is_not_drawn_or_falls_out_below() -> None:
    scale = Scale((1.0, 100.0), True, 300.0, 100.0)
    places = scale.places(np.array([1.0, 10.0, 0.0, -5.0, np.nan]))
    assert places[:2].tolist() == [300.0, 200.0] and (places[2:4] == 3000.0).all() and np.isnan(places[4])
    points = np.array([[0, 0], [1, 1], [np.nan, 2], [3, 3]])
    assert runs(points) == [slice(0, 2), slice(3, 4)] and joined(points) == "M0 0l1 1M3 3h0"
    assert stamped(points, "h0") == "m0 0h0m1 1h0m2 2h0"


def test_crowded_points_keep_the_outline(rng: np.random.Generator) -> None:
    """Of 50 points at one place across, first, least, largest and last are what an eye can tell."""
    across = np.repeat(np.arange(40), 50)
    points = np.column_stack([across, rng.integers(0, 1000, across.size)])
    few = _thinned(points)
    assert len(few) <= 160
    for place in range(40):
        all_there, left = points[across == place, 1], few[few[:, 0] == place, 1]
        assert (left.min(), left.max(), left[0], left[-1]) == (all_there.min(), all_there.max(), all_there[0], all_there[-1])
    np.testing.assert_array_equal(_thinned(points[::-1]), points[::-1])


@pytest.mark.parametrize("text", ["receptance [um/N]", "\N{MINUS SIGN}0.0125", "1.2e5", "k_xx from 65-80 Hz: (95 %)", "WORLD & MASS"])
def test_words_are_as_wide_as_dejavu_sans_within_3_percent(text: str) -> None:
    """By the advance of every letter in the font's file, which matplotlib brings."""
    font = FT2Font(findfont("DejaVu Sans"))
    font.set_size(100, 72)
    advance = sum(font.load_char(ord(letter)).linearHoriAdvance / 65536 for letter in text)
    assert text_width(text, 100.0) == pytest.approx(advance, rel=0.03)


def test_a_name_from_a_file_is_no_markup() -> None:
    root = drawn(stacked([Panel(Axis("<b>", "&"), Axis("y"), (curve("</svg><script>", X, X),))], 3.0))
    assert "</svg><script>" in words(root) and "<b> [&]" in words(root) and not list(root.iter(f"{SVG}script"))


def test_a_file_stands_alone_with_colours_by_value(every_kind: Chart, drawings: dict[str, Drawing]) -> None:
    """Of a chart with every class that the style names, and a drawing by matplotlib; no browser's variables, nothing outside."""
    text = svg_file(Figure(every_kind, "c", "alternative"))
    root = ElementTree.fromstring(text)
    style = root.findtext(f"{SVG}style") or ""
    assert "var(" not in text and PALETTE[3] in text and "curve" in style and "#e3e6ea" in style
    classes = {name for element in root.iter() for name in element.attrib.get("class", "").split()}
    assert set(re.findall(r"\.([a-z]+)", style)) == classes | {"square"}
    assert ElementTree.fromstring(svg_file(Figure(drawings["film"], "c", "a"))).tag == root.tag

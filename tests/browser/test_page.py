"""The HTML report in a browser: nothing asked from elsewhere, readable in every width and colour scheme, zoom
and reading work.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from labpipe.document.html_page import NEEDS_SCRIPT, page_part
from labpipe.document.render import html_document
from labpipe.report.chart import Axis, Chart, Panel, arrow, cells, curve, level, named_ticks, stack
from labpipe.report.document import Document, Figure, Section

CURVE = "#figure-2 .panels > svg"
TICKS = "[...document.querySelectorAll('#figure-2 .ticks text[text-anchor=middle]')]"
LIMITS = f"Math.max(...{TICKS}.map((t) => Number(t.textContent.replace('−', '-'))))"
# Relative luminance and contrast after WCAG 2.1, over every text and the ground that it stands on.
CONTRAST = """
(() => {
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const shine = (rgb) => rgb.slice(0, 3).map((v) => v / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, n) => sum + v * [0.2126, 0.7152, 0.0722][n], 0);
  const ground = (element) => {
    for (let one = element; one; one = one.parentElement) {
      const colour = parts(getComputedStyle(one).backgroundColor);
      if (colour.length < 4 || colour[3] > 0) return colour;
    }
    return [255, 255, 255];
  };
  const found = [];
  for (const one of document.querySelectorAll("h1,h2,p,td,th,caption,figcaption,a,b,span,button,pre,.live text")) {
    if (!one.textContent.trim() || !one.getClientRects().length || one.closest(".skip") || one.style.fill) continue;
    const style = getComputedStyle(one);
    const ink = shine(parts(one instanceof SVGElement ? style.fill : style.color));
    const paper = shine(ground(one));
    found.push((Math.max(ink, paper) + 0.05) / (Math.min(ink, paper) + 0.05));
  }
  return [found.length, Math.min(...found)];
})()
"""


@pytest.fixture
def page(browser: Any, report_page: Path) -> Iterator[Any]:
    opened = browser.open(report_page)
    yield opened
    opened.close()


def centre(page: Any, selector: str, across: float = 0.5, down: float = 0.4) -> tuple[float, float]:
    page.run(f"document.querySelector({json.dumps(selector)}).scrollIntoView({{block: 'center'}})")
    found = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
    box = page.run(f"(({{left, top, width, height}}) => [left, top, width, height])({found})")
    return box[0] + across * box[2], box[1] + down * box[3]


def read(page: Any) -> str:
    return page.run(
        "(document.querySelector('#figure-2 .reading:not([hidden])') || {innerText: ''}).innerText"
    )


def test_nothing_is_asked_from_elsewhere_and_nothing_is_complained_of(page: Any, report_page: Path) -> None:
    asked = [event["request"]["url"] for event in page.said("Network.requestWillBeSent")]
    assert [url for url in asked if not url.startswith("data:")] == [report_page.resolve().as_uri()]
    assert page.said("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled") == []


def test_the_policy_stops_a_page_that_would_ask(browser: Any, report_page: Path, tmp_path: Path) -> None:
    added = '<img src="http://127.0.0.1:9/a.png"></main><script>window.ran = 1</script>'
    text = report_page.read_text(encoding="utf-8").replace("</main>", added)
    (tmp_path / "changed.html").write_text(text, encoding="utf-8")
    opened = browser.open(tmp_path / "changed.html")
    assert opened.run("window.ran") is None
    assert "Content Security Policy" in json.dumps(opened.said("Log.entryAdded"))
    opened.close()


def test_every_figure_is_drawn_by_the_script(page: Any) -> None:
    assert page.run("document.querySelectorAll('figure').length") == 5
    assert page.run("document.querySelectorAll('figure.alive .panels svg .series').length") == 9
    assert page.run("document.querySelectorAll('noscript').length") == 5


def test_a_box_zooms_the_wheel_needs_a_click_and_all_comes_back(page: Any) -> None:
    whole = page.run(LIMITS)
    page.drag(centre(page, CURVE, 0.2, 0.1), centre(page, CURVE, 0.5, 0.12))
    boxed = page.run(LIMITS)
    assert whole >= 225 and 100 <= boxed <= 150
    place = centre(page, CURVE)
    page.run("document.activeElement.blur()")
    page.mouse("mouseWheel", *place, deltaX=0, deltaY=-1)
    page.settle()
    assert page.run(LIMITS) == boxed
    page.run(f"document.querySelector('{CURVE}').focus()")
    for _ in range(6):
        page.mouse("mouseWheel", *centre(page, CURVE, 0.1), deltaX=0, deltaY=-100)
    page.settle()
    assert page.run(LIMITS) < boxed
    page.run(
        "[...document.querySelectorAll('#figure-2 button')].find((one) => one.textContent === 'All').click()"
    )
    assert page.run(LIMITS) == whole


def test_the_pointer_and_the_keys_read_the_values_of_the_table(page: Any) -> None:
    page.mouse("mouseMoved", *centre(page, CURVE, 0.5))
    page.settle()
    told = read(page)
    found = re.search(
        r"centre of the band ([\d.]+) Hz\s+k: ([\d.]+) kN/m \(shaded ([\d.]+) to ([\d.]+)\)", told
    )
    assert found, told
    at, k, low, high = map(float, found.groups())
    assert low < k < high
    page.run(f"document.querySelector('{CURVE}').focus()")
    page.key("ArrowRight")
    assert f"centre of the band {at + 3:g} Hz" in read(page)
    page.key("Home")
    assert "centre of the band 8.5 Hz" in read(page)
    rows = "[...document.querySelectorAll('tbody tr')]"
    row = page.run(f"{rows}.find((one) => one.cells[1]?.textContent === '8.5').cells[3].textContent")
    value = float(re.search(r"k: (−?[\d.]+)", read(page))[1].replace("−", "-"))  # type: ignore[index]
    assert value == pytest.approx(float(row.split()[0]), abs=float(row.split()[2]) / 5)
    page.key("Escape")
    assert read(page) == ""


def test_a_series_is_hidden_and_shown_by_its_legend(page: Any) -> None:
    count = "document.querySelectorAll('#figure-4 .series .curve').length"
    entry = "document.querySelector('#figure-4 .entry')"
    before = page.run(count)
    page.run(f"{entry}.click()")
    assert page.run(count) == before - 1 and page.run(f"{entry}.getAttribute('aria-pressed')") == "false"
    page.run(f"{entry}.click()")
    assert page.run(count) == before


@pytest.mark.parametrize(("width", "kind"), [(360, "screen"), (700, "print"), (1400, "screen")])
def test_nothing_hangs_over_the_edge(page: Any, width: int, kind: str) -> None:
    page.media(kind=kind)
    page.size(width, 800)
    assert page.run("document.documentElement.scrollWidth") <= width
    if kind == "print":
        page.run("dispatchEvent(new Event('beforeprint'))")
        assert page.run(
            "[...document.querySelectorAll('.live svg')].every((one) => one.getClientRects().length === 1)"
        )
        assert page.run(
            "[...document.querySelectorAll('.controls > button')].every((one) => "
            "!one.getClientRects().length)"
        )
        edges = (
            "[...document.querySelectorAll('table, pre, .live svg')].map((one) => "
            "one.getBoundingClientRect().right)"
        )
        assert max(page.run(edges)) <= width + 1
    else:
        sizes = (
            "Math.min(...[...document.querySelectorAll('.live text')].map((one) => "
            "parseFloat(getComputedStyle(one).fontSize)))"
        )
        assert page.run(sizes) >= 11


@pytest.mark.parametrize("dark", [False, True])
def test_all_text_stands_out_in_both_colour_schemes(page: Any, dark: bool) -> None:
    page.media(dark=dark)
    page.settle()
    count, least = page.run(CONTRAST)
    assert count > 200 and least >= 4.5
    assert page.run("getComputedStyle(document.body).backgroundColor") == (
        "rgb(20, 24, 29)" if dark else "rgb(255, 255, 255)"
    )


def test_a_screen_reader_finds_names_for_everything(page: Any) -> None:
    nodes = page.call("Accessibility.getFullAXTree")["nodes"]
    by_role: dict[str, list[str]] = {}
    for node in nodes:
        if not node.get("ignored"):
            by_role.setdefault(node["role"]["value"], []).append(node.get("name", {}).get("value", ""))
    for role in ("button", "application", "region", "link", "heading", "table"):
        assert by_role.get(role) and all(by_role[role]), role
    assert len(by_role["main"]) == 1 and by_role["navigation"] == ["Contents"]
    assert page.run("[...document.querySelectorAll('thead th')].every((one) => one.scope === 'col')")
    ids = page.run("[...document.querySelectorAll('[id]')].map((one) => one.id)")
    assert len(set(ids)) == len(ids)
    assert page.run("document.querySelector('.skip').getAttribute('href')") == "#content"


def test_a_page_of_79_bands_is_small_and_soon_there(browser: Any, report_page: Path, tmp_path: Path) -> None:
    assert report_page.stat().st_size < 3_000_000
    (tmp_path / "empty.html").write_text("<!DOCTYPE html><title>empty</title>", encoding="utf-8")
    spent = {}
    for path in (tmp_path / "empty.html", report_page):
        opened = browser.open(path)
        # The processor time of the page's own main thread, loading, drawing and laying out.
        metrics = {one["name"]: one["value"] for one in opened.call("Performance.getMetrics")["metrics"]}
        spent[path.name] = metrics["TaskDuration"]
        loaded = opened.run("performance.getEntriesByType('navigation')[0].loadEventEnd")
        print(
            f"{path.name}: loaded after {loaded:.0f} ms, main thread {1000 * spent[path.name]:.0f} ms, "
            f"{path.stat().st_size} bytes"
        )
        opened.close()
    assert spent["report.html"] < 30 * spent["empty.html"]


def test_arrows_and_names_of_levels_are_drawn(browser: Any, tmp_path: Path) -> None:
    across = Axis("x", "um")
    series = (
        curve("orbit", [0.0, 1.0], [0.0, 1.0]),
        arrow([0.0, 0.0], [0.5, 0.5], 1),
        level(0.5, name="limit"),
    )
    sense = Panel(across, Axis("y", "um"), series)
    figure = Figure(stack([sense], 2.0), "Orbit", "An orbit")
    (tmp_path / "kinds.html").write_bytes(
        html_document(Document("T", "", (Section("F", (figure,)),), to_sign=False))
    )
    opened = browser.open(tmp_path / "kinds.html")
    texts = opened.run("[...document.querySelectorAll('.panels text')].map((one) => one.textContent)")
    assert "limit" in texts
    head = opened.run("document.querySelector('.head').getBBox().width")
    assert (
        0 < head < 20
        and opened.run("getComputedStyle(document.querySelector('.head')).fill") == "rgb(213, 94, 0)"
    )
    assert opened.said("Runtime.exceptionThrown") == []
    opened.close()


def test_keys_go_from_measured_point_to_measured_point(page: Any) -> None:
    """The fitted curve has many more points than the lines it was fitted to."""
    panel = "document.querySelectorAll('#figure-1 .panels > svg')[0]"
    page.run(f"{panel}.scrollIntoView(); {panel}.focus()")
    page.key("Home")
    places = []
    for _ in range(3):
        told = re.search(
            r"frequency ([\d.]+) Hz", page.run("document.querySelector('#figure-1 .reading').innerText")
        )
        assert told is not None
        places.append(float(told[1]))
        page.key("ArrowRight")
    assert places == [40.0, 41.0, 42.0]


def test_without_script_a_page_shows_the_numbers_and_says_why(
    browser: Any, report_page: Path, tmp_path: Path
) -> None:
    # What a browser without script makes of the page: noscript is an element as any other, and nothing draws.
    text = report_page.read_text(encoding="utf-8").replace("noscript>", "div>")
    (tmp_path / "still.html").write_text(
        re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL), encoding="utf-8"
    )
    opened = browser.open(tmp_path / "still.html")
    shown = opened.run("[...document.querySelectorAll('figure')].map((one) => one.innerText)")
    assert all(NEEDS_SCRIPT in words and words.count("\n") > 10 for words in shown) and len(shown) == 5
    opened.close()


def test_every_figure_is_on_paper_however_soon_it_is_printed(browser: Any, tmp_path: Path) -> None:
    chart = Chart((Panel(Axis("x"), Axis("y"), (curve("a", [0.0, 1.0], [0.0, 1.0]),)),))
    figures = tuple(Figure(chart, f"Figure {n}", "a line") for n in range(40))
    (tmp_path / "many.html").write_bytes(
        html_document(Document("T", "", (Section("F", figures),), to_sign=False))
    )
    opened = browser.open(tmp_path / "many.html")
    opened.run("dispatchEvent(new Event('beforeprint'))")
    assert opened.run("document.querySelectorAll('figure.alive .series .curve').length") == 40
    widths = opened.run(
        "[...document.querySelectorAll('.panels > svg')].map((one) => one.viewBox.baseVal.width)"
    )
    assert set(widths) == {680}
    opened.run("dispatchEvent(new Event('afterprint'))")
    assert opened.run("document.querySelector('.panels > svg').viewBox.baseVal.width") > 680
    opened.close()


def test_a_heat_map_has_its_colours_words_and_scale(browser: Any, tmp_path: Path) -> None:
    names = [f"stiffness of bearing {n}" for n in range(12)]
    axis = Axis(ticks=named_ticks(names))
    values = [[1.0 - abs(r - c) / 6 for c in range(12)] for r in range(12)]
    panel = Panel(axis, axis, (cells(values, [["1\nall"] * 12] * 12, "correlation"),))
    figure = Figure(Chart((panel,), size=(7.2, 6.0)), "Correlation", "A matrix")
    (tmp_path / "heat.html").write_bytes(
        html_document(Document("T", "", (Section("F", (figure,)),), to_sign=False))
    )
    opened = browser.open(tmp_path / "heat.html")
    fills = opened.run(
        "[...document.querySelectorAll('.series rect')].map((one) => getComputedStyle(one).fill)"
    )
    # The ends and the middle of ColorBrewer's PuOr.
    assert fills[0] == "rgb(45, 0, 75)" and fills[6] == "rgb(247, 247, 247)" and len(fills) == 144
    texts = opened.run("[...document.querySelectorAll('.panels text')].map((one) => one.textContent)")
    assert texts.count("1") == 145 and texts.count("all") == 144 and "correlation" in texts
    # All names stand at the axes, turned, none over another and none outside.
    assert all(texts.count(name) == 2 for name in names)
    boxes = (
        "[...document.querySelectorAll('.ticks text[transform]')].map((one) => one.getBoundingClientRect())"
    )
    edges = opened.run(f"{boxes}.map(({{left, right, bottom}}) => [left, right, bottom])")
    assert len(edges) == 12 and all(after[0] >= before[1] - 4 for before, after in pairwise(edges))
    assert max(edge[2] for edge in edges) <= opened.run(
        "document.querySelector('.panels > svg').getBoundingClientRect().bottom"
    )
    opened.close()


@pytest.mark.parametrize(
    ("limits", "unit", "logarithmic", "texts"),
    [
        ((1.0, 2.0), "N", False, ["1.0", "1.2", "1.4", "1.6", "1.8", "2.0"]),
        ((-198.0, 198.0), "deg", False, ["−180", "−90", "0", "90", "180"]),
        ((0.9, 2000.0), "N", True, ["1", "10", "100", "1000"]),
        ((9.0, 110.0), "N", True, ["10", "20", "50", "100"]),
        ((1e-9, 3e-8), "N", False, ["5 × 10⁻⁹", "10⁻⁸", "1.5 × 10⁻⁸", "2 × 10⁻⁸", "2.5 × 10⁻⁸", "3 × 10⁻⁸"]),
        (
            (1048576.5, 1048577.0),
            "N",
            False,
            ["1048576.5", "1048576.6", "1048576.7", "1048576.8", "1048576.9", "1048577.0"],
        ),
    ],
)
def test_numbers_along_an_axis_are_round(
    browser: Any,
    report_page: Path,
    limits: tuple[float, float],
    unit: str,
    logarithmic: bool,
    texts: list[str],
) -> None:
    opened = browser.open(report_page)
    axis = {"ticks": [], "log": logarithmic, "unit": unit}
    found = opened.run(
        f"(() => {{{page_part('scale.js')}; return ticksOf({json.dumps(axis)}, {json.dumps(limits)}, "
        "6).map((one) => one[1]); })()"
    )
    opened.close()
    assert found == texts

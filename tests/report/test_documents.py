"""Every format of a document, over every kind of figure; and that nothing is drawn that nobody sees."""

from __future__ import annotations

import functools
import io
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from pypdf import PdfReader

import labpipe
from labpipe.document import html_page, pdf
from labpipe.document.render import DOCUMENTS, RENDERERS
from labpipe.processes import use_processes
from labpipe.records.identification import Identification, RuleOutcome
from labpipe.report.chart import Chart, Drawing
from labpipe.report.document import Code, Document, Figure, Paragraph, Section, Table

PAGE = re.compile(rb"/Type /Page\n")
RULE = RuleOutcome("accept", "a.k > 0", 1.0, True)
RESULT = Identification(
    (),
    "Report",
    pipeline="p.yaml",
    sources=({"path": "a.csv", "sha256": "ab" * 32},),
    outcomes=(RULE,),
    version="0.1.0",
)


@pytest.fixture(scope="module")
def document(every_kind: Chart, heat_map: Chart, drawings: dict[str, Drawing]) -> Document:
    figures = tuple(
        Figure(graphic, f"Caption {n}", f"Shows {n}")
        for n, graphic in enumerate((every_kind, heat_map, *drawings.values()))
    )
    table = Table(("name", "value"), (("a|b", "1"), ("c", "2")), "Values", (1,))
    words = (Paragraph("All well.", "passed"), Paragraph("Plain *words*."), Code('{"a": 1}'))
    sections = (Section("Verdict", words), Section("Table", (table,)), Section("Figures", figures))
    return Document("Title", "Subtitle", sections, (("rig", "bench"),))


@pytest.fixture(scope="module")
def written(document: Document) -> Callable[[str], bytes]:
    """The document in a format, drawn once for all tests that look at it."""
    return functools.cache(lambda name: DOCUMENTS.load(name)(document))


@pytest.mark.parametrize("name", DOCUMENTS.names())
def test_every_format_holds_all_parts(name: str, written: Callable[[str], bytes]) -> None:
    if name == "pdf":
        assert written(name).startswith(b"%PDF-")
        return
    text = written(name).decode()
    for words in (
        "Title",
        "Subtitle",
        "All well.",
        "Values",
        *(f"Caption {n}" for n in range(5)),
        "Signature",
    ):
        assert words in text


@pytest.mark.parametrize("name", RENDERERS.names())
def test_every_format_renders_an_identification(name: str) -> None:
    assert len(RENDERERS.load(name)(RESULT)) > 500


def test_the_page_has_numbers_for_charts_and_shapes_only(
    written: Callable[[str], bytes], every_kind: Chart
) -> None:
    html = written("html").decode()
    figures = re.findall(r"<figure .*?</figure>", html, re.DOTALL)
    numbers = [re.search(r'<script type="application/json">(.*?)</script>', figure) for figure in figures]
    assert [found is not None for found in numbers] == [True, True, False, False, True]
    assert numbers[0] is not None
    panels = json.loads(numbers[0][1])["panels"]
    assert [len(panel["series"]) for panel in panels] == [len(panel.series) for panel in every_kind.panels]
    assert ["<noscript>" in figure for figure in figures] == [True, True, False, False, False]
    assert ['src="data:image/' in figure for figure in figures] == [False, False, True, True, True]
    assert "<svg" not in html and html.count("use strict") == 1


def test_a_page_without_charts_has_no_script(drawings: dict[str, Drawing]) -> None:
    document = Document(
        "T", "", (Section("Film", (Figure(drawings["film"], "The film", "film"),)),), to_sign=False
    )
    html = DOCUMENTS.load("html")(document).decode()
    assert "<script" not in html and html.count("<img") == 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("module", "function", "name", "count"),
    [(html_page, "drawing_source", "html", 1), (pdf, "canvas_of", "pdf", 2)],
)
def test_every_figure_is_drawn_once_and_the_same_each_time(
    module: object,
    function: str,
    name: str,
    count: int,
    heat_map: Chart,
    drawings: dict[str, Drawing],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    figures = tuple(Figure(graphic, "Caption", "Shows") for graphic in (heat_map, drawings["film"]))
    document = Document("T", "", (Section("Figures", figures),), to_sign=False)
    first = DOCUMENTS.load(name)(document)
    drawn: list[object] = []
    draw = getattr(module, function)
    monkeypatch.setattr(
        module, function, lambda graphic, *where: drawn.append(graphic) or draw(graphic, *where)
    )
    assert DOCUMENTS.load(name)(document) == first
    assert len(drawn) == count and len(set(map(id, drawn))) == count


def test_pages_of_a_pdf_are_a_cover_and_what_its_figures_need(
    document: Document, written: Callable[[str], bytes]
) -> None:
    # At 165 mm of width the figures are 92, 64, 66, 119 and 142 mm high, and a page holds 259 mm: behind the
    # cover the words with the first two (which leave no room for 66 mm and a caption), the next two, and the
    # last.
    assert len(PAGE.findall(written("pdf"))) == 4
    alone = replace(document, sections=document.sections[:1], to_sign=False)
    assert len(PAGE.findall(DOCUMENTS.load("pdf")(alone))) == 1


@pytest.mark.long
def test_processes_that_draw_change_no_byte(
    every_kind: Chart, drawings: dict[str, Drawing], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three figures in files of two: a page for each in its order, drawn by one process or by two."""
    monkeypatch.setattr(pdf, "MOST_TOGETHER", 2)
    graphics = [every_kind, *list(drawings.values())[:1], every_kind]
    figures = tuple(Figure(graphic, f"Caption {n}", "") for n, graphic in enumerate(graphics))
    document = Document("Title", "Subtitle", (Section("S", figures),), ())
    here = pdf.render_pdf(document)
    with use_processes(2):
        assert pdf.render_pdf(document) == here
    names = [name for page in PdfReader(io.BytesIO(here)).pages for name in page["/Resources"]["/XObject"]]
    assert [name for name in names if "Drawing" in name] == [f"/Drawing{n}" for n in range(3)]


@pytest.mark.long
def test_heat_maps_are_dots_in_a_pdf_and_curves_are_lines(every_kind: Chart, heat_map: Chart) -> None:
    for graphic, dots in ((every_kind, False), (heat_map, True)):
        content = pdf.render_pdf(
            Document("T", "", (Section("F", (Figure(graphic, "c", "a"),)),), to_sign=False)
        )
        assert (b"/Subtype /Image" in content) == dots


def test_a_drawing_of_very_many_points_is_a_picture_in_a_pdf(
    every_kind: Chart, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pdf, "MOST_POINTS", 10)
    content = pdf.render_pdf(
        Document("T", "", (Section("F", (Figure(every_kind, "c", "a"),)),), to_sign=False)
    )
    assert b"/Subtype /Image" in content


def test_markdown_is_plain_text(written: Callable[[str], bytes]) -> None:
    text = written("md").decode()
    assert (
        "> **passed**: All well." in text
        and "Plain \\*words\\*." in text
        and '```json\n{"a": 1}\n```' in text
    )
    assert (
        "| name | value |\n| --- | ---: |\n| a\\|b | 1 |" in text
        and ("*Figure (drawn in the HTML report):* Caption 0") in text
    )


def test_a_markdown_report_loads_no_matplotlib(tmp_path: Path) -> None:
    """In a process of its own: others have loaded it here."""
    code = (
        "import sys, labpipe\n"
        "from labpipe.records.identification import Identification\n"
        "labpipe.markdown_report(Identification((), 'T', version='1'))\n"
        "assert 'matplotlib' not in sys.modules and 'fpdf' not in sys.modules\n"
    )
    root = str(Path(labpipe.__file__).parents[1])
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr


def test_reports_at_the_root_are_those_of_the_table() -> None:
    assert labpipe.html_report(RESULT) == RENDERERS.load("html")(RESULT) and labpipe.markdown_report(
        RESULT
    ) == RENDERERS.load("md")(RESULT)


@pytest.mark.long
def test_many_figures_share_rows_and_no_heading_stands_alone(
    every_kind: Chart, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seven sections of 40 mm of words and two charts of 3.2 in: 212 mm and a page each one above the other,
    126 mm side by side, two a page but for the first.

    The last words of a page are its foot; before them stands no heading and no caption of a table.
    """
    chart = Chart(every_kind.panels[:1])
    canvas = pdf.canvas_of(chart)
    monkeypatch.setattr(pdf, "canvas_of", lambda *_: canvas)
    table = Table(("name", "value"), (("a", "1"), ("b", "2")), "Values", (1,))
    blocks = (
        Paragraph("Model and band. " * 20),
        table,
        Figure(chart, "First", "First"),
        Figure(chart, "Second", "Second"),
    )
    sections = tuple(Section(f"Result {n}", blocks) for n in range(7))
    pages = PdfReader(io.BytesIO(pdf.render_pdf(Document("Title", "Subtitle", sections, ())))).pages
    assert len(pages) <= 5
    few = PdfReader(io.BytesIO(pdf.render_pdf(Document("Title", "Subtitle", sections[:3], ())))).pages
    assert len(few) >= 3
    for page in (*pages, *few):
        before = page.extract_text().split("Title   page")[0].rstrip().splitlines()[-1]
        assert not before.startswith(("Result", "Values", "name"))


@pytest.mark.long
def test_a_sentence_stands_on_the_page_of_the_figure_it_leads_to(every_kind: Chart) -> None:
    """Figures of 100 mm: two fill a page but for the words before a third."""
    chart = replace(Chart(every_kind.panels[:1]), size=(6.7, 3.7))
    blocks = [(Paragraph(f"Words before {n}."), Figure(chart, f"caption {n}", "")) for n in range(5)]
    cover, all_of_them = Section("Verdict", ()), Section("All", tuple(b for pair in blocks for b in pair))
    document = Document("Title", "Subtitle", (cover, all_of_them), ())
    texts = [page.extract_text() for page in PdfReader(io.BytesIO(pdf.render_pdf(document))).pages]
    assert len(texts) > 2
    for n in range(5):
        (page,) = (text for text in texts if f"Words before {n}." in text)
        assert f"caption {n}" in page

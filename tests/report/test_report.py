"""The report is a pure function of the result: what it says, what it escapes, that it stands alone."""

from __future__ import annotations

import base64
import csv
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from fpdf import FPDF
from pypdf import PdfReader
from pypdf.generic import StreamObject

from labpipe.document import render
from labpipe.document.html_page import LONG_TABLE, render_html
from labpipe.document.pdf import pdf_report, render_pdf
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings, Sliding
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Identification, RuleOutcome
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.report.document import Document, Paragraph, Section, Table
from labpipe.report.figures import response_figure
from labpipe.report.wording import parameter_row, round_to_error, significance

HOSTILE = '<script>alert("x")</script> $y_1$ | *bold*'


def result(name: str = "pedestal", sliding: Sliding | None = None) -> Identification:
    rng = np.random.default_rng(1)
    frequency = np.arange(30.0, 100.0)
    w = 2 * np.pi * frequency
    clean = (1 / (134.5e3 - 0.79 * w**2 + 3.7j * w))[:, None, None]
    noise = 1e-7 * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)) / np.sqrt(2)
    response = FrequencyResponse(
        frequency,
        clean + noise,
        (Port(name, name, "y"),),
        (Port("f", "f", "y"),),
        covariance=diagonal_covariance(np.full(clean.shape, 1e-14)),
        name="run 1",
    )
    fits = identify(response, FitSettings("sdof", mass=0.79, name=name, sliding=sliding))
    outcome = RuleOutcome("accept", f"{name}.gof >= 0.95", 0.9999, True)
    sources = ({"path": "run.csv", "sha256": "ab" * 32},)
    return Identification(
        fits,
        f"Report of {name}",
        pipeline="p.yaml",
        sources=sources,
        settings={"frf": {"period": 1.0}},
        rig={},
        responses=(response,),
        outcomes=(outcome,),
        version="0.1.0",
    )


def html_report(identification: Identification) -> str:
    return render.html_report(identification).decode()


def markdown_report(identification: Identification) -> str:
    return render.markdown_report(identification).decode()


class Tags(HTMLParser):
    """Every tag with its attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


def test_the_verdict_comes_first_and_provenance_is_complete() -> None:
    html = html_report(result())
    headings = re.findall(r"<h2[^>]*>(.*?)</h2>", html)
    assert headings[0] == "Verdict" and headings[-3:] == ["Rig and conditions", "Provenance", "Signature"]
    assert "ACCEPTED: the one rule holds" in html
    assert "ab" * 32 in html and "labpipe 0.1.0" in html and re.search(r"frf.period</th><td>1.0</td>", html)


def test_settings_of_zero_are_stated() -> None:
    """By default windows overlap by half and a period is skipped."""
    settings = {"frf": {"overlap": 0.0, "skip": 0, "detrend": "constant"}, "identify": [{"relative": False}]}
    text = markdown_report(replace(result(), settings=settings))
    stated = [line for line in text.splitlines() if line.startswith(("| frf", "| identify"))]
    assert stated == ["| frf.overlap | 0.0 |", "| frf.skip | 0 |"]


def test_a_failed_rule_and_missing_rules_are_said() -> None:
    base = result()
    failed = replace(base, outcomes=(replace(base.outcomes[0], passed=False),))
    assert "NOT ACCEPTED: 1 of 1 rules fail" in html_report(failed)
    assert "nothing is accepted or refused" in html_report(replace(base, outcomes=()))


def test_every_warning_stands_in_words() -> None:
    base = result()
    fit = replace(base.fits[0], findings=(Finding("collinear", "k and c cannot be told apart"),))
    for text in (html_report(replace(base, fits=(fit,))), markdown_report(replace(base, fits=(fit,)))):
        assert "collinear" in text and "k and c cannot be told apart" in text


def test_names_from_files_are_escaped_everywhere() -> None:
    html = html_report(
        replace(result(), title=HOSTILE, fits=result(HOSTILE).fits, responses=result(HOSTILE).responses)
    )
    assert "<script>alert" not in html and "&lt;script&gt;" in html
    assert set(re.findall(r"<script[^>]*>", html)) == {"<script>", '<script type="application/json">'}
    markdown = markdown_report(replace(result(), title=HOSTILE))
    assert "<script>" not in markdown.replace("\\<", "") and "\\*bold\\*" in markdown


def test_the_page_asks_for_nothing_from_elsewhere() -> None:
    html = html_report(result())
    tags = Tags()
    tags.feed(html)
    assert not [tag for tag, _ in tags.tags if tag in ("link", "img", "iframe", "object", "form")]
    assert [
        attributes
        for tag, attributes in tags.tags
        if tag == "script" and attributes.get("type") != "application/json"
    ] == [{}]
    links = [
        value
        for _, attributes in tags.tags
        for key, value in attributes.items()
        if key in ("src", "href", "xlink:href")
    ]
    assert all(str(link).startswith(("#", "data:image/png;base64,")) for link in links)
    assert "@import" not in html and "url(http" not in html


def test_every_figure_tells_what_it_shows() -> None:
    tags = Tags()
    tags.feed(html_report(result()))
    figures = [attributes for tag, attributes in tags.tags if tag == "figure"]
    assert len(figures) == 2 and all(
        attributes.get("role") == "group" and attributes.get("aria-label") for attributes in figures
    )


def test_sliding_fits_are_drawn_over_frequency_and_stay_small() -> None:
    html = html_report(result(sliding=Sliding(15.0, 1.0)))
    assert "stiffness over frequency, 55 bands" in html and "damping over frequency" in html
    assert len(html) < 1e6


def test_same_result_same_bytes() -> None:
    assert html_report(result()) == html_report(result())


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (134.49812, 0.0086, "134.4981"),
        (3.70808, 0.021, "3.708"),
        (134498.12, 860.0, "134500"),
        (5.0, None, "5"),
        (0.0056878, 3.2e-5, "0.005688"),
        (float("nan"), 1.0, "not determined"),
    ],
)
def test_values_are_rounded_to_what_their_error_supports(
    value: float, error: float | None, text: str
) -> None:
    assert round_to_error(value, error) == text


def test_stars_follow_the_t_distribution() -> None:
    # Student's t with 40 degrees of freedom: two-sided p of 0.05, 0.01, 0.001 at 2.021, 2.704, 3.551 (printed
    # tables).
    marks = [
        significance(Parameter("k", t, "N/m", std_error=1.0, t_ratio=t), 40) for t in (2.0, 2.03, 2.71, 3.56)
    ]
    assert marks == ["n.s.", "*", "**", "***"]


def test_a_parameter_without_an_error_shows_none() -> None:
    row = parameter_row(Parameter("linear_range", 0.2, "1", derived=True), 5)
    assert row == ("linear_range", "0.2", "", "none", "none", "", "derived", "")


@pytest.mark.long
def test_the_pdf_has_pages_with_numbers_and_is_the_same_each_time() -> None:
    first, second = pdf_report(result()), pdf_report(result())
    assert first.startswith(b"%PDF-") and first == second
    assert first.count(b"/Type /Page\n") >= 3


def test_the_pdf_has_a_cover_with_the_dates_of_the_recordings_and_lines_instead_of_dots() -> None:
    from labpipe.report.cover import cover_facts

    base = result()
    responses = tuple(
        replace(base.responses[0], conditions={"date": day, "preload": "427 N", "speed": speed, "oil": oil})
        for day, speed, oil in (("2026-03-02", "12000rpm", "warm"), ("2026-02-27", "50 Hz", "cold"))
    )
    facts = dict(cover_facts([replace(base, responses=responses)]))
    assert facts["recorded"] == "2026-02-27 to 2026-03-02" and facts["preload"] == "427 N"
    assert facts["speed"] == "50 Hz, 12000rpm" and facts["oil"] == "warm, cold"
    assert facts["pipeline"] == "p.yaml" and facts["computed by"] == "labpipe 0.1.0" and "rig" not in facts
    # The correlation of two estimates is a sentence; no picture of dots stands for it.
    assert b"/Subtype /Image" not in pdf_report(base)


def test_many_recorded_conditions_are_a_range() -> None:
    from labpipe.report.cover import cover_facts

    base = result()
    oils = [f"{45 + (7 * n) % 12 / 100:.2f} degC +- 0.1 K" for n in range(12)]
    responses = tuple(replace(base.responses[0], conditions={"oil": oil}) for oil in oils)
    facts = dict(cover_facts([replace(base, responses=responses)]))
    assert facts["oil"] == "45.00 degC +- 0.1 K to 45.11 degC +- 0.1 K, 12 values"


def test_one_fit_of_one_test_is_three_pages_and_its_response_stands_once() -> None:
    """Its figure, with phase and residual, is on the first page."""
    base = result()
    fit = identify(base.responses[0], FitSettings("sdof", name="free"))[0]
    warned = replace(fit, findings=tuple(Finding(f"code-{n}", 8 * "what a warning says; ") for n in range(4)))
    one = replace(base, fits=(warned,), outcomes=())
    pages = PdfReader(io.BytesIO(pdf_report(one))).pages
    assert len(pages) <= 3 and "Figure 1. free" in pages[0].extract_text()
    assert markdown_report(one).count("measured (dots) and fitted (lines)") == 1
    two = replace(base, fits=(fit, replace(fit, name="again")))
    assert markdown_report(two).count("measured (dots) and fitted (lines)") == 2


def test_drawings_share_a_page_as_streams_in_a_row() -> None:
    """ISO 32000-1, 7.7.3.3: a page's content is a stream or a list of streams; of a list in a list readers
    show nothing.
    """
    figures = 2 * (response_figure(result().responses[0]),)
    (page,) = PdfReader(
        io.BytesIO(render_pdf(Document("T", "", (Section("S", figures),), to_sign=False)))
    ).pages
    parts = page.raw_get("/Contents")
    assert len(parts) == 3 and all(isinstance(part.get_object(), StreamObject) for part in parts)


def test_lines_of_a_pdf_break_where_fpdf2_breaks_them() -> None:
    """fpdf2's multi_cell on its own, in the same font on the same page, says the lines."""
    rng = np.random.default_rng(1)
    words = ["".join(rng.choice(list("abcdefgW"), n)) for n in rng.integers(1, 18, 300)]
    text = " ".join([*words[:200], 400 * "W", *words[200:]])
    peer = FPDF(format="A4")
    peer.set_margins(20, 18, 20)
    peer.add_page()
    peer.add_font("D", "", Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf")
    peer.set_font("D", "", 9)
    expected = peer.multi_cell(0, 4.5, text, dry_run=True, output="LINES", align="L")
    peer.output()  # closes the file of the font
    document = Document("T", "", (Section("S", (Paragraph(text),)),), to_sign=False)
    (page,) = PdfReader(io.BytesIO(render_pdf(document))).pages
    printed = [line.strip() for line in page.extract_text().split("\n")]
    first = printed.index(expected[0].strip())
    assert printed[first : first + len(expected)] == [line.strip() for line in expected]


def test_a_table_of_a_pdf_breaks_no_word_and_goes_on_behind_a_full_page() -> None:
    names = ("fit", "noise", "success", "coverage", "signature", "transmissibility")
    rows = [tuple(f"{0.0123456789 * n:.8f}" for _ in names) for n in range(1, 3)]
    long = tuple(" ".join(f"w{n}" for n in range(600)) for _ in names)
    document = Document("T", "", (Section("S", (Table(names, (*rows, long)),)),), to_sign=False)
    texts = [page.extract_text() for page in PdfReader(io.BytesIO(render_pdf(document))).pages]
    assert len(texts) > 1
    # The head comes again on each page.
    for text in texts:
        assert {name: text.split().count(name) for name in names} == dict.fromkeys(names, 1)
    for row in rows:
        assert texts[0].split().count(row[0]) == len(names)
    found = [word for text in texts for word in text.split() if word[0] == "w"]
    assert sorted(found) == sorted(6 * [f"w{n}" for n in range(600)])


def test_the_signs_are_explained_once_and_the_correlation_of_few_in_words() -> None:
    base = result()
    text = html_report(replace(base, fits=(base.fits[0], replace(base.fits[0], name="again"))))
    assert text.count("Significance of the difference from zero") == 1
    assert text.count("Correlation between the estimates of") == 2 and "Correlation matrix" not in text


def test_a_long_table_is_folded_and_stands_in_full_in_its_csv() -> None:
    rows = tuple((str(n), f"{n}.5, or so") for n in range(LONG_TABLE))
    rows = (*rows, ("=1+1", "no formula to a spreadsheet"))
    tables = (Table(("band", "value"), chosen, "Bands") for chosen in (rows, rows[1:]))
    long, short = (render_html(Document("T", "", (Section("S", (table,)),))) for table in tables)
    assert "<details" not in short and f"<summary>Bands: {len(rows)} rows</summary>" in long
    content = base64.b64decode(re.search(r'data:text/csv;base64,([^"]+)"', long)[1]).decode()
    read = list(csv.reader(io.StringIO(content)))
    assert read == [["band", "value"], *(list(row) for row in rows[:-1]), ["'=1+1", rows[-1][1]]]

"""A document as one HTML page that opens without a network: style, script, numbers and drawings inside,
nothing fetched.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import re
from functools import cache
from html import escape
from importlib.resources import files

from labpipe.artefacts.writing import cell
from labpipe.display import as_printed
from labpipe.document.figure_numbers import figure_json, figure_table, json_text, shape_numbers, short_name
from labpipe.report.chart import Chart, Drawing, Graphic
from labpipe.report.document import Block, Code, Document, Figure, Paragraph, Section, Table
from labpipe.report.figures import KIND as SHAPES

NEEDS_SCRIPT = "This figure is drawn by the script of the page, which does not run here. Its numbers:"
SCRIPTS = ("scale.js", "panel.js", "reading.js", "zoom.js", "choose.js", "figure.js", "shape.js")
# Many sections need a way to them; few do not.
LEAST_LISTED = 4
LONG_FRACTION = re.compile(r"(\.\d\d)\d+")
# Bytes of lines beyond which a drawing is of dots: half a megabyte is what these take in print resolution.
MOST_LINES = 500_000
# Rows of a table beyond which it is folded.
LONG_TABLE = 30


@cache
def page_part(name: str) -> str:
    """A file of the page: its style or a part of its script."""
    return files("labpipe.document").joinpath("page", name).read_text(encoding="utf-8")


@cache
def script_text() -> str:
    """The page's script: its parts in one function without global names."""
    return '(() => {\n"use strict";\n' + "\n".join(page_part(name) for name in SCRIPTS) + "})();\n"


def policy() -> str:
    """What the page may do: run this script, style itself, show embedded pictures; no request to anywhere."""
    digest = base64.b64encode(hashlib.sha256(script_text().encode()).digest()).decode()
    may = (f"script-src 'sha256-{digest}'", "style-src 'unsafe-inline'", "img-src data:")
    return "; ".join(("default-src 'none'", *may, "base-uri 'none'", "form-action 'none'"))


def render_html(document: Document) -> str:
    counter = _Figures()
    sections = "\n".join(_section(n, section, counter) for n, section in enumerate(document.signed, 1))
    script = f"<script>{script_text()}</script>\n" if counter.alive else ""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(policy())}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(document.title)}</title>\n"
        f"<style>\n{page_part('report.css')}</style></head>\n<body>\n"
        '<a class="skip" href="#content">Skip to the content</a>\n<main id="content">\n'
        f"<header><h1>{escape(document.title)}</h1><p>{escape(document.subtitle)}</p></header>\n"
        f"{_contents(document)}{sections}\n</main>\n{script}</body></html>\n"
    )


class _Figures:
    def __init__(self) -> None:
        self.count, self.alive = 0, False

    def html(self, figure: Figure) -> str:
        """A figure with its number: numbers for the script, what is shown without it, the caption."""
        self.count += 1
        graphic, name = figure.graphic, escape(figure.alternative)
        living = live_json(graphic)
        self.alive |= living is not None
        kind, numbers = "", ""
        if living is not None:
            kind = f' class="{living[0]}"'
            numbers = f'<script type="application/json">{living[1]}</script>'
        if isinstance(graphic, Chart):
            still = f"<noscript><p>{NEEDS_SCRIPT}</p>{_whole(figure_table(graphic))}</noscript>"
        else:
            still = f'<div class="static"><img alt="{name}" src="{drawing_source(graphic)}"></div>'
        caption = escape(as_printed(figure.caption))
        return (
            f'<figure id="figure-{self.count}" role="group" aria-label="{name}"{kind}>{still}{numbers}'
            f"<figcaption><b>Figure {self.count}.</b> {caption}</figcaption></figure>"
        )


def live_json(graphic: Graphic) -> tuple[str, str] | None:
    """(class of the figure, numbers) for the script of the page; None for what is a drawing only."""
    if isinstance(graphic, Chart):
        return "numbers", figure_json(graphic)
    return ("shapes", json_text(shape_numbers(graphic.subject))) if graphic.kind == SHAPES else None


def drawing_source(drawing: Drawing) -> str:
    """A drawing as the source of an image inside the page: lines, or dots where these are too many."""
    # Matplotlib, which takes its time to load, is for drawings alone.
    from labpipe.document.charts import canvas_of, png_bytes, svg_text

    canvas = canvas_of(drawing)
    # A hundredth of a point is less than a screen shows.
    kind, content = "svg+xml", LONG_FRACTION.sub(r"\1", svg_text(canvas)).encode()
    if len(content) > MOST_LINES:
        kind, content = "png", png_bytes(canvas)
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _contents(document: Document) -> str:
    if len(document.signed) < LEAST_LISTED:
        return ""
    entries = "".join(
        f'<li><a href="#section-{n}">{escape(section.heading)}</a></li>'
        for n, section in enumerate(document.signed, 1)
    )
    return f'<nav aria-label="Contents"><ul>{entries}</ul></nav>\n'


def _section(number: int, section: Section, counter: _Figures) -> str:
    blocks = "\n".join(_block(block, counter) for block in section.blocks)
    head = f'<h2 id="section-{number}">{escape(section.heading)}</h2>'
    return f'<section aria-labelledby="section-{number}">{head}\n{blocks}</section>'


def _block(block: Block, counter: _Figures) -> str:
    if isinstance(block, Paragraph):
        kind = f' class="{escape(block.kind)}"' if block.kind else ""
        return f"<p{kind}>{escape(as_printed(block.text))}</p>"
    if isinstance(block, Code):
        return f'<pre tabindex="0">{escape(block.text)}</pre>'
    return counter.html(block) if isinstance(block, Figure) else _table(block)


def _table(table: Table) -> str:
    whole = _whole(table)
    return whole if len(table.rows) <= LONG_TABLE else _fold(table, escape(_name(table)), whole)


def _name(table: Table) -> str:
    return table.caption or ", ".join(table.header)


def _whole(table: Table) -> str:
    caption = f"<caption>{escape(as_printed(table.caption))}</caption>" if table.caption else ""
    heads = "".join(
        f'<th scope="col"{_mark(table, n)}>{escape(as_printed(text))}</th>'
        for n, text in enumerate(table.header)
    )
    rows = ("".join(_cell(table, n, text) for n, text in enumerate(row)) for row in table.rows)
    body = "\n".join(f"<tr>{cells}</tr>" for cells in rows)
    name = escape(_name(table))
    is_blank = table.rows and not any(text.strip() for row in table.rows for text in row)
    blank = ' class="signature"' if is_blank else ""
    named = "" if table.caption else f' aria-label="{name}"'
    whole = f"<table{blank}{named}>{caption}<thead><tr>{heads}</tr></thead>\n<tbody>{body}</tbody></table>"
    return f'<div class="wide" tabindex="0" role="region" aria-label="{name}">{whole}</div>'


def _fold(table: Table, name: str, whole: str) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(map(cell, row) for row in (table.header, *table.rows))
    content = base64.b64encode(stream.getvalue().encode()).decode("ascii")
    file = f"{short_name(table.caption or 'table')}.csv"
    link = f'<a download="{file}" href="data:text/csv;base64,{content}">CSV</a>'
    summary = f"<summary>{name}: {len(table.rows)} rows</summary>"
    return f'<details class="long">{summary}\n<p>{link}</p>\n{whole}</details>'


def _cell(table: Table, column: int, text: str) -> str:
    if column == 0 and text.strip():
        return f'<th scope="row"{_mark(table, 0)}>{escape(as_printed(text))}</th>'
    return f"<td{_mark(table, column)}>{escape(as_printed(text))}</td>"


def _mark(table: Table, column: int) -> str:
    return ' class="number"' if column in table.numeric else ""

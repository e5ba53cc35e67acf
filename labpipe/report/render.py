"""A document as HTML or Markdown. RENDERERS by format: each turns an identification into the bytes of a file."""

from __future__ import annotations

from html import escape
from importlib.resources import files

from labpipe.records.identification import Identification
from labpipe.registry import Registry
from labpipe.report.build import build
from labpipe.report.document import Block, Code, Document, Figure, Paragraph, Table
from labpipe.report.drawing import svg_text

RENDERERS = Registry(
    "report format",
    {
        "html": "labpipe.report.render:html_report",
        "md": "labpipe.report.render:markdown_report",
        "pdf": "labpipe.report.pdf:pdf_report",
    },
)


def html_report(identification: Identification) -> bytes:
    """One HTML file that opens offline: style and drawings inside, nothing fetched, names from files escaped."""
    return render_html(build(identification)).encode()


def markdown_report(identification: Identification) -> bytes:
    """The same report as Markdown; drawings are named by their captions."""
    return render_markdown(build(identification)).encode()


def render_html(document: Document) -> str:
    """The document as HTML."""
    style = files("labpipe.report").joinpath("report.css").read_text(encoding="utf-8")
    sections = "\n".join(
        f"<section><h2>{escape(section.heading)}</h2>\n" + "\n".join(_html(block) for block in section.blocks) + "</section>"
        for section in document.sections
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(document.title)}</title>\n<style>\n{style}</style></head>\n<body><main>\n"
        f"<header><h1>{escape(document.title)}</h1><p>{escape(document.subtitle)}</p></header>\n{sections}\n</main></body></html>\n"
    )


def _html(block: Block) -> str:
    if isinstance(block, Paragraph):
        return f'<p class="{escape(block.kind)}">{escape(block.text)}</p>' if block.kind else f"<p>{escape(block.text)}</p>"
    if isinstance(block, Code):
        return f"<pre>{escape(block.text)}</pre>"
    if isinstance(block, Figure):
        drawing = svg_text(block.drawing).replace("<svg", f'<svg role="img" aria-label="{escape(block.alternative)}"', 1)
        return f"<figure>{drawing}<figcaption>{escape(block.caption)}</figcaption></figure>"
    return _html_table(block)


def _html_table(table: Table) -> str:
    def row(cells: tuple[str, ...], tag: str) -> str:
        marked = ((' class="number"' if n in table.numeric else "", cell) for n, cell in enumerate(cells))
        return "<tr>" + "".join(f"<{tag}{mark}>{escape(cell)}</{tag}>" for mark, cell in marked) + "</tr>"

    body = "\n".join(row(cells, "td") for cells in table.rows)
    caption = f"<caption>{escape(table.caption)}</caption>" if table.caption else ""
    return f'<div class="wide"><table>{caption}<thead>{row(table.header, "th")}</thead>\n<tbody>{body}</tbody></table></div>'


def render_markdown(document: Document) -> str:
    """The document as Markdown."""
    parts = [f"# {_md(document.title)}", _md(document.subtitle)]
    for section in document.sections:
        parts.append(f"## {_md(section.heading)}")
        parts.extend(_markdown(block) for block in section.blocks)
    return "\n\n".join(parts) + "\n"


def _markdown(block: Block) -> str:
    if isinstance(block, Paragraph):
        return f"> **{block.kind}**: {_md(block.text)}" if block.kind else _md(block.text)
    if isinstance(block, Code):
        return "```json\n" + block.text + "\n```"
    if isinstance(block, Figure):
        return f"*Figure (drawn in the HTML report):* {_md(block.caption)}"
    rows = [block.header, tuple("---:" if n in block.numeric else "---" for n in range(len(block.header))), *block.rows]
    lines = ["| " + " | ".join(cell if set(cell) <= set("-:") else _md(cell) for cell in row) + " |" for row in rows]
    return (f"*{_md(block.caption)}*\n\n" if block.caption else "") + "\n".join(lines)


def _md(text: str) -> str:
    """Text in which nothing is markup."""
    for sign in "\\`*_[]<>|#":
        text = text.replace(sign, f"\\{sign}")
    return text.replace("\n", " ")

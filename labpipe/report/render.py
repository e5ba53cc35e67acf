"""A document as HTML or Markdown. RENDERERS by format: each turns an identification into the bytes of a file."""

from __future__ import annotations

from labpipe.records.identification import Identification
from labpipe.registry import Registry
from labpipe.report.build import build
from labpipe.report.document import Block, Code, Document, Figure, Paragraph
from labpipe.report.html_page import render_html

RENDERERS = Registry(
    "report format",
    {
        "html": "labpipe.report.render:html_report",
        "md": "labpipe.report.render:markdown_report",
        "pdf": "labpipe.report.pdf:pdf_report",
    },
)

# The same for documents that are not of one identification.
DOCUMENTS = Registry(
    "report format",
    {
        "html": "labpipe.report.render:html_document",
        "md": "labpipe.report.render:markdown_document",
        "pdf": "labpipe.report.pdf:render_pdf",
    },
)


def html_document(document: Document) -> bytes:
    """A document as the bytes of an HTML file."""
    return render_html(document).encode()


def markdown_document(document: Document) -> bytes:
    """A document as the bytes of a Markdown file."""
    return render_markdown(document).encode()


def html_report(identification: Identification) -> bytes:
    """One HTML file that opens offline: style and drawings inside, nothing fetched, names from files escaped."""
    return render_html(build(identification)).encode()


def markdown_report(identification: Identification) -> bytes:
    """The same report as Markdown; drawings are named by their captions."""
    return render_markdown(build(identification)).encode()


def render_markdown(document: Document) -> str:
    """The document as Markdown."""
    parts = [f"# {_md(document.title)}", _md(document.subtitle)]
    for section in document.signed:
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

"""A report in the format of a file, Markdown among them. RENDERERS by format: identification -> the bytes of
a file.
"""

from __future__ import annotations

from labpipe.display import as_printed
from labpipe.document.html_page import render_html
from labpipe.records.identification import Identification
from labpipe.registry import Registry
from labpipe.report.build import build
from labpipe.report.document import Block, Code, Document, Figure, Paragraph

RENDERERS = Registry("report format")

# The same for documents that are not of one identification.
DOCUMENTS = Registry("document format")


def html_document(document: Document) -> bytes:
    """A document as the bytes of one HTML file that opens offline."""
    return render_html(document).encode()


def markdown_document(document: Document) -> bytes:
    """A document as the bytes of a Markdown file, figures by their captions."""
    parts = [f"# {_plain(document.title)}", _plain(document.subtitle)]
    for section in document.signed:
        parts.append(f"## {_plain(section.heading)}")
        parts.extend(_markdown(block) for block in section.blocks)
    return ("\n\n".join(parts) + "\n").encode()


def html_report(identification: Identification) -> bytes:
    """The report of an identification as the bytes of one HTML file that opens offline."""
    return html_document(build(identification))


def markdown_report(identification: Identification) -> bytes:
    """The same report as Markdown."""
    return markdown_document(build(identification))


def _markdown(block: Block) -> str:
    if isinstance(block, Paragraph):
        return f"> **{block.kind}**: {_plain(block.text)}" if block.kind else _plain(block.text)
    if isinstance(block, Code):
        return "```json\n" + block.text + "\n```"
    if isinstance(block, Figure):
        return f"*Figure (drawn in the HTML report):* {_plain(block.caption)}"
    rule = ("---:" if n in block.numeric else "---" for n in range(len(block.header)))
    rows = [block.header, rule, *block.rows]
    cells = [[cell if set(cell) <= set("-:") else _plain(cell) for cell in row] for row in rows]
    lines = [f"| {' | '.join(row)} |" for row in cells]
    return (f"*{_plain(block.caption)}*\n\n" if block.caption else "") + "\n".join(lines)


def _plain(text: str) -> str:
    text = as_printed(text)
    for sign in "\\`*_[]<>|#":
        text = text.replace(sign, f"\\{sign}")
    return text.replace("\n", " ")

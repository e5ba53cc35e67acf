"""A report in the format of a file. RENDERERS by format: each turns an identification into the bytes of a file."""

from __future__ import annotations

from labpipe.document.html_page import render_html
from labpipe.records.identification import Identification
from labpipe.registry import Registry
from labpipe.report.build import build
from labpipe.report.document import Document

RENDERERS = Registry(
    "report format",
    {
        "html": "labpipe.document.render:html_report",
        "md": "labpipe.document.render:markdown_report",
        "pdf": "labpipe.document.pdf:pdf_report",
    },
)

# The same for documents that are not of one identification.
DOCUMENTS = Registry(
    "report format",
    {
        "html": "labpipe.document.render:html_document",
        "md": "labpipe.document.render:markdown_document",
        "pdf": "labpipe.document.pdf:render_pdf",
    },
)


def html_document(document: Document) -> bytes:
    """A document as the bytes of an HTML file that opens offline: style and drawings inside, nothing fetched, names from files escaped."""
    return render_html(document).encode()


def markdown_document(document: Document) -> bytes:
    """A document as the bytes of a Markdown file; drawings are named by their captions."""
    from labpipe.document.markdown import render_markdown

    return render_markdown(document).encode()


def html_report(identification: Identification) -> bytes:
    """The report of an identification as the bytes of one HTML file that opens offline."""
    return html_document(build(identification))


def markdown_report(identification: Identification) -> bytes:
    """The same report as Markdown."""
    return markdown_document(build(identification))

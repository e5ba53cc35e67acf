"""A document as PDF on A4 with page numbers, set in the font that comes with matplotlib."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import matplotlib as mpl
from fpdf import FPDF
from fpdf.enums import TableBordersLayout
from fpdf.fonts import FontFace

from labpipe.records.identification import Identification
from labpipe.report.build import build
from labpipe.report.document import Block, Code, Document, Figure, Paragraph, Table
from labpipe.report.drawing import png_bytes

FONT = "DejaVu"
INK, GREY, SOFT = (27, 31, 36), (87, 96, 106), (244, 246, 248)
TONES = {"passed": (11, 110, 79), "failed": (168, 50, 30), "warning": (138, 90, 0), "note": GREY}
# Without a clock in it the same result gives the same file.
EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
WIDEST_FIGURE = 165.0


class _Pages(FPDF):
    """A4 pages whose foot names the document and counts the pages."""

    def __init__(self, document: Document) -> None:
        super().__init__(format="A4")
        self._foot = document.title
        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
        self.add_font(FONT, "", fonts / "DejaVuSans.ttf")
        self.add_font(FONT, "B", fonts / "DejaVuSans-Bold.ttf")
        self.set_margins(20, 18, 20)
        self.set_auto_page_break(True, margin=20)
        self.set_creation_date(EPOCH)
        self.set_title(document.title)

    def footer(self) -> None:
        self.set_y(-14)
        self.set_font(FONT, "", 7)
        self.set_text_color(*GREY)
        self.cell(0, 5, f"{self._foot[:90]}   page {self.page_no()} of {{nb}}", align="C")


def pdf_report(identification: Identification) -> bytes:
    """The report of an identification as the bytes of a PDF file."""
    document = build(identification)
    pages = _Pages(document)
    pages.add_page()
    _text(pages, document.title, 17, bold=True)
    _text(pages, document.subtitle, 9, colour=GREY)
    for section in document.sections:
        pages.ln(3)
        if pages.will_page_break(30):
            pages.add_page()
        _text(pages, section.heading, 12, bold=True)
        pages.line(20, pages.get_y(), 190, pages.get_y())
        pages.ln(2)
        for block in section.blocks:
            _put(pages, block)
    return bytes(pages.output())


def _text(pages: FPDF, text: str, size: float, *, bold: bool = False, colour: tuple[int, int, int] = INK) -> None:
    pages.set_font(FONT, "B" if bold else "", size)
    pages.set_text_color(*colour)
    pages.multi_cell(0, size * 0.5, text, new_x="LMARGIN", new_y="NEXT", align="L")


def _put(pages: FPDF, block: Block) -> None:
    if isinstance(block, Paragraph):
        _text(pages, block.text, 9, bold=block.kind in ("passed", "failed"), colour=TONES.get(block.kind, INK))
        pages.ln(1.5)
    elif isinstance(block, Code):
        _text(pages, block.text, 6, colour=GREY)
    elif isinstance(block, Figure):
        _figure(pages, block)
    elif block.rows:
        _table(pages, block)


def _figure(pages: FPDF, figure: Figure) -> None:
    """A drawing in its own size, at most as wide as the text; caption below it on the same page."""
    inches_wide, inches_high = figure.drawing.get_size_inches()
    width = min(25.4 * inches_wide, WIDEST_FIGURE)
    height = width * inches_high / inches_wide
    if pages.will_page_break(height + 10):
        pages.add_page()
    pages.image(png_bytes(figure.drawing), w=width, alt_text=figure.alternative)
    _text(pages, figure.caption, 8, colour=GREY)
    pages.ln(2)


def _table(pages: FPDF, table: Table) -> None:
    """A table whose columns share the width by their longest text; its head comes again on each page."""
    if table.caption:
        _text(pages, table.caption, 8.5, bold=True)
    pages.set_font(FONT, "", 7)
    pages.set_text_color(*INK)
    longest = [max(len(row[n]) for row in (table.header, *table.rows)) for n in range(len(table.header))]
    aligned = tuple("RIGHT" if n in table.numeric else "LEFT" for n in range(len(table.header)))
    with pages.table(
        col_widths=[min(max(length, 5), 40) for length in longest],
        text_align=aligned,
        line_height=4.2,
        borders_layout=TableBordersLayout.HORIZONTAL_LINES,
        headings_style=FontFace(emphasis="BOLD", fill_color=SOFT),
    ) as drawn:
        for row in (table.header, *table.rows):
            drawn.row([cell or " " for cell in row])
    pages.ln(2)

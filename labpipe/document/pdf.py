"""A document as PDF on A4 with page numbers, set in the font that comes with matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeGuard

import matplotlib as mpl
from fpdf import FPDF
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure as Canvas
from pypdf import PageObject, PdfReader, PdfWriter
from pypdf.generic import (
    ArrayObject,
    DecodedStreamObject,
    DictionaryObject,
    FloatObject,
    IndirectObject,
    NameObject,
    StreamObject,
)

from labpipe.display import as_printed
from labpipe.document.charts import STYLE, Frame, Layout, Words, canvas_of, laid_out, png_bytes
from labpipe.processes import SHARED_OUT, pool_of
from labpipe.records.identification import Identification
from labpipe.report.build import build
from labpipe.report.chart import Chart, Graphic
from labpipe.report.document import SIGNATURE, Block, Code, Document, Figure, Paragraph, Table

FONT = "DejaVu"
INK, GREY, SOFT, PAPER = (27, 31, 36), (87, 96, 106), (244, 246, 248), (255, 255, 255)
TONES = {"passed": (11, 110, 79), "failed": (168, 50, 30), "warning": (138, 90, 0), "note": GREY}
# Without a clock in it the same result gives the same file.
EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
LINE = (190, 196, 203)
WIDEST_FIGURE = 165.0
# Figures of a document beyond which two share a row, and their width and largest height then [in].
MANY_FIGURES, HALF, HALF_HEIGHT = 12, 3.25, 3.0
# What a table needs on the page on which it begins: caption, head and a row [mm].
TABLE_HEAD = 24.0
# A line of text in a table [mm], and the most lines of a row on one page.
ROW, MOST_LINES = 4.2, 45
# Most that is kept together with a heading [mm].
HIGHEST = 150.0
# Drawings of one file that a process makes, with the same fonts; a report of more can be shared out.
MOST_TOGETHER = 60
# Points of a drawing beyond which a picture of dots opens faster.
MOST_POINTS = 30_000
# Text of drawings stays text, in fonts of outlines.
VECTOR = {**STYLE, "pdf.fonttype": 42}
# Points [pt] in a millimetre.
POINT = 72 / 25.4
# Keeps the room of a figure, with its words for those who do not see it.
ROOM = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {} {}"></svg>'


@dataclass(frozen=True)
class _DrawingPlace:
    """Where a drawing goes: *page* from 0, its lower left corner [pt] and its *scale* [1]."""

    page: int
    left: float
    low: float
    scale: float


class _Pages(FPDF):
    def __init__(self, document: Document) -> None:
        super().__init__(format="A4")
        self._foot = document.title
        self.figures = 0
        # Where the drawings go, those that nobody draws yet, and what gives the files of the others.
        self.places: list[_DrawingPlace] = []
        self.waiting: list[Graphic] = []
        self.files: list[Callable[[], bytes]] = []
        self.pool: Executor | None = None
        # Widths of words in a font style, over the size of the font [mm/pt].
        self._widths: dict[tuple[str, str], float] = {}
        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
        self.add_font(FONT, "", fonts / "DejaVuSans.ttf")
        self.add_font(FONT, "B", fonts / "DejaVuSans-Bold.ttf")
        self.set_margins(20, 18, 20)
        self.set_auto_page_break(True, margin=20)
        self.set_creation_date(EPOCH)
        self.set_title(document.title)

    def footer(self) -> None:
        """The title and the number of the page at its foot."""
        self.set_y(-14)
        self.set_font(FONT, "", 7)
        self.set_text_color(*GREY)
        self.cell(0, 5, f"{self._foot[:90]}   page {self.page_no()} of {{nb}}", align="C")

    def lines_of(self, text: str, width: float) -> list[str]:
        """A text in lines that fit into a cell of *width* [mm] in the present font.

        fpdf2 breaks lines too, but measures a whole line anew at each of its blanks.
        """
        # A column is just as wide as its widest word, but for rounding.
        room, blank = (width - 2 * self.c_margin) / self.font_size_pt + 1e-6, self.width_of(" ")
        lines: list[str] = []
        for paragraph in text.split("\n"):
            line, used = None, 0.0
            for word in paragraph.split(" "):
                wide = self.width_of(word)
                if line is not None and used + blank + wide <= room:
                    line, used = f"{line} {word}", used + blank + wide
                    continue
                full, rest = self._cut(word, room)
                lines += full if line is None else [line, *full]
                line, used = rest, self.width_of(rest)
            lines.append(line or "")
        return lines

    def _cut(self, word: str, room: float) -> tuple[list[str], str]:
        full = []
        while self.width_of(word) > room and len(word) > 1:
            n = next((n for n in range(len(word) - 1, 1, -1) if self.width_of(word[:n]) <= room), 1)
            full.append(word[:n])
            word = word[n:]
        return full, word

    def width_of(self, word: str) -> float:
        """The width of a word over the size of the font [mm/pt]."""
        key = self.font_style, word
        if key not in self._widths:
            self._widths[key] = self.get_string_width(word) / self.font_size_pt
        return self._widths[key]

    def write_lines(self, lines: Sequence[str], width: float, height: float, align: str = "L") -> None:
        """Lines of *height* below each other, in a cell of *width* [mm] that begins here."""
        x = self.get_x()
        for line in lines:
            self.set_x(x)
            self.cell(width, height, line, align=align, new_x="LMARGIN", new_y="NEXT")

    def begin_drawing(self) -> None:
        """Let a process draw what waits, or draw it when its file is asked for."""
        draw = partial(drawings_file, tuple(self.waiting))
        self.files.append(draw if self.pool is None else self.pool.submit(draw).result)
        self.waiting.clear()


def drawings_file(graphics: Sequence[Graphic]) -> bytes:
    """A PDF file with a page for each of the *graphics*; charts alike share their canvas and layout."""
    canvases: dict[Frame, Canvas] = {}
    layouts: dict[Words, Layout] = {}
    drawn = io.BytesIO()
    with mpl.rc_context(VECTOR), PdfPages(drawn, metadata={"CreationDate": None}) as file:
        for graphic in graphics:
            canvas = laid_out(canvas_of(graphic, canvases), layouts if isinstance(graphic, Chart) else None)
            canvas.savefig(file, format="pdf")
    return drawn.getvalue()


def pdf_report(identification: Identification) -> bytes:
    """The report of an identification as the bytes of a PDF file."""
    return render_pdf(build(identification))


# Where the place to sign begins, near the foot of the page [mm].
SIGNATURE_AT = 260


def render_pdf(document: Document) -> bytes:
    """The document as PDF: a cover to sign (or just its title), then every section.

    Headings are the file's bookmarks. The same bytes whatever the number of processes that draw, which is
    that of `processes.use_processes`.
    """
    pages = _Pages(document)
    count = sum(isinstance(block, Figure) for section in document.sections for block in section.blocks)
    with pool_of(SHARED_OUT.get() if count > MOST_TOGETHER else 1) as pages.pool:
        _lay_out(pages, document, count > MANY_FIGURES)
        return _with_drawings(pages)


def _lay_out(pages: _Pages, document: Document, many: bool) -> None:
    pages.add_page()
    if document.to_sign:
        _cover(pages, document)
        # A cover that was too full for it has the place to sign on the next page, where the report goes on.
        if pages.page == 1:
            pages.add_page()
    else:
        _title(pages, document)
    for section in document.sections[1 if document.to_sign else 0 :]:
        pages.ln(3)
        first, second = (*section.blocks[:2], None, None)[:2]
        if pages.will_page_break(_height_of(pages, first, second)):
            pages.add_page()
        pages.start_section(section.heading)
        _text(pages, section.heading, 12, bold=True)
        pages.line(20, pages.get_y(), 190, pages.get_y())
        pages.ln(2)
        blocks = [*_pair_figures(section.blocks)] if many else section.blocks
        for block, after in zip(blocks, (*blocks[1:], None), strict=True):
            # What introduces a figure or a table does not end a page.
            leads = isinstance(block, Paragraph) and isinstance(after, Figure | Table)
            if leads and pages.will_page_break(_height_of(pages, block, after)):
                pages.add_page()
            _put(pages, block)


def _pair_figures(blocks: Sequence[Block]) -> Iterator[Block | tuple[Figure, Figure]]:
    left = list(blocks)
    while left:
        first, second = left[0], left[1] if len(left) > 1 else None
        if _is_chart(first) and _is_chart(second):
            yield first, second
            del left[:2]
        else:
            yield first
            del left[0]


def _is_chart(block: Block | None) -> TypeGuard[Figure]:
    return isinstance(block, Figure) and isinstance(block.graphic, Chart) and block.graphic.columns == 1


def _with_drawings(pages: _Pages) -> bytes:
    if pages.waiting:
        pages.begin_drawing()
    text = bytes(pages.output())
    if not pages.places:
        return text
    writer = PdfWriter(clone_from=io.BytesIO(text))
    drawings = (page for file in pages.files for page in PdfReader(io.BytesIO(file())).pages)
    for number, (place, drawing) in enumerate(zip(pages.places, drawings, strict=True)):
        _lay(writer, writer.pages[place.page], drawing, place, f"/Drawing{number}")
    written = io.BytesIO()
    writer.write(written)
    return written.getvalue()


def _lay(writer: PdfWriter, page: PageObject, drawing: PageObject, place: _DrawingPlace, name: str) -> None:
    """Lay a page of drawings onto a *page*: as a form of that *name*, its content as it is."""
    form = DecodedStreamObject()
    contents = drawing.get_contents()
    form.set_data(b"" if contents is None else contents.get_data())
    form[NameObject("/Type")], form[NameObject("/Subtype")] = NameObject("/XObject"), NameObject("/Form")
    form[NameObject("/BBox")] = ArrayObject(FloatObject(side) for side in drawing.mediabox)
    form[NameObject("/Resources")] = drawing.raw_get("/Resources").clone(writer)
    resources = page["/Resources"]
    assert isinstance(resources, DictionaryObject)
    forms = resources.setdefault(NameObject("/XObject"), DictionaryObject()).get_object()
    forms[NameObject(name)] = _add_stream(writer, form.flate_encode())
    put = DecodedStreamObject()
    scale = f"{place.scale:.6f}"
    put.set_data(f"q {scale} 0 0 {scale} {place.left:.3f} {place.low:.3f} cm {name} Do Q".encode())
    before = page.raw_get("/Contents")
    # Streams in a row: readers draw nothing of a page whose list holds another list.
    parts = list(before) if isinstance(before, ArrayObject) else [before]
    page[NameObject("/Contents")] = ArrayObject([*parts, _add_stream(writer, put)])


def _add_stream(writer: PdfWriter, stream: StreamObject) -> IndirectObject:
    # Only what may have a reference is given one.
    stream.indirect_reference = None
    reference = stream.clone(writer).indirect_reference
    assert reference is not None
    return reference


def _height_of(pages: _Pages, first: object, second: object) -> float:
    """The height [mm] of a heading with what may not be apart from it: the figure, the paragraph or the head
    of the table that follows, *first* and, after a paragraph, *second*.
    """
    if isinstance(first, Figure):
        return 30 + _size(first)[1]
    if not isinstance(first, Paragraph):
        return 30
    pages.set_font(FONT, "", 9)
    text = 4.5 * len(pages.lines_of(as_printed(first.text), pages.epw))
    after = _size(second)[1] if isinstance(second, Figure) else TABLE_HEAD if isinstance(second, Table) else 0
    return min(18 + text + after, HIGHEST)


def _size(figure: Figure) -> tuple[float, float]:
    inches_wide, inches_high = figure.graphic.size
    width = min(25.4 * inches_wide, WIDEST_FIGURE)
    return width, width * inches_high / inches_wide


def _cover(pages: _Pages, document: Document) -> None:
    pages.set_y(20)
    _title(pages, document)
    pages.ln(4)
    for what, which in document.cover:
        top = pages.get_y()
        pages.set_xy(20, top)
        _text(pages, what, 10, colour=GREY)
        pages.set_xy(60, top)
        _text(pages, which, 10)
        pages.ln(0.5)
    pages.ln(4)
    for block in document.sections[0].blocks if document.sections else ():
        if isinstance(block, Paragraph):
            _box(pages, block)
        else:
            _put(pages, block)
    if pages.get_y() > SIGNATURE_AT:
        pages.add_page()
    pages.set_y(SIGNATURE_AT if pages.page == 1 else pages.get_y() + 4)
    _table(pages, SIGNATURE)


def _title(pages: _Pages, document: Document) -> None:
    _text(pages, document.title, 24, bold=True)
    pages.ln(2)
    _text(pages, document.subtitle, 11, colour=GREY)
    pages.set_line_width(0.8)
    pages.line(20, pages.get_y() + 4, 190, pages.get_y() + 4)
    pages.set_line_width(0.2)
    pages.ln(4)


def _box(pages: _Pages, block: Paragraph) -> None:
    start, page = pages.get_y(), pages.page
    pages.set_fill_color(*SOFT)
    pages.set_font(FONT, "B" if block.kind in ("passed", "failed") else "", 11)
    pages.set_text_color(*TONES.get(block.kind, INK))
    pages.set_x(23)
    look: Any = {"fill": True, "new_x": "LMARGIN", "new_y": "NEXT", "align": "L", "padding": (2, 3)}
    pages.multi_cell(167, 6.5, as_printed(block.text), **look)
    if pages.page == page:
        pages.set_fill_color(*TONES.get(block.kind, INK))
        pages.rect(20, start, 1.6, pages.get_y() - start, style="F")
    pages.set_fill_color(*PAPER)
    pages.ln(3)


def _text(
    pages: _Pages, text: str, size: float, *, bold: bool = False, colour: tuple[int, int, int] = INK
) -> None:
    pages.set_font(FONT, "B" if bold else "", size)
    pages.set_text_color(*colour)
    width = pages.w - pages.r_margin - pages.get_x()
    pages.write_lines(pages.lines_of(text, width), width, size * 0.5)


def _put(pages: _Pages, block: Block | tuple[Figure, Figure]) -> None:
    if isinstance(block, tuple):
        _pair(pages, block)
    elif isinstance(block, Paragraph):
        text, bold = as_printed(block.text), block.kind in ("passed", "failed")
        _text(pages, text, 9, bold=bold, colour=TONES.get(block.kind, INK))
        pages.ln(1.5)
    elif isinstance(block, Code):
        _text(pages, block.text, 6, colour=GREY)
    elif isinstance(block, Figure):
        _figure(pages, block)
    elif block.rows:
        _table(pages, block)


def _figure(pages: _Pages, figure: Figure) -> None:
    height = _size(figure)[1]
    if pages.will_page_break(height + 10):
        pages.add_page()
    _drawing(pages, figure, pages.l_margin)
    pages.figures += 1
    _text(pages, as_printed(f"Figure {pages.figures}. {figure.caption}"), 8, colour=GREY)
    pages.ln(2)


def _pair(pages: _Pages, pair: tuple[Figure, Figure]) -> None:
    tall = min(max(figure.graphic.size[1] for figure in pair), HALF_HEIGHT)
    charts = [figure.graphic for figure in pair if isinstance(figure.graphic, Chart)]
    small = [replace(chart, size=(HALF, tall), legend="above") for chart in charts]
    halves = [replace(figure, graphic=chart) for figure, chart in zip(pair, small, strict=True)]
    if pages.will_page_break(25.4 * tall + 25):
        pages.add_page()
    top, ends = pages.get_y(), []
    for figure, x in zip(halves, (pages.l_margin, 210 - pages.r_margin - 25.4 * HALF), strict=True):
        pages.set_y(top)
        _drawing(pages, figure, x)
        pages.figures += 1
        pages.set_xy(x, top + 25.4 * tall)
        pages.set_font(FONT, "", 7)
        pages.set_text_color(*GREY)
        caption = as_printed(f"Figure {pages.figures}. {figure.caption}")
        pages.write_lines(pages.lines_of(caption, 25.4 * HALF), 25.4 * HALF, 3.2)
        ends.append(pages.get_y())
    pages.set_y(max(ends))
    pages.ln(2)


def _drawing(pages: _Pages, figure: Figure, x: float) -> None:
    width, height = _size(figure)
    if _as_dots(figure):
        dots = io.BytesIO(png_bytes(canvas_of(figure.graphic)))
        pages.image(dots, x=x, w=width, alt_text=figure.alternative)
        return
    low = pages.h - pages.get_y() - height
    scale = width / (25.4 * figure.graphic.size[0])
    pages.places.append(_DrawingPlace(pages.page - 1, POINT * x, POINT * low, scale))
    pages.waiting.append(figure.graphic)
    if len(pages.waiting) == MOST_TOGETHER:
        pages.begin_drawing()
    room = io.BytesIO(ROOM.format(*figure.graphic.size).encode())
    pages.image(room, x=x, w=width, alt_text=figure.alternative)


def _as_dots(figure: Figure) -> bool:
    if not isinstance(figure.graphic, Chart):
        return False
    series = [curve for panel in figure.graphic.panels for curve in panel.series]
    is_map = any(curve.kind == "cells" for curve in series)
    return is_map or sum(curve.y.size for curve in series) > MOST_POINTS


def _table(pages: _Pages, table: Table) -> None:
    if table.caption:
        if pages.will_page_break(TABLE_HEAD):
            pages.add_page()
        _text(pages, as_printed(table.caption), 8.5, bold=True)
    pages.set_text_color(*INK)
    pages.set_draw_color(*LINE)
    pages.set_fill_color(*SOFT)
    texts = [[as_printed(cell) for cell in row] for row in (table.header, *table.rows)]
    widths = _column_widths(pages, texts)
    rows: list[list[list[str]]] = []
    for row in texts:
        pages.set_font(FONT, "" if rows else "B", 7)
        cells = [pages.lines_of(text, width) for text, width in zip(row, widths, strict=True)]
        # A row higher than a page goes on in the next one.
        for start in range(0, max(map(len, cells)), MOST_LINES):
            rows.append([lines[start : start + MOST_LINES] for lines in cells])
    begin = partial(_row, pages, rows[0], widths, table.numeric, is_head=True)
    if pages.will_page_break(_height(rows[0]) + _height(rows[1])):
        pages.add_page()
    begin()
    for cells in rows[1:]:
        if pages.will_page_break(_height(cells)):
            pages.add_page()
            begin()
        _row(pages, cells, widths, table.numeric)
    pages.set_draw_color(0)
    pages.ln(2)


def _column_widths(pages: _Pages, rows: Sequence[Sequence[str]]) -> list[float]:
    """Widths [mm] by the longest text of each column; none is below its widest word, where all have room."""
    shares, least = [], []
    pages.set_font(FONT, "B", 7)
    for column in zip(*rows, strict=True):
        shares.append(min(max(8, *map(len, column)), 40))
        least.append(max(pages.width_of(word) for text in column for word in text.split(" ")))
    least = [width * pages.font_size_pt + 2 * pages.c_margin for width in least]
    narrow: set[int] = set()
    while True:
        room = pages.epw - sum(least[n] for n in narrow)
        whole = sum(share for n, share in enumerate(shares) if n not in narrow)
        widths = [least[n] if n in narrow else room * share / whole for n, share in enumerate(shares)]
        more = {n for n, width in enumerate(widths) if width < least[n]} - narrow
        if not more or sum(least) > pages.epw:
            return widths
        narrow |= more


def _height(row: Sequence[Sequence[str]]) -> float:
    return ROW * max(map(len, row))


def _row(
    pages: _Pages,
    row: Sequence[Sequence[str]],
    widths: Sequence[float],
    numeric: Sequence[int],
    is_head: bool = False,
) -> None:
    pages.set_font(FONT, "B" if is_head else "", 7)
    x, y, height = pages.l_margin, pages.get_y(), _height(row)
    if is_head:
        pages.rect(x, y, pages.epw, height, style="F")
    else:
        pages.line(x, y, x + pages.epw, y)
    for number, (lines, width) in enumerate(zip(row, widths, strict=True)):
        pages.set_xy(x, y + (height - ROW * len(lines)) / 2)
        pages.write_lines(lines, width, ROW, "R" if number in numeric else "L")
        x += width
    pages.set_y(y + height)

"""A report as a document: sections of paragraphs, tables and figures, with no format inside."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.report.chart import Graphic


@dataclass(frozen=True)
class Paragraph:
    """Plain text; *kind* is '' or the tone of a box: 'passed', 'failed', 'warning', 'note'."""

    text: str
    kind: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; with a *caption*; *numeric*: columns aligned as numbers. Columns without
    any entry are left out.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    numeric: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        kept = [n for n in range(len(self.header)) if any(row[n] for row in self.rows)]
        if self.rows and len(kept) < len(self.header):
            header, *rows = (tuple(row[n] for n in kept) for row in (self.header, *self.rows))
            numeric = tuple(place for place, n in enumerate(kept) if n in self.numeric)
            for name, value in (("header", header), ("rows", tuple(rows)), ("numeric", numeric)):
                object.__setattr__(self, name, value)


@dataclass(frozen=True)
class Figure:
    """A chart or drawing, its caption, and what it shows for those who cannot see it.

    Each format of a document draws it its own way.
    """

    graphic: Graphic
    caption: str
    alternative: str


@dataclass(frozen=True)
class Code:
    """Text that keeps its line breaks: settings, commands."""

    text: str


Block = Paragraph | Table | Figure | Code


@dataclass(frozen=True)
class Section:
    """A heading and its blocks."""

    heading: str
    blocks: tuple[Block, ...]


SIGNATURE = Table(("tested by", "date", "signature"), (("\n\n", "\n\n", "\n\n"),))


@dataclass(frozen=True)
class Document:
    """The whole report; *cover*: entries of the first page, (what, which) in order.

    It ends with a place to sign, where *to_sign*.
    """

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    cover: tuple[tuple[str, str], ...] = ()
    to_sign: bool = True

    @property
    def signed(self) -> tuple[Section, ...]:
        """The sections with the place to sign last, for formats without a cover."""
        return (*self.sections, Section("Signature", (SIGNATURE,))) if self.to_sign else self.sections

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
    """Rows of text under a header; with a *caption*; *numeric*: columns aligned as numbers."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    numeric: tuple[int, ...] = ()


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
    """A heading and its blocks; columns of a table without any entry are left out."""

    heading: str
    blocks: tuple[Block, ...]

    def __post_init__(self) -> None:
        blocks = tuple(_without_empty(block) if isinstance(block, Table) else block for block in self.blocks)
        object.__setattr__(self, "blocks", blocks)


def _without_empty(table: Table) -> Table:
    """The table without columns that have no entry."""
    kept = [n for n in range(len(table.header)) if any(row[n] for row in table.rows)]
    if not table.rows or len(kept) == len(table.header):
        return table
    header, *rows = (tuple(row[n] for n in kept) for row in (table.header, *table.rows))
    return Table(header, tuple(rows), table.caption, tuple(map(kept.index, {*table.numeric} & {*kept})))


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

"""Elements and words of a drawing in SVG: what the words need of room, and how they stand."""

from __future__ import annotations

from html import escape

# Places are whole numbers, so many of them to the point (1/72 in): as finely as print shows them.
PER_POINT = 10
# Widths of letters as thousandths of their size: DejaVu Sans, the widest of the fonts that a page may have at hand.
_WIDTHS = {
    275: "'", 278: "ijl", 295: "IJ", 318: " ,.", 337: "/:;\\|", 352: "f", 361: "-", 390: "()[]", 392: "t", 401: "!²", 411: "r",
    460: '"', 500: "*_`°", 521: "s", 525: "z", 531: "?", 550: "c", 557: "L", 575: "F", 579: "k", 592: "vxy", 603: "P",
    611: "TY", 612: "o", 613: "a", 615: "e", 632: "E", 635: "Sbdgpqσκζχ", 636: "$0123456789{}µ", 656: "K", 660: "hnuαβφ",
    695: "ADVXZBRCδΔ", 732: "U", 752: "HN", 787: "GOQ", 780: "&", 818: "w", 838: "#+<=>^~−±×", 863: "M", 950: "%", 974: "m", 1000: "@W",
}  # fmt: skip
WIDTHS = {letter: width / 1000 for width, letters in _WIDTHS.items() for letter in letters}
OTHER_WIDTH = 0.7
# Of a line of text, as parts of its size: from one to the next, and its letters above their foot.
LEADING, CAPITAL = 1.25, 0.73


def text_width(text: str, size: float) -> float:
    """Width [pt] of the longest line of a text in letters of *size* [pt]."""
    return size * max(sum(WIDTHS.get(letter, OTHER_WIDTH) for letter in line) for line in text.split("\n"))


def text_height(text: str, size: float) -> float:
    """Height [pt] of the lines of a text in letters of *size* [pt]."""
    return LEADING * size * (text.count("\n") + 1)


def words(text: str, x: float, y: float, size: float, anchor: str = "middle", *, turned: float = 0.0, colour: str = "") -> str:
    """A text whose foot (of several lines: that of the last) stands at (x, y) [pt], turned clockwise by an angle [deg]."""
    lines = text.split("\n")
    across, down, letters = (round(PER_POINT * value) for value in (x, y, size))
    look = f' text-anchor="{anchor}"' if anchor != "start" else ""
    look += f' transform="rotate({turned:g} {across} {down})"' if turned else ""
    look += f' style="fill:{colour}"' if colour else ""
    above = [round(LEADING * letters * number) for number in range(len(lines) - 1, -1, -1)]
    spans = [escape(line, quote=False) for line in lines]
    if len(lines) > 1:
        spans = [f'<tspan x="{across}" y="{down - step}">{line}</tspan>' for line, step in zip(spans, above, strict=True)]
    return f'<text x="{across}" y="{down}" font-size="{letters}"{look}>{"".join(spans)}</text>'


def path(data: str, look: str) -> str:
    """A path with the attributes *look*; nothing where it has no data."""
    return f'<path {look} d="{data}"/>' if data else ""


def rectangle(left: float, top: float, width: float, height: float, look: str) -> str:
    """A rectangle [pt] with the attributes *look*."""
    x, y, right, bottom = (round(PER_POINT * value) for value in (left, top, left + width, top + height))
    return f'<rect x="{x}" y="{y}" width="{right - x}" height="{bottom - y}" {look}/>'

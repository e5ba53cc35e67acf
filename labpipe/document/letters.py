"""The room that words need: widths and heights of letters."""

from __future__ import annotations

# Widths of letters as thousandths of their size: DejaVu Sans, the widest of the fonts that a page may have at hand.
_WIDTHS = {
    275: "'", 278: "ijl", 295: "IJ", 318: " ,.", 337: "/:;\\|", 352: "f", 361: "-", 390: "()[]", 392: "t", 401: "!²", 411: "r",
    460: '"', 500: "*_`°", 521: "s", 525: "z", 531: "?", 550: "c", 557: "L", 575: "F", 579: "k", 592: "vxy", 603: "P",
    611: "TY", 612: "o", 613: "a", 615: "e", 632: "E", 635: "Sbdgpqσκζχ", 636: "$0123456789{}µ", 656: "K", 660: "hnuαβφ",
    695: "ADVXZBRCδΔ", 732: "U", 752: "HN", 787: "GOQ", 780: "&", 818: "w", 838: "#+<=>^~−±×", 863: "M", 950: "%", 974: "m", 1000: "@W",
}  # fmt: skip
WIDTHS = {letter: width / 1000 for width, letters in _WIDTHS.items() for letter in letters}
OTHER_WIDTH = 0.7
# Size of the letters at axes [pt].
LETTERS = 9.0
# Of a line of text, as parts of its size: from one to the next, and its letters above their foot.
LEADING, CAPITAL = 1.25, 0.73


def text_width(text: str, size: float) -> float:
    """Width [pt] of the longest line of a text in letters of *size* [pt]."""
    return size * max(sum(WIDTHS.get(letter, OTHER_WIDTH) for letter in line) for line in text.split("\n"))


def text_height(text: str, size: float) -> float:
    """Height [pt] of the lines of a text in letters of *size* [pt]."""
    return LEADING * size * (text.count("\n") + 1)

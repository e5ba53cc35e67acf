"""A figure as an SVG file that stands alone."""

from __future__ import annotations

import re

from labpipe.document.page_parts import page_part
from labpipe.document.palette import GREY_TONE, PALETTE
from labpipe.document.svg_chart import chart_svg
from labpipe.report.chart import Chart
from labpipe.report.document import Figure

PROLOGUE = '<?xml version="1.0" encoding="utf-8"?>\n'
# The colours that the style of a page names, on paper.
PAPER = {"ink": "#000000", "grid": "#e3e6ea", "rule": GREY_TONE} | {f"c{number}": colour for number, colour in enumerate(PALETTE)}


def svg_file(figure: Figure) -> str:
    """The figure as SVG with its style inside, on a white ground; colours by value, since drawing programs know no names for them."""
    if not isinstance(figure.graphic, Chart):
        # Matplotlib, which takes its time to load, is for drawings alone.
        from labpipe.document.saving import canvas_of, svg_text

        return PROLOGUE + svg_text(canvas_of(figure.graphic))
    text = chart_svg(figure.graphic, "chart", figure.alternative)
    inside = f'<style>{page_part("drawing.css")}</style><rect width="100%" height="100%" fill="#ffffff"/>'
    head, end, rest = text.partition(">")
    return PROLOGUE + re.sub(r"var\(--(\w+)\)", lambda found: PAPER[found[1]], head + end + inside + rest) + "\n"

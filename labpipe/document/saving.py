"""What a figure shows as a canvas, and a canvas as SVG or PNG."""

from __future__ import annotations

import io
from typing import IO, Any

import matplotlib as mpl
from matplotlib.figure import Figure as Canvas

from labpipe.document.matplotlib_chart import chart_canvas
from labpipe.document.matplotlib_style import STYLE
from labpipe.registry import Registry
from labpipe.report.chart import Chart, Graphic

PRINT_DPI = 200
# What is not numbers over axes, by kind: each draws its subject on a canvas of a size.
DRAWINGS = Registry(
    "drawing",
    {
        "film": "labpipe.document.film_drawing:film_canvas",
        "surfaces": "labpipe.document.surface_drawing:surface_canvas",
        "mode-shapes": "labpipe.document.shape_drawing:shape_canvas",
    },
)


def canvas_of(graphic: Graphic) -> Canvas:
    """A chart or a drawing on a canvas of its size."""
    if isinstance(graphic, Chart):
        return chart_canvas(graphic)
    canvas: Canvas = DRAWINGS.load(graphic.kind)(graphic.subject, graphic.size)
    return canvas


def svg_text(canvas: Canvas, outlined: bool = False) -> str:
    """The canvas as SVG without its XML prologue, so that it can stand inside HTML; no clock in it. *outlined*: letters as outlines."""
    stream = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.fonttype": "path" if outlined else "none"}):
        _save(canvas, stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


def png_bytes(canvas: Canvas) -> bytes:
    """The canvas as PNG in print resolution."""
    stream = io.BytesIO()
    with mpl.rc_context(STYLE):
        _save(canvas, stream, format="png", dpi=PRINT_DPI, metadata={"Software": None})
    return stream.getvalue()


def _save(canvas: Canvas, stream: IO[Any], **options: Any) -> None:
    """Lay out once, and save: by itself matplotlib would go through all artists once more, only to have them laid out."""
    engine = canvas.get_layout_engine()
    if engine is not None:
        engine.execute(canvas)
        # Not "none": a canvas with any engine, that one too, is drawn twice.
        canvas.set_layout_engine(None)
    canvas.savefig(stream, **options)

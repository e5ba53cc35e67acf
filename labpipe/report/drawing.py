"""The style of all drawings, and saving them as SVG or PNG."""

from __future__ import annotations

import io
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure as Canvas

# Okabe and Ito's colours: told apart by colour-blind readers and in grey print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLE = {
    "svg.hashsalt": "labpipe",
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "axes.spines.top": False,
    "axes.spines.right": False,
    # More curves than colours: the next round is dashed, so that none looks like another.
    "axes.prop_cycle": mpl.cycler(linestyle=("-", "--", ":")) * mpl.cycler(color=COLOURS),
    "legend.frameon": False,
}
PRINT_DPI = 200


def svg_text(drawing: Canvas, outlined: bool = False) -> str:
    """The drawing as SVG without its XML prologue, so that it can stand inside HTML; no clock in it. *outlined*: letters as outlines."""
    stream = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.fonttype": "path" if outlined else "none"}):
        _save(drawing, stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


def png_bytes(drawing: Canvas) -> io.BytesIO:
    """The drawing as PNG in print resolution."""
    stream = io.BytesIO()
    with mpl.rc_context(STYLE):
        _save(drawing, stream, format="png", dpi=PRINT_DPI, metadata={"Software": None})
    stream.seek(0)
    return stream


def _save(drawing: Canvas, stream: io.IOBase, **options: Any) -> None:
    """Save, and keep the layout as it is now: laid out once more, everything would move by a hair."""
    drawing.savefig(stream, **options)
    drawing.set_layout_engine("none")

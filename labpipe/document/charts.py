"""Charts and drawings by matplotlib: for PDF, PNG and SVG files, and results as figures for notebooks."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import Formatter, Locator, LogLocator, MaxNLocator, MultipleLocator, NullLocator

from labpipe.arrays import FloatArray
from labpipe.display import as_printed
from labpipe.document.figure_numbers import figure_csv, short_name
from labpipe.errors import DataError
from labpipe.records.comparison import Comparison
from labpipe.records.identification import Fit, Identification
from labpipe.records.response import FrequencyResponse
from labpipe.registry import Registry
from labpipe.report.build import build
from labpipe.report.chart import PALETTE_SIZE, Axis, Chart, Graphic, Series
from labpipe.report.comparison import comparison_figures
from labpipe.report.document import Document, Figure, Section
from labpipe.report.figures import REACH, VIEWS, ShapeSketch, project, response_figure, sliding_figures
from labpipe.report.fits import fit_figures

# Okabe and Ito's colours, distinguishable for colour-blind readers and in grey print; amber and sky darker,
# so that thin lines reach a contrast of 3:1 with white (WCAG 2.1, criterion 1.4.11).
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B97F00", "#3A94D0", "#000000")
GREY_TONE = "#808080"
# From -1 to 1: orange, white, violet, of one lightness at both ends.
HEAT = "PuOr"
STYLE: Any = {
    "svg.hashsalt": "labpipe",
    "svg.fonttype": "none",
    # Names from files must not become mathematical markup.
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
}
PROLOGUE = '<?xml version="1.0" encoding="utf-8"?>\n'
PRINT_DPI = 200
TITLE, SMALL_TITLE, SMALL = 9.0, 8.0, 7.0
# Bars of markers smaller than this [pt] have no caps: there are too many of them.
LEAST_CAPPED, CAP = 3.0, 2.0
# Letters that fit into an inch of an ordinate; names of places with more to the inch of the figure are turned
# [deg].
LETTERS_UPWARDS, MOST_LEVEL = 13, 9
UPRIGHT, SLANTED = 90.0, 25.0
# Letters that fit into a legend as wide as the page, and those of the sample beside each name.
LEGEND_LETTERS, SAMPLE, MOST_COLUMNS = 112, 11, 5
# Points beyond which a legend stands in a corner: matplotlib looks at each of them to find the best place.
MOST_SEEN = 20_000
# Names beyond which a legend within a panel would hide what is drawn there: it stands above it.
MOST_WITHIN = 4
# Steps between numbers; many degrees have parts of a turn. A logarithmic axis of fewer decades than the first
# has numbers in equal steps, of fewer than the second numbers within its decades.
STEPS, TURNS, MANY_DEGREES = (1, 2, 2.5, 5, 10), (15, 30, 45, 90, 180, 360), 60.0
LEAST_DECADES, FEW_DECADES, WITHIN = 0.7, 2.2, (1.0, 2.0, 5.0)
# Numbers from here on, and below the other, are written with an exponent.
LARGE, SMALLEST = 1e6, 1e-4
# Texts around the panels of a chart, which take room.
Words = tuple[str, ...]
# Size, heights and scales of a chart's panels.
Frame = tuple[Any, ...]
# The texts of a laid-out chart, and where its panels and titles stand.
Layout = tuple[Words, list[Any]]
# All digits are as wide as one.
WIDE = str.maketrans("123456789", "000000000")
# What is not numbers over axes, by kind: each draws its subject on a canvas of a size.
DRAWINGS = Registry("drawing")


def style(grid: bool = True) -> Any:
    """The style of the house as a context."""
    return mpl.rc_context({**STYLE, "axes.grid": grid})


def canvas_of(graphic: Graphic, canvases: dict[Frame, Canvas] | None = None) -> Canvas:
    """A chart or a drawing on a canvas of its size; *canvases* as in chart_canvas."""
    if isinstance(graphic, Chart):
        return chart_canvas(graphic, canvases)
    canvas: Canvas = DRAWINGS.load(graphic.kind)(graphic.subject, graphic.size)
    return canvas


def svg_text(canvas: Canvas) -> str:
    """The canvas as SVG without its XML prologue, no clock in it."""
    stream = io.StringIO()
    with mpl.rc_context(STYLE):
        nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
        laid_out(canvas).savefig(stream, format="svg", metadata=nothing)
    text = stream.getvalue()
    return text[text.index("<svg") :]


def svg_file(figure: Figure) -> str:
    """The figure as an SVG file that stands alone."""
    return PROLOGUE + svg_text(canvas_of(figure.graphic))


def png_bytes(canvas: Canvas) -> bytes:
    """The canvas as PNG in print resolution."""
    stream = io.BytesIO()
    with mpl.rc_context(STYLE):
        laid_out(canvas).savefig(stream, format="png", dpi=PRINT_DPI, metadata={"Software": None})
    return stream.getvalue()


def laid_out(canvas: Canvas, layouts: dict[Words, Layout] | None = None) -> Canvas:
    """The canvas, laid out once: by itself matplotlib would go through all artists once more for it.

    *layouts*, for a chart: those of the same document so far. The layout of a chart with the same words about
    its panels is taken from there, else its own is added.
    """
    engine = canvas.get_layout_engine()
    if engine is not None and (layouts is None or not _is_placed(canvas, layouts)):
        words = () if layouts is None else _words(canvas)
        engine.execute(canvas)
        if layouts is not None:
            layouts[words] = _words(canvas), _places(canvas)
    # Not "none": a canvas with any engine, that one too, is drawn twice.
    canvas.set_layout_engine(None)
    return canvas


def _is_placed(canvas: Canvas, layouts: dict[Words, Layout]) -> bool:
    """Put the parts of a canvas where those of one with the same words are; False where there is none, or
    where panels of that size have room for other numbers.
    """
    before = _places(canvas)
    after, places = layouts.get(_words(canvas), ((), before))
    _put(canvas, places)
    if _words(canvas) == after:
        return True
    _put(canvas, before)
    return False


def _places(canvas: Canvas) -> list[Any]:
    parts: list[Any] = [*canvas.axes, *canvas.texts]
    return [drawn.get_position() for drawn in parts]


def _put(canvas: Canvas, places: Sequence[Any]) -> None:
    parts: list[Any] = [*canvas.axes, *canvas.texts]
    for drawn, place in zip(parts, places, strict=True):
        drawn.set_position(place)
        # Axes whose place is set would be left out of the next layout.
        drawn.set_in_layout(True)


def _words(canvas: Canvas) -> Words:
    words = [*canvas.get_size_inches(), *(text.get_text() for text in canvas.texts)]
    for legend in (*canvas.legends, *(axes.get_legend() for axes in canvas.axes)):
        words += [text.get_text() for text in legend.get_texts()] if legend else [None]
    for axes in canvas.axes:
        place: Any = axes.get_subplotspec()
        words += [axes.get_title(), axes.get_aspect(), place, place.get_gridspec().get_height_ratios()]
        for axis in (axes.xaxis, axes.yaxis):
            numbers = axis.get_major_formatter().format_ticks(list(axis.get_majorticklocs()))
            words += [axis.get_label_text(), axis.get_tick_params()]
            words += [text.translate(WIDE) for text in numbers]
    return tuple(map(str, words))


def figure_files(document: Document) -> dict[str, bytes]:
    """name -> content: figure-01-... .svg, .png and .csv of every figure, numbered as in the report."""
    figures = (figure for section in document.sections for figure in _figures(section))
    contents: dict[str, bytes] = {}
    for number, figure in enumerate(figures, 1):
        stem = f"figure-{number:02d}-{short_name(figure.caption)}".rstrip("-")
        canvas = canvas_of(figure.graphic)
        contents[f"{stem}.svg"] = (PROLOGUE + svg_text(canvas)).encode()
        contents[f"{stem}.png"] = png_bytes(canvas)
        if isinstance(figure.graphic, Chart):
            contents[f"{stem}.csv"] = figure_csv(figure.graphic, figure.caption).encode()
    return contents


def _figures(section: Section) -> list[Figure]:
    return [block for block in section.blocks if isinstance(block, Figure)]


def chart_canvas(chart: Chart, canvases: dict[Frame, Canvas] | None = None) -> Canvas:
    """The chart on a canvas of its size.

    *canvases*: those of charts that are written already; one with the same panels is emptied and drawn on
    again, which spares the making of its axes and ticks.
    """
    has_cells = any(series.kind == "cells" for panel in chart.panels for series in panel.series)
    has_names = any(panel.x.ticks or panel.y.ticks for panel in chart.panels)
    with style(grid=not has_cells):
        canvas = Canvas(figsize=chart.size)
        if canvases is not None and not has_cells and not has_names and chart.columns == 1:
            canvas = _drop_contents(canvases.setdefault(_frame(chart), canvas))
        canvas.set_layout_engine("constrained")
        drawn = canvas.axes or _panels(canvas, chart)
        handles: dict[int, Artist] = {}
        for number, (axes, panel) in enumerate(zip(drawn, chart.panels, strict=True)):
            for series in panel.series:
                if (artist := PAINTERS[series.kind](axes, series)) is not None:
                    handles[id(series)] = artist
            _scales(axes, chart, number)
        _titles(canvas, drawn, chart)
        _legends(canvas, drawn, chart, handles)
    return canvas


def _panels(canvas: Canvas, chart: Chart) -> list[Axes]:
    grid = canvas.add_gridspec(chart.rows, chart.columns, height_ratios=chart.heights)
    drawn: list[Axes] = []
    for number in range(len(chart.panels)):
        together = {f"share{which}": drawn[0] for which in "xy" if drawn and which in chart.shared}
        drawn.append(canvas.add_subplot(grid[divmod(number, chart.columns)], **together))
    return drawn


def _frame(chart: Chart) -> Frame:
    panels = ((panel.x.logarithmic, panel.y.logarithmic, panel.equal) for panel in chart.panels)
    return chart.size, tuple(chart.heights), chart.shared, *panels


def _drop_contents(canvas: Canvas) -> Canvas:
    around = [*canvas.legends, *(legend for axes in canvas.axes if (legend := axes.get_legend()))]
    inside = [(axes.lines, axes.patches, axes.collections, axes.texts) for axes in canvas.axes]
    for artist in (*around, *(artist for kinds in inside for kind in kinds for artist in list(kind))):
        artist.remove()
    for axes in canvas.axes:
        axes.containers.clear()
        axes.set_title("")
        place = axes.get_subplotspec()
        assert place is not None
        axes.set_position(place.get_position(canvas))
    return canvas


def _scales(axes: Axes, chart: Chart, number: int) -> None:
    panel = chart.panels[number]
    for which, axis in (("x", panel.x), ("y", panel.y)):
        limits = chart.limits(number, which)
        if axis.logarithmic:
            axes.set(**{f"{which}scale": "log"})
        # Of two axes with one scale matplotlib may move an end outwards.
        (axes.set_xlim if which == "x" else axes.set_ylim)(*limits, auto=panel.equal)
        _number(axes.xaxis if which == "x" else axes.yaxis, axis, limits)
    # The ordinate of a panel has its numbers where it moves alone, or no panel stands to its left.
    is_leftmost = "y" not in chart.shared or number % chart.columns == 0
    axes.tick_params(labelbottom=_is_lowest(chart, number), labelleft=is_leftmost)
    if panel.equal:
        axes.set_aspect("equal", adjustable="box" if chart.shared else "datalim")
    if sum(len(name) + 1 for _, name in panel.x.ticks) > MOST_LEVEL * chart.size[0]:
        upright = any(series.kind == "cells" for series in panel.series)
        axes.tick_params(axis="x", labelrotation=UPRIGHT if upright else SLANTED, labelsize=SMALL)
        for label in axes.get_xticklabels():
            label.set_horizontalalignment("center" if upright else "right")


def _is_lowest(chart: Chart, number: int) -> bool:
    return "x" not in chart.shared or number + chart.columns >= len(chart.panels)


def _titles(canvas: Canvas, drawn: Sequence[Axes], chart: Chart) -> None:
    once = {
        "x": chart.columns > 1 and chart.rows > 1 and len({panel.x.label for panel in chart.panels}) == 1,
        "y": chart.columns > 1 and len({panel.y.label for panel in chart.panels}) == 1,
    }
    for number, (axes, panel) in enumerate(zip(drawn, chart.panels, strict=True)):
        if panel.title:
            axes.set_title(panel.title, fontsize=SMALL_TITLE if chart.columns > 1 else TITLE)
        if not once["x"] and _is_lowest(chart, number):
            axes.set_xlabel(panel.x.label)
        if not once["y"]:
            # A title that is longer than its panel is high has its unit on a second line.
            room = LETTERS_UPWARDS * chart.size[1] * chart.heights[number // chart.columns]
            label = panel.y.label
            axes.set_ylabel(label.replace(" [", "\n[") if len(label) > room else label)
    if once["x"]:
        canvas.supxlabel(chart.panels[0].x.label, fontsize=TITLE)
    if once["y"]:
        canvas.supylabel(chart.panels[0].y.label, fontsize=TITLE)


def _legends(canvas: Canvas, drawn: Sequence[Axes], chart: Chart, handles: dict[int, Artist]) -> None:
    listed: dict[tuple[str, int], list[Series]] = {}
    for axes, panel in zip(drawn, chart.panels, strict=True):
        entries: dict[tuple[str, int], list[Series]] = {}
        for series in panel.series:
            if series.listed and id(series) in handles:
                entries.setdefault((series.listed, series.colour), []).append(series)
        fresh = {entry: series for entry, series in entries.items() if entry not in listed}
        listed |= fresh
        if chart.legend == "panels" and fresh:
            crowded = sum(series.x.size for series in panel.series) > MOST_SEEN
            place: Any = {"loc": "upper right" if crowded else "best"}
            if len(fresh) > MOST_WITHIN and chart.columns == 1 and not panel.title:
                place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0}
            axes.legend(*_samples(fresh, handles), ncols=_columns(fresh, chart.columns), **place)
    if chart.legend == "above" and listed:
        canvas.legend(*_samples(listed, handles), ncols=_columns(listed, 1), loc="outside upper center")


def _samples(
    entries: dict[tuple[str, int], list[Series]], handles: dict[int, Artist]
) -> tuple[list[Any], list[str]]:
    samples: list[Any] = []
    for series in entries.values():
        lined = next((curve for curve in series if curve.line), series[0])
        marked = next((curve for curve in series if curve.marker), lined)
        drawn = tuple(dict.fromkeys(handles[id(shown)] for shown in (lined, marked)))
        samples.append(drawn if len(drawn) > 1 else drawn[0])
    return samples, [name for name, _ in entries]


def _columns(entries: dict[tuple[str, int], list[Series]], side_by_side: int) -> int:
    longest = max(len(name) for name, _ in entries) + SAMPLE
    return max(1, min(len(entries), MOST_COLUMNS, int(LEGEND_LETTERS / side_by_side / longest)))


# Width of a figure [in] up to which long numbers below an axis would run into each other, and the ticks then.
NARROW, FEW_TICKS = 4.0, 4


def _number(drawn: Any, axis: Axis, limits: tuple[float, float]) -> None:
    drawn.set_minor_locator(NullLocator())
    if axis.ticks:
        drawn.set_ticks([place for place, _ in axis.ticks], [name for _, name in axis.ticks])
        return
    decades = math.log10(max(limits) / min(limits)) if axis.logarithmic else 0.0
    most: Any = "auto" if drawn.get_figure().get_size_inches()[0] > NARROW else FEW_TICKS
    if decades >= LEAST_DECADES:
        drawn.set_major_locator(LogLocator(subs=WITHIN if decades < FEW_DECADES else (1.0,)))
    else:
        round_numbers = MaxNLocator(most, steps=STEPS, min_n_ticks=3)
        drawn.set_major_locator(Degrees() if axis.unit == "deg" else round_numbers)
    drawn.set_major_formatter(NumberTexts(even=decades < LEAST_DECADES))


class Degrees(Locator):
    """Parts of a turn along many degrees, else round numbers."""

    # Matplotlib sets it; it has no more to say of its type.
    axis: Any = None

    def __call__(self) -> Any:
        """Where the numbers stand."""
        return self.tick_values(*sorted(self.axis.get_view_interval()))

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """The same for given ends [deg]."""
        most = int(np.clip(self.axis.get_tick_space(), 2, 6))
        step = next((turn for turn in TURNS if vmax - vmin <= most * turn), TURNS[-1])
        parts = MultipleLocator(step) if vmax - vmin > MANY_DEGREES else MaxNLocator(most, steps=STEPS)
        return parts.tick_values(vmin, vmax)


class NumberTexts(Formatter):
    """Numbers with a true minus; *even*: all with as many decimals as the finest of them needs."""

    def __init__(self, even: bool) -> None:
        self._even = even

    def __call__(self, x: float, pos: int | None = None) -> str:  # noqa: ARG002
        """The digits that a number has, and a power of ten where it is very large or small."""
        if _has_power(x):
            mantissa, exponent = f"{x:.4e}".split("e")
            text = as_printed(f"{mantissa.rstrip('0').rstrip('.')}e{exponent}").removeprefix("1 × ")
        else:
            text = f"{x + 0.0:.10g}"
        return text.replace("-", "\N{MINUS SIGN}")

    def format_ticks(self, values: Any) -> list[str]:
        """The texts of all numbers of an axis."""
        # A step's own rounding is not a digit of it.
        step = min(np.diff(np.sort(values)), default=0.0)
        exact = [0.0 if abs(value) < 1e-9 * step else float(value) for value in values]
        texts = [self(value) for value in exact]
        if not self._even or any(map(_has_power, exact)):
            return texts
        decimals = max((len(text.partition(".")[2]) for text in texts), default=0)
        return [f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}") for value in exact]


def _has_power(x: float) -> bool:
    return bool(x) and not SMALLEST <= abs(x) < LARGE


def tone(colour: int) -> str:
    """The colour of a series by its number as #rrggbb."""
    return PALETTE[colour % PALETTE_SIZE] if colour >= 0 else GREY_TONE


def _line(axes: Axes, series: Series) -> Artist:
    colour = tone(series.colour)
    if series.low is not None and series.high is not None:
        if series.interval == "shaded":
            shade: dict[str, Any] = {"color": colour, "alpha": series.opacity, "linewidth": 0}
            axes.fill_between(series.x, series.low, series.high, **shade)
        else:
            cap = CAP if series.size >= LEAST_CAPPED else 0.0
            # An interval need not hold its value.
            inside = np.fmin(np.fmax(series.y, series.low), series.high)
            reach = np.nan_to_num(np.abs(np.array([series.low, series.high]) - inside))
            axes.errorbar(series.x, inside, reach, fmt="none", ecolor=colour, elinewidth=0.8, capsize=cap)
    look: dict[str, Any] = {"color": colour, "linestyle": series.line or "none", "linewidth": series.width}
    if series.marker:
        look |= {"marker": series.marker, "markersize": series.size * (2 if series.marker == "." else 1)}
        look |= {"markerfacecolor": "none"} if series.hollow else {}
    # Matplotlib leaves out of a legend what begins with an underscore.
    (drawn,) = axes.plot(series.x, series.y, label=series.name or "_", **look)
    return drawn


def _area(axes: Axes, series: Series) -> Artist:
    face = (tone(series.colour), series.opacity)
    edge: dict[str, Any] = {"edgecolor": GREY_TONE, "linewidth": series.width}
    (drawn,) = axes.fill(series.x, series.y, facecolor=face, label=series.name or "_", **edge)
    return drawn


def _level(axes: Axes, series: Series) -> None:
    (y,) = series.y
    axes.axhline(y, color=tone(series.colour), linewidth=series.width, linestyle=series.line)
    if series.name:
        place: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "ha": "right", "va": "bottom"}
        axes.text(0.99, y, series.name, fontsize=SMALL, color="0.3", clip_on=True, **place)


def _upright(axes: Axes, series: Series) -> None:
    (x,) = series.x
    axes.axvline(x, color=tone(series.colour), linewidth=series.width, linestyle=series.line)


def _span(axes: Axes, series: Series) -> None:
    axes.axhspan(*series.y, color=tone(series.colour), alpha=series.opacity, linewidth=0)


def _cells(axes: Axes, series: Series) -> None:
    image = axes.imshow(series.y, cmap=HEAT, vmin=-1, vmax=1, aspect="auto")
    scale = axes.figure.colorbar(image, ax=axes, ticks=[-1, -0.5, 0, 0.5, 1], aspect=30, pad=0.03)
    scale.set_label(series.name, fontsize=SMALL + 1)
    scale.ax.tick_params(labelsize=SMALL, length=0)
    for (row, column), value in np.ndenumerate(series.y):
        red, green, blue, _ = image.cmap((value + 1) / 2)
        ink = "#ffffff" if 0.3 * red + 0.59 * green + 0.11 * blue < 0.5 and np.isfinite(value) else "#000000"
        axes.text(column, row, series.texts[row][column], ha="center", va="center", fontsize=SMALL, color=ink)


def _arrow(axes: Axes, series: Series) -> None:
    tail, head = np.column_stack([series.x, series.y])
    look: Any = {"arrowstyle": "-|>", "color": tone(series.colour)}
    arrow = axes.annotate("", head, tail, arrowprops=look, annotation_clip=True)
    arrow.set_in_layout(False)


def _text(axes: Axes, series: Series) -> None:
    look: dict[str, Any] = {"fontsize": series.size, "color": tone(series.colour), "clip_on": True}
    for x, y, text in zip(series.x, series.y, series.texts[0], strict=True):
        axes.text(x, y, text, ha="center", va="center", **look)


PAINTERS: dict[str, Callable[[Axes, Series], Artist | None]] = {
    "line": _line,
    "area": _area,
    "hline": _level,
    "vline": _upright,
    "hspan": _span,
    "cells": _cells,
    "arrow": _arrow,
    "text": _text,
}


# Room about the structure for its motion.
ROOM = 1.2 * REACH


def shape_canvas(sketch: ShapeSketch, size: tuple[float, float]) -> Canvas:
    """One row of views for every mode on a canvas of *size* [in]."""
    with style(grid=False):
        canvas = Canvas(figsize=size, layout="constrained")
        places = canvas.subplots(len(sketch.titles), len(VIEWS), squeeze=False)
        for mode, (row, title) in enumerate(zip(places, sketch.titles, strict=True)):
            for axes, (name, azimuth, elevation) in zip(row, VIEWS, strict=True):
                _view(axes, sketch, mode, (azimuth, elevation))
                if mode == len(sketch.titles) - 1:
                    axes.set_xlabel(name, fontsize=8)
            row[0].set_title(title, fontsize=9, loc="left")
    return canvas


def _view(axes: Axes, sketch: ShapeSketch, mode: int, eye: tuple[float, float]) -> None:
    there, back = sketch.extremes(mode)
    looks = ((sketch.positions, "0.75", "-"), (back, PALETTE[0], ":"), (there, PALETTE[0], "-"))
    for points, colour, style in looks:
        _draw(axes, sketch, project(points, *eye), colour, style)
    half = np.max([np.abs(project(sketch.positions, *view)).max(axis=0) for _, *view in VIEWS], axis=0) + ROOM
    axes.set_xlim(-half[0], half[0])
    axes.set_ylim(-half[1], half[1])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw(axes: Axes, sketch: ShapeSketch, seen: FloatArray, colour: str, style: str) -> None:
    lines = list(seen[sketch.lines])
    axes.add_collection(LineCollection(lines, colors=colour, linestyles=style, linewidths=1.2))
    axes.plot(*seen.T, ".", color=colour, markersize=3)


def plot(result: Any) -> Canvas:
    """The figure of a result as the report has it, a new matplotlib Figure each time.

    result: a Fit (measured and fitted FRF), several Fits of one sliding fit (coefficients over frequency), a
    FrequencyResponse, a Comparison, or an Identification (the first figure of its report). Raises DataError
    where a result has no figure, TypeError for what is none of these.
    """
    for kind, figures in FIGURES.items():
        if isinstance(result, kind):
            shown = figures(result)
            if not shown:
                what = f"this {type(result).__name__} has no figure"
                raise DataError(what, hint="its curve or responses are missing")
            return canvas_of(shown[0].graphic)
    kinds = ", ".join(kind.__name__ for kind in FIGURES)
    raise TypeError(f"no figure of {type(result).__name__}; known: {kinds}")


def _figures_of_identification(identification: Identification) -> list[Figure]:
    first, *others = map(_figures, build(identification).sections)
    whole = [figure for figure in first if isinstance(figure.graphic, Chart) and figure.graphic.rows > 1]
    return [*whole, *(figure for figures in others for figure in figures)]


def _figures_of_fits(fits: Sequence[Fit]) -> list[Figure]:
    return sliding_figures(fits) if len(fits) > 1 else [figure for fit in fits for figure in fit_figures(fit)]


FIGURES: dict[type, Callable[[Any], list[Figure]]] = {
    Fit: fit_figures,
    tuple: _figures_of_fits,
    list: _figures_of_fits,
    FrequencyResponse: lambda response: [response_figure(response)],
    # Those that need no response: those of pairs of FRFs stand in the report of their identification.
    Comparison: lambda comparison: comparison_figures(comparison, ()),
    Identification: _figures_of_identification,
}

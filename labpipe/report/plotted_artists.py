"""Lines, intervals, outlines and heat maps of a pair of axes, read back into series."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.container import ErrorbarContainer
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from labpipe.report.plotted import Numbers, Series


def series_of(axes: Axes) -> tuple[list[Series], bool]:
    """Every series of the axes, and whether nothing was left that is none."""
    bars, consumed = _error_bars(axes)
    found: list[Series] = []
    understood = True
    for artist in _content(axes):
        if artist in consumed:
            continue
        read = next((reader for kind, reader in READERS.items() if isinstance(artist, kind)), None)
        series = read(axes, artist) if read else None
        if series is None:
            understood = understood and isinstance(artist, Text) and bool(axes.images)
        else:
            found.extend(series)
    return _with_shades([*found, *bars]), understood


def _content(axes: Axes) -> list[Artist]:
    """What was drawn into the axes, in the order of drawing; texts too, for they may say something."""
    drawn = [*axes.images, *axes.collections, *axes.patches, *axes.lines, *(text for text in axes.texts if text.get_text())]
    return [artist for artist in drawn if artist.get_visible()]


def _name(artist: Artist) -> tuple[str, bool]:
    label = str(artist.get_label() or "")
    return ("", False) if not label or label.startswith("_") else (label, True)


def _plain(values: Any) -> Numbers:
    return np.asarray(np.ma.filled(np.ma.asarray(values, float), np.nan), float)


def _error_bars(axes: Axes) -> tuple[list[Series], set[Artist]]:
    """Points with bars; and the artists that they are made of."""
    found, consumed = [], set[Artist]()
    for container in axes.containers:
        if not isinstance(container, ErrorbarContainer) or container.lines[0] is None or container.has_xerr:
            continue
        points, caps, bars = container.lines
        consumed.update([points, *caps, *bars])
        ends = np.array([segment[:, 1] if len(segment) == 2 else (np.nan, np.nan) for segment in bars[0].get_segments()])
        name, labelled = _name(container)
        one = replace(_joined(points), name=name, labelled=labelled)
        found.append(replace(one, low=ends.min(axis=1), high=ends.max(axis=1), interval="bar") if len(ends) == len(one.x) else one)
    return found, consumed


def _line(axes: Axes, line: Line2D) -> list[Series] | None:
    across, along = line.get_transform().contains_branch_seperately(axes.transData)
    if across and along:
        return [_joined(line)]
    one = _joined(line)
    if along:
        return [replace(one, kind="hline", x=np.empty(0), y=one.y[:1])]
    return [replace(one, kind="vline", x=one.x[:1], y=np.empty(0))] if across else None


def _joined(line: Line2D) -> Series:
    name, labelled = _name(line)
    marker = "" if line.get_marker() in ("None", None, " ", "") else str(line.get_marker())
    style = "" if line.get_linestyle() in ("None", " ", "") else str(line.get_linestyle())
    size = float(line.get_markersize()) * (0.5 if marker == "." else 1.0)
    x, y = (_plain(values) for values in (line.get_xdata(), line.get_ydata()))
    return Series(
        "line",
        name,
        x,
        y,
        to_hex(line.get_color()),
        line=style,
        marker=marker,
        size=size if marker else 0.0,
        width=float(line.get_linewidth()),
        opacity=float(line.get_alpha() or 1.0),
        labelled=labelled,
        hollow=bool(marker) and str(line.get_markerfacecolor()) == "none",
    )


def _shade(axes: Axes, shade: PolyCollection) -> list[Series] | None:
    """A band between two curves over one abscissa; its gaps, where it has any, become NaN."""
    if not all(shade.get_transform().contains_branch_seperately(axes.transData)) or not len(shade.get_facecolor()):
        return None
    parts = [_between(path.vertices) for path in shade.get_paths()]
    if not parts or any(part is None for part in parts):
        return None
    gap = np.full((1, 3), np.nan)
    whole = np.vstack([rows for part in parts if part is not None for rows in (part, gap)])[:-1]
    x, low, high = whole.T
    name, labelled = _name(shade)
    colour, opacity = to_hex(shade.get_facecolor()[0]), float(shade.get_facecolor()[0][3])
    middle = np.full(x.size, np.nan)
    return [Series("line", name, x, middle, colour, low, high, "shaded", opacity=opacity, labelled=labelled)]


def _between(outline: Any) -> Numbers | None:
    """(n, 3) abscissa, lower and upper curve from the outline that matplotlib makes: start, one curve, end, the other backwards."""
    points = np.asarray(outline, float)
    n = (len(points) - 3) // 2
    if n < 1 or len(points) != 2 * n + 3:
        return None
    first, second = points[1 : n + 1], points[n + 2 : 2 * n + 2][::-1]
    if not np.array_equal(first[:, 0], second[:, 0]):
        return None
    pair = np.column_stack([first[:, 1], second[:, 1]])
    return np.column_stack([first[:, 0], pair.min(axis=1), pair.max(axis=1)])


def _patch(axes: Axes, patch: Patch) -> list[Series] | None:
    across, along = Artist.get_transform(patch).contains_branch_seperately(axes.transData)
    corners = patch.get_patch_transform().transform(patch.get_path().vertices)
    name, labelled = _name(patch)
    colour, opacity = to_hex(patch.get_facecolor()), float(patch.get_facecolor()[3])
    one = Series("area", name, corners[:, 0], corners[:, 1], colour, opacity=opacity, labelled=labelled)
    if across and along:
        return [one] if type(patch).__name__ == "Polygon" else None
    if along:
        return [replace(one, kind="hspan", x=np.empty(0), y=np.array([corners[:, 1].min(), corners[:, 1].max()]))]
    return [replace(one, kind="vspan", x=np.array([corners[:, 0].min(), corners[:, 0].max()]), y=np.empty(0))] if across else None


def _cells(axes: Axes, image: AxesImage) -> list[Series] | None:
    """A heat map whose cells lie at whole numbers; the texts that stand in them."""
    values = _plain(image.get_array())
    if values.ndim != 2:
        return None
    texts = {tuple(round(float(part)) for part in text.get_position()): text.get_text() for text in axes.texts}
    rows, columns = values.shape
    said = tuple(tuple(texts.get((c, r), f"{values[r, c]:.4g}") for c in range(columns)) for r in range(rows))
    fills = tuple(tuple(to_hex(image.cmap(image.norm(values[r, c]))) for c in range(columns)) for r in range(rows))
    return [Series("cells", "", np.arange(columns, dtype=float), values, "#000000", texts=said, fills=fills)]


def _with_shades(found: list[Series]) -> list[Series]:
    """A shade without a name belongs to the curve of its colour over the same abscissa."""
    kept = list(found)
    for shade in [one for one in found if one.interval == "shaded" and not one.labelled]:
        for place, one in enumerate(kept):
            if one.interval or one.kind != "line" or one.colour != shade.colour or not _covers(one.x, shade.x):
                continue
            low, high = (_at(one.x, shade.x, values) for values in (shade.low, shade.high))
            kept[place] = replace(one, low=low, high=high, interval="shaded")
            kept.remove(shade)
            break
    return kept


def _covers(x: Numbers, shade: Numbers) -> bool:
    return set(shade[np.isfinite(shade)].tolist()) <= set(x.tolist())


def _at(x: Numbers, places: Numbers, values: Numbers | None) -> Numbers:
    known = dict(zip(places.tolist(), [] if values is None else values.tolist(), strict=False))
    return np.array([known.get(place, np.nan) for place in x.tolist()])


READERS: dict[type[Artist], Callable[..., list[Series] | None]] = {
    Line2D: _line,
    PolyCollection: _shade,
    Patch: _patch,
    AxesImage: _cells,
}

"""The figures of a matrix of tests: points tested, coefficients over two conditions as lines and as a map, paths of the rest position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.quantities import to_display
from labpipe.records.condition_matrix import ConditionAxis, ConditionMatrix, MatrixPoint, Repeated
from labpipe.report.chart import PALETTE_SIZE, Axis, Chart, Panel, Series, cells, curve, look, named_ticks, stacked
from labpipe.report.document import Figure
from labpipe.report.wording import legible

MAP_HEIGHT = 0.42
ROOM = 1.1
# From here on, and below its inverse, numbers are written with an exponent.
READABLE = 1e6
CIRCLE = np.linspace(0.0, 2 * math.pi, 121)


def coverage_figure(matrix: ConditionMatrix) -> list[Figure]:
    """Number of tests at every combination of the first two conditions; nothing where there is one condition."""
    if len(matrix.axes) < 2:
        return []
    counts = np.zeros((len(matrix.axes[1].levels), len(matrix.axes[0].levels)), int)
    for point in matrix.points:
        counts[point.place[1], point.place[0]] += len(point.tests)
    texts = [[str(count) if count else "none" for count in row] for row in counts]
    chart = _map(matrix.axes, counts / max(counts.max(), 1) * 0.6, texts, "number of tests")
    return [Figure(chart, "Tests at each combination of conditions.", f"Map of the tests of {matrix.name}")]


def _map(axes: Sequence[ConditionAxis], values: np.ndarray, texts: Sequence[Sequence[str]], name: str) -> Chart:
    """A matrix (second, first) over the levels of two conditions, the first along the abscissa, the second upwards."""
    across, up = ([f"{axis.shown(level):.4g}" for level in axis.levels] for axis in axes[:2])
    x, y = (Axis(axis.name, _unit(axis), ticks=named_ticks(ticks)) for axis, ticks in zip(axes, (across, up[::-1]), strict=False))
    return stacked([Panel(x, y, (cells(values[::-1], texts[::-1], name),))], ROOM + MAP_HEIGHT * values.shape[0])


def _unit(axis: ConditionAxis) -> str:
    return legible(axis.shown_unit)


def coefficient_figures(matrix: ConditionMatrix, name: str) -> list[Figure]:
    """One figure of lines for every combination of the third and further conditions; of two conditions a map as well."""
    figures = []
    for further, points in _further(matrix).items():
        at = ", ".join(axis.text(axis.levels[n]) for axis, n in zip(matrix.axes[2:], further, strict=True))
        figures.append(_lines(matrix, name, points, at))
        if len(matrix.axes) > 1 and all(len(axis.levels) > 1 for axis in matrix.axes[:2]):
            figures.append(_value_map(matrix, name, points, at))
    return figures


def _further(matrix: ConditionMatrix) -> dict[tuple[int, ...], list[MatrixPoint]]:
    groups: dict[tuple[int, ...], list[MatrixPoint]] = {}
    for point in matrix.points:
        groups.setdefault(point.place[2:], []).append(point)
    return groups


def _valued(points: Sequence[MatrixPoint], name: str) -> list[tuple[MatrixPoint, Repeated]]:
    return [(point, value) for point in points if (value := point.value(name)) is not None]


def _lines(matrix: ConditionMatrix, name: str, points: Sequence[MatrixPoint], at: str) -> Figure:
    """The coefficient over the first condition, one line with bars for every level of the second; dashed: the theory."""
    first, unit = matrix.axes[0], matrix.unit_of(name)
    having = _valued(points, name)
    series: list[Series] = []
    expected: list[Series] = []
    second = sorted({point.place[1] for point, _ in having}) if len(matrix.axes) > 1 else [0]
    for number, place in enumerate(second):
        line = [(point, value) for point, value in having if len(matrix.axes) < 2 or point.place[1] == place]
        title = matrix.axes[1].text(matrix.axes[1].levels[place]) if len(matrix.axes) > 1 else "measured"
        series.append(_line(first, line, title, unit, number))
        expected.extend(_theory_line(first, line, unit, number))
    if expected:
        expected[0] = replace(expected[0], name="theory")
    chart = stacked([Panel(Axis(first.name, _unit(first)), Axis(name, legible(unit)), (*series, *expected))], 3.2)
    theory = "; dashed: theory" if expected else ""
    caption = f"{name} over {first.name}{f' at {at}' if at else ''}: means of repeats with 95 % intervals{theory}."
    return Figure(chart, caption, f"{name} of {matrix.name} over {first.name}")


def _abscissa(first: ConditionAxis, line: Sequence[tuple[MatrixPoint, Repeated]]) -> FloatArray:
    return np.array([first.shown(first.levels[point.place[0]]) for point, _ in line])


def _line(first: ConditionAxis, line: Sequence[tuple[MatrixPoint, Repeated]], title: str, unit: str, number: int) -> Series:
    y = np.array([to_display(value.parameter.value, unit) for _, value in line])
    ends = [value.parameter.ci95 or (value.parameter.value,) * 2 for _, value in line]
    low, high = (np.array([to_display(pair[end], unit) for pair in ends]) for end in (0, 1))
    colour, dash = look(number)
    return curve(title, _abscissa(first, line), y, colour, dash, marker="o", size=4.0, bars=(low, high))


def _theory_line(first: ConditionAxis, line: Sequence[tuple[MatrixPoint, Repeated]], unit: str, number: int) -> list[Series]:
    """The theory of a line in its colour, without a name; nothing where there is none."""
    theory = np.array([np.nan if value.theory is None else to_display(value.theory, unit) for _, value in line])
    has_theory = bool(np.any(np.isfinite(theory)))
    return [curve("", _abscissa(first, line), theory, number % PALETTE_SIZE, "--", width=0.9)] if has_theory else []


def _value_map(matrix: ConditionMatrix, name: str, points: Sequence[MatrixPoint], at: str) -> Figure:
    shape = (len(matrix.axes[1].levels), len(matrix.axes[0].levels))
    values = np.full(shape, np.nan)
    having = _valued(points, name)
    unit = matrix.unit_of(name)
    for point, value in having:
        values[point.place[1], point.place[0]] = to_display(value.parameter.value, unit)
    largest = float(np.nanmax(np.abs(values))) or 1.0
    texts = [[_plain(value) if np.isfinite(value) else "none" for value in row] for row in values]
    chart = _map(matrix.axes, np.nan_to_num(values / largest), texts, name)
    where = f" at {at}" if at else ""
    shown = f" [{legible(unit)}]" if legible(unit) else ""
    return Figure(chart, f"{name}{shown} over {matrix.axes[0].name} and {matrix.axes[1].name}{where}.", f"Map of {name} of {matrix.name}")


def _plain(value: float) -> str:
    """Four digits, zeros at the end too, without an exponent where the number is readable."""
    if not 1 / READABLE < abs(value) < READABLE:
        return f"{value:.4g}"
    return f"{float(f'{value:.4g}'):.{max(0, 3 - math.floor(math.log10(abs(value))))}f}"


def path_figure(matrix: ConditionMatrix) -> Figure:
    """The rest positions over the load, one line per level of the other conditions, within the clearance circle where it is known."""
    series: list[Series] = []
    for number, path in enumerate(matrix.paths):
        scale = 1e6 if path.clearance is None else 1.0 / path.clearance
        x, y = (scale * np.array([point.position[axis] for point in path.points]) for axis in (0, 1))
        colour, dash = look(number)
        series.append(curve(path.at or "rest position", x, y, colour, dash, marker="o", size=4.0))
    clearance = matrix.paths[0].clearance
    if clearance is not None:
        series.append(curve("clearance", np.cos(CIRCLE), np.sin(CIRCLE), 6, "-", width=0.7))
    unit, title = ("um", "{}") if clearance is None else ("", "{} / clearance")
    panel = Panel(Axis(title.format("x"), unit), Axis(title.format("y"), unit), tuple(series), equal=True)
    caption = "Rest position of the shaft as the load rises, one line per level of the other conditions."
    return Figure(stacked([panel], 5.0), caption, f"Path of the rest position of {matrix.name}")

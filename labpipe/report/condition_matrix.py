"""The part of a report that a matrix of tests fills: what was tested, every coefficient over the conditions,
figures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import difference_in, two_digits, with_error, written
from labpipe.quantities import to_display
from labpipe.records.comparison import (
    ConditionAxis,
    ConditionMatrices,
    ConditionMatrix,
    EquilibriumPath,
    MatrixPoint,
    Repeated,
    condition_unit,
)
from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import Identification
from labpipe.report.chart import (
    PALETTE_SIZE,
    Axis,
    Chart,
    Panel,
    Series,
    cells,
    curve,
    look,
    named_ticks,
    stack,
)
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.wording import legible, rounded

# The figures of a matrix of tests: points tested, coefficients over two conditions as lines and as a map,
# paths of the rest position.

MAP_HEIGHT = 0.42
ROOM = 1.1
# From here on, and below its inverse, numbers are written with an exponent.
READABLE = 1e6
CIRCLE = np.linspace(0.0, 2 * math.pi, 121)


def coverage_figure(matrix: ConditionMatrix) -> list[Figure]:
    """Number of tests at every combination of the first two conditions.

    Nothing where there is one condition.
    """
    if len(matrix.axes) < 2:
        return []
    counts = np.zeros((len(matrix.axes[1].levels), len(matrix.axes[0].levels)), int)
    for point in matrix.points:
        counts[point.place[1], point.place[0]] += len(point.tests)
    texts = [[str(count) if count else "none" for count in row] for row in counts]
    chart = _map(matrix.axes, counts / max(counts.max(), 1) * 0.6, texts, "number of tests")
    return [Figure(chart, "Tests at each combination of conditions.", f"Map of the tests of {matrix.name}")]


def _map(
    axes: Sequence[ConditionAxis], values: np.ndarray, texts: Sequence[Sequence[str]], name: str
) -> Chart:
    """A matrix (second, first) over the levels of two conditions, the first along the abscissa, the second
    upwards.
    """
    across, up = ([f"{axis.shown(level):.4g}" for level in axis.levels] for axis in axes[:2])
    x, y = (
        Axis(axis.name, _unit(axis), ticks=named_ticks(ticks))
        for axis, ticks in zip(axes, (across, up[::-1]), strict=False)
    )
    return stack(
        [Panel(x, y, (cells(values[::-1], texts[::-1], name),))], ROOM + MAP_HEIGHT * values.shape[0]
    )


def _unit(axis: ConditionAxis) -> str:
    return legible(axis.shown_unit)


def coefficient_figures(matrix: ConditionMatrix, name: str) -> list[Figure]:
    """One figure of lines for every combination of the third and further conditions.

    Of two conditions a map as well.
    """
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


def _values(points: Sequence[MatrixPoint], name: str) -> list[tuple[MatrixPoint, Repeated]]:
    return [(point, value) for point in points if (value := point.value(name)) is not None]


def _lines(matrix: ConditionMatrix, name: str, points: Sequence[MatrixPoint], at: str) -> Figure:
    """The coefficient over the first condition, one line with bars for every level of the second; dashed: the
    theory.
    """
    first, unit = matrix.axes[0], matrix.unit_of(name)
    having = _values(points, name)
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
    chart = stack(
        [Panel(Axis(first.name, _unit(first)), Axis(name, legible(unit)), (*series, *expected))], 3.2
    )
    theory = "; dashed: theory" if expected else ""
    caption = (
        f"{name} over {first.name}{f' at {at}' if at else ''}: means of repeats with 95 % intervals{theory}."
    )
    return Figure(chart, caption, f"{name} of {matrix.name} over {first.name}")


def _abscissa(first: ConditionAxis, line: Sequence[tuple[MatrixPoint, Repeated]]) -> FloatArray:
    return np.array([first.shown(first.levels[point.place[0]]) for point, _ in line])


def _line(
    first: ConditionAxis, line: Sequence[tuple[MatrixPoint, Repeated]], title: str, unit: str, number: int
) -> Series:
    y = np.array([to_display(value.parameter.value, unit) for _, value in line])
    ends = [value.parameter.ci95 or (value.parameter.value,) * 2 for _, value in line]
    low, high = (np.array([to_display(pair[end], unit) for pair in ends]) for end in (0, 1))
    colour, dash = look(number)
    return curve(title, _abscissa(first, line), y, colour, dash, marker="o", size=4.0, bars=(low, high))


def _theory_line(
    first: ConditionAxis, line: Sequence[tuple[MatrixPoint, Repeated]], unit: str, number: int
) -> list[Series]:
    """The theory of a line in its colour, without a name; nothing where there is none."""
    theory = np.array(
        [np.nan if value.theory is None else to_display(value.theory, unit) for _, value in line]
    )
    has_theory = bool(np.any(np.isfinite(theory)))
    return (
        [curve("", _abscissa(first, line), theory, number % PALETTE_SIZE, "--", width=0.9)]
        if has_theory
        else []
    )


def _value_map(matrix: ConditionMatrix, name: str, points: Sequence[MatrixPoint], at: str) -> Figure:
    shape = (len(matrix.axes[1].levels), len(matrix.axes[0].levels))
    values = np.full(shape, np.nan)
    having = _values(points, name)
    unit = matrix.unit_of(name)
    for point, value in having:
        values[point.place[1], point.place[0]] = to_display(value.parameter.value, unit)
    largest = float(np.nanmax(np.abs(values))) or 1.0
    texts = [[_plain(value) if np.isfinite(value) else "none" for value in row] for row in values]
    chart = _map(matrix.axes, np.nan_to_num(values / largest), texts, name)
    where = f" at {at}" if at else ""
    shown = f" [{legible(unit)}]" if legible(unit) else ""
    return Figure(
        chart,
        f"{name}{shown} over {matrix.axes[0].name} and {matrix.axes[1].name}{where}.",
        f"Map of {name} of {matrix.name}",
    )


def _plain(value: float) -> str:
    """Four digits, zeros at the end too, without an exponent where the number is readable."""
    if not 1 / READABLE < abs(value) < READABLE:
        return f"{value:.4g}"
    return f"{float(f'{value:.4g}'):.{max(0, 3 - math.floor(math.log10(abs(value))))}f}"


def path_figure(matrix: ConditionMatrix) -> Figure:
    """The rest positions over the load, one line per level of the other conditions, within the clearance
    circle where it is known.
    """
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
    return Figure(stack([panel], 5.0), caption, f"Path of the rest position of {matrix.name}")


# The part of a report that a matrix of tests fills: what was tested, every coefficient over the conditions,
# rest positions.

EXPLAINED = (
    "Each point is the weighted mean of its repeats. What noise leaves shrinks with their number, and is "
    "enlarged where they scatter more than it says; what is common to all of them, such as the uncertainty "
    "of a mass, does not shrink. Bars are 95 % intervals."
)
PATH_EXPLAINED = (
    "Rest positions are means of the repeats. The slope of the path over the load is a displacement per "
    "static force; beside it the same by the stiffness from shaking. A film that depends on amplitude, a "
    "probe that drifts or a support that carries a part of the load makes them differ."
)


def matrix_sections(
    matrices: ConditionMatrices,
    identification: Identification,  # noqa: ARG001
) -> tuple[Section, ...]:
    """Two sections for every matrix: the tests, then the coefficients; a third for rest positions."""
    return tuple(section for matrix in matrices for section in _sections(matrix))


def _sections(matrix: ConditionMatrix) -> tuple[Section, ...]:
    paths = [Section(f"Rest position: {matrix.name}", _path_blocks(matrix))] if matrix.paths else []
    return (
        Section(f"Test matrix: {matrix.name}", _matrix_blocks(matrix)),
        *_coefficient_sections(matrix),
        *paths,
    )


def _matrix_blocks(matrix: ConditionMatrix) -> tuple[Block, ...]:
    warnings = (Paragraph(finding.message, "warning") for finding in of_level(WARNING, matrix.findings))
    missing = [
        Paragraph(
            f"Without a test: {'; '.join(_place_text(matrix, place) for place in matrix.missing)}.", "note"
        )
    ]
    return (
        Paragraph(matrix.statement, "note"),
        *warnings,
        *(missing if matrix.missing else []),
        *coverage_figure(matrix),
        _points_table(matrix),
        Paragraph(
            "The pages of a single test are drawn on demand: labpipe report FOLDER --test "
            f"{matrix.points[0].tests[0]} -o FILE."
        ),
    )


def _place_text(matrix: ConditionMatrix, place: tuple[int, ...]) -> str:
    return ", ".join(axis.text(axis.levels[number]) for axis, number in zip(matrix.axes, place, strict=True))


def _points_table(matrix: ConditionMatrix) -> Table:
    """Every point with its tests, what stands beside, and warnings of its tests."""
    beside = [(entry.name, condition_unit(entry.name, entry.unit)) for entry in matrix.points[0].beside]
    header = (
        *_axis_titles(matrix),
        "tests",
        *(f"{name} [{unit}]" if unit != "1" else name for name, unit in beside),
        "warnings",
    )
    rows = tuple(
        (*_levels(matrix, point), str(len(point.tests)), *_beside(point), ", ".join(point.warnings) or "none")
        for point in matrix.points
    )
    return Table(
        header,
        rows,
        f"Points of {matrix.name}; beside: means over the tests ± their scatter",
        tuple(range(len(header) - 1)),
    )


def _axis_titles(matrix: ConditionMatrix) -> tuple[str, ...]:
    return tuple(
        f"{axis.name} [{axis.shown_unit}]" if axis.shown_unit != "1" else axis.name for axis in matrix.axes
    )


def _levels(matrix: ConditionMatrix, point: MatrixPoint) -> tuple[str, ...]:
    return tuple(
        f"{axis.shown(level):.4g}" for axis, level in zip(matrix.axes, matrix.levels_of(point), strict=True)
    )


def _beside(point: MatrixPoint) -> tuple[str, ...]:
    texts = []
    for entry in point.beside:
        unit = condition_unit(entry.name, entry.unit)
        value, scatter = to_display(entry.value, unit), _size(entry.scatter, unit)
        texts.append(with_error(value, scatter or None))
    return tuple(texts)


def _coefficient_sections(matrix: ConditionMatrix) -> tuple[Section, ...]:
    return tuple(
        Section(
            f"{name} over {' and '.join(axis.name for axis in matrix.axes)}",
            (
                *([Paragraph(EXPLAINED)] if number == 0 else []),
                *coefficient_figures(matrix, name),
                _coefficient_table(matrix, name),
            ),
        )
        for number, name in enumerate(matrix.names)
    )


def _coefficient_table(matrix: ConditionMatrix, name: str) -> Table:
    """The coefficient at every point with its uncertainty, the scatter of repeats and the theory."""
    having = [(point, value) for point in matrix.points if (value := point.value(name)) is not None]
    unit = matrix.unit_of(name)
    theory = any(value.theory is not None for _, value in having)
    shown = legible(unit)
    header = (
        *_axis_titles(matrix),
        f"{name} [{shown}]" if shown else name,
        "std. error",
        "95 % interval",
        "repeats",
        "scatter",
        *(["theory"] if theory else []),
    )
    cells = ((*_value_cells(value, unit), *([_theory(value, unit)] if theory else [])) for _, value in having)
    rows = tuple(
        (*_levels(matrix, point), *of_value) for (point, _), of_value in zip(having, cells, strict=True)
    )
    outside = (
        "; *: the theory lies outside the interval"
        if any(value.holds_theory is False for _, value in having)
        else ""
    )
    return Table(header, rows, f"{name} at every point{outside}", tuple(range(len(header))))


def _size(value: float | None, unit: str) -> float | None:
    """A difference in the display unit."""
    return None if value is None else abs(difference_in(value, unit))


def _value_cells(value: Repeated, unit: str) -> tuple[str, ...]:
    parameter = value.parameter
    error, scatter = _size(parameter.full_error, unit), _size(value.scatter, unit)
    ends = () if parameter.ci95 is None else tuple(to_display(end, unit) for end in parameter.ci95)
    shown, uncertainty, *interval = written(to_display(parameter.value, unit), error, *ends)
    return (
        shown,
        uncertainty or "none",
        " to ".join(interval) or "none",
        str(value.repeats),
        "" if scatter is None else two_digits(scatter, to_display(parameter.value, unit)),
    )


def _theory(value: Repeated, unit: str) -> str:
    if value.theory is None:
        return "none"
    inside = value.holds_theory
    expected = rounded(to_display(value.theory, unit), _size(value.parameter.full_error, unit))
    return f"{expected}{'' if inside is None or inside else ' *'}"


def _path_blocks(matrix: ConditionMatrix) -> tuple[Block, ...]:
    blocks: list[Block] = [Paragraph(PATH_EXPLAINED), path_figure(matrix)]
    blocks.extend(_path_table(path) for path in matrix.paths)
    return tuple(blocks)


def _path_table(path: EquilibriumPath) -> Table:
    rows = tuple(
        (
            f"{point.load:.4g}",
            *(
                rounded(1e6 * value, 1e6 * error)
                for value, error in zip(point.position, point.position_error, strict=True)
            ),
            f"{1e6 * point.eccentricity:.4g}"
            if path.clearance is None
            else f"{point.eccentricity / path.clearance:.4g}",
            f"{point.attitude * 180 / 3.141592653589793:.4g}",
            *_slopes(point.statics, point.statics_error),
            *_slopes(point.shaking, point.shaking_error),
            "" if point.p_value is None else f"{point.p_value:.2g}",
        )
        for point in path.points
    )
    header = (
        "load [N]",
        "x [um]",
        "y [um]",
        "e [um]" if path.clearance is None else "e / clearance",
        "attitude [deg]",
        "static slope x [nm/N]",
        "y [nm/N]",
        "by shaking x [nm/N]",
        "y [nm/N]",
        "p-value",
    )
    caption = (
        f"Rest positions{f' at {path.at}' if path.at else ''}; p-value: that static slope and shaking agree"
    )
    return Table(header, rows, caption, tuple(range(len(header))))


def _slopes(values: tuple[float, ...], errors: tuple[float, ...]) -> tuple[str, str]:
    if not values:
        return "none", "none"
    x, y = (with_error(1e9 * value, 1e9 * error) for value, error in zip(values, errors, strict=True))
    return x, y

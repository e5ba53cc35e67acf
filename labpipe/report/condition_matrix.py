"""The part of a report that a matrix of tests fills: what was tested, every coefficient over the conditions,
figures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from labpipe.display import difference_in, two_digits, with_error
from labpipe.quantities import to_display
from labpipe.records import comparison
from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import Identification
from labpipe.records.text import parameter_cells
from labpipe.report import chart
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.wording import legible, round_to_error, title

# A point with its value of a coefficient.
Valued = tuple[comparison.MatrixPoint, comparison.Repeated]
# Height of a row of a map, and room for its axes [in].
MAP_HEIGHT, ROOM = 0.42, 1.1
# From here on, and below its inverse, numbers are written with an exponent.
READABLE = 1e6
CIRCLE = np.linspace(0.0, 2 * math.pi, 121)


def coverage_figure(matrix: comparison.ConditionMatrix) -> list[Figure]:
    """Number of tests at every combination of the first two conditions, where there are two."""
    if len(matrix.axes) < 2:
        return []
    counts = np.zeros((len(matrix.axes[1].levels), len(matrix.axes[0].levels)), int)
    for point in matrix.points:
        counts[point.place[1], point.place[0]] += len(point.tests)
    texts = [[str(count) if count else "none" for count in row] for row in counts]
    graphic = _map(matrix.axes, counts / max(counts.max(), 1), texts, "tests / most tests")
    return [Figure(graphic, "Tests at each combination of conditions.", f"Map of the tests of {matrix.name}")]


def _map(
    axes: Sequence[comparison.ConditionAxis], values: np.ndarray, texts: Sequence[Sequence[str]], name: str
) -> chart.Chart:
    """A matrix (second, first) over the levels of two conditions, the first along the abscissa, the second
    upwards.
    """
    across, up = ([axis.digits(level) for level in axis.levels] for axis in axes[:2])
    x, y = (
        chart.Axis(axis.name, _unit(axis), ticks=chart.named_ticks(ticks))
        for axis, ticks in zip(axes, (across, up[::-1]), strict=False)
    )
    panel = chart.Panel(x, y, (chart.cells(values[::-1], texts[::-1], name),))
    return chart.stack([panel], ROOM + MAP_HEIGHT * values.shape[0])


def _unit(axis: comparison.ConditionAxis) -> str:
    return legible(axis.shown_unit)


def coefficient_figures(matrix: comparison.ConditionMatrix, name: str) -> list[Figure]:
    """Lines, and of two conditions a map, for every combination of the further conditions."""
    groups: dict[tuple[int, ...], list[Valued]] = {}
    for point in matrix.points:
        if (value := point.value(name)) is not None:
            groups.setdefault(point.place[2:], []).append((point, value))
    figures = []
    for further, having in groups.items():
        at = ", ".join(axis.text(axis.levels[n]) for axis, n in zip(matrix.axes[2:], further, strict=True))
        figures.append(_lines(matrix, name, having, at))
        if len(matrix.axes) > 1 and all(len(axis.levels) > 1 for axis in matrix.axes[:2]):
            figures.append(_value_map(matrix, name, having, at))
    return figures


def _lines(matrix: comparison.ConditionMatrix, name: str, having: Sequence[Valued], at: str) -> Figure:
    first, unit = matrix.axes[0], matrix.unit_of(name)
    series: list[chart.Series] = []
    expected: list[chart.Series] = []
    for number, second in enumerate(sorted({point.place[1:2] for point, _ in having})):
        line = [(point, value) for point, value in having if point.place[1:2] == second]
        title = matrix.axes[1].text(matrix.axes[1].levels[second[0]]) if second else "measured"
        x = np.array([first.show(first.levels[point.place[0]]) for point, _ in line])
        y = np.array([to_display(value.parameter.value, unit) for _, value in line])
        ends = [value.parameter.ci95 or (value.parameter.value,) * 2 for _, value in line]
        low, high = (np.array([to_display(pair[end], unit) for pair in ends]) for end in (0, 1))
        series.append(chart.curve(title, x, y, *chart.look(number), marker="o", size=4.0, bars=(low, high)))
        theory = [np.nan if value.theory is None else to_display(value.theory, unit) for _, value in line]
        if np.any(np.isfinite(theory)):
            entry = "" if expected else "theory"
            expected.append(chart.curve(entry, x, theory, number % chart.PALETTE_SIZE, "--", width=0.9))
    panel = chart.Panel(
        chart.Axis(first.name, _unit(first)), chart.Axis(name, legible(unit)), (*series, *expected)
    )
    where, dashed = f" at {at}" if at else "", "; dashed: theory" if expected else ""
    caption = f"{name} over {first.name}{where}: means of repeats with 95 % intervals{dashed}."
    return Figure(chart.stack([panel], 3.2), caption, f"{name} of {matrix.name} over {first.name}")


def _value_map(matrix: comparison.ConditionMatrix, name: str, having: Sequence[Valued], at: str) -> Figure:
    shape = (len(matrix.axes[1].levels), len(matrix.axes[0].levels))
    values, unit = np.full(shape, np.nan), matrix.unit_of(name)
    for point, value in having:
        values[point.place[1], point.place[0]] = to_display(value.parameter.value, unit)
    largest = float(np.nanmax(np.abs(values))) or 1.0
    texts = [[_number_text(value) if np.isfinite(value) else "none" for value in row] for row in values]
    graphic = _map(matrix.axes, np.nan_to_num(values / largest), texts, f"{name} / largest")
    where = f" at {at}" if at else ""
    caption = f"{title(name, unit)} over {matrix.axes[0].name} and {matrix.axes[1].name}{where}."
    return Figure(graphic, caption, f"Map of {name} of {matrix.name}")


def _number_text(value: float) -> str:
    """Four digits, zeros at the end too, without an exponent where the number is readable."""
    if not 1 / READABLE < abs(value) < READABLE:
        return f"{value:.4g}"
    return f"{float(f'{value:.4g}'):.{max(0, 3 - math.floor(math.log10(abs(value))))}f}"


def path_figure(matrix: comparison.ConditionMatrix) -> Figure:
    """The rest positions over the load, one line per level of the other conditions."""
    series: list[chart.Series] = []
    for number, path in enumerate(matrix.paths):
        scale = 1e6 if path.clearance is None else 1.0 / path.clearance
        x, y = (scale * np.array([point.position[axis] for point in path.points]) for axis in (0, 1))
        colour, dash = chart.look(number)
        series.append(chart.curve(path.at or "rest position", x, y, colour, dash, marker="o", size=4.0))
    clearance = matrix.paths[0].clearance
    if clearance is not None:
        series.append(chart.curve("clearance", np.cos(CIRCLE), np.sin(CIRCLE), 6, "-", width=0.7))
    unit, title = ("um", "{}") if clearance is None else ("", "{} / clearance")
    panel = chart.Panel(
        chart.Axis(title.format("x"), unit), chart.Axis(title.format("y"), unit), tuple(series), equal=True
    )
    caption = "Rest position of the shaft as the load rises, one line per level of the other conditions."
    return Figure(chart.stack([panel], 5.0), caption, f"Path of the rest position of {matrix.name}")


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
    matrices: comparison.ConditionMatrices,
    identification: Identification,  # noqa: ARG001
) -> tuple[Section, ...]:
    """Two sections for every matrix: the tests, then the coefficients; a third for rest positions."""
    sections: list[Section] = []
    for matrix in matrices:
        sections += [Section(f"Test matrix: {matrix.name}", _matrix_blocks(matrix))]
        sections += tuple(
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
        if matrix.paths:
            figure, tables = path_figure(matrix), map(_path_table, matrix.paths)
            blocks: tuple[Block, ...] = (Paragraph(PATH_EXPLAINED), figure, *tables)
            sections.append(Section(f"Rest position: {matrix.name}", blocks))
    return tuple(sections)


def _matrix_blocks(matrix: comparison.ConditionMatrix) -> tuple[Block, ...]:
    warnings = (Paragraph(finding.message, "warning") for finding in of_level(WARNING, matrix.findings))
    missing = "; ".join(
        ", ".join(axis.text(axis.levels[number]) for axis, number in zip(matrix.axes, place, strict=True))
        for place in matrix.missing
    )
    command = f"labpipe report FOLDER --test {matrix.points[0].tests[0]} -o FILE"
    return (
        Paragraph(matrix.statement, "note"),
        *warnings,
        *([Paragraph(f"Without a test: {missing}.", "note")] if missing else []),
        *coverage_figure(matrix),
        _points_table(matrix),
        Paragraph(f"The pages of a single test are drawn on demand: {command}."),
    )


def _points_table(matrix: comparison.ConditionMatrix) -> Table:
    beside = [
        title(entry.name, comparison.condition_unit(entry.name, entry.unit))
        for entry in matrix.points[0].beside
    ]
    header = (*_axis_titles(matrix), "tests", *beside, "warnings")
    rows = tuple(
        (
            *_levels(matrix, point),
            str(len(point.tests)),
            *_beside_cells(point),
            ", ".join(point.warnings) or "none",
        )
        for point in matrix.points
    )
    caption = f"Points of {matrix.name}; beside: means over the tests ± their scatter"
    return Table(header, rows, caption, tuple(range(len(header) - 1)))


def _axis_titles(matrix: comparison.ConditionMatrix) -> tuple[str, ...]:
    return tuple(title(axis.name, axis.shown_unit) for axis in matrix.axes)


def _levels(matrix: comparison.ConditionMatrix, point: comparison.MatrixPoint) -> tuple[str, ...]:
    return tuple(axis.digits(level) for axis, level in zip(matrix.axes, matrix.levels_of(point), strict=True))


def _beside_cells(point: comparison.MatrixPoint) -> tuple[str, ...]:
    units = [comparison.condition_unit(entry.name, entry.unit) for entry in point.beside]
    return tuple(
        with_error(to_display(entry.value, unit), _size(entry.scatter, unit) or None)
        for entry, unit in zip(point.beside, units, strict=True)
    )


def _coefficient_table(matrix: comparison.ConditionMatrix, name: str) -> Table:
    having = [(point, value) for point in matrix.points if (value := point.value(name)) is not None]
    unit = matrix.unit_of(name)
    none = "none" if any(value.theory is not None for _, value in having) else ""
    header = (title(name, unit), "std. error", "95 % interval", "repeats", "scatter", "theory")
    rows = tuple(
        (*_levels(matrix, point), *_value_cells(value, unit), _theory(value, unit) or none)
        for point, value in having
    )
    outside = any(value.holds_theory is False for _, value in having)
    caption = f"{name} at every point{'; *: the theory lies outside the interval' if outside else ''}"
    numeric = tuple(range(len(matrix.axes) + len(header)))
    return Table((*_axis_titles(matrix), *header), rows, caption, numeric)


def _size(value: float | None, unit: str) -> float | None:
    return None if value is None else abs(difference_in(value, unit))


def _value_cells(value: comparison.Repeated, unit: str) -> tuple[str, ...]:
    _, shown, error, interval, *_ = parameter_cells(value.parameter, unit)
    scatter = _size(value.scatter, unit)
    scattered = "" if scatter is None else two_digits(scatter, to_display(value.parameter.value, unit))
    return (shown, error or "none", interval or "none", str(value.repeats), scattered)


def _theory(value: comparison.Repeated, unit: str) -> str:
    if value.theory is None:
        return ""
    expected = round_to_error(to_display(value.theory, unit), _size(value.parameter.full_error, unit))
    return f"{expected} *" if value.holds_theory is False else expected


def _path_table(path: comparison.EquilibriumPath) -> Table:
    scale = 1e6 if path.clearance is None else 1.0 / path.clearance
    rows = tuple(
        (
            f"{point.load:.4g}",
            *(
                round_to_error(1e6 * value, 1e6 * error)
                for value, error in zip(point.position, point.position_error, strict=True)
            ),
            f"{scale * point.eccentricity:.4g}",
            f"{math.degrees(point.attitude):.4g}",
            *_slopes(point.statics, point.statics_error),
            *_slopes(point.shaking, point.shaking_error),
            "" if point.p_value is None else f"{point.p_value:.2g}",
        )
        for point in path.points
    )
    eccentricity = "e [um]" if path.clearance is None else "e / clearance"
    header = (
        "load [N]", "x [um]", "y [um]", eccentricity, "attitude [deg]", "static slope x [nm/N]", "y [nm/N]",
        "by shaking x [nm/N]", "y [nm/N]", "p-value",
    )  # fmt: skip
    where = f" at {path.at}" if path.at else ""
    caption = f"Rest positions{where}; p-value: that static slope and shaking agree"
    return Table(header, rows, caption, tuple(range(len(header))))


def _slopes(values: tuple[float, ...], errors: tuple[float, ...]) -> tuple[str, str]:
    if not values:
        return "none", "none"
    x, y = (with_error(1e9 * value, 1e9 * error) for value, error in zip(values, errors, strict=True))
    return x, y

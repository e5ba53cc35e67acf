"""The part of a report that a matrix of tests fills: what was tested, every coefficient over the conditions, rest positions."""

from __future__ import annotations

from labpipe.display import difference_in, two_digits, with_error, written
from labpipe.quantities import to_display
from labpipe.records.condition_matrix import ConditionMatrices, ConditionMatrix, EquilibriumPath, MatrixPoint, Repeated, condition_unit
from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import Identification
from labpipe.report.condition_figures import coefficient_figures, coverage_figure, path_figure
from labpipe.report.document import Block, Paragraph, Section, Table
from labpipe.report.wording import legible, rounded

EXPLAINED = (
    "Each point is the weighted mean of its repeats. What noise leaves shrinks with their number, and is enlarged where they scatter more "
    "than it says; what is common to all of them, such as the doubt of a mass, does not shrink. Bars are 95 % intervals."
)
PATH_EXPLAINED = (
    "Rest positions are means of the repeats. The slope of the path over the load is a displacement per static force; beside it the same "
    "by the stiffness from shaking. A film that depends on amplitude, a probe that drifts or a support that carries a part of the load "
    "makes them differ."
)


def matrix_sections(matrices: ConditionMatrices, identification: Identification) -> tuple[Section, ...]:  # noqa: ARG001
    """Two sections for every matrix: the tests, then the coefficients; a third for rest positions."""
    return tuple(section for matrix in matrices for section in _sections(matrix))


def _sections(matrix: ConditionMatrix) -> tuple[Section, ...]:
    paths = [Section(f"Rest position: {matrix.name}", _path_blocks(matrix))] if matrix.paths else []
    return (Section(f"Test matrix: {matrix.name}", _matrix_blocks(matrix)), *_coefficient_sections(matrix), *paths)


def _matrix_blocks(matrix: ConditionMatrix) -> tuple[Block, ...]:
    warnings = (Paragraph(finding.message, "warning") for finding in of_level(WARNING, matrix.findings))
    missing = [Paragraph(f"Without a test: {'; '.join(_place_text(matrix, place) for place in matrix.missing)}.", "note")]
    return (
        Paragraph(matrix.statement, "note"),
        *warnings,
        *(missing if matrix.missing else []),
        *coverage_figure(matrix),
        _points_table(matrix),
        Paragraph(f"The pages of a single test are drawn on demand: labpipe report FOLDER --test {matrix.points[0].tests[0]} -o FILE."),
    )


def _place_text(matrix: ConditionMatrix, place: tuple[int, ...]) -> str:
    return ", ".join(axis.text(axis.levels[number]) for axis, number in zip(matrix.axes, place, strict=True))


def _points_table(matrix: ConditionMatrix) -> Table:
    """Every point with its tests, what stands beside, and warnings of its tests."""
    beside = [(entry.name, condition_unit(entry.name, entry.unit)) for entry in matrix.points[0].beside]
    header = (*_axis_titles(matrix), "tests", *(f"{name} [{unit}]" if unit != "1" else name for name, unit in beside), "warnings")
    rows = tuple(
        (*_levels(matrix, point), str(len(point.tests)), *_beside(point), ", ".join(point.warnings) or "none") for point in matrix.points
    )
    return Table(header, rows, f"Points of {matrix.name}; beside: means over the tests ± their scatter", tuple(range(len(header) - 1)))


def _axis_titles(matrix: ConditionMatrix) -> tuple[str, ...]:
    return tuple(f"{axis.name} [{axis.shown_unit}]" if axis.shown_unit != "1" else axis.name for axis in matrix.axes)


def _levels(matrix: ConditionMatrix, point: MatrixPoint) -> tuple[str, ...]:
    return tuple(f"{axis.shown(level):.4g}" for axis, level in zip(matrix.axes, matrix.levels_of(point), strict=True))


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
            (*([Paragraph(EXPLAINED)] if number == 0 else []), *coefficient_figures(matrix, name), _coefficient_table(matrix, name)),
        )
        for number, name in enumerate(matrix.names)
    )


def _coefficient_table(matrix: ConditionMatrix, name: str) -> Table:
    """The coefficient at every point with its doubt, the scatter of repeats and the theory."""
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
    rows = tuple((*_levels(matrix, point), *of_value) for (point, _), of_value in zip(having, cells, strict=True))
    outside = "; *: the theory lies outside the interval" if any(value.holds_theory is False for _, value in having) else ""
    return Table(header, rows, f"{name} at every point{outside}", tuple(range(len(header))))


def _size(value: float | None, unit: str) -> float | None:
    """A difference in the display unit."""
    return None if value is None else abs(difference_in(value, unit))


def _value_cells(value: Repeated, unit: str) -> tuple[str, ...]:
    parameter = value.parameter
    error, scatter = _size(parameter.full_error, unit), _size(value.scatter, unit)
    ends = () if parameter.ci95 is None else tuple(to_display(end, unit) for end in parameter.ci95)
    shown, doubt, *interval = written(to_display(parameter.value, unit), error, *ends)
    return (
        shown,
        doubt or "none",
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
            *(rounded(1e6 * value, 1e6 * error) for value, error in zip(point.position, point.position_error, strict=True)),
            f"{1e6 * point.eccentricity:.4g}" if path.clearance is None else f"{point.eccentricity / path.clearance:.4g}",
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
    caption = f"Rest positions{f' at {path.at}' if path.at else ''}; p-value: that static slope and shaking agree"
    return Table(header, rows, caption, tuple(range(len(header))))


def _slopes(values: tuple[float, ...], errors: tuple[float, ...]) -> tuple[str, str]:
    if not values:
        return "none", "none"
    x, y = (with_error(1e9 * value, 1e9 * error) for value, error in zip(values, errors, strict=True))
    return x, y

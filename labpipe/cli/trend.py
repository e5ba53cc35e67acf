"""labpipe trend [FOLDER] -p PARAMETER --over CONDITION"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.mirrored import results_read
from labpipe.catalogue.index import DATE
from labpipe.catalogue.query import Filter
from labpipe.catalogue.search import found_values
from labpipe.catalogue.trends import Series, trends, undated
from labpipe.cli import options
from labpipe.cli.columns import echo_table, value_cells
from labpipe.cli.list import row_entry
from labpipe.cli.output import echo
from labpipe.display import difference_in, number, unit_label, with_error
from labpipe.errors import DataError, cut
from labpipe.formats.rows_csv import write_rows
from labpipe.places.address import shown as shown_path
from labpipe.quantities import readable_unit, to_display
from labpipe.stages.report import format_of, write_campaign

LEVEL = 0.05


@click.command()
@click.argument("folder", type=options.PLACE, default=Path("."))
@click.option("-p", "--parameter", required=True, help="The parameter; '*' matches any characters.")
@click.option("--over", required=True, metavar="CONDITION", help="A condition of the tests such as preload, or `date`.")
@options.catalogue_filters
@click.option("--csv", "table", type=options.PATH, help="Write the values, in SI units, to this file.")
@click.option(
    "-o", "--output", type=options.PATH, metavar="FILE", help="Also write the campaign report of these results (.html, .pdf, .md)."
)
def trend(folder: Path, parameter: str, over: str, table: Path | None, output: Path | None, **filters: object) -> None:
    """Show a parameter over a condition in all results below FOLDER: values, slope, and over `date` control limits.

    FOLDER may be s3://bucket/prefix. The line is weighted by the standard errors; control limits are mean -+ 3 x mean moving range /
    1.128 in the order of the dates.
    """
    if output is not None:
        format_of(output)
    with results_read(folder) as here:
        rows = found_values(here, Filter(parameter=parameter, **filters))  # type: ignore[arg-type]
        results = {} if output is None else {path: read_identification(here / path) for path in sorted({row.path for row in rows})}
    all_series = trends(rows, over)
    for row in undated(rows) if over == DATE else ():
        echo(f"warning: {row.path}: test '{row.test}': '{cut(row.date)}' is not a date; write it as 2026-11-03", err=True)
    selected = [row for series in all_series for row in series.rows]
    if not selected:
        raise DataError("no result matches these filters", where=shown_path(folder))
    for series in all_series:
        _echo_series(series)
    if table is not None:
        write_rows(table, [row_entry(row) for row in selected])
    if output is not None:
        chosen = {row.path for row in selected}
        write_campaign([(path.removesuffix("/identification.json"), result) for path, result in results.items() if path in chosen], output)
        echo(f"written: {output}", err=True)


def _echo_series(series: Series) -> None:
    echo(f"{series.parameter} of {series.fit} over {series.over}")
    # Over conditions other than time, values are expected to differ.
    outside = set(map(id, series.outside)) if series.over == DATE else set()
    rows = []
    shown = _unit(series)
    for x, row in zip(series.condition, series.rows, strict=True):
        mark = "out of control" if id(row) in outside else row.warnings
        rows.append(
            (f"  {x:g} {series.condition_unit}", *value_cells(row.value, row.std_error, row.unit, shown), row.label, row.date, mark)
        )
    echo_table((f"  {series.over}", series.parameter, "std. error", "unit", "test", "date", ""), rows, right=(1, 2))
    echo(f"  {_slope(series)}")
    if series.over == DATE:
        echo(f"  {_control(series)}")


def _unit(series: Series) -> str:
    """The unit of all values."""
    return readable_unit(series.unit, (row.value for row in series.rows))


def _slope(series: Series) -> str:
    """The slope in words, in display units."""
    line = series.line
    if line is None:
        return "no trend can be computed: at least three values with standard errors at different conditions are required"
    unit = _unit(series)
    slope, error = (difference_in(value, unit) for value in (float(line.values[1]), line.std_error(1)))
    reach, p_value = line.quantile * error, line.p_of(1)
    per = series.condition_unit.split(" ")[0]
    verdict = "no trend" if p_value >= LEVEL else "rising" if slope > 0 else "falling"
    scatter = "; the values scatter more than their errors, which are enlarged" if line.inflated else ""
    return f"slope {with_error(slope, reach, unit, '+-')} per {per} (95 %): {verdict}, p = {p_value:.2g}{scatter}"


def _control(series: Series) -> str:
    limits = series.limits
    if limits is None:
        return "fewer than three values give no control limits"
    unit = _unit(series)
    low, high = (to_display(value, unit) for value in (limits.low, limits.high))
    beyond = ", ".join(row.label for row in series.outside) or "none"
    return f"control limits {' '.join(filter(None, (number(low), 'to', number(high), unit_label(unit))))}: beyond {beyond}"

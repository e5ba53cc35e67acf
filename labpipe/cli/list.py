"""labpipe list [FOLDER]"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import click

from labpipe.artefacts.mirrored import results_read
from labpipe.catalogue.query import Filter, ResultRow, ValueRow
from labpipe.catalogue.search import found_results, found_values
from labpipe.cli import options
from labpipe.cli.columns import echo_table, value_cells
from labpipe.cli.output import echo
from labpipe.formats.rows_csv import write_rows
from labpipe.quantities import readable_unit


@click.command(name="list")
@click.argument("folder", type=options.PLACE, default=Path("."))
@click.option("-p", "--parameter", default="", help="Show the values of a parameter; '*' matches any characters.")
@options.catalogue_filters
@click.option("--csv", "table", type=options.PATH, help="Write all columns, in SI units, to this file.")
def list_results(folder: Path, parameter: str, table: Path | None, **filters: object) -> None:
    """List the results below FOLDER, or their parameter values.

    FOLDER may be s3://bucket/prefix. Every identification.json counts. Conditions are written as `--where "preload >= 400 N"`; all of
    them must hold. The date is the test's condition `date`, or else that of the file.
    """
    criteria = Filter(parameter=parameter, **filters)  # type: ignore[arg-type]
    find = found_values if _selects_values(criteria) else found_results
    with results_read(folder) as here:
        rows: Sequence[ValueRow | ResultRow] = find(here, criteria)
    if table is not None:
        write_rows(table, [row_entry(row) for row in rows])
    if not rows:
        echo("nothing found")
    elif isinstance(rows[0], ValueRow):
        echo_values([row for row in rows if isinstance(row, ValueRow)])
    else:
        echo_results([row for row in rows if isinstance(row, ResultRow)])


def _selects_values(criteria: Filter) -> bool:
    return bool(criteria.parameter or criteria.fit or criteria.test)


def row_entry(row: ValueRow | ResultRow) -> dict[str, object]:
    """A row with one column per condition, as written in the pipeline."""
    entry = {field.name: getattr(row, field.name) for field in dataclasses.fields(row)}
    conditions = entry.pop("conditions", {})
    entry.pop("amounts", None)
    return {**entry, **{f"condition:{name}": text for name, text in conditions.items()}}


def echo_results(rows: Sequence[ResultRow]) -> None:
    """One line for each result."""
    header = ("date", "result", "rig", "tests", "verdict", "warnings")
    lines = [(row.date, row.path.removesuffix("/identification.json"), row.rig, str(row.tests), row.verdict, _remark(row)) for row in rows]
    echo_table(header, lines, right=(3,))


def _remark(row: ResultRow) -> str:
    return row.fault or row.warnings


def echo_values(rows: Sequence[ValueRow]) -> None:
    """One line for each value, with the conditions of its test."""
    names = list(dict.fromkeys(name for row in rows for name in row.conditions))
    header = ("result", "test", "fit", "band", "parameter", "value", "std. error", "unit", *names, "warnings")
    lines = []
    units = _units(rows)
    for row in rows:
        fit = f"{row.fit} of {row.term}" if row.term else row.fit
        band = f"{row.low_hz:g}-{row.high_hz:g} Hz" if row.high_hz > row.low_hz else ""
        cells = value_cells(row.value, row.std_error, row.unit, units[row.parameter, row.unit])
        conditions = [row.conditions.get(name, "") for name in names]
        lines.append((row.path.removesuffix("/identification.json"), row.test, fit, band, row.parameter, *cells, *conditions, row.warnings))
    echo_table(header, lines, right=(5, 6))


def _units(rows: Sequence[ValueRow]) -> dict[tuple[str, str], str]:
    """One unit for all values of a parameter."""
    sizes: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        sizes.setdefault((row.parameter, row.unit), []).append(row.value)
    return {key: readable_unit(key[1], values) for key, values in sizes.items()}

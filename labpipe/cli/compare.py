"""labpipe compare A B"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click

from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.catalogue.differences import LEVEL, Difference, differences
from labpipe.cli import options
from labpipe.cli.columns import echo_table
from labpipe.formats.rows_csv import write_rows
from labpipe.quantities import display_unit, to_display
from labpipe.records.identification import Identification


@click.command()
@click.argument("first", type=options.PATH)
@click.argument("second", type=options.PATH)
@click.option("-p", "--parameter", multiple=True, help="Show only this parameter (repeatable); the correction counts all of them.")
@click.option("--csv", "table", type=options.PATH, help="Write all columns, in SI units, to this file.")
def compare(first: Path, second: Path, parameter: tuple[str, ...], table: Path | None) -> None:
    """Hold the result SECOND against FIRST (folders or identification.json), parameter by parameter.

    The p-value is the chance of so large a difference by the stated errors alone, corrected for the number of parameters (Holm).
    """
    found = differences(_result(first), _result(second))
    shown = [one for one in found if not parameter or one.parameter in parameter]
    if table is not None:
        write_rows(table, [dataclasses.asdict(one) for one in shown])
    if shown:
        header = ("fit", "test", "parameter", "first", "second", "difference", "std. error", "unit", "p", "")
        echo_table(header, [_cells(one) for one in shown], right=(3, 4, 5, 6, 8))
    told = [one for one in found if one.p_value is not None]
    click.echo(f"{sum(one.differs for one in told)} of {len(told)} parameters differ (level {100 * LEVEL:g} %, corrected for their number)")


def _result(path: Path) -> Identification:
    return read_identification(path / NAME if path.is_dir() else path)


def _cells(one: Difference) -> tuple[str, ...]:
    """A row in one unit, the one that suits the first value; a difference has no zero of its own (degC)."""
    unit = display_unit(one.unit, one.first)
    first, second, change = (to_display(value, unit) for value in (one.first, one.second, one.second - one.first))
    change -= to_display(0.0, unit)
    error = "" if one.std_error is None else f"{to_display(one.std_error, unit) - to_display(0.0, unit):.2g}"
    p_value = "" if one.p_value is None else f"{one.p_value:.2g}"
    numbers = f"{first:.6g}", f"{second:.6g}", f"{change:.4g}", error, "" if unit == "1" else unit
    return one.fit, one.test, one.parameter, *numbers, p_value, "differs" if one.differs else ""

"""labpipe compare A B"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click

from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.mirrored import results_read
from labpipe.catalogue.dataset import dataset_parameters
from labpipe.catalogue.differences import LEVEL, Difference, differences
from labpipe.cli import options
from labpipe.cli.columns import echo_table
from labpipe.cli.output import echo
from labpipe.display import difference_in, shown_unit, unit_label, written
from labpipe.formats.rows_csv import write_rows
from labpipe.quantities import to_display
from labpipe.records.listed import ListedParameter, of_fit


@click.command()
@click.argument("first", type=options.PLACE)
@click.argument("second", type=options.PLACE)
@click.option("-p", "--parameter", multiple=True, help="Show only this parameter (repeatable); the correction counts all of them.")
@click.option("--csv", "table", type=options.PATH, help="Write all columns, in SI units, to this file.")
def compare(first: Path, second: Path, parameter: tuple[str, ...], table: Path | None) -> None:
    """Compare the result SECOND with FIRST (folders or identification.json), parameter by parameter.

    Either may be s3://bucket/prefix. The p-value is the probability of so large a difference by the standard errors alone, corrected for
    the number of parameters (Holm).
    """
    pairs = differences(_parameters(first), _parameters(second))
    selected = [pair for pair in pairs if not parameter or pair.parameter in parameter]
    if table is not None:
        write_rows(table, [dataclasses.asdict(pair) for pair in selected])
    if selected:
        header = ("fit", "test", "parameter", "first", "second", "difference", "std. error", "unit", "p", "")
        echo_table(header, [_cells(pair) for pair in selected], right=(3, 4, 5, 6, 8))
    tested = [pair for pair in pairs if pair.p_value is not None]
    n_different = sum(pair.differs for pair in tested)
    echo(f"{n_different} of {len(tested)} parameters differ (level {100 * LEVEL:g} %, corrected for their number)")


def _parameters(path: Path) -> list[ListedParameter]:
    """The parameters of all fits of a result, or of the dataset that it sums up."""
    with results_read(path) as here:
        file = here / NAME if here.is_dir() else here
        identification = read_identification(file)
        if identification.dataset is not None:
            return dataset_parameters(file.parent)
        return [listed for fit in identification.fits for listed in of_fit(fit)]


def _cells(pair: Difference) -> tuple[str, ...]:
    """A row in one unit, all numbers to the place that the error of the difference supports; differences have no offset (degC)."""
    unit = shown_unit(pair.unit, pair.first, pair.second)
    error = None if pair.std_error is None else difference_in(pair.std_error, unit)
    change = difference_in(pair.second - pair.first, unit)
    difference, doubt, first, second = written(change, error, *(to_display(value, unit) for value in (pair.first, pair.second)))
    p_value = "" if pair.p_value is None else f"{pair.p_value:.2g}"
    numbers = first, second, difference, doubt, unit_label(unit)
    return pair.fit, pair.test, pair.parameter, *numbers, p_value, "differs" if pair.differs else ""

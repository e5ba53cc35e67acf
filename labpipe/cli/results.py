"""labpipe list, trend, compare: results below a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import click

from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.mirrored import read_results
from labpipe.artefacts.writing import show as shown_path, write_rows
from labpipe.cli import options
from labpipe.cli.output import echo, echo_table, for_terminal, value_cells
from labpipe.display import chance_text, difference_in, shown_unit, unit_label, with_error, write_values
from labpipe.errors import ConfigError, DataError, shorten
from labpipe.project import catalogue_search
from labpipe.project.catalogue import NOT_COLUMNS, Filter, ResultRow, ValueRow, name_of
from labpipe.project.report import format_of, write_campaign
from labpipe.quantities import readable_unit, to_display
from labpipe.records.dataset import DATE, day_of
from labpipe.records.identification import ListedParameter, listed_parameters
from labpipe.registry import few, list_names, nearest
from labpipe.uncertainty import weighted


@click.command(name="list")
@click.argument("folder", type=options.PLACE, default=Path("."))
@click.option(
    "-p", "--parameter", default="", help="Show the values of a parameter; '*' matches any characters."
)
@options.catalogue_filters
@click.option("--csv", "table", type=options.PATH, help="Write all columns, in SI units, to this file.")
def list_results(folder: Path, parameter: str, table: Path | None, **filters: object) -> None:
    """List the results below FOLDER, or their parameter values.

    FOLDER may be s3://bucket/prefix. Every identification.json counts. Conditions are written as `--where
    "preload >= 400 N"`; all of them must hold. The date is the test's condition `date`, else that of its
    run in a record of runs, else that of the file.
    """
    criteria = Filter(parameter=parameter, **filters)  # type: ignore[arg-type]
    find = (
        catalogue_search.found_values
        if criteria.parameter or criteria.fit or criteria.test or criteria.source
        else catalogue_search.found_results
    )
    with read_results(folder) as here:
        rows: Sequence[ValueRow | ResultRow] = find(here, criteria)
    if table is not None:
        write_rows(table, [row_entry(row) for row in rows])
    if not rows:
        echo("nothing found")
    elif isinstance(rows[0], ValueRow):
        echo_values([row for row in rows if isinstance(row, ValueRow)])
    else:
        echo_results([row for row in rows if isinstance(row, ResultRow)])


def row_entry(row: ValueRow | ResultRow) -> dict[str, object]:
    """A row with one column per condition, as written in the pipeline."""
    entry = {field.name: getattr(row, field.name) for field in fields(row)}
    conditions = entry.get("conditions", {})
    for name in NOT_COLUMNS:
        entry.pop(name, None)
    return {**entry, **{f"condition:{name}": text for name, text in conditions.items()}}


def echo_results(rows: Sequence[ResultRow]) -> None:
    header = ("date", "result", "rig", "tests", "verdict", "warnings")
    lines = [
        (row.date, name_of(row.path), row.rig, str(row.tests), row.verdict, row.fault or row.warnings)
        for row in rows
    ]
    echo_table(header, lines, right=(3,))


def echo_values(rows: Sequence[ValueRow]) -> None:
    """One line for each value, with the conditions of its test."""
    names = list(dict.fromkeys(name for row in rows for name in row.conditions))
    header = ("result", "test", "fit", "band", "parameter", "value", "std. error", "unit", *names, "warnings")
    lines = []
    units = _units(rows)
    for row in rows:
        cells = value_cells(row.value, row.std_error, row.unit, units[row.parameter, row.unit])
        conditions = [row.conditions.get(name, "") for name in names]
        first = (name_of(row.path), row.test, row.title, row.band, row.parameter)
        lines.append((*first, *cells, *conditions, row.warnings))
    echo_table(header, lines, right=(5, 6))


def _units(rows: Sequence[ValueRow]) -> dict[tuple[str, str], str]:
    sizes: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        sizes.setdefault((row.parameter, row.unit), []).append(row.value)
    return {key: readable_unit(key[1], values) for key, values in sizes.items()}


@click.command()
@click.argument("folder", type=options.PLACE, default=Path("."))
@click.option("-p", "--parameter", required=True, help="The parameter; '*' matches any characters.")
@click.option(
    "--over", required=True, metavar="CONDITION", help="A condition of the tests such as preload, or `date`."
)
@options.catalogue_filters
@click.option("--csv", "table", type=options.PATH, help="Write the values, in SI units, to this file.")
@options.path("-o", "--output", help="Also write the campaign report of these results (.html, .pdf, .md).")
def trend(
    folder: Path, parameter: str, over: str, table: Path | None, output: Path | None, **filters: object
) -> None:
    """Show a parameter over a condition in all results below FOLDER: values, slope, and over `date` control
    limits.

    FOLDER may be s3://bucket/prefix. The line is weighted by the standard errors. Control limits are of
    values without their trends over other conditions; 5 % of sound campaigns have one beyond.
    """
    if output is not None:
        format_of(output)
    criteria = Filter(parameter=parameter, **filters)  # type: ignore[arg-type]
    with read_results(folder) as here:
        rows = catalogue_search.found_values(here, criteria)
        paths = [] if output is None else sorted({row.path for row in rows})
        results = {path: read_identification(here / path) for path in paths}
    all_series = catalogue_search.trends(rows, over)
    for row in rows if over == DATE else ():
        if day_of(row.date) is not None:
            continue
        what = f"test '{row.test}': '{shorten(row.date)}' is not a date; write it as 2026-11-03"
        echo(f"warning: {row.path}: {what}", err=True)
    selected = [row for series in all_series for row in series.rows]
    if not selected:
        raise DataError("no result matches these filters", shown_path(folder))
    for adjusted in weighted.adjust(all_series, weighted.trends_of(all_series)):
        _echo_series(adjusted)
    for dated in dict.fromkeys(row.dated for row in selected if row.dated) if over == DATE else ():
        names = dict.fromkeys(name_of(row.path) for row in selected if row.dated == dated)
        echo(f"note: {list_names(list(names))}: without a condition `date`, dated by {dated}", err=True)
    if table is not None:
        write_rows(table, [row_entry(row) for row in selected])
    if output is not None:
        chosen = {row.path for row in selected}
        named = [(name_of(path), result) for path, result in results.items() if path in chosen]
        write_campaign(named, output)
        echo(f"written: {output}", err=True)


def _echo_series(adjusted: weighted.Adjusted[catalogue_search.ParameterSeries]) -> None:
    series = adjusted.series
    echo(f"{series.parameter} of {series.fit} over {series.over}")
    # Over conditions other than time, values are expected to differ.
    limits = adjusted.limits if series.over == DATE else None
    rows = []
    shown = _unit(series)
    for place, (x, row) in enumerate(zip(series.condition, series.rows, strict=True)):
        mark = "out of control" if limits and place in limits.outside else row.warnings
        cells = value_cells(row.value, row.std_error, row.unit, shown)
        start = f"  {x:g} {unit_label(series.condition_unit)}".rstrip()
        rows.append((start, *cells, row.label, row.date, mark))
    header = (f"  {series.over}", series.parameter, "std. error", "unit", "test", "date", "")
    echo_table(header, rows, right=(1, 2))
    if series.copies:
        which = list_names(
            list(dict.fromkeys(f"{row.label} of {name_of(row.path)}" for row in series.copies))
        )
        echo(f"  left out, since a recording counts once: {which}")
    echo(f"  {_slope(series)}")
    if series.over == DATE:
        echo(f"  {_control(adjusted)}")


def _unit(series: catalogue_search.ParameterSeries) -> str:
    return readable_unit(series.unit, (row.value for row in series.rows))


def _slope(series: catalogue_search.ParameterSeries) -> str:
    line = series.line_over(series.over)
    if line is None:
        return (
            "no trend can be computed: at least three values with standard errors at different "
            "conditions are required"
        )
    unit = _unit(series)
    slope, error = (difference_in(value, unit) for value in (float(line.values[1]), line.std_error(1)))
    reach, p_value = line.quantile(1) * error, line.p_of(1)
    per = unit_label(series.condition_unit.split(" ")[0]) or f"unit of {series.over}"
    verdict = weighted.trend_verdict(slope, line.curved, sure=p_value < weighted.LEVEL)
    scatter = f"; {line.curved}" if line.curved else ""
    scatter += "; the values scatter more than their errors, which are enlarged" if line.inflated else ""
    _, *others = series.joint_conditions(series.over)[0]
    held = f", at {' and '.join(others)} held" if others else ""
    stated = f"slope {with_error(slope, reach, unit, '+-')} per {per} (95 %){held}"
    return for_terminal(f"{stated}: {verdict}, {chance_text(p_value)}{scatter}")


def _control(adjusted: weighted.Adjusted[catalogue_search.ParameterSeries]) -> str:
    series, limits = adjusted.series, adjusted.limits
    if limits is None:
        return "fewer than three values give no control limits"
    unit = _unit(series)
    centre, *ends = (to_display(value, unit) for value in (limits.centre, limits.low, limits.high))
    _, _, low, high = write_values(centre, difference_in(limits.rounding, unit), *ends)
    beyond = ", ".join(series.rows[place].label for place in limits.outside) or "none"
    of = f" of {series.parameter}{adjusted.without}" if adjusted.conditions else ""
    return f"control limits {f'{low} to {high} {unit_label(unit)}'.rstrip()}{of}: beyond {beyond}"


# Parameters without a partner that `compare` names.
MOST_NAMED = 6


@click.command()
@click.argument("first", type=options.PLACE)
@click.argument("second", type=options.PLACE)
@click.option(
    "-p",
    "--parameter",
    multiple=True,
    help="Show only this parameter (repeatable); the correction counts all of them.",
)
@click.option("--csv", "table", type=options.PATH, help="Write all columns, in SI units, to this file.")
@click.option(
    "--exit-code",
    is_flag=True,
    help="End with 1 where a value differs, or cannot be judged, or is in one result alone.",
)
def compare(
    first: Path, second: Path, parameter: tuple[str, ...], table: Path | None, exit_code: bool
) -> int:
    """Compare the result SECOND with FIRST (folders or identification.json), parameter by parameter.

    Either may be s3://bucket/prefix. The p-value is the probability of so large a difference by the standard
    errors alone, corrected for the number of parameters (Holm). The exit code is 0 whatever differs, without
    --exit-code; with -p this is of the parameters shown.
    """
    (mine, digests), (others, digests_there) = _parameters(first), _parameters(second)
    pairs = catalogue_search.differences(mine, others)
    in_both = dict.fromkeys(pair.parameter for pair in pairs)
    if unknown := [name for name in parameter if name not in in_both]:
        raise ConfigError(
            f"--parameter: '{unknown[0]}' is not in both results", hint=nearest(unknown[0], in_both)
        )
    selected = [pair for pair in pairs if not parameter or pair.parameter in parameter]
    if table is not None:
        write_rows(table, [asdict(pair) for pair in selected])
    if selected:
        header = ("fit", "test", "parameter", "first", "second", "difference", "std. error", "unit", "p", "")
        echo_table(header, [_cells(pair) for pair in selected], right=(3, 4, 5, 6, 8))
    tested = [pair for pair in pairs if pair.p_value is not None]
    n_different = sum(pair.differs for pair in tested)
    level = f"level {100 * weighted.LEVEL:g} %, corrected for their number"
    echo(f"{n_different} of {len(tested)} parameters differ ({level})")
    alone = [*catalogue_search.lone_parameters(mine, others)]
    for which, names in zip(("first", "second"), alone, strict=True):
        if names:
            echo(f"not compared, in the {which} alone: {few(names, MOST_NAMED, '; ')}")
    shared = digests & digests_there
    if shared and shared in (digests, digests_there):
        echo("both come from the same files: the noise that they share makes no difference")
    is_same = all(pair.is_same for pair in selected) and (bool(parameter) or not any(alone))
    return int(exit_code and not is_same)


def _parameters(path: Path) -> tuple[list[ListedParameter], frozenset[str]]:
    with read_results(path) as here:
        file = here / NAME if here.is_dir() else here
        identification = read_identification(file)
        if identification.dataset is not None:
            return catalogue_search.dataset_parameters(file.parent), identification.digests
        return list(listed_parameters(identification)), identification.digests


def _cells(pair: catalogue_search.Difference) -> tuple[str, ...]:
    unit = shown_unit(pair.unit, pair.first, pair.second)
    error = None if pair.std_error is None else difference_in(pair.std_error, unit)
    change = difference_in(pair.second - pair.first, unit)
    difference, uncertainty, first, second = write_values(
        change, error, *(to_display(value, unit) for value in (pair.first, pair.second))
    )
    p_value = "" if pair.p_value is None else chance_text(pair.p_value).removeprefix("p ").removeprefix("= ")
    numbers = first, second, difference, uncertainty, unit_label(unit)
    return pair.fit, pair.test, pair.parameter, *numbers, p_value, "differs" if pair.differs else ""

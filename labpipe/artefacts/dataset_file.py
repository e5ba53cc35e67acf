"""``dataset/rig=RIG/date=DATE/part-....results.parquet``: the results of many tests as rows, for labpipe and
for whatever reads Parquet, and their columns for reports.

Schema "labpipe/results/1": a row of `DatasetRow` for each test, fit and parameter; rig and date stand in the
folders' names (Hive's layout), every condition NAME in a column condition.NAME as people wrote it, and in
amount.NAME in SI where it is an amount. A part is named after its content and never changes; results are
added as further parts.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labpipe.arrays import FloatArray
from labpipe.artefacts import parquet
from labpipe.artefacts.digest import stamp_parquet
from labpipe.artefacts.header import Header
from labpipe.artefacts.json_file import entry_of, plain, record_of
from labpipe.artefacts.writing import OutputFolder, without_staging
from labpipe.errors import DataError
from labpipe.records import dataset

FOLDER = "dataset"
SUFFIX = ".results.parquet"
KIND = "results"
SCHEMA = "labpipe/results/1"
CONDITION, AMOUNT = "condition.", "amount."
# Partitions cannot have empty names.
UNNAMED = "unnamed"
_PARTITIONS = ("rig", "date")
_TEXTS = (
    "test", "fit", "term", "model", "estimator", "parameter", "unit", "warnings", "failed", "source",
    "digest",
)  # fmt: skip
_TYPES: Mapping[str, pa.DataType] = {
    **dict.fromkeys(_TEXTS, pa.string()),
    **dict.fromkeys(("significant", "accepted"), pa.bool_()),
    "covariance": pa.list_(pa.float64()),
    **dict.fromkeys(("changes", "dofs"), pa.map_(pa.string(), pa.float64())),
}
COLUMNS = tuple(
    field.name for field in fields(dataset.DatasetRow) if field.name not in (*_PARTITIONS, "conditions")
)


@dataclass(frozen=True)
class DatasetPart:
    """One file of a dataset and what its folders say of all its rows."""

    path: Path
    rig: str
    date: str


def write_parts(results: Sequence[dataset.TestResult], output: OutputFolder) -> list[str]:
    """Write the rows of tests, one part for each rig and date; the names of the parts."""
    groups: dict[tuple[str, str], list[dataset.TestResult]] = {}
    for result in results:
        if result.rows:
            groups.setdefault((result.rows[0].rig, result.rows[0].date), []).append(result)
    return [_write_part(rig, date, group, output) for (rig, date), group in groups.items()]


def _write_part(rig: str, date: str, results: Sequence[dataset.TestResult], output: OutputFolder) -> str:
    summary = entry_of(dataset.sum_summaries(dataset.summary_of(result) for result in results))
    contents = {"summary": json.loads(json.dumps(summary, default=plain))}
    header = Header(KIND, {"schema": SCHEMA}, inputs=(), contents=contents)
    table = table_of([row for result in results for row in result.rows])
    table = table.replace_schema_metadata(parquet.metadata_of(header))
    stream = pa.BufferOutputStream()
    pq.write_table(table, stream, compression="zstd", write_page_checksum=True)
    content = stream.getvalue()
    digest = hashlib.sha256(content).hexdigest()[:16]
    name = f"{FOLDER}/rig={quote(rig or UNNAMED, safe=' ')}/date={date}/part-{digest}{SUFFIX}"
    path = output.write_path(name)
    path.write_bytes(content)
    stamp_parquet(path)
    return name


def read_summary(part: DatasetPart) -> dataset.DatasetSummary:
    """What a part says of its tests as a whole; DamagedError for a file that is not as labpipe wrote it."""
    header = parquet.read_header(part.path, KIND)
    with parquet.check_layout(part.path):
        summary: dataset.DatasetSummary = record_of(header.contents["summary"], dataset.DatasetSummary)
    return summary


def table_of(rows: Sequence[dataset.DatasetRow]) -> pa.Table:
    """Rows as the columns of a part, without those that its folders say."""
    columns = {
        name: pa.array((_cell(row, name) for row in rows), _TYPES.get(name, pa.float64())) for name in COLUMNS
    }
    conditions = list(dict.fromkeys(name for row in rows for name in row.conditions))
    for name in conditions:
        texts = [row.conditions.get(name) for row in rows]
        columns[CONDITION + name] = pa.array(texts, pa.string())
        amounts = [None if text is None else dataset.amount_of(text) for text in texts]
        if any(amounts):
            columns[AMOUNT + name] = pa.array((amount and amount[0] for amount in amounts), pa.float64())
    return pa.table(columns)


def _cell(row: dataset.DatasetRow, name: str) -> Any:
    cell = getattr(row, name)
    return list(cell.items()) if isinstance(cell, Mapping) else cell


def parts(folder: Path) -> list[DatasetPart]:
    """The parts of the dataset in a folder of results, by rig, date and name."""
    written = without_staging((folder / FOLDER).glob(f"rig=*/date=*/*{SUFFIX}"))
    return [
        DatasetPart(path, unquote(path.parts[-3].removeprefix("rig=")), path.parts[-2].removeprefix("date="))
        for path in written
    ]


def read_part(part: DatasetPart, columns: Collection[str] = COLUMNS) -> pa.Table:
    """The rows of a part, columns rig and date before the others; of its own *columns* only those, of
    conditions all.

    DamagedError for a file that is not as labpipe wrote it, DataError for one of another schema.
    """
    header = parquet.read_header(part.path, KIND)
    if header.parameters.get("schema") != SCHEMA:
        raise DataError(f"is not of schema {SCHEMA}", part.path, "read it with the version that wrote it")
    there = parquet.open_parquet(part.path).schema_arrow.names
    with parquet.check_layout(part.path):
        # Parts written before sources had degrees of freedom are without them.
        if lacking := set(COLUMNS).difference(there, ["dofs"]):
            raise KeyError(min(lacking))
    chosen = [name for name in there if name in columns or name.startswith((CONDITION, AMOUNT))]
    table = parquet.read_columns(part.path, chosen).replace_schema_metadata(None)
    for place, name in enumerate(_PARTITIONS):
        table = table.add_column(place, name, pa.array([getattr(part, name)] * table.num_rows, pa.string()))
    return table


def read_rows(folder: Path) -> pa.Table:
    """The rows of all parts in a folder, conditions that a part lacks as nulls; DataError without a part."""
    tables = [read_part(part) for part in parts(folder)]
    if not tables:
        raise DataError("holds no dataset of results", folder)
    return pa.concat_tables(tables, promote_options="default")


def columns_of_conditions(names: Sequence[str]) -> Iterator[str]:
    return (name.removeprefix(CONDITION) for name in names if name.startswith(CONDITION))


KEYS = ("fit", "term", "parameter", "unit", "low_hz", "high_hz")
# Tests that a report names one by one.
MOST = 100


def read_many_tests(folder: Path) -> dataset.ManyTests:
    """The dataset of a folder; DataError without one, DamagedError for a part not by labpipe."""
    # Not loaded where rows are only written: it costs a tenth of a run that finds nothing to do.
    from pyarrow.compute import equal

    table = read_rows(folder)
    table = table.sort_by([("date", "ascending"), ("test", "ascending")])
    return dataset.ManyTests(
        tuple(_columns(table.filter(table["parameter"].is_valid()))),
        failed=tuple(first_tests(table.filter(table["failed"].is_valid()), "failed")),
        not_accepted=tuple(first_tests(table.filter(equal(table["accepted"], False)), "warnings")),
    )


def _columns(table: pa.Table) -> Iterator[dataset.TestColumns]:
    """One for each fit, term, band and parameter, in the order in which they first stand in the dataset."""
    groups: dict[tuple[object, ...], list[int]] = {}
    for row, key in enumerate(table.select(KEYS).to_pylist()):
        groups.setdefault(tuple(key.values()), []).append(row)
    for (fit, term, parameter, unit, low_hz, high_hz), rows in groups.items():
        group = table.take(rows)
        has_bands = sum(key[:4] == (fit, term, parameter, unit) for key in groups) > 1
        yield dataset.TestColumns(
            str(fit),
            str(term),
            str(parameter),
            str(unit),
            tests=tuple(group["test"].to_pylist()),
            dates=tuple(group["date"].to_pylist()),
            values=_numbers(group, "value"),
            errors=_numbers(group, "full_error"),
            low=_numbers(group, "ci_low"),
            high=_numbers(group, "ci_high"),
            amounts=dict(_amounts(group)),
            band=f"{low_hz:g}-{high_hz:g} Hz" if has_bands else "",
        )


def _numbers(table: pa.Table, name: str) -> FloatArray:
    return np.asarray(parquet.numpy_array(table[name]), np.float64)


def _amounts(table: pa.Table) -> Iterator[tuple[str, tuple[str, FloatArray]]]:
    """The conditions that are amounts of one unit; a condition in several dimensions is not an axis."""
    for column in table.column_names:
        if column.startswith(AMOUNT):
            name = column.removeprefix(AMOUNT)
            texts = table[CONDITION + name].unique().drop_null().to_pylist()
            units = {amount and amount[1] for amount in map(dataset.amount_of, texts)}
            if len(units) == 1:
                yield name, (units.pop() or "", _numbers(table, column))


def first_tests(table: pa.Table, why: str) -> Iterator[tuple[str, str, str]]:
    """The first tests of some rows with their conditions, each once."""
    conditions = [name for name in table.column_names if name.startswith(CONDITION)]
    seen: set[str] = set()
    for batch in table.select(["test", why, *conditions]).to_batches():
        for row in batch.to_pylist():
            if row["test"] in seen:
                continue
            seen.add(row["test"])
            there = (name for name in conditions if row[name] is not None)
            text = ", ".join(f"{name.removeprefix(CONDITION)} {row[name]}" for name in there)
            yield row["test"], text, row[why] or ""
            if len(seen) >= MOST:
                return

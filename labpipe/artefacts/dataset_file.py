"""``dataset/rig=RIG/date=DATE/part-....results.parquet``: the results of many tests as rows, for labpipe and for whatever reads Parquet.

Schema "labpipe/results/1": a row of `DatasetRow` for each test, fit and parameter; rig and date stand in the folders' names (Hive's
layout), every condition NAME in a column condition.NAME as people wrote it, and in amount.NAME in SI where it is an amount. A part is
named after its content and never changes; results are added as further parts.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import pyarrow as pa
import pyarrow.parquet as pq

from labpipe.artefacts.digest import stamp_parquet
from labpipe.artefacts.header import Header
from labpipe.artefacts.json_file import plain
from labpipe.artefacts.parquet import as_written, metadata_of, open_parquet, read_columns, read_header
from labpipe.artefacts.typed_json import entry_of, record_of
from labpipe.artefacts.writing import OutputFolder, finished
from labpipe.errors import DataError
from labpipe.quantities import UnitError, si_amount
from labpipe.records.dataset_row import DatasetRow, TestResult
from labpipe.records.dataset_summary import DatasetSummary, summary_of, summed

FOLDER = "dataset"
SUFFIX = ".results.parquet"
KIND = "results"
SCHEMA = "labpipe/results/1"
CONDITION, AMOUNT = "condition.", "amount."
# Partitions cannot have empty names.
UNNAMED = "unnamed"
_PARTITIONS = ("rig", "date")
_TYPES: Mapping[str, pa.DataType] = {
    **dict.fromkeys(
        ("test", "fit", "term", "model", "estimator", "parameter", "unit", "warnings", "failed", "source", "digest"), pa.string()
    ),
    **dict.fromkeys(("significant", "accepted"), pa.bool_()),
    "covariance": pa.list_(pa.float64()),
    "changes": pa.map_(pa.string(), pa.float64()),
}
COLUMNS = tuple(field.name for field in dataclasses.fields(DatasetRow) if field.name not in (*_PARTITIONS, "conditions"))


@dataclass(frozen=True)
class Part:
    """One file of a dataset and what its folders say of all its rows."""

    path: Path
    rig: str
    date: str


def write_parts(results: Sequence[TestResult], output: OutputFolder) -> list[str]:
    """Write the rows of tests, one part for each rig and date, in their order; the names of the parts below the output folder."""
    groups: dict[tuple[str, str], list[TestResult]] = {}
    for result in results:
        if result.rows:
            groups.setdefault((result.rows[0].rig, result.rows[0].date), []).append(result)
    return [_write_part(rig, date, group, output) for (rig, date), group in groups.items()]


def _write_part(rig: str, date: str, results: Sequence[TestResult], output: OutputFolder) -> str:
    summary = json.loads(json.dumps(entry_of(summed(summary_of(result) for result in results)), default=plain))
    header = Header(KIND, {"schema": SCHEMA}, inputs=(), contents={"summary": summary})
    table = _table([row for result in results for row in result.rows]).replace_schema_metadata(metadata_of(header))
    stream = pa.BufferOutputStream()
    pq.write_table(table, stream, compression="zstd", write_page_checksum=True)
    content = stream.getvalue()
    name = f"{FOLDER}/rig={quote(rig or UNNAMED, safe=' ')}/date={date}/part-{hashlib.sha256(content).hexdigest()[:16]}{SUFFIX}"
    path = output.write_path(name)
    path.write_bytes(content)
    stamp_parquet(path)
    return name


def read_summary(part: Part) -> DatasetSummary:
    """What a part says of its tests as a whole; DamagedError for a file that is not as labpipe wrote it."""
    header = read_header(part.path, KIND)
    with as_written(part.path):
        summary: DatasetSummary = record_of(header.contents["summary"], DatasetSummary)
    return summary


def _table(rows: Sequence[DatasetRow]) -> pa.Table:
    columns = {name: pa.array((_cell(row, name) for row in rows), _TYPES.get(name, pa.float64())) for name in COLUMNS}
    conditions = list(dict.fromkeys(name for row in rows for name in row.conditions))
    for name in conditions:
        texts = [row.conditions.get(name) for row in rows]
        columns[CONDITION + name] = pa.array(texts, pa.string())
        amounts = [None if text is None else amount_of(text)[0] for text in texts]
        if any(amount is not None for amount in amounts):
            columns[AMOUNT + name] = pa.array(amounts, pa.float64())
    return pa.table(columns)


def _cell(row: DatasetRow, name: str) -> Any:
    cell = getattr(row, name)
    return list(cell.items()) if name == "changes" else cell


def amount_of(text: str) -> tuple[float | None, str]:
    """A condition as a number in SI with its unit, or none for words such as "up"."""
    try:
        return si_amount(text)
    except UnitError:
        return None, ""


def parts(folder: Path) -> list[Part]:
    """The parts of the dataset in a folder of results, by rig, date and name."""
    written = finished((folder / FOLDER).glob(f"rig=*/date=*/*{SUFFIX}"))
    return [Part(path, unquote(path.parts[-3].removeprefix("rig=")), path.parts[-2].removeprefix("date=")) for path in written]


def read_part(part: Part, columns: Collection[str] = COLUMNS) -> pa.Table:
    """The rows of a part, columns rig and date before the others; of its own *columns* only those, of conditions all.

    DamagedError for a file that is not as labpipe wrote it, DataError for one of another schema.
    """
    header = read_header(part.path, KIND)
    if header.parameters.get("schema") != SCHEMA:
        raise DataError(f"is not of schema {SCHEMA}", where=str(part.path), hint="read it with the version that wrote it")
    there = open_parquet(part.path).schema_arrow.names
    with as_written(part.path):
        if lacking := set(COLUMNS).difference(there):
            raise KeyError(min(lacking))
    table = read_columns(part.path, [name for name in there if name in columns or name.startswith((CONDITION, AMOUNT))])
    table = table.replace_schema_metadata(None)
    for place, name in enumerate(_PARTITIONS):
        table = table.add_column(place, name, pa.array([getattr(part, name)] * table.num_rows, pa.string()))
    return table


def read_rows(folder: Path, columns: Collection[str] = COLUMNS) -> pa.Table:
    """The rows of all parts in a folder of results, conditions that a part lacks as nulls; DataError where there is no part."""
    tables = [read_part(part, columns) for part in parts(folder)]
    if not tables:
        raise DataError("holds no dataset of results", where=str(folder))
    return pa.concat_tables(tables, promote_options="default")


def columns_of_conditions(names: Sequence[str]) -> Iterator[str]:
    """The conditions that columns of a dataset are of."""
    return (name.removeprefix(CONDITION) for name in names if name.startswith(CONDITION))

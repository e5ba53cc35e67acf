"""A dataset of results read for a report: every parameter of every fit as columns over the tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from labpipe.arrays import FloatArray
from labpipe.arrow_arrays import numpy_array
from labpipe.artefacts.dataset_file import AMOUNT, CONDITION, amount_of, read_rows
from labpipe.records.test_columns import ManyTests, TestColumns

KEYS = ("fit", "term", "parameter", "unit", "low_hz", "high_hz")
# Tests that a report names one by one.
MOST = 100


def read_many_tests(folder: Path) -> ManyTests:
    """The dataset of a folder of results; DataError where there is none, DamagedError for a part that labpipe did not write."""
    table = read_rows(folder)
    table = table.sort_by([("date", "ascending"), ("test", "ascending")])
    valid = table.filter(pc.is_valid(table["parameter"]))
    return ManyTests(
        tuple(_columns(valid)),
        failed=tuple(_named(table.filter(pc.is_valid(table["failed"])), "failed")),
        not_accepted=tuple(_named(table.filter(pc.equal(table["accepted"], False)), "warnings")),
    )


def _columns(table: pa.Table) -> Iterator[TestColumns]:
    """One for each fit, term, band and parameter, in the order in which they first stand in the dataset."""
    keys = pa.StructArray.from_arrays([table[name].combine_chunks() for name in KEYS], names=list(KEYS)) if table.num_rows else pa.array([])
    groups: dict[tuple[object, ...], list[int]] = {}
    for row, key in enumerate(keys.to_pylist()):
        groups.setdefault(tuple(key.values()), []).append(row)
    for (fit, term, parameter, unit, low_hz, high_hz), rows in groups.items():
        group = table.take(rows)
        yield TestColumns(
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
            band_hz=(float(str(low_hz)), float(str(high_hz))),
        )


def _numbers(table: pa.Table, name: str) -> FloatArray:
    return np.asarray(numpy_array(table[name]), np.float64)


def _amounts(table: pa.Table) -> Iterator[tuple[str, tuple[str, FloatArray]]]:
    """The conditions that are amounts of one unit; a condition in several dimensions is no axis."""
    for column in table.column_names:
        if column.startswith(AMOUNT):
            name = column.removeprefix(AMOUNT)
            units = {amount_of(text)[1] for text in pc.unique(table[CONDITION + name]).to_pylist() if text is not None}
            if len(units) == 1:
                yield name, (units.pop(), _numbers(table, column))


def _named(table: pa.Table, why: str) -> Iterator[tuple[str, str, str]]:
    """The first tests of some rows with their conditions, each once."""
    conditions = [name for name in table.column_names if name.startswith(CONDITION)]
    seen: set[str] = set()
    for batch in table.select(["test", why, *conditions]).to_batches():
        for row in batch.to_pylist():
            if row["test"] in seen:
                continue
            seen.add(row["test"])
            text = ", ".join(f"{name.removeprefix(CONDITION)} {row[name]}" for name in conditions if row[name] is not None)
            yield row["test"], text, row[why] or ""
            if len(seen) >= MOST:
                return

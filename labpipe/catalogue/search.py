"""What the results below a folder hold: those of single results by their index, those of many tests by their datasets.

Both are kept. The index spares reading the JSON of a lab's results, of which each is small and may be replaced; a dataset is columns
already, its parts never change, and it is asked where it lies, however large it grows.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from labpipe.catalogue.dataset import dataset_values, folders, has_test
from labpipe.catalogue.index import open_index
from labpipe.catalogue.query import Filter, ResultRow, ValueRow, results, values, with_datasets
from labpipe.errors import ConfigError

Row = TypeVar("Row", ResultRow, ValueRow)


def found_values(folder: Path, criteria: Filter) -> list[ValueRow]:
    """The parameters that meet the criteria in all results below a folder, by date and result.

    ConfigError for a name or a condition that none of them has; DataError for a folder without results.
    """
    with open_index(folder) as index:
        asked: list[Callable[[], list[ValueRow]]] = [lambda: values(index, criteria)] if _has_values(index) else []
        for name, home in folders(with_datasets(index), folder):
            asked.append(lambda name=name, home=home: dataset_values(home, name, criteria))  # type: ignore[misc]
        return _all_of(asked)


def found_results(folder: Path, criteria: Filter) -> list[ResultRow]:
    """The results below a folder with at least one test that meets the criteria, the oldest first; errors as of `found_values`."""
    with open_index(folder) as index:
        homes = dict(folders(with_datasets(index), folder))
        if not homes or not criteria.where:
            return results(index, criteria)
        asked: list[Callable[[], list[ResultRow]]] = [lambda: results(index, criteria)] if _has_values(index) else []
        everything = results(index, Filter(rig=criteria.rig, since=criteria.since, until=criteria.until))
        for row in everything:
            home = Path(row.path).parent.as_posix()
            if home in homes:
                asked.append(lambda row=row, path=homes[home]: [row] if has_test(path, criteria) else [])  # type: ignore[misc]
        return _all_of(asked)


def _has_values(index: sqlite3.Connection) -> bool:
    return bool(index.execute("SELECT 1 FROM value LIMIT 1").fetchone())


def _all_of(asked: list[Callable[[], list[Row]]]) -> list[Row]:
    """The rows of all that have what is asked for; the first ConfigError where none has."""
    rows: list[Row] = []
    faults: list[ConfigError] = []
    for ask in asked:
        try:
            rows.extend(ask())
        except ConfigError as error:
            faults.append(error)
    if faults and len(faults) == len(asked):
        raise faults[0]
    return sorted(rows, key=lambda row: (row.date, row.path))

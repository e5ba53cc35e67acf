"""Channels of one run in several files: joined on time or row by row, and what is cut is said."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.raw_files.joined_table import JoinedTable
from labpipe.raw_files.table import check_columns


class Rows:
    """A table in memory whose chunks have the lengths that a test wants."""

    def __init__(
        self, name: str, columns: dict[str, np.ndarray], length: int, rate: float | None = None
    ) -> None:
        self.path, self.columns, self.units, self.sample_rate = Path(name), tuple(columns), {}, rate
        self._columns, self._length = columns, length

    def chunks(self, columns: Sequence[str]) -> Iterator[np.ndarray]:
        rows = np.column_stack([self._columns[name] for name in columns])
        for start in range(0, rows.shape[0], self._length):
            yield rows[start : start + self._length]


N = np.arange(100.0)


def timed(name: str, start: int, stop: int, length: int, **columns: np.ndarray) -> Rows:
    """Rows start to stop of a run at 10 Hz, in chunks of *length*."""
    return Rows(
        name,
        {"t": N[start:stop] / 10, **{key: values[start:stop] for key, values in columns.items()}},
        length,
    )


def read(table: JoinedTable, *columns: str) -> np.ndarray:
    return np.concatenate(list(table.chunks(columns)))


@pytest.mark.parametrize("lengths", [(7, 11, 100), (100, 3, 5), (50, 50, 50)])
def test_rows_of_one_time_stand_side_by_side(lengths: tuple[int, int, int]) -> None:
    """Values n, n^2, 3 n at the times n / 10, from rows 0, 12 and 5 on and up to rows 100, 90 and 95: rows 12
    to 90 are left.
    """
    parts = [
        timed("a.csv", 0, 100, lengths[0], f=N),
        timed("b.csv", 12, 90, lengths[1], y=N**2),
        timed("c.csv", 5, 95, lengths[2], f=3 * N),
    ]
    table = JoinedTable(parts, "t")
    assert table.columns == ("t", "f", "b/t", "y", "c/t", "c/f")
    np.testing.assert_array_equal(
        read(table, "t", "c/f", "y", "f"), np.column_stack([N / 10, 3 * N, N**2, N])[12:90]
    )
    assert [finding.message for finding in table.findings()] == [
        "a.csv: 12 samples at its start and 10 at its end are cut, where another file has none",
        "c.csv: 7 samples at its start and 5 at its end are cut, where another file has none",
    ]


def test_row_by_row_only_the_end_is_cut() -> None:
    table = JoinedTable([Rows("a.csv", {"f": N}, 30), Rows("b.csv", {"y": N[:64]}, 16)], None)
    np.testing.assert_array_equal(read(table, "y", "f"), np.column_stack([N, N])[:64])
    (finding,) = table.findings()
    assert (finding.code, finding.level) == ("cut", "note") and finding.message.startswith(
        "a.csv: 0 samples at its start and 36 at its end"
    )


def test_files_that_fit_leave_no_note() -> None:
    table = JoinedTable([timed("a.csv", 0, 50, 9, f=N), timed("b.csv", 0, 50, 50, y=N)], "t")
    assert read(table, "f", "y").shape == (50, 2) and table.findings() == ()


LOST = {"t": np.delete(N, 40) / 10, "y": np.delete(N, 40)}


@pytest.mark.parametrize(
    ("second", "fault"),
    [
        (
            Rows("b.csv", {"t": N / 10 + 0.05, "y": N}, 50),
            "the times of b.csv lie 0.50 steps beside those of a.csv",
        ),
        (
            Rows("b.csv", {"t": N / 20, "y": N}, 50),
            "the time steps of b.csv (0.05) differ from those of a.csv (0.1)",
        ),
        (Rows("b.csv", LOST, 30), "the times of b.csv and a.csv run apart: 4.1 and 4 at common row 41"),
        (
            Rows("b.csv", {"t": (N + 5 * (N > 60)) / 10, "y": N}, 100),
            "differ from those of a.csv (0.1); samples are lost or stand twice after its row 61",
        ),
        (Rows("b.csv", {"t": 20 + N / 10, "y": N}, 50), "the files have no time in common"),
    ],
)
def test_times_that_do_not_fit_are_refused(second: Rows, fault: str) -> None:
    with pytest.raises(DataError) as caught:
        read(JoinedTable([timed("a.csv", 0, 100, 50, f=N), second], "t"), "f", "y")
    assert fault in str(caught.value)


def test_files_of_two_rates_are_refused() -> None:
    with pytest.raises(DataError, match=r"b.wav is sampled at 2000 Hz, a.wav at 1000 Hz"):
        JoinedTable([Rows("a.wav", {"f": N}, 9, 1000.0), Rows("b.wav", {"y": N}, 9, 2000.0)], None)


def test_a_column_that_two_files_call_alike_is_listed_twice() -> None:
    """By its name alone it cannot be told from the other, so that who reads it is refused."""
    parts = [timed(name, 0, 9, 9, f=values) for name, values in (("a/r", N), ("b/r", -N), ("c/r", 2 * N))]
    assert JoinedTable(parts, "t").columns == ("t", "f", "r/t", "r/f", "r/t", "r/f")
    twice = timed("a/r", 0, 9, 9, f=N)
    twice.columns = ("t", "f", "f")
    table = JoinedTable([twice, timed("b/q", 0, 9, 9, y=N)], "t")
    assert table.columns == ("t", "f", "f", "q/t", "y")
    with pytest.raises(DataError, match="the column 'f' appears 2 times"):
        check_columns(table, ["t", "f"])

"""Date-time stamps of loggers as seconds."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.raw_files.text_table import CsvTable, StampClock, is_stamp

START = datetime(2024, 2, 29, 23, 59, 59)
FORMATS = [
    "%Y-%m-%d %H:%M:%S.%f",
    "%Y-%m-%dT%H:%M:%S.%fZ",
    "%d.%m.%Y %H:%M:%S.%f",
    "%m/%d/%Y %I:%M:%S.%f %p",
    "%H:%M:%S.%f",
]


@pytest.mark.parametrize("written", FORMATS)
def test_seconds_go_on_over_midnight(written: str) -> None:
    """Every half second for 3 s from one second before the end of a leap day."""
    stamps = [(START + timedelta(seconds=n / 2)).strftime(written) for n in range(7)]
    clock = StampClock("t")
    seconds = np.concatenate([clock.seconds(stamps[:3]), clock.seconds(stamps[3:])])
    np.testing.assert_array_equal(seconds, 86399 + np.arange(7) / 2)


def test_a_column_of_stamps_with_decimal_commas(tmp_path: Path) -> None:
    rows = "".join(f"01.03.2024 10:00:0{n // 10},{n % 10};{n},5\n" for n in range(30))
    (tmp_path / "run.csv").write_text("Uhrzeit;x\n" + rows)
    table = CsvTable(tmp_path / "run.csv")
    values = np.concatenate(list(table.chunks(["x", "Uhrzeit"])))
    np.testing.assert_allclose(
        values, np.column_stack([np.arange(30) + 0.5, 36000 + np.arange(30) / 10]), rtol=1e-15
    )


def test_a_faulty_stamp_has_its_line(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t,x\n10:00:00.0,1\n10:00:00.1,2\n10:00:00.2,3\n10:00:00.3,b\n")
    with pytest.raises(DataError) as caught:
        list(CsvTable(tmp_path / "run.csv").chunks(["t", "x"]))
    assert str(caught.value).endswith("run.csv:5: column 'x': 'b' is not a number")


def test_time_that_is_left_out_is_refused() -> None:
    with pytest.raises(
        DataError, match="the column 't' leaves out time between 2024-03-01 and 2024-03-02 10:00:01"
    ):
        StampClock("t").seconds(["2024-03-01 10:00:00", "2024-03-02 10:00:01"])


@pytest.mark.parametrize("text", ["10:00", "2024-03-01", "1.5", "", "10:00:00 x", "a 10:00:00"])
def test_what_is_no_stamp(text: str) -> None:
    assert not is_stamp(text)

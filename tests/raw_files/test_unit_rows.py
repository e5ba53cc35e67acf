"""Rows of units below what loggers say of ranges and offsets, as a strain logger prints them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from labpipe.raw_files.text_table import CsvTable, header_of

ABOVE = [
    "Sampling Rate(Hz),50,,",
    "CH No.,CH2,CH3,CH8",
    "Range,2000,1000,5",
    "Offset,-105.9434,-1020.512,-12.62195",
    "Unit,cm/s2,cm/s2,V",
]


def test_names_stand_above_ranges_and_offsets_and_a_word_leads_the_units() -> None:
    names, units = header_of(ABOVE, ",", range(4, 5))
    assert names == ("CH No.", "CH2", "CH3", "CH8")
    assert units == {"CH2": "cm/s2", "CH3": "cm/s2", "CH8": "V"}


def test_a_row_of_units_right_below_the_names_is_read_as_before() -> None:
    names, units = header_of(["t,y", "s,mm"], ",", range(2, 3))
    assert names == ("t", "y") and units == {"t": "s", "y": "mm"}


def test_remarks_beside_the_first_rows_are_no_header(tmp_path: Path) -> None:
    path = tmp_path / "calibration.csv"
    head = "CH No.,CH6,CH8,,,\nUnit,cm/s2,V,,,\n"
    remarks = ["Largest,10.1,m/s2", "Mass,2.5,kg", ",,"]
    rows = [f"{n / 50:g},{n}.5,-{n},{remarks[min(n, 2)]}\n" for n in range(9)]
    path.write_text(head + "".join(rows), encoding="utf-8")
    table = CsvTable(path)
    assert table.columns == ("CH No.", "CH6", "CH8") and table.units == {"CH6": "cm/s2", "CH8": "V"}
    numbers = np.concatenate(list(table.chunks(table.columns)))
    np.testing.assert_array_equal(numbers, [(n / 50, n + 0.5, -n) for n in range(9)])


def test_a_row_of_remarks_below_the_names_leaves_them_their_columns(tmp_path: Path) -> None:
    path = tmp_path / "sweeps.txt"
    head = "X-Data [Hz]\tLaser [m/s]\tPhase [deg]\t\n\t003: [06-04-24 09:45]\t\t\n"
    path.write_text(head + "".join(f"  {120 + n},5\t 0,00{n}\t57,{n}\n" for n in range(5)), encoding="utf-8")
    table = CsvTable(path)
    assert table.columns == ("X-Data [Hz]", "Laser [m/s]", "Phase [deg]")
    numbers = np.concatenate(list(table.chunks(table.columns)))
    np.testing.assert_array_equal(numbers, [(120.5 + n, n / 1000, 57 + n / 10) for n in range(5)])

"""Rows of units below what loggers say of ranges and offsets, as a strain logger prints them."""

from __future__ import annotations

from labpipe.raw_files.text_table import header_of

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

"""Text tables as loggers and spreadsheets write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.raw_files.table import check_columns, open_table
from labpipe.raw_files.text_table import CsvTable, find_layout

ROWS = [[0.0, 1.5, -2.25], [0.001, 1.25, 3.5], [0.002, -0.5, 0.125]]


def written(tmp_path: Path, text: str, encoding: str = "utf-8") -> Path:
    path = tmp_path / "run.csv"
    path.write_bytes(text.encode(encoding))
    return path


def body(delimiter: str, decimal: str) -> str:
    return "\n".join(delimiter.join(str(v).replace(".", decimal) for v in row) for row in ROWS) + "\n"


@pytest.mark.parametrize(
    ("delimiter", "decimal"), [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("|", ".")]
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
def test_delimiter_decimal_sign_and_encoding(
    tmp_path: Path, delimiter: str, decimal: str, encoding: str
) -> None:
    table = CsvTable(
        written(
            tmp_path,
            delimiter.join(["t [s]", "force [N]", "x [µm]"]) + "\n" + body(delimiter, decimal),
            encoding,
        )
    )
    assert table.columns == ("t [s]", "force [N]", "x [µm]")
    assert table.units == {"t [s]": "s", "force [N]": "N", "x [µm]": "µm"}
    np.testing.assert_array_equal(np.concatenate(list(table.chunks(table.columns))), ROWS)


@pytest.mark.parametrize(
    ("header", "columns", "units"),
    [
        ("# logger 7\n# rate: 1000 Hz\nt,f,x\n", ("t", "f", "x"), {}),
        ("t,f,x\ns,N,um\n", ("t", "f", "x"), {"t": "s", "f": "N", "x": "um"}),
        ("t,f,x\n[s],[N],[um]\n", ("t", "f", "x"), {"t": "s", "f": "N", "x": "um"}),
        ("# t,f,x\n", ("t", "f", "x"), {}),
        ('Test rig 5\nDate: 3 May\n\n"t","f","x"\n', ("t", "f", "x"), {}),
        ("", ("1", "2", "3"), {}),
    ],
)
def test_headers_and_unit_rows(
    tmp_path: Path, header: str, columns: tuple[str, ...], units: dict[str, str]
) -> None:
    table = CsvTable(written(tmp_path, header + body(",", ".")))
    assert (table.columns, table.units) == (columns, units)
    assert np.concatenate(list(table.chunks(columns[:1])))[:, 0].tolist() == [0.0, 0.001, 0.002]


def test_a_trailing_delimiter_is_no_column(tmp_path: Path) -> None:
    table = CsvTable(written(tmp_path, "t;f\n" + "0;1;\n1;2;\n2;3;\n"))
    assert table.columns == ("t", "f")
    assert np.concatenate(list(table.chunks(["f"])))[:, 0].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("header", "columns"), [("Kraft [N]\n", ("Kraft [N]",)), ("Kraft\nN\n", ("Kraft",)), ("", ("1",))]
)
def test_one_channel_with_decimal_commas_is_one_column(
    tmp_path: Path, header: str, columns: tuple[str, ...]
) -> None:
    """Not the whole numbers before the commas, as if a header lacked the name of the others."""
    table = CsvTable(written(tmp_path, header + "0,25\n-1,0625\n12,5\n"))
    assert table.columns == columns
    assert np.concatenate(list(table.chunks(columns)))[:, 0].tolist() == [0.25, -1.0625, 12.5]


def test_a_header_without_the_name_of_the_row_numbers_names_no_column(tmp_path: Path) -> None:
    """As write.table of R leaves it: the names would be those of the columns before."""
    table = CsvTable(written(tmp_path, '"t","f"\n"1",0,5\n"2",1,6\n'))
    assert table.columns == ("1", "2", "3")


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ('"t, s","f, N"\n"0,5","1,25"\n"1,5","2,25"\n', ("t, s", "f, N")),
        ("Tag;t;f;Zustand\n1.3.;0,5;1,25;in Ordnung\n1.3.;1,5;2,25;in Ordnung\n", ("t", "f")),
        ('n,t,f\n"run 5, up",0.5,1.25\n"run 5, up",1.5,2.25\n', ("t", "f")),
    ],
)
def test_quotation_marks_and_columns_of_text(tmp_path: Path, text: str, columns: tuple[str, ...]) -> None:
    table = CsvTable(written(tmp_path, text))
    assert table.columns == columns
    np.testing.assert_array_equal(np.concatenate(list(table.chunks(columns))), [[0.5, 1.25], [1.5, 2.25]])


def test_a_column_of_text_is_named_where_it_is_asked_for(tmp_path: Path) -> None:
    table = CsvTable(written(tmp_path, "t,f\n0,1 N\n1,2 N\n2,3 N\n"))
    with pytest.raises(DataError, match="the column 'f' holds text, not numbers"):
        check_columns(table, ["f"])
    with pytest.raises(DataError, match="no row of numbers"):
        CsvTable(written(tmp_path, "Notes, of May\nwe ran 5 times, and\nsaw 3 peaks, 2 of them\n"))


def test_missing_numbers_are_nan(tmp_path: Path) -> None:
    table = CsvTable(written(tmp_path, "t,f\n0,1\n1,\n2,NaN\n3,-\n4,5\n"))
    np.testing.assert_array_equal(
        np.concatenate(list(table.chunks(["f"])))[:, 0], [1, np.nan, np.nan, np.nan, 5]
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("\n\n", "the file is empty"),
        ("t,f\n", "no row of numbers in it"),
        ("t,f\n0,1\n1\n2,3\n", r"run.csv:3: 1 fields, 2 are needed"),
        ("t,f\n0,1\n1,2,3\n2,3\n", r"run.csv:3: 3 fields, 2 are needed"),
        ("t,f\n0,1\n1,abc\n2,3\n", r"run.csv:3: column 'f': 'abc' is not a number"),
        ("t,f\n0,1\n1,2 N\n2,3\n", r"run.csv:3: column 'f': '2 N' is not a number"),
    ],
)
def test_what_is_no_table_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        list(CsvTable(written(tmp_path, text)).chunks(["t", "f"]))


def test_columns_missing_or_twice(tmp_path: Path) -> None:
    table = CsvTable(written(tmp_path, "t,force,force\n0,1,2\n1,2,3\n"))
    with pytest.raises(DataError, match="no column 'forse'; did you mean 'force'"):
        check_columns(table, ["forse"])
    with pytest.raises(DataError, match="'force' appears 2 times"):
        check_columns(table, ["force"])
    check_columns(table, ["t"])


def test_files_of_no_known_kind(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        open_table(tmp_path / "none.csv")
    with pytest.raises(DataError, match="is a folder"):
        open_table(tmp_path)
    (tmp_path / "run.xyz").write_text("1\n")
    with pytest.raises(DataError, match=r"ending '\.xyz' cannot be read"):
        open_table(tmp_path / "run.xyz")
    (tmp_path / "run.csv").write_bytes(b"a\0b")
    with pytest.raises(DataError, match="is not a text file"):
        open_table(tmp_path / "run.csv")
    (tmp_path / "run.parquet").write_text("no parquet")
    with pytest.raises(DataError, match="is not a readable Parquet file"):
        open_table(tmp_path / "run.parquet")


def test_a_faulty_row_does_not_decide_over_the_delimiter(tmp_path: Path) -> None:
    layout = find_layout(written(tmp_path, "t;f\n" + "0,5;1,5\n" * 20 + "bad line\n" + "1,5;2,5\n" * 20))
    assert (layout.delimiter, layout.decimal, layout.first_line) == (";", ",", 1)


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("  1.5   2.5\n -3e-1\t 4\n", ("1", "2")),
        ("t   x\r\n1.5 2.5\r\n-0.3 4\r\n", ("t", "x")),
        ("# t x\n1,5 2,5\n-0,3 4\n", ("t", "x")),
        ("Run of 3 March, 2 channels\n1.5     2.5\n\n   -0.3  4   \n", ("1", "2")),
    ],
)
def test_any_number_of_blanks_keeps_columns_apart(
    tmp_path: Path, text: str, columns: tuple[str, ...]
) -> None:
    table = CsvTable(written(tmp_path, text))
    assert table.columns == columns
    np.testing.assert_array_equal(
        np.concatenate(list(table.chunks(columns[::-1]))), [[2.5, 1.5], [4.0, -0.3]]
    )


def test_blanks_of_a_long_file_and_its_faulty_row(tmp_path: Path) -> None:
    """40,000 rows of n, n^2: more than the reader takes in one piece."""
    rows = [f"{n}   {n * n}" for n in range(40_000)]
    values = np.concatenate(list(CsvTable(written(tmp_path, "\n".join(rows))).chunks(["1", "2"])))
    np.testing.assert_array_equal(values[:, 1], np.arange(40_000.0) ** 2)
    rows[30_000] = "30000 x"
    with pytest.raises(DataError) as caught:
        list(CsvTable(written(tmp_path, "\n".join(rows))).chunks(["1", "2"]))
    assert str(caught.value).endswith(":30001: column '2': 'x' is not a number")


@pytest.mark.parametrize("end", ["\r\n", "\n"])
@pytest.mark.parametrize(("delimiter", "decimal"), [(",", "."), (";", ","), (" ", ".")])
@pytest.mark.parametrize("form", ["%.4f", "%.3e"])
def test_a_file_that_ends_within_its_last_number_is_refused(
    tmp_path: Path, rng, delimiter: str, decimal: str, end: str, form: str
) -> None:
    """-6.40 is left of -6.4067, 1.234e-0 of 1.234e-05; the whole last line without an end is read."""
    lines = [
        delimiter.join((form % value).replace(".", decimal) for value in row)
        for row in rng.normal(size=(30, 3))
    ]
    text = end.join([delimiter.join("tfx"), *lines])
    whole = CsvTable(written(tmp_path, text))
    assert np.concatenate(list(whole.chunks(["x"]))).shape == (30, 1)
    table = CsvTable(written(tmp_path, text[:-2]))
    with pytest.raises(DataError, match="ends within its last number"):
        list(table.chunks(["f"]))


def test_numbers_of_any_decimals_end_as_they_like(tmp_path: Path, rng) -> None:
    """Shortest decimals, of which a last one of few is nothing to be seen; below 200 rows none is judged."""
    values = [round(value, 3) for value in rng.normal(size=150)]
    table = CsvTable(written(tmp_path, "\n".join(["t,x", *(f"0.5,{v}" for v in [*values, 2.0])])))
    assert np.concatenate(list(table.chunks(["x"])))[-1] == 2.0

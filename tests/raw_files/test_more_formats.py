"""LabVIEW, NumPy, Excel and MDF files as tables: what other libraries wrote is read back, faults have their
place.
"""

from __future__ import annotations

import datetime
import sys
import tempfile
from pathlib import Path

import numpy as np
import openpyxl
import pandas as pd
import pytest
from scipy.io import savemat

from labpipe.artefacts.writing import output_folder
from labpipe.errors import DataError
from labpipe.project.ingest import SourceFile, ingest
from labpipe.project.inspect import inspect
from labpipe.project.rig_file import load_rig
from labpipe.project.scaffold import scaffold
from labpipe.raw_files.frf_described import Dofs, read_described
from labpipe.raw_files.joined_table import ResampledTable
from labpipe.raw_files.mdf_table import TIME
from labpipe.raw_files.table import check_columns, open_table
from labpipe.records.frf_layout import FrfColumns, FrfLayout
from labpipe.records.recording import Overview

TOP = "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\n{more}***End_of_Header***\t\n\t\n"
SEGMENT = (
    "Channels\t2\t\t\nSamples\t3\t3\t\nY_Unit_Label\tNewtons\tm/s^2\t\nX_Dimension\tTime\tTime\t\n"
    "Delta_X\t{step}\t{step}\t\n***End_of_Header***\t\t\t\nX_Value\tF\ta\tComment\n"
)
ROWS = "\t0.5\t-1.5\tlost\n\t1.0\t2e-3\n\t1.5\t\n"


def whole(path: Path, *columns: str) -> np.ndarray:
    table = open_table(path)
    return np.concatenate(list(table.chunks(columns or table.columns)))


def lvm(path: Path, text: str, more: str = "", step: str = "3.906250E-5") -> Path:
    path.write_text(TOP.replace("{more}", more) + text.replace("{step}", step))
    return path


def test_lvm_without_x_values_has_units_and_rate_and_no_comments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Delta_X 3.90625E-5 s is 25.6 kHz; the text behind the numbers is LabVIEW's comment.

    Two rows and then one: chunks hold each row once.
    """
    monkeypatch.setattr("labpipe.raw_files.lvm_table.CHUNK_ROWS", 2)
    table = open_table(lvm(tmp_path / "r.lvm", SEGMENT + ROWS))
    assert (table.columns, table.units, table.sample_rate) == (("F", "a"), {"F": "N", "a": "m/s^2"}, 25600.0)
    np.testing.assert_array_equal(whole(table.path, "a", "F"), [[-1.5, 0.5], [2e-3, 1.0], [np.nan, 1.5]])


@pytest.mark.parametrize(
    ("step", "rate"),
    [("0.000977", 1024.0), ("0.000488", 2050.0), ("0.001000", 1000.0), ("2.441406E-4", 4096.0)],
)
def test_a_rounded_step_stands_for_the_rate_of_fewest_digits_that_it_may_be(
    tmp_path: Path, step: str, rate: float
) -> None:
    """1/1024 s is 0.000977 within its digits, 1/1023 s is not; of 0.000488 the shortest rate is 2050 Hz."""
    assert open_table(lvm(tmp_path / "r.lvm", SEGMENT + ROWS, step=step)).sample_rate == rate


def test_lvm_with_decimal_commas_and_two_segments_with_x_values(tmp_path: Path) -> None:
    two, one = (SEGMENT.replace("3\t3", counts) for counts in ("2\t2", "1\t1"))
    text = two + "0,0\t0,5\t-1,5\n0,1\t1,0\t2,5\n\n" + one + "0,2\t7\t8\n"
    table = open_table(lvm(tmp_path / "r.lvm", text, "Decimal_Separator\t,\n", "0,1"))
    assert table.columns == ("X_Value", "F", "a") and table.sample_rate is None
    np.testing.assert_array_equal(whole(table.path), [[0, 0.5, -1.5], [0.1, 1, 2.5], [0.2, 7, 8]])


def test_lvm_at_two_rates(tmp_path: Path) -> None:
    """By hand: of the slower channel the file has as many rows as it says, and blanks after them."""
    text = SEGMENT.replace("3\t3", "4\t2").replace("{step}\t{step}", "0.1\t0.2")
    text = text.replace("Delta_X", "X0\t0\t0.05\t\nDelta_X") + "\t1\t10\n\t2\t20\n\t3\t\n\t4\t\n"
    table = open_table(lvm(tmp_path / "r.lvm", text))
    assert (table.columns, table.sample_rate, table.unused) == (("F",), 10.0, {"a": 2})
    np.testing.assert_array_equal(whole(table.path), [[1], [2], [3], [4]])
    (slow,) = table.others
    assert (slow.columns, slow.units, slow.sample_rate, slow.start) == (("a",), {"a": "m/s^2"}, 5.0, 0.05)
    np.testing.assert_array_equal(np.concatenate(list(slow.chunks(["a"]))), [[10], [20]])
    with pytest.raises(DataError, match="a second segment begins, and no X values say when"):
        whole(lvm(tmp_path / "s.lvm", text + text))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (SEGMENT + ROWS + "\tx\t1\n", "r.lvm:16: column 'F': 'x' is not a number"),
        (
            SEGMENT + ROWS + "\n" + SEGMENT + ROWS,
            "r.lvm:23: a second segment begins, and no X values say when",
        ),
        (SEGMENT[:60], "r.lvm: is cut off in its header"),
        (SEGMENT + ROWS[:-7], "r.lvm: ends 1 sample(s) before the last one"),
        (
            SEGMENT.replace("3\t3", "9\t9").replace("{step}", "1E-3") + "0\t1\t2\n0.004\t3\t4\n0.008\t5\t6\n",
            "r.lvm: ends 6 sample(s) before the last one that its header states: rows are 0.004 s apart "
            "(X_Value), samples 0.001 s (Delta_X); rows were left out after it was written; save the titles",
        ),
        (SEGMENT.replace("3\t3", "0\t0") + ROWS, "r.lvm: holds no channel with samples"),
        (
            SEGMENT.replace("{step}\t{step}", "0.1\t-0.2") + ROWS,
            "r.lvm: not every channel has a positive step Delta_X",
        ),
    ],
)
def test_faults_of_lvm(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(DataError) as caught:
        whole(lvm(tmp_path / "r.lvm", text))
    assert str(caught.value).removeprefix(f"{tmp_path}/").startswith(fault)


def test_numpy_files(tmp_path: Path) -> None:
    rows = np.arange(12.0).reshape(6, 2)
    np.save(tmp_path / "r.npy", rows)
    assert open_table(tmp_path / "r.npy").columns == ("1", "2")
    np.testing.assert_array_equal(whole(tmp_path / "r.npy"), rows)
    np.savez(tmp_path / "r.npz", f=rows[:, 0], y=rows[:, 1], fs=512)
    assert (open_table(tmp_path / "r.npz").columns, open_table(tmp_path / "r.npz").sample_rate) == (
        ("f", "y"),
        512.0,
    )
    np.save(tmp_path / "s.npy", np.array([(1.0, 2), (3.0, 4)], [("t", float), ("x", int)]))
    np.testing.assert_array_equal(whole(tmp_path / "s.npy", "x", "t"), [[2, 1], [4, 3]])


def test_two_arrays_of_one_column_and_a_rate_that_is_none_are_refused(tmp_path: Path) -> None:
    """Column 1 of a matrix x is x_1, as another array is called; a number x_1 is not a channel."""
    both = {"x": np.arange(12.0).reshape(6, 2), "x_1": np.ones(6), "fs": 512.0}
    np.savez(tmp_path / "r.npz", **both)
    savemat(tmp_path / "r.mat", both)
    for name in ("r.npz", "r.mat"):
        with pytest.raises(DataError, match="two of its arrays make a column 'x_1'"):
            open_table(tmp_path / name)
    np.savez(tmp_path / "s.npz", **{**both, "x_1": np.ones(1)})
    np.testing.assert_array_equal(whole(tmp_path / "s.npz", "x_1", "x_2"), both["x"])
    np.savez(tmp_path / "n.npz", x=both["x"], fs=np.nan)
    with pytest.raises(DataError, match="no valid sampling rate"):
        open_table(tmp_path / "n.npz")


def test_pickled_objects_are_never_read(tmp_path: Path) -> None:
    np.save(tmp_path / "r.npy", np.array([{"a": 1}, None], object), allow_pickle=True)
    with pytest.raises(DataError, match="is not a readable NumPy file of numbers"):
        open_table(tmp_path / "r.npy")


def test_frfs_in_variables_of_npz(tmp_path: Path) -> None:
    np.savez(tmp_path / "h.npz", f=np.array([1.0, 2.0]), H=np.array([1 + 1j, 2 + 2j]))
    layout = FrfLayout(file="h.npz", variables=FrfColumns(frequency="f", complex="H"), form="mobility")
    np.testing.assert_array_equal(
        read_described(tmp_path / "h.npz", layout, Dofs(("x",), ("f",))).matrix.ravel(), [1 + 1j, 2 + 2j]
    )


def workbook(path: Path, *rows: list[object], second: bool = False) -> Path:
    book = openpyxl.Workbook()
    for row in rows:
        book.active.append(row)
    book.create_sheet("remarks").append([1.0, 2.0] if second else ["made by hand"])
    book.save(path)
    return path


def test_the_sheet_of_an_excel_workbook(tmp_path: Path) -> None:
    """A title, names, a row of units; a time of day is in seconds since midnight; a cell may be empty."""
    rows = [[datetime.time(10, 0, n), n * 0.5, None if n == 1 else n] for n in range(4)]
    path = workbook(tmp_path / "r.xlsx", ["Run 3"], ["Time", "force", "x"], [None, "N", "um"], *rows)
    table = open_table(path)
    assert table.columns == ("Time", "force", "x") and table.units == {"force": "N", "x": "um"}
    np.testing.assert_array_equal(
        whole(path, "x", "Time"), [[0, 36000], [np.nan, 36001], [2, 36002], [3, 36003]]
    )


def test_faults_of_workbooks(tmp_path: Path) -> None:
    good = [[1.0, 2.0]] * 3
    with pytest.raises(DataError) as caught:
        whole(workbook(tmp_path / "r.xlsx", ["a", "b"], *good, [1.0, "much"]))
    assert str(caught.value).endswith("r.xlsx: sheet Sheet, row 5: column 'b': 'much' is not a number")
    with pytest.raises(DataError, match="several sheets hold numbers: Sheet, remarks"):
        open_table(workbook(tmp_path / "r.xlsx", ["a", "b"], *good, second=True))
    with pytest.raises(DataError, match="no sheet holds a row of numbers"):
        open_table(workbook(tmp_path / "r.xlsx", ["a", "b"]))


def test_the_longest_group_of_an_mdf_file(tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    times = np.arange(400) / 100
    force, ticks = np.sin(times), np.arange(400, dtype=np.int16)
    with MDF(version="4.10") as file:
        file.append([Signal(times[:9], times[:9], name="slow")])
        file.append([Signal(force, times, name="f", unit="N"), Signal(ticks, times, name="n")])
        file.save(tmp_path / "r.mf4")
    table = open_table(tmp_path / "r.mf4")
    assert table.columns == ("time [s]", "f", "n") and table.units == {"f": "N"}
    np.testing.assert_array_equal(
        whole(tmp_path / "r.mf4", "n", "time [s]", "f"), np.column_stack([ticks, times, force])
    )


def test_groups_at_two_rates_are_brought_to_one(tmp_path: Path) -> None:
    """Closed form: a sine at a fifth of the slower rate, whose cubic spline is 3 sinc^4(r) / (2 + cos 2 pi r)
    = 0.9951 of it; the fast one, on its own times, stays as it is.
    """
    from asammdf import MDF, Signal

    fast, slow = np.arange(4001) / 1000, np.arange(0.0, 4.0, 0.01)
    with MDF(version="4.10") as file:
        file.append([Signal(np.cos(40 * np.pi * slow), slow, name="a")])
        file.append([Signal(fast**2, fast, name="f", unit="N")])
        file.save(tmp_path / "r.mf4")
    table = open_table(tmp_path / "r.mf4")
    assert table.unused == {"a": slow.size} and [other.columns for other in table.others] == [(TIME, "a")]
    both = ResampledTable([table, *table.others], 1000.0)
    assert (both.columns, both.sample_rate, both.units) == (("f", "a"), 1000.0, {"f": "N"})
    (rows,) = both.chunks(["a", "f"])
    times = fast[: rows.shape[0]]
    assert times[-1] == pytest.approx(slow[-1])
    np.testing.assert_allclose(rows[:, 1], times**2, atol=1e-12)
    middle = slice(500, -500)
    cosine = np.cos(40 * np.pi * times[middle])
    gain = rows[middle, 0] @ cosine / (cosine @ cosine)
    assert gain == pytest.approx(3 * np.sinc(0.2) ** 4 / (2 + np.cos(0.4 * np.pi)), rel=1e-3)
    (finding,) = both.findings()
    assert finding.code == "resampled" and "within 0.5 % up to 20 Hz" in finding.message
    with pytest.raises(DataError, match=r"'f' is sampled at 1000 Hz, above resample: 500 Hz"):
        list(ResampledTable([table, *table.others], 500.0).chunks(["a", "f"]))


def mdf(path: Path) -> bytearray:
    """A measurement of nine samples."""
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        file.append([Signal(np.arange(9.0), np.arange(9.0), name="f")])
        file.save(path)
    return bytearray(path.read_bytes())


def test_more_samples_than_an_mdf_file_can_hold_are_refused_at_once(tmp_path: Path) -> None:
    """A channel group ##CG: the number of its samples at byte 80, then the bytes of a sample and of its marks
    at 96 and 100.

    The library made room for four gigabytes, at each of its channels.
    """
    content = mdf(tmp_path / "r.mf4")
    group = content.index(b"##CG")
    for place, size in ((80, 8), (96, 4), (100, 4)):
        damaged = bytearray(content)
        damaged[group + place : group + place + size] = (2**31).to_bytes(size, "little")
        (tmp_path / "r.mf4").write_bytes(damaged)
        with pytest.raises(DataError, match=r"samples of .* bytes are stated, 144 bytes are there"):
            open_table(tmp_path / "r.mf4")


def test_what_a_library_prints_and_leaves_of_a_damaged_file_is_not_there(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A channel ##CN whose data stand far behind those of its sample (byte offset at 92), where the library
    crashes with a temporary folder open.
    """
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    content = mdf(tmp_path / "r.mf4")
    channel = content.rindex(b"##CN")
    content[channel + 92 : channel + 96] = (2**31).to_bytes(4, "little")
    (tmp_path / "r.mf4").write_bytes(content)
    with pytest.raises(DataError, match="not a readable MDF file"):
        whole(tmp_path / "r.mf4")
    assert capfd.readouterr() == ("", "")
    assert not list((tmp_path / "temporary").iterdir())


def test_damaged_files_are_refused_in_one_line(tmp_path: Path) -> None:
    """Bytes overwritten: what the libraries throw, and what half-made objects of theirs say when they go, is
    one message.
    """
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        file.append([Signal(np.arange(9.0), np.arange(9.0), name="f")])
        file.save(tmp_path / "good.mf4")
    np.save(tmp_path / "good.npy", np.arange(9.0))
    np.savez_compressed(tmp_path / "good.npz", f=np.arange(9.0))
    workbook(tmp_path / "good.xlsx", [1.0, 2.0])
    for suffix, place in ((".mf4", 64), (".npy", 12), (".npz", 60), (".xlsx", -60)):
        content = bytearray((tmp_path / f"good{suffix}").read_bytes())
        content[place : place + 40] = b"{(" * 20
        (tmp_path / f"bad{suffix}").write_bytes(content)
        with pytest.raises(DataError, match="is not a readable") as caught:
            whole(tmp_path / f"bad{suffix}")
        assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("module", "suffix", "extra"), [("openpyxl", ".xlsx", "excel"), ("asammdf", ".mf4", "mdf")]
)
def test_a_library_that_is_not_there_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, suffix: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / f"r{suffix}").write_bytes(b"1")
    with pytest.raises(DataError) as caught:
        open_table(tmp_path / f"r{suffix}")
    assert str(caught.value).endswith(
        f"r{suffix}: needs the package {module}; pip install 'labpipe[{extra}]'"
    )


@pytest.mark.parametrize(
    ("title", "dimension"),
    [("Acceleration (FFT - (RMS))", "Time"), ("a (Power Spectrum)", "Time"), ("a", "Frequency")],
)
def test_the_axis_of_an_lvm_spectrum_is_no_time(tmp_path: Path, title: str, dimension: str) -> None:
    """LabVIEW says Time of an FFT as well.

    With or without X values no rate follows from the distance of the lines.
    """
    head = SEGMENT.replace("\tF\ta\tComment", f"\t{title}\t{title} 2\tComment").replace(
        "Time\tTime", f"{dimension}\t{dimension}"
    )
    path = lvm(tmp_path / "s.lvm", head + "0.0\t1\t2\n0.5\t3\t4\n1.0\t5\t6\n", step="0.5")
    table = open_table(path)
    assert table.units["X_Value"] == "Hz" and table.sample_rate is None
    overview = inspect(path)
    assert isinstance(overview, Overview) and overview.sample_rate is None and overview.time == ""
    assert overview.rate == "a spectrum: 'X_Value' is a frequency in Hz, no time"
    assert open_table(lvm(tmp_path / "w.lvm", head + "\t1\t2\n\t3\t4\n", step="0.5")).sample_rate is None
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        f"name: R\ntime: X_Value\nchannels:\n  a: {{column: '{title}', quantity: acceleration, "
        "role: output}\n"
    )
    with (
        output_folder(tmp_path / "out") as output,
        pytest.raises(DataError, match="'X_Value' is a frequency, no time"),
    ):
        ingest(SourceFile(path, load_rig(rig)), output, "s", tmp_path)
    with pytest.raises(DataError, match="the file holds a spectrum"):
        scaffold([path], tmp_path)


def test_parquet_columns_of_every_kind(tmp_path: Path) -> None:
    """Times as pandas writes them, over midnight; a text is named where numbers are asked of it."""
    path = tmp_path / "run.parquet"
    frame = pd.DataFrame(
        {
            "stamp": pd.date_range("2024-02-29 23:59:59.5", periods=3, freq="500ms", tz="UTC"),
            "since": pd.to_timedelta([0, 250, 500], unit="ms"),
            "open": [True, False, True],
            "x": [1.5, 2.5, -3.5],
            "state": ["up", "up", "down"],
        }
    )
    frame.loc[1, "stamp"] = pd.NaT
    frame.to_parquet(path)
    table = open_table(path)
    assert table.columns == ("stamp", "since", "open", "x")
    assert table.units == {"stamp": "s", "since": "s"}
    rows = [[86399.5, 0.0, 1.0, 1.5], [np.nan, 0.25, 0.0, 2.5], [86400.5, 0.5, 1.0, -3.5]]
    np.testing.assert_array_equal(whole(path), rows)
    with pytest.raises(DataError, match="the column 'state' holds text, not numbers"):
        check_columns(table, ["state"])
    frame[["state"]].to_parquet(path)
    with pytest.raises(DataError, match="has no column of numbers"):
        open_table(path)


def test_texts_beside_the_numbers_of_a_workbook(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    rows = [[n / 2, "up" if n < 5 else "down", None if n == 3 else n * n] for n in range(9)]
    for row in (["Run 5"], [9], ["t", "state", "x"], *rows):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    table = open_table(tmp_path / "run.xlsx")
    assert table.columns == ("t", "x")
    expected = [[n / 2, np.nan if n == 3 else n * n] for n in range(9)]
    np.testing.assert_array_equal(whole(table.path), expected)
    with pytest.raises(DataError, match="the column 'state' holds text"):
        check_columns(table, ["state"])


def test_lvm_channels_that_begin_apart_are_no_recording(tmp_path: Path) -> None:
    segment = SEGMENT.replace("Delta_X", "X0\t0\t2.0E-3\t\nDelta_X")
    with pytest.raises(DataError, match=r"begin up to 0\.002 s apart \(X0\)"):
        open_table(lvm(tmp_path / "r.lvm", segment + ROWS))


def test_samples_that_an_mdf_file_marks_as_invalid_are_missing(tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    marks = np.array([False, True, False])
    with MDF() as file:
        file.append([Signal(np.arange(3.0), np.arange(3.0), name="x", invalidation_bits=marks)])
        file.save(tmp_path / "r.mf4")
    np.testing.assert_array_equal(whole(tmp_path / "r.mf4", "x")[:, 0], [0.0, np.nan, 2.0])


def test_a_channel_in_a_group_of_its_own_is_named_as_such(tmp_path: Path) -> None:
    """Loggers give every channel a group: at one rate nobody may speak of another rate alone."""
    from asammdf import MDF, Signal

    with MDF() as file:
        for name in "xf":
            file.append([Signal(np.arange(5.0), np.arange(5.0), name=name)])
        file.save(tmp_path / "r.mf4")
    with pytest.raises(DataError, match="'x' lies in another group than the others"):
        check_columns(open_table(tmp_path / "r.mf4"), ["x"])

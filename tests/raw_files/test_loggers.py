"""TDMS by npTDMS's own writer and shipped files, WAV by scipy's and Python's writers, packed CSV."""

from __future__ import annotations

import gzip
import wave
from pathlib import Path

import nptdms
import numpy as np
import pyarrow as pa
import pytest
from nptdms import ChannelObject, RootObject, TdmsWriter
from scipy.io import wavfile

from labpipe.errors import DataError
from labpipe.project.ready_response import read_frf_file
from labpipe.raw_files import tdms_table
from labpipe.raw_files.table import open_table

SHIPPED = Path(nptdms.__file__).parent / "test" / "data"


def whole(table) -> np.ndarray:
    return np.concatenate(list(table.chunks(table.columns)))


def tdms(path: Path, *channels: ChannelObject, times: int = 1) -> Path:
    with TdmsWriter(str(path)) as writer:
        for _ in range(times):
            writer.write_segment([RootObject(), *channels])
    return path


def test_tdms_in_blocks_with_names_units_and_rate(tmp_path: Path, rng, monkeypatch) -> None:
    monkeypatch.setattr(tdms_table, "CHUNK_ROWS", 300)
    x, y = rng.normal(size=200), rng.integers(-9, 9, size=200).astype(np.int16)
    wave_form = {"wf_increment": 1 / 51200, "unit_string": "um"}
    channels = [
        ChannelObject("rig", "x", x, wave_form),
        ChannelObject("rig", "y", y, {"wf_increment": 1 / 51200, "NI_UnitDescription": "V"}),
        ChannelObject("slow", "T", x[:7]),
        ChannelObject("notes", "text", ["a"] * 200),
        ChannelObject("other", "y", y),
    ]
    table = open_table(tdms(tmp_path / "r.tdms", *channels, times=5))
    assert (sorted(table.columns), table.sample_rate) == (["other/y", "rig/y", "x"], 51200.0)
    assert table.units == {"x": "um", "rig/y": "V"}
    chunks = list(table.chunks(["rig/y", "x"]))
    assert [len(chunk) for chunk in chunks] == [300, 300, 300, 100]
    np.testing.assert_array_equal(np.concatenate(chunks), np.tile(np.column_stack([y, x]), (5, 1)))


def test_scaling_properties_are_applied(tmp_path: Path) -> None:
    """y = 2 + 0.5 n of a linear scale, y = 1 + n^2 of a polynomial one, by hand."""
    n = np.arange(50, dtype=np.int16)
    linear = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Linear", "NI_Scale[0]_Linear_Slope": 0.5,
              "NI_Scale[0]_Linear_Y_Intercept": 2.0,
              "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF}  # fmt: skip
    square = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Polynomial",
    "NI_Scale[0]_Polynomial_Coefficients_Size": 3,
              "NI_Scale[0]_Polynomial_Coefficients[0]": 1.0, "NI_Scale[0]_Polynomial_Coefficients[1]": 0.0,
              "NI_Scale[0]_Polynomial_Coefficients[2]": 1.0,
              "NI_Scale[0]_Polynomial_Input_Source": 0xFFFFFFFF}  # fmt: skip
    table = open_table(
        tdms(tmp_path / "r.tdms", ChannelObject("g", "a", n, linear), ChannelObject("g", "b", n, square))
    )
    np.testing.assert_array_equal(whole(table), np.column_stack([2 + 0.5 * n, 1.0 + n.astype(float) ** 2]))


@pytest.mark.skipif(not SHIPPED.is_dir(), reason="this npTDMS ships no files")
@pytest.mark.parametrize(
    ("name", "shape", "rate"), [("big_endian.tdms", (3500, 2), 1000.0), ("raw1.tdms", (2000, None), None)]
)
def test_shipped_tdms_files(name: str, shape: tuple, rate: float | None) -> None:
    table = open_table(SHIPPED / name)
    samples = whole(table)
    assert samples.shape == (shape[0], shape[1] or len(table.columns))
    assert np.isfinite(samples).all() and np.ptp(samples) > 0
    assert rate is None or table.sample_rate == rate


def test_broken_tdms_files(tmp_path: Path) -> None:
    path = tdms(tmp_path / "r.tdms", ChannelObject("g", "a", np.arange(500.0)))
    content = path.read_bytes()
    for length in (0, 3, 20, 40, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(DataError, match=r"r\.tdms"):
            whole(open_table(path))
    path.write_bytes(b"MZ" + content)
    with pytest.raises(DataError, match="is not a readable TDMS file"):
        open_table(path)
    rates = [
        ChannelObject("g", name, np.arange(5.0), {"wf_increment": step})
        for name, step in (("a", 0.1), ("b", 0.2))
    ]
    with pytest.raises(DataError, match="one rate is required"):
        open_table(tdms(path, *rates))
    with pytest.raises(DataError, match="no channel of numbers"):
        open_table(tdms(path, ChannelObject("g", "a", ["text"])))


@pytest.mark.parametrize("dtype", ["int16", "int32", "uint8", "float32", "float64"])
def test_wav_is_a_share_of_full_scale(tmp_path: Path, dtype: str) -> None:
    share = np.array([[-0.5, 0.25], [0.0, -1.0], [0.75, 0.5]])
    half = {"int16": 2**15, "int32": 2**31, "uint8": 2**7}.get(dtype, 1)
    wavfile.write(tmp_path / "r.wav", 48000, (share * half + (half if dtype == "uint8" else 0)).astype(dtype))
    table = open_table(tmp_path / "r.wav")
    assert (table.columns, table.units, table.sample_rate) == (("1", "2"), {"1": "1", "2": "1"}, 48000.0)
    np.testing.assert_array_equal(whole(table), share)


def test_wav_of_24_bits(tmp_path: Path) -> None:
    values = [0, 2**22, -(2**23), 1]
    with wave.open(str(tmp_path / "r.wav"), "wb") as file:
        file.setparams((1, 3, 8000, 0, "NONE", ""))
        file.writeframes(b"".join(value.to_bytes(3, "little", signed=True) for value in values))
    np.testing.assert_array_equal(whole(open_table(tmp_path / "r.wav"))[:, 0], np.array(values) / 2**23)


def test_broken_wav_files(tmp_path: Path) -> None:
    wavfile.write(tmp_path / "r.wav", 8000, np.arange(500, dtype=np.int16))
    content = (tmp_path / "r.wav").read_bytes()
    for length in (0, 3, 10, 20, 40, 44, 500, len(content) - 2):
        (tmp_path / "r.wav").write_bytes(content[:length])
        with pytest.raises(DataError, match=r"r\.wav"):
            whole(open_table(tmp_path / "r.wav"))


TEXT = b"t [s];x [um]\n" + b"".join(b"%d,5;%d\n" % (n, n * n) for n in range(2000))


def packed(path: Path, content: bytes) -> Path:
    path.write_bytes(
        gzip.compress(content) if path.suffix == ".gz" else pa.Codec("zstd").compress(content, asbytes=True)
    )
    return path


@pytest.mark.parametrize("name", ["r.csv.gz", "r.TXT.zst"])
def test_packed_text_is_read_as_the_plain_one(tmp_path: Path, name: str) -> None:
    (tmp_path / "r.csv").write_bytes(TEXT)
    plain, table = open_table(tmp_path / "r.csv"), open_table(packed(tmp_path / name, TEXT))
    assert (table.columns, table.units) == (plain.columns, plain.units)
    np.testing.assert_array_equal(whole(table), whole(plain))


@pytest.mark.parametrize("name", ["r.csv.gz", "r.csv.zst"])
def test_packed_files_that_are_broken(tmp_path: Path, name: str) -> None:
    path = packed(tmp_path / name, TEXT * 30)
    content = path.read_bytes()
    for length in (0, 2, 30, len(content) // 2):
        path.write_bytes(content[:length])
        with pytest.raises(DataError, match=name):
            whole(open_table(path))
    with pytest.raises(DataError, match=f"{name}:2001: column 'x .um.': 'oops' is not a number"):
        whole(open_table(packed(path, TEXT.replace(b"1999,5;3996001", b"1999,5;oops"))))


def test_packed_frf_table(tmp_path: Path) -> None:
    path = packed(tmp_path / "h.csv.gz", b"# form: mobility\nfrequency_hz,x/f:re,x/f:im\n1,2,3\n2,4,5\n")
    response = read_frf_file(path)
    assert response.form == "mobility" and response.matrix.ravel().tolist() == [2 + 3j, 4 + 5j]


@pytest.mark.parametrize("name", ["r.gz", "r.tdms.gz.zst", "r.xls"])
def test_unknown_endings(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"1")
    with pytest.raises(DataError, match="cannot be read"):
        open_table(tmp_path / name)

"""TDMS files of any layout: the numbers that were written, each read once."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from nptdms import ChannelObject, RootObject, TdmsWriter, base_segment, tdms_segment

from labpipe.errors import DataError
from labpipe.raw_files import tdms_table
from labpipe.raw_files.table import check_columns, open_table

# The lead-in of a segment: mark, flags, version, bytes to the next segment and to the raw data.
LEAD_IN = struct.Struct("<4sIIQQ")
INTERLEAVED = 1 << 5


def write(path: Path, *segments: dict[str, np.ndarray]) -> Path:
    with TdmsWriter(str(path)) as writer:
        for segment in segments:
            writer.write_segment(
                [RootObject(), *(ChannelObject("g", name, part) for name, part in segment.items())]
            )
    return path


def patched(path: Path, more: bytes = b"", flags: int = 0) -> None:
    """Give the only segment further raw data and flags."""
    content = path.read_bytes()
    mark, toc, version, following, raw = LEAD_IN.unpack_from(content)
    path.write_bytes(
        LEAD_IN.pack(mark, toc | flags, version, following + len(more), raw) + content[LEAD_IN.size :] + more
    )


def numbers(path: Path, *names: str) -> np.ndarray:
    return np.concatenate(list(open_table(path).chunks(names)))


def test_a_channel_with_fewer_values_is_named_as_such(tmp_path: Path) -> None:
    table = open_table(write(tmp_path / "r.tdms", {"x": np.zeros(9), "slow": np.zeros(3)}))
    assert table.columns == ("x",)
    with pytest.raises(DataError, match="'slow' has 3 values, fewer than the others"):
        check_columns(table, ["slow"])


@pytest.mark.parametrize("seed", range(6))
def test_segments_of_any_lengths_and_kinds(
    tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tdms_table, "CHUNK_ROWS", 101)
    rng = np.random.default_rng(seed)
    kinds = dict(
        zip("abc", rng.choice([np.float32, np.float64, np.int16, np.int32, np.uint8], 3), strict=True)
    )
    segments = []
    for _ in range(rng.integers(1, 7)):
        length = int(rng.integers(1, 200))
        values = {name: rng.integers(0, 200, length).astype(kind) for name, kind in kinds.items()}
        # A channel may come before another one in one segment and after it in the next.
        segments.append({name: values[name] for name in rng.permutation(list(kinds))})
    path = write(tmp_path / "r.tdms", *segments)
    expected = np.column_stack([np.concatenate([segment[name] for segment in segments]) for name in "cab"])
    np.testing.assert_array_equal(numbers(path, "c", "a", "b"), expected)


def test_chunks_of_one_segment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A logger that writes on without a new lead-in: the raw data repeat the order of the first."""
    monkeypatch.setattr(tdms_table, "CHUNK_ROWS", 33)
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(9, 20)), rng.integers(-99, 99, (9, 20)).astype(np.int16)
    path = write(tmp_path / "r.tdms", {"x": x[0], "y": y[0]})
    patched(path, b"".join(x[n].tobytes() + y[n].tobytes() for n in range(1, 9)))
    np.testing.assert_array_equal(numbers(path, "x", "y"), np.column_stack([x.ravel(), y.ravel()]))


def test_interleaved_values(tmp_path: Path) -> None:
    x = np.arange(40.0)
    path = write(tmp_path / "r.tdms", {"x": x[:20], "y": x[20:]})
    patched(path, flags=INTERLEAVED)
    np.testing.assert_array_equal(numbers(path, "x", "y"), x.reshape(20, 2))


def test_every_chunk_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one long segment as well, of which npTDMS reads a channel from end to end for every part that is
    asked for.
    """
    path = write(tmp_path / "r.tdms", {"x": np.arange(5000.0), "y": np.arange(5000.0)})
    monkeypatch.setattr(tdms_table, "CHUNK_ROWS", 100)
    n_read, fromfile = [], base_segment.fromfile

    def counted(*arguments: object, **more: object) -> np.ndarray:
        n_read.append(fromfile(*arguments, **more))
        return n_read[-1]

    monkeypatch.setattr(tdms_segment, "fromfile", counted)
    assert numbers(path, "x", "y").shape == (5000, 2)
    assert sum(values.nbytes for values in n_read) == 2 * 5000 * 8


def test_a_file_that_ends_while_it_is_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "r.tdms", *({"x": np.arange(1000.0)} for _ in range(5)))
    monkeypatch.setattr(tdms_table, "CHUNK_ROWS", 100)
    chunks = open_table(path).chunks(["x"])
    assert next(chunks).shape == (100, 1)
    os.truncate(path, 20_000)
    with pytest.raises(DataError, match=r"r\.tdms: is not a readable TDMS file"):
        list(chunks)


def test_channels_of_one_name_in_a_file_that_grows(tmp_path: Path) -> None:
    """Each by its group, as in a file that is whole; the name alone says neither."""
    with TdmsWriter(str(tmp_path / "r.tdms")) as writer:
        parts = [ChannelObject(group, "x", np.arange(4.0) + n) for n, group in enumerate("ab")]
        writer.write_segment([RootObject(), *parts])
    rows, _ = tdms_table.growing_rows(tmp_path / "r.tdms", ["a/x", "b/x"], 0, 9)
    np.testing.assert_array_equal(rows, np.column_stack([np.arange(4.0), np.arange(4.0) + 1]))
    with pytest.raises(DataError, match="no column 'x'"):
        tdms_table.growing_rows(tmp_path / "r.tdms", ["x"], 0, 9)


@pytest.mark.parametrize(
    "later", [{"wf_start_offset": 2e-3}, {"wf_start_time": np.datetime64("2026-01-01T00:00:00.002")}]
)
def test_channels_that_begin_apart_are_no_recording(tmp_path: Path, later: dict) -> None:
    start = {"wf_increment": 1e-3, "wf_start_time": np.datetime64("2026-01-01"), "wf_start_offset": 0.0}
    with TdmsWriter(str(tmp_path / "r.tdms")) as writer:
        for name, properties in (("f", start), ("x", start | later)):
            writer.write_segment([RootObject(), ChannelObject("g", name, np.arange(9.0), properties)])
    with pytest.raises(DataError, match=r"begin up to 0\.002 s apart"):
        open_table(tmp_path / "r.tdms")


def test_the_step_of_a_spectrum_is_no_rate(tmp_path: Path) -> None:
    properties = {"wf_increment": 0.5, "wf_xunit_string": "Hz"}
    with TdmsWriter(str(tmp_path / "r.tdms")) as writer:
        writer.write_segment([RootObject(), ChannelObject("g", "x", np.arange(9.0), properties)])
    assert open_table(tmp_path / "r.tdms").sample_rate is None

"""MATLAB and HDF5 files, made by scipy's and h5py's own writers and by labpipe."""

from __future__ import annotations

import contextlib
import struct
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import eye_array

from labpipe.errors import DataError
from labpipe.raw_files.mat import (
    load_hdf5_variables,
    load_variables,
    read_frf_mat,
    write_frf_mat,
    write_recording_mat,
)
from labpipe.raw_files.table import open_table
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port

N = 300_001


def whole(table) -> np.ndarray:
    return np.concatenate(list(table.chunks(table.columns)))


def _element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


@pytest.mark.parametrize("squeezed", [False, True])
def test_an_object_beside_the_vectors(tmp_path: Path, squeezed: bool) -> None:
    """An object (a table, a string) as MATLAB writes it: class 17, its name, two more names and a matrix; the
    vectors beside it are read.
    """
    savemat(tmp_path / "r.mat", {"x": np.arange(9.0), "fs": 100.0}, do_compression=squeezed)
    numbers = _element(6, struct.pack("<II", 13, 0)) + _element(5, struct.pack("<ii", 6, 1))
    numbers += _element(1, b"") + _element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1))
    names = b"".join(_element(1, text) for text in (b"s", b"MCOS", b"string"))
    opaque = _element(14, _element(6, struct.pack("<II", 17, 0)) + names + _element(14, numbers))
    packed = zlib.compress(opaque)
    element = struct.pack("<II", 15, len(packed)) + packed if squeezed else opaque
    (tmp_path / "r.mat").write_bytes((tmp_path / "r.mat").read_bytes() + element)
    table = open_table(tmp_path / "r.mat")
    assert (table.columns, table.sample_rate) == (("x",), 100.0)
    np.testing.assert_array_equal(whole(table)[:, 0], np.arange(9))


def test_a_structure_array_with_a_name_and_a_unit_for_each_channel(tmp_path: Path) -> None:
    """As dSPACE writes it: the time in X, and a structure of Y for each channel."""
    fields = [("Name", object), ("Unit", object), ("Data", object)]
    time, force, motion = 1e-3 * np.arange(9), np.arange(9.0), np.arange(9.0) ** 2
    x = np.array([[("Time", "s", time)]], fields)
    y = np.array([[("Model/force", '"N"', force), ("Model/x", "um", motion)]], fields)
    savemat(tmp_path / "r.mat", {"meas": {"X": x, "Y": y}})
    table = open_table(tmp_path / "r.mat")
    assert table.columns == ("Time", "Model/force", "Model/x")
    assert table.units == {"Time": "s", "Model/force": "N", "Model/x": "um"}
    np.testing.assert_array_equal(whole(table), np.column_stack([time, force, motion]))
    same = np.array([[("y", "", force), ("y", "", motion)]], fields)
    savemat(tmp_path / "s.mat", {"meas": {"Y": same}})
    assert open_table(tmp_path / "s.mat").columns == ("meas.Y(1).Data", "meas.Y(2).Data")


def test_structures_in_cells(tmp_path: Path) -> None:
    """As an impedance analyser writes a sweep: a structure in a cell in a cell."""
    frequency, real = 100.0 + np.arange(9.0), np.arange(9.0) ** 2
    sample, cell = np.empty(1, object), np.empty(1, object)
    sample[0] = {"frequency": frequency, "realz": real, "header": {"name": "sweep"}}
    cell[0] = sample
    savemat(tmp_path / "r.mat", {"device": {"imps": {"sample": cell}}})
    table = open_table(tmp_path / "r.mat")
    place = "device.imps.sample{1}{1}"
    assert table.columns == (f"{place}.frequency", f"{place}.realz")
    np.testing.assert_array_equal(whole(table), np.column_stack([frequency, real]))


@pytest.mark.parametrize("version", ["4", "5"])
def test_vectors_matrices_and_rates(tmp_path: Path, rng, version: str) -> None:
    x, matrix = rng.normal(size=(70, 1)), rng.normal(size=(70, 2))
    savemat(
        tmp_path / "r.mat",
        {"x": x, "m": matrix, "row": x.T, "short": np.ones(5), "Fs": 5000.0, "dt": 2e-4},
        format=version,
    )
    table = open_table(tmp_path / "r.mat")
    assert (table.columns, table.sample_rate) == (("x", "m_1", "m_2", "row"), 5000.0)
    np.testing.assert_array_equal(whole(table), np.column_stack([x, matrix, x]))


def test_structures_integers_and_other_contents(tmp_path: Path) -> None:
    others = {"note": "text", "z": np.ones(9) * 1j, "cells": np.array([1, "a"], object)}
    run = {"x": np.arange(9, dtype=np.int16), "Time_Sample_Rate": 100.0, **others}
    savemat(tmp_path / "r.mat", {"run": run})
    table = open_table(tmp_path / "r.mat")
    assert (table.columns, table.sample_rate) == (("run.x",), 100.0)
    np.testing.assert_array_equal(whole(table)[:, 0], np.arange(9))


def test_sparse_matrices_are_no_channels(tmp_path: Path) -> None:
    savemat(tmp_path / "r.mat", {"K": eye_array(90).tocsc(), "x": np.ones(9)})
    assert open_table(tmp_path / "r.mat").columns == ("x",)


def test_hdf5_in_blocks_with_attributes(tmp_path: Path, rng) -> None:
    x, m = rng.normal(size=N), rng.integers(0, 9, size=(2, N))
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file.create_dataset("run/x", data=x, chunks=True, compression="gzip").attrs["unit"] = "um"
        file["run/m"] = m
        file["note"] = "text"
        file["short"] = np.ones(7)
        file["run/x"].attrs["sample_rate"] = 51200
        file["elsewhere"] = h5py.ExternalLink("other.h5", "/x")
    table = open_table(tmp_path / "r.h5")
    assert (table.columns, table.units, table.sample_rate) == (
        ("run/m_1", "run/m_2", "run/x"),
        {"run/x": "um"},
        51200.0,
    )
    chunks = list(table.chunks(["run/x", "run/m_2"]))
    assert max(len(chunk) for chunk in chunks) < N
    np.testing.assert_array_equal(np.concatenate(chunks), np.column_stack([x, m[1]]))


def test_packed_numbers_of_hdf5_are_read_as_what_they_stand_for(tmp_path: Path) -> None:
    """CF conventions, section 8.1: value = scale_factor * stored + add_offset, missing at _FillValue."""
    with h5py.File(tmp_path / "r.h5", "w") as file:
        for name in ("x", "m"):
            file[name] = np.array([[-4, 0, 2, 32767]] * (1 if name == "x" else 2), np.int16)
            file[name].attrs.update({"scale_factor": np.float32(0.5), "add_offset": [10.0]})
        file["x"].attrs["_FillValue"] = np.int16(32767)
    chunks = np.concatenate(list(open_table(tmp_path / "r.h5").chunks(["x", "m_2"])))
    np.testing.assert_array_equal(chunks.T, [[8, 10, 11, np.nan], [8, 10, 11, 16393.5]])
    np.testing.assert_array_equal(load_hdf5_variables(tmp_path / "r.h5", ["x"])["x"], [[8, 10, 11, np.nan]])
    with h5py.File(tmp_path / "r.h5", "a") as file:
        file["x"].attrs["scale_factor"] = "0.5"
    with pytest.raises(
        DataError, match=r"r\.h5: is not a readable HDF5 file \(scale_factor of /x is not a number"
    ):
        open_table(tmp_path / "r.h5")


def test_matlab_7_3_is_hdf5_behind_its_own_block(tmp_path: Path, rng) -> None:
    """The layout MATLAB writes: 512 bytes of text, matrices transposed, chars as numbers, references
    aside.
    """
    x = rng.normal(size=(1, 50))
    with h5py.File(tmp_path / "r.mat", "w", userblock_size=512) as file:
        for name, values, kind in (
            ("x", x, b"double"),
            ("fs", [[200.0]], b"double"),
            ("label", [[104] * 50], b"char"),
        ):
            file[name] = np.array(values)
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)
        file["#refs#/a"] = np.ones(90)
    table = open_table(tmp_path / "r.mat")
    assert (table.columns, table.sample_rate) == (("x",), 200.0)
    np.testing.assert_array_equal(whole(table), x.T)


@pytest.mark.parametrize("n_input", [1, 2])
def test_round_trip_of_a_response(tmp_path: Path, rng, n_input: int) -> None:
    """Everything is kept to the last bit, covariance and a trailing dimension of 1 included."""
    matrix = rng.normal(size=(6, 2, n_input)) + 1j * rng.normal(size=(6, 2, n_input))
    n = 2 * n_input
    outputs = (Port("x", "x", "x", 0.0), Port("probe 2", "probe 2", "45 deg", np.pi / 4))
    inputs = tuple(Port(f"f{i}", f"f{i}", "z", None) for i in range(n_input))
    covariance = rng.normal(size=(6, n, n)) + 1j * rng.normal(size=(6, n, n))
    frequency = np.sort(rng.uniform(1, 9, 6))
    coherence = rng.random(matrix.shape)
    made = FrequencyResponse(
        frequency,
        matrix,
        outputs,
        inputs,
        form="mobility",
        covariance=covariance,
        coherence=coherence,
        covariance_dof=17.5,
    )
    write_frf_mat(tmp_path / "h.mat", made)
    read = read_frf_mat(tmp_path / "h.mat")
    assert (read.outputs, read.inputs, read.form, read.covariance_dof) == (outputs, inputs, "mobility", 17.5)
    for name in ("frequency", "matrix", "covariance", "coherence"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))


def test_round_trip_of_a_recording(tmp_path: Path, rng) -> None:
    channels = (Channel("f 1", "force", "input", "x"), Channel("2y", "displacement", "output", "y"))
    made = Recording(channels, rng.normal(size=(40, 2)), 12345.5)
    write_recording_mat(tmp_path / "r.mat", made)
    table = open_table(tmp_path / "r.mat")
    assert (table.columns, table.units, table.sample_rate) == (
        ("f_1", "x2y"),
        {"f_1": "N", "x2y": "m"},
        12345.5,
    )
    np.testing.assert_array_equal(whole(table), made.samples)


@pytest.mark.parametrize("name", ["r.mat", "r.h5"])
def test_a_file_cut_off_anywhere_is_refused(tmp_path: Path, rng, name: str) -> None:
    x = rng.normal(size=5000)
    if name == "r.mat":
        savemat(tmp_path / name, {"x": x}, do_compression=True)
    else:
        with h5py.File(tmp_path / name, "w") as file:
            file["x"] = x
    content = (tmp_path / name).read_bytes()
    for length in (0, 1, 100, 127, 140, 600, 2000, len(content) // 2, len(content) - 20):
        (tmp_path / name).write_bytes(content[:length])
        with pytest.raises(DataError, match=name):
            whole(open_table(tmp_path / name))


@pytest.mark.parametrize(
    ("variables", "fragment"),
    [
        ({"x": np.ones(9), "fs": 100.0, "dt": 0.02}, "has no valid sampling rate"),
        ({"x": np.ones(9), "fs": -1.0}, "has no valid sampling rate"),
        ({"x": np.ones(9) * 1j}, "holds no vector of numbers"),
        ({"x": "text"}, "holds no vector of numbers"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path: Path, variables: dict, fragment: str) -> None:
    savemat(tmp_path / "r.mat", variables)
    with pytest.raises(DataError, match=fragment):
        open_table(tmp_path / "r.mat")


CELL = np.array(["x"], object)
FRF = {
    "frequency_hz": np.arange(3.0),
    "H": np.ones((3, 1, 1)) * 1j,
    "form": "receptance",
    "outputs": CELL,
    "inputs": CELL,
}


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ({"H": None}, "lacks the variable H"),
        ({"H": np.ones((2, 1, 1)) * 1j}, "H has the size"),
        (
            {
                "H": np.ones((3, 2)) * 1j,
                "outputs": np.array(["x", "y"], object),
                "inputs": np.array(["x", "y"], object),
            },
            "H has the size",
        ),
        ({"H": "text"}, "H holds no numbers"),
        ({"form": "reluctance"}, "unknown form 'reluctance'"),
        ({"unit": "mm/N"}, "H is in mm/N by the variable unit, a receptance in m/N is needed"),
        ({"output_dofs": np.array(["x", "y"], object)}, "differ in length"),
    ],
)
def test_what_is_no_response_is_refused(tmp_path: Path, changes: dict, fragment: str) -> None:
    savemat(
        tmp_path / "h.mat", {key: value for key, value in {**FRF, **changes}.items() if value is not None}
    )
    with pytest.raises(DataError, match=fragment):
        read_frf_mat(tmp_path / "h.mat")


@pytest.mark.parametrize("compressed", [False, True])
def test_damaged_bytes_end_in_one_message_or_in_numbers(tmp_path: Path, rng, compressed: bool) -> None:
    """Sizes and types that do not fit would end the program within scipy."""
    savemat(tmp_path / "r.mat", {"x": rng.normal(size=60), "s": {"a": np.ones(9)}}, do_compression=compressed)
    content = (tmp_path / "r.mat").read_bytes()
    for place in range(128, min(len(content), 200)):
        (tmp_path / "r.mat").write_bytes(
            content[:place] + bytes([content[place] ^ 0x5A]) + content[place + 1 :]
        )
        with contextlib.suppress(DataError):
            whole(open_table(tmp_path / "r.mat"))


@pytest.mark.parametrize(
    ("place", "value", "refused"),
    [
        (127, ord("X"), True),
        (128, 9, True),
        (132, 0xFF, False),
        (136, 5, False),
        (144, 99, True),
        (145, 8, True),
        (145, 0xFF, True),
        (152, 6, False),
        (176, 0, True),
        (177, 0xFF, True),
    ],
)
def test_elements_that_do_not_fit(tmp_path: Path, place: int, value: int, refused: bool) -> None:
    """By bytes 145, 176 and 177, the class and the type of the numbers, scipy's reader ends by a segmentation
    fault; where only a header is damaged, the numbers are those that were written.
    """
    savemat(tmp_path / "r.mat", {"x": np.ones(60), "s": {"a": np.ones(9)}})
    content = bytearray((tmp_path / "r.mat").read_bytes())
    content[place] = value
    (tmp_path / "r.mat").write_bytes(content)
    if refused:
        with pytest.raises(DataError, match="is not a readable MATLAB file"):
            open_table(tmp_path / "r.mat")
    else:
        np.testing.assert_array_equal(load_variables(tmp_path / "r.mat")["x"].ravel(), np.ones(60))


def test_attributes_beside_a_rate_and_in_lists(tmp_path: Path) -> None:
    """A rate in kHz and a step in us; a list of one unit, and one of a unit for each column of a matrix."""
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file.create_dataset("fs", data=20.0).attrs["unit"] = "kHz"
        file.create_dataset("dt", data=50.0).attrs["units"] = "us"
        file.create_dataset("x", data=np.arange(5.0)).attrs["unit"] = np.array([b"um"])
        file.create_dataset("m", data=np.ones((5, 2))).attrs["unit"] = np.array([b"N", b"V"])
    table = open_table(tmp_path / "r.h5")
    assert (table.sample_rate, table.units) == (20e3, {"x": "um", "m_1": "N", "m_2": "V"})
    savemat(tmp_path / "r.mat", {"x": np.arange(5.0), "fs": 20.0, "units": {"fs": "kHz", "x": "um"}})
    assert open_table(tmp_path / "r.mat").sample_rate == 20e3

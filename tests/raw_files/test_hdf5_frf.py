"""Frequency responses in HDF5: as MATLAB 7.3 lays them out (written here with h5py after MathWorks'
description), and plain.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.project.ready_response import is_response, load_response
from labpipe.raw_files.mat import holds_response, load_hdf5_variables, read_frf_mat

FREQUENCY = np.arange(1.0, 21.0)
COMPLEX = np.dtype([("real", "<f8"), ("imag", "<f8")])


def matrix(rng: np.random.Generator) -> np.ndarray:
    """(n_frequency, 3 outputs, 2 inputs), no two entries alike."""
    return rng.normal(size=(20, 3, 2)) + 1j * rng.normal(size=(20, 3, 2))


def matlab_text(file: h5py.File, name: str, text: str) -> h5py.Dataset:
    item = file.create_dataset(name, data=np.array([[ord(c)] for c in text], np.uint16))
    item.attrs["MATLAB_class"] = np.bytes_(b"char")
    return item


def matlab_array(file: h5py.File, name: str, values: np.ndarray) -> None:
    """Dimensions reversed, complex numbers as pairs."""
    if np.iscomplexobj(values):
        pairs = np.empty(values.shape, COMPLEX)
        pairs["real"], pairs["imag"] = values.real, values.imag
        values = pairs
    item = file.create_dataset(name, data=values.T)
    item.attrs["MATLAB_class"] = np.bytes_(b"double")


def matlab_cell(file: h5py.File, name: str, texts: list[str]) -> None:
    stored = [matlab_text(file, f"#refs#/{name}{n}", text) for n, text in enumerate(texts)]
    item = file.create_dataset(name, data=np.array([[one.ref] for one in stored], h5py.ref_dtype))
    item.attrs["MATLAB_class"] = np.bytes_(b"cell")


def write_matlab(path: Path, values: np.ndarray) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        matlab_array(file, "frequency_hz", FREQUENCY[:, None])
        matlab_array(file, "H", values)
        matlab_text(file, "form", "accelerance")
        matlab_cell(file, "outputs", ["x", "y", "tilt"])
        matlab_cell(file, "inputs", ["f1", "f2"])
        matlab_array(file, "coherence", np.abs(values) / 10)


def test_a_response_of_matlab_7_3(tmp_path: Path, rng) -> None:
    values = matrix(rng)
    write_matlab(tmp_path / "h.mat", values)
    assert holds_response(tmp_path / "h.mat") and is_response(tmp_path / "h.mat")
    read = load_response(tmp_path / "h.mat")
    np.testing.assert_array_equal(read.matrix, values)
    np.testing.assert_array_equal(read.frequency, FREQUENCY)
    assert read.form == "accelerance"
    assert [port.label for port in read.outputs] == ["x", "y", "tilt"] and [
        port.label for port in read.inputs
    ] == ["f1", "f2"]
    np.testing.assert_array_equal(read.coherence, np.abs(values) / 10)


def test_a_response_of_plain_hdf5(tmp_path: Path, rng) -> None:
    """h5py's own order of dimensions, complex type and texts."""
    values = matrix(rng)
    with h5py.File(tmp_path / "h.h5", "w") as file:
        file["frequency_hz"], file["H"], file["form"] = FREQUENCY, values, "receptance"
        file["outputs"], file["inputs"] = ["x", "y", "z"], ["f", "g"]
    read = load_response(tmp_path / "h.h5")
    np.testing.assert_array_equal(read.matrix, values)
    assert read.form == "receptance" and [port.label for port in read.outputs] == ["x", "y", "z"]


def test_a_recording_is_no_response(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["x"], file["fs"] = np.arange(10.0), 100.0
    assert not is_response(tmp_path / "run.h5")
    with pytest.raises(DataError, match="lacks the variable frequency_hz"):
        read_frf_mat(tmp_path / "run.h5")


def test_a_damaged_file_is_refused(tmp_path: Path, rng) -> None:
    write_matlab(tmp_path / "h.mat", matrix(rng))
    whole = (tmp_path / "h.mat").read_bytes()
    (tmp_path / "h.mat").write_bytes(whole[: len(whole) // 2])
    assert not holds_response(tmp_path / "h.mat")
    with pytest.raises(DataError, match="is not a readable HDF5 file"):
        read_frf_mat(tmp_path / "h.mat")


def test_links_into_other_files_are_not_followed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["H"] = np.arange(4.0)
    with h5py.File(tmp_path / "h.h5", "w") as file:
        file["H"] = h5py.ExternalLink("other.h5", "H")
        file["kept"] = np.arange(3.0)
    assert list(load_hdf5_variables(tmp_path / "h.h5", ["H", "kept", "gone"])) == ["kept"]

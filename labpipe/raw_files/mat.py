"""MATLAB files of versions 4 to 7.3, and HDF5 files, as tables of channels; and frequency responses read
and, as recordings, written as MATLAB files (version 7).
"""

from __future__ import annotations

import math
import re
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy
from scipy.io.matlab import MatlabOpaque

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.quantities import may_agree
from labpipe.raw_files.arrays_table import ArraysTable, columns_of, distinct, is_numeric, rate_of
from labpipe.raw_files.simcenter import labels_and_units, signals_of
from labpipe.raw_files.table import check_in_child
from labpipe.raw_files.text_table import check_filled, reading
from labpipe.records.recording import Recording
from labpipe.records.response import FORMS, FrequencyResponse, Port

# Elements of an HDF5 file read at once.
PART = 1 << 20
# Variables of a response.
_OPTIONAL = ("covariance", "coherence")
_MARKS = ("frequency_hz", "H", "form")
_PORTS = tuple(f"{side}{part}" for side in ("output", "input") for part in ("s", "_dofs", "_angles_rad"))
_KNOWN = (*_MARKS, *_PORTS, *_OPTIONAL, "covariance_dof", "unit")


def check_hdf5(path: Path) -> None:
    """DataError for a file that a child process cannot read whole within its limits of time and memory."""
    check_in_child(path, "HDF5", touch)


def touch(path: Path) -> None:
    """Read all attributes and datasets of a file."""
    with h5py.File(path, "r") as file:
        dict(file.attrs.items())
        file.visititems(_touch)


def _touch(_: str, item: object) -> None:
    dict(item.attrs.items())  # type: ignore[attr-defined]
    if isinstance(item, h5py.Dataset) and item.shape and h5py.check_ref_dtype(item.dtype) is None:
        rows = max(1, PART * item.shape[0] // max(item.size, 1))
        for start in range(0, item.shape[0] if item.size else 0, rows):
            item[start : start + rows]


def load_hdf5_variables(path: Path, names: Iterable[str]) -> dict[str, Any]:
    """The variables of these names, arrays in MATLAB's order of dimensions, texts as arrays of str. Links
    into other files are not followed. DataError for a damaged file.
    """
    check_hdf5(path)
    with reading(path, "HDF5 file"), h5py.File(path, "r") as file:
        hard = [n for n in names if isinstance(file.get(n, getlink=True), h5py.HardLink)]
        return {name: _value(file, file[name]) for name in hard if isinstance(file[name], h5py.Dataset)}


def hdf5_names(path: Path) -> tuple[str, ...]:
    """The data sets of an HDF5 file, "group/name"; DataError when the file is damaged."""
    check_hdf5(path)
    with reading(path, "HDF5 file"), h5py.File(path, "r") as file:
        return tuple(name for name in _data_sets(file) if name[0] != "#")


def _data_sets(file: h5py.File) -> dict[str, h5py.Dataset]:
    found: dict[str, Any] = {}
    file.visititems(found.__setitem__)
    return {name: item for name, item in found.items() if isinstance(item, h5py.Dataset)}


# What a data set states of packed numbers by the CF conventions of NetCDF, and what holds without.
PACKED = {"scale_factor": 1.0, "add_offset": 0.0, "_FillValue": math.nan}


class Scaled:
    """A data set of packed numbers: scale_factor times each plus add_offset, NaN at _FillValue."""

    def __init__(self, item: h5py.Dataset) -> None:
        self._item, self.attrs, self.shape, self.size = item, item.attrs, item.shape, item.size
        self.dtype = np.dtype(np.float64)
        numbers = [np.asarray(item.attrs.get(name, otherwise)) for name, otherwise in PACKED.items()]
        for name, number in zip(PACKED, numbers, strict=True):
            if number.size != 1 or number.dtype.kind not in "iuf":
                raise ValueError(f"{name} of {item.name} is not a number")
        self._scale, self._offset, self._fill = (float(number.item()) for number in numbers)

    def __getitem__(self, where: Any) -> FloatArray:
        stored = np.asarray(self._item[where], np.float64)
        return np.where(stored == self._fill, np.nan, stored * self._scale + self._offset)


def _unpack(item: h5py.Dataset) -> Any:
    return Scaled(item) if item.dtype.kind in "iuf" and not PACKED.keys().isdisjoint(item.attrs) else item


def _value(file: h5py.File, item: h5py.Dataset) -> Any:
    kind = item.attrs.get("MATLAB_class", b"")
    raw = _unpack(item)[()]
    if kind == b"char":
        return np.array("".join(map(chr, np.asarray(raw).T.ravel())))
    if h5py.check_ref_dtype(item.dtype) is not None:
        return np.array([_value(file, file[reference]) for reference in np.asarray(raw).T.ravel()], object)
    if h5py.check_string_dtype(item.dtype) is not None:
        return np.asarray(item.asstr()[()], object) if item.shape else np.array(item.asstr()[()])
    values = np.asarray(raw)
    if values.dtype.names == ("real", "imag"):
        values = values["real"] + 1j * values["imag"]
    return values.T if kind else values


# MATLAB files of versions 4 to 7, and of 7.3 as HDF5; no content is executed or unpickled.

_HDF5 = b"\x89HDF\r\n\x1a\n"


def is_hdf5(path: Path) -> bool:
    """True for HDF5, as written by MATLAB 7.3 after a block of 512 bytes."""
    with path.open("rb") as stream:
        head = stream.read(520)
    return head.startswith(_HDF5) or head[512:] == _HDF5


def load_variables(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file up to version 7; DataError for an unreadable file: some damaged ones
    crash scipy's reader, so that a child process reads it first.
    """
    check_filled(path)
    check_in_child(path, "MATLAB", load_all)
    with reading(path, "MATLAB file"):
        return {name: value for name, value in load_all(path).items() if not name.startswith("__")}


def load_all(path: Path) -> dict[str, Any]:
    """What scipy reads of a MATLAB file, notes on it among the variables."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        variables: dict[str, Any] = scipy.io.loadmat(str(path), chars_as_strings=True, appendmat=False)
    return variables


def _fields(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """(name, array) of a variable, of the fields of a structure ("run.x"), or of each structure of an array
    or of cells ("meas.Y(2).Data", "sweep.sample{1}.realz", as in MATLAB).
    """
    is_array = isinstance(value, np.ndarray) and not isinstance(value, MatlabOpaque)
    names = value.dtype.names if is_array else None
    boxed = []
    if is_array and value.dtype.kind == "O":
        boxed = [(number, item) for number, item in enumerate(value.flat, 1) if hasattr(item, "dtype")]
    if names:
        for number, element in enumerate(value.flat, 1):
            place = name if value.size == 1 else f"{name}({number})"
            for field in names:
                yield from _fields(f"{place}.{field}", element[field])
    elif any(item.dtype.names or item.dtype.kind == "O" for _, item in boxed):
        for number, item in boxed:
            yield from _fields(f"{name}{{{number}}}", item)
    else:
        yield name, value


# The fields in which programs keep the samples of a channel beside its name and unit (dSPACE:
# meas.Y(k).Data).
_SAMPLES, _NAMES, _UNIT_FIELDS = ("data", "values", "y"), ("name", "label"), ("unit", "units")


def _named_channels(arrays: dict[str, Any]) -> tuple[dict[str, str], dict[str, str]]:
    """Of arrays in a structure with a name or a unit: key -> the column's name, where no two share it; key ->
    unit.
    """
    lower = {key.lower(): key for key in arrays}
    names: dict[str, str] = {}
    units: dict[str, str] = {}
    for key in arrays:
        place, _, field = key.rpartition(".")
        if not place or field.lower() not in _SAMPLES:
            continue
        for fields, texts in ((_NAMES, names), (_UNIT_FIELDS, units)):
            beside = (f"{place.lower()}.{part}" for part in fields)
            stated = (text_of(arrays[lower[name]]).strip() for name in beside if name in lower)
            text = next((text.strip('"') for text in stated if text), "")
            if text and text != "-":
                texts[key] = text
    counts = Counter(names.values())
    return {key: name for key, name in names.items() if counts[name] == 1 and name not in arrays}, units


def load_fields(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file up to version 7, and the fields of its structures as "run.x". DataError
    as `load_variables`.
    """
    return dict(entry for name, value in load_variables(path).items() for entry in _fields(name, value))


def mat_table(path: Path) -> ArraysTable:
    """The vectors of a MATLAB file as a table. A structure ``units`` with one text per vector gives their
    units.
    """
    if is_hdf5(path):
        return hdf5_table(path)
    arrays = load_fields(path)
    named, stated = _named_channels(arrays)
    units = {
        name.removeprefix("units."): text_of(value)
        for name, value in arrays.items()
        if name.startswith("units.")
    }
    units |= {named.get(key, key): unit for key, unit in stated.items()}
    numeric = {named.get(name, name): value for name, value in arrays.items() if is_numeric(value)}
    parts = {key: columns_of(key, value) for key, value in numeric.items()}
    scalars = {name: float(value.item()) for name, value in numeric.items() if value.size == 1}
    signals = [part for part in signals_of(arrays) if part.axis == "s" and part.values in parts]
    labels, of_signals = labels_and_units(signals, parts)
    columns = distinct(
        ((labels.get(name, name), column) for part in parts.values() for name, column in part.items()), path
    )
    units |= {labels.get(name, name): unit for name, unit in of_signals.items()}
    rate = rate_of(scalars | {f"{part.place}.dt": part.step for part in signals}, path, units)
    texts = {name: lines for name, value in arrays.items() if (lines := lines_of(value))}
    return ArraysTable(path, columns, units, rate, texts)


def lines_of(value: Any) -> list[str]:
    """The texts of a char variable, of its rows, or of a cell array of texts; [] for anything else."""
    array = np.asarray(value)
    if array.dtype.kind == "U":
        return [str(text).strip() for text in array.flat]
    if array.dtype.kind != "O" or not array.size:
        return []
    cells = [np.asarray(cell) for cell in array.flat]
    if any(cell.dtype.kind != "U" or cell.size > 1 for cell in cells):
        return []
    return [text_of(cell).strip() for cell in cells]


def text_of(value: Any) -> str:
    """A char variable as text, '' for anything else."""
    array = np.asarray(value)
    return str(array.flat[0]) if array.dtype.kind == "U" and array.size == 1 else ""


_UNITS, _SENSITIVITIES = ("unit", "units", "unit_string", "y_unit"), ("sensitivity",)
# Longest list of texts that may describe channels.
MOST_TEXTS = 10_000


def hdf5_table(path: Path) -> ArraysTable:
    """The data sets of an HDF5 file by name ("group/name"); units and rates also from attributes. DataError
    when it is damaged. Links into other files are not followed.
    """
    check_hdf5(path)
    with reading(path, "HDF5 file"):
        file = h5py.File(path, "r")
        sets = _numeric_sets(file)
        scalars = {name: float(np.asarray(item[()]).item()) for name, item in sets.items() if item.size == 1}
        scalars |= _rate_attributes(file, sets)
    vectors = {key: item for key, item in sets.items() if item.size > 1}
    columns = distinct(
        (pair for key, item in vectors.items() for pair in columns_of(key, item).items()), path
    )
    units = {name: unit for name in columns if (unit := _attribute(sets, name, _UNITS))}
    rate = rate_of(scalars, path, {name: _attribute(sets, name, _UNITS) for name in scalars})
    table = ArraysTable(path, columns, units, rate, _hdf5_texts(file))
    stated = {name: _attribute(sets, name, _SENSITIVITIES) for name in table.columns}
    table.sensitivities |= {name: text for name, text in stated.items() if text}
    return table


def _hdf5_texts(file: h5py.File) -> dict[str, list[str]]:
    texts = {name: item for name, item in _data_sets(file).items() if h5py.check_string_dtype(item.dtype)}
    return {name: _decode(item[()]) for name, item in texts.items() if item.size < MOST_TEXTS}


def _decode(values: Any) -> list[str]:
    return [
        part.decode("utf-8", "replace") if isinstance(part, bytes) else str(part)
        for part in np.atleast_1d(values).ravel()
    ]


def _numeric_sets(file: h5py.File) -> dict[str, Any]:
    sets: dict[str, Any] = {}
    for name, item in _data_sets(file).items():
        is_text = item.attrs.get("MATLAB_class", b"") in (b"char", b"cell")
        # Of an object there are only numbers that say where it lies.
        if name[0] == "#" or is_text or "MATLAB_object_decode" in item.attrs:
            continue
        if item.dtype.kind in "iuf" if item.shape == () else item.shape and is_numeric(item):
            sets[name] = _unpack(item)
    return sets


def _rate_attributes(file: h5py.File, sets: dict[str, Any]) -> dict[str, float]:
    rates: dict[str, float] = {}
    for place, item in {"": file, **sets}.items():
        for name, value in item.attrs.items():
            if np.size(value) == 1 and np.asarray(value).dtype.kind in "iuf":
                rates[f"{place}/{name}"] = float(np.asarray(value).item())
    return rates


def _attribute(sets: dict[str, Any], name: str, keys: tuple[str, ...]) -> str:
    """What an attribute of a column's data set says; of several texts that of the column in its matrix."""
    base, _, number = name.rpartition("_")
    item = sets.get(name, sets.get(base))
    attributes = {} if item is None else {key.lower(): value for key, value in item.attrs.items()}
    texts = next((_decode(attributes[key]) for key in keys if key in attributes), [])
    place = int(number) - 1 if len(texts) > 1 and name not in sets else 0
    return texts[place] if len(texts) == 1 or (name not in sets and place < len(texts)) else ""


def write_frf_mat(path: Path, response: FrequencyResponse) -> None:
    """Write ``frequency_hz``, ``H`` (frequency, output, input), ``form``, ``unit``, cells of dofs, and
    covariance, coherence.
    """
    variables: dict[str, Any] = {
        "frequency_hz": response.frequency[:, None],
        "H": response.matrix,
        "form": response.form,
        "unit": FORMS[response.form],
        "covariance_dof": response.covariance_dof,
    }
    for side, ports in (("output", response.outputs), ("input", response.inputs)):
        variables[f"{side}s"] = np.array([port.label for port in ports], object)
        variables[f"{side}_dofs"] = np.array([port.dof for port in ports], object)
        angles = [math.nan if port.angle is None else port.angle for port in ports]
        variables[f"{side}_angles_rad"] = np.array(angles)
    variables |= {name: values for name in _OPTIONAL if (values := getattr(response, name)) is not None}
    scipy.io.savemat(path, variables, do_compression=True, appendmat=False)


def holds_response(path: Path) -> bool:
    """True if a readable MATLAB or HDF5 file holds a response."""
    if not is_hdf5(path):
        return set(_MARKS) <= load_variables(path).keys()
    check_hdf5(path)
    try:
        with h5py.File(path, "r") as file:
            return all(isinstance(file.get(name), h5py.Dataset) for name in _MARKS)
    except (OSError, RuntimeError, KeyError):
        return False


def read_frf_mat(path: Path, name: str = "") -> FrequencyResponse:
    """The response of a file written by `write_frf_mat`. DataError names a missing variable or one of wrong
    size.
    """
    variables = load_hdf5_variables(path, _KNOWN) if is_hdf5(path) else load_variables(path)
    needed = ("frequency_hz", "H", "form", "outputs", "inputs")
    missing = [key for key in needed if key not in variables]
    if missing:
        hint = "frequency_hz, H (frequency, output, input), form, outputs and inputs make a response"
        raise DataError(f"lacks the variable {', '.join(missing)}", path, hint)
    form, unit = (text_of(variables.get(key, "")) for key in ("form", "unit"))
    if unit and form in FORMS and not may_agree(unit, FORMS[form]):
        what = f"H is in {unit} by the variable unit, a {form} in {FORMS[form]} is needed"
        raise DataError(what, path, "describe it in the entry: {file: FILE, variables: {...}, unit: ...}")
    outputs, inputs = (_ports(variables, side, path) for side in ("output", "input"))
    frequency = _numbers(variables, "frequency_hz", path).ravel()
    shape = (frequency.size, len(outputs), len(inputs))
    n = shape[1] * shape[2]
    sizes = {"covariance": (shape[0], n, n), "coherence": shape}
    # MATLAB drops trailing dimensions of 1.
    optional = {key: _shape(variables, key, sizes[key], path) for key in _OPTIONAL if key in variables}
    optional["covariance_dof"] = float(np.asarray(variables.get("covariance_dof", math.inf)).item())
    matrix = _shape(variables, "H", shape, path)
    return FrequencyResponse(frequency, matrix, outputs, inputs, form=form, **optional, name=name)


def _numbers(variables: dict[str, Any], key: str, path: Path) -> Any:
    values = np.asarray(variables[key])
    if values.dtype.kind not in "iufc" or values.size == 0:
        raise DataError(f"the variable {key} holds no numbers", path)
    return values


def _shape(variables: dict[str, Any], key: str, shape: tuple[int, ...], path: Path) -> Any:
    values = _numbers(variables, key, path)
    if values.shape != shape[: values.ndim] or values.size != math.prod(shape):
        raise DataError(f"the variable {key} has the size {values.shape}, {shape} is required", path)
    return values.reshape(shape)


def _ports(variables: dict[str, Any], side: str, path: Path) -> tuple[Port, ...]:
    labels = lines_of(variables[f"{side}s"])
    dofs = lines_of(variables.get(f"{side}_dofs", variables[f"{side}s"]))
    angles = np.asarray(variables.get(f"{side}_angles_rad", np.full(len(labels), np.nan)), float).ravel()
    if not labels or not len(labels) == len(dofs) == angles.size:
        raise DataError(f"{side}s, {side}_dofs and {side}_angles_rad differ in length", path)
    ports = zip(labels, dofs, angles, strict=True)
    return tuple(
        Port(label, label, dof, None if math.isnan(angle) else float(angle)) for label, dof, angle in ports
    )


def write_recording_mat(path: Path, recording: Recording) -> None:
    """Write a column vector per channel [SI], ``fs`` [Hz] and a structure ``units``, under MATLAB's names."""
    names = [re.sub(r"\W", "_", channel.name, flags=re.ASCII) for channel in recording.channels]
    names = [name if name[:1].isalpha() else f"x{name}" for name in names]
    if len({*names, "fs", "units"}) < len(names) + 2:
        what = "two channels have the same name in MATLAB"
        raise DataError(what, recording.name, "fs and units are reserved")
    variables: dict[str, Any] = {name: recording.samples[:, n : n + 1] for n, name in enumerate(names)}
    units = {name: channel.unit for name, channel in zip(names, recording.channels, strict=True)}
    variables |= {"fs": recording.sample_rate, "units": units}
    scipy.io.savemat(path, variables, do_compression=True, long_field_names=True, appendmat=False)

"""Frequency responses and recordings as MATLAB files (version 7), and reading of responses."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from labpipe.errors import DataError
from labpipe.raw_files import mat_table
from labpipe.records.recording import Recording
from labpipe.records.response import FORMS, FrequencyResponse, Port

_OPTIONAL = ("covariance", "coherence")
_MARKS = ("frequency_hz", "H", "form")
_PORTS = tuple(f"{side}{part}" for side in ("output", "input") for part in ("s", "_dofs", "_angles_rad"))
_KNOWN = (*_MARKS, *_PORTS, *_OPTIONAL, "covariance_dof")


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
        **_port_variables("output", response.outputs),
        **_port_variables("input", response.inputs),
    }
    variables |= {name: values for name in _OPTIONAL if (values := getattr(response, name)) is not None}
    scipy.io.savemat(path, variables, do_compression=True, appendmat=False)


def _port_variables(side: str, ports: tuple[Port, ...]) -> dict[str, Any]:
    angles = np.array([math.nan if port.angle is None else port.angle for port in ports])
    return {
        f"{side}s": np.array([port.label for port in ports], object),
        f"{side}_dofs": np.array([port.dof for port in ports], object),
        f"{side}_angles_rad": angles,
    }


def holds_response(path: Path) -> bool:
    """True if a readable MATLAB or HDF5 file holds a response."""
    if mat_table.is_hdf5(path):
        return mat_table.has_hdf5_variables(path, _MARKS)
    return set(_MARKS) <= mat_table.load_variables(path).keys()


def read_frf_mat(path: Path, name: str = "") -> FrequencyResponse:
    """The response of a file written by `write_frf_mat`.

    DataError names a missing variable or one of wrong size.
    """
    variables = (
        mat_table.load_hdf5_variables(path, _KNOWN)
        if mat_table.is_hdf5(path)
        else mat_table.load_variables(path)
    )
    needed = ("frequency_hz", "H", "form", "outputs", "inputs")
    missing = [key for key in needed if key not in variables]
    if missing:
        hint = "frequency_hz, H (frequency, output, input), form, outputs and inputs make a response"
        raise DataError(f"lacks the variable {', '.join(missing)}", path, hint)
    outputs, inputs = (_ports(variables, side, path) for side in ("output", "input"))
    frequency = _numbers(variables, "frequency_hz", path).ravel()
    shape = (frequency.size, len(outputs), len(inputs))
    n = shape[1] * shape[2]
    sizes = {"covariance": (shape[0], n, n), "coherence": shape}
    # MATLAB drops trailing dimensions of 1.
    optional = {key: _shape(variables, key, sizes[key], path) for key in _OPTIONAL if key in variables}
    optional["covariance_dof"] = float(np.asarray(variables.get("covariance_dof", math.inf)).item())
    matrix, form = _shape(variables, "H", shape, path), mat_table.text_of(variables["form"])
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
    labels = _texts(variables[f"{side}s"])
    dofs = _texts(variables.get(f"{side}_dofs", variables[f"{side}s"]))
    angles = np.asarray(variables.get(f"{side}_angles_rad", np.full(len(labels), np.nan)), float).ravel()
    if not labels or not len(labels) == len(dofs) == angles.size:
        raise DataError(f"{side}s, {side}_dofs and {side}_angles_rad differ in length", path)
    ports = zip(labels, dofs, angles, strict=True)
    return tuple(
        Port(label, label, dof, None if math.isnan(angle) else float(angle)) for label, dof, angle in ports
    )


def _texts(cells: Any) -> list[str]:
    """The texts of a cell array, or of the rows of a char array."""
    return [
        mat_table.text_of(np.array(cell) if isinstance(cell, str) else cell).strip()
        for cell in np.asarray(cells).ravel()
    ]


def write_recording_mat(path: Path, recording: Recording) -> None:
    """Write one column vector per channel [SI], ``fs`` [Hz] and a structure ``units``.

    Names become MATLAB's.
    """
    names = [re.sub(r"\W", "_", channel.name, flags=re.ASCII) for channel in recording.channels]
    names = [name if name[:1].isalpha() else f"x{name}" for name in names]
    if len({*names, "fs", "units"}) < len(names) + 2:
        raise DataError(
            "two channels have the same name in MATLAB", recording.name, "fs and units are reserved"
        )
    variables: dict[str, Any] = {name: recording.samples[:, n : n + 1] for n, name in enumerate(names)}
    units = {name: channel.unit for name, channel in zip(names, recording.channels, strict=True)}
    variables |= {"fs": recording.sample_rate, "units": units}
    scipy.io.savemat(path, variables, do_compression=True, long_field_names=True, appendmat=False)

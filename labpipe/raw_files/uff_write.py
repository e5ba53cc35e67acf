"""Responses, recordings and mode shapes as universal files."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.raw_files.uff import COHERENCE, FRF, TIME, UffPoint
from labpipe.raw_files.uff_read import AXES, FORMS, SI_UNITS
from labpipe.records.fit_details import Modes
from labpipe.records.identification import Fit
from labpipe.records.recording import Recording
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.rig import Geometry

UNITS = {"type": 164, "units_code": 1, "units_description": "SI", "temp_mode": 2, "length": 1.0, "force": 1.0}
UNITS |= {"temp": 1.0, "temp_offset": 0.0}
TILTS = ("bx", "by", "bz")
_KINDS = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13, "pressure": 15}
_FORCE = {"orddenom_spec_data_type": 13, "orddenom_axis_lab": "Force", "orddenom_axis_units_lab": "N"}
_SCALAR = UffPoint("", 0, 0)
_NAME_WIDTH, _LABEL_WIDTH, _TITLE_WIDTH = 10, 20, 80
# How far printed start and step may be from the frequencies, as part of the highest.
_EVEN = 1e-9
_STRUCTURAL, _COMPLEX_EIGENVALUE, _TRANSLATIONS, _DISPLACEMENT = 1, 3, 2, 8


def write_frf_uff(path: Path, response: FrequencyResponse, binary: bool = False) -> None:
    """Write the FRFs, and coherences if available, as `read_frf_uff` reads them; the format has no
    covariances. Frequencies that do not follow from a first one and a step have six digits as text, all of
    them as binary numbers.
    """
    kind = next((number for number, form in FORMS.items() if form == response.form), None)
    if kind is None:
        raise DataError(f"a response of the form '{response.form}' cannot be written as a universal file")
    points = _points([*response.outputs, *response.inputs])
    outputs, inputs = points[: len(response.outputs)], points[len(response.outputs) :]
    ordinate = {**_ordinate(kind, response.form, SI_UNITS[kind]), **_FORCE}
    sets = []
    for o, i in itertools.product(range(len(outputs)), range(len(inputs))):
        both = {
            FRF: (response.matrix, ordinate),
            COHERENCE: (response.coherence, _ordinate(0, "Coherence", "")),
        }
        for function, (values, axis) in both.items():
            if values is not None:
                ends = outputs[o], inputs[i]
                sets.append(
                    _function(response.name, function, ends, response.frequency, values[:, o, i], axis)
                )
    _write(path, sets, binary)


def write_recording_uff(path: Path, recording: Recording, binary: bool = False) -> None:
    """Write one time record per channel as `UffTable` reads it; a time step has six digits in the format."""
    time = np.arange(recording.n_sample) / recording.sample_rate
    points = _points(
        [Port(channel.name, channel.name, channel.dof, channel.angle) for channel in recording.channels]
    )
    sets = []
    for channel, point, samples in zip(recording.channels, points, recording.samples.T, strict=True):
        axis = _ordinate(_KINDS.get(channel.quantity, 0), channel.quantity, channel.unit)
        sets.append(_function(channel.name, TIME, (point, _SCALAR), time, samples, axis))
    _write(path, sets, binary)


def write_shapes_uff(path: Path, fits: Sequence[Fit]) -> None:
    """Write the modes of all *fits*; nodes are numbered as their points are named, or from 1 where names are
    no numbers. Records 55 are of translations: without a geometry, tilts of a body (bx, by, bz) are left out.
    Modal A and modal B = -lambda A scale the shapes to residues, phi phi^T / A (Allemang, Vibrations:
    Experimental Modal Analysis, University of Cincinnati 1999); they are 0 without a driving point.
    DataError where nothing else moves.
    """
    sets: list[dict[str, Any]] = []
    for fit in fits:
        modes = fit.detail(Modes)
        assert modes is not None
        moving = [n for n, dof in enumerate(modes.dofs) if modes.geometry or dof not in TILTS]
        if not moving:
            raise DataError(f"fit '{fit.name}' has tilts only", hint="records 55 are written of translations")
        dofs = [modes.dofs[n] for n in moving]
        geometry = modes.geometry or Geometry.of_dofs(dofs)
        labels = [int(name) if name.isdigit() else 0 for name in geometry.names]
        if min(labels) < 1 or len(set(labels)) < len(labels):
            labels = list(range(1, len(labels) + 1))
        sets += [] if sets else _structure(geometry, labels)
        motion = geometry.motion(dofs, modes.shapes[moving])
        modal_a = np.zeros(modes.frequency.size) if modes.modal_a is None else modes.modal_a
        for n, (frequency, ratio) in enumerate(zip(modes.frequency, modes.damping_ratio, strict=True)):
            w = 2 * np.pi * frequency
            pole = complex(-ratio * w, w * np.sqrt(max(1 - ratio**2, 0.0)))
            sets.append(
                {
                    "type": 55,
                    "id1": f"mode {n + 1}: {frequency:.6g} Hz, damping ratio {ratio:.4g}"[:_TITLE_WIDTH],
                    "id2": (f"fit {fit.name}" + (f", test {fit.test}" if fit.test else ""))[:_TITLE_WIDTH],
                    "model_type": _STRUCTURAL,
                    "analysis_type": _COMPLEX_EIGENVALUE,
                    "data_ch": _TRANSLATIONS,
                    "spec_data_type": _DISPLACEMENT,
                    "load_case": 1,
                    "mode_n": n + 1,
                    "eig": pole,
                    "modal_a": complex(modal_a[n]),
                    "modal_b": complex(-pole * modal_a[n]),
                    "node_nums": labels,
                    **{f"r{axis + 1}": motion[n][:, axis].astype(complex) for axis in range(3)},
                }
            )
    _write(path, sets)


def _structure(geometry: Geometry, labels: Sequence[int]) -> list[dict[str, Any]]:
    places = dict(zip("xyz", geometry.positions.T, strict=True))
    trace = [label for a, b in geometry.lines.tolist() for label in (0, labels[a], labels[b])]
    line = {"type": 82, "trace_num": 1, "id": "lines of the structure", "nodes": np.array(trace)}
    return [{"type": 15, "node_nums": labels, **places}, *([line] if trace else [])]


def _points(ports: Iterable[Port]) -> list[UffPoint]:
    all_ports = list(ports)
    places = list(dict.fromkeys(_place(port.dof)[0] for port in all_ports))
    points = {port: _point(port, places) for port in all_ports}
    for first, second in itertools.combinations(dict.fromkeys(all_ports), 2):
        if points[first] == points[second] and first.label != second.label:
            what = f"'{first.label}' and '{second.label}' have the same name in a universal file"
            raise DataError(what, hint="use ten letters at most")
    return [points[port] for port in all_ports]


def _place(dof: str) -> tuple[str, int]:
    """ "bearing2.y" -> ("bearing2", 2); a dof that is not an axis is a scalar, 0."""
    place, _, axis = dof.rpartition(".")
    return (place, AXES.index(axis)) if axis in AXES[1:4] else (dof, 0)


def _point(port: Port, places: list[str]) -> UffPoint:
    place, direction = _place(port.dof)
    name = port.dof if port.angle is not None and not direction else port.label
    name = name if len(name) <= _NAME_WIDTH or not direction else ""
    return UffPoint(name[:_NAME_WIDTH], places.index(place) + 1, direction)


def _ordinate(kind: int, label: str, unit: str) -> dict[str, Any]:
    names = {"ordinate_axis_lab": label, "ordinate_axis_units_lab": unit}
    return {
        "ordinate_spec_data_type": kind,
        **{key: (text or "NONE")[:_LABEL_WIDTH] for key, text in names.items()},
    }


def _function(
    title: str,
    function: int,
    ends: tuple[UffPoint, UffPoint],
    abscissa: FloatArray,
    values: NDArray[Any],
    axes: dict[str, Any],
) -> dict[str, Any]:
    (response, reference), time = ends, function == TIME
    return {
        "type": 58,
        "id1": (title or "NONE")[:_TITLE_WIDTH],
        "func_type": function,
        "rsp_ent_name": response.name or "NONE",
        "rsp_node": response.node,
        "rsp_dir": response.direction,
        "ref_ent_name": reference.name or "NONE",
        "ref_node": reference.node,
        "ref_dir": reference.direction,
        "abscissa_spacing": int(time or abscissa.size < 2 or _is_even_as_printed(abscissa)),
        "abscissa_spec_data_type": 17 if time else 18,
        "abscissa_axis_lab": "Time" if time else "Frequency",
        "abscissa_axis_units_lab": "s" if time else "Hz",
        # pyuff takes the step from the first two, of which a single value has one.
        "x": abscissa if abscissa.size > 1 else np.append(abscissa, abscissa + 1),
        "data": values,
        "orddenom_spec_data_type": 0,
        **axes,
    }


def _is_even_as_printed(abscissa: FloatArray) -> bool:
    first, step = (float(f"{value:.5e}") for value in (abscissa[0], abscissa[1] - abscissa[0]))
    off = np.max(np.abs(first + step * np.arange(abscissa.size) - abscissa))
    return bool(off <= _EVEN * np.max(np.abs(abscissa)))


def _write(path: Path, sets: Sequence[dict[str, Any]], binary: bool = False) -> None:
    """The units and all *sets* in a new file, each written alone: pyuff reads all again after every set."""
    import pyuff

    with TemporaryDirectory() as folder, path.open("wb") as target, warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        part = Path(folder) / "part.uff"
        for entry in (UNITS, *sets):
            try:
                pyuff.UFF(str(part)).write_sets({**entry, "binary": int(binary)}, "add")
            except Exception as error:
                raise DataError(f"pyuff cannot write the universal file ({error})", path) from None
            target.write(part.read_bytes())
            part.unlink()

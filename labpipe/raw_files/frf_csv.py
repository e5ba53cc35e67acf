"""Frequency responses as CSV: ``frequency_hz``, then ``o/i:re``, ``o/i:im`` and, if available, ``o/i:var``,
``o/i:coh``.
"""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.writing import cell
from labpipe.errors import DataError
from labpipe.quantities import UnitError, parse_value
from labpipe.raw_files.table import check_columns
from labpipe.raw_files.text_table import CsvTable, open_unpacked
from labpipe.records.response import FORMS, FrequencyResponse, Port, uncorrelated
from labpipe.records.rig import AXIS_ANGLES
from labpipe.registry import nearest

_COLUMN = re.compile(r"^(?P<output>[^/]+)/(?P<input>[^:]+):(?P<part>re|im|var|coh)$")
FREQUENCY = "frequency_hz"


def read_frf_csv(path: Path, name: str = "") -> FrequencyResponse:
    """The response of an FRF table in SI units; DataError names missing columns.

    A variance per element becomes a covariance without correlation between the elements.
    """
    table = CsvTable(path)
    check_columns(table, [FREQUENCY])
    pairs = [match for column in table.columns if (match := _COLUMN.match(column))]
    if not pairs:
        raise DataError(
            "no columns 'output/input:re' and 'output/input:im'", path, "for example 'x/f:re', 'x/f:im'"
        )
    outputs = tuple(dict.fromkeys(match["output"] for match in pairs))
    inputs = tuple(dict.fromkeys(match["input"] for match in pairs))
    required = [f"{o}/{i}:{part}" for o in outputs for i in inputs for part in ("re", "im")]
    check_columns(table, required)
    columns = dict(zip(table.columns, np.concatenate(list(table.chunks(table.columns))).T, strict=True))
    real, imaginary = (_cube(columns, outputs, inputs, part) for part in ("re", "im"))
    variance, coherence = (_optional_cube(columns, outputs, inputs, part) for part in ("var", "coh"))
    return FrequencyResponse(
        frequency=columns[FREQUENCY],
        matrix=real + 1j * imaginary,
        outputs=tuple(port_of(label) for label in outputs),
        inputs=tuple(port_of(label) for label in inputs),
        form=_form(path),
        covariance=None if variance is None else uncorrelated(variance),
        coherence=coherence,
        name=name,
    )


def port_of(label: str) -> Port:
    """The port of a dof label; x, y and angles such as "45 deg" have a direction."""
    try:
        angle = parse_value(label, "rad") if label not in AXIS_ANGLES else AXIS_ANGLES[label]
    except UnitError:
        return Port(label, label, label)
    return Port(label, label, label, angle if " " in label or label in AXIS_ANGLES else None)


def _form(path: Path) -> str:
    """The form named in the comment lines above the table; receptance by default."""
    with (
        open_unpacked(path) as stream,
        io.TextIOWrapper(stream, encoding="utf-8-sig", errors="replace") as lines,
    ):
        for line in lines:
            if not line.startswith("#"):
                break
            match = re.match(r"#\s*form:\s*(\S+)", line)
            if match and match[1] not in FORMS:
                raise DataError(f"unknown form '{match[1]}'", f"{path}:1", nearest(match[1], FORMS))
            if match:
                return match[1]
    return "receptance"


def _cube(
    columns: dict[str, FloatArray], outputs: tuple[str, ...], inputs: tuple[str, ...], part: str
) -> FloatArray:
    return np.stack([np.stack([columns[f"{o}/{i}:{part}"] for i in inputs], -1) for o in outputs], 1)


def _optional_cube(
    columns: dict[str, FloatArray], outputs: tuple[str, ...], inputs: tuple[str, ...], part: str
) -> FloatArray | None:
    """The cube where every element has the column, else None."""
    complete = all(f"{o}/{i}:{part}" in columns for o in outputs for i in inputs)
    return _cube(columns, outputs, inputs, part) if complete else None


def write_frf_csv(path: Path, response: FrequencyResponse) -> None:
    """Write the response as `read_frf_csv` reads it."""
    columns = {FREQUENCY: response.frequency}
    variance = response.variance
    for o, output in enumerate(response.outputs):
        for i, port in enumerate(response.inputs):
            pair = f"{output.label}/{port.label}"
            columns[f"{pair}:re"] = response.matrix[:, o, i].real
            columns[f"{pair}:im"] = response.matrix[:, o, i].imag
            if variance is not None:
                columns[f"{pair}:var"] = variance[:, o, i]
            if response.coherence is not None:
                columns[f"{pair}:coh"] = response.coherence[:, o, i]
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(f"# form: {response.form}\n{','.join(str(cell(name)) for name in columns)}\n")
        np.savetxt(stream, np.stack(list(columns.values()), 1), "%.17g", delimiter=",")

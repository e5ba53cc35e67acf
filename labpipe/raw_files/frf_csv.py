"""Frequency responses as CSV: ``frequency_hz``, then ``o/i:re``, ``o/i:im`` and, if available, ``o/i:var``,
``o/i:coh``; in comments above the form, and the dof of a response or force that is not called by it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.artefacts.writing import cell
from labpipe.errors import DataError
from labpipe.quantities import UnitError, may_agree, parse_value
from labpipe.raw_files.table import check_columns
from labpipe.raw_files.text_table import CsvTable, open_text
from labpipe.records.response import FORMS, FrequencyResponse, Port, diagonal_covariance
from labpipe.records.rig import AXIS_ANGLES
from labpipe.registry import nearest

_COLUMN = re.compile(r"^(?P<output>[^/]+)/(?P<input>.+):(?P<part>re|im|var|coh)$")
FREQUENCY = "frequency_hz"
# Coherence with what single precision and few printed digits add to 1.
HIGHEST = 1.001


def read_frf_csv(path: Path, name: str = "") -> FrequencyResponse:
    """The response of an FRF table in SI units; DataError names missing columns. A variance per element
    becomes a covariance without correlation between the elements.
    """
    table = CsvTable(path)
    check_columns(table, [FREQUENCY])
    pairs = [match for column in table.columns if (match := _COLUMN.match(column))]
    if not pairs:
        what = "no columns 'output/input:re' and 'output/input:im'"
        raise DataError(what, path, "for example 'x/f:re', 'x/f:im'")
    outputs = tuple(dict.fromkeys(match["output"] for match in pairs))
    inputs = tuple(dict.fromkeys(match["input"] for match in pairs))
    form, dofs = _notes(path)
    _check_units(table, form)
    required = [f"{o}/{i}:{part}" for o in outputs for i in inputs for part in ("re", "im")]
    check_columns(table, [*required, *(match[0] for match in pairs)])
    columns = dict(zip(table.columns, np.concatenate(list(table.chunks(table.columns))).T, strict=True))

    def part(name: str) -> Any:
        """The cube where every element has the column, else None."""
        complete = all(f"{o}/{i}:{name}" in columns for o in outputs for i in inputs)
        return cube(outputs, inputs, lambda o, i: columns[f"{o}/{i}:{name}"]) if complete else None

    variance = part("var")
    if variance is not None and np.any(variance < 0):
        raise DataError(f"holds the negative variance {variance.min():g}", path)

    def ports(side: str, labels: Iterable[str]) -> tuple[Port, ...]:
        named = ((label, port_of(dofs.get((side, label), label))) for label in labels)
        return tuple(Port(label, label, port.dof, port.angle) for label, port in named)

    return FrequencyResponse(
        frequency=columns[FREQUENCY],
        matrix=part("re") + 1j * part("im"),
        outputs=ports("response", outputs),
        inputs=ports("force", inputs),
        form=form,
        covariance=None if variance is None else diagonal_covariance(variance),
        coherence=checked_coherence(part("coh"), path),
        name=name,
    )


def _check_units(table: CsvTable, form: str) -> None:
    for name, stated in table.units.items():
        column = _COLUMN.match(name)
        of_element = FORMS[form] if column and column["part"] in ("re", "im") and form != "other" else stated
        needed = "Hz" if name == FREQUENCY else of_element
        if not may_agree(stated, needed):
            what = f"column '{name}' is in {stated} by the file's own header, {needed} is needed"
            hint = "describe it in the entry: {file: FILE, columns: {...}, unit: ...}"
            raise DataError(what, table.path, hint)


def checked_coherence(values: Any, where: Path | str) -> Any:
    """Coherences [1] of any shape as they are, None without; DataError for one that is none."""
    if values is not None and np.any((beside := np.abs(values - 0.5)) > HIGHEST - 0.5):
        what = f"holds the coherence {values.flat[np.argmax(beside)]:g}"
        raise DataError(what, where, "they lie between 0 and 1, and are not in per cent")
    return values


def port_of(label: str) -> Port:
    """The port of a dof label; x, y and angles such as "45 deg" have a direction."""
    try:
        angle = parse_value(label, "rad") if label not in AXIS_ANGLES else AXIS_ANGLES[label]
    except UnitError:
        return Port(label, label, label)
    return Port(label, label, label, angle if " " in label or label in AXIS_ANGLES else None)


def _notes(path: Path) -> tuple[str, dict[tuple[str, str], str]]:
    """What the comment lines above the table say: the form, receptance by default, and the dofs of ports by
    their side and label.
    """
    form, dofs = "", dict[tuple[str, str], str]()
    with open_text(path, "utf-8-sig") as lines:
        for number, line in enumerate(lines, 1):
            comment = line.strip(' \r\n\t"')
            if comment and not comment.startswith("#"):
                break
            if match := re.match(r"#\s*form\s*[:=]\s*(\w+)", comment.lower()):
                form = form or match[1]
                if match[1] not in FORMS:
                    what = f"unknown form '{match[1]}'"
                    raise DataError(what, f"{path}:{number}", nearest(match[1], FORMS))
            elif match := re.match(r"#\s*(response|force) (.+) in (.+)", comment):
                dofs[match[1], match[2]] = match[3]
    return form or "receptance", dofs


def cube(outputs: Sequence[Any], inputs: Sequence[Any], values: Callable[[Any, Any], Any]) -> Any:
    """The *values* (n_line,) [any unit] of every pair of output and input as (n_line, n_output, n_input)."""
    return np.stack([np.stack([values(o, i) for i in inputs], -1) for o in outputs], 1)


def write_frf_csv(path: Path, response: FrequencyResponse) -> None:
    """Write the response as `read_frf_csv` reads it."""
    slashed = next((port.label for port in response.outputs if "/" in port.label), None)
    if slashed is not None:
        what = f"'{slashed}' cannot be a response in a table, where o/i is response per force"
        raise DataError(what, hint="--to mat, uff or parquet, or another dof in the rig file")
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
        stream.write(f"# form: {response.form}\n")
        for side, ports in (("response", response.outputs), ("force", response.inputs)):
            stream.writelines(f"# {side} {p.label} in {p.dof}\n" for p in ports if p.dof != p.label)
        stream.write(f"{','.join(str(cell(name)) for name in columns)}\n")
        np.savetxt(stream, np.stack(list(columns.values()), 1), "%.17g", delimiter=",")

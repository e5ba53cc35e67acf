"""``*.spectra.parquet``: the spectra of all channels of one test, a row per line, with their covariance."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.arrow_arrays import numpy_array
from labpipe.artefacts.header import Header
from labpipe.artefacts.parquet import as_written, read_header, read_table, write_columns
from labpipe.artefacts.typed_json import entry_of, record_of
from labpipe.records.channel_spectra import ChannelSpectra, UncertainFactor
from labpipe.records.recording import Channel

SUFFIX = ".spectra.parquet"


def write_spectra(path: Path, spectra: ChannelSpectra, header: Header) -> None:
    """Write the spectra: per run (numbered from 1) and channel real and imaginary part [SI], and the covariance of every run."""
    columns: dict[str, FloatArray] = {"frequency_hz": spectra.frequency}
    for run in range(len(spectra.runs)):
        for number, channel in enumerate(spectra.channels):
            columns |= _parts(f"{run + 1}/{channel.name}", spectra.vectors[:, run, number])
        for p, q in _upper(len(spectra.channels)):
            columns |= _parts(f"cov:{run + 1}:{p}:{q}", spectra.covariance[:, run, p, q])
    write_columns(path, columns, dataclasses.replace(header, contents=_contents(spectra), findings=spectra.findings))


def _parts(name: str, values: ComplexArray) -> dict[str, FloatArray]:
    return {f"{name}:re": values.real, f"{name}:im": values.imag}


def _upper(n: int) -> Iterator[tuple[int, int]]:
    return ((p, q) for p in range(n) for q in range(p, n))


def _contents(spectra: ChannelSpectra) -> dict[str, Any]:
    dof = spectra.covariance_dof
    return {
        "name": spectra.name,
        "channels": [{**dataclasses.asdict(channel), "unit": channel.unit} for channel in spectra.channels],
        "runs": list(spectra.runs),
        "covariance_dof": None if math.isinf(dof) else float(dof),
        "line_correlation": [[value.real, value.imag] for value in spectra.line_correlation],
        "factors": [{**vars(factor), "derivative": entry_of(factor.derivative)} for factor in spectra.factors],
        "conditions": spectra.conditions,
    }


def read_spectra(path: Path) -> ChannelSpectra:
    """The spectra of a ``*.spectra.parquet`` file; DataError when the file is not one."""
    header = read_header(path, "spectra")
    with as_written(path):
        return _spectra_of(header, path)


def _spectra_of(header: Header, path: Path) -> ChannelSpectra:
    contents = header.contents
    table = read_table(path)
    channels = tuple(Channel(**{key: value for key, value in entry.items() if key != "unit"}) for entry in contents["channels"])
    runs = tuple(contents["runs"])
    frequency = numpy_array(table.column("frequency_hz"))
    n = len(channels)
    vectors = np.empty((frequency.size, len(runs), n), np.complex128)
    covariance = np.empty((frequency.size, len(runs), n, n), np.complex128)
    for run in range(len(runs)):
        for number, channel in enumerate(channels):
            vectors[:, run, number] = _values(table, f"{run + 1}/{channel.name}")
        for p, q in _upper(n):
            covariance[:, run, p, q] = _values(table, f"cov:{run + 1}:{p}:{q}")
            covariance[:, run, q, p] = covariance[:, run, p, q].conj()
    dof = contents["covariance_dof"]
    return ChannelSpectra(
        frequency=frequency,
        vectors=vectors,
        covariance=covariance,
        channels=channels,
        runs=runs,
        covariance_dof=math.inf if dof is None else dof,
        line_correlation=tuple(complex(*value) for value in contents["line_correlation"]),
        factors=tuple(
            UncertainFactor(**{**entry, "derivative": record_of(entry["derivative"], ComplexArray)}) for entry in contents["factors"]
        ),
        name=contents["name"],
        findings=header.findings,
        conditions=contents["conditions"],
    )


def _values(table: pa.Table, name: str) -> ComplexArray:
    values = np.empty(table.num_rows, np.complex128)
    # A sum re + 1j im would lose the sign of a zero.
    values.real, values.imag = numpy_array(table.column(f"{name}:re")), numpy_array(table.column(f"{name}:im"))
    return values

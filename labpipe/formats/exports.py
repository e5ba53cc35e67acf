"""Artefacts as tables for other programs. WRITERS by name."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.parquet import open_parquet
from labpipe.artefacts.recording_file import SUFFIX as RECORDING_SUFFIX
from labpipe.artefacts.recording_file import open_recording
from labpipe.artefacts.response_file import read_response
from labpipe.errors import DataError
from labpipe.formats.frf_csv import write_frf_csv
from labpipe.formats.mat_frf import write_frf_mat, write_recording_mat
from labpipe.formats.uff_write import write_frf_uff, write_recording_uff
from labpipe.records.finding import WARNING, of_level
from labpipe.registry import Registry

WRITERS = Registry(
    "writer",
    {
        "csv": "labpipe.formats.exports:write_csv",
        "parquet": "labpipe.formats.exports:write_parquet",
        "uff": "labpipe.formats.exports:write_uff",
        "uff58b": "labpipe.formats.exports:write_uff58b",
        "mat": "labpipe.formats.exports:write_mat",
    },
)


def write_csv(artefact: Path, target: Path) -> None:
    """An FRF as the table labpipe reads again, a recording as one column per channel "name [unit]", a result as its parameters."""
    if artefact.suffix == ".json":
        parameter_table(artefact).to_csv(target, index=False)
    elif artefact.name.endswith(RECORDING_SUFFIX):
        recording_table(artefact).to_csv(target, index=False)
    else:
        write_frf_csv(target, read_response(artefact))


def write_parquet(artefact: Path, target: Path) -> None:
    """The same tables as Parquet, without labpipe's header."""
    if artefact.suffix == ".json":
        parameter_table(artefact).to_parquet(target, index=False)
    elif artefact.name.endswith(RECORDING_SUFFIX):
        recording_table(artefact).to_parquet(target, index=False)
    else:
        read_response(artefact)  # DataError for a file that is no response
        open_parquet(artefact).read().to_pandas().to_parquet(target, index=False)


def write_uff(artefact: Path, target: Path, binary: bool = False) -> None:
    """A recording or an FRF as a universal file, numbers as text."""
    if artefact.suffix == ".json":
        raise DataError("parameters cannot be written as a universal file", where=str(artefact), hint="known: csv, parquet")
    if artefact.name.endswith(RECORDING_SUFFIX):
        write_recording_uff(target, open_recording(artefact).in_memory(), binary)
    else:
        write_frf_uff(target, read_response(artefact), binary)


def write_uff58b(artefact: Path, target: Path) -> None:
    """The same with binary numbers."""
    write_uff(artefact, target, binary=True)


def write_mat(artefact: Path, target: Path) -> None:
    """A recording or an FRF as a MATLAB file."""
    if artefact.suffix == ".json":
        raise DataError("parameters cannot be written as a MATLAB file", where=str(artefact), hint="known: csv, parquet")
    if artefact.name.endswith(RECORDING_SUFFIX):
        write_recording_mat(target, open_recording(artefact).in_memory())
    else:
        write_frf_mat(target, read_response(artefact))


def recording_table(artefact: Path) -> pd.DataFrame:
    """Time in seconds and the channels in SI units."""
    recording = open_recording(artefact)
    record = recording.in_memory()
    names = [f"{channel.name} [{channel.unit}]" for channel in record.channels]
    table = pd.DataFrame(record.samples, columns=names)
    table.insert(0, "t [s]", [n / record.sample_rate for n in range(record.n_sample)])
    return table


def parameter_table(artefact: Path) -> pd.DataFrame:
    """One row per fit and parameter."""
    rows = [
        {
            "fit": fit.name,
            "test": fit.test,
            "centre_hz": fit.centre_hz,
            "parameter": parameter.name,
            "value": parameter.value,
            "unit": parameter.unit,
            "std_error": parameter.std_error,
            "ci95_low": parameter.ci95[0] if parameter.ci95 else None,
            "ci95_high": parameter.ci95[1] if parameter.ci95 else None,
            "warnings": " ".join(finding.code for finding in of_level(WARNING, fit.findings)),
        }
        for fit in read_identification(artefact).fits
        for parameter in fit.parameters
    ]
    return pd.DataFrame(rows)

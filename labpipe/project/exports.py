"""Artefacts as tables for other programs. WRITERS by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.measured_files import (
    DECAY_SUFFIX,
    SPECTRA_SUFFIX,
    read_decays,
    read_response,
    read_spectra,
)
from labpipe.artefacts.parquet import open_parquet
from labpipe.artefacts.recording_file import SUFFIX as RECORDING_SUFFIX
from labpipe.artefacts.recording_file import open_recording
from labpipe.errors import DataError
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.raw_files.mat_frf import write_frf_mat, write_recording_mat
from labpipe.raw_files.rows_csv import write_table_csv
from labpipe.raw_files.uff_write import write_frf_uff, write_recording_uff, write_shapes_uff
from labpipe.records.finding import WARNING, of_level
from labpipe.records.fit_details import Modes
from labpipe.records.identification import Fit
from labpipe.registry import Registry

WRITERS = Registry("writer")


def write_csv(artefact: Path, target: Path) -> None:
    """An FRF as the table labpipe reads again, recordings, decays, spectra as columns per channel "name
    [unit]", results as parameters.
    """
    if artefact.suffix == ".json":
        write_table_csv(parameter_table(artefact), target)
    elif artefact.name.endswith(DECAY_SUFFIX):
        write_table_csv(decay_table(artefact), target)
    elif artefact.name.endswith(SPECTRA_SUFFIX):
        write_table_csv(spectra_table(artefact), target)
    elif artefact.name.endswith(RECORDING_SUFFIX):
        write_table_csv(recording_table(artefact), target)
    else:
        write_frf_csv(target, read_response(artefact))


def write_parquet(artefact: Path, target: Path) -> None:
    """The same tables as Parquet, without labpipe's header."""
    if artefact.suffix == ".json":
        parameter_table(artefact).to_parquet(target, index=False)
    elif artefact.name.endswith(DECAY_SUFFIX):
        decay_table(artefact).to_parquet(target, index=False)
    elif artefact.name.endswith(SPECTRA_SUFFIX):
        spectra_table(artefact).to_parquet(target, index=False)
    elif artefact.name.endswith(RECORDING_SUFFIX):
        recording_table(artefact).to_parquet(target, index=False)
    else:
        read_response(artefact)  # DataError for a file that is no response
        open_parquet(artefact).read().to_pandas().to_parquet(target, index=False)


def write_uff(artefact: Path, target: Path, binary: bool = False) -> None:
    """A recording or an FRF as a universal file, numbers as text.

    Of a result its mode shapes (records 15, 82 and 55).
    """
    if artefact.suffix == ".json":
        write_shapes_uff(target, modal_fits(artefact))
        return
    _refuse_tables(artefact, "a universal file")
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
        raise DataError(
            "parameters cannot be written as a MATLAB file", where=str(artefact), hint="known: csv, parquet"
        )
    _refuse_tables(artefact, "a MATLAB file")
    if artefact.name.endswith(RECORDING_SUFFIX):
        write_recording_mat(target, open_recording(artefact).in_memory())
    else:
        write_frf_mat(target, read_response(artefact))


def write_shapes(artefact: Path, target: Path) -> None:
    """The mode shapes of a result as a table: one row per mode and point."""
    if artefact.suffix != ".json":
        raise DataError("holds no mode shapes", where=str(artefact), hint="they stand in identification.json")
    write_table_csv(shape_table(modal_fits(artefact)), target)


def modal_fits(artefact: Path) -> tuple[Fit, ...]:
    """The fits of a result that have modes; DataError where there is none."""
    fits = tuple(fit for fit in read_identification(artefact).fits if fit.detail(Modes) is not None)
    if not fits:
        raise DataError(
            "holds no mode shapes", where=str(artefact), hint="parameters are written as csv or parquet"
        )
    return fits


def shape_table(fits: Sequence[Fit]) -> pd.DataFrame:
    """One row per fit, mode and point: the complex shape with its standard error, and the place of the point
    where it is known.
    """
    rows = []
    for fit in fits:
        modes = fit.detail(Modes)
        assert modes is not None
        places = (
            modes.geometry.positions[[modes.geometry.place(dof)[0] for dof in modes.dofs]]
            if modes.geometry
            else None
        )
        for mode, (frequency, ratio) in enumerate(zip(modes.frequency, modes.damping_ratio, strict=True)):
            for n, point in enumerate(modes.points):
                place = dict(zip(("x_m", "y_m", "z_m"), places[n], strict=True)) if places is not None else {}
                value, error = modes.shapes[n, mode], modes.shape_std_errors[n, mode]
                shape = {
                    "point": point,
                    "dof": modes.dofs[n],
                    **place,
                    "real": value.real,
                    "imaginary": value.imag,
                    "std_error": error,
                }
                head = {
                    "fit": fit.name,
                    "test": fit.test,
                    "mode": mode + 1,
                    "frequency_hz": frequency,
                    "damping_ratio": ratio,
                }
                rows.append({**head, **shape})
    return pd.DataFrame(rows)


def recording_table(artefact: Path) -> pd.DataFrame:
    """Time in seconds and the channels in SI units."""
    recording = open_recording(artefact)
    record = recording.in_memory()
    names = [f"{channel.name} [{channel.unit}]" for channel in record.channels]
    table = pd.DataFrame(record.samples, columns=names)
    table.insert(0, "t [s]", [n / record.sample_rate for n in range(record.n_sample)])
    return table


def decay_table(artefact: Path) -> pd.DataFrame:
    """One row per sample: the number of the decay from 1, its recording, time in it in seconds, and the
    responses in SI units.
    """
    decays = read_decays(artefact)
    names = [f"{port.label} [{unit}]" for port, unit in zip(decays.outputs, decays.units, strict=True)]
    tables = []
    for number, decay in enumerate(decays.decays, 1):
        table = pd.DataFrame(decay.samples, columns=names)
        table.insert(0, "t [s]", [decay.start + n / decays.sample_rate for n in range(len(table))])
        table.insert(0, "recording", decay.recording)
        table.insert(0, "decay", number)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def _refuse_tables(artefact: Path, what: str) -> None:
    """DataError for spectra of all channels and for decays, of which there are tables only."""
    named = {SPECTRA_SUFFIX: "spectra of all channels", DECAY_SUFFIX: "free decays"}
    for suffix, name in named.items():
        if artefact.name.endswith(suffix):
            raise DataError(
                f"{name} cannot be written as {what}", where=str(artefact), hint="known: csv, parquet"
            )


def spectra_table(artefact: Path) -> pd.DataFrame:
    """One row per run and line: real part, imaginary part and standard deviation of every channel "name
    [unit]".
    """
    spectra = read_spectra(artefact)
    tables = []
    for number, run in enumerate(spectra.runs):
        table = pd.DataFrame({"run": run, "frequency_hz": spectra.frequency})
        for column, channel in enumerate(spectra.channels):
            values, variance = (
                spectra.vectors[:, number, column],
                spectra.covariance[:, number, column, column].real,
            )
            parts = (("re", values.real), ("im", values.imag), ("std", variance.clip(min=0) ** 0.5))
            for part, amounts in parts:
                table[f"{channel.name}:{part} [{channel.unit}]"] = amounts
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


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
            "std_error": parameter.full_error,
            "ci95_low": parameter.ci95[0] if parameter.ci95 else None,
            "ci95_high": parameter.ci95[1] if parameter.ci95 else None,
            "warnings": " ".join(finding.code for finding in of_level(WARNING, fit.findings)),
        }
        for fit in read_identification(artefact).fits
        for parameter in fit.parameters
    ]
    return pd.DataFrame(rows)

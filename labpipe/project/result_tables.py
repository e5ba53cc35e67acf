"""Results as tables for other programs: covariance of parameters, studies, plants for robust control
design.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from labpipe.arrays import FloatArray
from labpipe.artefacts.identification_file import read_identification
from labpipe.errors import DataError
from labpipe.raw_files.rows_csv import cell, write_table_csv
from labpipe.records.fit_details import RobustPlant
from labpipe.records.identification import Fit
from labpipe.records.study import Study
from labpipe.uncertainty.amounts import random_error

# The covariance of all parameters of a result, split by source, as a table for other programs.

NOISE = "noise"


def write_covariance_csv(artefact: Path, target: Path) -> None:
    """`covariance_table` as CSV."""
    write_table_csv(covariance_table(artefact), target)


def write_covariance_parquet(artefact: Path, target: Path) -> None:
    """`covariance_table` as Parquet."""
    covariance_table(artefact).to_parquet(target, index=False)


def covariance_table(artefact: Path) -> pd.DataFrame:
    """One row per test, fit, source and pair of parameters: covariance [product of the parameters' SI units].

    The sum over all sources is the covariance of the combined uncertainties. Sources of one name are one
    error in all fits: between two fits they add the product of `change`, that of a parameter by one standard
    uncertainty of the source. DataError for another artefact.
    """
    if artefact.suffix != ".json":
        raise DataError("holds no parameters", where=str(artefact), hint="they stand in identification.json")
    rows = [row for fit in read_identification(artefact).fits for row in _rows(fit)]
    if not rows:
        raise DataError("no parameter of it has an uncertainty", where=str(artefact))
    return pd.DataFrame(rows)


def _rows(fit: Fit) -> Iterator[dict[str, object]]:
    names = [parameter.name for parameter in fit.parameters]
    low, high = fit.band_hz
    head = {"test": fit.test, "fit": fit.name, "term": fit.term, "band_low_hz": low, "band_high_hz": high}
    for source, matrix, changes in _by_source(fit):
        for row, column in zip(*np.nonzero(np.triu(np.isfinite(matrix) & (matrix != 0))), strict=True):
            pair = {
                "parameter_1": names[row],
                "parameter_2": names[column],
                "covariance": matrix[row, column],
            }
            yield {**head, "source": source, **pair, "change_1": changes[row], "change_2": changes[column]}


def _by_source(fit: Fit) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Source, covariance (n, n) and change (n,) of all parameters by it [SI units].

    Noise has no change with a sign.
    """
    errors = np.array(
        [
            np.nan if (error := random_error(fit, parameter)) is None else error
            for parameter in fit.parameters
        ],
        np.float64,
    )
    correlation = np.eye(errors.size)
    n = min(fit.correlation.shape[0], errors.size)
    correlation[:n, :n] = fit.correlation[:n, :n]
    yield NOISE, correlation * np.outer(errors, errors), np.full(errors.size, np.nan)
    if fit.budget is not None:
        for source, changes in zip(fit.budget.sources, fit.budget.changes, strict=True):
            yield source.source, np.outer(changes, changes), changes


# A study as one table: a row for every parameter of every fit at every noise level.

HEADER = (
    "fit",
    "estimator",
    "noise",
    "lines",
    "repeats",
    "failed",
    "parameter",
    "unit",
    "truth",
    "mean",
    "rmse",
    "cramer_rao_bound",
    "mean_std_error",
    "coverage",
)


def write_study_csv(path: Path, study: Study) -> None:
    """Write the table; unknown values are left empty."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(HEADER)
        for case in study.cases:
            head = (case.fit, case.estimator, case.noise, case.lines, case.repeats, case.failed)
            for p in case.parameters:
                table.writerow(
                    (
                        *map(cell, head),
                        cell(p.name),
                        p.unit,
                        p.truth,
                        p.mean,
                        p.rmse,
                        p.bound,
                        p.std_error,
                        p.coverage,
                    )
                )


# Plants for robust control design as files: the band over frequency as CSV, nominal model and weight as a
# MATLAB file.


def write_band_csv(artefact: Path, target: Path) -> None:
    """One row per fit, line, output and input: nominal plant, radius of the band around it, weight and its
    overbound.
    """
    rows = []
    for fit in robust_fits(artefact):
        plant = fit.detail(RobustPlant)
        assert plant is not None
        for row, output in enumerate(plant.outputs):
            for column, input_name in enumerate(plant.inputs):
                gain, zero, pole = plant.overbound[row, column]
                bound = gain * np.abs((1 + 1j * plant.frequency / zero) / (1 + 1j * plant.frequency / pole))
                values = plant.nominal[:, row, column]
                part = {
                    "fit": fit.name,
                    "test": fit.test,
                    "output": output,
                    "input": input_name,
                    "unit": plant.unit,
                }
                lines = zip(
                    plant.frequency,
                    values,
                    plant.radius[:, row, column],
                    plant.weight[:, row, column],
                    bound,
                    strict=True,
                )
                for frequency, value, radius, weight, over in lines:
                    numbers = {
                        "re": value.real,
                        "im": value.imag,
                        "radius": radius,
                        "weight": weight,
                        "overbound": over,
                    }
                    rows.append(
                        {**part, "frequency_hz": frequency, **numbers, "confidence": plant.confidence}
                    )
    write_table_csv(pd.DataFrame(rows), target)


def write_plant_mat(artefact: Path, target: Path) -> None:
    """State space A, B, C, D of the only fit with a plant, its response, radius and weight, and the
    overbound's k, zero and pole [Hz].

    DataError for several such fits, of which a file holds one.
    """
    from scipy.io import savemat

    fits = robust_fits(artefact)
    if len(fits) > 1:
        named = ", ".join(f"{fit.name} {fit.test}".strip() for fit in fits)
        raise DataError(
            f"holds {len(fits)} plants ({named}), a MATLAB file holds one",
            where=str(artefact),
            hint="--to band writes all",
        )
    plant = fits[0].detail(RobustPlant)
    assert plant is not None
    savemat(
        target,
        {
            "A": plant.a,
            "B": plant.b,
            "C": plant.c,
            "D": plant.d,
            "frequency_hz": plant.frequency,
            "nominal": plant.nominal,
            "radius": plant.radius,
            "weight": plant.weight,
            "overbound": plant.overbound,
            "confidence": plant.confidence,
            "outputs": np.array(plant.outputs, object),
            "inputs": np.array(plant.inputs, object),
        },
    )


def robust_fits(artefact: Path) -> tuple[Fit, ...]:
    """The fits of a result that have a plant; DataError where there is none."""
    if artefact.suffix != ".json":
        raise DataError(
            "holds no plant",
            where=str(artefact),
            hint="plants stand in identification.json, of fits of the model magnet",
        )
    fits = tuple(fit for fit in read_identification(artefact).fits if fit.detail(RobustPlant) is not None)
    if not fits:
        raise DataError(
            "holds no plant", where=str(artefact), hint="model: magnet, with one run per axis at least"
        )
    return fits

"""The covariance of all parameters of a result, split by source, as a table for other programs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from labpipe.arrays import FloatArray
from labpipe.artefacts.identification_file import read_identification
from labpipe.campaign.common_sources import random_error
from labpipe.errors import DataError
from labpipe.formats.rows_csv import write_table_csv
from labpipe.records.identification import Fit

NOISE = "noise"


def write_covariance_csv(artefact: Path, target: Path) -> None:
    """`covariance_table` as CSV."""
    write_table_csv(covariance_table(artefact), target)


def write_covariance_parquet(artefact: Path, target: Path) -> None:
    """`covariance_table` as Parquet."""
    covariance_table(artefact).to_parquet(target, index=False)


def covariance_table(artefact: Path) -> pd.DataFrame:
    """One row per test, fit, source and pair of parameters: covariance [product of the parameters' SI units].

    The sum over all sources is the covariance of the combined uncertainties. Sources of one name are one error in all fits: between two
    fits they add the product of `change`, that of a parameter by one standard uncertainty of the source. DataError for another artefact.
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
            pair = {"parameter_1": names[row], "parameter_2": names[column], "covariance": matrix[row, column]}
            yield {**head, "source": source, **pair, "change_1": changes[row], "change_2": changes[column]}


def _by_source(fit: Fit) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Source, covariance (n, n) and change (n,) of all parameters by it [SI units]; noise has no change with a sign."""
    errors = np.array([np.nan if (error := random_error(fit, parameter)) is None else error for parameter in fit.parameters], np.float64)
    correlation = np.eye(errors.size)
    n = min(fit.correlation.shape[0], errors.size)
    correlation[:n, :n] = fit.correlation[:n, :n]
    yield NOISE, correlation * np.outer(errors, errors), np.full(errors.size, np.nan)
    if fit.budget is not None:
        for source, changes in zip(fit.budget.sources, fit.budget.changes, strict=True):
            yield source.source, np.outer(changes, changes), changes

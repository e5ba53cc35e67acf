"""A study as one table: a row for every parameter of every fit at every noise level."""

from __future__ import annotations

import csv
from pathlib import Path

from labpipe.records.study import Study
from labpipe.spreadsheet_cells import cell

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
                table.writerow((*map(cell, head), cell(p.name), p.unit, p.truth, p.mean, p.rmse, p.bound, p.std_error, p.coverage))

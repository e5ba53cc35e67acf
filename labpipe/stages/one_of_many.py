"""One test of a result whose tests stand in a dataset, as a result by itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from labpipe.artefacts.dataset_file import CONDITION, columns_of_conditions, read_rows
from labpipe.artefacts.fits_file import read_fits
from labpipe.errors import ConfigError
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.identification import Identification
from labpipe.records.response import FrequencyResponse
from labpipe.registry import nearest
from labpipe.stages.measured import fits_file_name, load_measured, measured_files


def one_of_many(identification: Identification, folder: Path, test: str) -> Identification:
    """The fits and the response of one test from the files in the *folder* of the result; ConfigError for a test that it does not have."""
    rows = read_rows(folder)
    names = rows["test"].to_pylist()
    if test not in names:
        raise ConfigError(f"the result has no test '{test}'", hint=nearest(test, list(dict.fromkeys(names))))
    row = rows.slice(names.index(test), 1).to_pylist()[0]
    if row["failed"] is not None:
        raise ConfigError(f"test '{test}' could not be evaluated: {row['failed']}")
    conditions = {name: text for name in columns_of_conditions(rows.column_names) if (text := row[CONDITION + name]) is not None}
    measured = [load_measured(path) for path in measured_files(folder, test)]
    fits = folder / fits_file_name(test)
    return dataclasses.replace(
        identification,
        fits=tuple(read_fits(fits)) if fits.exists() else (),
        responses=tuple(measurement for measurement in measured if isinstance(measurement, FrequencyResponse)),
        spectra=tuple(measurement for measurement in measured if isinstance(measurement, ChannelSpectra)),
        settings={**identification.settings, "tests": [{"name": test, "conditions": conditions}]},
        dataset=None,
    )

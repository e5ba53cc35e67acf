"""Plants for robust control design as files: the band over frequency as CSV, nominal model and weight as a MATLAB file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from labpipe.artefacts.identification_file import read_identification
from labpipe.errors import DataError
from labpipe.formats.rows_csv import write_table_csv
from labpipe.records.identification import Fit


def write_band_csv(artefact: Path, target: Path) -> None:
    """One row per fit, line, output and input: nominal plant, radius of the band around it, weight and its overbound."""
    rows = []
    for fit in robust_fits(artefact):
        plant = fit.robust
        assert plant is not None
        for row, output in enumerate(plant.outputs):
            for column, input_name in enumerate(plant.inputs):
                gain, zero, pole = plant.overbound[row, column]
                bound = gain * np.abs((1 + 1j * plant.frequency / zero) / (1 + 1j * plant.frequency / pole))
                values = plant.nominal[:, row, column]
                part = {"fit": fit.name, "test": fit.test, "output": output, "input": input_name, "unit": plant.unit}
                lines = zip(plant.frequency, values, plant.radius[:, row, column], plant.weight[:, row, column], bound, strict=True)
                for frequency, value, radius, weight, over in lines:
                    numbers = {"re": value.real, "im": value.imag, "radius": radius, "weight": weight, "overbound": over}
                    rows.append({**part, "frequency_hz": frequency, **numbers, "confidence": plant.confidence})
    write_table_csv(pd.DataFrame(rows), target)


def write_plant_mat(artefact: Path, target: Path) -> None:
    """State space A, B, C, D of the only fit with a plant, its response, radius and weight, and the overbound's k, zero and pole [Hz].

    DataError for several such fits, of which a file holds one.
    """
    from scipy.io import savemat

    fits = robust_fits(artefact)
    if len(fits) > 1:
        named = ", ".join(f"{fit.name} {fit.test}".strip() for fit in fits)
        raise DataError(f"holds {len(fits)} plants ({named}), a MATLAB file holds one", where=str(artefact), hint="--to band writes all")
    plant = fits[0].robust
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
        raise DataError("holds no plant", where=str(artefact), hint="plants stand in identification.json, of fits of the model magnet")
    fits = tuple(fit for fit in read_identification(artefact).fits if fit.robust is not None)
    if not fits:
        raise DataError("holds no plant", where=str(artefact), hint="model: magnet, with one run per axis at least")
    return fits

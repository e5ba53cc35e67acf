"""Recordings in the format of virtual loggers: units, whole numbers, and packing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from labpipe.records.recording import Recording
from labpipe.simulate.virtual_rigs import LoggedTable

# Long runs are stored as whole numbers: quantity -> (recorded unit, recorded value per SI value).
WHOLE = {"force": ("mN", 1e3), "displacement": ("nm", 1e9), "acceleration": ("mm/s^2", 1e3), "current": ("mA", 1e3), "tacho": ("V", 1.0)}
FINE_VOLTAGE, COARSE_VOLTAGE = ("uV", 1e6), ("mV", 1e3)


def force_and_displacements(run: Recording) -> LoggedTable:
    """Force and two displacements in um, single precision; the bytes of noise pack best one position after the other."""
    titles = ("force [N]", *(f"{channel.name} [um]" for channel in run.channels[1:]))
    columns = dict(zip(titles, (run.samples * [1.0, 1e6, 1e6]).T.astype(np.float32), strict=True))
    return LoggedTable(columns, dictionary=False, split=True)


def force_and_accelerations(run: Recording) -> LoggedTable:
    """As a 16-bit logger stores them: force in cN, accelerometers in mV at 10 mV per m/s^2."""
    steps = np.rint(run.samples * [100.0, *[10.0] * (len(run.channels) - 1)])
    titles = ("force [cN]", *(f"{channel.name} [mV]" for channel in run.channels[1:]))
    columns = {title: column.astype(np.int16) for title, column in zip(titles, steps.T, strict=True)}
    return LoggedTable(columns, level=19, dictionary=False)


def whole_numbers(run: Recording, units: Mapping[str, tuple[str, float]] | None = None) -> LoggedTable:
    """Columns such as "x [nm]", "ix [mA]", "ux [mV]" as whole numbers; injected voltages are small, so in uV. *units* as WHOLE has them."""
    columns: dict[str, NDArray[np.int32]] = {}
    chosen = {**WHOLE, **(units or {})}
    for number, channel in enumerate(run.channels):
        voltage = FINE_VOLTAGE if channel.role != "reference" else COARSE_VOLTAGE
        unit, per_si = chosen.get(channel.quantity, voltage)
        columns[f"{channel.name} [{unit}]"] = np.rint(run.samples[:, number] * per_si).astype(np.int32)
    return LoggedTable(columns, level=19, dictionary=False, split=True)

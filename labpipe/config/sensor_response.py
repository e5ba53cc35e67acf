"""The frequency response of a sensor from a calibration table: CSV with the columns frequency_hz, gain, phase_deg."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

from labpipe.quantities import UnitError

COLUMNS = ("frequency_hz", "gain", "phase_deg")


def read_sensor_response(path: Path) -> tuple[tuple[float, float, float], ...]:
    """Rows (frequency [Hz], gain [1], phase [rad]) of the table; lines that begin with # are left out.

    Gain and phase are what the sensor shows over what there is, relative to its sensitivity. UnitError for a file that cannot be
    read, other columns, what is no number, fewer than two rows, a gain not above zero, or frequencies that do not increase.
    """
    try:
        lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip() and not line.startswith("#")]
    except OSError:
        raise UnitError(f"no such file '{path.name}'", "paths are relative to the rig file") from None
    except UnicodeDecodeError:
        raise UnitError(f"'{path.name}' is no text table", f"columns: {', '.join(COLUMNS)}") from None
    rows = list(csv.reader(lines, skipinitialspace=True))
    if not rows or tuple(cell.strip() for cell in rows[0]) != COLUMNS:
        raise UnitError(f"'{path.name}' has other columns", f"columns: {', '.join(COLUMNS)}")
    table = tuple(_row(row, path.name) for row in rows[1:])
    if len(table) < 2 or any(later[0] <= earlier[0] for earlier, later in pairwise(table)):
        raise UnitError(f"'{path.name}' does not hold two or more increasing frequencies")
    return table


def _row(row: list[str], name: str) -> tuple[float, float, float]:
    try:
        frequency, gain, phase = (float(cell) for cell in row)
    except ValueError:
        raise UnitError(f"'{name}': '{','.join(row)}' is no frequency, gain and phase") from None
    if not (math.isfinite(frequency) and math.isfinite(phase) and frequency >= 0 and 0 < gain < math.inf):
        raise UnitError(f"'{name}': frequency {frequency:g} Hz, gain {gain:g}, phase {phase:g} deg cannot be")
    return frequency, gain, math.radians(phase)

"""Records of measured run-ups: motion, critical and threshold speeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.quantities import to_display
from labpipe.records.run_up import DIRECTIONS, RunUp
from labpipe.records.run_up_result import Amount, Cascade, MeasuredRun, Motion
from labpipe.run_ups.peak import measured_critical_speed
from labpipe.run_ups.settings import RunSettings

GRAM_MM = 1e6


@dataclass(frozen=True)
class ReadRun:
    """A run with its settings; *cascades* of a recording."""

    settings: RunSettings
    run: RunUp
    cascades: tuple[Cascade, ...] = ()


def measured_run(read: ReadRun, plane: str) -> tuple[MeasuredRun, str]:
    """The run as a record, and the reason of a missing critical speed."""
    run, settings = read.run, read.settings
    critical, reason = None, ""
    if run.shaker is None:
        try:
            peak = measured_critical_speed(run, plane)
            critical = Amount(peak.value, peak.std_error)
        except DataError as error:
            reason = str(error)
    record = MeasuredRun(
        run.name,
        run.load,
        settings.role,
        excitation=excitation_text(run),
        speed=column(run.speed),
        motions=motions(run.planes, run.response, run.amplitude_error, run.phase_error),
        critical_speed=critical,
        threshold=None if run.threshold is None else Amount(run.threshold.value, run.threshold.std_error),
        subtracted="" if settings.subtracted is None else settings.subtracted.name,
        printed_critical_speed=settings.printed_critical_speed,
        printed_threshold=settings.printed_threshold,
        cascades=read.cascades,
    )
    return record, reason


def excitation_text(run: RunUp) -> str:
    """Excitation of a run as text: shaker force or unbalances."""
    if run.shaker is not None:
        force = f"{run.shaker.x:g} N in x, {run.shaker.y:g} N in y at {run.shaker.plane}"
        return f"shaker: {force}, {run.shaker.frequency_ratio:g} of the speed"
    parts = []
    for plane, size in run.unbalance.items():
        angle = to_display(float(np.angle(size)), "deg")
        parts.append(f"{plane}: {GRAM_MM * abs(size):.4g} g mm at {angle:.4g} deg")
    return "; ".join(parts)


def motions(
    planes: tuple[str, ...],
    response: ComplexArray,
    amplitude_error: FloatArray | None = None,
    phase_error: FloatArray | None = None,
) -> tuple[Motion, ...]:
    """Phasors (n_speed, n_plane, 2) [m] and their errors [m, rad] as one record per plane and direction."""
    return tuple(
        Motion(
            plane,
            direction,
            column(response[:, n, d].real),
            column(response[:, n, d].imag),
            () if amplitude_error is None else column(amplitude_error[:, n, d]),
            () if phase_error is None else column(phase_error[:, n, d]),
        )
        for n, plane in enumerate(planes)
        for d, direction in enumerate(DIRECTIONS)
    )


def column(values: FloatArray) -> tuple[float, ...]:
    """Values (n,) [any unit], rounded to eight digits for a file."""
    return tuple(float(f"{value:.8g}") for value in np.asarray(values, np.float64).tolist())

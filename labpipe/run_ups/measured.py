"""Run-ups as they were measured: records of their motion, critical and threshold speeds."""

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
    """A run with what the pipeline says of it; *cascades* where it is a recording."""

    settings: RunSettings
    run: RunUp
    cascades: tuple[Cascade, ...] = ()


def measured_run(read: ReadRun, plane: str) -> tuple[MeasuredRun, str]:
    """The run as a record, and why it has no critical speed where it has none."""
    run, settings = read.run, read.settings
    critical, reason = None, ""
    if run.shaker is None:
        try:
            found = measured_critical_speed(run, plane)
            critical = Amount(found.value, found.std_error)
        except DataError as error:
            reason = str(error)
    record = MeasuredRun(
        run.name,
        run.load,
        settings.role,
        excitation_words(run),
        column(run.speed),
        motions(run.planes, run.response, run.amplitude_error, run.phase_error),
        critical,
        None if run.threshold is None else Amount(run.threshold.value, run.threshold.std_error),
        "" if settings.subtracted is None else settings.subtracted.name,
        settings.printed_critical_speed,
        settings.printed_threshold,
        read.cascades,
    )
    return record, reason


def excitation_words(run: RunUp) -> str:
    """What excited a run, as people read it."""
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
    """Every plane and direction of phasors (n_speed, n_plane, 2) as a record."""
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
    """Numbers for a file that people read as well: eight digits."""
    return tuple(float(f"{value:.8g}") for value in np.asarray(values, np.float64).tolist())

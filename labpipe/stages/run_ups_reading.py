"""Run-ups of a pipeline as they were measured: tables or tracked recordings, residuals subtracted, critical speeds read off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.writing import OutputFolder
from labpipe.config.run_ups import RunSettings
from labpipe.errors import DataError, LabpipeError
from labpipe.formats.runup_csv import read_runup_csv
from labpipe.identify.unbalance_peak import measured_critical_speed
from labpipe.identify.unbalance_rotor import RunUpRotor
from labpipe.quantities import to_display
from labpipe.records.rig import Rig
from labpipe.records.run_up_result import Amount, Cascade, MeasuredRun, Motion
from labpipe.records.runup import DIRECTIONS, RunUp
from labpipe.records.settings import Uncertain
from labpipe.spectra.cascade import cascade_spectra
from labpipe.spectra.orders import track_order
from labpipe.spectra.run_ups import at_speeds, difference, run_up_of
from labpipe.spectra.settings import ShaftLines
from labpipe.stages.ingest import ingest, is_recording

# Lines of a cascade that are kept: more than a figure can show.
MOST_LINES = 240
GRAM_MM = 1e6


@dataclass(frozen=True)
class ReadRun:
    """A run with what the pipeline says of it; *cascades* where it is a recording."""

    settings: RunSettings
    run: RunUp
    cascades: tuple[Cascade, ...] = ()


def read_run(settings: RunSettings, rig: RunUpRotor, output: OutputFolder, folder: Path) -> ReadRun:
    """The run of a pipeline's entry, less its residual where it names one; LabpipeError names the entry."""
    try:
        found = _recorded(settings, rig, output, folder) if settings.recording else _tabled(settings)
        rig.excited(found.run)
        return found
    except LabpipeError as error:
        error.where = error.where or f"run_ups, run '{settings.name}'"
        raise


def _tabled(settings: RunSettings) -> ReadRun:
    run = _stated(settings, read_runup_csv(settings.path, settings.name, dict(settings.unbalance) or None))
    if settings.subtracted is not None:
        run = difference(run, read_runup_csv(settings.subtracted, settings.subtracted.stem, {}))
    return ReadRun(settings, run)


def _stated(settings: RunSettings, run: RunUp) -> RunUp:
    """What the pipeline says takes the place of what the table says."""
    threshold = settings.threshold
    return replace(
        run,
        load=run.load if settings.load is None else settings.load,
        unbalance=dict(settings.unbalance) or run.unbalance,
        threshold=run.threshold if threshold is None else Uncertain(2 * np.pi * threshold.value, 2 * np.pi * threshold.std_error),
    )


def _recorded(settings: RunSettings, rig: RunUpRotor, output: OutputFolder, folder: Path) -> ReadRun:
    """The 1x of a recording, stretch by stretch, and its cascade."""
    lines = ShaftLines(tacho=settings.tacho, pulses=settings.pulses, harmonics=settings.harmonics)
    recording = _opened(settings.path, settings, output, folder)
    run = _tracked(recording, lines, settings, dict(settings.unbalance))
    if settings.subtracted is not None:
        residual = _opened(settings.subtracted, settings, output, folder)
        still = dict.fromkeys(rig.plane_names[:1], 0j)
        run = _less(run, _tracked(residual, lines, settings, still))
    return ReadRun(settings, _stated(settings, run), _cascades(recording, lines))


def _less(run: RunUp, residual: RunUp) -> RunUp:
    """Stretches of two recordings never fall on the same speeds: the residual is read off between its own."""
    inside = run.speed[(run.speed >= residual.speed[0]) & (run.speed <= residual.speed[-1])]
    return difference(run, at_speeds(residual, inside))


def _opened(path: Path, settings: RunSettings, output: OutputFolder, folder: Path) -> StoredRecording:
    if settings.own_rig is None and not is_recording(path):
        raise DataError("a raw file needs its rig file", where=str(path), hint="add rig: FILE to the entry")
    return ingest(path, settings.own_rig or Rig("", ()), output, f"recordings/{path.name.split('.')[0]}", folder)


def _tracked(recording: StoredRecording, lines: ShaftLines, settings: RunSettings, unbalance: dict[str, complex]) -> RunUp:
    track = track_order(recording, lines, revolutions=settings.revolutions)
    assert settings.load is not None
    return run_up_of(track, settings.name, settings.load, unbalance)


def _cascades(recording: StoredRecording, lines: ShaftLines) -> tuple[Cascade, ...]:
    """Of every response; lines are thinned by their largest, so that no peak is lost."""
    found = cascade_spectra(recording, lines)
    group = -(-found.frequency.size // MOST_LINES)
    whole = found.frequency.size // group * group
    frequency = found.frequency[:whole].reshape(-1, group).mean(axis=1)
    thinned = found.amplitude[:, :whole].reshape(found.amplitude.shape[0], -1, group, len(found.labels)).max(axis=2)
    return tuple(
        Cascade(label, column(found.speed), column(frequency), tuple(column(row) for row in thinned[:, :, number]))
        for number, label in enumerate(found.labels)
    )


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
    response: NDArray[np.complexfloating],
    amplitude_error: NDArray[np.floating] | None = None,
    phase_error: NDArray[np.floating] | None = None,
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




def column(values: NDArray[np.floating]) -> tuple[float, ...]:
    """Numbers for a file that people read as well: eight digits."""
    return tuple(float(f"{value:.8g}") for value in np.asarray(values, np.float64).tolist())

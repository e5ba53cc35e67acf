"""Run-ups of a pipeline as they were measured: tables or tracked recordings, residuals subtracted, critical speeds read off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError, LabpipeError
from labpipe.formats.run_up_csv import read_run_up_csv
from labpipe.records.rig import Rig
from labpipe.records.run_up import RunUp
from labpipe.records.run_up_result import Cascade
from labpipe.records.settings import Uncertain
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.run_ups.measured import ReadRun, column
from labpipe.run_ups.probes import ProbeDoubts, turning
from labpipe.run_ups.settings import RunSettings
from labpipe.spectra.cascade import cascade_spectra
from labpipe.spectra.orders import track_order
from labpipe.spectra.run_up_orders import at_speeds, difference, run_up_of
from labpipe.spectra.settings import ShaftLines
from labpipe.stages.ingest import ingest, is_recording

# Lines of a stored cascade, more than a figure can show.
MOST_LINES = 240
NO_DOUBTS = ProbeDoubts()


def read_run(settings: RunSettings, rig: RunUpRotor, output: OutputFolder, folder: Path, probes: ProbeDoubts = NO_DOUBTS) -> ReadRun:
    """The run of a pipeline's entry, its residual run subtracted where named; LabpipeError names the entry. *probes*: those of tables."""
    try:
        read = _recorded(settings, output, folder) if settings.recording else _tabled(settings, probes)
        rig.excited(read.run)
        return read
    except LabpipeError as error:
        error.where = error.where or f"run_ups, run '{settings.name}'"
        raise


def _tabled(settings: RunSettings, probes: ProbeDoubts) -> ReadRun:
    run = _stated(settings, read_run_up_csv(settings.path, settings.name, dict(settings.unbalance) or None))
    run = replace(run, doubts=probes.errors(run.planes))
    if settings.subtracted is not None:
        run = difference(run, read_run_up_csv(settings.subtracted, settings.subtracted.stem, {}))
    return ReadRun(settings, run)


def _stated(settings: RunSettings, run: RunUp) -> RunUp:
    """The run with load, unbalance and threshold of the pipeline instead of the table's."""
    threshold = settings.threshold
    return replace(
        run,
        load=run.load if settings.load is None else settings.load,
        unbalance=dict(settings.unbalance) or run.unbalance,
        threshold=run.threshold if threshold is None else Uncertain(2 * np.pi * threshold.value, 2 * np.pi * threshold.std_error),
    )


def _recorded(settings: RunSettings, output: OutputFolder, folder: Path) -> ReadRun:
    """The 1x of a recording, stretch by stretch, and its cascade."""
    lines = ShaftLines(tacho=settings.tacho, pulses=settings.pulses, harmonics=settings.harmonics)
    recording = _opened(settings.path, settings, output, folder)
    run = _tracked(recording, lines, settings, dict(settings.unbalance))
    if settings.subtracted is not None:
        residual = _opened(settings.subtracted, settings, output, folder)
        # Nothing was added before the residual run, where the run has its weights.
        still = dict.fromkeys(dict(settings.unbalance), 0j)
        run = _without_residual(run, _tracked(residual, lines, settings, still))
    return ReadRun(settings, _stated(settings, run), _cascades(recording, lines))


def _without_residual(run: RunUp, residual: RunUp) -> RunUp:
    """Subtract the residual run, interpolated to this run's speeds."""
    inside = run.speed[(run.speed >= residual.speed[0]) & (run.speed <= residual.speed[-1])]
    return difference(run, at_speeds(residual, inside))


def _opened(path: Path, settings: RunSettings, output: OutputFolder, folder: Path) -> StoredRecording:
    if settings.recorded_by is None and not is_recording(path):
        raise DataError("a raw file needs its rig file", where=str(path), hint="add rig: FILE to the entry")
    return ingest(path, settings.recorded_by or Rig("", ()), output, f"recordings/{path.name.split('.')[0]}", folder)


def _tracked(recording: StoredRecording, lines: ShaftLines, settings: RunSettings, unbalance: dict[str, complex]) -> RunUp:
    track = track_order(recording, lines, revolutions=settings.revolutions)
    assert settings.load is not None
    run = run_up_of(track, settings.name, settings.load, unbalance)
    tacho = next(channel for channel in recording.channels if channel.name == settings.tacho)
    turned = [effect.doubt for effect in tacho.doubts if effect.effect == "phase"]
    of_keyphasor = [error for doubt in turned for error in turning(doubt, len(run.planes))]
    return replace(run, doubts=(*run.doubts, *of_keyphasor))


def _cascades(recording: StoredRecording, lines: ShaftLines) -> tuple[Cascade, ...]:
    """Cascade of every response; groups of lines are reduced to their maximum, so that no peak is lost."""
    spectra = cascade_spectra(recording, lines)
    group = -(-spectra.frequency.size // MOST_LINES)
    whole = spectra.frequency.size // group * group
    frequency = spectra.frequency[:whole].reshape(-1, group).mean(axis=1)
    thinned = spectra.amplitude[:, :whole].reshape(spectra.amplitude.shape[0], -1, group, len(spectra.labels)).max(axis=2)
    return tuple(
        Cascade(label, column(spectra.speed), column(frequency), tuple(column(row) for row in thinned[:, :, number]))
        for number, label in enumerate(spectra.labels)
    )

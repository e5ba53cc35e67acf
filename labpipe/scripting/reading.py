"""Read every file of measurements or results by one function."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from labpipe.artefacts.decay_file import SUFFIX as DECAY_SUFFIX
from labpipe.artefacts.decay_file import read_decays
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.recording_file import open_recording
from labpipe.artefacts.spectra_file import SUFFIX as SPECTRA_SUFFIX
from labpipe.artefacts.spectra_file import read_spectra
from labpipe.artefacts.writing import output_folder
from labpipe.config.reader import DECIDE
from labpipe.config.rig import DEFAULT_ROLES, load_rig, time_scale
from labpipe.errors import ConfigError, DataError
from labpipe.formats.packed import plain_suffix
from labpipe.formats.run_up_csv import read_run_up_csv
from labpipe.formats.table import TEXT_SUFFIXES, Table, open_table
from labpipe.quantities import QUANTITIES, parse_unit
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.free_decay import FreeDecays
from labpipe.records.identification import Identification
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse
from labpipe.records.rig import AXIS_ANGLES, Rig
from labpipe.records.run_up import RunUp
from labpipe.signals.screening import TimeAxisScreen
from labpipe.stages.first_guess import GuessedChannel, first_rows, guess_channels, time_columns
from labpipe.stages.ingest import ingest, is_recording
from labpipe.stages.ready_response import is_response, load_response

SETTINGS_SUFFIXES = (".yaml", ".yml")
_RUN_UP = re.compile(r"^# *load *:", re.MULTILINE)
HEAD = 4096


def read(
    path: str | Path, rig: str | Path | Rig | None = None
) -> Recording | FrequencyResponse | FreeDecays | ChannelSpectra | RunUp | Identification:
    """The content of a file, in SI units: a recording, a frequency response, spectra, a run-up table, or a result.

    Raw recordings (CSV, TDMS, UFF 58, MAT, HDF5, WAV, Parquet) are calibrated as a *rig* file says; without one by the units and names that
    the file itself states. FRFs come from CSV, UFF 58, MAT, HDF5 and ``*.frf.parquet``, free decays from ``*.decay.parquet``, spectra
    of all channels from ``*.spectra.parquet``, results from identification.json or its folder.
    LabpipeError names the file, and the channels that only a rig file can describe.
    """
    path = Path(path)
    if path.is_dir():
        return read_identification(path / "identification.json")
    suffix = plain_suffix(path)
    if suffix in SETTINGS_SUFFIXES:
        raise ConfigError("is a settings file", where=str(path), hint="labpipe.run, bearing, rotor and virtual_rig read these")
    if suffix == ".json":
        return read_identification(path)
    if path.name.endswith(DECAY_SUFFIX):
        return read_decays(path)
    if path.name.endswith(SPECTRA_SUFFIX):
        return read_spectra(path)
    if is_response(path):
        return load_response(path)
    if path.is_file() and is_recording(path):
        return open_recording(path).in_memory()
    if suffix in TEXT_SUFFIXES and path.is_file() and _is_run_up(path):
        return read_run_up_csv(path)
    if rig is not None:
        return _calibrated(path, rig if isinstance(rig, Rig) else load_rig(Path(rig)))
    return _by_itself(path)


def _is_run_up(path: Path) -> bool:
    """True for a run-up table, which begins with the load in a comment."""
    with path.open("rb") as stream:
        return _RUN_UP.search(stream.read(HEAD).decode("utf-8", "replace")) is not None


def _calibrated(path: Path, rig: Rig) -> Recording:
    """The recording as the rig file describes it, through the same stage as on the command line."""
    import tempfile

    with tempfile.TemporaryDirectory(prefix="labpipe-") as scratch, output_folder(Path(scratch)) as output:
        return ingest(path, rig, output, path.stem, path.parent).in_memory()


def _by_itself(path: Path) -> Recording:
    """The recording as the file describes it; DataError for channels without quantity or unit."""
    table = open_table(path)
    names, rows = first_rows(table)
    time = time_columns(names, rows)[:1] if table.sample_rate is None else []
    if table.sample_rate is None and not time:
        raise DataError("states no sampling rate and has no time column", where=str(path), hint="read it with rig='rig.yaml'")
    guessed = guess_channels([name for name in names if name not in time], table.units)
    undecided = [channel.column for channel in guessed if DECIDE in (channel.quantity, channel.unit, channel.sensitivity)]
    if undecided:
        what = f"does not say quantity, unit or sensitivity of {', '.join(repr(column) for column in undecided)}"
        raise DataError(what, where=str(path), hint="read it with rig='rig.yaml'; labpipe init proposes one")
    return _recording(table, guessed, time)


def _recording(table: Table, guessed: list[GuessedChannel], time: list[str]) -> Recording:
    units = [parse_unit(channel.unit) for channel in guessed]
    samples = np.concatenate(list(table.chunks([*time, *(channel.column for channel in guessed)])))
    calibrated = samples[:, len(time) :] * [unit.factor for unit in units] + [unit.offset for unit in units]
    rate = table.sample_rate
    if time:
        screen = TimeAxisScreen(time[0])
        screen.add(samples[:, 0] * time_scale(time[0]))
        rate = screen.sample_rate()
    return Recording(tuple(_channel(channel) for channel in guessed), calibrated, float(rate or 0.0), table.path.stem)


def _channel(guessed: GuessedChannel) -> Channel:
    role = guessed.role or DEFAULT_ROLES.get(guessed.quantity, "reference")
    assert guessed.quantity in QUANTITIES
    return Channel(guessed.key, guessed.quantity, role, guessed.dof, AXIS_ANGLES.get(guessed.dof))

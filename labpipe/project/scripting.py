"""For scripts and notebooks: read files, run pipelines, bearings and rotors by name, results as tables."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.measured_files import DECAY_SUFFIX, SPECTRA_SUFFIX, read_decays, read_spectra
from labpipe.artefacts.mirrored import make_results
from labpipe.artefacts.recording_file import open_recording
from labpipe.artefacts.writing import OutputFolder, output_folder, path_of
from labpipe.bearings.kinds import BEARINGS, BearingCoefficients, BearingKind
from labpipe.errors import ConfigError, DataError
from labpipe.project.bearing_file import open_bearing
from labpipe.project.executors import in_processes, serially
from labpipe.project.first_guess import GuessedChannel, first_rows, guess_channels, time_columns
from labpipe.project.ingest import SourceFile, ingest, is_recording
from labpipe.project.marked_yaml import load_marked
from labpipe.project.one_test import silent
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.ready_response import is_response, load_response
from labpipe.project.report import outdate_reports, write_reports
from labpipe.project.rig_file import DEFAULT_ROLES, load_rig
from labpipe.project.run import Manner, run as run_pipeline
from labpipe.project.run_record import record_run
from labpipe.project.settings_reader import DECIDE, FILE_KINDS
from labpipe.project.simulate import load_virtual_rig
from labpipe.quantities import unit_of
from labpipe.raw_files.table import TEXT_SUFFIXES, open_table
from labpipe.raw_files.text_table import plain_suffix
from labpipe.records.dataset import entries_of
from labpipe.records.identification import Fit, Identification, ListedParameter, listed_parameters, of_fit
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse
from labpipe.records.rig import AXIS_ANGLES, Rig, RigChannel
from labpipe.registry import Registry
from labpipe.simulate.virtual_rigs import VIRTUAL_RIGS, VirtualRig, VirtualRigKind

if TYPE_CHECKING:
    import xarray

# Readers of text files that say themselves what they are: from a path to a record, or None for a file of
# another kind.
TEXT_FILES = Registry("text file")
SETTINGS_SUFFIXES = (".yaml", ".yml")


def bearing(kind: str | Path, **settings: Any) -> BearingCoefficients:
    """Stiffness and damping of a bearing: of a bearing file, or of a *kind* with the entries of its file as
    keywords.

    ``bearing("journal-bearing", diameter="31 mm", length="18 mm", clearance="90 um", viscosity=0.1044,
    speed="50 Hz", load="58.8 N")``; texts carry their unit, numbers are SI. ConfigError for an unknown kind
    or entry.
    """
    if _is_file(kind):
        file = open_bearing(Path(kind), [f"{name}={value}" for name, value in settings.items()])
        return file.coefficients([file.settings()])[0]
    chosen: BearingKind = BEARINGS.load(str(kind))
    return chosen.coefficients([chosen.settings(kind=str(kind), **settings)])[0]


def rotor(path: str | Path) -> Any:
    """The rotor of a rotor file; one with ``pins:`` is a rotor for run-ups."""
    entries = load_marked(Path(path)).content
    pinned = isinstance(entries, dict) and "pins" in entries
    return FILE_KINDS.load("run-up-rotor" if pinned else "rotor").load(Path(path))


def virtual_rig(kind: str | Path, **settings: Any) -> VirtualRig:
    """A virtual rig: of its file, or of a *kind* with the entries of its file as keywords."""
    if _is_file(kind):
        return load_virtual_rig(Path(kind), [f"{name}={value}" for name, value in settings.items()])
    chosen: VirtualRigKind = VIRTUAL_RIGS.load(str(kind))
    rig: VirtualRig = chosen.settings(kind=str(kind), **settings)
    return rig


def _is_file(kind: str | Path) -> bool:
    return isinstance(kind, Path) or kind.endswith(SETTINGS_SUFFIXES)


def to_frame(record: Fit | Identification | FrequencyResponse | Recording) -> pd.DataFrame:
    """Parameters of a fit or of a whole result, one row each; a response over frequency [Hz]; a recording
    over time [s]. SI units.

    A response has for every element the columns ``o/i``, complex, and ``o/i:std``, its standard deviation,
    where the noise is known.
    """
    if isinstance(record, Fit):
        return pd.DataFrame([_row(listed) for listed in of_fit(record)])
    if isinstance(record, Identification) and record.dataset is not None:
        hint = "pandas.read_parquet('OUT/dataset') reads it"
        raise ConfigError("the numbers of so many tests stand in a dataset", hint=hint)
    if isinstance(record, Identification):
        return pd.DataFrame([_row(listed) for listed in listed_parameters(record)])
    if isinstance(record, FrequencyResponse):
        return _response_frame(record)
    if isinstance(record, Recording):
        time = pd.Index(np.arange(record.n_sample) / record.sample_rate, name="time [s]")
        columns = [f"{channel.name} [{channel.unit}]" for channel in record.channels]
        return pd.DataFrame(record.samples, index=time, columns=columns)
    hint = "a fit, a result, a response or a recording has"
    raise ConfigError(f"a {type(record).__name__} has no table", hint=hint)


COLUMNS = (
    "fit", "test", "term", "model", "estimator", "low_hz", "high_hz", "parameter", "value", "unit",
    "std_error", "ci_low", "ci_high", "significant", "derived", "warnings",
)  # fmt: skip


def _row(listed: ListedParameter) -> dict[str, Any]:
    entries = {**entries_of(listed), "test": listed.test, "derived": listed.parameter.derived}
    return {name: entries[name] for name in COLUMNS}


def _response_frame(response: FrequencyResponse) -> pd.DataFrame:
    columns: dict[str, Any] = {}
    for o, output in enumerate(response.outputs):
        for i, force in enumerate(response.inputs):
            columns[f"{output.label}/{force.label}"] = response.matrix[:, o, i]
            if response.variance is not None:
                columns[f"{output.label}/{force.label}:std"] = np.sqrt(response.variance[:, o, i])
    return pd.DataFrame(columns, index=pd.Index(response.frequency, name="frequency [Hz]"))


def to_xarray(response: FrequencyResponse) -> xarray.Dataset:
    """The response over frequency, output and input, with variance and coherence where they are known.
    ConfigError where xarray is not installed.
    """
    try:
        import xarray
    except ImportError:
        raise ConfigError("to_xarray needs the package xarray", hint="pip install xarray") from None
    dims = ("frequency", "output", "input")
    variables = {"response": response.matrix, "variance": response.variance, "coherence": response.coherence}
    coords = {
        "frequency": response.frequency,
        "output": [port.label for port in response.outputs],
        "input": [port.label for port in response.inputs],
    }
    present = {name: (dims, values) for name, values in variables.items() if values is not None}
    attributes = {"form": response.form, "name": response.name, **response.conditions}
    return xarray.Dataset(present, coords, attributes)


HEAD = 4096


def read(path: str | Path, rig: str | Path | Rig | None = None) -> Any:
    """The content of a file, in SI units: a recording, a frequency response, spectra, a run-up table, or a
    result.

    Raw recordings (CSV, TDMS, UFF 58, MAT, HDF5, WAV, Parquet) are calibrated as a *rig* file says; without
    one by the units and names that the file itself states. FRFs come from CSV, UFF 58, MAT, HDF5 and
    ``*.frf.parquet``, free decays from ``*.decay.parquet``, spectra of all channels from
    ``*.spectra.parquet``, results from identification.json or its folder. LabpipeError names the file, and
    the channels that only a rig file can describe.
    """
    path = Path(path)
    if path.is_dir():
        return read_identification(path / "identification.json")
    suffix = plain_suffix(path)
    if suffix in SETTINGS_SUFFIXES:
        hint = "labpipe.run, bearing, rotor and virtual_rig read these"
        raise ConfigError("is a settings file", path, hint)
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
    names = TEXT_FILES.names() if suffix in TEXT_SUFFIXES and path.is_file() else ()
    records = (TEXT_FILES.load(name)(path) for name in names)
    stored = next((record for record in records if record is not None), None)
    if stored is not None or rig is None:
        return stored or _read_alone(path)
    return _calibrate(path, rig if isinstance(rig, Rig) else load_rig(Path(rig)))


@contextmanager
def _scratch_output() -> Iterator[OutputFolder]:
    with tempfile.TemporaryDirectory(prefix="labpipe-") as scratch, output_folder(Path(scratch)) as output:
        yield output


def _calibrate(path: Path, rig: Rig) -> Recording:
    with _scratch_output() as output:
        return ingest(SourceFile(path, rig), output, path.stem, path.parent).in_memory()


def _read_alone(path: Path) -> Recording:
    table = open_table(path)
    names, rows = first_rows(table)
    time = time_columns(names, rows)[:1] if table.sample_rate is None else []
    if table.sample_rate is None and not time:
        raise DataError("states no sampling rate and has no time column", path, "read it with rig='rig.yaml'")
    guessed = guess_channels([name for name in names if name not in time], table.units)
    undecided = [repr(c.column) for c in guessed if DECIDE in (c.quantity, c.unit, c.sensitivity)]
    if undecided:
        what = f"does not say quantity, unit or sensitivity of {', '.join(undecided)}"
        raise DataError(what, path, "read it with rig='rig.yaml'; labpipe init proposes one")
    return _calibrate(path, Rig("", tuple(map(_state_channel, guessed)), time=next(iter(time), None)))


def _state_channel(guessed: GuessedChannel) -> RigChannel:
    role = guessed.role or DEFAULT_ROLES.get(guessed.quantity, "reference")
    channel = Channel(guessed.key, guessed.quantity, role, guessed.dof, AXIS_ANGLES.get(guessed.dof))
    # By the quantity: g of an acceleration is not a gram.
    unit = unit_of(guessed.unit, channel.unit)
    return RigChannel(channel, guessed.column, guessed.unit, unit.factor, unit.offset)


def run(
    pipeline: str | Path, output: str | Path | None = None, overrides: Iterable[str] = (), jobs: int = 1
) -> Identification:
    """The result of a pipeline file; with an *output* folder also its files and reports, where fresh results
    are reused.

    The output may be of an object storage, s3://bucket/prefix. *overrides*: as --set takes them,
    "identify.support.band=60-70 Hz". *jobs*: processes for several tests; a script that asks for more than
    one needs the usual ``if __name__ == "__main__"``. LabpipeError as on the command line; rules that fail
    are in the result. Without a folder the result is whole, however many tests it has; in a folder that of
    very many is a dataset, read with pandas.
    """
    manner = Manner(execute=serially if jobs == 1 else in_processes(jobs), processes=jobs)
    if output is None:
        settings = replace(load_pipeline(Path(pipeline), overrides), results="whole")
        with _scratch_output() as folder:
            return run_pipeline(settings, folder, manner)
    target = path_of(str(output))
    with record_run(target, Path(pipeline)) as made:
        settings = load_pipeline(Path(pipeline), overrides)
        with make_results(target) as here:
            with output_folder(here) as folder:
                made.append(run_pipeline(settings, folder, manner))
                outdate_reports(folder, settings.report.formats)
            write_reports(made[0], here, settings.report.formats, silent)
    return made[0]

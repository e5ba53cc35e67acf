"""``*.decay.parquet``: the free decays of one test, one below the other."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from labpipe.arrow_arrays import numpy_array
from labpipe.artefacts.header import Header
from labpipe.artefacts.parquet import as_written, read_header, read_table, write_columns
from labpipe.records.free_decay import FreeDecay, FreeDecays
from labpipe.records.response import Port

SUFFIX = ".decay.parquet"


def write_decays(path: Path, decays: FreeDecays, header: Header) -> None:
    """Write the decays: a column of numbers of decays, one of times [s] in the recording, one of every output [SI]."""
    numbers = np.repeat(np.arange(len(decays.decays)), [decay.samples.shape[0] for decay in decays.decays])
    times = [decay.start + np.arange(decay.samples.shape[0]) / decays.sample_rate for decay in decays.decays]
    samples = np.concatenate([decay.samples for decay in decays.decays])
    columns = {"decay": numbers, "time_s": np.concatenate(times)}
    columns.update({f"output:{port.label}": samples[:, number] for number, port in enumerate(decays.outputs)})
    contents = {
        "name": decays.name,
        "sample_rate": decays.sample_rate,
        "outputs": [dataclasses.asdict(port) for port in decays.outputs],
        "units": list(decays.units),
        "recordings": [decay.recording for decay in decays.decays],
        "starts": [decay.start for decay in decays.decays],
        "conditions": decays.conditions,
    }
    write_columns(path, columns, dataclasses.replace(header, contents=contents, findings=decays.findings))


def read_decays(path: Path) -> FreeDecays:
    """The decays of a ``*.decay.parquet`` file; DataError when the file is not one."""
    header = read_header(path, "decay")
    with as_written(path):
        return _decay_of(header, path)


def _decay_of(header: Header, path: Path) -> FreeDecays:
    contents = header.contents
    table = read_table(path)
    outputs = tuple(Port(**entry) for entry in contents["outputs"])
    samples = np.column_stack([numpy_array(table.column(f"output:{port.label}")) for port in outputs])
    numbers = numpy_array(table.column("decay"))
    named = zip(contents["recordings"], contents["starts"], strict=True)
    decays = tuple(FreeDecay(recording, start, samples[numbers == number]) for number, (recording, start) in enumerate(named))
    return FreeDecays(
        contents["sample_rate"],
        outputs,
        tuple(contents["units"]),
        decays,
        name=contents["name"],
        findings=header.findings,
        conditions=contents["conditions"],
    )

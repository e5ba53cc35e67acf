"""simulate: a virtual rig -> recorded files as a logger would write them, and truth.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq

from labpipe.artefacts.parquet import arrow_array
from labpipe.artefacts.writing import OutputFolder
from labpipe.project.marked_yaml import load_marked
from labpipe.project.measured import file_stems
from labpipe.project.settings_reader import Faults, read_kind, read_settings
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import FileKind
from labpipe.simulate import virtual_rigs


def load_virtual_rig(path: Path, overrides: Iterable[str] = ()) -> virtual_rigs.VirtualRig:
    """The settings of a virtual rig file. ConfigErrors with every fault at its place."""
    tree, faults = load_marked(path, overrides), Faults(path.parent)
    chosen = read_kind(tree, "", virtual_rigs.VIRTUAL_RIGS, "virtual rig", faults)
    faults.raise_any()
    rig: virtual_rigs.VirtualRig | None = read_settings(chosen.settings, tree, "", faults)
    faults.raise_any()
    assert rig is not None
    return rig


VIRTUAL_RIG_FILE = FileKind(load_virtual_rig)


TRUTH = "truth.json"


def simulate_files(
    rig: virtual_rigs.VirtualRig, seed: int, runs: Iterable[str] | None, output: OutputFolder
) -> list[str]:
    """Write the files of a virtual rig and truth.json; their names."""
    simulation = virtual_rigs.simulate(rig, seed, runs)
    names, stems = [], file_stems(simulation.files, "runs")
    for run, content in simulation.files.items():
        in_parquet = isinstance(content, virtual_rigs.LoggedTable) and not content.text
        name = f"{stems[run]}.{'parquet' if in_parquet else 'csv'}"
        WRITERS[type(content)](output.write_path(name), content)
        names.append(name)
    entries = {"seed": seed, "rig": rig.name, **simulation.truth}
    output.write_path(TRUTH).write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    return [*names, TRUTH]


def _write_table(path: Path, table: virtual_rigs.LoggedTable) -> None:
    """Text with six significant digits, more than a 16-bit logger holds; Parquet as the table says."""
    if table.text:
        rounded = {
            title: arrow_array(np.array([float(f"{value:.6g}") for value in values]))
            for title, values in table.columns.items()
        }
        pc.write_csv(pa.table(rounded), path, pc.WriteOptions(quoting_style="none"))
        return
    pq.write_table(
        pa.table({title: arrow_array(values) for title, values in table.columns.items()}),
        path,
        compression="zstd",
        compression_level=table.level,
        use_dictionary=table.dictionary,
        use_byte_stream_split=table.split,
    )


WRITERS: dict[type, Callable[[Path, Any], None]] = {
    virtual_rigs.LoggedTable: _write_table,
    FrequencyResponse: write_frf_csv,
    virtual_rigs.LoggedFile: lambda path, file: file.write(path, file.content),
}

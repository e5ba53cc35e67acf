"""Files: what labpipe reads against what the file's own package reads or wrote."""

from __future__ import annotations

import tempfile
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import pyuff
from scipy.io import wavfile

from labpipe.raw_files.table import RawTable, open_table
from labpipe.raw_files.uff_read import read_frf_uff
from tests.validation.claims import Claim, Method, within
from tests.validation.gaps import gaps
from tests.validation.shipped import PACKAGE, shipped, variables

PEER, MEASURED = "peer program", "measured public data"


def column(table: RawTable, name: str) -> np.ndarray:
    rows = np.concatenate(list(table.chunks(table.columns)))
    return np.asarray(rows[:, table.columns.index(name)])


def measured() -> list[Claim]:
    """An analyser's MATLAB file: the rate from its own entry, the samples as scipy has them."""
    table, of = open_table(shipped("case1.mat")), variables("case1.mat")
    difference = np.max(np.abs(column(table, "Time_chan_2") - of["Time_chan_2"].ravel()))
    assert table.sample_rate is not None
    source = f"{PACKAGE}, case1"
    return [
        within(
            "sampling rate of an analyser's file",
            table.sample_rate,
            float(of["Time_Sample_Rate"].ravel()[0]),
            1e-6,
            "Hz",
            MEASURED,
            source,
        ),
        within("largest difference of 4096 samples", difference, 0.0, 1e-12, "V", MEASURED, source),
    ]


def written_by_others() -> list[Claim]:
    """FRFs that pyuff wrote, binary and as text, and a WAV file that scipy wrote."""
    rng, found = np.random.default_rng(3), []
    values = rng.normal(size=400) + 1j * rng.normal(size=400)
    record = {
        "type": 58, "func_type": 4, "rsp_node": 1, "rsp_dir": 1, "ref_node": 2, "ref_dir": 2, "data": values,
        "x": np.arange(1.0, 401.0),
        "abscissa_spacing": 1, "abscissa_spec_data_type": 18, "ordinate_spec_data_type": 12,
        "orddenom_spec_data_type": 13,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        for binary, name in ((1, "binary"), (0, "text")):
            path = Path(folder) / f"{name}.uff"
            with warnings.catch_warnings():
                # The other program leaves its files open.
                warnings.simplefilter("ignore", ResourceWarning)
                pyuff.UFF(str(path)).write_sets([{**record, "binary": binary}], "add")
            difference = np.max(np.abs(read_frf_uff(path).matrix[:, 0, 0] - values))
            found.append(
                within(
                    f"largest difference of an FRF, universal file, {name}",
                    difference,
                    0.0,
                    1e-9,
                    "1",
                    PEER,
                    "pyuff",
                )
            )
        path, samples = Path(folder) / "tone.wav", rng.normal(size=2000).astype(np.float32)
        wavfile.write(path, 4096, samples)
        table = open_table(path)
        difference = np.max(np.abs(np.concatenate(list(table.chunks(table.columns)))[:, -1] - samples))
        found.append(
            within("largest difference, WAV file", difference, 0.0, 1e-9, "1", PEER, "scipy.io.wavfile")
        )
    return found


METHOD = Method(
    "files",
    "Files",
    {"measured": measured, "written by others": written_by_others, "not tested": partial(gaps, "files")},
)

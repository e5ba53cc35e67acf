"""Test signals as files for a signal generator: CSV, Parquet, WAV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
from scipy.io import wavfile

from labpipe.arrays import FloatArray
from labpipe.artefacts.parquet import arrow_array
from labpipe.artefacts.writing import output_file
from labpipe.errors import ConfigError


def write_signal(path: Path, samples: FloatArray, sample_rate: float, column: str = "u [V]") -> None:
    """Write *samples* (n_sample,) [V], or as the title of the *column* says, in the format of the suffix;
    ConfigError for other suffixes.

    A WAV file is scaled to full range.
    """
    suffix = path.suffix.lower()
    device = path.exists() and not path.is_file() and not path.is_dir()
    if suffix not in (".csv", ".parquet", ".wav") and not device:
        raise ConfigError(
            f"no signal format for the ending '{suffix}'", where=str(path), hint="known: .csv, .parquet, .wav"
        )
    with output_file(path) as target:
        if suffix == ".wav":
            _write_wav(target, samples, sample_rate)
            return
        table = pa.table(
            {"t [s]": arrow_array(np.arange(samples.size) / sample_rate), column: arrow_array(samples)}
        )
        if suffix == ".parquet":
            pq.write_table(table, target)
        else:
            pc.write_csv(table, target, pc.WriteOptions(quoting_style="none"))


def _write_wav(path: Path, samples: FloatArray, sample_rate: float) -> None:
    """32-bit float WAV with peak 1; the file's rate is a whole number of hertz."""
    if sample_rate != round(sample_rate):
        raise ConfigError(
            f"a WAV file cannot hold the sampling rate {sample_rate:g} Hz",
            hint="choose a whole number of hertz",
        )
    wavfile.write(path, round(sample_rate), (samples / np.max(np.abs(samples))).astype(np.float32))

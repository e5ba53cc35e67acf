"""TDMS files of National Instruments, read block by block; scaling properties are applied by npTDMS."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nptdms import TdmsFile
from nptdms.log import log_manager

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.raw_files.table import check_names, unique
from labpipe.raw_files.text_table import reading

CHUNK_ROWS = 1 << 17
_UNITS = ("unit_string", "NI_UnitDescription", "unit")
_SENSITIVITIES = ("sensitivity", "ni_sensitivity", "sensor_sensitivity", "transducer_sensitivity")
_SENSITIVITY_UNITS = (
    "sensitivity_unit",
    "sensitivity_units",
    "ni_sensitivityunits",
    "sensor_sensitivity_unit",
)
# Relative difference of rates that are one, and of a rate from a whole number of hertz.
_SAME = 1e-6
# Share of a step by which channels may begin apart.
BESIDE = 0.1


class TdmsTable:
    """The longest channels, by name, or "group/name" for a repeated name. Satisfies RawTable. *sensitivities*
    where properties state them; *unused*: shorter channels, with their numbers of values.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        # Suppresses npTDMS's log of a damaged file: there is one error message.
        log_manager.set_level(logging.ERROR)
        with reading(path, "TDMS file"), path.open("rb") as stream, TdmsFile.open(stream) as file:
            if file.file_status.incomplete_final_segment:
                hint = "the logger was interrupted, or the copy is incomplete"
                raise DataError("its last segment is truncated", path, hint)
            self._keep(
                [c for g in file.groups() for c in g.channels() if len(c) and np.dtype(c.dtype).kind in "iuf"]
            )

    def _keep(self, candidates: list[Any]) -> None:
        length = max((len(channel) for channel in candidates), default=0)
        if length < 1:
            raise DataError("holds no channel of numbers", self.path)
        channels = [channel for channel in candidates if len(channel) == length]
        self.unused = {c.name: len(c) for c in candidates if len(c) < length}
        names = [channel.name for channel in channels]
        self.columns = unique(
            [c.name if names.count(c.name) == 1 else f"{c.group_name}/{c.name}" for c in channels]
        )
        self._places = {name: (c.group_name, c.name) for name, c in zip(self.columns, channels, strict=True)}
        self.n_row = length
        of_name = dict(zip(self.columns, channels, strict=True))
        self.units = {name: unit for name, channel in of_name.items() if (unit := _unit(channel))}
        self.sensitivities = {name: text for name, c in of_name.items() if (text := _sensitivity(c))}
        self.sample_rate = _rate(channels, self.path)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], scaled, a column beside the other. DataError
        when the file is damaged.
        """
        for rows in self._rows(columns):
            yield rows.T

    def column_chunks(self, columns: Sequence[str]) -> Iterator[list[FloatArray]]:
        """The same, column by column (n,) [unit of the file]."""
        return map(list, self._rows(columns))

    def _rows(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """The same, columns as rows (n_column, n). Every chunk of the file is read once, with all channels in
        it.
        """
        places = [self._places[column] for column in columns]
        parts: list[list[FloatArray]] = [[] for _ in places]
        waiting, done = np.zeros(len(places), int), 0
        with reading(self.path, "TDMS file"), self.path.open("rb") as stream, TdmsFile.open(stream) as file:
            for chunk in file.data_chunks():
                for n, (group, name) in enumerate(places):
                    parts[n].append(chunk[group][name][:])
                    waiting[n] += parts[n][-1].size
                whole = int(waiting.min()) // CHUNK_ROWS * CHUNK_ROWS
                if whole:
                    values = [np.concatenate(pieces) for pieces in parts]
                    yield from _blocks(values, whole)
                    parts = [[column[whole:]] for column in values]
                    waiting, done = waiting - whole, done + whole
            if np.any(done + waiting != self.n_row):
                raise EOFError("cut off")
            yield from _blocks([np.concatenate(pieces) for pieces in parts], self.n_row - done)


def growing_rows(
    path: Path, columns: Sequence[str], first: int, most: int
) -> tuple[FloatArray, float | None]:
    """At most *most* rows (n, n_column) [unit of the file] from row *first* on of a file that is being
    written, as far as they are whole, and its rate [Hz]. DataError for a column that is not there.
    """
    log_manager.set_level(logging.ERROR)
    try:
        with path.open("rb") as stream, TdmsFile.open(stream) as file:
            listed = [c for group in file.groups() for c in group.channels()]
            names = [c.name for c in listed]
            channels = {f"{c.group_name}/{c.name}": c for c in listed}
            channels |= {c.name: c for c in listed if names.count(c.name) == 1}
            check_names(path, columns, list(channels))
            chosen = [channels[name] for name in columns]
            last = min(first + most, *(len(channel) for channel in chosen))
            rows = [np.asarray(channel[first:last], float) for channel in chosen]
            return np.array(rows).reshape(len(columns), -1).T, _rate(chosen, path)
    except DataError:
        raise
    except Exception:
        return np.empty((0, len(columns))), None


def _blocks(columns: Sequence[FloatArray], n_row: int) -> Iterator[FloatArray]:
    for start in range(0, n_row, CHUNK_ROWS):
        yield np.array([column[start : min(start + CHUNK_ROWS, n_row)] for column in columns], float)


def _unit(channel: Any) -> str:
    return next((str(channel.properties[key]) for key in _UNITS if channel.properties.get(key)), "")


def _sensitivity(channel: Any) -> str:
    """The sensitivity that a property states ("100 mV/g"), or a number and its unit in two; '' for none."""
    properties = {str(key).lower(): str(value) for key, value in channel.properties.items()}
    text = next((properties[key] for key in _SENSITIVITIES if properties.get(key)), "")
    unit = next((properties[key] for key in _SENSITIVITY_UNITS if properties.get(key)), "")
    return f"{text} {unit}".strip()


def _rate(channels: list[Any], path: Path) -> float | None:
    waveforms = [channel.properties for channel in channels if channel.properties.get("wf_increment")]
    # Of a spectrum the step is one of frequency.
    if not waveforms or any(waveform.get("wf_xunit_string") == "Hz" for waveform in waveforms):
        return None
    steps = [float(waveform["wf_increment"]) for waveform in waveforms]
    low, high = min(steps), max(steps)
    if low <= 0 or high > low * (1 + _SAME):
        what = f"its channels have time steps from {low:g} s to {high:g} s"
        raise DataError(what, path, "one rate is required")
    # A channel that does not say when it begins is taken to begin with the others.
    times = [np.datetime64(w["wf_start_time"]) for w in waveforms if "wf_start_time" in w]
    apart = np.ptp([float(w.get("wf_start_offset") or 0) for w in waveforms])
    apart += (max(times) - min(times)) / np.timedelta64(1, "s") if times else 0.0
    if apart > BESIDE * low:
        what = f"its channels begin up to {apart:g} s apart (wf_start_time, wf_start_offset)"
        raise DataError(what, path, "export channels that begin together")
    rate = 1 / low
    return float(round(rate)) if abs(round(rate) / rate - 1) < _SAME else rate

"""inspect: a file as it lies on disk -> its overview: what it says of itself, levels, envelope, spectrum,
what is wrong with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.measured_files import DECAY_SUFFIX, SPECTRA_SUFFIX, read_decays, read_spectra
from labpipe.artefacts.recording_file import StoredRecording, open_recording
from labpipe.errors import DataError, locate_errors
from labpipe.project.first_guess import step_of
from labpipe.project.ingest import TIME_NAMES, contradictions, is_recording, named_times
from labpipe.project.ready_response import is_response, load_response
from labpipe.project.report import write_document
from labpipe.raw_files.first_look import EnvelopeTrack, SpectrumTrack
from labpipe.raw_files.screening import ChannelScreen, TimeAxisScreen
from labpipe.raw_files.table import guard, open_table
from labpipe.raw_files.text_table import plain_suffix
from labpipe.raw_files.uff import UFF_SUFFIXES, FileShapes, read_shapes_uff
from labpipe.records.recording import ChannelOverview, Overview
from labpipe.records.response import FrequencyResponse
from labpipe.records.rig import Rig, time_scale
from labpipe.records.spectra import ChannelSpectra, FreeDecays

BLOCK = 1 << 16


def inspect(file: Path, rig: Rig | None = None) -> Overview | FrequencyResponse | ChannelSpectra | FileShapes:
    """The overview of a recording, free decays or a raw file, or the response, spectra or mode shapes of a
    file, read once in blocks; DataError for one that cannot be read.
    """
    if not file.is_file():
        return _table_overview(file, rig)
    if plain_suffix(file) in UFF_SUFFIXES and (shapes := guard(read_shapes_uff, file)) is not None:
        return shapes
    if is_response(file):
        return load_response(file)
    if file.name.endswith(SPECTRA_SUFFIX):
        return read_spectra(file)
    if file.name.endswith(DECAY_SUFFIX):
        return _decays_overview(read_decays(file), file.name)
    return _recording_overview(open_recording(file)) if is_recording(file) else _table_overview(file, rig)


def write_card(
    content: Overview | FrequencyResponse | ChannelSpectra | FileShapes, file: str, path: Path
) -> None:
    """The card of a file as a document, by the ending of *path* (.html, .pdf, .md). DataError for shapes,
    which have none.
    """
    if isinstance(content, FileShapes):
        raise DataError("holds mode shapes alone, which have no card", file, "leave -o out")
    from labpipe.report.card import recording_card, response_card, spectra_card

    if isinstance(content, ChannelSpectra):
        document = spectra_card(content, file)
    elif isinstance(content, FrequencyResponse):
        document = response_card(content, file)
    else:
        document = recording_card(content)
    write_document(document, path)


class _Look:
    def __init__(self, names: Sequence[str]) -> None:
        self.screen = ChannelScreen(names)
        self._names = tuple(names)
        self._envelopes, self._spectra = EnvelopeTrack(len(names)), SpectrumTrack(len(names))

    def add(self, block: FloatArray) -> None:
        self.screen.add(block)
        self._envelopes.add(block)
        self._spectra.add(block)

    def channels(
        self, units: Sequence[str], about: Sequence[str], sample_rate: float | None
    ) -> tuple[ChannelOverview, ...]:
        screen = self.screen
        levels = np.column_stack([screen.minimum, screen.maximum, screen.mean, screen.rms]).tolist()
        tracks = zip(self._envelopes.envelopes(), self._spectra.spectra(sample_rate), strict=True)
        rows = zip(self._names, units, about, levels, tracks, strict=True)
        parts = ("minimum", "maximum", "mean", "rms", "envelope", "spectrum")
        return tuple(
            ChannelOverview(name, unit, role, **dict(zip(parts, (*of_channel, *track), strict=True)))
            for name, unit, role, of_channel, track in rows
        )


def _recording_overview(recording: StoredRecording) -> Overview:
    look = _Look([channel.name for channel in recording.channels])
    for block in recording.blocks(BLOCK):
        look.add(block)
    rate = recording.sample_rate
    rate_text = f"{rate:g} Hz, {recording.n_sample / rate:g} s"
    about = [f"{channel.role} {channel.dof}" for channel in recording.channels]
    channels = look.channels([channel.unit for channel in recording.channels], about, rate)
    return Overview(
        recording.name,
        "calibrated recording",
        n_sample=recording.n_sample,
        sample_rate=rate,
        rate=rate_text,
        channels=channels,
        findings=recording.findings,
    )


def _decays_overview(decays: FreeDecays, file: str) -> Overview:
    look = _Look([port.label for port in decays.outputs])
    for decay in decays.decays:
        look.add(decay.samples)
    lengths = [decay.samples.shape[0] / decays.sample_rate for decay in decays.decays]
    number = f"{len(lengths)} decay(s) of {min(lengths):.4g} s"
    number += f" to {max(lengths):.4g} s" if len(lengths) > 1 else ""
    return Overview(
        file,
        "free decays",
        n_sample=sum(decay.samples.shape[0] for decay in decays.decays),
        sample_rate=decays.sample_rate,
        rate=f"{decays.sample_rate:g} Hz, {number}",
        channels=look.channels(
            decays.units, [f"output {port.dof}" for port in decays.outputs], decays.sample_rate
        ),
        findings=decays.findings,
    )


def _table_overview(file: Path, rig: Rig | None) -> Overview:
    table = open_table(file)
    names = list(dict.fromkeys(table.columns))
    frequencies = [name for name in names if table.units.get(name) == "Hz"]
    times = named_times(table)
    if not times and table.sample_rate is None and names[0] not in frequencies and len(names) > 1:
        # A first column of even steps is the time, whatever it is called, as for `init`.
        times = [names[0]] if step_of(next(iter(table.chunks(names[:1])))[:, 0]) else []
    look, time = _Look(names), TimeAxisScreen(times[0]) if times else None
    rate, rate_text = table.sample_rate, "no time column; the rig file gives the rate"
    if any(name.lower() in TIME_NAMES for name in frequencies):
        rate_text = f"a spectrum: '{frequencies[0]}' is a frequency in Hz, no time"
    with locate_errors(file):
        for chunk in table.chunks(names):
            look.add(chunk)
            if time is not None:
                time.add(chunk[:, names.index(times[0])])
        if rate is not None:
            rate_text = f"{rate:g} Hz"
        elif time is not None:
            per_unit = time.sample_rate()
            rate_text = f"{per_unit:g} samples per unit of '{times[0]}'"
            with suppress(DataError):
                rate = per_unit / time_scale(times[0], table.units)
                # A time without a unit is taken for seconds, and not said to be.
                if table.units.get(times[0]) or times[0].rstrip().endswith(("]", ")")):
                    rate_text = f"{rate:g} Hz by '{times[0]}'"
    if rate is None and rig is not None:
        rate = rig.sample_rate
    units = [table.units.get(name, "") for name in names]
    channels = look.channels(units, [_role(name, rig) for name in names], rate)
    against = None if rig is None else tuple(map(str, contradictions(table, rig)))
    return Overview(
        file.name,
        "raw file",
        n_sample=look.screen.n_sample,
        sample_rate=rate,
        rate=rate_text,
        channels=channels,
        findings=look.screen.findings(),
        time=times[0] if times else "",
        contradictions=against,
    )


def _role(column: str, rig: Rig | None) -> str:
    of_rig = () if rig is None else rig.channels
    channels = [channel.channel for channel in of_rig if channel.column == column]
    return ", ".join(f"{channel.name}: {channel.role} {channel.dof}" for channel in channels)

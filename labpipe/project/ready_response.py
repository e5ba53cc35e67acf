"""Ready responses: labpipe's own files and those of other programs, by path or entry of ``frfs:``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from labpipe.artefacts.measured_files import RESPONSE_SUFFIX, read_response
from labpipe.errors import DataError
from labpipe.project.guessed_frfs import guessed_frf
from labpipe.project.tests import ReadyFrf
from labpipe.raw_files.frf_csv import FREQUENCY, port_of
from labpipe.raw_files.frf_described import Dofs, read_described
from labpipe.raw_files.mat import holds_response
from labpipe.raw_files.table import TEXT_SUFFIXES, guard, open_table, readable
from labpipe.raw_files.text_table import plain_suffix
from labpipe.raw_files.uff import TIME, UFF_SUFFIXES, read_uff
from labpipe.raw_files.uff_read import read_frf_uff
from labpipe.records.frf_layout import FrfLayout
from labpipe.records.response import BlockCovariance, Blocks, FrequencyResponse, Port
from labpipe.registry import Registry
from labpipe.spectra.damping import remove_window_damping
from labpipe.spectra.ports import join
from labpipe.spectra.quality import leaking_peaks
from labpipe.spectra.windows import (
    WINDOW_SAMPLES,
    amplitude_correlation,
    effective_averages,
    line_correlation,
    window_values,
)

MATRIX_SUFFIXES = (".mat", ".h5", ".hdf5", ".hdf")
FRF_READERS = Registry("frf-reader")
# Share of the distance of lines by which a written frequency may be off its line: few digits, and no more.
OFF_LINE = 0.1
# Blocks of random data whose number is not stated: so many that one more changes nothing.
MANY_BLOCKS = 100
# Independent averages below which a coherence says nothing of the noise.
LEAST_AVERAGES = 2


def read_frf_file(path: Path, name: str = "") -> FrequencyResponse:
    """The response of a file by its suffix; DataError for an unknown kind of file."""
    suffix = plain_suffix(path)
    if suffix not in FRF_READERS.names():
        suffixes = ", ".join((*FRF_READERS.names(), ".frf.parquet"))
        raise DataError(f"FRF files with the ending '{suffix}' cannot be read", path, f"known: {suffixes}")
    response: FrequencyResponse = guard(FRF_READERS.load(suffix), path, name)
    return response


def is_response(path: Path) -> bool:
    """Whether a file holds FRFs and no recording: labpipe's own, or another program's."""
    if not path.is_file():
        return False
    suffix = plain_suffix(path)
    with readable(path):
        if suffix in MATRIX_SUFFIXES:
            return holds_response(path)
        if suffix in UFF_SUFFIXES:
            return all(record.function != TIME for record in read_uff(path))
    return path.name.endswith(RESPONSE_SUFFIX) or (
        suffix in TEXT_SUFFIXES and FREQUENCY in open_table(path).columns
    )


def load_response(path: Path, name: str = "", conditions: dict[str, str] | None = None) -> FrequencyResponse:
    """A ready response of any program; *name*, *conditions*: of its test, in place of its own."""
    response = _check(_read(path))
    return response.rename(name or response.name, conditions or response.conditions)


def _check(response: FrequencyResponse) -> FrequencyResponse:
    return response if response.blocks else response.with_findings(leaking_peaks(response))


def _read(path: Path) -> FrequencyResponse:
    if path.is_dir():
        raise DataError("is a folder, a file is needed", path)
    if not path.exists():
        raise DataError("no such file", path)
    try:
        return read_response(path) if path.suffix == ".parquet" else read_frf_file(path)
    except DataError as error:
        error.where = error.where or str(path)
        if error.what.startswith(OWN_LAYOUT):
            error.hint = _other_layouts(path, error.hint)
        raise


# How a fault begins of a file that is not laid out as labpipe writes FRFs.
OWN_LAYOUT = ("lacks the variable", f"no column '{FREQUENCY}'", "no columns 'output/input")


def _other_layouts(path: Path, hint: str | None) -> str:
    try:
        guessed = guessed_frf(path)
    except DataError:
        guessed = None
    if guessed is not None:
        listed = ", ".join(f"{kind}: {name}" for kind, name in guessed.columns.items())
        return (
            f"tried as well: {guessed.word} {{{listed}}} look like an FRF; describe them in the entry, as "
            "`labpipe init DIR FILE` writes it"
        )
    missed = "a frequency and complex numbers, or amplitude and phase, were not found by names or numbers"
    recording = "time data belong under recordings:"
    return "; ".join(filter(None, (hint, f"tried as well, a table of another program: {missed}", recording)))


def load_described(
    frf: ReadyFrf, layout: FrfLayout, name: str, conditions: dict[str, str]
) -> FrequencyResponse:
    """The ready response of a test, joined where it lies in several files; DataError names file and line."""

    def load(numbered: bool = False) -> list[FrequencyResponse]:
        return [
            replace(_load_file(path, layout, Dofs(outputs, inputs), numbered), name=path.name)
            for path, outputs, inputs in zip(frf.paths, frf.outputs, frf.inputs, strict=True)
        ]

    try:
        response = join(load()) if layout.each else load()[0]
    except DataError:
        # A universal file of one point says x, one of several 1.x.
        if not layout.each or any(plain_suffix(path) not in UFF_SUFFIXES for path in frf.paths):
            raise
        response = join(load(numbered=True))
    if layout.excitation:
        response = _state_random_blocks(response, layout, frf.paths[0])
    elif layout.averages:
        response = _with_noise(response, layout.averages, frf.paths[0])
    if layout.windowed is not None:
        response = remove_window_damping(response, layout.windowed.exponential)
    if layout.window and not response.line_correlation:
        response = replace(response, line_correlation=amplitude_correlation(layout.window))
    return replace(_check(response), name=name, conditions=conditions or response.conditions)


def _with_noise(response: FrequencyResponse, averages: float, path: Path) -> FrequencyResponse:
    """E|dH|^2 = |H|^2 (1 / coherence - 1) / (averages - 1) of every element alone, of an H1 under one force
    at a time (Bendat and Piersol 2010, Random Data, 9.2); averages less one, since the same data tell it.
    """
    if response.coherence is None or response.stored_covariance is not None:
        has = "no coherence" if response.coherence is None else "its covariance"
        raise DataError(f"holds {has}, so 'averages' tells nothing", path, "leave `averages` out")
    if not np.all(response.coherence > 0):
        raise DataError("holds a coherence of zero: its noise has no bound", path, "leave `averages` out")
    if np.all(response.coherence == 1):
        what = "holds a coherence of 1 at all lines, so 'averages' tells nothing"
        raise DataError(what, path, "export it with more digits, or leave `averages` out")
    variance = np.abs(response.matrix) ** 2 * (1 / response.coherence - 1) / (averages - 1)
    held = BlockCovariance.from_variance(variance)
    return replace(response, covariance=held, covariance_dof=averages - 1, averages=averages)


def _state_random_blocks(response: FrequencyResponse, layout: FrfLayout, path: Path) -> FrequencyResponse:
    """An H1 of random data in blocks of one over the distance of its lines, with what these leave in it."""
    if response.blocks is not None:
        raise DataError("says itself what its blocks were", path, "leave `excitation` out")
    if response.n_frequency < 2:
        raise DataError("has one line, which tells no length of blocks", path, "leave `excitation` out")
    steps = np.diff(response.frequency)
    # Over all lines, since each is written with few digits.
    spacing = float(np.sum(steps) / np.sum(np.round(steps / np.median(steps))))
    numbers = response.frequency / spacing
    if np.any(np.abs(numbers - np.round(numbers)) > OFF_LINE):
        what = "has lines that are not multiples of their distance, as those of whole blocks are"
        raise DataError(what, path, "export all lines as they were measured, or leave `excitation` out")
    window, number = window_values(layout.window, WINDOW_SAMPLES), layout.averages or MANY_BLOCKS
    step = max(1, round(window.size * (1 - layout.overlap)))
    if layout.averages:
        averages = effective_averages(window, step, number)
        if averages < LEAST_AVERAGES:
            what = f"is of {averages:.2g} independent averages by its `averages` and `overlap`"
            raise DataError(what, path, f"{LEAST_AVERAGES} or more tell the noise; leave `averages` out")
        response = _with_noise(response, averages, path)
    blocks = Blocks(1 / spacing, layout.window, layout.overlap, number, "H1")
    return replace(response, blocks=blocks, line_correlation=line_correlation(window, step, number))


def _load_file(path: Path, layout: FrfLayout, dofs: Dofs, numbered: bool) -> FrequencyResponse:
    if layout.table is not None:
        return guard(read_described, path, layout, dofs)
    if layout.unit or layout.form or numbered:
        form = (layout.form, None) if layout.form else None
        response = guard(read_frf_uff, path, "", layout.scale if layout.unit else form, numbered)
    else:
        response = _read(path)
    return replace(
        response,
        outputs=_rename(response.outputs, dofs.outputs, "outputs", path),
        inputs=_rename(response.inputs, dofs.inputs, "inputs", path),
    )


def _rename(ports: tuple[Port, ...], dofs: tuple[str, ...], word: str, path: Path) -> tuple[Port, ...]:
    if dofs and len(dofs) != len(ports):
        raise DataError(f"has {len(ports)} {word}, {len(dofs)} are named ({', '.join(dofs)})", path)
    return tuple(map(port_of, dofs)) or ports

"""``*.frf.parquet``, ``*.spectra.parquet``, ``*.decay.parquet``: what a test was measured as, with its
covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, freeze_bases
from labpipe.artefacts.header import Header
from labpipe.artefacts.json_file import entry_of, named_entries, record_of, values_of
from labpipe.artefacts.parquet import check_layout, numpy_array, read_columns, read_header, write_columns
from labpipe.artefacts.recording_file import channel_entries
from labpipe.records.response import BlockCovariance, FrequencyResponse, StoredCovariance
from labpipe.records.spectra import ChannelSpectra, FreeDecay, FreeDecays
from labpipe.records.uncertain import MatrixError, Uncertainty

RESPONSE_SUFFIX = ".frf.parquet"
Columns = dict[str, FloatArray]
Measured = TypeVar("Measured")
PARTS = ("re", "im")
# Fields of a response that stand in the header as they are.
_STATED = (
    "form", "outputs", "inputs", "averages", "covariance_dof", "snr_channels", "name", "conditions"
)  # fmt: skip
_COMPLEX = ("change", "open_loop")
_BY_REPEAT = ("repeat_levels", "repeat_shares")
_BY_ELEMENT = {"coherence": ":coh", "partial_coherence": ":partial_coh", "distortion": ":distortion"}


def write_response(path: Path, response: FrequencyResponse, header: Header) -> None:
    """Write the response; *header* gets its contents and findings from the response."""
    columns: Columns = {"frequency_hz": response.frequency}
    for o, output in enumerate(response.outputs):
        for i, port in enumerate(response.inputs):
            pair = f"{output.label}/{port.label}"
            columns |= {pair + suffix: values for suffix, values in _element(response, o, i)}
        if response.multiple_coherence is not None:
            columns[f"{output.label}:multiple_coh"] = response.multiple_coherence[:, o]
    for p, q in _stored_pairs(response.stored_covariance):
        columns |= _parts(f"cov:{p}:{q}:", response.covariance_of(p, q))
    if response.snr is not None:
        columns.update({f"{name}:snr": response.snr[:, n] for n, name in enumerate(response.snr_channels)})
    header = replace(header, contents=_contents(response), findings=response.findings)
    write_columns(path, columns, header)


def _element(response: FrequencyResponse, o: int, i: int) -> Iterator[tuple[str, FloatArray]]:
    yield from _parts(":", response.matrix[:, o, i]).items()
    for attribute, suffix in _BY_ELEMENT.items():
        values = getattr(response, attribute)
        if values is not None:
            yield suffix, values[:, o, i]
    for number, error in enumerate(response.errors):
        yield from _parts(f":error:{number}:", error.change[:, o, i]).items()
        for power, part in enumerate(error.parts):
            yield from _parts(f":error_{power}:{number}:", part[:, o, i]).items()
    for attribute in _COMPLEX:
        beside = getattr(response, attribute)
        if beside is not None:
            yield from _parts(f":{attribute}_", beside[:, o, i]).items()
    for number, repeat in enumerate(() if response.repeats is None else response.repeats):
        yield from _parts(f":repeat:{number}:", repeat[:, o, i]).items()
    if response.line_gains is not None:
        for neighbour, gains in enumerate(response.line_gains[:, :, o, i].T):
            yield from _parts(f":gain:{neighbour}:", gains).items()


def _upper(n: int) -> Iterator[tuple[int, int]]:
    return ((p, q) for p in range(n) for q in range(p, n))


def _stored_pairs(covariance: StoredCovariance) -> Iterator[tuple[int, int]]:
    """The pairs of elements whose covariance is written: those of one block where it lies in blocks, all
    otherwise.
    """
    if covariance is None:
        return iter(())
    if isinstance(covariance, BlockCovariance):
        return (
            (int(members[j]), int(members[k]))
            for members in covariance.elements
            for j, k in _upper(members.size)
        )
    return _upper(covariance.shape[1])


def _contents(response: FrequencyResponse) -> dict[str, Any]:
    dof, stored = response.covariance_dof, response.stored_covariance
    repeats: dict[str, Any] = {}
    if response.repeat_names:
        there = (name for name in _BY_REPEAT if getattr(response, name) is not None)
        repeats = {"repeats": list(response.repeat_names), **named_entries(response, "repeats_are", *there)}
    by_repeat = [error.by_repeat for error in response.errors]
    n_part = [len(error.parts) for error in response.errors]
    return {
        **named_entries(response, "name", "form", "outputs", "inputs"),
        "averages": float(response.averages),
        "covariance_dof": None if math.isinf(dof) else float(dof),
        # A number where it is real, as files have always had it; real and imaginary part of a complex one.
        "line_correlation": [c.real if c.imag == 0 else [c.real, c.imag] for c in response.line_correlation],
        "line_gains": 0 if response.line_gains is None else response.line_gains.shape[1],
        **({"covariance_blocks": stored.elements.tolist()} if isinstance(stored, BlockCovariance) else {}),
        **named_entries(response, "blocks", "snr_channels"),
        "errors": [entry_of(error.uncertainty) for error in response.errors],
        **({"errors_by_repeat": by_repeat} if any(by_repeat) else {}),
        **({"error_parts": n_part} if any(n_part) else {}),
        **repeats,
        "conditions": response.conditions,
    }


def read_response(path: Path) -> FrequencyResponse:
    """The response of a ``*.frf.parquet`` file; DataError when the file is not one."""
    return _read(path, "frf", _response_of)


def _read(path: Path, kind: str, make: Callable[[Header, Columns], Measured]) -> Measured:
    header, table = read_header(path, kind), read_columns(path)
    columns = {name: numpy_array(table.column(name)) for name in table.column_names}
    with check_layout(path):
        return make(header, columns)


def _response_of(header: Header, columns: Columns) -> FrequencyResponse:
    contents = header.contents
    given = _header_values(contents, FrequencyResponse, _STATED, "blocks", "repeats_are", *_BY_REPEAT)
    outputs, inputs, snr_channels = given["outputs"], given["inputs"], given["snr_channels"]
    pairs = [[f"{o.label}/{i.label}" for i in inputs] for o in outputs]
    given |= {
        name: _matrix(columns, pairs, suffix)
        for name, suffix in _BY_ELEMENT.items()
        if pairs[0][0] + suffix in columns
    }
    given |= {
        name: _complex_matrix(columns, pairs, f":{name}_")
        for name in _COMPLEX
        if f"{pairs[0][0]}:{name}_re" in columns
    }
    has_multiple = f"{outputs[0].label}:multiple_coh" in columns
    n_gain, n_repeat = contents.get("line_gains", 0), len(contents.get("repeats", ()))
    return FrequencyResponse(
        frequency=columns["frequency_hz"],
        matrix=_complex_matrix(columns, pairs, ":"),
        **given,
        covariance=_covariance(columns, len(outputs) * len(inputs), contents.get("covariance_blocks")),
        multiple_coherence=np.stack([columns[f"{o.label}:multiple_coh"] for o in outputs], 1)
        if has_multiple
        else None,
        snr=np.stack([columns[f"{name}:snr"] for name in snr_channels], 1) if snr_channels else None,
        line_correlation=tuple(
            complex(*c) if isinstance(c, list) else c for c in contents.get("line_correlation", ())
        ),
        line_gains=np.stack(_numbered_matrices(columns, pairs, "gain", n_gain), 1) if n_gain else None,
        errors=tuple(_errors(contents, columns, pairs)),
        repeats=np.stack(_numbered_matrices(columns, pairs, "repeat", n_repeat)) if n_repeat else None,
        repeat_names=tuple(contents.get("repeats", ())),
        findings=header.findings,
    )


def _header_values(
    contents: dict[str, Any], kind: type, names: Sequence[str], *others: str
) -> dict[str, Any]:
    """The values of the fields of *names*, which must be there, and of *others* that are."""
    entries = {name: contents[name] for name in names} | {n: contents[n] for n in others if n in contents}
    return values_of(entries, kind)


def _matrix(columns: Columns, pairs: list[list[str]], suffix: str) -> FloatArray:
    return np.stack([np.stack([columns[pair + suffix] for pair in row], -1) for row in pairs], 1)


def _complex_matrix(columns: Columns, pairs: list[list[str]], suffix: str) -> ComplexArray:
    return _join(*(_matrix(columns, pairs, suffix + part) for part in PARTS))


def _errors(contents: Mapping[str, Any], columns: Columns, pairs: list[list[str]]) -> Iterator[MatrixError]:
    entries = contents.get("errors", [])
    changes = _numbered_matrices(columns, pairs, "error", len(entries))
    by_repeat = contents.get("errors_by_repeat", [False] * len(entries))
    n_part = contents.get("error_parts", [0] * len(entries))
    for number, entry in enumerate(entries):
        names = [f":error_{power}:{number}:" for power in range(n_part[number])]
        parts = tuple(_complex_matrix(columns, pairs, name) for name in names)
        yield MatrixError(record_of(entry, Uncertainty), changes[number], by_repeat[number], parts)


def _numbered_matrices(columns: Columns, pairs: list[list[str]], name: str, count: int) -> list[ComplexArray]:
    """The complex matrices (n_line, n_output, n_input) whose columns end in the *name* and a number."""
    return [_complex_matrix(columns, pairs, f":{name}:{number}:") for number in range(count)]


def _values(columns: Columns, name: str) -> ComplexArray:
    return _join(*(columns[f"{name}:{part}"] for part in PARTS))


def _join(real: FloatArray, imaginary: FloatArray) -> ComplexArray:
    values = np.empty(real.shape, np.complex128)
    # A sum re + 1j im would lose the sign of a zero.
    values.real, values.imag = real, imaginary
    return values


def _covariance(columns: Columns, n: int, elements: list[list[int]] | None) -> StoredCovariance:
    """The Hermitian covariance from its stored upper triangle, or from those of its blocks of *elements*."""
    if "cov:0:0:re" not in columns:
        return None
    n_line = columns["frequency_hz"].size
    members = np.array(elements or [list(range(n))], np.intp)
    blocks = np.empty((n_line, *members.shape, members.shape[1]), np.complex128)
    for number, block in enumerate(members):
        for j, k in _upper(block.size):
            blocks[:, number, j, k] = _values(columns, f"cov:{block[j]}:{block[k]}")
            blocks[:, number, k, j] = blocks[:, number, j, k].conj()
    return BlockCovariance(members, freeze_bases(blocks)) if elements else blocks[:, 0]


# ``*.spectra.parquet``: the spectra of all channels of one test, a row per line, with their covariance.

SPECTRA_SUFFIX = ".spectra.parquet"


def write_spectra(path: Path, spectra: ChannelSpectra, header: Header) -> None:
    """Write the spectra: per run (numbered from 1) and channel real and imaginary part [SI], and the
    covariance of every run.
    """
    columns: Columns = {"frequency_hz": spectra.frequency}
    for run in range(len(spectra.runs)):
        for number, channel in enumerate(spectra.channels):
            columns |= _parts(f"{run + 1}/{channel.name}:", spectra.vectors[:, run, number])
        for p, q in _upper(len(spectra.channels)):
            columns |= _parts(f"cov:{run + 1}:{p}:{q}:", spectra.covariance[:, run, p, q])
    header = replace(header, contents=_spectra_contents(spectra), findings=spectra.findings)
    write_columns(path, columns, header)


def _parts(name: str, values: ComplexArray) -> Columns:
    return {f"{name}{part}": numbers for part, numbers in zip(PARTS, (values.real, values.imag), strict=True)}


def _spectra_contents(spectra: ChannelSpectra) -> dict[str, Any]:
    dof = spectra.covariance_dof
    return {
        "name": spectra.name,
        "channels": channel_entries(spectra.channels),
        "runs": list(spectra.runs),
        "covariance_dof": None if math.isinf(dof) else float(dof),
        "line_correlation": [[value.real, value.imag] for value in spectra.line_correlation],
        **named_entries(spectra, "blocks", "factors"),
        "conditions": spectra.conditions,
    }


def read_spectra(path: Path) -> ChannelSpectra:
    """The spectra of a ``*.spectra.parquet`` file; DataError when the file is not one."""
    return _read(path, "spectra", _spectra_of)


def _spectra_of(header: Header, columns: Columns) -> ChannelSpectra:
    contents, frequency = header.contents, columns["frequency_hz"]
    names = ("channels", "runs", "covariance_dof", "factors", "name", "conditions")
    given = _header_values(contents, ChannelSpectra, names, "blocks")
    channels, runs = given["channels"], given["runs"]
    n = len(channels)
    vectors = np.empty((frequency.size, len(runs), n), np.complex128)
    covariance = np.empty((frequency.size, len(runs), n, n), np.complex128)
    for run in range(len(runs)):
        for number, channel in enumerate(channels):
            vectors[:, run, number] = _values(columns, f"{run + 1}/{channel.name}")
        for p, q in _upper(n):
            covariance[:, run, p, q] = _values(columns, f"cov:{run + 1}:{p}:{q}")
            covariance[:, run, q, p] = covariance[:, run, p, q].conj()
    return ChannelSpectra(
        frequency=frequency,
        vectors=vectors,
        covariance=covariance,
        **given,
        line_correlation=tuple(complex(*value) for value in contents["line_correlation"]),
        findings=header.findings,
    )


DECAY_SUFFIX = ".decay.parquet"


def write_decays(path: Path, decays: FreeDecays, header: Header) -> None:
    """Write the decays: a column of numbers of decays, one of times [s] in the recording, one of every output
    [SI].
    """
    numbers = np.repeat(np.arange(len(decays.decays)), [decay.samples.shape[0] for decay in decays.decays])
    times = [decay.start + np.arange(decay.samples.shape[0]) / decays.sample_rate for decay in decays.decays]
    samples = np.concatenate([decay.samples for decay in decays.decays])
    columns = {"decay": numbers, "time_s": np.concatenate(times)}
    columns.update({f"output:{port.label}": samples[:, number] for number, port in enumerate(decays.outputs)})
    contents = {
        **named_entries(decays, "name", "sample_rate", "outputs", "units"),
        "recordings": [decay.recording for decay in decays.decays],
        "starts": [decay.start for decay in decays.decays],
        "conditions": decays.conditions,
    }
    write_columns(path, columns, replace(header, contents=contents, findings=decays.findings))


def read_decays(path: Path) -> FreeDecays:
    """The decays of a ``*.decay.parquet`` file; DataError when the file is not one."""
    return _read(path, "decay", _decay_of)


def _decay_of(header: Header, columns: Columns) -> FreeDecays:
    contents = header.contents
    given = _header_values(contents, FreeDecays, ("name", "sample_rate", "outputs", "units", "conditions"))
    samples = np.column_stack([columns[f"output:{port.label}"] for port in given["outputs"]])
    named = zip(contents["recordings"], contents["starts"], strict=True)
    decays = tuple(
        FreeDecay(recording, start, samples[columns["decay"] == number])
        for number, (recording, start) in enumerate(named)
    )
    return FreeDecays(**given, decays=decays, findings=header.findings)

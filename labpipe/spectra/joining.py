"""Responses measured one after the other as one FRF matrix."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.errors import DataError
from labpipe.records.doubt import MatrixError
from labpipe.records.response import FrequencyResponse, Port

# Relative tolerance between the frequency axes, which files print with six digits.
SAME_AXIS = 1e-5
# What a response has for each element beside H.
QUALITIES = ("coherence", "partial_coherence", "distortion", "change", "open_loop", "line_gains")


def joined(responses: Sequence[FrequencyResponse]) -> FrequencyResponse:
    """One matrix (n_frequency, n_output, n_input) [unit of the form] of elements, rows or columns that lie in several responses.

    Rows and columns are in the order of the numbers in their labels. Coherences and covariances stay where all responses have them; the
    noise of different responses is independent. DataError, with the names of the responses, for an element that is missing or there
    twice, for frequencies or forms that differ.
    """
    first = responses[0]
    for response in responses[1:]:
        _check_alike(response, first)
    outputs = _ports([port for response in responses for port in response.outputs])
    inputs = _ports([port for response in responses for port in response.inputs])
    rows, columns = ({port.label: number for number, port in enumerate(ports)} for ports in (outputs, inputs))
    _check_complete(responses, rows, columns)
    whole = {name: _placed(responses, name, rows, columns) for name in ("matrix", *QUALITIES)}
    windows = {response.line_correlation for response in responses}
    return FrequencyResponse(
        frequency=first.frequency,
        outputs=outputs,
        inputs=inputs,
        form=first.form,
        covariance=_covariance(responses, rows, columns),
        covariance_dof=min(response.covariance_dof for response in responses),
        averages=min(response.averages for response in responses),
        line_correlation=windows.pop() if len(windows) == 1 else (),
        blocks=first.blocks if all(response.blocks == first.blocks for response in responses) else None,
        errors=_errors(responses, rows, columns),
        findings=tuple(dict.fromkeys(finding for response in responses for finding in response.findings)),
        conditions=first.conditions,
        **whole,
    )


def _placed(responses: Sequence[FrequencyResponse], name: str, rows: dict[str, int], columns: dict[str, int]) -> Any:
    """An array by output and input, its last two dimensions, of all responses; None where one has none."""
    parts = [getattr(response, name) for response in responses]
    if any(part is None for part in parts):
        return None
    whole = np.zeros((*parts[0].shape[:-2], len(rows), len(columns)), parts[0].dtype)
    for response, part in zip(responses, parts, strict=True):
        o = np.array([rows[port.label] for port in response.outputs])[:, None]
        i = np.array([columns[port.label] for port in response.inputs])
        whole[..., o, i] = part
    return whole


def _covariance(responses: Sequence[FrequencyResponse], rows: dict[str, int], columns: dict[str, int]) -> ComplexArray | None:
    """Covariance (n_frequency, n, n) [unit^2] of all elements, n = n_output n_input; None where a response has none."""
    n = len(rows) * len(columns)
    whole = np.zeros((responses[0].n_frequency, n, n), np.complex128)
    for response in responses:
        if response.covariance is None:
            return None
        place = np.array([rows[o.label] * len(columns) + columns[i.label] for o in response.outputs for i in response.inputs])
        whole[:, place[:, None], place] = response.covariance
    return whole


def _errors(responses: Sequence[FrequencyResponse], rows: dict[str, int], columns: dict[str, int]) -> tuple[MatrixError, ...]:
    """The systematic errors of all responses; one of several responses is one error in all of them."""
    doubts = {error.doubt.source: error.doubt for response in responses for error in response.errors}
    errors = []
    for source, doubt in doubts.items():
        whole = np.zeros((responses[0].n_frequency, len(rows), len(columns)), np.complex128)
        for response in responses:
            o = np.array([rows[port.label] for port in response.outputs])[:, None]
            i = np.array([columns[port.label] for port in response.inputs])
            for error in response.errors:
                if error.doubt.source == source:
                    whole[:, o, i] += error.change
        errors.append(MatrixError(doubt, whole))
    return tuple(errors)


def _check_complete(responses: Sequence[FrequencyResponse], rows: Iterable[str], columns: Iterable[str]) -> None:
    """DataError unless every element lies in one response."""
    holders: dict[tuple[str, str], str] = {}
    for response in responses:
        for output, port in itertools.product(response.outputs, response.inputs):
            pair = output.label, port.label
            if pair in holders:
                raise DataError(
                    f"{output.label}/{port.label} lies in {holders[pair]} and in {response.name}", hint="one file for each element"
                )
            holders[pair] = response.name
    missing = [f"{output}/{port}" for output, port in itertools.product(rows, columns) if (output, port) not in holders]
    if missing:
        raise DataError(f"{', '.join(missing[:5])} was not measured", hint="every output needs every input")


def _check_alike(response: FrequencyResponse, first: FrequencyResponse) -> None:
    if response.form != first.form:
        raise DataError(f"{response.name} is a {response.form}, {first.name} a {first.form}")
    if response.n_frequency != first.n_frequency:
        raise DataError(f"{response.name} has {response.n_frequency} frequencies, {first.name} has {first.n_frequency}")
    if not np.allclose(response.frequency, first.frequency, rtol=SAME_AXIS, atol=0):
        line = int(np.argmax(np.abs(response.frequency - first.frequency)))
        raise DataError(
            f"the frequencies of {response.name} differ from those of {first.name}: {response.frequency[line]:g} and "
            f"{first.frequency[line]:g} Hz at line {line + 1}"
        )


def _ports(ports: Sequence[Port]) -> tuple[Port, ...]:
    """Distinct ports, 2x before 10x."""
    distinct = {port.label: port for port in reversed(ports)}
    return tuple(distinct[label] for label in sorted(distinct, key=_natural))


def _natural(label: str) -> list[tuple[int, int, str]]:
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in re.split(r"(\d+)", label) if part]

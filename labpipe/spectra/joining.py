"""Responses measured one after the other as one FRF matrix."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.errors import DataError
from labpipe.records.response import FrequencyResponse, Port

# Relative tolerance between the frequency axes, which files print with six digits.
SAME_AXIS = 1e-5


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
    shape = (first.n_frequency, len(outputs), len(inputs))
    matrix, coherence = np.zeros(shape, np.complex128), np.zeros(shape)
    rows, columns = ({port.label: number for number, port in enumerate(ports)} for ports in (outputs, inputs))
    _check_complete(responses, rows, columns)
    for response in responses:
        o = np.array([rows[port.label] for port in response.outputs])[:, None]
        i = np.array([columns[port.label] for port in response.inputs])
        matrix[:, o, i] = response.matrix
        if response.coherence is not None:
            coherence[:, o, i] = response.coherence
    complete = all(response.coherence is not None for response in responses)
    return FrequencyResponse(
        first.frequency,
        matrix,
        outputs,
        inputs,
        form=first.form,
        coherence=coherence if complete else None,
        covariance=_covariance(responses, rows, columns),
        covariance_dof=min(response.covariance_dof for response in responses),
    )


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
        raise DataError(f"no file holds {', '.join(missing[:5])}", hint="every output needs every input")


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

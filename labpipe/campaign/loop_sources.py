"""Systematic errors of a recorded loop: what the doubts of its channels and of sums of channels do to its responses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from labpipe.identify.matrix_errors import matrix_errors
from labpipe.identify.measured import Measured
from labpipe.records.doubt import MatrixError
from labpipe.records.response import FrequencyResponse, Port


def response_errors(response: FrequencyResponse, rows: Sequence[int], columns: Sequence[int]) -> tuple[MatrixError, ...]:
    """Changes (n_line, n_output, n_input) [unit of the response] of the chosen part by one standard uncertainty of every source.

    Gain, delay and phase of the channels, and sums of channels; a direction, which another channel of the same quantity would have to
    tell, is left out.
    """
    part = np.ix_(range(response.n_frequency), rows, columns)
    return matrix_errors(
        Measured(
            omega=2 * np.pi * response.frequency,
            matrix=response.matrix[part],
            covariance=None,
            noise_dof=np.inf,
            noise_lines=1.0,
            outputs=tuple(response.outputs[row] for row in rows),
            inputs=tuple(response.inputs[column] for column in columns),
            errors=tuple(replace(error, change=error.change[part]) for error in response.errors),
        )
    )


def merged(errors: Iterable[MatrixError]) -> tuple[MatrixError, ...]:
    """The errors with those of one source added up."""
    by_source: dict[str, MatrixError] = {}
    for error in errors:
        before = by_source.get(error.doubt.source)
        by_source[error.doubt.source] = error if before is None else replace(before, change=before.change + error.change)
    return tuple(by_source.values())


def directions_left_out(ports: Iterable[Port]) -> list[str]:
    """Labels of the ports whose direction has a doubt."""
    return list(dict.fromkeys(port.label for port in ports if any(doubted.effect == "direction" for doubted in port.doubts)))

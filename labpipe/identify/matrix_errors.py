"""Systematic errors of a measured matrix: of the gain, delay and phase of its ports, and of the sums of channels among them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.identify.measured import Measured
from labpipe.records.doubt import COURSES, Doubt, MatrixError

# Errors are tried at this share of their standard uncertainty on either side, so that slopes are those at the estimate.
SHARE = 1e-3


def matrix_errors(measured: Measured) -> tuple[MatrixError, ...]:
    """dH (n_line, n_output, n_input) [m/N] by one standard uncertainty of every source; numbers of one source err together.

    An error d of an output changes its row by H a w^n d, one of a force its column by -H a w^n d, with a w^n of COURSES. Directions are
    left to the models that know them.
    """
    doubts: dict[str, Doubt] = {}
    changes: dict[str, ComplexArray] = {}

    def add(doubt: Doubt, change: ComplexArray) -> None:
        doubts.setdefault(doubt.source, doubt)
        changes[doubt.source] = changes.get(doubt.source, np.zeros_like(change)) + change

    whole = measured.plus_offset(measured.matrix)
    for ports, sign in ((measured.outputs, 1.0), (measured.inputs, -1.0)):
        for number, port in enumerate(ports):
            for doubted in port.doubts:
                if doubted.effect in COURSES:
                    slope, power = COURSES[doubted.effect]
                    change = np.zeros_like(whole)
                    at = (slice(None), number) if sign > 0 else (slice(None), slice(None), number)
                    change[at] = (sign * doubted.doubt.std_error * slope * measured.omega**power)[:, None] * whole[at]
                    add(doubted.doubt, change)
    for error in measured.errors:
        add(error.doubt, error.change)
    return tuple(MatrixError(doubts[source], change) for source, change in changes.items())


def changes_by(errors: tuple[MatrixError, ...], values: Callable[[ComplexArray], FloatArray]) -> list[tuple[Doubt, FloatArray]]:
    """Central differences (n_parameter,) [parameter units] of reported *values* of a change of the matrix [m/N], one for each error."""
    return [(one.doubt, (values(SHARE * one.change) - values(-SHARE * one.change)) / (2 * SHARE)) for one in errors]

"""Systematic errors of a measured matrix: of the gain, delay and phase of its ports, and of the sums of channels among them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.identify.measured import Measured
from labpipe.records.doubt import COURSES, Doubt, MatrixError
from labpipe.records.response import Port

# Errors are tried at this share of their standard uncertainty on either side, so that slopes are those at the estimate.
SHARE = 1e-3
# Sine of the angle between directions below which they do not tell the plane.
PARALLEL = 0.02


def matrix_errors(measured: Measured, *, directions: bool = False) -> tuple[MatrixError, ...]:
    """dH (n_line, n_output, n_input) [m/N] by one standard uncertainty of every source; numbers of one source err together.

    An error d of an output changes its row by H a w^n d, one of a force its column by -H a w^n d, with a w^n of COURSES. With *directions*
    an error d of an angle changes row or column by -d times that at right angles, where ports of known direction tell it; else
    directions are left to the models that know them. Equation (unc-port).
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
                elif directions and (across := across_ports(ports)) is not None:
                    add(doubted.doubt, doubted.doubt.std_error * turned(measured.matrix, number, across, of_forces=sign < 0))
    for error in measured.errors:
        add(error.doubt, error.change)
    return tuple(MatrixError(doubts[source], change) for source, change in changes.items())


def across_ports(ports: Sequence[Port]) -> FloatArray | None:
    """What ports see at right angles to their directions, (n_port, n_port) [1] by what all of them see; None where they do not tell.

    Rows of zeros for ports without a direction. A port at a + d sees what one at a sees, and d times that at a + 90 deg.
    Equation (unc-across).
    """
    with_angle = [number for number, port in enumerate(ports) if port.angle is not None]
    angles = np.array([ports[number].angle for number in with_angle], float)
    plane = np.column_stack([np.cos(angles), np.sin(angles)])
    if len(with_angle) < 2 or np.linalg.svd(plane, compute_uv=False)[-1] < PARALLEL:
        return None
    across = np.zeros((len(ports), len(ports)))
    across[np.ix_(with_angle, with_angle)] = np.column_stack([-np.sin(angles), np.cos(angles)]) @ np.linalg.pinv(plane)
    return across


def turned(matrix: ComplexArray, number: int, across: FloatArray, *, of_forces: bool) -> ComplexArray:
    """Change of a *matrix* (n_line, n_output, n_input) [m/N] per radian [m/N] by which the direction of one port was written too large.

    *across* (n_port, n_port) [1] of `across_ports`; of_forces: the port is a force, a column. Equation (unc-direction).
    """
    change = np.zeros_like(matrix)
    if of_forces:
        change[:, :, number] = -matrix @ across[number]
    else:
        change[:, number] = -(across[number] @ matrix)
    return change


def changes_by(errors: tuple[MatrixError, ...], values: Callable[[ComplexArray], FloatArray]) -> list[tuple[Doubt, FloatArray]]:
    """Central differences (n_parameter,) [parameter units] of reported *values* of a change of the matrix [m/N], one for each error."""
    return [(error.doubt, (values(SHARE * error.change) - values(-SHARE * error.change)) / (2 * SHARE)) for error in errors]

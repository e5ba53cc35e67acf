"""What one standard uncertainty of a port's number does to a measured matrix, against the matrix that a port
with that error gives.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.estimation.measured import Measured, across_ports, changes_by, matrix_errors
from labpipe.records.response import Port
from labpipe.records.uncertain import ChannelUncertainty, MatrixError, Uncertainty

OMEGA = np.array([10.0, 25.0, 40.0])
PLANE = np.array([[[3 + 1j, 0.5], [-0.7j, 2]], [[1, 2 - 1j], [0.3, 1j]], [[2j, 1], [1, 1]]])
OUTPUTS, FORCES = np.radians([20.0, 75.0]), np.radians([-10.0, 95.0])
OFFSET = np.array([0.2, 0.1, 0.05])


def rows(angles: np.ndarray) -> np.ndarray:
    """What ports at *angles* [rad] see of x and y, (n_port, 2)."""
    return np.column_stack([np.cos(angles), np.sin(angles)])


def seen(outputs: np.ndarray = OUTPUTS, forces: np.ndarray = FORCES) -> np.ndarray:
    """The matrix of the plane between ports at these angles."""
    return np.asarray(rows(outputs) @ PLANE @ rows(forces).T)


def measured(effect: str, std_error: float, port: str, **more: object) -> Measured:
    """The matrix, with an uncertainty of the second output or of the second force."""
    uncertainty = (ChannelUncertainty(effect, Uncertainty("number", std_error, "1")),)
    outputs = tuple(
        Port(name, name, name, a, uncertainty if port == name else ())
        for name, a in zip(("a", "b"), OUTPUTS, strict=True)
    )
    forces = tuple(
        Port(name, name, name, a, uncertainty if port == name else ())
        for name, a in zip(("f", "g"), FORCES, strict=True)
    )
    known = {
        "covariance": None,
        "noise_dof": np.inf,
        "noise_lines": 1.0,
        "outputs": outputs,
        "inputs": forces,
    }
    return Measured(omega=OMEGA, matrix=seen(), **known, **more)


@pytest.mark.parametrize(
    ("effect", "relative"), [("gain", -0.01), ("delay", 0.01j * OMEGA), ("phase", 0.01j)]
)
def test_an_output_s_error_is_on_its_row_and_a_force_s_the_other_way_on_its_column(
    effect: str, relative: complex | np.ndarray
) -> None:
    """X (1 - d), X e^{+jwd}, X e^{+jd}; a force is divided by.

    What was taken off the form is in the sensor's signal.
    """
    whole = seen() + OFFSET[:, None, None]
    for port, at, sign in (("b", (slice(None), 1), 1), ("g", (slice(None), slice(None), 1), -1)):
        (error,) = matrix_errors(measured(effect, 0.01, port, offset=OFFSET))
        expected = np.zeros_like(whole)
        expected[at] = sign * (np.ones(3) * relative)[:, None] * whole[at]
        np.testing.assert_allclose(error.change, expected, rtol=1e-12)


@pytest.mark.parametrize("port", ["b", "g"])
def test_a_direction_written_too_large_turns_its_row_or_column_back(port: str) -> None:
    """The port stands at the written angle less the error: finite differences of the matrix by that angle."""
    (error,) = matrix_errors(measured("direction", 0.01, port), directions=True)
    step = 1e-6 * np.array([0.0, 1.0])
    turned = (
        seen(OUTPUTS - step) - seen(OUTPUTS + step)
        if port == "b"
        else seen(forces=FORCES - step) - seen(forces=FORCES + step)
    )
    np.testing.assert_allclose(error.change, 0.01 * turned / 2e-6, rtol=1e-8, atol=1e-11)
    assert matrix_errors(measured("direction", 0.01, port)) == ()


def test_numbers_of_one_source_err_together() -> None:
    both = measured(
        "gain", 0.01, "b", errors=(MatrixError(Uncertainty("number", 0.01, "1"), np.ones((3, 2, 2))),)
    )
    (alone,), (error,) = matrix_errors(measured("gain", 0.01, "b")), matrix_errors(both)
    np.testing.assert_allclose(error.change, alone.change + 1, rtol=1e-15)


def test_ports_that_do_not_tell_the_plane() -> None:
    """Singular values of two directions d apart are sqrt(1 -+ cos d): 0.02 for d = 1.62 deg."""
    two = [Port("a", "a", "a", 0.3), Port("b", "b", "b", 0.3 + np.radians(1.5)), Port("c", "c", "c")]
    assert across_ports(two) is None and across_ports(two[:1]) is None and across_ports(two[2:]) is None
    apart = [two[0], Port("b", "b", "b", 0.3 + np.pi / 2), two[2]]
    across = across_ports(apart)
    assert across is not None
    # At right angles to the first the second sees all, at right angles to the second the first less than
    # nothing.
    np.testing.assert_allclose(across, [[0, 1, 0], [-1, 0, 0], [0, 0, 0]], atol=1e-15)


def test_changes_are_central_differences() -> None:
    """Of a sum, its square and its exponential, over a thousandth of the error to either side: 3, 0 and
    sinh(3 h) / h with h = 1e-3.
    """
    one = MatrixError(Uncertainty("number", 0.01, "1"), np.ones((3, 1, 1)))
    ((uncertainty, change),) = changes_by(
        (one,), lambda by: np.array([np.sum(by).real, np.sum(by).real ** 2, np.exp(np.sum(by).real)])
    )
    assert uncertainty.source == "number"
    np.testing.assert_allclose(change, [3, 0, np.sinh(3e-3) / 1e-3], rtol=1e-9, atol=1e-15)

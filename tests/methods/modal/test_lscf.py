"""p-LSCF: poles of rational FRFs in closed form, normal equations against the regression written out."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.arrays import modal_assurance
from labpipe.methods.modal.poles import normal_equations, stabilisation
from tests.methods.modal.structures import chain, chain_response, nine_modes


def eigen_poles(n_dof: int) -> np.ndarray:
    """Poles of the chain with positive imaginary part, from the undamped modes: damping in proportion to the
    stiffness.
    """
    mass, _, stiffness = chain(n_dof)
    square = np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real)
    return -1e-5 * square + 1j * np.sqrt(square - 1e-10 * square**2)


def regression(
    omega: np.ndarray, matrix: np.ndarray, order: int, period: float, scale: np.ndarray
) -> np.ndarray:
    """A_0 ...

    A_order-1 with A_order = I by one least-squares solution over all numerators and the denominator.
    """
    n_output, n_input = matrix.shape[1:]
    scaled = matrix * scale
    scaled = scaled / np.sqrt(np.mean(np.abs(scaled) ** 2, axis=(0, 2)))[None, :, None]
    z = np.exp(-1j * omega[:, None] * period * np.arange(order + 1))
    rows, right = [], []
    for output in range(n_output):
        numerators = np.zeros((omega.size, n_output * (order + 1)), complex)
        numerators[:, output * (order + 1) : (output + 1) * (order + 1)] = z
        denominators = -(z[:, :, None] * scaled[:, output, None, :]).reshape(omega.size, -1)
        rows.append(np.hstack([numerators, denominators[:, :-n_input]]))
        right.append(-denominators[:, -n_input:])
    design, side = np.vstack(rows), np.vstack(right)
    real = np.vstack([design.real, design.imag])
    values = []
    for column in range(n_input):
        # B differs from column to column of A: every column is a regression of its own.
        target = np.concatenate([side[:, column].real, side[:, column].imag])
        values.append(np.linalg.lstsq(real, target, rcond=None)[0][n_output * (order + 1) :])
    return np.array(values).T.reshape(order, n_input, n_input)


def test_denominators_are_those_of_the_regression() -> None:
    structure = nine_modes(4, 301)
    matrix = structure.noisy(0.02, 1)[:, :, :2]
    omega = 2 * np.pi * structure.frequency
    equations = normal_equations(omega, matrix, 9)
    for order in (3, 9):
        expected = regression(omega, matrix, order, equations.period, equations.scale)
        size = 2 * order
        m = equations.matrices[order - 1]
        found = np.linalg.solve(m[:size, :size], -m[:size, size:]).reshape(order, 2, 2)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("stable_noise", [False, True])
def test_poles_of_a_noise_free_chain(stable_noise: bool) -> None:
    response = chain_response(np.linspace(5, 120, 400), 3)
    poles = normal_equations(2 * np.pi * response.frequency, response.matrix, 12).poles(
        12, stable_noise=stable_noise
    )
    for expected in eigen_poles(3):
        assert np.min(np.abs(poles.values - expected)) < 1e-4 * abs(expected.real)


def test_participation_is_the_shape_at_the_forces() -> None:
    response = chain_response(np.linspace(5, 120, 400), 3)
    mass, _, stiffness = chain(3)
    poles = normal_equations(2 * np.pi * response.frequency, response.matrix, 12).poles(12)
    square, shapes = np.linalg.eig(np.linalg.solve(mass, stiffness))
    for w2, shape in zip(square, shapes.T, strict=True):
        nearest = np.argmin(np.abs(np.abs(poles.values) - np.sqrt(w2)))
        assert (
            modal_assurance(poles.participation[nearest : nearest + 1], shape[None].astype(complex))[0, 0]
            > 1 - 1e-8
        )


def test_a_narrow_band_far_from_zero_keeps_its_poles() -> None:
    structure = nine_modes(8)
    lines = (structure.frequency >= 40) & (structure.frequency <= 66)
    omega = 2 * np.pi * structure.frequency[lines]
    equations = normal_equations(omega, structure.noisy(0.01, 2)[lines], 40)
    diagram = stabilisation(equations, (omega[0], omega[-1]), 40)
    assert 0 < equations.origin < omega[0]
    np.testing.assert_allclose(np.abs(diagram.modes.values) / (2 * np.pi), [46.0, 46.46, 61.0], rtol=2e-4)


def test_the_origin_lies_a_tenth_of_the_band_below_its_first_line() -> None:
    """The band then takes ten elevenths of 0.95 of the half circle.

    One that begins near 0 Hz keeps that as its origin.
    """
    omega = np.array([100.0, 130.0, 160.0, 200.0])
    matrix = np.ones((4, 1, 1)) + 0j
    high, low = normal_equations(omega, matrix, 1), normal_equations(omega - 90, matrix, 1)
    assert (high.origin, low.origin) == (pytest.approx(90.0), 0.0)
    assert (high.period, low.period) == (pytest.approx(0.95 * np.pi / 110), pytest.approx(0.95 * np.pi / 110))


@pytest.mark.parametrize("level", [0.01, 0.05])
def test_all_modes_of_a_structure_and_none_of_noise(level: float) -> None:
    structure = nine_modes()
    omega = 2 * np.pi * structure.frequency
    diagram = stabilisation(normal_equations(omega, structure.noisy(level, 0), 60), (omega[0], omega[-1]), 60)
    assert diagram.modes.values.size == 9
    np.testing.assert_allclose(diagram.modes.values.imag, structure.poles.imag, rtol=2e-4)
    assert (
        diagram.group.max() == 8
        and diagram.returns(diagram.modes.values, diagram.modes.participation).min() > 0.3
    )


def test_noise_has_no_modes() -> None:
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(600, 6, 2)) + 1j * rng.normal(size=(600, 6, 2))
    omega = 2 * np.pi * np.linspace(10, 100, 600)
    assert stabilisation(normal_equations(omega, noise, 40), (omega[0], omega[-1]), 40).modes.values.size == 0

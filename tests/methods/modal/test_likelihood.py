"""Refinement: estimates, standard errors and residual terms against a dense weighted least squares written
out here.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from labpipe.arrays import modal_assurance
from labpipe.methods.modal.likelihood import Lines, Refined, ResidualTerms, refine
from labpipe.methods.modal.model_error import modal_parameters
from labpipe.methods.modal.poles import normal_equations, refine_with_terms, stabilisation
from tests.methods.modal.structures import DAMPING, FREQUENCIES, nine_modes


def lines_of(omega: np.ndarray, matrix: np.ndarray) -> Lines:
    """Accelerance with the same noise at all lines."""
    return Lines(omega, matrix, 2, np.ones(omega.size))


def small_case(n_input: int = 2) -> tuple[Lines, ResidualTerms, np.ndarray, np.ndarray]:
    """Three points, two modes of a part of the band, with start values near the truth."""
    structure = nine_modes(3, 1501)
    lines = (structure.frequency >= 85) & (structure.frequency <= 128)
    omega = 2 * np.pi * structure.frequency[lines]
    matrix = structure.noisy(0.02, 4)[lines][:, :, :n_input]
    poles = structure.poles[6:8] * 1.0002
    participation = structure.shapes[6:8][:, :n_input]
    return lines_of(omega, matrix), ResidualTerms(lines_of(omega, matrix), 1, 2), poles, participation


def dense_residual(parameters: np.ndarray, lines: Lines, refined: Refined) -> np.ndarray:
    """Residual over its noise: poles, free participation, shapes, residual factors of 1, s^2 and s^-2 as
    plain parameters.
    """
    n_line, n_output, n_input = lines.matrix.shape
    values = parameters[0::2] + 1j * parameters[1::2]
    k = refined.poles.size
    poles, rest = values[:k] * 1e3, values[k:]
    fixed = np.argmax(refined.participation == 1, axis=1)
    participation = np.ones((k, n_input), complex)
    for mode in range(k):
        free = [column for column in range(n_input) if column != fixed[mode]]
        participation[mode, free], rest = rest[: len(free)], rest[len(free) :]
    shapes, rest = rest[: n_output * k].reshape(n_output, k), rest[n_output * k :]
    factors = rest.reshape(3, n_output, n_input)
    s = 1j * lines.omega
    model = np.zeros((n_line, n_output, n_input), complex)
    for mode in range(k):
        residue = np.outer(shapes[:, mode], participation[mode])
        model += (
            residue / (s - poles[mode])[:, None, None]
            + residue.conj() / (s - poles[mode].conj())[:, None, None]
        )
    unit = s / (1j * lines.omega[-1])
    for factor, power in zip(factors, (-2, 0, 2), strict=True):
        model += factor * (unit**power)[:, None, None]
    error = (lines.matrix - model * (s**2)[:, None, None]) / np.sqrt(refined.noise / 2)
    return np.concatenate([error.real.ravel(), error.imag.ravel()])


def test_estimate_and_covariance_are_those_of_dense_least_squares() -> None:
    lines, terms, poles, participation = small_case()
    refined = refine(lines, terms, poles, participation)
    assert refined.converged
    fixed = np.argmax(refined.participation == 1, axis=1)
    free = np.array([refined.participation[mode, 1 - fixed[mode]] for mode in range(2)])
    start = np.concatenate([refined.poles / 1e3, free, refined.shapes.ravel(), np.zeros(3 * lines.n_element)])
    start = np.stack([start.real, start.imag], -1).ravel()
    dense = least_squares(
        dense_residual, start, args=(lines, refined), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    covariance = np.linalg.inv(dense.jac.T @ dense.jac)
    error = np.sqrt(np.diag(refined.covariance))
    found = np.stack([refined.poles.real, refined.poles.imag], -1).ravel()
    np.testing.assert_allclose(found, 1e3 * dense.x[:4], atol=2e-2 * error[:4].min())
    np.testing.assert_allclose(
        refined.covariance[:4, :4], 1e6 * covariance[:4, :4], rtol=1e-3, atol=1e-3 * error[:4].min() ** 2
    )
    np.testing.assert_allclose(
        refined.covariance[4:, 4:], covariance[4:8, 4:8], rtol=1e-3, atol=1e-6 * covariance[4, 4]
    )
    shapes = dense.x[8 : 8 + 12].reshape(3, 4)
    np.testing.assert_allclose(
        np.stack([refined.shapes.real, refined.shapes.imag], -1).reshape(3, 4), shapes, rtol=1e-3, atol=1e-7
    )
    for output in range(3):
        block = slice(8 + 4 * output, 12 + 4 * output)
        size = np.sqrt(np.outer(np.diag(covariance[block, block]), np.diag(covariance[block, block])))
        np.testing.assert_allclose(
            refined.shape_covariance[output] / size, covariance[block, block] / size, atol=2e-3
        )
        scale = np.array([1e3, 1e3, 1e3, 1e3, 1, 1, 1, 1])
        crossed = covariance[block, :8] * scale
        size = np.sqrt(np.outer(np.diag(covariance[block, block]), np.diag(refined.covariance)))
        np.testing.assert_allclose(refined.crossed[output] / size, crossed / size, atol=2e-3)


def test_noise_of_every_element_is_found() -> None:
    structure = nine_modes(20)
    omega = 2 * np.pi * structure.frequency
    matrix = structure.noisy(0.01, 7)
    refined, _ = refine_with_terms(lines_of(omega, matrix), structure.poles, structure.shapes[:, [0, 7, 15]])
    expected = 1e-4 * np.mean(np.abs(structure.matrix) ** 2, axis=0)
    # The variance of 1,501 complex lines is known to 1 / sqrt(1501) = 2.6 %.
    assert np.max(np.abs(refined.noise / expected - 1)) < 5 / np.sqrt(1501)


def test_residual_terms_are_taken_out_of_the_data() -> None:
    omega = 2 * np.pi * np.linspace(20, 40, 120)
    w = omega[:, None, None] / omega[-1]
    smooth = (w**2 * (2 - 1j) + 3j * w**-0 + 0.5 * w**4).astype(complex)
    terms = ResidualTerms(lines_of(omega, smooth), 1, 2)
    assert np.max(np.abs(terms.remainder)) < 1e-12 * np.max(np.abs(smooth))


@pytest.mark.long
@pytest.mark.parametrize("level", [0.01, 0.05])
def test_draws_reach_the_bound(level: float) -> None:
    """20 draws of 18 parameters: three deviations of a share of 95 % are 3.4 %, of the rms .11."""
    structure = nine_modes()
    omega = 2 * np.pi * structure.frequency
    errors, alike = [], []
    for seed in range(20):
        matrix = structure.noisy(level, seed)
        modes = stabilisation(normal_equations(omega, matrix, 60), (omega[0], omega[-1]), 60).modes
        assert modes.values.size == 9, f"seed {seed}"
        refined, _ = refine_with_terms(lines_of(omega, matrix), modes.values, modes.participation)
        parameters = modal_parameters(refined, 10**6, None, (), None)
        truth = np.stack([FREQUENCIES, DAMPING], -1).ravel()
        errors.append([(p.value - t) / p.std_error for p, t in zip(parameters, truth, strict=True)])
        alike.append(np.diag(modal_assurance(refined.shapes.T, structure.shapes)).min())
    scaled = np.array(errors)
    assert np.sqrt(np.mean(scaled**2)) < 1.11
    assert 0.916 < np.mean(np.abs(scaled) < 1.96) < 0.984
    assert min(alike) > (0.9999 if level == 0.01 else 0.999)

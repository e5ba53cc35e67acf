"""Noise that lines share through gains and a Toeplitz correlation, compared with the matrix written out and
against drawn noise.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.estimation import leakage
from labpipe.estimation.leakage import LineBlocks, LinePairs, SharedNoise, shared_residual

NUMBERS = np.array([7, 8, 9, 11, 12, 15, 16, 17, 18, 22])
CORRELATION = np.array([0.6 - 0.3j, 0.3 - 0.2j, 0.1 - 0.1j])
N_ELEMENT = 2


def literal(noise: SharedNoise, element: int) -> np.ndarray:
    """R of one element by its definition, line by line and neighbour by neighbour."""
    whole = np.zeros((NUMBERS.size, NUMBERS.size), np.complex128)
    gains = np.ones((NUMBERS.size, 1)) if noise.gains is None else noise.gains[:, :, element]
    for k, row in enumerate(NUMBERS):
        for m, column in enumerate(NUMBERS):
            for i in range(gains.shape[1]):
                for j in range(gains.shape[1]):
                    d = (row + i) - (column + j)
                    r = (
                        1.0
                        if d == 0
                        else (noise.correlation[abs(d) - 1] if abs(d) <= noise.correlation.size else 0.0)
                    )
                    whole[k, m] += gains[k, i] * (r if d >= 0 else np.conj(r)) * np.conj(gains[m, j])
    return whole


@pytest.fixture(params=[False, True])
def noise(request: pytest.FixtureRequest, rng: np.random.Generator) -> SharedNoise:
    gains = rng.normal(size=(NUMBERS.size, 3, N_ELEMENT)) + 1j * rng.normal(size=(NUMBERS.size, 3, N_ELEMENT))
    return SharedNoise(NUMBERS, CORRELATION, gains if request.param else None)


def test_products_and_power_are_those_of_the_matrix(noise: SharedNoise, rng: np.random.Generator) -> None:
    columns = rng.normal(size=(NUMBERS.size, N_ELEMENT, 3)) + 1j * rng.normal(
        size=(NUMBERS.size, N_ELEMENT, 3)
    )
    products = noise.times(columns)
    matrices = [literal(noise, element) for element in range(N_ELEMENT)]
    for element, matrix in enumerate(matrices):
        np.testing.assert_allclose(
            products[:, element], matrix @ columns[:, element], atol=1e-12 * np.abs(products).max()
        )
    assert noise.power == pytest.approx(
        np.mean([np.sum(np.abs(matrix) ** 2) for matrix in matrices]), rel=1e-10
    )


def test_drawn_noise_has_the_correlation(noise: SharedNoise, rng: np.random.Generator) -> None:
    draws = np.array([noise.draw(rng, N_ELEMENT)[..., 0] for _ in range(3000)])
    for element in range(N_ELEMENT):
        matrix = literal(noise, element)
        size = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix))).real
        # 3000 draws: 1.8 % on a correlation. The circle's power is cut off at zero, here by up to 4 %.
        found = draws[:, :, element].T @ draws[:, :, element].conj() / 3000
        np.testing.assert_allclose(found / size, matrix / size, atol=0.12)


def test_estimates_and_residual_scatter_as_predicted(rng: np.random.Generator) -> None:
    # A straight line through real and imaginary parts, 4000 draws of correlated noise by the matrix's own
    # root.
    noise = SharedNoise(np.arange(12), CORRELATION)
    distance = np.subtract.outer(np.arange(12), np.arange(12))
    whole = np.concatenate([[1.0], CORRELATION, np.zeros(8)])
    root = np.linalg.cholesky(
        np.where(distance >= 0, whole[np.abs(distance)], whole[np.abs(distance)].conj())
    )
    design = np.column_stack([np.ones(12), np.arange(12) * (1 + 1j)])
    jacobian = np.sqrt(2) * design[:, None, :]
    real = np.concatenate([jacobian[:, 0].real, jacobian[:, 0].imag])
    inverse = np.linalg.inv(real.T @ real)
    predicted = shared_residual(noise, jacobian, inverse)
    draws = (root @ (rng.normal(size=(12, 4000)) + 1j * rng.normal(size=(12, 4000)))) / np.sqrt(2)
    stacked = np.sqrt(2) * np.concatenate([draws.real, draws.imag])
    estimates = inverse @ (real.T @ stacked)
    residual = np.sum((stacked - real @ estimates) ** 2, axis=0)
    # 4000 draws: 2.2 % on a variance, less on a mean.
    np.testing.assert_allclose(
        np.cov(estimates), predicted.covariance, rtol=0.1, atol=0.03 * predicted.covariance.max()
    )
    assert residual.mean() == pytest.approx(predicted.mean, rel=0.03)
    assert 2 * residual.mean() ** 2 / residual.var() == pytest.approx(predicted.dof, rel=0.1)
    # Independent lines would be 22 degrees of freedom, and a standard error too small.
    assert predicted.dof < 15 and np.all(np.diag(predicted.covariance) > 1.3 * np.diag(inverse))


def test_blocks_of_near_lines_are_the_covariance_of_real_and_imaginary_parts(
    rng: np.random.Generator,
) -> None:
    # Lines 0, 1, 3, 4 with two elements: noise mixed of the own and the next number's draws, real parts more
    # than imaginary ones.
    numbers = np.array([0, 1, 3, 4])
    mixing = rng.normal(size=(8, 12)) + 1j * rng.normal(size=(8, 12))
    shares = np.repeat(
        (np.arange(6) == numbers[:, None]) | (np.arange(6) == numbers[:, None] + 1), 2, axis=0
    ).repeat(2, axis=1)
    mixing = mixing * shares
    correlation, turned = mixing @ mixing.conj().T, 0.3 * mixing @ mixing.T
    pairs = []
    for distance in range(3):
        first = np.array([k for k in range(4) if numbers[k] + distance in numbers], int)
        second = np.searchsorted(numbers, numbers[first] + distance)
        blocks = [
            np.array([m[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] for k, j in zip(first, second, strict=True)])
            for m in (correlation, turned)
        ]
        pairs.append(LinePairs(first, second, *blocks))
    noise = LineBlocks(4, tuple(pairs))
    columns = rng.normal(size=(4, 2, 3)) + 1j * rng.normal(size=(4, 2, 3))
    flat = columns.reshape(8, 3)
    np.testing.assert_allclose(
        noise.times(columns).reshape(8, 3), correlation @ flat + turned @ flat.conj(), rtol=1e-10
    )
    assert noise.trace == pytest.approx(np.trace(correlation).real / 2)
    # Of real and imaginary parts, scaled to the variance 1 each: their covariance has the trace 2 tr(R), its
    # square 2 tr(R^2) + 2 tr(T T*).
    real = np.block(
        [
            [(correlation + turned).real, (turned - correlation).imag],
            [(correlation + turned).imag, (correlation - turned).real],
        ]
    )
    assert np.sum(real**2) == pytest.approx(2 * 2 * noise.power)


@pytest.mark.parametrize("at_once", [1, 40])
def test_lines_held_a_few_at_a_time_are_all_lines(
    noise: SharedNoise, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    """The covariance A J^H R J A with the matrix R written out, from one line or some at a time."""
    jacobian = rng.normal(size=(NUMBERS.size, N_ELEMENT, 3)) + 1j * rng.normal(
        size=(NUMBERS.size, N_ELEMENT, 3)
    )
    inverse = np.linalg.inv(np.einsum("lep,leq->pq", jacobian.conj(), jacobian).real)
    middle = sum(
        jacobian[:, element].conj().T @ literal(noise, element) @ jacobian[:, element]
        for element in range(N_ELEMENT)
    )
    monkeypatch.setattr(leakage, "NUMBERS_AT_ONCE", at_once)
    found = shared_residual(noise, jacobian, inverse)
    np.testing.assert_allclose(found.covariance, inverse @ middle.real @ inverse, rtol=1e-10)

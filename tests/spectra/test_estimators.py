"""H1, H2, Hv and coherence from the cross-spectral matrix."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labpipe.errors import ConfigError
from labpipe.spectra.quality import multiple_coherence, ordinary_coherence, partial_coherence
from labpipe.spectra.random import ESTIMATORS

H = np.array([[1.0 + 2.0j, 0.3 - 0.1j], [0.2j, 2.0 - 1.0j]])


def spectra(
    rng: np.random.Generator, n: int, noise_u: float, noise_y: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    u = rng.normal(size=(2, n)) + 1j * rng.normal(size=(2, n))
    y = H @ u + noise_y * (rng.normal(size=(2, n)) + 1j * rng.normal(size=(2, n)))
    u = u + noise_u * (rng.normal(size=(2, n)) + 1j * rng.normal(size=(2, n)))
    return tuple((a @ b.conj().T / n)[None] for a, b in ((u, u), (y, u), (y, y)))


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_noise_free_data_give_the_truth_and_the_sign_of_its_phase(
    rng: np.random.Generator, name: str
) -> None:
    np.testing.assert_allclose(ESTIMATORS[name](*spectra(rng, 50, 0.0, 0.0))[0], H, rtol=1e-7, atol=1e-7)


def test_each_estimator_resists_its_own_noise(rng: np.random.Generator) -> None:
    only_y, only_u = spectra(rng, 200_000, 0.0, 0.5), spectra(rng, 200_000, 0.5, 0.0)
    np.testing.assert_allclose(ESTIMATORS["H1"](*only_y)[0], H, atol=0.01)
    np.testing.assert_allclose(ESTIMATORS["H2"](*only_u)[0], H, atol=0.02)
    # Closed form: noise of variance 0.25 on forces of variance 1 makes H1 too small by 1 / 1.25.
    np.testing.assert_allclose(ESTIMATORS["H1"](*only_u)[0], H / 1.25, atol=0.01)


@settings(derandomize=True, max_examples=30, deadline=None)
@given(u=st.floats(-12, 12), y=st.floats(-12, 12), name=st.sampled_from(list(ESTIMATORS)))
def test_units_change_no_estimate_but_by_their_factor(u: float, y: float, name: str) -> None:
    s_uu, s_yu, s_yy = spectra(np.random.default_rng(3), 60, 0.3, 0.3)
    a, b = 10.0**u, 10.0**y
    scaled = ESTIMATORS[name](a * a * s_uu, a * b * s_yu, b * b * s_yy)
    np.testing.assert_allclose(scaled * (a / b), ESTIMATORS[name](s_uu, s_yu, s_yy), rtol=1e-9)


def test_hv_lies_between_h1_and_h2(rng: np.random.Generator) -> None:
    u = rng.normal(size=5000) + 1j * rng.normal(size=5000)
    y, u = 2 * u + 0.5 * rng.normal(size=5000), u + 0.5 * rng.normal(size=5000)
    single = tuple(np.array([[[np.mean(a * b.conj())]]]) for a, b in ((u, u), (y, u), (y, y)))
    h1, h2, hv = (abs(ESTIMATORS[name](*single)[0, 0, 0]) for name in ("H1", "H2", "Hv"))
    assert h1 < hv < h2


def test_h2_needs_a_square_matrix() -> None:
    with pytest.raises(ConfigError, match="as many responses as forces"):
        ESTIMATORS["H2"](np.eye(2)[None], np.ones((1, 1, 2)), np.ones((1, 1, 1)))


def test_coherence_closed_form(rng: np.random.Generator) -> None:
    # y = h u + e: gamma^2 = |h|^2 S_uu / (|h|^2 S_uu + S_ee).
    s_uu, s_yy, s_yu = np.array([[[2.0 + 0j]]]), np.array([[[4 * 2.0 + 1.0 + 0j]]]), np.array([[[2j * 2.0]]])
    assert ordinary_coherence(s_uu, s_yu, s_yy)[0, 0, 0] == pytest.approx(8 / 9)
    assert multiple_coherence(s_yu @ np.linalg.inv(s_uu), s_yu, s_yy)[0, 0] == pytest.approx(8 / 9)
    noisy = spectra(rng, 2, 0.0, 3.0)
    assert np.all(multiple_coherence(noisy[1] @ np.linalg.inv(noisy[0]), *noisy[1:]) <= 1) and np.all(
        ordinary_coherence(*noisy) >= 0
    )


def test_partial_coherence_is_that_of_what_the_other_force_leaves(rng: np.random.Generator) -> None:
    # Literal twin (Bendat and Piersol, ch. 7.3): regress the other force out of force and response, then the
    # ordinary coherence.
    u = rng.normal(size=(2, 400)) + 1j * rng.normal(size=(2, 400))
    u[1] += 0.8 * u[0]
    y = H @ u + 0.7 * (rng.normal(size=(2, 400)) + 1j * rng.normal(size=(2, 400)))
    s_uu, s_yu, s_yy = (np.array([a @ b.conj().T]) for a, b in ((u, u), (y, u), (y, y)))
    inverse = np.linalg.inv(s_uu)
    partial = partial_coherence(np.einsum("fii->fi", inverse).real, s_yu @ inverse, s_yu, s_yy)[0]
    for output in range(2):
        for force in range(2):
            other = u[1 - force]
            left = [
                row - (row @ other.conj()) / (other @ other.conj()) * other for row in (u[force], y[output])
            ]
            expected = abs(left[1] @ left[0].conj()) ** 2 / (
                (left[0] @ left[0].conj()).real * (left[1] @ left[1].conj()).real
            )
            assert partial[output, force] == pytest.approx(expected, rel=1e-9)

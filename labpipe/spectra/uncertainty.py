"""The covariance of a frequency response matrix: E[d d^H] of d = vec(H - E H), row-major (index = output * n_input + input)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.complexfloating]


def covariance_of_random(s_uu: Matrix, s_yu: Matrix, s_yy: Matrix, response: Matrix, averages: float) -> Matrix:
    """cov(H_oi, H_pj) = S_rr[o, p] (S_uu^-1)[j, i] / (n_e - n_input), S_rr = [-H, I] S [-H, I]^H.

    From d = sum_k r_k u_k^H S_uu^-1 / n_e with the residual r = y - H u. For one force and one response this is
    E|H - E H|^2 = (1 - coh^2) / coh^2 |H|^2 / n_e, twice the variance that the textbooks give for the magnitude alone
    (Bendat and Piersol, Random Data, eq. 9.90: the complex value has two such parts).
    """
    n_frequency, n_output, n_input = response.shape
    cross = response @ s_yu.conj().swapaxes(-1, -2)
    residual = s_yy - cross - cross.conj().swapaxes(-1, -2) + response @ s_uu @ response.conj().swapaxes(-1, -2)
    inverse = np.linalg.inv(s_uu)
    covariance = np.einsum("fop,fji->foipj", residual, inverse) / max(averages - n_input, 1.0)
    n = n_output * n_input
    return _without_rounding(covariance.reshape(n_frequency, n, n))


def covariance_of_periodic(response: Matrix, force_inverse: Matrix, noise: Matrix) -> Matrix:
    """cov(H_oi, H_pj) = sum_e R_e[o, p] G[e, i] G[e, j]*, R_e = [-H, I] N_e [-H, I]^H, G = pinv(U).

    From H = Y G over the experiments e (one per force direction): dH = sum_e (dy_e - H du_e) G[e, :].
    response (n_line, n_output, n_input); force_inverse (n_line, n_experiment, n_input);
    noise (n_experiment, n_line, n_input + n_output, n_input + n_output), forces first.
    """
    n_line, n_output, n_input = response.shape
    identity = np.broadcast_to(np.eye(n_output), (n_line, n_output, n_output))
    weights = np.concatenate([-response, identity], axis=2)
    residual = np.einsum("foa,efab,fpb->efop", weights, noise, weights.conj())
    covariance = np.einsum("efop,fei,fej->foipj", residual, force_inverse, force_inverse.conj())
    n = n_output * n_input
    return _without_rounding(covariance.reshape(n_line, n, n))


def _without_rounding(covariance: Matrix) -> Matrix:
    """The Hermitian part, its diagonal not below zero."""
    covariance = (covariance + covariance.conj().swapaxes(-1, -2)) / 2
    diagonal = np.einsum("fii->fi", covariance)
    diagonal[...] = np.maximum(diagonal.real, 0.0)
    return covariance

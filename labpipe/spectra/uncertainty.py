"""The covariance of a frequency response matrix: E[d d^H] of d = vec(H - E H), row-major (index = output * n_input + input)."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.spectra.matrices import hermitian, inverse, without_rounding


def covariance_of_random(spectra: ComplexArray, response: ComplexArray, instruments: ComplexArray, averages: float) -> ComplexArray:
    """cov(H_oi, H_pj) = S_rr[o, p] (B_p^H S_zz[p, o] B_o)[j, i] / (n_e - n_input), B_o = (E[u z_o^H])^-1, S_rr = [-H, I] S [-H, I]^H.

    The error of an estimator with instruments z is d_o = sum_k r_o z_o^H B_o / n_e, r = y - H u. For H1 (z = u) the second factor is
    (S_uu^-1)[j, i], and one force and one output give E|H - E H|^2 = (1 - coh^2) / coh^2 |H|^2 / n_e: twice the variance that
    the textbooks give for the magnitude alone (Bendat and Piersol, Random Data, eq. 9.90: the complex value has two such parts).
    H2 has the same share of its own, larger |H|^2. Exact for H1, first order in 1 / n_e for the others.

    spectra (n_frequency, n, n) [unit^2/Hz] of all channels, the n_input forces first; response (n_frequency, n_output, n_input) [unit/N];
    instruments W (n_frequency, n_output or 1, n_input, n) with z_o = W_o [u; y], see estimators.INSTRUMENTS.
    """
    n_frequency, n_output, n_input = response.shape
    identity = np.broadcast_to(np.eye(n_output), (n_frequency, n_output, n_output))
    residual_of = np.concatenate([-response, identity], axis=2)
    residual = residual_of @ spectra @ hermitian(residual_of)
    force_products = spectra[:, None, :n_input] @ hermitian(instruments)
    # B_o^H W_o of every response in rows, so that one product gives the spread of all pairs of responses.
    gain = hermitian(inverse(force_products)) @ instruments
    rows = gain.reshape(n_frequency, -1, gain.shape[3])
    spread = (rows @ spectra @ hermitian(rows)).reshape(n_frequency, gain.shape[1], n_input, gain.shape[1], n_input)
    # B_p^H S_zz[p, o] B_o stands at [p, j, o, i]; the covariance needs it at [o, i, p, j].
    spread = spread.transpose(0, 3, 4, 1, 2)
    covariance = residual[:, :, None, :, None] * (spread / max(averages - n_input, 1.0))
    n = n_output * n_input
    return without_rounding(covariance.reshape(n_frequency, n, n))


def covariance_of_periodic(response: ComplexArray, force_inverse: ComplexArray, noise: ComplexArray) -> ComplexArray:
    """cov(H_oi, H_pj) = sum_e R_e[o, p] G[e, i] G[e, j]*, R_e = [-H, I] N_e [-H, I]^H, G = pinv(U).

    From H = Y G over the experiments e (one per force direction): dH = sum_e (dy_e - H du_e) G[e, :].
    response (n_line, n_output, n_input) [unit/N]; force_inverse (n_line, n_experiment, n_input) [1/N];
    noise (n_experiment, n_line, n_input + n_output, n_input + n_output) [unit^2], forces first.
    """
    n_line, n_output, n_input = response.shape
    identity = np.broadcast_to(np.eye(n_output), (n_line, n_output, n_output))
    weights = np.concatenate([-response, identity], axis=2)
    residual = np.einsum("foa,efab,fpb->efop", weights, noise, weights.conj())
    covariance = np.einsum("efop,fei,fej->foipj", residual, force_inverse, force_inverse.conj())
    n = n_output * n_input
    return without_rounding(covariance.reshape(n_line, n, n))

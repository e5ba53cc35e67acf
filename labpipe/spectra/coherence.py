"""Ordinary, multiple and partial coherence: the share of an output's power that is linear in the forces."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.spectra.matrices import inverse


def ordinary_coherence(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """gamma^2 = |S_yu|^2 / (S_yy S_uu) per output and force, (n_frequency, n_output, n_input) [1].

    s_uu (n_frequency, n_input, n_input) [N^2/Hz], s_yu (n_frequency, n_output, n_input), s_yy (n_frequency, n_output, n_output).
    """
    power = np.einsum("foo->fo", s_yy).real[:, :, None] * np.einsum("fii->fi", s_uu).real[:, None, :]
    return _clipped(np.abs(s_yu) ** 2, power)


def multiple_coherence(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """gamma^2 = S_yu S_uu^-1 S_uy / S_yy per output, (n_frequency, n_output) [1]; arguments as in ordinary_coherence.

    Raises numpy.linalg.LinAlgError for a singular S_uu.
    """
    explained = np.einsum("foi,foi->fo", s_yu @ inverse(s_uu), s_yu.conj()).real
    return _clipped(explained, np.einsum("foo->fo", s_yy).real)


def partial_coherence(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """Coherence of an output and one force, both conditioned on the other forces, (n_frequency, n_output, n_input) [1].

    gamma^2 = |Q_yu|^2 / (Q_yy Q_uu) of the inverse Q of the spectra of all forces and that output (Bendat and Piersol, Random
    Data, ch. 7.3: conditioned spectra); by blocks Q_yu = -q H1 and Q_uu = S_uu^-1 + q H1^H H1 with the residual power 1 / q.
    Arguments as in ordinary_coherence. Raises numpy.linalg.LinAlgError for a singular S_uu.
    """
    inverse_force = inverse(s_uu)
    h1 = s_yu @ inverse_force
    residual = np.einsum("foo->fo", s_yy).real - np.einsum("foi,foi->fo", h1, s_yu.conj()).real
    explained = np.abs(h1) ** 2
    alone = np.einsum("fii->fi", inverse_force).real[:, None, :] * np.maximum(residual, 0.0)[:, :, None]
    return _clipped(explained, explained + alone)


def _clipped(part: FloatArray, whole: FloatArray) -> FloatArray:
    """part / whole within 0 ... 1, which rounding alone may leave; 0 where there is no signal."""
    ratio = np.divide(part, whole, out=np.zeros(np.broadcast(part, whole).shape), where=whole > 0)
    return np.clip(ratio, 0.0, 1.0)

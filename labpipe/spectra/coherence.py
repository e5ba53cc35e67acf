"""How much of a response the forces explain: ordinary, multiple and partial coherence."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.spectra.matrices import inverse


def ordinary_coherence(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """gamma^2 = |S_yu|^2 / (S_yy S_uu) per response and force, (n_frequency, n_output, n_input)."""
    power = np.einsum("foo->fo", s_yy).real[:, :, None] * np.einsum("fii->fi", s_uu).real[:, None, :]
    return _clipped(np.abs(s_yu) ** 2, power)


def multiple_coherence(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """gamma^2 = S_yu S_uu^-1 S_uy / S_yy per response, (n_frequency, n_output)."""
    explained = np.einsum("foi,foi->fo", s_yu @ inverse(s_uu), s_yu.conj()).real
    return _clipped(explained, np.einsum("foo->fo", s_yy).real)


def partial_coherence(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """Coherence of a response and one force after the other forces are taken out of both, (n_frequency, n_output, n_input).

    gamma^2 = |Q_yu|^2 / (Q_yy Q_uu) of the inverse Q of the spectra of all forces and that response (Bendat and Piersol, Random
    Data, ch. 7.3: conditioned spectra); by blocks Q_yu = -q H1 and Q_uu = S_uu^-1 + q H1^H H1 with the residual power 1 / q.
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

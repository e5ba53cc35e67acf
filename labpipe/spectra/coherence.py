"""Ordinary, multiple and partial coherence: the share of an output's power that is linear in the forces."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray


def ordinary_coherence(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """gamma^2 = |S_yu|^2 / (S_yy S_uu) per output and force, (n_frequency, n_output, n_input) [1].

    s_uu (n_frequency, n_input, n_input) [N^2/Hz], s_yu (n_frequency, n_output, n_input), s_yy (n_frequency, n_output, n_output).
    Equation (frf-coherence).
    """
    power = np.einsum("foo->fo", s_yy).real[:, :, None] * np.einsum("fii->fi", s_uu).real[:, None, :]
    return _clipped(_squared(s_yu), power)


def multiple_coherence(h1: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """gamma^2 = H1 S_uy / S_yy per output, (n_frequency, n_output) [1], the share of H1 = S_yu S_uu^-1, (n_frequency, n_output, n_input).

    Spectra as in ordinary_coherence. Equation (frf-multiple-coherence).
    """
    return _clipped(_explained(h1, s_yu), np.einsum("foo->fo", s_yy).real)


def partial_coherence(inverse_force: ComplexArray, h1: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """Coherence of an output and one force, both conditioned on the other forces, (n_frequency, n_output, n_input) [1].

    gamma^2 = |Q_yu|^2 / (Q_yy Q_uu) of the inverse Q of the spectra of all forces and that output (Bendat and Piersol, Random
    Data, ch. 7.3: conditioned spectra); by blocks Q_yu = -q H1 and Q_uu = S_uu^-1 + q H1^H H1 with the residual power 1 / q.
    inverse_force: S_uu^-1 (n_frequency, n_input, n_input) [Hz/N^2]; the other arguments as in multiple_coherence.
    Equation (frf-partial-coherence).
    """
    residual = np.einsum("foo->fo", s_yy).real - _explained(h1, s_yu)
    explained = _squared(h1)
    alone = np.einsum("fii->fi", inverse_force).real[:, None, :] * np.maximum(residual, 0.0)[:, :, None]
    return _clipped(explained, explained + alone)


def _explained(h1: ComplexArray, s_yu: ComplexArray) -> FloatArray:
    """The power of every output that the forces explain, the diagonal of H1 S_uy, (n_frequency, n_output)."""
    explained: FloatArray = np.sum(h1.real * s_yu.real + h1.imag * s_yu.imag, axis=2)
    return explained


def _squared(values: ComplexArray) -> FloatArray:
    """|z|^2 without the root that abs takes."""
    squared: FloatArray = values.real**2 + values.imag**2
    return squared


def _clipped(part: FloatArray, whole: FloatArray) -> FloatArray:
    """part / whole within 0 ... 1, which rounding alone may leave; 0 where there is no signal."""
    ratio = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
    return np.clip(ratio, 0.0, 1.0, out=ratio)

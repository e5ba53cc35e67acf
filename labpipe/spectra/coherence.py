"""How much of a response the forces explain: ordinary and multiple coherence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.complexfloating]


def ordinary_coherence(s_uu: Matrix, s_yu: Matrix, s_yy: Matrix) -> NDArray[np.floating]:
    """gamma^2 = |S_yu|^2 / (S_yy S_uu) per response and force, (n_frequency, n_output, n_input)."""
    power = np.einsum("foo->fo", s_yy).real[:, :, None] * np.einsum("fii->fi", s_uu).real[:, None, :]
    return _clipped(np.abs(s_yu) ** 2, power)


def multiple_coherence(s_uu: Matrix, s_yu: Matrix, s_yy: Matrix) -> NDArray[np.floating]:
    """gamma^2 = S_yu S_uu^-1 S_uy / S_yy per response, (n_frequency, n_output)."""
    explained = np.einsum("foi,fio->fo", s_yu, np.linalg.solve(s_uu, s_yu.conj().swapaxes(-1, -2))).real
    return _clipped(explained, np.einsum("foo->fo", s_yy).real)


def _clipped(part: NDArray[np.floating], whole: NDArray[np.floating]) -> NDArray[np.floating]:
    """part / whole within 0 ... 1, which rounding alone may leave; 0 where there is no signal."""
    ratio = np.divide(part, whole, out=np.zeros(np.broadcast(part, whole).shape), where=whole > 0)
    return np.clip(ratio, 0.0, 1.0)

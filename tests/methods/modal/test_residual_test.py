"""Noise along the lines of a window."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.modal.poles import shared_power


def test_power_of_lines_that_share_their_noise() -> None:
    """The mean power of n lines scatters by 1 + 2 sum |rho_d|^2 more: of a Hann window 1 + 2 (4 / 9 + 1 /
    36); of drawn noise as well.
    """
    hann = shared_power((-2 / 3, 1 / 6))
    assert shared_power(()) == 1.0 and hann == pytest.approx(1 + 2 * (4 / 9 + 1 / 36))
    rng = np.random.default_rng(1)
    white = rng.standard_normal((2, 2000, 402))
    noise = np.einsum("pnl->nl", white * np.array([1, 1j])[:, None, None])
    windowed = noise[:, 1:-1] - (noise[:, :-2] + noise[:, 2:]) / 2
    powers = np.mean(np.abs(windowed) ** 2, axis=1)
    # 2000 draws tell a variance to 3 %.
    assert 400 * np.var(powers) / np.mean(powers) ** 2 == pytest.approx(hann, rel=0.1)

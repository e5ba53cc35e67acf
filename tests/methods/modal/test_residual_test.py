"""Noise along the lines of a window."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.modal.likelihood import shared_power
from labpipe.methods.modal.settings import ModalSettings
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, ImpactSettings


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


@pytest.mark.parametrize(("n_output", "n_hit"), [(2, 16), pytest.param(6, 16, marks=pytest.mark.long)])
def test_modes_of_hits_under_an_exponential_window_scatter_as_stated(n_output: int, n_hit: int) -> None:
    """Two modes in closed form, struck by one sample, and white noise: twelve records. Neighbouring lines
    share their noise by up to .85, and six responses lose by weights that 16 hits estimate.
    """
    rate, frequencies, ratios = 256.0, np.array([31.3, 47.7]), np.array([0.006, 0.008])
    poles = 2 * np.pi * frequencies * (-ratios + 1j * np.sqrt(1 - ratios**2))
    shapes = np.cos(np.outer([0.5, 1.7], np.arange(n_output) + 0.4))
    time = np.arange(round(12 * rate)) / rate
    block = np.sum((shapes[:, :, None] * np.exp(np.outer(poles, time)).imag[:, None]), axis=0).T
    force = np.zeros((n_hit, time.size))
    force[:, 26] = 100.0
    clean = np.tile(np.roll(block, 26, axis=0) * (np.arange(time.size) >= 26)[:, None], (n_hit, 1))
    channels = [Channel("f", "force", "input", "p", 0.0)]
    channels += [Channel(f"x{n}", "displacement", "output", f"{n}", 0.0) for n in range(n_output)]
    away = []
    for seed in range(12):
        noise = np.random.default_rng(seed).normal(size=(clean.shape[0], n_output + 1))
        samples = np.column_stack([force.ravel(), clean]) + noise * np.array([1e-3, *[0.01] * n_output])
        hits = ImpactSettings(decay=0.4)
        settings = FrfSettings("impact", block=2.0, band=(20.0, 65.0), impact=hits)
        response = measure([Recording(tuple(channels), samples, rate, "hits")], settings)
        modal = FitSettings("modal", band=(20.0, 65.0), model_settings=ModalSettings((2, 12)))
        (fit,) = identify(response, modal)
        for mode in range(2):
            for name, true in (("f_n", frequencies[mode]), ("zeta", ratios[mode])):
                found = fit.parameter(f"{name}_{mode + 1}")
                away.append((found.value - true) / found.std_error)
    # 48 values: rms known to a tenth.
    assert 0.75 < np.sqrt(np.mean(np.square(away))) < 1.3

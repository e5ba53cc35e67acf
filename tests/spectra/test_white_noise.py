"""White noise from force to coefficients: truth inside the intervals as often as stated, and a shaft-speed
line changes nothing.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.project.simulate import load_virtual_rig
from labpipe.records.identification import Fit
from labpipe.simulate.linear import SensorNoise, WhiteNoiseRig
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, MaskSettings, ShaftLines

SETTINGS = FrfSettings(excitation="random", block=5.0, band=(30.0, 130.0))
NAMES = [f"{letter}_{pair}" for letter in "kc" for pair in ("xx", "xy", "yx", "yy")]


def fitted(rig: WhiteNoiseRig, settings: FrfSettings, seed: int = 1) -> Fit:
    (fit,) = identify(measure(recordings(rig, seed), settings), FitSettings("rotor-2dof", mass=rig.mass))
    return fit


def normal_errors(fit: Fit, rig: WhiteNoiseRig) -> list[float]:
    known = rig.truth
    return [
        (fit.parameter(name).value - known[name]) / (fit.parameter(name).std_error or np.nan)
        for name in NAMES
    ]


@pytest.fixture(scope="module")
def rig() -> WhiteNoiseRig:
    return load_virtual_rig(Path(__file__).parents[2] / "configs/virtual-white-noise.yaml")


@pytest.mark.parametrize(
    ("how", "settings"),
    [
        ("masked", {"mask": MaskSettings(50.0)}),
        ("removed", {"remove": ShaftLines(50.0)}),
        ("left in, its lines weigh little", {}),
    ],
)
def test_a_shaft_speed_line_leaves_the_parameters_within_their_intervals(
    rig: WhiteNoiseRig, how: str, settings: dict
) -> None:
    with_line, without = (
        fitted(rig, replace(SETTINGS, **settings)),
        fitted(replace(rig, unbalance=0.0), SETTINGS),
    )
    for name in NAMES:
        ours, plain = with_line.parameter(name), without.parameter(name)
        assert ours.ci95 is not None and ours.ci95[0] < plain.value < ours.ci95[1]
        # Samples and noise are the same but for the line, so far less than an interval is left.
        assert abs(ours.value - plain.value) < 0.2 * plain.std_error
        assert ours.std_error == pytest.approx(plain.std_error, rel=0.05)
    assert with_line.gof.chi2_p is not None and with_line.gof.chi2_p > 0.01


@pytest.mark.long
def test_intervals_hold_the_truth_as_often_as_they_say(rig: WhiteNoiseRig) -> None:
    # Sensor noise above the window's leakage; 16 runs of 8 parameters: 95 % +- 1.9 %, rms 1 +- .063.
    noisy = replace(rig, noise=SensorNoise(30e-6, 0.05))
    settings = replace(SETTINGS, band=(20.0, 160.0))
    fits = [fitted(noisy, settings, seed) for seed in range(16)]
    errors = np.array([normal_errors(fit, noisy) for fit in fits])
    assert 0.90 < np.mean(np.abs(errors) < 1.96) < 0.995
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1, abs=0.15)
    assert np.mean([fit.gof.chi2_reduced for fit in fits]) == pytest.approx(1, abs=0.02)
    assert np.mean([(fit.gof.chi2_p or 0.0) < 0.05 for fit in fits]) < 0.15


@pytest.mark.long
def test_where_leakage_is_the_noise_intervals_are_as_wide_as_the_scatter(rig: WhiteNoiseRig) -> None:
    # 12 runs of 8 parameters, rms 1 +- .072.
    fits = [fitted(rig, SETTINGS, seed) for seed in range(12)]
    errors = np.array([normal_errors(fit, rig) for fit in fits])
    assert np.mean(np.abs(errors) < 1.96) > 0.90
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.17)
    assert np.mean([fit.gof.chi2_reduced for fit in fits]) == pytest.approx(1, abs=0.02)


def quiet(rig: WhiteNoiseRig, **changed: float) -> WhiteNoiseRig:
    """Noise of the sensors far below the leakage of blocks of 2 s."""
    more = {"sample_rate": 512.0, "bandwidth": 200.0, "block": 2.0, "blocks": 12, "unbalance": 0.0, **changed}
    return replace(rig, noise=SensorNoise(3e-7, 0.0), **more)


SHORT = FrfSettings(excitation="random", block=2.0, band=(60.0, 110.0))


def test_every_force_has_the_noise_of_its_own_recordings(rig: WhiteNoiseRig) -> None:
    # As of each recording by itself, whose covariance is that of one force.
    both = recordings(quiet(rig), 2)
    together, alone = measure(both, SHORT), [measure([recording], SHORT) for recording in both]
    assert together.covariance_dof == pytest.approx(alone[0].covariance_dof)
    for force, own in enumerate(alone):
        elements = np.arange(2) * 2 + force
        block = together.covariance[:, elements[:, None], elements]
        size = np.abs(own.covariance).max(axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(block / size, own.covariance / size, atol=1e-9)
    # Two responses and four blocks: nu = 5.7, and 32 > 2 (3.7^2 - 1).
    few = measure(recordings(quiet(rig, blocks=4), 2), SHORT)
    assert few.covariance_dof == pytest.approx(few.averages - 2)


def test_every_force_has_its_own_blocks(rig: WhiteNoiseRig) -> None:
    # Two thirds of a recording are enough for a noise of its own, four blocks are not. nu is that of the mean
    # of nu / (nu - 2).
    y, short = recordings(quiet(rig), 2)[1], recordings(quiet(rig, blocks=8), 2)[0]
    uneven = measure([short, y], SHORT)
    assert uneven.blocks is not None and uneven.blocks.apart and uneven.blocks.by_force == (15, 23)
    excess = [nu / (nu - 2) for nu in (measure([run], SHORT).covariance_dof for run in (short, y))]
    assert uneven.covariance_dof / (uneven.covariance_dof - 2) == pytest.approx(np.mean(excess))
    assert uneven.blocks.select_forces([1]).by_force == (23,)


def test_a_right_model_fits_few_blocks(rig: WhiteNoiseRig) -> None:
    # 800 equations, a covariance of 5.7 degrees of freedom: chi2/dof 1 +- .15. Leakage of one force is common
    # to both responses; levels of single responses turned it: above 10.
    fit = fitted(quiet(rig, blocks=4), SHORT, 5)
    assert fit.gof.chi2_reduced == pytest.approx(1.0, abs=0.35)


def test_a_right_model_fits_leakage_of_two_forces(rig: WhiteNoiseRig) -> None:
    # 800 equations, lines share noise: chi2/dof 1 +- .07. The leakage of both forces pooled: above 3.
    fit = fitted(quiet(rig), SHORT, 3)
    assert fit.gof.chi2_reduced == pytest.approx(1.0, abs=0.2)
    assert not [finding for finding in fit.findings if finding.code == "model-mismatch"]


@pytest.mark.long
@pytest.mark.parametrize("blocks", [7, 24])
def test_intervals_where_leakage_of_two_forces_is_the_noise(rig: WhiteNoiseRig, blocks: int) -> None:
    # 10 runs of 8 parameters, rms 1 +- .08.
    fits = [fitted(quiet(rig, blocks=blocks), SHORT, seed) for seed in range(10)]
    errors = np.array([normal_errors(fit, rig) for fit in fits])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.24)
    assert np.mean([fit.gof.chi2_reduced for fit in fits]) == pytest.approx(1, abs=0.06)

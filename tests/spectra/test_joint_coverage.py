"""Intervals of closed loops over many draws: FRF by the reference and the coefficients fitted to it, on
virtual levitated rotors.

Expected are the parameters of the rig; 24 draws of 8 s at each of two levels of disturbance.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.magnetic_bearing.levitated_loop import LevitatedRig, rotor_receptance
from labpipe.project.simulate import load_virtual_rig
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

pytestmark = pytest.mark.long
DRAWS = 24
EXCITED = {
    "random": FrfSettings("random", block=1.0, band=(10.0, 300.0)),
    "multisine-": FrfSettings("periodic", period=1.0, band=(10.0, 300.0), skip=0),
}


def rig(axes: str, disturbance: float) -> LevitatedRig:
    shipped = load_virtual_rig(Path(__file__).parents[2] / "configs/virtual-levitated.yaml")
    assert isinstance(shipped, LevitatedRig)
    cross = shipped.cross_stiffness if axes == "xy" else 0.0
    injection, noise = (
        replace(shipped.injection, duration=8.0, periods=8),
        replace(shipped.noise, disturbance=disturbance),
    )
    return replace(
        shipped, axes=axes, cross_stiffness=cross, force_recorded=True, injection=injection, noise=noise
    )


@pytest.mark.parametrize(("disturbance", "axes"), [(4.0, "x"), (1.0, "xy")])
@pytest.mark.parametrize("run", list(EXCITED))
def test_intervals_hold_the_truth(run: str, disturbance: float, axes: str) -> None:
    """95 % intervals: of lines 93.5-96.5 %, of k and c 20 of 24 or more (by chance once in 170;
    where 70 % hold, nine in ten fail), neither
    biased by half a sigma.
    """
    made = rig(axes, disturbance)
    names = [run] if run == "random" else [f"{run}{label}" for label in made.labels]
    settings = replace(EXCITED[run], reference=tuple(f"r_{label}" for label in made.labels))
    lines, apart = [], []
    for seed in range(DRAWS if axes == "x" else DRAWS // 3):
        response = measure(recordings(made, seed, names), settings)
        assert response.variance is not None
        away = (
            (response.matrix - rotor_receptance(made, response.frequency)) / np.sqrt(response.variance / 2)
        ).ravel()
        lines.append(np.mean(np.abs([away.real, away.imag]) < 1.96))
        if axes == "x":
            (fit,) = identify(response, FitSettings("sdof", mass=4.0), judging=False)
            k, c = fit.parameter("k"), fit.parameter("c")
            assert k.std_error is not None and c.std_error is not None
            apart.append([(k.value + 2e5) / k.std_error, (c.value - 100) / c.std_error])
    assert np.mean(lines) == pytest.approx(0.95, abs=0.015)
    if axes == "x":
        held = np.mean(np.abs(apart) < 1.96, axis=0)
        assert np.all(held >= 20 / 24)
        assert np.all(np.abs(np.mean(apart, axis=0)) < 0.2 + 3 / np.sqrt(DRAWS))

"""Errors of labpipe's own fits where periods give the noise, over the prediction with known noise: simulated
tests from samples to fits.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.floating_bearing.settings import DynamicStiffnessSettings
from labpipe.methods.planning.campaigns import ONE_BY_ONE, TOGETHER, PlannedRig, RigLimits
from labpipe.methods.planning.model import SensorDensities, planned_model
from labpipe.methods.planning.plan import weighting_factor
from labpipe.methods.planning.search import flat
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings
from tests.methods.planning.rigs import PEDESTAL, SEAL

# Draws of the suite. The table of labpipe.methods.planning.plan is of 2000: there the rms of n ratios is
# known to 1 / sqrt(4000 n).
DRAWS = 150


def ratio(name: str, periods: int, draws: int) -> float:
    """Root of the mean square of the errors of all coefficients over their prediction."""
    if name == "sdof":
        model, rate, period = planned_model("sdof", PEDESTAL, 0.79), 200.0, 2.0
        force, scheme, lines = 1.0, ONE_BY_ONE, np.arange(130, 134)
        noise = {"force": 0.02, "displacement": 0.3e-6}
    else:
        model, rate, period = planned_model("dynamic-stiffness", SEAL, 60.0), 250.0, 0.5
        force, scheme, lines = 2e3, TOGETHER, np.arange(5, 50)
        noise = {"force": 2.0, "displacement": 0.2e-6, "acceleration": 0.05}
    axes = ("x", "y")[: model.n_dof]
    density = SensorDensities.of_samples(
        noise["force"], noise["displacement"], noise.get("acceleration", 0.0), rate
    )
    rig = PlannedRig(model, density, RigLimits(force), np.eye(model.n_dof, dtype=complex), axes, 1 / period)
    told = flat(rig, lines, scheme)
    (test,) = told.tests
    applied = test.forces @ rig.directions
    moved = np.einsum("lij,lj->li", model.receptance(rig.omega(test)), applied)
    seen = {"force": applied, "displacement": moved, "acceleration": -(rig.omega(test)[:, None] ** 2) * moved}
    n_sample = round(rate * period)
    turning = np.exp(2j * np.pi * np.outer(np.arange(n_sample) / n_sample, test.lines))
    clean = np.tile(np.hstack([(turning @ seen[quantity]).real for quantity in noise]), (periods, 1))
    channels = tuple(
        Channel(f"{quantity[0]}_{axis}", quantity, "input" if quantity == "force" else "output", axis)
        for quantity in noise
        for axis in axes
    )
    size = np.repeat(list(noise.values()), model.n_dof)
    rng = np.random.default_rng(periods)
    found = []
    for _ in range(draws):
        recording = Recording(channels, clean + rng.standard_normal(clean.shape) * size, rate, "test")
        found.append(_fitted(name, recording, period, model.names))
    predicted = told.errors(periods * period) * model.scales
    return float(np.sqrt(np.mean(((np.array(found) - model.expected) / predicted) ** 2)))


def _fitted(name: str, recording: Recording, period: float, names: tuple[str, ...]) -> list[float]:
    if name == "sdof":
        response = measure([recording], FrfSettings("periodic", period=period, skip=0, band=(64.9, 66.6)))
        (fit,) = identify(response, FitSettings("sdof", mass=0.79, name="fit"), judging=False)
    else:
        spectra = channel_spectra(
            [recording], FrfSettings("periodic", period=period, skip=0, band=(9.5, 98.5), result="spectra")
        )
        form = DynamicStiffnessSettings(form="kcm")
        (fit,) = identify(
            spectra,
            FitSettings("dynamic-stiffness", mass=60.0, model_settings=form, name="fit"),
            judging=False,
        )
    values = {parameter.name: parameter.value for parameter in fit.parameters}
    return [values[key] for key in names]


@pytest.mark.long
@pytest.mark.parametrize(("name", "periods"), [("sdof", 3), ("seal", 3)])
def test_errors_with_unknown_noise_are_those_of_the_table(name: str, periods: int) -> None:
    # Two coefficients of 150 draws know the ratio to 1 / sqrt(4 x 150) = 4 %.
    assert ratio(name, periods, DRAWS) == pytest.approx(weighting_factor(periods, name == "seal"), abs=0.09)

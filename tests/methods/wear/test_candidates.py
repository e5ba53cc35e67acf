"""What a test of a worn rotor tells: slopes against differences of the virtual rig's receptance, errors
against draws of a fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.planning.wear import ExpectedWear, ResponseTest, information
from labpipe.methods.wear.search import descend
from labpipe.methods.wear.virtual_rig import receptance
from labpipe.records.response import FrequencyResponse, diagonal_covariance
from tests.methods.wear.worn_cases import PORTS, RIG, SCALE, misfit_of, worn_rig

MESH = FilmMesh(240, 30)
LINES = np.array([20.0, 25.0, 60.0, 82.0, 90.0])
VALUES = {
    "wear_depth": 20e-6,
    "wear_angle": float(np.deg2rad(8.0)),
    "viscosity": 0.1044,
    "clearance": 90e-6,
    "beta": 1.6e-4,
}
# Steps as wide as the film's: cells scatter finer differences.
STEPS = {
    "wear_depth": 1e-6,
    "wear_angle": np.deg2rad(1.0),
    "viscosity": 1e-3,
    "clearance": 9e-7,
    "beta": 1e-6,
}


def _moved(name: str, step: float) -> np.ndarray:
    values = {**VALUES, name: VALUES[name] + step}
    rig = worn_rig(
        values["wear_depth"] * 1e6,
        np.degrees(values["wear_angle"]),
        viscosity=values["viscosity"],
        clearance=values["clearance"],
    )
    return receptance(replace(rig, rotor=replace(rig.rotor, beta=values["beta"])), LINES, MESH)


def test_slopes_are_differences_of_the_virtual_rig() -> None:
    response, slopes = ExpectedWear(RIG, "bearing 2", VALUES).receptance_and_slopes(LINES, MESH)
    np.testing.assert_allclose(response, _moved("beta", 0.0), rtol=1e-9)
    for number, (name, step) in enumerate(STEPS.items()):
        difference = (_moved(name, step) - _moved(name, -step)) / (2 * step)
        np.testing.assert_allclose(slopes[number], difference, atol=0.01 * np.abs(difference).max())


def test_other_speeds_and_loads() -> None:
    at = ExpectedWear(RIG, "bearing 2", VALUES).at(40.0, 10, -120.0)
    assert at.rig.speed == 40.0
    assert at.rig.loads == ((10, 0.0, -120.0),)
    # What the actuator pulls down more, the bearings carry.
    more = sum(load[1] for load in at.rig.static_loads().values()) - sum(
        load[1] for load in RIG.static_loads().values()
    )
    assert more == pytest.approx(-40.0)


def test_information_adds_up() -> None:
    expected = ExpectedWear(RIG, "bearing 2", {name: VALUES[name] for name in ("wear_depth", "wear_angle")})
    testing = ResponseTest(30.0, 60.0, 0.5, 1e-7, 0.0, exclude=((24.0, 26.0),))
    assert 25.0 not in testing.lines((20.0, 40.0)) and testing.lines((20.0, 40.0)).size == 36
    whole = information(expected, testing, (20.0, 40.0))
    parts = [information(expected, testing, (20.0, 40.0), terms) for terms in ("direct", "cross")]
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-12)
    longer = information(expected, ResponseTest(60.0, 120.0, 0.5, 1e-7, 0.0, testing.exclude), (20.0, 40.0))
    np.testing.assert_allclose(longer, 8 * whole, rtol=1e-12)


@pytest.mark.long
def test_predicted_errors_are_those_of_draws(rng: np.random.Generator) -> None:
    # 80 draws know a standard deviation to 1 / sqrt(160) = 7.9 %; films and tables of unequal cells differ
    # by some per cent in slopes.
    expected = ExpectedWear(RIG, "bearing 2", {name: VALUES[name] for name in ("wear_depth", "wear_angle")})
    testing = ResponseTest(30.0, 60.0, 2.0, 2e-7, 0.0)
    band = (60.0, 100.0)
    lines = testing.lines(band)
    clean, _ = expected.receptance_and_slopes(lines, FilmMesh(120, 30))
    # E|n|^2 = S_n / (n_d S_F), n_d = T times the spacing of independent lines.
    std = testing.displacement / np.sqrt(
        testing.force**2 / (band[1] - band[0]) * testing.seconds * testing.spacing
    )
    covariance = diagonal_covariance(np.full(clean.shape, std**2))
    found = []
    start = np.array([20.0, 8.0])
    for _ in range(80):
        noise = std * (rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)) / np.sqrt(2)
        misfit = misfit_of(
            FrequencyResponse(lines, clean + noise, PORTS, PORTS, covariance=covariance),
            cells_around=120,
            cells_across=30,
        )
        found.append(descend(misfit, start).parameters)
    predicted = np.sqrt(np.diagonal(np.linalg.inv(information(expected, testing, band)))) / SCALE
    np.testing.assert_allclose(np.std(found, axis=0), predicted, rtol=0.25)

"""The response as a function of wear and the bearings' other data: derivatives, bounds, and the films behind
the tables.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.bearings.kinds import LINEAR, LinearBearingSettings
from labpipe.errors import ConfigError, FitError
from labpipe.methods.journal_bearing.bearing import journal_equilibrium
from labpipe.methods.journal_bearing.curve import PARAMETERS
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.wear.model import WornModel, worn_model
from labpipe.methods.wear.settings import ANGLE, DEPTH
from labpipe.methods.wear.tables import film_slopes, table_range, tabulate
from labpipe.methods.wear.virtual_rig import receptance
from labpipe.records.uncertain import Uncertain
from tests.methods.wear.worn_cases import COARSE, FINE, LINES, NUISANCES, RIG, wear_settings, worn_rig

BETA = Uncertain(1.6e-4, 2e-5)
# Of a table whose own numbers are not looked at.
COARSEST = {"cells_around": 24, "cells_across": 4}


@pytest.fixture(scope="module")
def model() -> WornModel:
    """All that can be estimated but the cavitation pressure."""
    return worn_model(wear_settings(**NUISANCES, beta=BETA), LINES)


def point(model: WornModel, depth: float = 22.0, angle: float = 8.0) -> np.ndarray:
    """Scaled parameters, the known ones half a standard deviation above their mean."""
    return np.array([depth, angle, *(np.array(model.prior.mean) / model.scale[2:] + 0.5)])


def test_names_scales_and_bounds(model: WornModel) -> None:
    assert model.names == (DEPTH, ANGLE, "viscosity", "clearance", "beta")
    np.testing.assert_allclose(model.low[:2], [0, -20])
    np.testing.assert_allclose(model.high[:2], [50, 20])
    np.testing.assert_allclose((model.high - model.low)[2:], 8.0)
    assert model.values(point(model))["viscosity"] == pytest.approx(0.1044 + 0.0015)


@pytest.mark.parametrize("directional", ["FRF", "dFRF"])
def test_derivatives_equal_differences(model: WornModel, directional: str) -> None:
    own = worn_model(wear_settings(**NUISANCES, beta=BETA, response=directional), LINES)
    here = point(own)
    _, slopes = own.response(here)
    for number in range(here.size):
        step = 1e-4 * np.eye(here.size)[number]
        difference = (own.response(here + step)[0] - own.response(here - step)[0]) / 2e-4
        np.testing.assert_allclose(slopes[number], difference, atol=1e-4 * np.abs(difference).max())


def test_refined_model_is_the_film_and_its_slopes(model: WornModel) -> None:
    """Where it is corrected it is the response with coefficients from the films, and near it follows them.

    No wear that divides them.
    """
    here = point(model, depth=40.0)
    values = model.values(here)
    refined = model.refine(here)
    own = {name: values[name] for name in ("viscosity", "clearance")}

    def film(depth: float, angle: float) -> np.ndarray:
        return receptance_with_beta(values["beta"], worn_rig(depth, angle, **own))

    np.testing.assert_allclose(refined.response(here)[0], film(40.0, 8.0), rtol=1e-6)
    near = here + np.array([0.5, 0.5, 0, 0, 0])
    truth = film(40.5, 8.5)
    error = np.abs(refined.response(near)[0] - truth).max()
    assert error < 0.1 * np.abs(truth - film(40.0, 8.0)).max()


def receptance_with_beta(beta: float, rig: RotorRig) -> np.ndarray:
    return receptance(replace(rig, rotor=replace(rig.rotor, beta=beta)), LINES, FINE)


def test_what_refining_is_for(model: WornModel) -> None:
    """A coarse table errs by percents, which a fit would take for micrometres of wear.

    The refined model does not.
    """
    here = np.array([22.0, 8.0, *(np.array(model.prior.mean) / model.scale[2:])])
    truth = receptance(worn_rig(22.0, 8.0), LINES, FINE)
    errors = [
        np.abs(one.response(here)[0] - truth).max() / np.abs(truth).max()
        for one in (model, model.refine(here))
    ]
    assert errors[0] < 0.1 and errors[1] < 1e-4 * errors[0]


def test_healthy_model_has_no_wear(model: WornModel) -> None:
    healthy = worn_model(wear_settings(**NUISANCES, healthy=True), LINES)
    assert healthy.names == ("viscosity", "clearance")
    mean = np.array(healthy.prior.mean) / healthy.scale
    np.testing.assert_allclose(
        healthy.refine(mean).response(mean)[0], receptance(worn_rig(), LINES, FINE), rtol=1e-6
    )


def test_wear_alone_needs_no_table_of_the_other_bearing() -> None:
    alone = worn_model(wear_settings(), LINES)
    assert [bearing.table is None for bearing in alone.bearings] == [True, False]
    here = np.array([40.0, -5.0])
    np.testing.assert_allclose(
        alone.refine(here).response(here)[0], receptance(worn_rig(40.0, -5.0), LINES, FINE), rtol=1e-6
    )


@pytest.mark.long
def test_given_parameters_are_taken_as_they_are() -> None:
    given = worn_model(
        wear_settings(viscosity=Uncertain(0.11), beta=Uncertain(2e-4), healthy=False, **COARSEST), LINES
    )
    assert given.rig.rotor.beta == 2e-4 and {place.bearing.viscosity for place in given.rig.bearings} == {
        0.11
    }


@pytest.mark.long
def test_the_other_bearing_may_be_the_worn_one() -> None:
    first = worn_model(wear_settings(bearing="bearing 1"), LINES)
    assert [bearing.worn for bearing in first.bearings] == [True, False]
    here = np.array([20.0, 5.0])
    rig = RIG.with_bearings(["bearing 1"], wear_depth=20e-6, wear_angle=np.deg2rad(5))
    np.testing.assert_allclose(first.refine(here).response(here)[0], receptance(rig, LINES, FINE), rtol=1e-6)


def test_a_second_wear_does_not_go_with_nuisances() -> None:
    both = RIG.with_bearings(["bearing 1"], wear_depth=10e-6)
    with pytest.raises(ConfigError, match="'bearing 1' has a fixed wear"):
        worn_model(wear_settings(rig=both, **NUISANCES), LINES)
    assert worn_model(wear_settings(rig=both), LINES).bearings[0].fixed is not None


def test_no_rotor() -> None:
    with pytest.raises(FitError, match="no rotor was read"):
        worn_model(wear_settings(rig=None), LINES)


@pytest.mark.parametrize("name", ["viscosity", "clearance"])
def test_slopes_of_an_unworn_film_equal_differences(name: str) -> None:
    """Also that by clearance, which comes from that by viscosity.

    Within .5 % of the largest, what films of finite cells allow.
    """
    film = journal_equilibrium(RIG.bearings[0].bearing, (0.0, -35.4), RIG.omega, FINE)
    step = 0.005 * getattr(film.bearing, name)
    ends = [
        journal_equilibrium(
            replace(film.bearing, **{name: getattr(film.bearing, name) + s}), film.load, film.speed, FINE
        )
        for s in (step, -step)
    ]
    found = film_slopes(film, [name])
    assert list(found) == [name]
    for number, kind in enumerate(("stiffness", "damping")):
        difference = (getattr(ends[0], kind) - getattr(ends[1], kind)) / (2 * step)
        np.testing.assert_allclose(found[name][number], difference, atol=5e-3 * np.abs(difference).max())


def test_slopes_stand_under_their_names() -> None:
    """The bearing without wear follows viscosity and clearance, not wear.

    A parameter it has not has slope zero.
    """
    place = RIG.bearings[0]
    ranges = table_range(50e-6, 0.3, 1.05, 1.05)
    bearing = tabulate(place, (0.0, -35.4), RIG.omega, False, ranges, FilmMesh(*COARSE))
    values = {"wear_depth": 2e-5, "wear_angle": 0.1, "viscosity": 0.1, "clearance": 9e-5}
    found = bearing.support(values, (*PARAMETERS[:4], "beta"))
    assert [bool(np.any(found.stiffness_slopes[n])) for n in range(5)] == [False, False, True, True, False]


def test_a_healthy_rotor_without_a_film_has_its_shaft_s_damping_alone() -> None:
    linear = LINEAR.make(LinearBearingSettings(kind="linear-bearing", k_yy=1e6, c=100.0))
    places = tuple(replace(place, bearing=linear, kind="linear-bearing") for place in RIG.bearings)
    rig = replace(RIG, bearings=places)
    model = worn_model(wear_settings(healthy=True, beta=Uncertain(1.6e-4, 1e-5), rig=rig), LINES)
    assert model.names == ("beta",)

"""Metamodels over load and speed: against closed forms and other codes, saved and read back, and with one
load left out.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import ConfigError, DataError, FitError
from labpipe.methods.run_ups import metamodels
from labpipe.methods.run_ups.joint import fit_jointly
from labpipe.methods.run_ups.metamodel_kinds import (
    TERMS,
    Extent,
    Grid,
    PhysicalFit,
    fit_surface,
    physical_without,
)
from labpipe.methods.run_ups.metamodels import (
    METAMODELS,
    GaussianProcess,
    Metamodel,
    caution,
    fit_network,
    fit_process,
    from_entries,
    leave_one_load_out,
)
from labpipe.methods.run_ups.methods import fit_points
from labpipe.methods.run_ups.rotor import as_eight, coefficient_errors
from labpipe.methods.run_ups.virtual_rig import true_coefficients
from tests.methods.run_ups.run_up_cases import RIG, trained, virtual

LOADS = (4.0, 6.0, 8.0, 10.0)
SPEEDS = np.linspace(50.0, 300.0, 9)


def grid_of(function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Grid:
    """Eight columns of a function (n_point,) of load and speed, each another multiple."""
    load, speed = np.repeat(LOADS, SPEEDS.size), np.tile(SPEEDS, len(LOADS))
    return Grid(load, speed, function(load, speed)[:, None] * np.arange(1.0, 9.0))


def quadratic(load: np.ndarray, speed: np.ndarray) -> np.ndarray:
    w, s = (load - 7) / 3, (speed - 175) / 125
    return np.asarray(2000 + 300 * w - 500 * s + 80 * w * s + 40 * w**2 - 90 * s**2)


def smooth(load: np.ndarray, speed: np.ndarray) -> np.ndarray:
    return np.asarray(1000 + 50 * load + 300 * np.sin(speed / 90) * np.sqrt(load))


def needs(kind: str) -> None:
    if kind in ("network", "process"):
        pytest.importorskip("sklearn")


@pytest.fixture(scope="module", params=[*METAMODELS, "physical"])
def any_model(request: pytest.FixtureRequest) -> Metamodel:
    """One of every kind."""
    if request.param == "physical":
        return PhysicalFit.of(fit_jointly(RIG, trained("outside")[:2]), (50.0, 300.0))
    needs(request.param)
    return METAMODELS[request.param](grid_of(smooth), 3)


def test_a_second_order_surface_is_met_exactly() -> None:
    """Its coefficients are those of the polynomial in coded load and speed, and it holds beyond the grid."""
    model = fit_surface(grid_of(quadratic))
    np.testing.assert_allclose(model.beta[:, 0], [2000, 300, -500, 80, 40, -90], rtol=1e-9)
    np.testing.assert_allclose(
        model.predict(17.0, np.array([350.0]))[0, 2],
        3 * quadratic(np.array(17.0), np.array(350.0)),
        rtol=1e-9,
    )
    np.testing.assert_allclose(model.r2, 1)
    np.testing.assert_allclose(model.spread, 0, atol=1e-6)


def test_its_statistics_are_those_of_linear_regression(rng: np.random.Generator) -> None:
    """Errors of a new point and R^2 written out; PRESS by leaving every point out in turn."""
    grid = grid_of(quadratic)
    noisy = Grid(grid.load, grid.speed, grid.eight + 30 * rng.standard_normal(grid.eight.shape))
    model = fit_surface(noisy)
    w, s = (grid.load - 7) / 3, (grid.speed - 175) / 125
    x, y = np.stack([np.ones_like(w), w, s, w * s, w**2, s**2], axis=-1), noisy.eight[:, 4]
    beta, squares = np.linalg.lstsq(x, y, rcond=None)[:2]
    np.testing.assert_allclose(model.beta[:, 4], beta, rtol=1e-9)
    new = np.array([1.0, 0.5, -0.2, -0.1, 0.25, 0.04])
    error = np.sqrt((1 + new @ np.linalg.solve(x.T @ x, new)) * squares[0] / (y.size - 6))
    np.testing.assert_allclose(model.std_error(8.5, np.array([150.0]))[0, 4], error, rtol=1e-9)
    total = np.sum((y - y.mean()) ** 2)
    assert model.r2[4] == pytest.approx(1 - squares[0] / total)
    assert model.r2_adjusted[4] == pytest.approx(1 - (squares[0] / (y.size - 6)) / (total / (y.size - 1)))
    press = 0.0
    for left in range(y.size):
        kept = np.arange(y.size) != left
        press += (y[left] - x[left] @ np.linalg.lstsq(x[kept], y[kept], rcond=None)[0]) ** 2
    assert model.press[4] == pytest.approx(press)
    assert model.r2_predicted[4] == pytest.approx(1 - press / total)
    assert len(TERMS) == 6


def test_errors_of_the_surface_cover_new_points(rng: np.random.Generator) -> None:
    """New noisy points within one standard error as often as a normal distribution has it."""
    grid = grid_of(quadratic)
    model = fit_surface(Grid(grid.load, grid.speed, grid.eight + 30 * rng.standard_normal(grid.eight.shape)))
    missed = (
        grid.eight + 30 * rng.standard_normal(grid.eight.shape) - model.predict(grid.load, grid.speed)
    ) / model.std_error(grid.load, grid.speed)
    assert np.mean(np.abs(missed) < 1) == pytest.approx(0.683, abs=0.08)


def test_two_loads_do_not_determine_a_square() -> None:
    grid = grid_of(quadratic)
    two = Grid(*(getattr(grid, name)[grid.load < 7] for name in ("load", "speed", "eight")))
    with pytest.raises(FitError, match="three loads"):
        fit_surface(two)


def test_the_process_predicts_what_the_textbook_does(rng: np.random.Generator) -> None:
    """k^T (K + n^2)^-1 y and its variance, with all hyperparameters given (Rasmussen and Williams, 2.25 and
    2.26).
    """
    grid = grid_of(smooth)
    hyper = np.tile([0.8, 0.9, 0.5, 0.1], (8, 1))
    model = GaussianProcess.of(grid, hyper)
    x = Extent.of(grid).code(grid.load, grid.speed)
    asked = rng.uniform(-1.3, 1.3, (4, 2))

    def k(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        square = ((a[:, None, 0] - b[None, :, 0]) / 0.9) ** 2 + ((a[:, None, 1] - b[None, :, 1]) / 0.5) ** 2
        return np.asarray(9 * (1 + a @ b.T) + 0.64 * np.exp(-square / 2))

    y = grid.eight[:, 1]
    whole = k(x, x) + (0.01 + 1e-9) * np.eye(y.size)
    mean = y.mean() + y.std() * k(asked, x) @ np.linalg.solve(whole, (y - y.mean()) / y.std())
    variance = np.diag(k(asked, asked) - k(asked, x) @ np.linalg.solve(whole, k(x, asked))) + 0.01
    load, speed = 7 + 3 * asked[:, 0], 175 + 125 * asked[:, 1]
    np.testing.assert_allclose(model.predict(load, speed)[:, 1], mean, rtol=1e-7)
    np.testing.assert_allclose(model.std_error(load, speed)[:, 1], y.std() * np.sqrt(variance), rtol=1e-5)


def test_its_hyperparameters_are_at_a_maximum(rng: np.random.Generator) -> None:
    """No step of a tenth in any of the four raises the likelihood times the priors."""
    grid = grid_of(smooth)
    grid = Grid(grid.load, grid.speed, grid.eight * (1 + 0.02 * rng.standard_normal(grid.eight.shape)))
    hyper = fit_process(grid).hyper[0]
    x, y = Extent.of(grid).code(grid.load, grid.speed), grid.eight[:, 0]
    y = (y - y.mean()) / y.std()
    median, deviation = (np.array(column) for column in zip(*metamodels.HYPER, strict=True))

    def density(hyper: np.ndarray) -> float:
        square = np.sum(((x[:, None] - x[None]) / hyper[1:3]) ** 2, axis=-1)
        covariance = (
            9 * (1 + x @ x.T) + hyper[0] ** 2 * np.exp(-square / 2) + (hyper[3] ** 2 + 1e-9) * np.eye(y.size)
        )
        prior = stats.norm.logpdf(np.log(hyper / median) / deviation).sum()
        return float(stats.multivariate_normal.logpdf(y, cov=covariance) + prior)

    best = density(hyper)
    for n in range(4):
        for factor in (0.9, 1.1):
            assert density(hyper * np.where(np.arange(4) == n, factor, 1)) < best


def test_a_smooth_field_is_met_between_its_points_within_the_stated_error() -> None:
    model = fit_process(grid_of(smooth))
    load, speed = np.array([5.1, 6.7, 9.2]), np.array([70.0, 160.0, 250.0])
    true = smooth(load, speed)[:, None] * np.arange(1.0, 9.0)
    np.testing.assert_allclose(model.predict(load, speed), true, rtol=5e-3)
    assert np.all(np.abs(model.predict(load, speed) - true) < 4 * model.std_error(load, speed))
    assert np.all(model.std_error(30.0, speed) > 5 * model.std_error(7.0, speed))


@pytest.mark.long
def test_networks_follow_a_smooth_field_and_their_seed() -> None:
    pytest.importorskip("sklearn")
    grid = grid_of(smooth)
    model, again, other = (fit_network(grid, seed, repeats=3) for seed in (4, 4, 9))
    np.testing.assert_array_equal(model.predict(7.0, SPEEDS), again.predict(7.0, SPEEDS))
    assert np.any(model.predict(7.0, SPEEDS) != other.predict(7.0, SPEEDS))
    np.testing.assert_allclose(model.predict(grid.load, grid.speed), grid.eight, rtol=0.05)
    assert model.n_converged == 3 and len(model.repeats) == 3
    each = model.repeat_predictions(7.0, SPEEDS)
    np.testing.assert_allclose(model.std_error(7.0, SPEEDS), each.std(axis=0, ddof=1))
    assert np.isnan(fit_network(grid, repeats=1).std_error(7.0, SPEEDS)).all()


def test_a_network_is_what_scikit_learn_predicts() -> None:
    """The layers written out against the regressor's own predict."""
    networks = pytest.importorskip("sklearn.neural_network")
    grid = grid_of(smooth)
    x = Extent.of(grid).code(grid.load, grid.speed)
    y = (grid.eight - grid.eight.mean(axis=0)) / grid.eight.std(axis=0)
    theirs = networks.MLPRegressor(
        hidden_layer_sizes=(8,), activation="tanh", solver="lbfgs", alpha=1e-3, max_iter=4000, random_state=7
    ).fit(x, y)
    ours = fit_network(grid, 7, repeats=1).predict(grid.load, grid.speed)
    np.testing.assert_allclose(
        ours, grid.eight.mean(axis=0) + grid.eight.std(axis=0) * theirs.predict(x), rtol=1e-9
    )


@pytest.mark.parametrize(("kind", "module"), [("network", "neural_network"), ("process", "gaussian_process")])
def test_without_scikit_learn_it_is_said_what_to_install(
    kind: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, f"sklearn.{module}", None)
    with pytest.raises(ConfigError, match="scikit-learn, which is not installed") as caught:
        METAMODELS[kind](grid_of(smooth), 0)
    assert "labpipe[metamodels]" in caught.value.hint


def test_every_metamodel_is_read_back_as_it_was(any_model: Metamodel) -> None:
    """Through JSON and back: the same predictions, errors, extent and entries."""
    entries = json.loads(json.dumps(any_model.to_entries(), allow_nan=False))
    again = from_entries(entries)
    for load in (5.0, 12.0):
        np.testing.assert_allclose(again.predict(load, SPEEDS), any_model.predict(load, SPEEDS), rtol=1e-9)
        np.testing.assert_allclose(
            again.std_error(load, SPEEDS), any_model.std_error(load, SPEEDS), rtol=1e-6
        )
    assert (again.kind, again.extent, again.speeds) == (any_model.kind, any_model.extent, any_model.speeds)
    assert again.to_entries() == entries
    assert again.predict(5.0, SPEEDS).shape == again.std_error(5.0, SPEEDS).shape == (SPEEDS.size, 8)


def test_every_metamodel_says_how_it_was_made(any_model: Metamodel) -> None:
    words = {
        "surface": "36 points, over the eight coefficients R² 0.9",
        "process": "correlated over",
        "network": "10 repeats of 2 inputs, 8 hidden units and 8 outputs, seeds from 3 on; the training of "
        "all of them converged",
        "physical": "parameters of the joint fit",
    }
    assert words[any_model.kind] in any_model.statement


def test_a_load_beyond_those_of_the_fit_is_cautioned(any_model: Metamodel) -> None:
    low, high = any_model.extent.loads
    assert caution(any_model, (low + high) / 2) == caution(any_model, high) == ""
    assert "17 N lies outside the loads of this metamodel" in caution(any_model, 17.0)


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({}, "kind 'None'"),
        ({"kind": "surfaces"}, "kind 'surfaces'"),
        ({"kind": "surface"}, "damaged"),
        (
            {
                "kind": "process",
                "loads": [1, 2],
                "speeds": [1, 2],
                "load": [1],
                "speed": [1],
                "eight": [[1] * 8],
                "hyper": [[1]],
            },
            "damaged",
        ),
        ([1, 2], "kind 'None'"),
    ],
)
def test_entries_of_something_else_are_refused(entries: dict[str, object], said: str) -> None:
    with pytest.raises(DataError, match=said):
        from_entries(entries)


def test_a_surface_of_five_coefficients_is_refused() -> None:
    entries = fit_surface(grid_of(quadratic)).to_entries()
    entries["beta"] = [row[:5] for row in entries["beta"]]
    with pytest.raises(DataError, match="eight coefficients"):
        from_entries(entries)


def test_grids_without_points_are_refused() -> None:
    with pytest.raises(DataError, match="one load, one speed"):
        Grid(np.ones(2), np.ones(3), np.ones((2, 8)))
    with pytest.raises(DataError, match="finite"):
        Grid(np.ones(2), np.ones(2), np.full((2, 8), np.nan))


def test_the_grid_of_fits_and_of_a_joint_fit() -> None:
    runs = trained("outside")[:2]
    fits, joint = fit_points(RIG, runs), fit_jointly(RIG, runs)
    grid = Grid.of(fits)
    assert grid.loads == tuple(run.load for run in runs)
    np.testing.assert_array_equal(grid.at(runs[1].load).eight, fits[1].coefficients)
    assert grid.at(runs[1].load, others=True).loads == (runs[0].load,)
    sampled = Grid.sample(joint, joint.loads, SPEEDS)
    np.testing.assert_array_equal(sampled.at(runs[0].load).eight, joint.coefficients(runs[0].load, SPEEDS)[0])


@pytest.mark.long
def test_one_load_left_out_of_a_known_field() -> None:
    """A quadratic is predicted at every load by the surface.

    A wavy field is predicted better by the process than by the surface.
    """
    exact = leave_one_load_out(grid_of(quadratic), ["surface"])["surface"]
    assert [row.load for row in exact] == list(LOADS)
    assert [row.outside for row in exact] == [True, False, False, True]
    assert max(row.rms for row in exact) < 1e-9
    wavy = leave_one_load_out(grid_of(smooth), ["surface", "process"])
    inner = {kind: max(row.rms for row in rows if not row.outside) for kind, rows in wavy.items()}
    assert inner["process"] < 0.01 < inner["surface"]


def test_a_kind_that_cannot_do_without_a_load_says_so() -> None:
    grid = grid_of(quadratic)
    three = Grid(*(getattr(grid, name)[grid.load < 9] for name in ("load", "speed", "eight")))
    rows = leave_one_load_out(three, ["surface"])["surface"]
    assert all("three loads" in row.failed and np.isnan(row.rms) for row in rows)


def test_a_metamodel_of_one_load_cannot_be_validated() -> None:
    (run,) = trained("inside")[:1]
    grid = Grid(np.full(2, run.load), np.array([100.0, 200.0]), np.ones((2, 8)))
    rows = leave_one_load_out(grid, ["process", "network"], physical_without(RIG, [run]))
    for (row,) in rows.values():
        assert row.failed == "there is no other load to fit" and np.isnan(row.rms)


@pytest.mark.long
def test_the_physical_fit_predicts_a_load_it_never_saw_best() -> None:
    """On the rig outside its family: against the coefficients of the joint fit of all loads, and at the
    held-out load against the truth.
    """
    truth, runs = virtual("outside"), trained("outside")
    joint = fit_jointly(RIG, runs)
    grid = Grid.sample(joint, joint.loads, truth.omega)
    rows = leave_one_load_out(grid, ["surface", "process"], physical_without(RIG, runs))
    worst = {kind: max(row.rms for row in of_kind) for kind, of_kind in rows.items()}
    assert worst["physical"] < 0.06 < worst["process"] < worst["surface"]
    true = as_eight(*true_coefficients(truth, truth.held_out)(truth.omega))
    model = PhysicalFit.of(joint, (truth.omega[0], truth.omega[-1]))
    missed = {
        kind: float(np.sqrt(np.mean(coefficient_errors(one.predict(truth.held_out, truth.omega), true) ** 2)))
        for kind, one in {"surface": fit_surface(grid), "physical": model}.items()
    }
    assert missed["physical"] < 0.08 < missed["surface"]
    np.testing.assert_allclose(model.predict(7.0, truth.omega), joint.coefficients(7.0, truth.omega)[0])
    np.testing.assert_allclose(model.std_error(7.0, truth.omega), joint.coefficients(7.0, truth.omega)[1])

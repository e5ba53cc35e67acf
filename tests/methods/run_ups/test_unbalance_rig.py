"""The virtual unbalance rig: its three truths, noise, unstable speeds, names."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.rotor.response import GROWTH_TOLERANCE
from labpipe.methods.run_ups.rotor import as_eight
from labpipe.methods.run_ups.virtual_rig import (
    HIGHEST_FACTOR,
    LOWEST_FACTOR,
    RunUpNoise,
    VirtualUnbalanceRig,
    run_ups,
    smooth_factors,
    true_coefficients,
    truth,
)
from labpipe.project.simulate import load_virtual_rig

CONFIG = Path(__file__).parents[3] / "configs/virtual-unbalance.yaml"
RIG: VirtualUnbalanceRig = load_virtual_rig(CONFIG)


def test_the_shipped_rig_is_that_of_the_source() -> None:
    """Printed loads in pounds, 400 to 3000 rpm; 27 speeds are our own."""
    np.testing.assert_allclose(
        [*RIG.loads, RIG.held_out], 4.4482216 * np.array([0.823, 1.321, 1.817, 2.316, 3.808]), rtol=1e-7
    )
    np.testing.assert_allclose(RIG.omega * 30 / np.pi, np.arange(400, 3001, 100))
    assert list(RIG.load_of_run) == ["load-1", "load-2", "load-3", "load-4", "held-out"]
    assert RIG.nominal.pinned.n_dof == 12


def test_run_ups_hold_no_speed_at_which_the_rotor_is_unstable() -> None:
    for run in run_ups(RIG, 1):
        coefficients = true_coefficients(RIG, run.load)
        growth = RIG.nominal.stability.growth(RIG.omega, *coefficients(RIG.omega))
        np.testing.assert_allclose(run.speed, RIG.omega[growth <= GROWTH_TOLERANCE])
        threshold = RIG.nominal.threshold(coefficients)
        assert threshold is not None and run.speed.max() < threshold
        assert run.n_speed == (27 if threshold > RIG.omega[-1] else np.count_nonzero(RIG.omega < threshold))


def test_noise_has_the_stated_size() -> None:
    """1 % and 1 deg about the exact response, over 400 speeds below the threshold."""
    fine = dataclasses.replace(RIG, count=400, speeds=(400 / 60, 2700 / 60))
    run = run_ups(fine, 7, ["load-2"])[0]
    exact = fine.nominal.response(run.speed, true_coefficients(fine, run.load))
    ratio = run.response / exact
    assert np.std(np.abs(ratio)) == pytest.approx(0.01, rel=0.05)
    assert np.degrees(np.std(np.angle(ratio))) == pytest.approx(1, rel=0.05)
    np.testing.assert_allclose(run.amplitude_error, 0.01 * np.abs(run.response))
    np.testing.assert_allclose(run.phase_error, np.deg2rad(1))


def test_a_seed_makes_the_same_noise_whichever_runs_are_asked_for() -> None:
    alone, among = run_ups(RIG, 3, ["load-4"])[0], run_ups(RIG, 3)[3]
    np.testing.assert_array_equal(alone.response, among.response)
    assert np.max(np.abs(run_ups(RIG, 4, ["load-4"])[0].response - alone.response)) > 0


def test_measured_thresholds_scatter_by_their_uncertainty() -> None:
    thresholds = [run_ups(RIG, seed, ["load-1"])[0].threshold for seed in range(30)]
    exact = RIG.nominal.threshold(true_coefficients(RIG, RIG.loads[0]))
    missed = [
        (one.value - exact) / one.std_error for one in thresholds if one is not None and exact is not None
    ]
    assert len(missed) == 30
    assert 0.7 < np.std(missed) < 1.35


def test_factors_are_smooth_and_within_their_limits() -> None:
    speed = np.linspace(RIG.omega[0], RIG.omega[-1], 200)
    loads = np.linspace(RIG.loads[0], RIG.held_out, 50)
    found = np.array(
        [smooth_factors(load, speed, (RIG.loads[0], RIG.held_out), (speed[0], speed[-1])) for load in loads]
    )
    assert LOWEST_FACTOR <= found.min() < 0.78 and 1.21 < found.max() <= HIGHEST_FACTOR
    assert np.max(np.abs(np.diff(found, axis=1))) < 0.01
    correlation = np.corrcoef(found.reshape(-1, 8).T)
    assert np.max(np.abs(correlation - np.eye(8))) < 0.999


@pytest.mark.parametrize("kind", ["factors", "inside", "outside"])
def test_every_truth_differs_from_the_rotor_file_and_says_how(kind: str) -> None:
    rig = dataclasses.replace(RIG, truth=kind)
    stated = truth(rig)
    assert stated["kind"] == kind
    for name, load in rig.load_of_run.items():
        eight = as_eight(*true_coefficients(rig, load)(rig.omega))
        np.testing.assert_allclose(stated["loads"][name]["coefficients"], eight, rtol=1e-5)
        start = as_eight(*rig.nominal.start_coefficients(load, rig.omega))
        assert 0.03 < np.median(np.abs(eight / start - 1)) < 0.4
        assert stated["loads"][name]["critical_speed"] < stated["loads"][name]["threshold"]


def test_without_errors_the_outside_truth_is_the_rotor_file_s() -> None:
    rig = dataclasses.replace(
        RIG, viscosity_error=0.0, clearance_error=0.0, heating=0.0, groove_width=np.deg2rad(20)
    )
    ours, start = (
        as_eight(*one)
        for one in (true_coefficients(rig, 5.0)(rig.omega), rig.nominal.start_coefficients(5.0, rig.omega))
    )
    np.testing.assert_allclose(ours, start, rtol=1e-10)


def test_thinner_oil_is_a_bearing_of_lower_viscosity() -> None:
    """Without heating: the same as a rotor file with that viscosity."""
    rig = dataclasses.replace(
        RIG, clearance_error=0.0, heating=0.0, groove_width=np.deg2rad(20), viscosity_error=-0.2
    )
    place = rig.nominal.place
    thin = dataclasses.replace(
        place, bearing=dataclasses.replace(place.bearing, viscosity=0.8 * place.bearing.viscosity)
    )
    expected = dataclasses.replace(rig.nominal, place=thin).start_coefficients(5.0, rig.omega)
    np.testing.assert_allclose(
        as_eight(*true_coefficients(rig, 5.0)(rig.omega)), as_eight(*expected), rtol=1e-10
    )


def test_further_runs_for_what_a_load_alone_cannot_tell() -> None:
    rig = dataclasses.replace(RIG, second_unbalance=True, shaker=True)
    second, shaken = run_ups(rig, 1, ["load-3-second", "load-3-shaker"])
    assert second.unbalance == {"disc 2": pytest.approx(50e-6)} and second.threshold is None
    assert shaken.shaker is not None and shaken.shaker.plane == "disc 1" and not shaken.unbalance
    assert set(truth(rig)["loads"]) == {"load-1", "load-2", "load-3", "load-4", "held-out"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"count": 1}, "2 to 1000 speeds"),
        ({"speeds": (50.0, 10.0)}, "the lower frequency comes first"),
        ({"loads": ()}, "loads: is empty"),
        ({"held_out": -1.0}, "held_out must be positive"),
        ({"viscosity_error": -0.7}, "between -50 % and 50 %"),
        ({"heating": 0.6}, "heating between"),
        ({"shaker_force": 0.0}, "must be positive"),
    ],
)
def test_rigs_that_cannot_be_are_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        dataclasses.replace(RIG, **changes)  # type: ignore[arg-type]
    assert said in str(caught.value)


def test_no_noise_no_rotor_and_no_such_run_are_refused() -> None:
    with pytest.raises(ConfigError, match="amplitude must be positive"):
        RunUpNoise(amplitude=0.0)
    with pytest.raises(ConfigError, match="no rotor was read"):
        run_ups(dataclasses.replace(RIG, rig=None), 1)
    with pytest.raises(ConfigError, match="no run 'load-9'"):
        run_ups(RIG, 1, ["load-9"])


def test_a_rig_unstable_throughout_has_no_run_up() -> None:
    fast = dataclasses.replace(RIG, speeds=(80.0, 90.0))
    with pytest.raises(ConfigError, match="unstable at every speed"):
        run_ups(fast, 1, ["load-1"])

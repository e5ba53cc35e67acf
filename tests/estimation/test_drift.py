"""Drift between the halves of a record: exact changes of a model, noise alone, and both."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.finding import Finding
from labpipe.records.response import FrequencyResponse
from tests.estimation.conftest import COUPLED_C, COUPLED_K, PEDESTAL

STD = 2e-8
COUPLED = FitSettings("rotor-2dof", mass=0.92)


def coupled(k_factor: float = 1.0, c_factor: float = 1.0, frequency: np.ndarray | None = None) -> np.ndarray:
    """H of the cross-coupled support, 40-120 Hz every 1 Hz."""
    w = 2 * np.pi * (np.arange(40.0, 121.0) if frequency is None else frequency)[:, None, None]
    return np.linalg.inv(k_factor * COUPLED_K + 1j * w * c_factor * COUPLED_C - w**2 * 0.92 * np.eye(2))


def changed(
    response: FrequencyResponse, change: np.ndarray, rng: np.random.Generator | None, std: float = STD
) -> FrequencyResponse:
    """The response with the change of its second half: each half has twice the variance of the whole, their
    difference four times.
    """
    shape = response.matrix.shape
    noise = (
        0.0 if rng is None else 2 * std * (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)
    )
    return replace(response, change=change + noise)


def drift(response: FrequencyResponse, settings: FitSettings = COUPLED) -> Finding | None:
    (fit,) = identify(response, settings)
    findings = [finding for finding in fit.findings if finding.code == "drift"]
    return findings[0] if findings else None


SHAPES = {
    "all stiffness": (coupled(1.01) - coupled(), 1.0),
    "all damping": (coupled(c_factor=1.05) - coupled(), 5.0),
    "the gain of x": (0.02 * coupled() * np.array([[1.0], [0.0]]), 2.0),
    # A force that shows 2 % more makes the response to it 2 % less.
    "the gain of fy": (-0.02 * coupled() * np.array([[0.0, 1.0]]), 2.0),
}


@pytest.mark.parametrize("name", SHAPES)
def test_each_shape_is_told_from_the_others_with_its_amount(coupled_response, name: str) -> None:
    rng = np.random.default_rng(1)
    change, per_cent = SHAPES[name]
    finding = drift(changed(coupled_response(STD, rng), change, rng))
    assert finding is not None
    amount, error = map(
        float, re.findall(f"looks like {name} changed by ([-+.0-9]+) \\+- ([.0-9]+) %", finding.message)[0]
    )
    # 1 % of stiffness is beyond first order by 1 % of itself; amounts are written with two digits.
    assert amount == pytest.approx(per_cent, abs=4 * error + 0.05 * abs(per_cent))


@pytest.mark.parametrize(("name", "mask", "sign"), [("y", [[0.0], [1.0]], 1), ("fx", [[1.0, 0.0]], -1)])
def test_a_lag_that_grows_is_told_from_what_changes_in_the_rig(
    coupled_response, name: str, mask: list[list[float]], sign: int
) -> None:
    """H exp(-j w tau) - H of one channel, early for a force: clocks 50 ppm apart over 2 s."""
    rng = np.random.default_rng(7)
    w = 2 * np.pi * np.arange(40.0, 121.0)[:, None, None]
    change = coupled() * np.array(mask) * (np.exp(-1j * w * sign * 1e-4) - 1)
    finding = drift(changed(coupled_response(STD, rng), change, rng))
    assert finding is not None
    found = re.search(rf"the delay of {name} changed by \+([.0-9]+) \+- ([.0-9]+) us, as", finding.message)
    assert found is not None, finding.message
    assert abs(float(found[1]) - 100) < 4 * float(found[2])


def test_a_signal_that_is_lost_is_no_gain_that_changed(sdof_response) -> None:
    """In the second half nothing is left: the change is twice the mean of both."""
    rng = np.random.default_rng(8)
    response = sdof_response(1e-7, rng)
    finding = drift(
        changed(response, -2 * response.matrix, rng, 1e-7), FitSettings("sdof", mass=PEDESTAL["m"])
    )
    assert finding is not None and "in one half its signal is hardly there" in finding.message


def test_a_single_coefficient_is_named(coupled_response) -> None:
    """k_yx alone by 2 kN/m: no common factor, no gain."""
    rng = np.random.default_rng(2)
    w = 2 * np.pi * np.arange(40.0, 121.0)[:, None, None]
    other = COUPLED_K + np.array([[0.0, 0.0], [2e3, 0.0]])
    change = np.linalg.inv(other + 1j * w * COUPLED_C - w**2 * 0.92 * np.eye(2)) - coupled()
    finding = drift(changed(coupled_response(STD, rng), change, rng))
    assert finding is not None
    amount, error = map(
        float, re.findall(r"most of all k_yx by ([-+.e0-9]+) \+- ([.e+0-9]+) kN/m", finding.message)[0]
    )
    assert amount == pytest.approx(2.0, abs=4 * error + 0.02 * 2.0)


@pytest.mark.long
@pytest.mark.parametrize(("stated", "runs"), [(4.0, 60), (0.25, 5)])
def test_noise_alone_is_no_drift_however_wrong_its_stated_size(
    coupled_response, stated: float, runs: int
) -> None:
    """A test of 0.1 %, held to 1 % and three binomial deviations, two of 60: 10 % are seen in 95 of 100,
    of 5 none: 40 % are seen in 92.

    The covariance may be wrong by any factor.
    """
    alarms = 0
    for seed in range(runs):
        rng = np.random.default_rng([3, seed])
        response = changed(coupled_response(STD, rng), np.zeros((81, 2, 2)), rng)
        assert response.covariance is not None
        alarms += drift(replace(response, covariance=stated * response.covariance)) is not None
    assert alarms / runs < 0.01 + 3 * np.sqrt(0.01 / runs)


def test_one_force_and_one_response_have_one_gain(sdof_response) -> None:
    rng = np.random.default_rng(4)
    response = sdof_response(1e-7, rng)
    finding = drift(
        changed(response, 0.05 * response.matrix, rng, 1e-7), FitSettings("sdof", mass=PEDESTAL["m"])
    )
    assert finding is not None and "the gain of y or f" in finding.message


def test_nothing_is_said_without_halves_or_noise(coupled_response) -> None:
    change = SHAPES["all stiffness"][0]
    sound = coupled_response(STD, np.random.default_rng(5))
    assert drift(sound) is None
    assert drift(replace(coupled_response(), change=change)) is None
    assert drift(replace(sound, change=change)) is not None

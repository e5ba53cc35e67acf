"""What a shaker says of the displacement under a static load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.records.identification import Fit
from labpipe.records.uncertain import Budget, Uncertainty
from labpipe.uncertainty.matrix import STIFFNESS, mean_compliance
from labpipe.uncertainty.settings import EquilibriumSettings
from tests.uncertainty.conftest import a_fit

K = np.array([[4.0, 1.0], [-2.0, 3.0]])


def test_the_mean_of_repeats_has_their_covariance_over_their_number() -> None:
    """K^-1 u by numbers, its covariance by central differences of each coefficient.

    Three repeats that say the same.
    """
    settings = EquilibriumSettings(load="load", x="x", y="y", direction=0.3, support=0.5)
    load = np.array([np.cos(0.3), np.sin(0.3)])

    def displacement(change: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.solve(K + 0.5 * np.eye(2) + change, load))

    step = 1e-6
    units = np.eye(4).reshape(4, 2, 2)
    slopes = np.column_stack(
        [(displacement(step * unit) - displacement(-step * unit)) / (2 * step) for unit in units]
    )
    values = {name: (float(value), 0.01) for name, value in zip(STIFFNESS, K.ravel(), strict=True)}
    for repeats in (1, 3):
        found = mean_compliance(settings, [a_fit(f"test {n}", values) for n in range(repeats)])
        assert found is not None
        np.testing.assert_allclose(found[0], displacement(np.zeros((2, 2))), rtol=1e-12)
        np.testing.assert_allclose(found[1], 0.01**2 * slopes @ slopes.T / repeats, rtol=1e-7)


def test_no_coefficients_no_displacement() -> None:
    settings = EquilibriumSettings(load="load", x="x", y="y")
    assert mean_compliance(settings, [a_fit("test", {"k_xx": (4.0, 0.01)})]) is None


def test_an_error_in_common_does_not_shrink_with_repeats() -> None:
    """A gain of 2 % on all of K: K^-1 u goes 2 % the other way.

    One sensor in three repeats, then one sensor in each.
    """
    settings = EquilibriumSettings(load="load", x="x", y="y", direction=0.3)
    load = np.array([np.cos(0.3), np.sin(0.3)])
    values = {name: (float(value), 0.01) for name, value in zip(STIFFNESS, K.ravel(), strict=True)}
    gain = 0.02 * np.linalg.solve(K, load)

    def fit(number: int, source: str) -> Fit:
        plain = a_fit(f"test {number}", values)
        changes = -0.02 * np.array([[plain.parameter(name).value for name in STIFFNESS]])
        budget = Budget(STIFFNESS, np.full(4, 0.01), None, (Uncertainty(source, 0.02, "1"),), changes)
        combined = [
            replace(
                parameter, std_error_inflated=float(np.hypot(0.01, change)), systematic=abs(float(change))
            )
            for parameter, change in zip(plain.parameters, changes[0], strict=True)
        ]
        return replace(plain, parameters=tuple(combined), budget=budget)

    noise = mean_compliance(settings, [a_fit(f"test {n}", values) for n in range(3)])
    common = mean_compliance(settings, [fit(n, "cell") for n in range(3)])
    each = mean_compliance(settings, [fit(n, f"cell {n}") for n in range(3)])
    assert noise is not None and common is not None and each is not None
    np.testing.assert_allclose(common[1] - noise[1], np.outer(gain, gain), rtol=1e-9)
    np.testing.assert_allclose(each[1] - noise[1], np.outer(gain, gain) / 3, rtol=1e-9)

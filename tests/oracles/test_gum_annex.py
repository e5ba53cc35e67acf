"""The printed examples of JCGM 100:2008 (GUM), annex H, by labpipe's own propagation.

H.1 end-gauge: 50.000838 mm, u_c 32 nm, 16 effective degrees of freedom, U 93 nm at 99 %, with second-order terms 34 nm.
H.2 resistance and reactance from five simultaneous readings: R 127.732(71), X 219.847(295), Z 254.260(236) ohm,
correlations -.588, -.485, .993.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.distributions import student_quantile
from labpipe.identify.corrections import Estimated
from labpipe.identify.derived import propagated
from labpipe.identify.monte_carlo import drawn_error
from labpipe.records.budget import Budget
from labpipe.records.doubt import Doubt

LENGTH, DIFFERENCE = 50.000623e-3, 215e-9
EXPANSION, TEMPERATURE = 11.5e-6, -0.1
# As printed in table H.1; from their unrounded half widths (1e-6 / K, 0.05 K) the expanded uncertainty would be 92.5 nm.
DOUBTS = {
    "standard": Doubt("standard", 25e-9, "m", dof=18.0),
    "comparison": Doubt("comparison", 9.7e-9, "m", dof=25.6),
    "expansion difference": Doubt("expansion difference", 0.58e-6, "1/K", dof=50.0, shape="rectangular"),
    "temperature difference": Doubt("temperature difference", 0.029, "K", dof=2.0, shape="rectangular"),
}


def test_the_end_gauge() -> None:
    """l = l_s + d - l_s (da theta + a_s dtheta); coefficients 1, 1, -l_s theta, -l_s a_s (GUM H.1.3)."""
    slopes = (1.0, 1.0, -LENGTH * TEMPERATURE, -LENGTH * EXPANSION)
    changes = np.array([[slope * doubt.std_error] for slope, doubt in zip(slopes, DOUBTS.values(), strict=True)])
    budget = Budget(("l",), np.zeros(1), None, tuple(DOUBTS.values()), changes)
    assert pytest.approx(50.000838e-3, abs=5e-10) == LENGTH + DIFFERENCE
    assert round(1e9 * budget.combined[0]) == 32
    assert int(budget.dof[0]) == 16
    assert round(1e9 * student_quantile(0.995, 16) * budget.combined[0]) == 93
    assert next(iter(budget.shares("l"))) == "standard"


def test_the_end_gauge_beyond_first_order(rng) -> None:
    """GUM H.1.7: terms of second order, expansion times temperature, make 34 nm; 200,000 draws of the whole function say the same.

    The mean temperature's 0.5 K cycle (arc-sine) and 0.2 K (normal) enter by the expansion difference only: theta = -0.1 K +- 0.41 K.
    """
    draws = 200_000
    theta = TEMPERATURE + 0.2 * rng.standard_normal(draws) + 0.5 * np.sin(2 * np.pi * rng.uniform(size=draws))
    expansion = EXPANSION + 2e-6 * rng.uniform(-1, 1, draws)
    length, difference = (scale * rng.standard_normal(draws) for scale in (25e-9, 9.7e-9))
    da, dtheta = (
        np.array([drawn_error(DOUBTS[name], np.random.default_rng(seed)) for seed in range(2000)])[rng.integers(0, 2000, draws)]
        for name in ("expansion difference", "temperature difference")
    )
    scatter = np.std(length + difference - LENGTH * (da * theta + expansion * dtheta))
    assert round(1e9 * scatter) == 34


VOLT = np.array([5.007, 4.994, 5.005, 4.990, 4.999])
AMPERE = 1e-3 * np.array([19.663, 19.639, 19.640, 19.685, 19.678])
PHASE = np.array([1.0456, 1.0438, 1.0468, 1.0428, 1.0433])


def test_resistance_and_reactance_from_correlated_readings() -> None:
    readings = np.array([VOLT, AMPERE, PHASE])
    volt, ampere, phase = readings.mean(axis=1)
    means = Estimated(("V", "I", "phi"), ("V", "A", "rad"), readings.mean(axis=1), np.cov(readings) / 5)
    impedance = volt / ampere
    r, x = impedance * np.cos(phase), impedance * np.sin(phase)
    slopes = {
        "R": {"V": r / volt, "I": -r / ampere, "phi": -x},
        "X": {"V": x / volt, "I": -x / ampere, "phi": r},
        "Z": {"V": impedance / volt, "I": -impedance / ampere},
    }
    assert (round(r, 3), round(x, 3), round(impedance, 3)) == (127.732, 219.847, 254.260)
    errors = {name: propagated(means, of_name) for name, of_name in slopes.items()}
    assert round(errors["R"], 3) == 0.071
    assert errors["X"] == pytest.approx(0.295, abs=1e-3)
    assert round(errors["Z"], 3) == 0.236
    rows = np.array([[of_name.get(name, 0.0) for name in means.names] for of_name in slopes.values()])
    covariance = rows @ means.covariance @ rows.T
    correlation = covariance / np.outer(*[np.sqrt(np.diag(covariance))] * 2)
    np.testing.assert_allclose(correlation[np.triu_indices(3, 1)], [-0.588, -0.485, 0.993], atol=1e-3)

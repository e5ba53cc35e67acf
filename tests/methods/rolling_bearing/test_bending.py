"""The bending shaft in series: closed forms, the error law against sampling, intervals that cover, what is
refused.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate

from labpipe.errors import ConfigError, FitError
from labpipe.methods.rolling_bearing.loads import BendingShaft, damping_without_shaft, without_shaft
from labpipe.records.uncertain import Uncertain

BEAM = BendingShaft(2.1e11, 37e-3, 0.20, 7800, ends=0.06)


def test_static_stiffness_from_the_bending_moment() -> None:
    """Deflection at mid span under a unit load at s, by the unit-load integral int M_1 M_2 dx / (E I)."""
    span, s = 0.20, 0.07

    def moment(x: float, load: float) -> float:
        return x * (span - load) / span if x < load else load * (span - x) / span

    def deflection(load: float) -> float:
        points = (load, span / 2)
        return (
            integrate.quad(lambda x: moment(x, load) * moment(x, span / 2), 0, span, points=points)[0]
            / BEAM.rigidity
        )

    assert BEAM.static_stiffness(s) == pytest.approx(1 / deflection(s), rel=1e-9)
    assert (
        BEAM.static_stiffness()
        == pytest.approx(1 / deflection(span / 2), rel=1e-9)
        == 48 * BEAM.rigidity / span**3
    )


def test_energy_stiffness_and_masses_by_quadrature() -> None:
    """First mode y = cos(pi x / l) over -l/2 ... l/2."""
    wave = math.pi / 0.20
    curvature = integrate.quad(lambda x: (wave**2 * math.cos(wave * x)) ** 2, -0.1, 0.1)[0]
    motion = integrate.quad(lambda x: math.cos(wave * x) ** 2, -0.1, 0.1)[0]
    area = math.pi * 37e-3**2 / 4
    assert BEAM.energy_stiffness() == pytest.approx(BEAM.rigidity * curvature, rel=1e-10)
    assert BEAM.equivalent_mass() == pytest.approx(7800 * area * motion, rel=1e-10)
    assert BEAM.total_mass() == pytest.approx(7800 * area * 0.26)


def test_series_correction_in_closed_form() -> None:
    """Two equal springs: the total is half of either, the relative error doubles."""
    corrected = without_shaft(Uncertain(5e7, 5e5), Uncertain(1e8))
    assert corrected.bearing == Uncertain(pytest.approx(1e8), pytest.approx(2e6))
    assert corrected.amplification == pytest.approx(2)


def test_the_printed_error_law() -> None:
    """s_b/k_b = (k_b/k_total) s_total/k_total combined with (k_b/k_shaft) s_shaft/k_shaft."""
    total, shaft = Uncertain(8e7, 1e6), Uncertain(1.2e8, 3e6)
    bearing = without_shaft(total, shaft).bearing
    law = math.hypot(bearing.value / 8e7 * 1e6 / 8e7, bearing.value / 1.2e8 * 3e6 / 1.2e8)
    assert bearing.std_error / bearing.value == pytest.approx(law)


def test_standard_error_and_interval_against_sampling(rng) -> None:
    total, shaft = (8e7, 1e6), (1.2e8, 2e6)
    draws_total, draws_shaft = rng.normal(*total, 20_000), rng.normal(*shaft, 20_000)
    sampled = 1 / (1 / draws_total - 1 / draws_shaft)
    corrected = without_shaft(Uncertain(*total), Uncertain(*shaft))
    assert corrected.bearing.std_error == pytest.approx(np.std(sampled), rel=0.1)
    assert corrected.ci95 == pytest.approx(np.quantile(sampled, [0.025, 0.975]), rel=0.02)
    truth = corrected.bearing.value
    pairs = zip(draws_total[:2000], draws_shaft[:2000], strict=True)
    intervals = [without_shaft(Uncertain(t, 1e6), Uncertain(s, 2e6)).ci95 for t, s in pairs]
    assert 0.935 < np.mean([low <= truth <= high for low, high in intervals]) < 0.965


def test_where_the_bearing_cannot_be_told_from_rigid_the_interval_is_open() -> None:
    corrected = without_shaft(Uncertain(1.15e8, 3e6), Uncertain(1.2e8, 1e6))
    assert corrected.ci95[1] == math.inf and 0 < corrected.ci95[0] < corrected.bearing.value


@pytest.mark.parametrize(
    ("total", "shaft", "message"),
    [
        (1.2e8, 1.2e8, "is not below the shaft's 1.2e\\+08 N/m"),
        (1.3e8, 1.2e8, "two springs in series are softer than either"),
        (-1e7, 1.2e8, "must be above zero"),
        (1e7, 0.0, "must be above zero"),
    ],
)
def test_impossible_series_are_refused(total: float, shaft: float, message: str) -> None:
    with pytest.raises(FitError) as fault:
        without_shaft(Uncertain(total, 1e5), Uncertain(shaft, 1e5))
    assert message.replace("\\", "") in str(fault.value)


def test_damping_against_the_complex_series(rng) -> None:
    """(k_t + j w c_t) = 1 / (1/(k_b + j w c_b) + 1/k_s) at a low frequency; the error by sampling."""
    k_b, c_b, k_s, w = 2.0e8, 900.0, 1.2e8, 10.0
    total = 1 / (1 / (k_b + 1j * w * c_b) + 1 / k_s)
    found = damping_without_shaft(
        Uncertain(total.imag / w, 3.0), Uncertain(total.real, 5e5), Uncertain(k_s, 8e5)
    )
    assert found.value == pytest.approx(c_b, rel=1e-6)
    draws = [
        rng.normal(mean, error, 20_000)
        for mean, error in ((total.imag / w, 3.0), (total.real, 5e5), (k_s, 8e5))
    ]
    sampled = draws[0] * (draws[2] / (draws[2] - draws[1])) ** 2
    assert found.std_error == pytest.approx(np.std(sampled), rel=0.05)


@pytest.mark.parametrize("load_point", [0.0, -0.01, 0.11])
def test_a_load_outside_the_span_is_refused(load_point: float) -> None:
    with pytest.raises(ConfigError, match="is not between a support and mid span"):
        BEAM.static_stiffness(load_point)


def test_an_impossible_shaft_is_refused() -> None:
    with pytest.raises(ConfigError, match="must be above zero"):
        BendingShaft(2.1e11, 0.0, 0.2)

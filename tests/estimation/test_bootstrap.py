"""Bootstrap intervals against the first-order ones where both must agree, and their faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import FitError, SettingError
from labpipe.estimation.draws import with_scatter
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.finding import Parameter

SDOF = FitSettings("sdof", mass="estimate", name="pedestal", bootstrap=200)


@pytest.mark.long
def test_bootstrap_agrees_with_the_information_matrix(sdof_response) -> None:
    response = sdof_response(1e-7, np.random.default_rng(1))
    (plain,), (again,) = identify(response, replace(SDOF, bootstrap=0)), identify(response, SDOF)
    for name in ("k", "c", "m", "f_n", "zeta"):
        own, other = again.parameter(name), plain.parameter(name)
        assert own.value == other.value
        # A standard deviation of 200 values is known to 5 %, an end of the interval to 12 % of its width;
        # three of those.
        assert own.std_error == pytest.approx(other.std_error, rel=0.15)
        np.testing.assert_allclose(own.ci95, other.ci95, atol=0.36 * (other.ci95[1] - other.ci95[0]) / 2)
    assert any("bootstrap" in note for note in again.notes)


def test_the_same_fit_draws_the_same_noise(sdof_response) -> None:
    response = sdof_response(1e-7, np.random.default_rng(1))
    first, second = (identify(response, replace(SDOF, bootstrap=50))[0] for _ in range(2))
    assert first.parameter("k") == second.parameter("k")


def test_weights_of_few_degrees_of_freedom_cost_refits_what_they_cost_the_fit(sdof_response) -> None:
    """A variance that was estimated from 6 degrees of freedom: estimates vary by 6^2 / (5^2 - 1) = 1.5 times
    what known weights leave (the mean of its inverse and of the inverse's square), in draws as well. `ls`
    has no weights.
    """
    known = sdof_response(1e-9, np.random.default_rng(1))
    for estimator, factor in (("ml", 1.5**0.5), ("ls", 1.0)):
        asked = replace(SDOF, bootstrap=60, estimator=estimator, weight="none")
        first, other = (
            identify(of, asked, judging=False)[0].parameter("k")
            for of in (known, replace(known, covariance_dof=6.0))
        )
        assert other.std_error / first.std_error == pytest.approx(factor, rel=1e-3)


def test_error_and_interval_are_those_of_the_refits() -> None:
    """Of 0, 1, ..., 200: 2.5 and 97.5 % are 5 and 195, the variance n (n + 1) / 12 with n = 201.

    Too few of them change nothing.
    """
    values = [float(n) for n in range(201)]
    plain = Parameter("k", 100.0, "N/m", std_error=1.0, t_ratio=100.0, ci95=(98.0, 102.0), significant=True)
    found = with_scatter(plain, values)
    error = np.sqrt(201 * 202 / 12)
    assert (found.std_error, found.t_ratio, found.ci95) == (
        pytest.approx(error),
        pytest.approx(100 / error),
        (5.0, 195.0),
    )
    assert found.significant and with_scatter(plain, [value - 10 for value in values]).significant is False
    assert with_scatter(plain, values[:47]) == plain != with_scatter(plain, values[:48])
    derived = replace(plain, std_error=None)
    assert with_scatter(derived, values) == derived


def test_what_bootstrap_needs_is_said(sdof_response) -> None:
    with pytest.raises(FitError, match="not known"):
        identify(sdof_response(), SDOF)
    for key, fewest in (("bootstrap", 50), ("monte_carlo", 200)):
        with pytest.raises(SettingError, match=f"'{key}' of {fewest - 1} draws gives no 95 % interval"):
            replace(SDOF, **{key: fewest - 1})
        assert getattr(replace(SDOF, **{key: fewest}), key) == fewest

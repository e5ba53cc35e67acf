"""What a residual that is not noise does to the intervals.

Faults and noise are drawn here, truths are known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, diagonal_covariance
from tests.estimation.test_residual_structure import F0, ZETA, response

HANN = (-2 / 3, 1 / 6)


def mismatch(fit: Fit) -> str:
    """The message of the mismatch, empty without one."""
    return next((finding.message for finding in fit.findings if finding.code == "model-mismatch"), "")


def hann(seed: int) -> FrequencyResponse:
    """A right model with noise as a Hann window leaves it: every line minus half of both neighbours."""
    clean = response("", seed)
    n_line = clean.frequency.size
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(n_line + 2, 2)) @ np.array([1, 1j])
    noise = (noise[1:-1] - 0.5 * noise[2:] - 0.5 * noise[:-2])[:, None, None]
    w, w0 = 2 * np.pi * clean.frequency, 2 * np.pi * F0
    matrix = (1 / (w0**2 - w**2 + 2j * ZETA * w0 * w))[:, None, None]
    return replace(clean, matrix=matrix + 0.01 * np.sqrt(np.mean(np.abs(matrix) ** 2)) * noise / np.sqrt(3))


@pytest.mark.long
def test_lines_that_share_noise_through_a_window_raise_no_alarm_when_the_window_is_known() -> None:
    fits = [
        [
            bool(mismatch(identify(r, FitSettings("sdof"))[0]))
            for r in (hann(n), replace(hann(n), line_correlation=HANN))
        ]
        for n in range(10)
    ]
    without, known = np.sum(fits, axis=0)
    assert without >= 3 and known <= 1


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
def test_a_mode_beside_the_band_widens_the_intervals_until_they_cover(estimator: str) -> None:
    (fit,) = identify(response("mode beside the band", 0), FitSettings("sdof", estimator=estimator))
    assert "include what the model leaves unexplained" in mismatch(fit)
    assert fit.discrepancy.shares and all(p.reason and p.interval.discrepancy > 0 for p in fit.parameters)
    for name, truth in (("f_n", F0), ("zeta", ZETA), ("m", 1.0)):
        parameter = fit.parameter(name)
        assert parameter.ci95[0] < truth < parameter.ci95[1]
        assert parameter.std_error_inflated == parameter.full_error >= parameter.std_error
    m = fit.parameter("m")
    assert m.std_error_inflated > 1.3 * m.std_error


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
def test_a_mode_too_few_is_inside_the_interval(estimator: str) -> None:
    (fit,) = identify(response("second mode", 0), FitSettings("sdof", estimator=estimator))
    assert "include what the model leaves unexplained" in mismatch(fit)
    for name, truth in (("f_n", F0), ("zeta", ZETA)):
        parameter = fit.parameter(name)
        assert (
            parameter.ci95[0] < truth < parameter.ci95[1]
            and parameter.interval.discrepancy > parameter.interval.noise
        )


def test_scatter_of_gain_gives_every_line_its_own_noise() -> None:
    (fit,) = identify(response("random gain", 1), FitSettings("sdof"))
    assert "scatter of every line by itself" in mismatch(fit)
    assert fit.parameter("k").std_error_inflated > fit.parameter("k").std_error


def test_a_measured_excess_widens_the_intervals_and_says_by_how_much() -> None:
    plain = response("", 3)
    variance = np.mean(np.abs(plain.matrix) ** 2) * 1e-4
    small = replace(plain, covariance=diagonal_covariance(np.full(plain.matrix.shape, variance / 9)))
    (fit,) = identify(small, FitSettings("sdof"))
    k = fit.parameter("k")
    # Noise thrice as large as its covariance says, and nothing else wrong: the factor is at least 3 and far
    # below that of a course.
    assert 2.5 < k.std_error_inflated / k.std_error < 5
    assert "times as wide as noise alone" in mismatch(fit) and "noise larger than measured" in k.reason


def test_too_few_lines_to_judge_are_said() -> None:
    few = response("", 1)
    chosen = slice(36, 46)
    few = replace(few, frequency=few.frequency[chosen], matrix=few.matrix[chosen])
    assert "not-judged" in [
        finding.code for finding in identify(few, FitSettings("sdof", mass=1.0))[0].findings
    ]


@pytest.mark.parametrize(("scale", "mass", "code"), [(1.3, 1.0, "low-gof"), (0.01, 100.0, "negative-gof")])
def test_a_fit_that_explains_little_says_so(scale: float, mass: float, code: str) -> None:
    """Noise larger than the response.

    And a mass so wrong that the model gives next to nothing, less than the mean of the data.
    """
    plain = response("", 2)
    rng = np.random.default_rng(2)
    size = scale * np.sqrt(np.mean(np.abs(plain.matrix) ** 2) / 2)
    noise = size * (rng.normal(size=plain.matrix.shape) + 1j * rng.normal(size=plain.matrix.shape))
    (fit,) = identify(replace(plain, matrix=plain.matrix + noise), FitSettings("sdof", mass=mass))
    assert code in [finding.code for finding in fit.findings], fit.gof

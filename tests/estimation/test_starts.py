"""Start values of an output-error fit: near its minimum where plain least squares and one pass of reweighting
are far.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from labpipe.estimation.likelihood import starts
from labpipe.estimation.linear_models import sdof
from labpipe.estimation.model import Setup
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.weights import whitener
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from tests.estimation.noisy import measured

TRUTH = {"k": 1.35e5, "c": 10.0, "m": 0.79}
PORTS = (Port("x", "x", "x"),), (Port("f", "f", "x"),)


def test_reweighting_goes_on_as_long_as_it_is_worth_while() -> None:
    """At noise of 7 % of the peak; the lowest chi-square there is by scipy's least squares from the truth."""
    frequency = np.arange(40.0, 100.0, 0.5)
    w = 2 * np.pi * frequency
    h = 1 / (TRUTH["k"] - TRUTH["m"] * w**2 + 1j * TRUTH["c"] * w)
    rng = np.random.default_rng(1)
    std = 0.07 * np.max(np.abs(h))
    h = h + std * (rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)) / np.sqrt(2)
    covariance = diagonal_covariance(np.full((w.size, 1, 1), std**2))
    data = measured(FrequencyResponse(frequency, h[:, None, None], *PORTS, covariance=covariance))
    model = sdof(Setup(*PORTS, FitSettings("sdof")))
    problem = OutputError(data, model, whitener(data))
    truth = np.array([TRUTH[name] for name in model.names])
    lowest = 2 * least_squares(lambda share: problem.residual(share * truth), np.ones(3)).cost
    found = {start.name: start for start in starts(problem)}
    best = next(iter(found.values()))
    assert best.chi2 == pytest.approx(problem.chi2(best.values)) and best.chi2 < 1.2 * lowest
    assert best.chi2 == min(start.chi2 for start in found.values())
    assert (
        found["least squares"].chi2 > 5 * lowest
        and found["reweighted least squares (pass 1)"].chi2 > 1.3 * lowest
    )
    # Where noise already explains the first pass, there is no second; where it explains none, all are made.
    names = [start.name for start in starts(problem, lambda chi2: 1.0)]
    assert names == ["reweighted least squares (pass 1)", "least squares"]
    assert {start.name for start in starts(problem, lambda chi2: 0.0)} == set(found)

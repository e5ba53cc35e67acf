"""Stepped sine on a simulated oscillator: FRF and coefficients within their intervals, transients without a
trace.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings
from tests.spectra.stepped_oscillator import TRUTH, receptance, record


@pytest.mark.long
def test_intervals_hold_the_truth_and_transients_leave_no_bias() -> None:
    """Real and imaginary part of 19 lines: 95 % intervals of Student's t; bias below 0.3 standard errors.

    K and c of the fit.
    """
    draws = 40
    errors, holds, scaled = [], [], []
    for seed in range(draws):
        response = measure([record(seed)], FrfSettings("stepped-sine"))
        # E|d|^2 is shared by two parts.
        size = np.sqrt(response.variance[:, 0, 0] / 2)
        errors.append((response.matrix[:, 0, 0] - receptance(response.frequency)) / size)
        limit = stats.t.ppf(0.975, 2 * response.covariance_dof)
        (fit,) = identify(response, FitSettings("sdof", mass=1.0))
        found = [fit.parameter(name) for name in ("k", "c")]
        holds.append([p.ci95[0] < true < p.ci95[1] for p, true in zip(found, TRUTH, strict=True)])
        scaled.append([(p.value - true) / p.std_error for p, true in zip(found, TRUTH, strict=True)])
    parts = np.concatenate([np.real(errors), np.imag(errors)], axis=1)
    chance = 3 * np.sqrt(0.05 * 0.95 / parts.size)
    assert 0.95 - max(0.02, chance) < np.mean(np.abs(parts) < limit) < 0.95 + max(0.02, chance)
    assert np.max(np.abs(parts.mean(axis=0))) < 0.3 + 3.5 / np.sqrt(draws)
    assert np.sqrt(max(0.0, np.mean(parts.mean(axis=0) ** 2) - 1 / draws)) < 0.3
    assert np.all(np.mean(holds, axis=0) > 0.95 - 3 * np.sqrt(0.05 * 0.95 / draws))
    assert np.all(np.abs(np.mean(scaled, axis=0)) < 0.3 + 3 / np.sqrt(draws))

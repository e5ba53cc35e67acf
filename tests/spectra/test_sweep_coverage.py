"""Swept sines on a simulated oscillator: stiffness, damping and natural frequency within their intervals as
often as these say.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.raw_files.excitation import Sweep
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings
from tests.spectra.swept_oscillator import BAND, TRUTH, receptance, record

# One sweep has its noise from the lines around, three have it from their scatter; one that ends in full
# motion leaves leakage, and its intervals are on the safe side: sweeps, their number, noise of force and
# displacement, whether intervals are exact.
CASES = {
    "one linear": (Sweep(BAND, 10.0, 1.0, "linear", "up", 3.0), 1, (0.0, 0.01), True),
    "one logarithmic": (Sweep(BAND, 10.0, 1.0, "logarithmic", "down", 3.0), 1, (0.0, 0.01), True),
    "three, noise of the force too": (Sweep(BAND, 8.0, 1.0, "linear", "up-down", 3.0), 3, (0.01, 0.01), True),
    "cut in full motion": (Sweep((20.0, 45.0), 10.0, 1.0), 1, (0.0, 0.003), False),
}


@pytest.mark.parametrize(
    ("case", "draws"),
    [
        ("three, noise of the force too", 10),
        *(pytest.param(case, 40, marks=pytest.mark.long) for case in CASES),
    ],
)
def test_intervals_hold_the_truth(case: str, draws: int) -> None:
    sweep, count, noise, exact = CASES[case]
    errors, holds, power = [], [], []
    for seed in range(draws):
        response = measure([record(seed, sweep, count, noise)], FrfSettings("sweep"))
        power.append(
            np.mean(
                np.abs(response.matrix[:, 0, 0] - receptance(response.frequency)) ** 2
                / response.variance[:, 0, 0]
            )
        )
        # The noise of the FRF of all sweeps is looked at: of their scatter three say little.
        (fit,) = identify(response, FitSettings("sdof", mass=1.0, repeats="pool"))
        found = [fit.parameter(name) for name in ("k", "c", "f_n")]
        errors.append([(p.value - true) / p.std_error for p, true in zip(found, TRUTH, strict=True)])
        holds.append([p.ci95[0] < true < p.ci95[1] for p, true in zip(found, TRUTH, strict=True)])
    # Three standard deviations of a share of 40 draws, which sees 80 % of both k and c in 92 of 100; the tail
    # of that of few is longer.
    chance = (3 if draws >= 40 else 4) * np.sqrt(0.05 * 0.95 / draws)
    assert np.all(np.mean(holds, axis=0) > 0.95 - chance)
    # No bias: means within 3.5 of their standard errors.
    assert np.all(np.abs(np.mean(errors, axis=0)) < 3.5 / np.sqrt(draws))
    if exact:
        # E|d|^2 over its variance, of dof complex degrees of freedom: dof / (dof - 1); of some 700 lines in
        # every draw.
        assert np.mean(power) == pytest.approx(
            response.covariance_dof / (response.covariance_dof - 1), rel=0.03 + 0.1 / np.sqrt(draws)
        )


def test_three_sweeps_as_repeats_are_hardly_less_sure_than_together() -> None:
    """Nothing moves between them: every interval holds the damping, and on average is no wider than Student's
    t of two degrees of freedom makes that of their common noise. Their noise is that of all together, as far
    as equal weights use it as well: within 30 %.
    """
    sweep, count, noise, _ = CASES["three, noise of the force too"]
    wide, noisy = [], []
    for seed in range(6):
        response = measure([record(seed, sweep, count, noise)], FrfSettings("sweep"))
        (each,) = identify(response, FitSettings("sdof", mass=1.0))
        (pooled,) = identify(response, FitSettings("sdof", mass=1.0, repeats="pool"))
        low, high = each.parameter("c").ci95
        assert low < dict(zip(("k", "c", "f_n"), TRUTH, strict=True))["c"] < high
        wide.append((high - low) / np.ptp(pooled.parameter("c").ci95))
        noisy.append(each.parameter("c").interval.noise / pooled.parameter("c").std_error)
    assert 0.7 < np.exp(np.mean(np.log(wide))) < 4.3 / 1.96
    assert 1 / 1.3 < np.exp(np.mean(np.log(noisy))) < 1.3

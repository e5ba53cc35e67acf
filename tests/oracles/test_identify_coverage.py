"""Do the intervals keep what they promise? The pedestal, from simulated recordings to k, 200 times.

Truth: the virtual rig's closed form. A 95 % interval over 200 repeats holds the truth in 92-98 % but for chance (binomial +-1.9 sigma).
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.identify.fitting import identify
from labpipe.identify.settings import FitSettings
from labpipe.simulate.magnetic_rig import simulate
from labpipe.simulate.magnetic_settings import VirtualMagneticRig
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

REPEATS = 200
FRF = FrfSettings(excitation="periodic", period=2.0, skip=3, band=(1.0, 100.0))
FIT = FitSettings("sdof", mass=0.79, band=(60.0, 70.0), name="pedestal")


@pytest.fixture(scope="module")
def fits():  # type: ignore[no-untyped-def]
    rig = VirtualMagneticRig("virtual-magnetic-rig")
    runs = (simulate(rig, seed, ["pedestal"])[0].recording for seed in range(1000, 1000 + REPEATS))
    return [identify(measure([run], FRF), FIT)[0] for run in runs]


@pytest.mark.parametrize(("name", "truth"), [("k", 134.5e3), ("c", 3.682), ("f_n", np.sqrt(134.5e3 / 0.79) / (2 * np.pi))])
def test_intervals_cover_the_truth(fits, name: str, truth: float) -> None:
    inside = [fit.parameter(name).ci95[0] <= truth <= fit.parameter(name).ci95[1] for fit in fits]
    assert 0.92 <= np.mean(inside) <= 0.98


def test_standard_error_is_the_scatter(fits) -> None:
    estimates = [fit.parameter("k").value for fit in fits]
    assert np.mean([fit.parameter("k").std_error for fit in fits]) == pytest.approx(np.std(estimates, ddof=1), rel=0.10)


def test_chi_square_is_one_and_its_p_value_uniform(fits) -> None:
    assert np.mean([fit.gof.chi2_reduced for fit in fits]) == pytest.approx(1.0, abs=0.05)
    assert np.mean([fit.gof.chi2_p < 0.05 for fit in fits]) < 0.12
    assert sum(finding.code == "model-mismatch" for fit in fits for finding in fit.findings) <= 8

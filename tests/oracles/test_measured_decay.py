"""A measured hammer test of a beam, public data of the package vibrationtesting (MIT): its free decay against its own averaged FRF."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.io import loadmat

from labpipe.identify.fitting import identify
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.free_decays import free_decays
from labpipe.spectra.settings import FrfSettings
from tests.oracles.test_measured_beam import shipped


@cache
def recorded() -> Recording:
    """The acceleration of the last hit, 3.2 s at 1280 Hz."""
    variables = loadmat(shipped("case1.mat"))
    samples = np.asarray(variables["Time_chan_2"], float)
    return Recording((Channel("a", "acceleration", "output", "a"),), samples, 1280.0, "case1")


def fitted(band: tuple[float, float]) -> Fit:
    (fit,) = identify(free_decays([recorded()], FrfSettings("decay")), FitSettings("decay", band=band))
    return fit


def test_the_single_mode_lies_where_the_frf_has_it() -> None:
    """The mode between 204 and 220 Hz lies at 212.0925 Hz in the averaged FRF; one of many hits shows it within 50 ppm."""
    fit = fitted((204.0, 220.0))
    assert fit.parameter("f_n_1").value == pytest.approx(212.0925, rel=5e-5)
    assert fit.parameter("zeta_1").value == pytest.approx(8.8e-4, rel=0.1)
    # Its damping depends on the amplitude, which one averaged FRF cannot show; a second mode fits it better than the law, but not well.
    assert "amplitude-dependent" in [finding.code for finding in fit.findings] and fit.parameter("zeta_1").ci95 is None


def test_hum_is_no_mode() -> None:
    """The second harmonic of the mains of 60 Hz: its damping ratio cannot be told from zero, and a warning says so."""
    fit = fitted((100.0, 130.0))
    low, high = fit.parameter("zeta_1").ci95
    assert fit.parameter("f_n_1").value == pytest.approx(120.0, abs=0.03) and low < 0 < high
    assert {finding.code for finding in fit.findings} & {"unphysical", "insignificant"}

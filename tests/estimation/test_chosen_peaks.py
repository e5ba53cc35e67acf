"""Several bands at once and chosen peaks of diagonal terms, against single fits and exact two-mass
responses.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings, Sliding
from labpipe.project.marked_yaml import load_marked
from labpipe.project.settings_reader import Faults, read_settings
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

SDOF = FitSettings("sdof", mass=0.79, name="pedestal")
K, M, C = {"x": 4e5, "z": 9e5}, 2.0, 40.0


@pytest.fixture
def two_directions() -> FrequencyResponse:
    """Uncoupled x and z, each a mass on its own spring, 20-200 Hz every 0.5 Hz: the fit of a diagonal term is
    exact.
    """
    frequency = np.arange(20.0, 200.25, 0.5)
    w = 2 * np.pi * frequency
    matrix = np.zeros((w.size, 2, 2), complex)
    for number, k in enumerate(K.values()):
        matrix[:, number, number] = 1 / (k - M * w**2 + 1j * w * C)
    outputs = tuple(Port(dof, dof, dof) for dof in K)
    inputs = tuple(Port(f"f@{dof}", "f", dof) for dof in K)
    return FrequencyResponse(
        frequency, matrix, outputs, inputs, covariance=diagonal_covariance(np.full(matrix.shape, 1e-18))
    )


def test_bands_give_the_fits_of_each_band_alone(sdof_response, rng) -> None:
    response = sdof_response(1e-7, rng)
    bands = ((60.0, 66.0), (64.0, 70.0))
    both = identify(response, replace(SDOF, bands=bands))
    alone = [identify(response, replace(SDOF, band=band))[0] for band in bands]
    assert [fit.band_hz for fit in both] == list(bands)
    assert [fit.parameters for fit in both] == [fit.parameters for fit in alone]


def test_a_band_s_upper_line_belongs_to_it(sdof_response) -> None:
    (fit,) = identify(sdof_response(), replace(SDOF, bands=((61.0, 64.0),)))
    assert fit.lines == 7


def test_peaks_fit_each_diagonal_term_in_its_own_bands(two_directions) -> None:
    peaks = (("x", ((60.0, 85.0),)), ("z", ((90.0, 110.0), (100.0, 130.0))))
    fits = identify(two_directions, FitSettings("sdof", peaks=peaks, name="diagonal"))
    assert [(fit.name, fit.term) for fit in fits] == [("diagonal", "x"), ("diagonal", "z"), ("diagonal", "z")]
    for fit in fits:
        assert fit.parameter("k").value == pytest.approx(K[fit.term], rel=1e-9)
        assert fit.parameter("m").value == pytest.approx(M, rel=1e-9)
        assert (
            fit.curve is not None
            and fit.curve.outputs == (fit.term,)
            and fit.curve.inputs == (f"f@{fit.term}",)
        )


def test_errors_name_the_term(two_directions) -> None:
    with pytest.raises(ConfigError, match=r"term bx: no (force|response)"):
        identify(two_directions, FitSettings("sdof", peaks=(("bx", ((60.0, 85.0),)),)))
    with pytest.raises(FitError, match="term z: band 1-2 Hz: no frequency line"):
        identify(two_directions, FitSettings("sdof", peaks=(("z", ((1.0, 2.0),)),)))


PEAKS = (("x", ((60.0, 85.0),)),)


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"bands": ((1.0, 2.0),), "band": (1.0, 3.0)}, "'bands' goes with neither"),
        ({"bands": ((1.0, 2.0),), "sliding": Sliding(1.0, 1.0)}, "'bands' goes with neither"),
        ({"peaks": PEAKS, "output": ("x",)}, "'peaks' names bands and ports"),
        ({"peaks": PEAKS, "band": (1.0, 2.0)}, "'peaks' names bands and ports"),
        ({"peaks": PEAKS, "model": "mdof"}, "'peaks' is not for model mdof"),
    ],
)
def test_what_says_the_same_thing_twice_is_refused(settings, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        FitSettings(**{"model": "sdof", **settings})


def test_peaks_are_read_from_yaml(tmp_path: Path) -> None:
    (tmp_path / "fit.yaml").write_text("model: sdof\npeaks: {x: 0.7-1.1 kHz, z: [300-500 Hz, 900-950 Hz]}\n")
    faults = Faults()
    settings = read_settings(FitSettings, load_marked(tmp_path / "fit.yaml"), "identify.p", faults)
    assert not len(faults)
    assert settings is not None
    assert settings.peaks == (("x", ((700.0, 1100.0),)), ("z", ((300.0, 500.0), (900.0, 950.0))))
    (tmp_path / "fit.yaml").write_text("model: sdof\npeaks: 300-500 Hz\n")
    with pytest.raises(ConfigError, match="not a mapping of dofs to bands"):
        read_settings(FitSettings, load_marked(tmp_path / "fit.yaml"), "identify.p", faults)
        faults.raise_any()

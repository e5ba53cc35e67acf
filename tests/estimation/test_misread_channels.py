"""Channels of the rig file that stand for others are named, and what a wrong unit makes of a given mass.

The FRF of one mass in closed form, 12 kg on 2.4 MN/m with 3 % of damping, noise of 1/200 of its peak.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.convert import DERIVATIVES

K, M, ZETA = 2.4e6, 12.0, 0.03
FREQUENCY = np.arange(55.0, 90.5, 0.5)
JW = 2j * np.pi * FREQUENCY
RECEPTANCE = 1 / (K + 2 * ZETA * np.sqrt(K * M) * JW + M * JW**2)
NAMES = dict(zip(DERIVATIVES, ("displacement", "velocity", "acceleration"), strict=True))


def measured(true: np.ndarray, form: str, seed: int = 1) -> FrequencyResponse:
    """An FRF that a rig file says to be of *form*."""
    scale = np.max(np.abs(true)) / 200
    noise = np.random.default_rng(seed).standard_normal((2, true.size)) * scale / np.sqrt(2)
    return FrequencyResponse(
        FREQUENCY,
        (true + noise[0] + 1j * noise[1])[:, None, None],
        (Port("y", "y", "z"),),
        (Port("f", "f", "z"),),
        form=form,
        covariance=np.full((true.size, 1, 1), scale**2, complex),
    )


def fitted(true: np.ndarray, form: str, **settings: object) -> Fit:
    """Its fit."""
    return identify(measured(true, form), FitSettings("sdof", name="s", **settings))[0]


def suggestion(fit: Fit) -> str:
    """What the finding says of the channels; "" without it."""
    said = [finding.message.split(": ")[0] for finding in fit.findings if finding.code == "wrong-quantity"]
    return said[0] if said else ""


@pytest.mark.parametrize("mass", ["estimate", M])
@pytest.mark.parametrize("form", DERIVATIVES)
def test_force_and_response_in_each_others_place_are_named(form: str, mass: object) -> None:
    fit = fitted(1 / (RECEPTANCE * JW ** DERIVATIVES[form]), form, mass=mass)
    antiresonance = ", or the band holds an antiresonance" if form == "mobility" else ""
    assert suggestion(fit) == f"the FRF suggests that f and y are in each other's place{antiresonance}"
    assert not {"unphysical", "mass"} & {finding.code for finding in fit.findings}
    (message,) = (finding.message for finding in fit.findings if finding.code == "wrong-quantity")
    f_n, zeta = (float(message.split(f"{name} = ")[1].split()[0].rstrip(",")) for name in ("f_n", "zeta"))
    assert (f_n, zeta) == (
        pytest.approx(np.sqrt(K / M) / (2 * np.pi), rel=2e-3),
        pytest.approx(ZETA, rel=0.1),
    )


@pytest.mark.parametrize("estimator", ["ml", "ls", "iv"])
@pytest.mark.parametrize(("form", "true"), [(a, b) for a in DERIVATIVES for b in DERIVATIVES if a != b])
def test_another_derivative_than_the_rig_file_says_is_named(form: str, true: str, estimator: str) -> None:
    fit = fitted(RECEPTANCE * JW ** DERIVATIVES[true], form, estimator=estimator)
    assert suggestion(fit) == f"the FRF suggests that y is {NAMES[true]}, not {NAMES[form]}"


@pytest.mark.parametrize("form", DERIVATIVES)
def test_right_channels_turned_ones_and_dead_ones_are_not_suspected(form: str) -> None:
    true = RECEPTANCE * JW ** DERIVATIVES[form]
    for shown in (true, -true, 1e-6 * true, np.full(true.size, 1e-9 + 0j)):
        assert suggestion(fitted(shown, form)) == ""


def test_the_antiresonance_of_a_driving_point_is_no_swapped_channel() -> None:
    """Two free masses of 1 kg joined by a spring, each on another: at 71.2 Hz the driven one stands still."""
    mass, spring = JW**2, K / M
    driven = (mass + 30 * JW + spring) / ((mass + 30 * JW + spring) * (mass + 5 * spring) - spring**2)
    for form, order in DERIVATIVES.items():
        said = suggestion(fitted(driven * JW**order, form))
        assert not said or said.endswith("or the band holds an antiresonance")


def test_a_line_that_has_no_inverse_leaves_the_fit_as_it_was() -> None:
    """A line at 0 Hz, or without any response. Warnings of numpy are errors here."""
    response = measured(1 / RECEPTANCE, "receptance")
    at_rest, dead = response.frequency.copy(), response.matrix.copy()
    at_rest[0], dead[3] = 0.0, 0.0
    for changed in (replace(response, frequency=at_rest), replace(response, matrix=dead)):
        (fit,) = identify(changed, FitSettings("sdof", name="s"))
        assert suggestion(fit) == ""


@pytest.mark.parametrize(
    ("factor", "units"), [(9.80665, "g and m/s²"), (1e3, "kN and N"), (1e-3, "kN and N"), (1e-6, "um and m")]
)
def test_a_wrong_unit_is_named_by_its_factor_on_the_mass(factor: float, units: str) -> None:
    fit = fitted(factor * RECEPTANCE, "receptance", mass=M)
    (message,) = (finding.message for finding in fit.findings if finding.code == "mass")
    assert f"the calibration (the factor is that of {units.replace('²', '^2')}" in message
    fit = fitted(1.2 * RECEPTANCE, "receptance", mass=M)
    (message,) = (finding.message for finding in fit.findings if finding.code == "mass")
    assert "the calibration is wrong" in message

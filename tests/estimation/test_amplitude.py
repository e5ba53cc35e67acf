"""The amplitude fit: exact whatever the phase, weighted or not; truth from the pedestal's closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings

SDOF = FitSettings("sdof", mass="estimate", estimator="amplitude", name="pedestal")
TRUTH = {"k": 134.5e3, "c": 3.682, "m": 0.79}


@pytest.mark.parametrize("mass", [0.79, "estimate"])
@pytest.mark.parametrize("phase", ["delay", "random"])
def test_exact_with_pure_phase_error_where_ls_is_not(sdof_response, rng, mass, phase: str) -> None:  # type: ignore[no-untyped-def]
    plain = sdof_response()
    # A sensor delay of 0.2 ms, or phases off by 5 deg at random: amplitudes stay what they are.
    error = (
        -2 * np.pi * plain.frequency * 2e-4
        if phase == "delay"
        else np.radians(5) * rng.normal(size=plain.frequency.size)
    )
    response = replace(plain, matrix=plain.matrix * np.exp(1j * error)[:, None, None])
    (by_amplitude,), (by_ls,) = (
        identify(response, replace(SDOF, mass=mass, estimator=name)) for name in ("amplitude", "ls")
    )
    for name in ("k", "c") if mass == 0.79 else TRUTH:
        assert by_amplitude.parameter(name).value == pytest.approx(TRUTH[name], rel=1e-6)
    # The phase mixes stiffness and damping in the equation of motion.
    assert max(abs(by_ls.parameter(name).value / TRUTH[name] - 1) for name in ("k", "c")) > 5e-4


@pytest.mark.long
@pytest.mark.parametrize("weight", ["none", "noise"])
def test_standard_errors_are_the_scatter(sdof_response, weight: str) -> None:
    settings = replace(SDOF, mass=0.79, weight=weight)
    fits = [identify(sdof_response(2e-6, np.random.default_rng(seed)), settings)[0] for seed in range(60)]
    for name in ("k", "c"):
        values = [fit.parameter(name).value for fit in fits]
        # A standard deviation from 60 values is known to 9 %; three of those.
        assert np.mean([fit.parameter(name).std_error for fit in fits]) == pytest.approx(
            np.std(values, ddof=1), rel=0.27
        )
    if weight == "noise":
        assert np.mean([fit.gof.chi2_reduced for fit in fits]) == pytest.approx(1.0, abs=0.08)


def test_weighing_by_the_noise_is_nearer_to_the_truth(sdof_response) -> None:
    def squares(weight: str) -> float:
        settings = replace(SDOF, mass=0.79, weight=weight)
        found = [
            identify(sdof_response(2e-6, np.random.default_rng(seed)), settings)[0] for seed in range(40)
        ]
        return float(np.mean([(fit.parameter("c").value - TRUTH["c"]) ** 2 for fit in found]))

    assert squares("noise") < squares("none")


def test_equations_are_the_amplitudes(sdof_response) -> None:
    (fit,) = identify(sdof_response(1e-7, np.random.default_rng(1)), replace(SDOF, mass=0.79))
    assert (fit.lines, fit.equations, fit.dof) == (21, 21, 19)


def test_the_unit_of_the_receptance_does_not_matter(sdof_response) -> None:
    (plain,) = identify(sdof_response(1e-7, np.random.default_rng(2)), SDOF)
    for scale in (1e-7, 1e8):
        (scaled,) = identify(sdof_response(1e-7, np.random.default_rng(2), scale=scale), SDOF)
        assert scaled.parameter("k").value * scale == pytest.approx(plain.parameter("k").value, rel=1e-9)
        assert scaled.parameter("k").std_error * scale == pytest.approx(
            plain.parameter("k").std_error, rel=1e-6
        )


def test_what_cannot_be_fitted_is_said(sdof_response) -> None:
    with pytest.raises(FitError, match="not known"):
        identify(sdof_response(), replace(SDOF, weight="noise"))
    with pytest.raises(FitError, match="cannot determine"):
        identify(sdof_response(), replace(SDOF, band=(60.0, 60.6)))
    with pytest.raises(ConfigError, match="estimates k and c"):
        identify(sdof_response(), replace(SDOF, fixed=(("c", 0.0),)))
    flat = sdof_response()
    with pytest.raises(FitError, match="no real"):
        identify(replace(flat, matrix=np.abs(flat.frequency - 65)[:, None, None] + 1.0 + 0j), SDOF)

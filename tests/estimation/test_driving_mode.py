"""One mode at a driving point among others: k, c and m beside a constant, against sums of modes in closed
form.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.transfer_mode import DrivingMode
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

# A floor of a building: its third mode, of 150 t, the first and second below it and stiffer ones above.
FREQUENCY = np.linspace(6.0, 10.0, 161)
MODE = (8.0, 0.012, 150e3)
OTHERS = ((1.5, 0.01, 120e3), (4.6, 0.01, 90e3), (14.0, 0.015, 60e3), (22.0, 0.02, 40e3))


def mode(f_n: float, zeta: float, mass: float) -> np.ndarray:
    w, w_n = 2 * np.pi * FREQUENCY, 2 * np.pi * f_n
    return np.asarray(1 / (mass * (w_n**2 - w**2 + 2j * zeta * w_n * w)))


def response(h: np.ndarray, noise: float = 0.0, seed: int = 0) -> FrequencyResponse:
    rng, std = np.random.default_rng(seed), noise * np.max(np.abs(h))
    h = h + std * (rng.normal(size=h.size) + 1j * rng.normal(size=h.size)) / np.sqrt(2)
    covariance = diagonal_covariance(np.full((h.size, 1, 1), std**2)) if noise else None
    return FrequencyResponse(
        FREQUENCY, h[:, None, None], (Port("y", "y", "3"),), (Port("f", "f", "3"),), covariance=covariance
    )


def truth() -> dict[str, float]:
    f_n, zeta, mass = MODE
    w_n = 2 * np.pi * f_n
    return {"k": mass * w_n**2, "c": 2 * zeta * mass * w_n, "m": mass, "f_n": f_n, "zeta": zeta}


def test_a_mode_beside_a_constant_is_exact() -> None:
    (fit,) = identify(response(mode(*MODE) + 3e-9 - 1e-9j), FitSettings("sdof", residuals=True))
    for name, value in truth().items():
        assert fit.parameter(name).value == pytest.approx(value, rel=1e-7)
    assert fit.parameter("residual_re").value == pytest.approx(3e-9, rel=1e-6)


def test_derivatives_are_those_of_differences() -> None:
    model, omega = DrivingMode(), 2 * np.pi * FREQUENCY
    at = np.array([truth()["k"], truth()["c"], truth()["m"], 3e-9, -1e-9])
    for number, step in enumerate(1e-6 * np.abs(at) * np.eye(5)):
        slope = (model.receptance(at + step, omega) - model.receptance(at - step, omega)) / (2 * step[number])
        np.testing.assert_allclose(model.jacobian(at, omega)[number], slope, rtol=1e-5)


@pytest.mark.parametrize("seed", range(2))
def test_the_mass_of_a_floor_is_held_among_other_modes(seed: int) -> None:
    """The residual of modes below and above is not a constant: what is left of it is model error."""
    h = mode(*MODE) + sum(mode(*other) for other in OTHERS)
    (fit,) = identify(response(h, 0.002, seed), FitSettings("sdof", residuals=True))
    for name, value in truth().items():
        low, high = fit.parameter(name).ci95
        assert low < value < high
    assert fit.parameter("m").ci95[1] < 1.3 * MODE[2]


def test_a_driving_point_without_an_oscillator_is_fitted_beside_a_constant() -> None:
    """A floor that hardly takes part in the mode: without residual terms its mass is negative."""
    small = (8.0, 0.012, 20 * MODE[2])
    h = mode(*small) - 1.6e-9 * (FREQUENCY / 8) ** -2
    (fit,) = identify(response(h, 0.01, 1), FitSettings("sdof"))
    assert any("is not an oscillator" in note for note in fit.notes)
    low, high = fit.parameter("m").ci95
    assert low < small[2] < high and fit.parameter("f_n").value == pytest.approx(8.0, rel=2e-3)
    assert "unphysical" not in [finding.code for finding in fit.findings]


@pytest.mark.parametrize(
    "keys", [{"mass": 2.0}, {"damping": "hysteretic"}, {"fixed": (("c", 1.0),)}, {"share": 2}]
)
def test_residual_terms_are_of_a_mode_by_its_coefficients_alone(keys: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="residuals"):
        FitSettings("sdof", residuals=True, **keys)


def test_residual_terms_are_of_one_response() -> None:
    """Of two the fit with them ended in a fault of the shapes of arrays, which the plain model refuses."""
    one = response(mode(*MODE))
    outputs = (*one.outputs, Port("z", "z", "4"))
    two = replace(one, matrix=np.repeat(one.matrix, 2, axis=1), outputs=outputs)
    with pytest.raises(ConfigError, match=r"sdof takes 1 response\(s\), found y, z"):
        identify(two, FitSettings("sdof", residuals=True))


def test_the_compared_model_is_that_of_the_fit() -> None:
    """Five parameters with the constant, not the three of a mode alone."""
    h = mode(*MODE) + 3e-9 - 1e-9j
    (fit,) = identify(response(h, 1e-3), FitSettings("sdof", residuals=True, compare=True))
    (this,) = (model for model in fit.candidates if model.name.startswith("this model"))
    assert this.name == "this model: sdof, mass estimated, residual term"
    assert (this.parameters, this.dof) == (5, fit.dof)

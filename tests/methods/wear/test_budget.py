"""What uncertainties of sensors do to a wear, against whole refits of a response with the number off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.measured import matrix_errors
from labpipe.methods.rotor.rig import UncertainBearing
from labpipe.methods.wear.model import worn_receptance
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty
from tests.methods.wear.worn_cases import RIG, fit_settings, measured, wear_settings, worn_rig

GAIN = Uncertainty("y.sensitivity", 0.02, "1")


@pytest.mark.long
def test_the_change_by_a_sensitivity_is_that_of_refits() -> None:
    """A gain of 2 %, so that its change stands above the error of the films' mesh (23 nm and 0.008 rad),
    which a refit moves through.

    A deep wear: at 22 um, where it divides the film, the slope over 2 um of the budget is 5 % off that over
    the .07 um of the refits.
    """
    response = measured(worn_rig(40.19, 8.0), 2e-3)
    outputs = (
        replace(response.outputs[0], uncertainties=(ChannelUncertainty("gain", GAIN),)),
        response.outputs[1],
    )
    settings = fit_settings()
    (fit,) = identify(replace(response, outputs=outputs), settings)
    budget = fit.budget
    assert budget is not None and [source.source for source in budget.sources] == ["y.sensitivity"]
    ends = []
    for sign in (1, -1):
        matrix = response.matrix.copy()
        matrix[:, 0] *= 1 - sign * 0.02
        ends.append(identify(replace(response, matrix=matrix), settings)[0])
    for name in ("wear_depth", "wear_angle"):
        expected = (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
        assert budget.change_by("y.sensitivity", name) == pytest.approx(expected, rel=0.05)
        assert fit.parameter(name).systematic == pytest.approx(abs(budget.change_by("y.sensitivity", name)))


def test_a_direction_turns_the_frame() -> None:
    """A sensor at a + d reads what one at a reads, and d times the motion at right angles: R(-d) H to first
    order.
    """
    angles = 0.3, 0.3 + np.pi / 2
    uncertainty = ChannelUncertainty("direction", Uncertainty("y.dof", 0.01, "rad"))
    ports = tuple(Port(f"s{n}", f"s{n}", f"{angle}", angle, (uncertainty,)) for n, angle in enumerate(angles))
    forces = tuple(Port(f"f{n}", f"f{n}", f"{angle}", angle) for n, angle in enumerate((0.0, np.pi / 2)))
    rng = np.random.default_rng(2)
    matrix = rng.normal(size=(3, 2, 2)) + 1j * rng.normal(size=(3, 2, 2))
    response = FrequencyResponse(np.array([20.0, 30.0, 40.0]), matrix, ports, forces)
    found = worn_receptance(response, fit_settings(), wear_settings())
    assert matrix_errors(found.measured) == ()
    # Both sensors turn together: the frame turns, all motions by -d.
    turn = 0.01 * np.array([[0, -1], [1, 0]])
    total = sum(error.change for error in found.errors)
    np.testing.assert_allclose(total, turn @ found.measured.matrix, rtol=1e-6, atol=1e-9)


def test_the_change_by_a_bearing_s_number_is_that_of_refits() -> None:
    """The clearance of the bearing that is not worn, 4 % of it, against refits on rotors with that clearance.

    The one step is 11 % short in depth and 5 % in angle, at 8 % as at 4 %: it knows the films at the minimum
    only.
    """
    healthy = RIG.bearings[0]
    above, below = (
        replace(healthy.bearing, clearance=healthy.bearing.clearance * factor) for factor in (1.04, 0.96)
    )
    uncertainty = Uncertainty("bearing 1: clearance", 0.04 * healthy.bearing.clearance, "m")
    uncertain = replace(
        RIG,
        bearings=(
            replace(healthy, uncertainties=(UncertainBearing(uncertainty, above, below),)),
            *RIG.bearings[1:],
        ),
    )
    response = measured(worn_rig(22.27, 11.0), 2e-3)
    (fit,) = identify(response, fit_settings(rig=uncertain))
    budget = fit.budget
    assert budget is not None and [source.source for source in budget.sources] == ["bearing 1: clearance"]
    ends = [identify(response, fit_settings(rig=rig))[0] for rig in uncertain.ends("bearing 1: clearance")[0]]
    for name in ("wear_depth", "wear_angle"):
        expected = (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
        assert budget.change_by("bearing 1: clearance", name) == pytest.approx(expected, rel=0.15)
    assert fit.parameter("wear_depth").full_error > 2 * fit.parameter("wear_depth").std_error

"""Fitted modes that a structure cannot have."""

from __future__ import annotations

import pytest

from labpipe.estimation.diagnostics import mode_findings
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import FitSettings
from labpipe.records.finding import Parameter
from labpipe.records.response import Port
from labpipe.records.settings import ESTIMATE

DRIVEN = Port("y", "y", "1")
UNITS = {"m": "kg", "k": "N/m", "zeta": "1", "f_n": "Hz"}


def said(
    values: dict[str, float], output: Port = DRIVEN, closed_loop: bool = False, mass: float | str = ESTIMATE
) -> str:
    """The message on a mode with these values in the band 10-20 Hz, driven at the point 1; empty for none."""
    setup = Setup((output,), (Port("f", "f", "1"),), FitSettings("sdof", mass=mass), closed_loop)
    parameters = [Parameter(name, value, UNITS[name]) for name, value in values.items()]
    findings = mode_findings(parameters, (10.0, 20.0), setup)
    assert all((finding.code, finding.level) == ("unphysical", "warning") for finding in findings)
    return "".join(finding.message for finding in findings)


@pytest.mark.parametrize(
    "values",
    [
        {"m": 1.0, "zeta": 0.01, "f_n": 15.0},
        {"zeta": 0.0, "f_n": 10.0},
        {"f_n": 20.0},
        {"k": 1.0, "m": 1.0},
        {},
    ],
)
def test_a_mode_of_a_structure_is_none_of_them(values: dict[str, float]) -> None:
    """Damping of exactly nothing does not grow, and both ends of the band belong to it."""
    assert said(values) == ""


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"m": -0.5, "f_n": 15.0}, "m = -0.5 kg is negative"),
        ({"zeta": -0.02, "f_n": 15.0}, "zeta = -0.02 is negative"),
        ({"f_n": 9.9}, "f_n = 9.9 Hz lies outside the band 10-20 Hz"),
        ({"f_n": 20.1}, "outside the band"),
        ({"k": -1.0, "m": 1.0}, "different signs: there is no resonance"),
        ({"k": 0.0, "m": 1.0}, "there is no resonance"),
    ],
)
def test_what_is_wrong_is_said(values: dict[str, float], what: str) -> None:
    assert what in said(values)


def test_what_explains_itself_is_not_said() -> None:
    """A transfer FRF may have a mode of negative size, a loop may hold what does not swing, and a given mass
    stands for itself.
    """
    assert said({"m": -0.5, "f_n": 15.0}, output=Port("y", "y", "2")) == ""
    assert said({"k": -1.0, "m": 1.0}, closed_loop=True) == ""
    assert said({"m": -0.5, "zeta": -1.0, "f_n": 5.0}, mass=1.0) == ""

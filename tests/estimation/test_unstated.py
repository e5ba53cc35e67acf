"""What counts as zero since nobody stated it: listed with every fit of an FRF, gone once it is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.artefacts.identification_file import fit_entry, read_fit
from labpipe.estimation.derived import add_unstated
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty
from labpipe.report.budget import budget_blocks

FREQUENCY = np.linspace(20.0, 60.0, 61)
W = 2 * np.pi * FREQUENCY
# k = 1e5 N/m, c = 20 N s/m, m = 2 kg: zeta = 20 / (2 sqrt(2e5)) = 2.236 %.
RESPONSE = FrequencyResponse(
    FREQUENCY, (1 / (1e5 - 2 * W**2 + 20j * W))[:, None, None], (Port("y", "y", "x"),), (Port("f", "f", "x"),)
)
OF_GAIN = ChannelUncertainty("gain", Uncertainty("calibrator", 0.01, "1"))


def sources(response: FrequencyResponse, settings: FitSettings) -> dict[str, str]:
    (fit,) = identify(response, settings)
    return {entry.source: entry.effect for entry in fit.not_stated}


def test_gains_mass_level_and_law_of_damping_are_listed() -> None:
    listed = sources(RESPONSE, FitSettings("sdof"))
    assert list(listed) == [
        "gain of f, y",
        "mass m_t of what is attached to the structure",
        "level of the force",
        "law of damping",
    ]
    assert "2.2 %" in listed["law of damping"]


def test_what_is_stated_is_not_listed() -> None:
    stated = replace(RESPONSE, outputs=(replace(RESPONSE.outputs[0], uncertainties=(OF_GAIN,)),))
    assert "gain of f" in sources(stated, FitSettings("sdof"))
    assert "law of damping" not in sources(RESPONSE, FitSettings("sdof", damping="hysteretic"))
    of_given_mass = sources(RESPONSE, FitSettings("sdof", mass=2.0))
    assert not any("attached" in source for source in of_given_mass)


def test_result_and_report_hold_them() -> None:
    (fit,) = identify(RESPONSE, FitSettings("sdof"))
    assert read_fit(fit_entry(fit)).not_stated == fit.not_stated
    (table,) = budget_blocks(fit)
    assert all(row[1] == "0 (not stated)" for row in table.rows) and len(table.rows) == 4


@pytest.mark.parametrize(
    ("names", "effect", "has_mass"),
    [
        ({"f_n": "f_n_1", "zeta": "zeta_1"}, "the size of the mode shapes; f_n and zeta not at all", True),
        (
            {"k": "viscosity", "c": "clearance"},
            "every parameter, as far as the residual does not show it",
            False,
        ),
    ],
)
def test_models_without_stiffness_name_what_they_have(
    names: dict[str, str], effect: str, has_mass: bool
) -> None:
    """No k, c, m of a fit that has none: a page to be signed spoke of them for the oil of a bearing."""
    (fit,) = identify(RESPONSE, FitSettings("sdof"))
    renamed = tuple(replace(p, name=names[p.name]) for p in fit.parameters if p.name in names)
    listed = add_unstated(replace(fit, parameters=renamed), RESPONSE, FitSettings("sdof")).not_stated
    effects = {entry.source: entry.effect for entry in listed}
    assert effects["gain of f, y"] == effect
    assert any("attached" in source for source in effects) == has_mass

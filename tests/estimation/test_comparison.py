"""Which models a fit is compared with."""

from __future__ import annotations

from typing import Any

import pytest

from labpipe.estimation.comparison import comparison_findings, variants_of
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Candidate
from labpipe.records.settings import ESTIMATE

GENERAL, SYMMETRIC = {"symmetric": False}, {"symmetric": True}


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"model": "sdof", "mass": 1.0}, ["sdof", "sdof, mass estimated"]),
        ({"model": "sdof", "mass": ESTIMATE}, ["sdof, mass estimated"]),
        (
            {"model": "mdof", "mass": 1.0, **GENERAL},
            [
                "mdof, general",
                "mdof, general, mass estimated",
                "mdof, symmetric",
                "mdof, general, proportional damping",
            ],
        ),
        (
            {"model": "mdof", "mass": 1.0, **SYMMETRIC},
            [
                "mdof, symmetric",
                "mdof, general",
                "mdof, symmetric, mass estimated",
                "mdof, symmetric, proportional damping",
            ],
        ),
        (
            {"model": "mdof", "mass": ESTIMATE, "damping": "proportional", **SYMMETRIC},
            [
                "mdof, symmetric, proportional damping, mass estimated",
                "mdof, general, proportional damping, mass estimated",
                "mdof, symmetric, mass estimated",
                "mdof, symmetric, proportional damping, lumped mass estimated",
            ],
        ),
        (
            {"model": "rotor-2dof", "mass": 1.0},
            ["rotor-2dof", "rotor-2dof-direct", "rotor-2dof, proportional damping"],
        ),
        ({"model": "rotor-2dof-direct", "mass": 1.0}, ["rotor-2dof-direct", "rotor-2dof"]),
    ],
)
def test_one_assumption_more_or_less_at_a_time(settings: dict[str, Any], names: list[str]) -> None:
    variants = variants_of(FitSettings(**settings))
    assert [variant.name for variant in variants] == [f"this model: {names[0]}", *names[1:]]


def test_another_model_is_named_where_this_one_has_no_support() -> None:
    """Differences of AIC of ten and more leave essentially none (Burnham and Anderson 2002)."""

    def ranking(apart: float) -> tuple[Candidate, ...]:
        return (
            Candidate("mdof", 5, 90.0, 100, 100.0),
            Candidate("this model: sdof", 3, 94.0 + apart, 102, 100.0 + apart),
        )

    (finding,) = comparison_findings(ranking(10.5))
    assert finding.code == "other-model" and "'mdof' with 5 parameters" in finding.message
    assert comparison_findings(ranking(9.5)) == () == comparison_findings(ranking(10.5)[:1])

"""What a floating-bearing fit says of the motion of the shaft and of signs, and how often without a cause."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from labpipe.methods.floating_bearing import findings
from labpipe.methods.floating_bearing.findings import motion_findings, physical_findings, shaft_motion
from labpipe.methods.floating_bearing.stator import stator_of
from labpipe.methods.floating_bearing.virtual_rig import FilmCondition, FloatingNoise, FloatingRig
from labpipe.records.finding import Parameter
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.settings import FrfSettings
from tests.methods.floating_bearing import floating_rig
from tests.methods.floating_bearing.floating_rig import JOURNAL, SEAL, kcm


@pytest.mark.parametrize(
    ("moved", "accelerated", "level"),
    [
        (None, False, None),
        # Two and nine tenths of a standard error are noise, one and nine tenths per mille of the motion are
        # too little to matter.
        ((0.1, 2.9), False, None),
        ((0.0019, 100.0), False, None),
        ((0.0021, 3.1), False, "warning"),
        ((0.0021, 3.1), True, "note"),
    ],
)
def test_motion_beyond_three_standard_errors_is_said(
    monkeypatch: pytest.MonkeyPatch, moved: tuple[float, float] | None, accelerated: bool, level: str | None
) -> None:
    monkeypatch.setattr(findings, "shaft_motion", lambda _: moved)
    monkeypatch.setattr(findings, "effective_forces", lambda _: False)
    found = motion_findings(cast("Any", None), cast("Any", SimpleNamespace(accelerated=accelerated)))
    assert [finding.level for finding in found] == ([level] if level else [])
    assert not found or found[0].code == "shaft-moves"


# A smaller bench than the shipped one: 25 kg, lines every 2 Hz up to 200 Hz, five periods, no film.
BENCH = FloatingRig(
    kind="virtual-floating-rig",
    stator_mass=25.0,
    conditions=(("dry", FilmCondition()),),
    baseline_stiffness=((1.1e6, 0.0), (0.0, 0.9e6)),
    baseline_damping=((400.0, 0.0), (0.0, 350.0)),
    force=300.0,
    band=(4.0, 200.0),
    spacing=2.0,
    periods=5,
    sample_rate=1000.0,
    noise=FloatingNoise(force=1.0, displacement=1e-7, acceleration=0.3),
)
LINES = FrfSettings("periodic", period="0.5 s", skip=0, band="4-200 Hz", result="spectra")


def test_a_shaft_at_rest_does_not_move() -> None:
    """50 recordings of a dry stator, whose shaft nothing moves: said in none or one (0.13 % by chance, which
    exceeds one once in 500).

    A / w^2 is 2500 times as noisy at 4 as at 200 Hz; by one noise for all lines it was said in 40 of 150.
    """
    said = 0
    for seed in range(50):
        stator = stator_of(channel_spectra(recordings(BENCH, seed, ["dry-plus"]), LINES), None, (), ())
        moved = shaft_motion(stator)
        assert moved is not None
        said += moved[1] > findings.SEEN and moved[0] > findings.MOVES
    assert said <= 1


def test_a_shaft_that_moves_is_seen() -> None:
    """A film of 2 MN/m on a shaft of 50 MN/m: 4 % of the motion."""
    film = FilmCondition(stiffness=((2e6, 0.0), (0.0, 2e6)), damping=((2e3, 0.0), (0.0, 2e3)))
    rig = replace(BENCH, conditions=(("film", film),), shaft_stiffness=((5e7, 0.0), (0.0, 5e7)))
    stator = stator_of(channel_spectra(recordings(rig, 1, ["film-plus"]), LINES), None, (), ())
    moved = shaft_motion(stator)
    assert moved is not None and moved[1] > 10 and 0.02 < moved[0] < 0.08


@pytest.mark.parametrize(
    ("turn", "message"),
    [
        # A probe at +30 deg reads cos 30 x + sin 30 y.
        ([[0.866025404, 0.5], [-0.5, 0.866025404]], "turned by"),
        ([[-1.0, 0.0], [0.0, -1.0]], "`invert: true` for both"),
        ([[0.0, 1.0], [1.0, 0.0]], "the channels of x and y are swapped"),
        ([[1.0, 0.0], [0.0, -1.0]], "`invert: true` for the one along y"),
        ([[-1.0, 0.0], [0.0, 1.0]], "`invert: true` for the one along x"),
        ([[1.0, 0.0], [0.0, 1.0]], "the shaft moves by"),
    ],
)
@pytest.mark.parametrize("film", [JOURNAL, SEAL, {"k": [[1e7, 3e7], [-3e7, 1e7]], "c": [[0.0, 0.0]] * 2}])
def test_displacements_against_the_accelerations(
    film: dict[str, list[list[float]]], turn: list[list[float]], message: str
) -> None:
    """D' = R D of probes elsewhere than stated, beside a shaft that moves by up to 7 %; of probes that stand
    right it is the shaft that moves, or nothing does.
    """
    shaft = kcm([[4e9, 0.0], [0.0, 4e9]], [[2e4, 0.0], [0.0, 2e4]])
    rig = floating_rig.FloatingRig(kcm(**film), rotor=shaft)
    spectra = rig.draw(np.random.default_rng(1))
    probes = np.eye(6)
    probes[2:4, 2:4] = turn
    turned = replace(
        spectra, vectors=spectra.vectors @ probes.T, covariance=probes @ spectra.covariance @ probes.T
    )
    given = cast("Any", SimpleNamespace(accelerated=True))
    found = motion_findings(stator_of(turned, None, (), ()), given)
    right = np.array_equal(turn, np.eye(2))
    assert all(finding.level == ("note" if right else "warning") for finding in found)
    text = "".join(finding.message for finding in found)
    if message == "turned by":
        assert float(text.partition("turned by ")[2].partition(" deg")[0]) == pytest.approx(30.0, abs=0.5)
    assert message in text or (right and not found)


def test_a_sign_is_unphysical_beyond_its_uncertainty_alone() -> None:
    """An added mass that is zero lies below zero by two standard errors in one fit of forty."""
    small = Parameter("m_xx", -2.5, "kg", std_error=1.0, ci95=(-4.5, -0.5), significant=True)
    assert not physical_findings((small,))
    assert physical_findings((replace(small, value=-3.5),))
    assert not physical_findings((replace(small, value=-3.5, systematic=2.0, combined=2.24),))

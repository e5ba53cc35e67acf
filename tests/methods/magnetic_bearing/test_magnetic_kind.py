"""Magnetic-bearing files: geometry, factors or static stiffness; what is missing or said twice is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing import virtual_mechanics as mechanics
from labpipe.methods.magnetic_bearing.bearing import (
    MAGNETIC_KIND,
    MU_0,
    Magnet,
    MagneticFile,
    magnet_factors,
    verdict,
)
from labpipe.methods.magnetic_bearing.loop import ControlLoop, dynamic_stiffness
from labpipe.project.bearing_file import open_bearing
from labpipe.project.simulate import load_virtual_rig

FILE = MagneticFile(kind="magnetic-bearing", mass=0.065, frequency=50.0, static_stiffness=1694.0)
MAGNET = Magnet(turns=180, gap=0.45e-3, pole_area=60e-6, bias_current=0.2)


def test_shipped_file_is_the_virtual_rig_s_bearing(root: Path) -> None:
    """k and c of the rig's truth, which its recordings hold, at every frequency of the sweep."""
    file = open_bearing(root / "configs/bearings/hmb-magnetic.yaml")
    frequency = np.arange(1.0, 251.0)
    found = file.coefficients([replace(file.settings(), frequency=each) for each in frequency])
    rig = load_virtual_rig(root / "configs/virtual-hmb-loop.yaml").levitation
    truth = mechanics.levitation_stiffness(rig, 2 * np.pi * frequency) / rig.bearings
    np.testing.assert_allclose([each.stiffness[0, 0] for each in found], truth.real, rtol=1e-9)
    np.testing.assert_allclose(
        [each.damping[1, 1] for each in found], truth.imag / (2 * np.pi * frequency), rtol=1e-9
    )


def test_shares_sum_to_the_coefficients() -> None:
    (found,) = MAGNETIC_KIND.coefficients([FILE])
    for symbol, matrix in (("k_", found.stiffness), ("c_", found.damping)):
        total = sum(share.value for share in found.shares if share.name.startswith(symbol))
        assert total == pytest.approx(matrix[0, 0], rel=1e-12)


def test_speed_is_the_frequency_unless_one_is_given() -> None:
    assert replace(FILE, frequency=None, speed=30.0).motion_frequency == 30.0
    assert replace(FILE, speed=30.0).motion_frequency == 50.0


def test_static_stiffness_is_a_way_to_give_the_negative_one() -> None:
    inferred = FILE.suspension()
    assert (
        replace(FILE, static_stiffness=None, negative_stiffness=inferred.negative_stiffness).suspension()
        == inferred
    )
    assert "inferred from the static stiffness" in FILE.assumptions()


def test_geometry_gives_both_factors_and_given_ones_replace_it() -> None:
    """k_i = 4 mu_0 N^2 A i_0 / g^2 of the electromagnet alone."""
    plant = replace(FILE, static_stiffness=None, magnet=MAGNET).suspension()
    assert plant.loop.force_per_current == pytest.approx(
        4 * MU_0 * 180**2 * 60e-6 * 0.2 / 0.45e-3**2, rel=1e-12
    )
    assert plant.negative_stiffness == magnet_factors(MAGNET).negative_stiffness
    given = replace(
        FILE, static_stiffness=None, magnet=MAGNET, force_per_current=5.8, negative_stiffness=1e4
    ).suspension()
    assert (given.loop.force_per_current, given.negative_stiffness) == (5.8, 1e4)
    assert "no leakage" in replace(FILE, magnet=MAGNET).assumptions()


def test_unstable_loop_is_said_and_has_no_sensitivity() -> None:
    """The printed sign of the lag: two growing poles, which the test of stability finds by two ways."""
    (found,) = MAGNETIC_KIND.coefficients([replace(FILE, loop=ControlLoop(lag=0.25))])
    assert [finding.code for finding in found.findings] == ["unstable-loop"]
    assert "256.4" in found.findings[0].message and found.words["stability"] == "unstable"
    assert "sensitivity_zone" not in found.words and all(
        note.name != "sensitivity_peak" for note in found.notes
    )


def test_the_poles_of_a_sampled_loop_are_no_approximation() -> None:
    """A constant gain in z, and more pull than it gives stiffness."""
    gain = {"form": "polynomial", "numerator": [1.0, 0.0], "denominator": [1.0, 0.0], "rate": 20e3}
    loose = replace(FILE, static_stiffness=None, negative_stiffness=3e5, loop=ControlLoop(controller=[gain]))
    (found,) = MAGNETIC_KIND.coefficients([loose])
    assert re.fullmatch(r"the loop is unstable: 1 pole grows; at \d+ \+0j rad/s", found.findings[0].message)


def test_well_damped_loop_has_no_warning() -> None:
    """Without the bias field's pull, S is s^2 / (s^2 + 2 z w_0 s + w_0^2) but for the lags, below 1 for z = K
    k_d / 2 sqrt(K m) = 0.84.
    """
    loop = ControlLoop(lag=0.0, derivative=2e-3)
    (found,) = MAGNETIC_KIND.coefficients(
        [replace(FILE, static_stiffness=None, negative_stiffness=0.0, loop=loop)]
    )
    assert found.findings == () and found.words["sensitivity_zone"] == "A"


def test_verdict_is_kept_over_a_sweep() -> None:
    assert verdict(FILE.suspension()) is verdict(replace(FILE, frequency=77.0).suspension())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mass": 0.0}, "mass must be positive"),
        ({"frequency": None}, "frequency: is missing"),
        ({"frequency": 0.0}, "frequency: must be above zero"),
        ({"negative_stiffness": 1e4}, "is given as well"),
        ({"static_stiffness": None}, "negative_stiffness: is missing"),
        (
            {"loop": ControlLoop(force_per_current=7.0), "force_per_current": 5.0},
            "'force_per_current' gives it",
        ),
        ({"loop": ControlLoop(force_per_current=7.0), "magnet": MAGNET}, "'magnet' gives it"),
    ],
)
def test_what_is_missing_or_said_twice_is_refused(change: dict[str, float | None], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        replace(FILE, **change)


def test_inferred_entries_are_told_and_must_be_entries() -> None:
    assert "neither published nor measured: lag, gap" in replace(FILE, inferred=("lag", "gap")).assumptions()
    assert "neither published" not in FILE.assumptions()
    with pytest.raises(ConfigError, match="'lagg' is not an entry"):
        replace(FILE, inferred=("lagg",))


def test_the_shipped_magnet_has_the_published_static_stiffness(root: Path) -> None:
    """1694 N/m (Lim et al. 2009) from turns, gap, bias current and coercivity as printed.

    Pole area and magnet length are inferred.
    """
    file = open_bearing(root / "configs/bearings/hmb-geometry.yaml").settings()
    plant = file.suspension()
    assert dynamic_stiffness(plant.loop, plant.negative_stiffness, np.zeros(1))[0].real == pytest.approx(
        1694, abs=1
    )
    assert "pole_area, magnet_length" in file.assumptions()
    assert (file.magnet.turns, file.magnet.gap, file.magnet.bias_current) == pytest.approx(
        (180, 0.45e-3, 0.2)
    )
    # 9.465 kOe, 1 Oe = 1000 / (4 pi) A/m.
    assert file.magnet.coercivity == pytest.approx(9465 * 1000 / (4 * np.pi), rel=1e-4)

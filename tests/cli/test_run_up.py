"""labpipe orders on the shipped levitated run-up: 1x and whole motion at both ends, orbits against the
gap.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from labpipe.methods.magnetic_bearing.loop import dynamic_stiffness
from labpipe.project.bearing_file import open_bearing


@pytest.fixture
def command(root: Path, tmp_path: Path) -> list[object]:
    files = [root / "sample_data/hmb-loop/run-up.parquet", "-r", root / "configs/hmb-run-up.yaml"]
    return ["orders", *files, "--tacho", "n", "-o", tmp_path / "out"]


@pytest.mark.usefixtures("undrawn")
def test_amplitudes_are_those_of_the_unbalance_on_the_loop(
    command: list[object], root: Path, tmp_path: Path, labpipe
) -> None:
    """m e w^2 / (K_eq + j w C_eq - m w^2) of 15 um at the front and 9 um at the rear.

    2 % is what run-up and noise leave.
    """
    ended = labpipe(*command, "--gap", "0.45 mm")
    assert ended.code == 0 and "of the gap" in ended.out and "within 20 % at all speeds" in ended.out, ended
    drawn = {"orders.svg", "orbits-front.svg", "orbits-rear.svg", "gap.svg"}
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"orders.csv", *drawn}
    rows = list(csv.DictReader((tmp_path / "out/orders.csv").read_text("utf-8").splitlines()))
    table = {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    plant = open_bearing(root / "configs/bearings/hmb-magnetic.yaml").settings().suspension()
    omega = 2 * np.pi * table["speed_hz"]
    bearing = dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    compliance = np.abs(0.065 * omega**2 / (bearing - 0.065 * omega**2))
    # Below 2400 rpm the orbit is near the noise of a stretch.
    fast = table["speed_hz"] > 40
    for end, eccentricity in (("front", 15e-6), ("rear", 9e-6)):
        for name in (f"{end}.x:amplitude", f"{end}:f:amplitude", f"{end}:half_axis"):
            np.testing.assert_allclose(
                table[name][fast], (eccentricity * compliance)[fast], rtol=0.04, err_msg=name
            )
        assert np.all(table[f"{end}:orbit"] >= table[f"{end}:half_axis"])
        assert np.all(table[f"{end}.y:overall"] >= 0.97 * table[f"{end}.y:amplitude"])
        np.testing.assert_allclose(table[f"{end}:orbit_per_gap"], table[f"{end}:orbit"] / 0.45e-3, rtol=1e-6)


@pytest.mark.usefixtures("undrawn")
def test_an_orbit_beyond_the_limit_is_told_with_its_speed(command: list[object], labpipe) -> None:
    ended = labpipe(*command, "--gap", "100 um", "--limit", "15 %")
    assert ended.code == 0 and "front" in ended.out and "beyond 15 % at speeds from" in ended.out, ended


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--gap", "0.45 mm", "--limit", "0 %"), "--gap and --limit must be positive"),
        (("--gap", "0.45 N"), "--gap: 'N' has the wrong dimension"),
        (("--gap", "450"), "--gap: '450' has no unit"),
    ],
)
def test_a_gap_that_is_none_is_said(
    command: list[object], arguments: tuple[str, ...], message: str, labpipe
) -> None:
    ended = labpipe(*command, *arguments)
    assert ended.code == 2 and message in ended.err, ended


def test_a_gap_needs_a_plane_of_displacements(root: Path, tmp_path: Path, labpipe) -> None:
    text = (root / "configs/hmb-run-up.yaml").read_text("utf-8")
    (tmp_path / "rig.yaml").write_text(
        text.replace("dof: front.y", "dof: a").replace("dof: rear.y", "dof: b"), encoding="utf-8"
    )
    source = root / "sample_data/hmb-loop/run-up.parquet"
    ended = labpipe(
        "orders", source, "-r", tmp_path / "rig.yaml", "--tacho", "n", "--gap", "1 mm", "-o", tmp_path / "out"
    )
    assert ended.code == 2 and "no orbit to compare with the gap" in ended.err, ended

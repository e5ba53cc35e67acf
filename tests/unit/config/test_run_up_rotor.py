"""Rotor files with pins: what they hold, and every fault at its place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.config.rotor import load_rotor
from labpipe.config.run_up_rotor import load_run_up_rotor
from labpipe.config.virtual_rig import load_virtual_rig
from labpipe.errors import ConfigError


@pytest.fixture
def text(root: Path) -> str:
    return (root / "configs/rotors/falah.yaml").read_text(encoding="utf-8")


def test_the_shipped_rotor(root: Path) -> None:
    rig = load_run_up_rotor(root / "configs/rotors/falah.yaml")
    assert (rig.pins, rig.planes) == ((1, 5), (("disc 1", 2), ("disc 2", 4)))
    assert (rig.place.name, rig.place.node) == ("journal", 3)
    assert sum(element.length for element in rig.rotor.elements) == pytest.approx(0.76)
    bearing = rig.place.bearing
    assert (bearing.diameter, bearing.length, bearing.clearance, bearing.viscosity) == (0.0165, 0.00825, 0.0002, 0.55)
    assert np.degrees(bearing.groove_width) == pytest.approx(20)
    assert rig.known_unbalance["disc 2"] == pytest.approx(30e-6 * np.exp(1j * np.pi / 3))


def test_an_entry_may_be_set_from_outside(root: Path) -> None:
    rig = load_run_up_rotor(root / "configs/rotors/falah.yaml", ["bearings.0.viscosity=0.4 Pa.s"])
    assert rig.place.bearing.viscosity == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("pins: [1, 5]\n", "", "pins: is missing"),
        ("pins: [1, 5]", "pins: 1", "pins: a list of nodes is needed"),
        ("pins: [1, 5]", "pins: [1, five]", "pins.2: the number of a node"),
        ("pins: [1, 5]", "pins: [1, 9]", "node 9"),
        ("disc 1: 2", "disc 1: true", "planes.disc 1: the number of a node"),
        ("disc 1: 2, disc 2: 4", "disc 1: 2", "no plane at node 4"),
        ("viscosity: 0.55 Pa.s", "viscosity: 0.55 m", "wrong dimension"),
        ("groove_width: 20 deg", "groove_width: 200 deg", "a groove of 200 deg"),
        ("count: 4", "cont: 4", "unknown key"),
        ("size: 30 g.mm", "size: 30", "has no unit"),
    ],
)
def test_faults_are_named_with_their_place(tmp_path: Path, text: str, old: str, new: str, said: str) -> None:
    assert old in text
    path = tmp_path / "broken.yaml"
    path.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=said) as caught:
        load_run_up_rotor(path)
    assert f"{path}:" in str(caught.value)


def test_where_a_rotor_in_journal_bearings_is_needed_pins_are_said(root: Path) -> None:
    with pytest.raises(ConfigError, match=r"falah.yaml:\d+:1: pins: this rotor runs between pins") as caught:
        load_rotor(root / "configs/rotors/falah.yaml")
    assert "\n" not in str(caught.value)


def test_two_journal_bearings_between_pins_are_refused(tmp_path: Path, text: str) -> None:
    line = next(one for one in text.splitlines() if one.lstrip().startswith("- {name: journal"))
    path = tmp_path / "two.yaml"
    path.write_text(text.replace(line, f"{line}\n{line}"))
    with pytest.raises(ConfigError, match="runs on one journal bearing"):
        load_run_up_rotor(path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rotors/falah.yaml", "rotors/fala.yaml", "no such file"),
        ("truth: outside", "truth: outsider", "unknown choice"),
        ("speeds: 400-3000 rpm", "speeds: 400-3000 kg", "wrong dimension"),
        ("amplitude: 1 %", "amplitude: 0 %", "is positive"),
    ],
)
def test_faults_of_the_virtual_rig(root: Path, tmp_path: Path, old: str, new: str, said: str) -> None:
    (tmp_path / "rotors").mkdir()
    (tmp_path / "rotors/falah.yaml").write_text((root / "configs/rotors/falah.yaml").read_text())
    path = tmp_path / "virtual.yaml"
    shipped = (root / "configs/virtual-unbalance.yaml").read_text()
    assert old in shipped
    path.write_text(shipped.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        load_virtual_rig(path)


def test_a_rotor_without_unbalances_makes_no_run_up(tmp_path: Path, text: str, root: Path) -> None:
    (tmp_path / "rotors").mkdir()
    (tmp_path / "rotors/falah.yaml").write_text(text[: text.index("unbalances:")])
    path = tmp_path / "virtual.yaml"
    path.write_text((root / "configs/virtual-unbalance.yaml").read_text())
    with pytest.raises(ConfigError, match="has no unbalances"):
        load_virtual_rig(path)

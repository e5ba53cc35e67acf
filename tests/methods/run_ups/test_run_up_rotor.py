"""Rotor files with pins: what they hold, and every fault at its place."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.run_ups.metamodel_kinds import Grid, ResponseSurface, fit_surface
from labpipe.methods.run_ups.rotor import as_eight
from labpipe.methods.run_ups.rotor_file import files_of, load_run_up_rotor
from labpipe.project.simulate import load_virtual_rig


@pytest.fixture
def text(root: Path) -> str:
    return (root / "configs/rotors/falah.yaml").read_text(encoding="utf-8")


def test_the_shipped_rotor(root: Path) -> None:
    rig = load_run_up_rotor(root / "configs/rotors/falah.yaml")
    assert (rig.pins, rig.planes) == ((1, 5), (("disc 1", 2), ("disc 2", 4)))
    assert (rig.place.name, rig.place.node) == ("journal", 3)
    assert sum(element.length for element in rig.rotor.elements) == pytest.approx(0.76)
    bearing = rig.place.bearing
    assert (bearing.diameter, bearing.length, bearing.clearance, bearing.viscosity) == (
        0.0165,
        0.00825,
        0.0002,
        0.55,
    )
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


def with_coefficients(
    tmp_path: Path, text: str, entries: object, named: str = "identification.json#surface"
) -> Path:
    """A rotor file that names a metamodel in a file of these entries."""
    (tmp_path / "identification.json").write_text(json.dumps(entries))
    path = tmp_path / "rotor.yaml"
    path.write_text(f"{text}\ncoefficients: {named}\n")
    return path


def surface() -> tuple[ResponseSurface, dict[str, object]]:
    """A surface over 4 to 10 N and 60 to 240 rad/s, and an identification that holds it."""
    load, speed = np.repeat([4.0, 6.0, 10.0], 4), np.tile([60.0, 120.0, 180.0, 240.0], 3)
    eight = np.tile([4e4, 2e4, -1e4, 3e4, 200, 50, 50, 150], (12, 1)) * (load / 6 + speed / 300)[:, None]
    model = fit_surface(Grid(load, speed, eight))
    return model, {"run_ups": {"metamodels": [{"name": "surface", "model": model.to_entries()}]}}


def test_coefficients_identified_before_take_the_place_of_the_film(
    tmp_path: Path, text: str, root: Path
) -> None:
    model, entries = surface()
    path = with_coefficients(tmp_path, text, entries)
    rig = load_run_up_rotor(path)
    speed = np.array([70.0, 200.0, 300.0])
    eight = as_eight(*rig.start_coefficients(7.0, speed))
    np.testing.assert_allclose(eight[:2], model.predict(7.0, speed[:2]))
    # Beyond the measured speeds K and Omega C are held.
    np.testing.assert_allclose(eight[2], model.predict(7.0, np.array([240.0]))[0] * np.repeat([1, 0.8], 4))
    film = load_run_up_rotor(root / "configs/rotors/falah.yaml")
    assert np.all(eight[0] != as_eight(*film.start_coefficients(7.0, speed))[0])
    assert rig.critical_speed(rig.start(7.0)) != film.critical_speed(film.start(7.0))
    assert files_of(path) == (path, tmp_path / "identification.json")
    assert files_of(root / "configs/rotors/falah.yaml") == (root / "configs/rotors/falah.yaml",)


@pytest.mark.parametrize(
    ("entries", "named", "said"),
    [
        ({}, "nowhere.json#surface", "no such file"),
        ({}, "identification.json", "is not FILE#NAME"),
        ({}, "identification.json#surface", "holds no metamodels"),
        ([1], "identification.json#surface", "is not a readable identification.json"),
        (
            {"run_ups": {"metamodels": [{"name": "surface", "model": {"kind": "surface"}}]}},
            "identification.json#surface",
            "are damaged",
        ),
        (
            {"run_ups": {"metamodels": [{"name": "surface", "model": {}}]}},
            "identification.json#surfaces",
            "did you mean 'surface'",
        ),
    ],
)
def test_coefficients_that_cannot_be_read_are_faults_at_their_place(
    tmp_path: Path, text: str, entries: object, named: str, said: str
) -> None:
    path = with_coefficients(tmp_path, text, entries, named)
    with pytest.raises(ConfigError, match=said) as caught:
        load_run_up_rotor(path)
    assert f"{path}:" in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_that_is_no_json_is_said(tmp_path: Path, text: str) -> None:
    path = with_coefficients(tmp_path, text, {})
    (tmp_path / "identification.json").write_text("{")
    with pytest.raises(ConfigError, match=r"is not a readable identification\.json"):
        load_run_up_rotor(path)


def test_where_a_rotor_in_journal_bearings_is_needed_pins_are_said(root: Path) -> None:
    with pytest.raises(ConfigError, match=r"falah.yaml:\d+:1: pins: this rotor runs between pins") as caught:
        load_rotor(root / "configs/rotors/falah.yaml")
    assert "\n" not in str(caught.value)


def test_two_journal_bearings_between_pins_are_refused(tmp_path: Path, text: str) -> None:
    line = next(one for one in text.splitlines() if one.lstrip().startswith("- {name: journal"))
    path = tmp_path / "two.yaml"
    path.write_text(text.replace(line, f"{line}\n{line}"))
    with pytest.raises(ConfigError, match="runs on one bearing"):
        load_run_up_rotor(path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rotors/falah.yaml", "rotors/fala.yaml", "no such file"),
        ("truth: outside", "truth: outsider", "unknown choice"),
        ("speeds: 400-3000 rpm", "speeds: 400-3000 kg", "wrong dimension"),
        ("amplitude: 1 %", "amplitude: 0 %", "must be positive"),
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


def test_run_ups_do_not_take_the_uncertainty_of_a_film(text: str, tmp_path: Path) -> None:
    (tmp_path / "rotor.yaml").write_text(
        re.sub(r"(clearance: [^,}]*)", r"\1 +- 2 %", text, count=1), encoding="utf-8"
    )
    with pytest.raises(ConfigError, match="the uncertainty of journal: clearance is not used by run-ups"):
        load_run_up_rotor(tmp_path / "rotor.yaml")

"""Rotor files: the shipped ones, every kind of entry, and every fault at its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.bearings.kinds import LinearBearingSettings
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.rotor.response import growth_rate, modes
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.rotor.shaft import ALUMINIUM, Disc

SMALL = """name: Small
speed: 3000 rpm
materials:
  brass: {density: 8500 kg/m^3, elastic_modulus: 100 GPa, shear_modulus: 37 GPa}
elements:
  - {diameter: 20 mm, length: 100 mm, count: 3}
  - {diameter: 30 mm, inner_diameter: 10 mm, length: 50 mm, material: brass}
discs:
  - {node: 3, mass: 2 kg, polar_inertia: 0.003 kg.m^2, transverse_inertia: 0.002 kg.m^2}
  - {node: 4, inner_diameter: 20 mm, outer_diameter: 60 mm, length: 10 mm, material: aluminium}
bearings:
  - {node: 1, kind: journal-bearing, diameter: 20 mm, length: 10 mm, clearance: 50 um, viscosity: 50 mPa.s}
  - {name: right, node: 5, kind: journal-bearing, viscosity: 50 mPa.s, diameter: 30 mm,
     length: 10 mm, clearance: 50 um}
loads:
  - {node: 3, y: 5 N, z: -10 N}
  - {node: 3, z: -10 N}
unbalances:
  - {node: 3, size: 20 g.mm, phase: 90 deg}
force: 3
response: 4
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    return path


@pytest.fixture(scope="module")
def mendes() -> RotorRig:
    return load_rotor(Path(__file__).parents[3] / "configs/rotors/mendes.yaml")


def test_mendes_rig_is_the_tables_rotor(mendes: RotorRig) -> None:
    diameters = [12, 12, 31, 31, 12, 12, 12, 12, 30, 30, 12, 12, 31, 31, 12]
    lengths = [60, 60, 10, 10, 55, 55, 55, 55, 40, 40, 50, 50, 10, 10, 30]
    assert [round(1e3 * piece.outer_diameter) for piece in mendes.rotor.elements] == diameters
    assert [round(1e3 * piece.length) for piece in mendes.rotor.elements] == lengths
    assert mendes.rotor.discs == (Disc.of_dimensions(1, 12e-3, 25e-3, 20e-3, ALUMINIUM),)
    assert [sleeve.element for sleeve in mendes.rotor.sleeves] == [9, 10]
    assert (mendes.force, mendes.response, mendes.speed, mendes.rotor.beta) == (10, 14, 50.0, 1.6e-4)
    assert mendes.place("").name == "bearing 2"


def test_laval_rig_is_stable_with_its_critical_speed_in_the_published_range(root: Path) -> None:
    """Machado and Cavalca: 13 elements, bearings on nodes 3 and 11, unbalance 5.5e-5 kg m, 40-65 Hz."""
    laval = load_rotor(root / "configs/rotors/laval.yaml")
    assert len(laval.rotor.elements) == 13 and [place.node for place in laval.bearings] == [3, 11]
    assert laval.unbalances[0].size == 5.5e-5 and laval.unbalances[0].node == 7
    for speed in (40.0, 50.0, 65.0):
        turning = laval.at_speed(speed)
        assert growth_rate(turning.rotor, turning.supports(), turning.omega) < 0
    found = modes(laval.rotor, laval.supports(), laval.omega)
    bending = (found.eigenvalues.imag / (2 * np.pi))[found.damping_ratio < 0.03][0]
    assert 40 < bending < 65


def test_every_kind_of_entry(small: Path) -> None:
    rig = load_rotor(small)
    assert (rig.name, rig.speed, rig.rotor.n_node) == ("Small", pytest.approx(50.0), 5)
    assert rig.rotor.elements[3].material.density == 8500 and rig.rotor.elements[3].inner_diameter == 0.01
    assert rig.rotor.discs[0] == Disc(3, 2.0, 0.002, 0.003)
    assert [place.name for place in rig.bearings] == ["1", "right"] and rig.bearings[
        0
    ].bearing.viscosity == 0.05
    assert rig.unbalances[0].size == pytest.approx(2e-5) and rig.unbalances[0].phase == pytest.approx(
        np.pi / 2
    )


def test_loads_on_one_node_add_up(small: Path) -> None:
    """Both bearings together carry the weight and all loads: y 5 N, z -(20 N + m g)."""
    rig = load_rotor(small)
    total = np.sum(list(rig.static_loads().values()), axis=0)
    shaft = sum(piece.area * piece.length * piece.material.density for piece in rig.rotor.elements)
    weight = 9.80665 * (shaft + sum(disc.mass for disc in rig.rotor.discs))
    np.testing.assert_allclose(total, [5.0, -20.0 - weight], rtol=1e-9)


def test_overrides_and_the_rig_with_other_bearings(small: Path) -> None:
    rig = load_rotor(small, ["speed=60 Hz"])
    assert rig.speed == 60
    worn = rig.with_bearings(["right"], wear_depth=20e-6, wear_angle=0.1)
    assert worn.place("right").bearing.wear_depth == 20e-6 and worn.place("1").bearing.wear_depth == 0
    assert {place.bearing.viscosity for place in rig.with_bearings(viscosity=0.03).bearings} == {0.03}
    with pytest.raises(ConfigError, match=r"no bearing 'rihgt'.*did you mean 'right'"):
        rig.place("rihgt")


@pytest.mark.parametrize(
    ("line", "replacement", "where", "message"),
    [
        ("length: 50 mm", "length: 50 um/s", 7, "elements.2.length"),
        (
            "diameter: 20 mm, length: 100 mm",
            "diameter: -20 mm, length: 100 mm",
            6,
            "outer diameter of a shaft element is positive",
        ),
        ("material: brass", "material: bras", 7, "did you mean 'brass'"),
        ("- {node: 3, mass: 2 kg", "- {node: 9, mass: 2 kg", 1, "nodes 1 to 5"),
        ("mass: 2 kg, polar", "polar", 9, "one of mass and outer_diameter"),
        # I_p <= 2 I_t of every body, equal for a thin disc.
        ("inertia: 0.002", "inertia: 0.001", 9, "polar_inertia is more than twice transverse_inertia"),
        ("length: 10 mm, material: aluminium", "material: aluminium", 10, "needs its length"),
        ("mass: 2 kg", "mass: 2 kg, length: 9 mm", 9, "'length' changes nothing of a disc given by its mass"),
        ("outer_diameter: 60", "polar_inertia: 1 kg.m^2, outer_diameter: 60", 10, "'polar_inertia' changes"),
        ("shear_modulus: 37 GPa", "shear_modulus: 37 GPa, poisson: 34", 4, "Poisson's ratio lies between"),
        ("node: 1, kind", "node: 7, kind", 12, "nodes 1 to 5"),
        (
            "kind: journal-bearing, diameter: 20",
            "kind: journal-baering, diameter: 20",
            12,
            "did you mean 'journal-bearing'",
        ),
        (
            "clearance: 50 um, viscosity: 50 mPa.s}\n  - {name",
            "viscosity: 50 mPa.s}\n  - {name",
            12,
            "bearings.1.clearance: is missing",
        ),
        ("{node: 3, z: -10 N}", "{node: 8, z: -10 N}", 17, "nodes 1 to 5"),
        ("size: 20 g.mm", "sise: 20 g.mm", 19, "did you mean 'size'"),
        ("force: 3", "force: 33", 1, "the force sits on node 33"),
        ("speed: 3000 rpm", "speed: 0 rpm", 1, "speed above zero"),
        ("count: 3", "count: 0", 6, "count: from 1"),
        (
            "elastic_modulus: 100 GPa",
            "elastic_modulus: 0 GPa",
            4,
            "elastic modulus of a material is positive",
        ),
        ("name: right, node: 5", "name: right, node: 1", 1, "two bearings have one node"),
    ],
)
def test_faults_stand_at_their_place(
    small: Path, line: str, replacement: str, where: int, message: str
) -> None:
    assert line in SMALL
    small.write_text(SMALL.replace(line, replacement, 1))
    with pytest.raises(ConfigError) as caught:
        load_rotor(small)
    assert f"small.yaml:{where}:" in str(caught.value) and message in str(caught.value)


def test_all_faults_of_a_file_are_named_at_once(small: Path) -> None:
    small.write_text(SMALL.replace("2 kg", "2 m").replace("50 um", "50 umm").replace("response", "respond"))
    with pytest.raises(ConfigError) as caught:
        load_rotor(small)
    text = str(caught.value)
    assert "discs.1.mass" in text and "bearings.1.clearance" in text and "bearings.2.clearance" in text
    assert "did you mean 'response'" in text


@pytest.mark.parametrize("key", ["elements", "bearings"])
def test_what_a_rotor_needs(small: Path, key: str) -> None:
    start = SMALL.index(f"{key}:")
    end = SMALL.index("}\n", SMALL.rindex("- {", start, SMALL.index(":\n", start + len(key) + 2))) + 1
    small.write_text(SMALL[:start] + SMALL[end + 1 :])
    with pytest.raises(ConfigError, match=f"{key}: is missing"):
        load_rotor(small)
    small.write_text(f"speed: 50 Hz\n{key}: none\n")
    with pytest.raises(ConfigError, match=f"{key}: a list is needed"):
        load_rotor(small)


def test_numbers_of_bearings_may_carry_their_uncertainty(small: Path) -> None:
    """One oil in both bearings is one source; the ends differ in that number alone."""
    text = SMALL.replace("viscosity: 50 mPa.s", 'viscosity: "50 mPa.s +- 3 % (source=oil)"')
    small.write_text(
        text.replace("length: 10 mm, clearance: 50 um", "length: 10 mm, clearance: 50 um +- 2 um", 1),
        encoding="utf-8",
    )
    rig = load_rotor(small)
    assert {source.source: (source.std_error, source.unit) for source in rig.sources} == {
        "1: clearance": (pytest.approx(2e-6), "m"),
        "oil": (pytest.approx(1.5e-3), "Pa.s"),
    }
    for source, name, changed, step in (
        ("oil", "viscosity", (0, 1), 1.5e-3),
        ("1: clearance", "clearance", (0,), 2e-6),
    ):
        ((above, below),) = rig.ends(source)
        for number, (place, up, down) in enumerate(
            zip(rig.bearings, above.bearings, below.bearings, strict=True)
        ):
            value = getattr(place.bearing, name)
            by = step if number in changed else 0.0
            assert getattr(up.bearing, name) == pytest.approx(value + by)
            assert getattr(down.bearing, name) == pytest.approx(value - by)
            assert replace(up.bearing, **{name: value}) == place.bearing
    # Two numbers of one bearing by one source: one pair of rigs each, whose changes add up.
    both = "clearance: 50 um +- 2 um (source=oil), viscosity"
    small.write_text(text.replace("clearance: 50 um, viscosity", both, 1), encoding="utf-8")
    ends = load_rotor(small).ends("oil")
    moved = [(above.bearings[0].bearing, below.bearings[0].bearing) for above, below in ends]
    assert [(up.clearance - down.clearance, up.viscosity - down.viscosity) for up, down in moved] == [
        (pytest.approx(4e-6), 0.0),
        (0.0, pytest.approx(3e-3)),
    ]
    # What is changed by hand has no uncertainty any more.
    assert [source.source for source in rig.with_bearings(viscosity=0.04).sources] == ["1: clearance"]


def test_an_uncertainty_that_cannot_be_read_is_named_at_its_place(small: Path) -> None:
    small.write_text(SMALL.replace("clearance: 50 um", "clearance: 50 um +- 2 kg", 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"clearance") as caught:
        load_rotor(small)
    assert ":12:" in str(caught.value)


def test_a_linear_bearing_takes_one_way_to_state_a_coefficient() -> None:
    """k_cross is k_yz = -k_zy, c both dampings; without k_zz the stiffness is that of y."""
    seal = LinearBearingSettings(kind="linear-bearing", k_yy=2e6, k_cross=1e6, c=10.0)
    assert seal.stiffness.tolist() == [[2e6, 1e6], [-1e6, 2e6]]
    assert seal.damping.tolist() == [[10, 0], [0, 10]]
    both = {"k_zz": 3e6, "k_yz": 1.0, "k_zy": 2.0, "c_yy": 4.0, "c_zy": 5.0}
    plain = LinearBearingSettings(kind="linear-bearing", k_yy=2e6, **both)
    assert plain.stiffness.tolist() == [[2e6, 1], [2, 3e6]] and plain.damping.tolist() == [[4, 0], [5, 0]]
    for entries in ({"k_cross": 1.0, "k_yz": 1.0}, {"k_cross": 0.0, "k_zy": 1.0}, {"c": 1.0, "c_zz": 1.0}):
        with pytest.raises(SettingError):
            LinearBearingSettings(kind="linear-bearing", k_yy=2e6, **entries)

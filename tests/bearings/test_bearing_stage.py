"""The bearing stage: the table of kinds, reading with bare units, JSON and CSV of coefficients of any
kind.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.writing import output_folder
from labpipe.bearings.kinds import BEARINGS, Amount, BearingCoefficients, BearingKind
from labpipe.errors import ConfigError
from labpipe.project.bearing import (
    Evaluated,
    bearing_entry,
    bearing_json,
    sweep_bearing,
    sweep_columns,
    write_sweep,
)
from labpipe.project.bearing_file import BearingFile, open_bearing, parse_sweep
from labpipe.records.finding import Finding
from labpipe.records.settings import settings_of

FILE = (
    "kind: ball-bearing\nelements: 9\nstiffness_constant: {}\ngroove_distance: 0.5953 mm\npitch_radius: "
    "30 mm\nloads: {{z: 100 N}}\n"
)
JOURNAL = BearingCoefficients(
    dofs=("y", "z"),
    stiffness=np.array([[2.0, 7.0], [-8.0, 1.0]]) * 1e6,
    damping=np.array([[9.0, -2.0], [-2.0, 8.0]]) * 1e3,
    rest=(Amount("eccentricity_ratio", 0.4, "1"), Amount("attitude_angle", 0.5, "rad")),
    findings=(Finding("one", "first"), Finding("two", "second")),
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "ball.yaml"
    file.write_text(FILE.format("1.1e10"))
    return file


@pytest.mark.parametrize("name", BEARINGS.names())
def test_every_kind_of_the_table_has_settings_and_a_model(name: str) -> None:
    kind = BEARINGS.load(name)
    assert isinstance(kind, BearingKind) and callable(kind.coefficients)
    settings = settings_of(kind.settings)
    assert "kind" in settings and all(setting.help for setting, _ in settings.values())
    for key, unit in kind.bare_units.items():
        assert settings[key][0].unit == unit


@pytest.mark.parametrize("constant", ["1.1e10", "11000000000", "1.1e10 N/m^1.5", "347.8505426 kN/mm^1.5"])
def test_constants_with_and_without_their_unit(path: Path, constant: str) -> None:
    path.write_text(FILE.format(constant))
    assert open_bearing(path).settings().stiffness_constant == pytest.approx(1.1e10, rel=1e-9)


def test_overrides_are_read_as_the_file_is(path: Path) -> None:
    file = open_bearing(path, ["stiffness_constant=2e10", "loads.y=-3 kN"])
    assert (
        file.settings().stiffness_constant == 2e10
        and file.settings().loads.y == -3000
        and file.settings().loads.z == 100
    )


def test_a_quoted_number_is_no_bare_number(path: Path) -> None:
    path.write_text(FILE.format("'1.1e10'"))
    with pytest.raises(ConfigError, match=r"stiffness_constant: '1.1e10' has no unit"):
        open_bearing(path).settings()


def test_a_sweep_equals_the_single_answers(path: Path) -> None:
    file = open_bearing(path)
    sweep = parse_sweep("loads.z=100:300:100", file.kind.settings)
    together = sweep_bearing(file, sweep)
    for value, found in zip(sweep.values, together, strict=True):
        single = open_bearing(path, [f"loads.z={value} N"])
        (alone,) = single.coefficients([single.settings()])
        np.testing.assert_allclose(found.coefficients.stiffness, alone.stiffness, rtol=1e-8, atol=1)


def test_json_of_any_kind_of_bearing() -> None:
    """A journal's two dofs: asymmetric stiffness as it is, equilibrium by name, no passage, no shaft."""
    file = BearingFile(Path("j.yaml"), "journal-bearing", BEARINGS.load("ball-bearing"), None)  # type: ignore[arg-type]
    entry = json.loads(bearing_json(bearing_entry(file, "J", Evaluated(JOURNAL))))
    assert (
        entry["kind"] == "journal-bearing"
        and entry["dofs"] == ["y", "z"]
        and entry["schema"] == "labpipe/bearing/1"
    )
    assert entry["stiffness"] == [[2e6, 7e6], [-8e6, 1e6]] and entry["damping"][0] == [9e3, -2e3]
    assert entry["equilibrium"] == {"eccentricity_ratio": 0.4, "attitude_angle": 0.5}
    assert (
        entry["warnings"][1] == {"code": "two", "message": "second"}
        and not {"passage", "shaft"} & entry.keys()
    )


def test_columns_of_any_kind_of_bearing(tmp_path: Path) -> None:
    sweep = parse_sweep("loads.z=1:2:1", open_bearing_settings())
    columns = sweep_columns(sweep, [Evaluated(JOURNAL)] * 2)
    assert list(columns)[:6] == [
        "loads.z [N]",
        "k_y_y [N/m]",
        "k_y_z [N/m]",
        "k_z_y [N/m]",
        "k_z_z [N/m]",
        "c_y_y [N.s/m]",
    ]
    assert list(columns)[-3:] == ["eccentricity_ratio [1]", "attitude_angle [rad]", "warnings"]
    np.testing.assert_array_equal(columns["k_z_y [N/m]"], [-8e6, -8e6])
    with output_folder(tmp_path / "out") as folder:
        names = write_sweep("J", sweep, [Evaluated(JOURNAL)] * 2, folder)
    lines = (tmp_path / "out/sweep.csv").read_text().splitlines()
    assert names == ["sweep.csv", "sweep-stiffness.svg", "sweep-damping.svg"]
    assert (
        lines[1] == "1,2000000,7000000,-8000000,1000000,9000,-2000,-2000,8000,0.4,0.5,one two"
        and len(lines) == 3
    )


def open_bearing_settings() -> type:
    kind: BearingKind = BEARINGS.load("ball-bearing")
    return kind.settings

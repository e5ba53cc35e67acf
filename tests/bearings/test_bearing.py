"""labpipe bearing: the catalogue, JSON, heat map, sweeps, and every faulty input refused at its place."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

CATALOGUE = sorted((Path(__file__).parents[2] / "configs/bearings").glob("*.yaml"))
ROLLING = [path for path in CATALOGUE if path.read_text().split("kind: ")[1].startswith(("ball", "roller"))]
BALL = """kind: ball-bearing
elements: 9
stiffness_constant: 1.10e10     # N/m^1.5
groove_distance: 0.5953 mm
contact_angle: 0 deg
pitch_radius: 30.1488 mm
clearance: 0 mm
loads: {y: -24 N, z: 427 N}
"""
TAPER = """kind: roller-bearing
elements: 17
stiffness_constant: 1e9
contact_angle: 14 deg
pitch_radius: 32 mm
loads: {x: 200 N, z: 400 N}
"""


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    path = tmp_path / "ball.yaml"
    path.write_text(BALL)
    return path


def answer(labpipe, path: Path, *more: object) -> dict:  # type: ignore[no-untyped-def]
    ended = labpipe("bearing", path, "--json", "-", *more)
    assert ended.code == 0, ended.err
    entry: dict = json.loads(ended.out)
    return entry


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("path", ROLLING, ids=[path.stem for path in ROLLING])
def test_every_bearing_of_the_catalogue_has_an_answer(path: Path, labpipe, tmp_path: Path) -> None:
    ended = labpipe("bearing", path, "--json", tmp_path / "k.json", "-o", tmp_path / "out")
    assert ended.code == 0 and "stiffness [N/m" in ended.out and "warning" not in ended.out, ended
    entry = json.loads((tmp_path / "k.json").read_text())
    k = np.array(entry["stiffness"])
    assert entry["dofs"] == ["x", "y", "z", "bx", "by"] and k.shape == (5, 5)
    assert np.allclose(k, k.T, rtol=1e-9, atol=1e-9 * np.abs(k).max()) and np.all(np.diag(k) >= 0)
    comment = "".join(line for line in path.read_text().splitlines() if line.startswith("#"))
    assert any(word in comment for word in ("printed by", "published", "worked example of")), (
        "its source is not named"
    )
    files = ["bearing.json", "stiffness.svg", *(["transfer.csv"] if "shaft:" in path.read_text() else [])]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == files and "written to" in ended.out


@pytest.mark.usefixtures("undrawn")
def test_the_shaft_s_frequencies_and_the_fit_of_its_theoretical_curve(
    labpipe, root: Path, tmp_path: Path
) -> None:
    """Knaapen's shaft on the 6208: 63.09 63.11 413.50 1486.0 1486.1 Hz by an independent calculation.

    Identify fits transfer.csv.
    """
    ended = labpipe(
        "bearing",
        root / "configs/bearings/nsk-6208.yaml",
        "--set",
        "damping_factor=1e-6 s",
        "-o",
        tmp_path,
        "--json",
        tmp_path / "k.json",
    )
    assert (
        "f_1 63.092 Hz" in ended.out
        and "zeta_1 0.000198" in ended.out
        and ("sdof_k: stiffness from a one-dof fit") in ended.out
    )
    entry = json.loads((tmp_path / "k.json").read_text())
    shaft = entry["shaft"]
    assert [shaft[f"f_{n}"] for n in range(1, 6)] == pytest.approx(
        [63.09, 63.11, 413.50, 1486.0, 1486.1], rel=2e-4
    )
    fits = "radial: {model: sdof, estimator: ls, input: x, output: x, mass: estimate, band: 1400-1560 Hz}"
    (tmp_path / "p.yaml").write_text(f"title: Theory\nfrfs: transfer.csv\nidentify:\n  {fits}\n")
    assert labpipe("identify", "-c", tmp_path / "p.yaml", "-o", tmp_path / "o").code == 0
    (fit,) = json.loads((tmp_path / "o/identification.json").read_text())["fits"]
    assert fit["parameters"][0]["value"] == pytest.approx(shaft["sdof_k_x"], rel=2e-3)
    assert shaft["sdof_k_x"] / entry["stiffness"][0][0] == pytest.approx(1.0104, abs=2e-4)
    assert shaft["sdof_k_bx"] / entry["stiffness"][3][3] == pytest.approx(0.26, abs=0.005)


def test_the_file_of_the_interface_gives_the_printed_matrix(ball: Path, labpipe) -> None:
    """Knaapen's first matrix, four digits."""
    entry = answer(labpipe, ball)
    k = np.array(entry["stiffness"])
    assert [k[0, 0], k[1, 2], k[0, 4], k[3, 3]] == pytest.approx(
        [0.2125e9, 0.4339e6, -0.1087e7, 0.7517e4], rel=1e-3
    )
    assert (
        entry["kind"] == "ball-bearing"
        and np.array(entry["damping"]).shape == (5, 5)
        and not np.any(entry["damping"])
    )
    rest = entry["equilibrium"]
    assert (
        rest["load_z"] == pytest.approx(427)
        and rest["loaded_elements"] == 9
        and len(rest["contact_angle"]) == 9
    )
    low, high = (np.array(entry["passage"][f"stiffness_{end}"]) for end in ("min", "max"))
    assert np.all(low <= high) and low[0, 0] == pytest.approx(k[0, 0], rel=1e-6)


def test_the_constant_may_carry_its_unit(ball: Path, labpipe) -> None:
    plain = answer(labpipe, ball)["stiffness"]
    assert np.allclose(
        answer(labpipe, ball, "--set", "stiffness_constant=347.8505426 kN/mm^1.5")["stiffness"],
        plain,
        rtol=1e-6,
        atol=1e-3,
    )


def test_overrides_damping_and_held_displacements(ball: Path, labpipe) -> None:
    entry = answer(labpipe, ball, "--set", "damping_factor=2e-5 s", "--set", "displacements.bx=0 rad")
    assert np.allclose(entry["damping"], 2e-5 * np.array(entry["stiffness"]))
    assert entry["equilibrium"]["bx"] == 0 and abs(entry["equilibrium"]["load_mx"]) > 0.01


def test_hertz_s_constant_stands_beside_the_given_one(labpipe, root: Path) -> None:
    model = answer(labpipe, root / "configs/bearings/nsk-6208.yaml")["model"]
    assert model["stiffness_constant"] == 1.10e10 and model["stiffness_constant_hertz"] == pytest.approx(
        1.0976e10, rel=1e-3
    )


def test_taper_rollers_hold_their_tilts(tmp_path: Path, labpipe) -> None:
    (tmp_path / "taper.yaml").write_text(TAPER)
    rest = answer(labpipe, tmp_path / "taper.yaml")["equilibrium"]
    assert rest["bx"] == rest["by"] == 0 and rest["load_x"] == pytest.approx(200)


def test_a_mirrored_solution_is_said(labpipe, root: Path) -> None:
    ended = labpipe("bearing", root / "configs/bearings/rpf-7208.yaml", "--set", "loads.z=-445 N")
    assert ended.code == 0 and "warning mirrored: elements carry at the opposite contact angle" in ended.out
    assert (
        answer(labpipe, root / "configs/bearings/rpf-7208.yaml", "--set", "loads.z=-445 N")["warnings"][0][
            "code"
        ]
        == "mirrored"
    )


def test_a_bearing_without_load_is_said(ball: Path, labpipe) -> None:
    ended = labpipe("bearing", ball, "--set", "loads={z: 0 N}", "--set", "clearance=10 um")
    assert ended.code == 0 and "warning indeterminate: " in ended.out


def test_sweep_writes_table_and_curves(ball: Path, labpipe, tmp_path: Path) -> None:
    ended = labpipe(
        "bearing",
        ball,
        "--sweep",
        "loads.z=0:2000:50",
        "--set",
        "damping_factor=1e-5 s",
        "-v",
        "-o",
        tmp_path / "out",
    )
    assert ended.code == 0 and ended.err.endswith("ball.yaml, loads.z [N]: 41 values\n")
    assert "41 values" in ended.out and "..." in ended.out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "sweep-damping.svg",
        "sweep-stiffness.svg",
        "sweep.csv",
    ]
    with (tmp_path / "out/sweep.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["loads.z [N]"]) for row in rows] == list(range(0, 2001, 50))
    alone = answer(labpipe, ball, "--set", "loads.z=700 N")
    row = rows[14]
    assert float(row["k_x_by [N/rad]"]) == pytest.approx(alone["stiffness"][0][4], rel=1e-7)
    assert float(row["c_z_z [N.s/m]"]) == pytest.approx(1e-5 * alone["stiffness"][2][2], rel=1e-7)
    assert float(row["z [m]"]) == pytest.approx(alone["equilibrium"]["z"], rel=1e-7) and row["warnings"] == ""
    svg = (tmp_path / "out/sweep-stiffness.svg").read_text()
    assert "k x,by" in svg and "loads.z [N]" in svg


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("loads.z=0:2:0.5 kN", [0, 500, 1000, 1500, 2000]),
        ("loads.z=100 N:0.2 kN:50 N", [100, 150, 200]),
        ("loads.z=300:100:-100", [300, 200, 100]),
        ("loads.z=0:250:100", [0, 100, 200]),
        ("clearance=0:10:5 um", [0, 5e-6, 10e-6]),
    ],
)
def test_sweeps_with_units_and_in_either_direction(
    ball: Path, labpipe, tmp_path: Path, text: str, values: list[float]
) -> None:
    assert labpipe("bearing", ball, "--sweep", text, "-o", tmp_path / "out").code == 0
    with (tmp_path / "out/sweep.csv").open() as stream:
        key = next(csv.reader([stream.readline()]))[0]
        assert [float(line.split(",")[0]) for line in stream] == pytest.approx(values)
    assert key == f"{text.split('=')[0]} [{'m' if 'clear' in text else 'N'}]"


@pytest.mark.long
def test_the_same_input_gives_the_same_bytes(ball: Path, labpipe, tmp_path: Path) -> None:
    for name in ("a", "b"):
        labpipe("bearing", ball, "--sweep", "loads.z=100:200:50", "-o", tmp_path / name)
        labpipe("bearing", ball, "-o", tmp_path / name)
    files = [sorted((p.name, p.read_bytes()) for p in (tmp_path / name).iterdir()) for name in ("a", "b")]
    assert files[0] == files[1] and len(files[0]) == 4


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ("kind: ball-bearing\n", "", ["ball.yaml:1:1: kind: is missing; known: ball-bearing"]),
        (
            "ball-bearing",
            "bal-bearing",
            ["ball.yaml:1:1: kind: unknown bearing 'bal-bearing'; did you mean 'ball-bearing'?"],
        ),
        ("elements: 9", "elements: 2", ["ball.yaml:2:1: elements: 2 rolling elements do not make a bearing"]),
        ("elements: 9", "elements: nine", ["ball.yaml:2:1: elements: 'nine' is not a whole number"]),
        (
            "stiffness_constant: 1.10e10",
            "# ",
            ["stiffness_constant: is missing; give it, or geometry from which it follows"],
        ),
        (
            "1.10e10  ",
            "1.10e10 N/m",
            ["ball.yaml:3:1: stiffness_constant: 'N/m' has the wrong dimension, N/m^1.5 is needed"],
        ),
        ("0.5953 mm", "0.5953", ["ball.yaml:4:1: groove_distance: '0.5953' has no unit"]),
        ("0.5953 mm", "0.5953 Nm", ["groove_distance: unknown unit 'Nm'"]),
        (
            "pitch_radius",
            "pich_radius",
            ["ball.yaml:6:1: pich_radius: unknown key; did you mean 'pitch_radius'?"],
        ),
        (
            "clearance: 0 mm",
            "clearance: 1 mm",
            ["the clearance is larger than the groove centres' radial distance"],
        ),
        ("z: 427 N}", "z: 427 N, q: 1 N}", ["ball.yaml:8:29: loads.q: unknown key"]),
        ("z: 427 N", "z: 427 mm", ["ball.yaml:8:19: loads.z: 'mm' has the wrong dimension, N is needed"]),
        ("z: 427 N", "x: .inf N", ["ball.yaml:8:19: loads.x: '.inf N' is not a value with a unit"]),
        ("z: 427 N", "x: 1e400 N", ["loads.x: '1e400 N' is not a finite value"]),
        ("z: 427 N", "z: 4e6 N", ["ball.yaml: element 1 is pressed in by", "the model holds up to 595.3 um"]),
        (
            "z: 427 N",
            "z: 4e12 N",
            ["ball.yaml: no rest position: the bearing cannot carry y -24 N, z 4e+12 N"],
        ),
        ("loads:", "displacements: {z: 0 mm}\nloads:", ["displacements.z and loads.z are both given"]),
        (
            "loads:",
            "geometry: {ball_diameter: 12 mm}\nloads:",
            ["ball.yaml:8:1: geometry.pitch_diameter: is missing"],
        ),
        (
            "loads:",
            "geometry: {ball_diameter: 9 mm, pitch_diameter: 9 mm}\nloads:",
            ["ball.yaml:8:1: geometry: the ball diameter must"],
        ),
        ("loads:", "damping_factor: -1 s\nloads:", ["damping_factor must not be negative"]),
        (
            "loads:",
            "shaft: {mass: 2 kg}\nloads:",
            ["ball.yaml:8:1: shaft.inertia_x: is missing; moment of inertia about x"],
        ),
        (
            "loads:",
            "shaft: {mass: 0 kg, inertia_x: 1 kg.m^2}\nloads:",
            ["ball.yaml:8:1: shaft: the shaft's mass must be above zero"],
        ),
        (
            "loads:",
            "shaft: {mass: 1 kg, inertia_x: 1 kg.m^2, lines: 1}\nloads:",
            ["ball.yaml:8:1: shaft: lines must be at least 2"],
        ),
        ("loads: {", "loads: [", ["not valid YAML"]),
    ],
)
def test_broken_bearing_files(ball: Path, labpipe, old: str, new: str, fragments: list[str]) -> None:
    assert old in BALL
    ball.write_text(BALL.replace(old, new, 1))
    ended = labpipe("bearing", ball, "--json", ball.with_name("k.json"))
    assert ended.code == 2 and len(ended.err.strip().splitlines()) <= 2 and "Traceback" not in ended.err, (
        ended
    )
    for fragment in fragments:
        assert fragment in ended.err, ended.err
    assert ended.err.startswith(f"error: {ball}") and [p.name for p in ball.parent.iterdir()] == ["ball.yaml"]


@pytest.mark.parametrize(
    ("old", "new", "fragment"),
    [
        (
            "x: 200 N, z: 400 N",
            "x: 200 N, z: 4 N",
            "no rest position: the bearing cannot carry x 200 N, z 4 N",
        ),
        (
            "x: 200 N",
            "mx: 2 N.m",
            "rollers at a fixed contact angle leave the tilt bx without support; hold it: displacements.bx",
        ),
        ("14 deg", "0 deg", "rollers at contact angle 0 carry no axial load"),
        ("pitch_radius: 32 mm\n", "", "pitch_radius: is missing"),
        ("stiffness_constant: 1e9\n", "", "stiffness_constant: is missing; give it, or roller_length"),
        ("stiffness_constant: 1e9\n", "roller_length: 0 mm\n", "the roller length must be above zero"),
    ],
)
def test_broken_roller_bearings(tmp_path: Path, labpipe, old: str, new: str, fragment: str) -> None:
    path = tmp_path / "taper.yaml"
    assert old in TAPER
    path.write_text(TAPER.replace(old, new, 1))
    ended = labpipe("bearing", path)
    assert ended.code == 2 and len(ended.err.strip().splitlines()) == 1 and fragment in ended.err, ended
    assert ended.err.startswith(f"error: {path}")


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["none.yaml"], "none.yaml: no such file"),
        (["."], "is a directory"),
        (["ball.yaml", "--sweep", "loads.z=0:2:1"], "--sweep needs -o DIR"),
        (
            ["ball.yaml", "--sweep", "loads.z=0:2", "-o", "out"],
            "not a sweep; write --sweep loads.z=0:2000:50",
        ),
        (
            ["ball.yaml", "--sweep", "loads.zz=0:2:1", "-o", "out"],
            "loads.zz: cannot be swept; did you mean 'loads.z'?",
        ),
        (["ball.yaml", "--sweep", "elements=8:12:1", "-o", "out"], "elements: cannot be swept"),
        (
            ["ball.yaml", "--sweep", "loads.z=0:2:1 mm", "-o", "out"],
            "loads.z: 'mm' has the wrong dimension, N is needed",
        ),
        (
            ["ball.yaml", "--sweep", "loads.z=0:2:-1", "-o", "out"],
            "the step does not lead from start to stop",
        ),
        (["ball.yaml", "--sweep", "loads.z=0:2:0", "-o", "out"], "the step does not lead from start to stop"),
        (
            ["ball.yaml", "--sweep", "loads.z=0:1e9:1", "-o", "out"],
            "1000000001 values are too many; at most 20000",
        ),
        (["ball.yaml", "--sweep", "loads.z=0:a:1", "-o", "out"], "'a' is not a value with a unit"),
        (
            ["ball.yaml", "--sweep", "loads.z=1e3:4e6:1e6", "-o", "out"],
            "load case 3: element 1 is pressed in",
        ),
        (["ball.yaml", "--sweep", "clearance=0:1:0.5 mm", "-o", "out"], "the clearance is larger"),
        (["ball.yaml", "--json", "k.json", "--sweep", "loads.z=0:2:1", "-o", "out"], "has no --json"),
        (
            ["ball.yaml", "--set", "loads.z=nothing"],
            "--set loads.z=nothing: loads.z: 'nothing' is not a value with a unit",
        ),
        (
            ["ball.yaml", "--set", "loads=5 N"],
            "--set loads=5 N: loads: a mapping of keys to values is needed",
        ),
        (["ball.yaml", "-o", "ball.yaml"], "is a file, a folder is needed"),
        (["ball.yaml", "--json", "."], "is a folder, a file name is needed"),
        ([], "Missing argument 'BEARING'"),
    ],
)
def test_broken_command_lines(ball: Path, labpipe, monkeypatch, arguments: list[str], fragment: str) -> None:
    monkeypatch.chdir(ball.parent)
    ended = labpipe("bearing", *arguments)
    assert ended.code == 2 and fragment in ended.err and "Traceback" not in ended.err, ended
    assert len(ended.err.strip().splitlines()) == 1 and [p.name for p in ball.parent.iterdir()] == [
        "ball.yaml"
    ]


def test_several_faults_are_named_in_one_pass(ball: Path, labpipe) -> None:
    ball.write_text(
        BALL.replace("427 N", "427").replace("0.5953 mm", "0.5953 m/s").replace("clearance", "clarance")
    )
    ended = labpipe("bearing", ball)
    assert ended.code == 2 and len(ended.err.strip().splitlines()) == 3

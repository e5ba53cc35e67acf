"""Journal-bearing files: what they hold, and their coefficients against the checked reference of an
independent calculation.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.journal_bearing.kind import JOURNAL_KIND
from labpipe.project.bearing_file import open_bearing

REFERENCE = [
    # load N, depth um, angle deg, eccentricity ratio, attitude deg, K Cr/W and C Cr Omega/W in the order yy
    # yz zy zz
    (35.38, 0.0, 0.0, 0.1326, 80.95, [2.361, 7.259, -7.946, 1.265], [14.87, -2.367, -2.367, 15.65]),
    (58.82, 0.0, 0.0, 0.2096, 75.71, [2.331, 4.329, -5.412, 1.379], [9.204, -2.345, -2.345, 10.445]),
    (58.82, 22.27, 11.0, 0.2908, 44.51, [3.176, 3.187, -5.956, 1.600], [8.406, -1.831, -1.831, 9.969]),
    (58.82, 40.19, 8.0, 0.4423, 26.61, [5.187, 2.270, -5.269, 1.056], [7.863, -3.333, -3.333, 7.297]),
]


@pytest.fixture
def file(root: Path) -> Path:
    return root / "configs/bearings/mendes-journal.yaml"


@pytest.mark.parametrize(("load", "depth", "angle", "eccentricity", "attitude", "k", "c"), REFERENCE)
def test_file_with_the_reference_s_wear(
    file: Path,
    load: float,
    depth: float,
    angle: float,
    eccentricity: float,
    attitude: float,
    k: list[float],
    c: list[float],
) -> None:
    """Mesh 1440 x 72 in the reference; here the mesh that is accurate to 1 %: .5 % (eccentricity), 3.5 % of
    the largest coefficient.
    """
    opened = open_bearing(file, [f"load={load} N", f"wear.depth={depth} um", f"wear.angle={angle} deg"])
    (found,) = opened.coefficients([opened.settings()])
    rest = {amount.name: amount.value for amount in found.rest}
    assert rest["eccentricity_ratio"] == pytest.approx(eccentricity, rel=5e-3)
    assert np.degrees(rest["attitude_angle"]) == pytest.approx(attitude, abs=0.5)
    scale = 90e-6 / load
    np.testing.assert_allclose(found.stiffness.ravel() * scale, k, atol=0.035 * max(map(abs, k)))
    np.testing.assert_allclose(found.damping.ravel() * scale * 100 * np.pi, c, atol=0.035 * max(map(abs, c)))


def test_json_has_the_interface_s_keys(file: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    ended = labpipe("bearing", file, "--json", "-")
    entry = json.loads(ended.out)
    assert ended.code == 0 and entry["kind"] == "journal-bearing" and entry["dofs"] == ["y", "z"]
    assert {"eccentricity_ratio", "attitude_angle", "sommerfeld"} <= set(entry["equilibrium"])
    assert np.allclose(entry["damping"], np.transpose(entry["damping"]), rtol=1e-8)
    # mu N L D / W (R / c)^2 by hand.
    assert entry["equilibrium"]["sommerfeld"] == pytest.approx(
        0.1044 * 50 * 18e-3 * 31e-3 / 58.82 * (15.5e-3 / 90e-6) ** 2
    )
    assert 0 < entry["model"]["mesh_error"] <= 0.01


def test_a_tighter_accuracy_takes_a_finer_mesh(file: Path) -> None:
    (coarse, fine) = (open_bearing(file, [f"accuracy={share} %"]) for share in (5, 0.3))
    cells = [opened.coefficients([opened.settings()])[0].notes[0].value for opened in (coarse, fine)]
    assert cells == [120.0, 240.0]


def test_a_turned_load_turns_the_coefficients(file: Path) -> None:
    """A load in +y instead of -z is the rig turned by 90 deg with the spin: K' = R K R^T."""
    down, aside = (open_bearing(file, entries) for entries in ([], ["load=0 N", "side_load=58.82 N"]))
    (first,), (second,) = (opened.coefficients([opened.settings()]) for opened in (down, aside))
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose(second.stiffness, turn @ first.stiffness @ turn.T, rtol=1e-5)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("load=0 N", "needs a load"),
        ("speed=0 Hz", "speed above zero"),
        ("wear.depth=-3 um", "wear of -3 um"),
        ("clearance=0 um", "clearance of a journal bearing is positive"),
        ("accuracy=0 %", "accuracy"),
        ("cavitation_pressure=1 bar", "above the ambient"),
        ("viscosity=0.1 Pa", "viscosity"),
        ("viscosity_slope=-3 %/K", "viscosity_slope must not be negative"),
        ("clearence=90 um", "did you mean 'clearance'"),
    ],
)
def test_impossible_entries_are_refused_in_words(file: Path, entry: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        open_bearing(file, [entry]).settings()
    assert message in str(caught.value)


def test_its_place_in_the_file_is_named(file: Path, tmp_path: Path) -> None:
    path = tmp_path / "b.yaml"
    path.write_text(file.read_text().replace("90 um", "90 kg"))
    with pytest.raises(ConfigError, match=r"b.yaml:6:\d+: clearance"):
        open_bearing(path).settings()
    line = file.read_text()[: file.read_text().index("clearance")].count("\n") + 1
    path.write_text(file.read_text().replace("90 um", "-90 um"))
    with pytest.raises(ConfigError, match=rf"b.yaml:{line}:\d+: clearance: the clearance of a journal"):
        open_bearing(path).settings()


def test_the_kind_names_its_settings() -> None:
    assert JOURNAL_KIND.response is None and not JOURNAL_KIND.bare_units

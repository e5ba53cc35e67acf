"""labpipe bearing on a journal bearing with axial grooves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

BEARING = """kind: journal-bearing
diameter: 100 mm
length: 50 mm
clearance: 0.1 mm
viscosity: 0.05 Pa.s
groove_width: 20 deg
speed: 3000 rpm
load: 5000 N
accuracy: 0.2 %
"""


def test_grooves_of_twenty_degrees_give_the_printed_coefficients(labpipe, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """S = mu N L D / W (R / c)^2 = .05 * 50 * .05 * .1 / W * 500^2.

    A load for S = 1.656 against Lund and Thomsen's row, z up.
    """
    load = 0.05 * 50 * 0.05 * 0.1 * 500**2 / 1.656
    (tmp_path / "grooved.yaml").write_text(BEARING.replace("5000 N", f"{load:.6g} N"))
    ended = labpipe("bearing", tmp_path / "grooved.yaml", "--json", tmp_path / "out.json")
    assert ended.code == 0, ended.err
    found = json.loads((tmp_path / "out.json").read_text())
    assert abs(found["equilibrium"]["eccentricity_ratio"] - 0.244) < 0.001
    scaled = np.array(found["stiffness"]) * 1e-4 / load
    np.testing.assert_allclose(scaled, [[1.95, 2.20], [-5.06, 1.69]], rtol=0.03)


def test_a_groove_in_plain_numbers_or_too_wide_is_refused_with_its_place(labpipe, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    for text, said in (
        ("groove_width: 20", "has no unit"),
        ("groove_width: 150 deg", "a groove of 150 deg is out of range"),
    ):
        path = tmp_path / "wrong.yaml"
        path.write_text(BEARING.replace("groove_width: 20 deg", text))
        ended = labpipe("bearing", path)
        assert ended.code == 2 and said in ended.err and f"{path}:" in ended.err

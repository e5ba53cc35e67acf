"""labpipe bearing on a magnetic bearing: JSON, sweep over frequency, and an unstable setting said in
words.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def file(root: Path) -> Path:
    return root / "configs/bearings/hmb-magnetic.yaml"


def test_json_has_coefficients_poles_and_zone(labpipe: Callable[..., Any], file: Path) -> None:
    """k and c at 50 Hz as configs/virtual-hmb-loop.yaml states them; S at rest is 33106 / 1694."""
    ended = labpipe("bearing", file, "--json", "-")
    entry = json.loads(ended.out)
    assert ended.code == 0 and entry["dofs"] == ["x", "y"]
    assert entry["stiffness"][0][0] == pytest.approx(14.07e3, rel=2e-3) and entry["damping"][1][
        1
    ] == pytest.approx(22.8, rel=4e-3)
    assert max(real for real, _ in entry["poles"]) < 0
    assert entry["model"]["sensitivity_zone"] == "D" and entry["model"]["sensitivity_peak"] == pytest.approx(
        19.543, rel=1e-4
    )
    assert entry["shares"]["k_bias_field"] == pytest.approx(-33106.0)


@pytest.mark.usefixtures("undrawn")
def test_sweep_over_frequency_has_the_shares(labpipe: Callable[..., Any], file: Path, tmp_path: Path) -> None:
    ended = labpipe("bearing", file, "--sweep", "frequency=1:249:31", "-o", tmp_path / "out")
    with (tmp_path / "out/sweep.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert ended.code == 0 and len(rows) == 9
    for row in (rows[0], rows[-1]):
        total = sum(float(number) for title, number in row.items() if title.startswith("share_k_"))
        assert total == pytest.approx(float(row["k_x_x [N/m]"]), rel=1e-5)


def test_unstable_setting_is_a_warning_with_its_poles(labpipe: Callable[..., Any], file: Path) -> None:
    ended = labpipe("bearing", file, "--set", "loop.lag=0.25")
    assert ended.code == 0 and "stability: unstable" in ended.out
    assert "warning unstable-loop: the loop is unstable: 2 poles grow; at 256.4" in ended.out


def test_wrong_entries_are_refused_at_their_place(labpipe: Callable[..., Any], file: Path) -> None:
    ended = labpipe("bearing", file, "--set", "loop.delay=-1 us")
    assert ended.code != 0 and "delay must not be negative" in ended.err and "Traceback" not in ended.err


def test_a_loop_without_stiffness_at_rest_has_no_largest_sensitivity(
    labpipe: Callable[..., Any], file: Path, tmp_path: Path
) -> None:
    """S = -m w^2 / (k - m w^2) with k = 0 at w = 0: a pole on the axis."""
    ended = labpipe("bearing", file, "-q", "--json", tmp_path / "b.json", "--set", "static_stiffness=0 N/m")
    assert (ended.code, ended.err) == (0, "")
    assert json.loads((tmp_path / "b.json").read_text("utf-8"))["model"]["sensitivity_peak"] is None


@pytest.mark.parametrize(
    "late",
    [
        "{form: polynomial, numerator: [1], denominator: [1, 0], rate: 20 kHz}",
        "{form: polynomial, numerator: [0, 1], denominator: [1, 0], rate: 20 kHz}",
        "{form: roots, poles: [0], rate: 20 kHz}",
    ],
)
def test_a_power_of_z_is_the_delay_that_it_is(labpipe: Callable[..., Any], tmp_path: Path, late: str) -> None:
    """A controller times z^-1 and the same one with a sampling interval more of delay: the same poles,
    margins and stiffness.
    """
    entries = []
    for delay, block in (
        ("75 us", late),
        ("125 us", "{form: polynomial, numerator: [1], denominator: [1], rate: 20 kHz}"),
    ):
        path = tmp_path / "bearing.yaml"
        path.write_text(
            "kind: magnetic-bearing\nname: test\nmass: 0.3 kg\nfrequency: 50 Hz\nnegative_stiffness: 40 "
            "kN/m\n"
            "loop:\n  sensor: 8 V/mm\n  amplifier: 1 A/V\n  force_per_current: 20 N/A\n  bandwidth: 1.5 "
            f"kHz\n  delay: {delay}\n"
            "  controller: [{form: pid, proportional: 0.9, derivative: 1.6 ms, derivative_time: 0.1 ms}, "
            f"{block}]\n"
        )
        ended = labpipe("bearing", path, "--json", "-")
        assert ended.code == 0, ended.err
        entries.append(json.loads(ended.out))
    first, second = ([pole for pole in entry["poles"] if pole[0] > -5e3] for entry in entries)
    assert len(first) == len(second) >= 2 and max(real for real, _ in first) < 0
    for one, other in zip(sorted(first), sorted(second), strict=True):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-6 * 1e3)
    assert entries[0]["model"]["sensitivity_peak"] == pytest.approx(
        entries[1]["model"]["sensitivity_peak"], rel=1e-6
    )
    assert entries[0]["stiffness"][0][0] == pytest.approx(entries[1]["stiffness"][0][0], rel=1e-6)

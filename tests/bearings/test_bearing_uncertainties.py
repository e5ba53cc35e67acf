"""Uncertainties of a bearing file's numbers in its coefficients, against closed forms of similarity."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigErrors
from labpipe.project.bearing import Evaluated, bearing_entry, evaluate
from labpipe.project.bearing_file import open_bearing

JOURNAL = """kind: journal-bearing
diameter: 31 mm
length: 18 mm
clearance: 90 um
viscosity: {viscosity}
speed: 50 Hz
load: {load}
accuracy: 5 %
"""
BALL = """kind: ball-bearing
elements: 9
stiffness_constant: {constant}
groove_distance: 0.5953 mm
pitch_radius: 30.1488 mm
loads: {{z: {load}}}
"""


def journal(folder: Path, viscosity: str = "0.1044 Pa.s", load: str = "58.82 N", more: str = "") -> Evaluated:
    (folder / "j.yaml").write_text(JOURNAL.format(viscosity=viscosity, load=load) + more)
    return evaluate(open_bearing(folder / "j.yaml"))


def relative(whole: Evaluated) -> np.ndarray:
    assert whole.uncertainties is not None
    return np.array(whole.uncertainties.stiffness / whole.coefficients.stiffness)


def test_without_uncertainties_nothing_is_added(tmp_path: Path) -> None:
    assert journal(tmp_path).uncertainties is None


def test_at_one_sommerfeld_number_stiffness_is_load_over_clearance(tmp_path: Path) -> None:
    """K = W / c kappa(S), S ~ viscosity / W: both 1 % up by one cause leave S as it is, so K and C are 1 % up
    and nothing else moves.
    """
    both = journal(tmp_path, "0.1044 Pa.s +- 1 % (source=scale)", "58.82 N +- 1 % (source=scale)")
    np.testing.assert_allclose(relative(both), 0.01, rtol=1e-3)
    assert both.uncertainties is not None and [source.source for source in both.uncertainties.sources] == [
        "scale"
    ]
    np.testing.assert_allclose(both.uncertainties.damping / both.coefficients.damping, 0.01, rtol=1e-3)
    places = {amount.name: n for n, amount in enumerate(both.coefficients.rest)}
    assert abs(both.uncertainties.rest[0, places["eccentricity_ratio"]]) < 1e-6
    # Of two causes they add up in squares instead, and S moves.
    apart = journal(tmp_path, "0.1044 Pa.s +- 1 %", "58.82 N +- 1 %")
    assert apart.uncertainties is not None
    np.testing.assert_allclose(relative(apart).sum(axis=0), relative(both)[0], rtol=2e-3)
    for what in ("stiffness", "damping", "rest"):
        each = getattr(apart.uncertainties, what)
        np.testing.assert_allclose(apart.uncertainties.error(what), np.hypot(*each))


def test_a_temperature_is_a_viscosity(tmp_path: Path) -> None:
    """Reynolds: eta exp(-b (T - T_0)); 2 K at 3 %/K are a viscosity of 6 %.

    An uncertainty in degC is a difference.
    """
    more = "viscosity_temperature: 40 degC\nviscosity_slope: 3 %/K\ntemperature: 40 degC +- {}\n"
    by_temperature = journal(tmp_path, more=more.format("2 K"))
    by_viscosity = journal(tmp_path, "0.1044 Pa.s +- 6 %")
    np.testing.assert_allclose(relative(by_temperature), -relative(by_viscosity), rtol=5e-3, atol=2e-5)
    in_celsius = journal(tmp_path, more=more.format("2 degC"))
    np.testing.assert_array_equal(relative(in_celsius), relative(by_temperature))


def test_hertz_contact_stiffness_goes_with_its_constant_and_load(tmp_path: Path) -> None:
    """F = K d^1.5 at every contact: at the same F / K all displacements are the same, and stiffness goes with
    K (solved to 1e-5).
    """
    (tmp_path / "b.yaml").write_text(
        BALL.format(constant="1.1e10 +- 2 % (source=x)", load="427 N +- 2 % (source=x)")
    )
    whole = evaluate(open_bearing(tmp_path / "b.yaml"))
    # Terms between directions that do not couple are zero, or what rounding leaves of it.
    large = np.abs(whole.coefficients.stiffness) > 1e-6 * np.abs(whole.coefficients.stiffness).max()
    assert whole.uncertainties is not None
    np.testing.assert_allclose(
        whole.uncertainties.stiffness[0][large], 0.02 * whole.coefficients.stiffness[large], rtol=1e-4
    )


@pytest.mark.usefixtures("undrawn")
def test_json_table_and_sweep_hold_the_uncertainties(tmp_path: Path, labpipe_without_report) -> None:
    file = tmp_path / "j.yaml"
    journal(tmp_path, "0.1044 Pa.s +- 1 %", "58.82 N +- 1 %")
    shown = labpipe_without_report("bearing", file, "--json", tmp_path / "j.json")
    assert "with standard uncertainties" in shown.out and "k_y_z" in shown.out and " ± " in shown.out
    entry = json.loads((tmp_path / "j.json").read_text())
    assert entry == json.loads(
        json.dumps(bearing_entry(open_bearing(file), "j", evaluate(open_bearing(file))))
    )
    changes = np.array([source["stiffness"] for source in entry["uncertainty"]["sources"]])
    np.testing.assert_allclose(entry["uncertainty"]["stiffness"], np.hypot(*changes))
    # The uncertainty of the swept entry does not count beside its values.
    labpipe_without_report("bearing", file, "--sweep", "load=50:60:10", "-o", tmp_path / "out")
    with (tmp_path / "out/sweep.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    single = journal(tmp_path, "0.1044 Pa.s +- 1 %", "60 N")
    assert single.uncertainties is not None
    assert float(rows[1]["u_k_y_z [N/m]"]) == pytest.approx(
        single.uncertainties.error("stiffness")[0, 1], rel=1e-6
    )


def test_faults_have_their_place(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match=r"j.yaml:5:1: viscosity: .*'mm'"):
        journal(tmp_path, "0.1044 Pa.s +- 1 mm")
    with pytest.raises(ConfigErrors, match=r"j.yaml:9:1: temperature: the viscosity at it needs"):
        journal(tmp_path, more="temperature: 40 degC\n")

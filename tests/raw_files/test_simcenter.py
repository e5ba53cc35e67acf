"""MATLAB files of Simcenter Test.Lab, written here field by field as that program writes them: texts stand
upright, terms of a unit are a structure array, numbers are in SI units whatever the label says.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.io import savemat

from labpipe.artefacts.identification_file import read_identification
from labpipe.cli.main import run_command
from labpipe.errors import DataError
from labpipe.raw_files.excitation import Sweep
from labpipe.raw_files.table import open_table

BASES = ["LENGTH", "ANGLE", "MASS", "TIME", "CURRENT", "LIGHT", "TEMPERATURE", "MOLCULAR_AMOUNT"]
ACCELERATION, VOLTAGE = {"LENGTH": 1, "TIME": -2}, {"LENGTH": 2, "MASS": 1, "TIME": -3, "CURRENT": -1}
MKS = "Data saved by Test.Lab in MKS"


def upright(text: str) -> np.ndarray:
    return np.array(list(text))[:, None]


def labels(texts: Sequence[str]) -> np.ndarray:
    """A char of one text, a cell of several."""
    if len(texts) == 1:
        return upright(texts[0])
    cells = np.empty((1, len(texts)), object)
    cells[0] = [upright(text) for text in texts]
    return cells


def structure(
    values: np.ndarray,
    step: float,
    label: str,
    powers: dict[str, int],
    responses: Sequence[str],
    references: Sequence[str] = (),
    axis: str = "s",
    start: float = 0.0,
    info: str = MKS,
) -> dict[str, Any]:
    terms = np.zeros(len(BASES), [("num", "O"), ("den", "O"), ("quantity", "O")])
    for place, base in enumerate(BASES):
        terms[place] = (float(powers.get(base, 0)), 1.0, base)
    record: dict[str, Any] = {"name": labels(responses), "primary_channel": {"label": labels(responses)}}
    if references:
        record["reference_channel"] = {"label": labels(references)}
    return {
        "x_values": {"start_value": start, "increment": step, "quantity": {"label": upright(axis)}},
        "y_values": {
            "values": values,
            "quantity": {"label": upright(label), "quantity_terms": terms, "info": upright(info)},
        },
        "function_record": record,
    }


def test_channels_have_their_labels_their_rate_and_si_units(tmp_path: Path, rng: np.random.Generator) -> None:
    a, u, slow = rng.normal(size=(300, 2)), rng.normal(size=(300, 1)), rng.normal(size=(30, 1))
    content = {
        "Signal_0": structure(a, 1 / 2048, "g", ACCELERATION, ("shaft:1:+X", "shaft:2:+X")),
        "Signal_1": structure(u, 1 / 2048, "V", VOLTAGE, ("shaft:1:-X",)),
        "Spectrum": structure(slow, 0.5, "g", ACCELERATION, ("shaft:1:+X",), axis="Hz"),
    }
    savemat(tmp_path / "run.mat", content)
    table = open_table(tmp_path / "run.mat")
    assert table.columns == ("shaft:1:+X", "shaft:2:+X", "shaft:1:-X") and table.sample_rate == 2048
    assert table.units == {"shaft:1:+X": "m/s^2", "shaft:2:+X": "m/s^2", "shaft:1:-X": "V"}
    np.testing.assert_array_equal(np.concatenate(list(table.chunks(table.columns))), np.hstack([a, u]))


def test_init_takes_the_swept_volts_for_the_force_and_labels_for_points(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Volts of 20 to 200 Hz in 8 s, and two points that follow through a mode at 60 Hz."""
    volts = Sweep((20.0, 200.0), 8.0, 1.0).samples(1024.0, 1)
    omega = 2 * np.pi * np.fft.rfftfreq(volts.size, 1 / 1024)
    course = -(omega**2) / ((2 * np.pi * 60) ** 2 - omega**2 + 0.04j * 2 * np.pi * 60 * omega)
    motion = np.fft.irfft(np.fft.rfft(volts) * course, volts.size)
    motions = np.column_stack([motion, -0.4 * motion]) + 0.01 * rng.normal(size=(volts.size, 2))
    content = {
        "Signal_0": structure(motions, 1 / 1024, "g", ACCELERATION, ("shaft:1:+X", "shaft:2:-X")),
        "Signal_1": structure(volts[:, None], 1 / 1024, "V", VOLTAGE, ("amplifier",)),
    }
    savemat(tmp_path / "run.mat", content)
    project = tmp_path / "lab"
    assert run_command(["init", str(project), str(tmp_path / "run.mat")]) == 0
    rig = yaml.safe_load((project / "rig.yaml").read_text("utf-8"))
    assert "sample_rate" not in rig
    one, two, force = rig["channels"].values()
    assert (one["dof"], two["dof"], two["invert"]) == ("1.x", "2.x", True) and one["unit"] == "m/s^2"
    assert (force["quantity"], force["role"], force["unit"]) == ("force", "input", "V")
    assert yaml.safe_load((project / "pipeline.yaml").read_text("utf-8"))["frf"]["excitation"] == "sweep"


def test_labels_that_two_channels_share_are_no_names(tmp_path: Path, rng: np.random.Generator) -> None:
    values = rng.normal(size=(300, 3))
    savemat(tmp_path / "run.mat", {"S": structure(values, 1e-3, "g", ACCELERATION, ("a", "a", "b"))})
    assert open_table(tmp_path / "run.mat").columns == ("S.y_values.values_1", "S.y_values.values_2", "b")


@pytest.mark.parametrize(
    ("powers", "info", "unit"),
    [
        ({"LENGTH": 1, "MASS": 1, "TIME": -2}, MKS, "N"),
        ({"LENGTH": 1}, MKS, "m"),
        ({"LENGTH": -1, "MASS": 1, "TIME": -2}, MKS, "Pa"),
        ({"ANGLE": 1, "TIME": -1}, MKS, "rad/s"),
        ({"LENGTH": 1}, "Data saved by Test.Lab in user units", "mil"),
        # No unit has a name for it, and none is made up.
        ({"LENGTH": 5}, MKS, None),
        ({"LENGTH": 1, "LIGHT": 1}, MKS, None),
    ],
)
def test_the_label_counts_only_where_numbers_are_not_in_si(
    tmp_path: Path, rng: np.random.Generator, powers: dict[str, int], info: str, unit: str | None
) -> None:
    content = {"S": structure(rng.normal(size=(300, 1)), 1e-3, "mil", powers, ("a",), info=info)}
    savemat(tmp_path / "run.mat", content)
    assert open_table(tmp_path / "run.mat").units.get("a") == unit


def test_a_base_that_the_terms_leave_out_has_the_power_0(tmp_path: Path, rng: np.random.Generator) -> None:
    content = {"S": structure(rng.normal(size=(300, 1)), 1e-3, "mil", {BASES[0]: 1}, ("a",))}
    quantity = content["S"]["y_values"]["quantity"]
    quantity["quantity_terms"] = quantity["quantity_terms"][:2]
    savemat(tmp_path / "run.mat", content)
    assert open_table(tmp_path / "run.mat").units.get("a") == "m"


@pytest.mark.parametrize("term", [(1.0, 0.0, "LENGTH"), ("x", 1.0, "LENGTH"), (1.0, np.ones(2), "LENGTH")])
def test_damaged_terms_of_a_unit_are_no_unit(
    tmp_path: Path, rng: np.random.Generator, term: tuple[Any, ...]
) -> None:
    content = structure(rng.normal(size=(300, 1)), 1e-3, "m", {"LENGTH": 1}, ("a",))
    content["y_values"]["quantity"]["quantity_terms"][0] = term
    savemat(tmp_path / "run.mat", {"S": content})
    assert open_table(tmp_path / "run.mat").units == {}


def test_two_rates_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    content = {
        name: structure(rng.normal(size=(300, 1)), step, "g", ACCELERATION, (name,))
        for name, step in (("a", 1e-3), ("b", 2e-3))
    }
    savemat(tmp_path / "run.mat", content)
    with pytest.raises(DataError, match=r"no valid sampling rate \(a.dt: 1000 Hz, b.dt: 500 Hz\)"):
        open_table(tmp_path / "run.mat")


def test_frfs_are_scaffolded_with_names_lines_and_unit_and_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two points of one mode, 2 MN/m and 3 kg: accelerance -w^2 / (k - w^2 m + j w c) in SI behind the label
    g/N.
    """
    frequency = 60 + 0.5 * np.arange(200)
    w = 2 * np.pi * frequency
    course = -(w**2) / (2e6 - 3 * w**2 + 40j * w)
    values = np.column_stack([course, -0.5 * course])
    frf = structure(
        values, 0.5, "g/N", {"MASS": -1}, ("drive:+Z", "end:+Z"), 2 * ("hammer:+Z",), "Hz", frequency[0]
    )
    savemat(tmp_path / "frf.mat", {"FRF": frf})
    project = tmp_path / "lab"
    assert run_command(["init", str(project), str(tmp_path / "frf.mat")]) == 0
    written = yaml.safe_load((project / "pipeline.yaml").read_text("utf-8"))
    assert written["frfs"]["unit"] == "m/(N.s^2)" and written["frfs"]["input"] == "hammer:+Z"
    assert list(written["frfs"]["elements"]) == ["drive:+Z", "end:+Z"]
    assert run_command(["run", str(project / "pipeline.yaml"), "-o", str(tmp_path / "out"), "-q"]) == 0
    fit = read_identification(tmp_path / "out" / "identification.json").fits[0]
    found = {parameter.name: parameter.value for parameter in fit.parameters}
    assert found["k"] == pytest.approx(2e6, rel=1e-6) and found["m"] == pytest.approx(3.0, rel=1e-6)
    # g/N would be a contradiction: the file says what its numbers are.
    other_unit = ["-o", str(tmp_path / "other"), "--set", "frfs.unit=g/N"]
    assert run_command(["run", str(project / "pipeline.yaml"), *other_unit]) == 2
    assert "write unit: m/(N.s^2)" in capsys.readouterr().err

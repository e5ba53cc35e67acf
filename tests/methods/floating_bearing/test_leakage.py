"""Random forces on a dry stator that rings on its hoses, from raw files: blocks smear its resonance, and the
coefficients are those of the hoses all the same.

The bench is one of the tests, its truth what its hoses are made of.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import labpipe
from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_spectra, write_spectra
from labpipe.methods.floating_bearing.virtual_rig import FilmCondition
from labpipe.records.finding import WARNING
from labpipe.records.identification import Fit
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.settings import FrfSettings
from tests.methods.floating_bearing.test_stated_numbers import BENCH, on_disk

STIFFNESS, MASS = 1.1e6, 25.0
PIPELINE = """title: Dry stator
rig: rig.yaml
recordings: dry-random.parquet
frf: {{excitation: random, block: 500 ms, band: 20-60 Hz, result: spectra}}
identify:
  dry: {{model: dynamic-stiffness, estimator: {estimator}, form: kc, motion: absolute, stator_mass: 25 kg}}
"""


def damping(zeta: float) -> float:
    return float(2 * zeta * np.sqrt(STIFFNESS * MASS))


def bench(zeta: float):
    """Hoses of 1.1 MN/m: 33.4 Hz."""
    of_hoses = {
        f"baseline_{name}": ((size, 0.0), (0.0, size))
        for name, size in (("stiffness", STIFFNESS), ("damping", damping(zeta)))
    }
    return replace(
        BENCH, conditions=(("dry", FilmCondition()),), band=(5.0, 160.0), periods=240, drives=True, **of_hoses
    )


def fitted(folder: Path, zeta: float, seed: int, estimator: str = "ml") -> Fit:
    on_disk(folder, recordings(bench(zeta), seed, ["dry-random"]))
    (folder / "pipeline.yaml").write_text(PIPELINE.format(estimator=estimator))
    (fit,) = labpipe.run(folder / "pipeline.yaml").fits
    return fit


@pytest.mark.long
@pytest.mark.parametrize(
    ("zeta", "codes"), [pytest.param(0.08, set(), marks=pytest.mark.long), (0.008, {"leakage"})]
)
def test_hoses_are_told_under_random_forces(tmp_path: Path, zeta: float, codes: set[str]) -> None:
    """Three records of 120 s in blocks of half a second, 2.7 and 0.27 lines in the half-power width: the
    means are within 2.45 of their standard errors of the truth; without the model of the leakage the damping
    was 5.5 and 4.1 of one record's too large, 7 of the mean's. Two of three intervals of 95 % hold it but
    once in 140. The residual is noise; *leakage* is said where it decides on the damping.
    """
    fits = [fitted(tmp_path, zeta, seed) for seed in range(3)]
    truth = {"k_xx": STIFFNESS, "k_yy": STIFFNESS, "c_xx": damping(zeta), "c_yy": damping(zeta)}
    for name, true in truth.items():
        found = [fit.parameter(name) for fit in fits]
        error = np.mean([one.std_error for one in found]) / np.sqrt(len(found))
        assert abs(np.mean([one.value for one in found]) - true) < 2.45 * error, name
        assert sum(one.ci95[0] < true < one.ci95[1] for one in found) >= 2, name
    for fit in fits:
        said = {finding.code for finding in fit.findings if finding.level == WARNING}
        assert said & {"leakage", "model-mismatch"} == codes


def test_least_squares_says_what_it_cannot_model(tmp_path: Path) -> None:
    """2.7 lines are enough for `ml`, not for `ls`, whose damping is too large."""
    fit = fitted(tmp_path, 0.08, 1, "ls")
    (message,) = [finding.message for finding in fit.findings if finding.code == "leakage"]
    assert "33" in message and "the estimator ml" in message
    assert fit.parameter("c_xx").value > 1.005 * damping(0.08)


def test_spectra_keep_their_blocks(tmp_path: Path) -> None:
    """Through a file."""
    settings = FrfSettings("random", block="500 ms", band="20-60 Hz", result="spectra")
    spectra = channel_spectra(recordings(replace(bench(0.08), periods=60), 1, ["dry-random"]), settings)
    write_spectra(tmp_path / "dry.spectra.parquet", spectra, Header("spectra", {}, inputs=()))
    again = read_spectra(tmp_path / "dry.spectra.parquet")
    assert again.blocks == spectra.blocks and again.blocks is not None
    assert again.blocks.length == 0.5 and again.blocks.window == "hann" and again.blocks.estimator == "H1"

"""The section wear: what goes together, what is known beforehand, and how it is read from YAML."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings
from labpipe.methods.wear.settings import Gaussian
from labpipe.project.pipeline_file import load_pipeline
from labpipe.records.uncertain import Uncertain
from tests.methods.wear.worn_cases import NUISANCES, wear_settings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lines": (20.0,), "half_power": ((10.0, 30.0),)}, "both choose lines"),
        ({"depth_limit": 0.0}, "must be positive"),
        ({"angle_limit": 2.0}, "between 0 and 90 deg"),
        ({"start_depths": ()}, "start_depths: is empty"),
        ({"start_depths": (60e-6,)}, "leave the range of depths"),
        ({"start_angles": (0.5,)}, "leave the range of angles"),
        ({"prior": "tuning", **NUISANCES}, "already covers viscosity, clearance"),
        ({"healthy": True}, "nothing to tune"),
        ({"healthy": True, "bearing": "bearing 2", **NUISANCES}, "tuned in all of them"),
        ({"same_wear": True}, "goes with the 'prior'"),
        ({"cavitation_pressure": Uncertain(1e4, 1e3)}, "above the ambient"),
        ({"viscosity": Uncertain(0.0, 0.1)}, "'viscosity' must be positive"),
        ({"clearance": Uncertain(90e-6, 40e-6)}, "'clearance' not below 25 %"),
        ({"viscosity": Uncertain(0.1, 0.025)}, "'viscosity' not below 25 %"),
        ({"prior": "t", "posterior": Gaussian(("viscosity",), (0.1,), ((9e-4,),))}, "'viscosity' not below"),
        ({"healthy": True, "start_depths": (1e-6,), **NUISANCES}, "'start_depths' is of a worn bearing"),
        ({"healthy": True, "angle_limit": 0.5, **NUISANCES}, "'angle_limit' is of a worn bearing"),
    ],
)
def test_what_does_not_go_together_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        wear_settings(**changes)


def test_uncertainty_is_estimated_and_certainty_is_given() -> None:
    wear = wear_settings(
        viscosity=Uncertain(0.1, 0.002), clearance=Uncertain(88e-6), beta=Uncertain(1.6e-4, 1e-5)
    )
    assert wear.nuisances == ("viscosity", "beta") and wear.fixed_values == {"clearance": 88e-6}
    assert wear.nuisance_prior.names == ("viscosity", "beta") and wear.nuisance_prior.mean == (0.1, 1.6e-4)
    np.testing.assert_allclose(wear.nuisance_prior.std, [0.002, 1e-5])


def test_a_posterior_takes_the_place_of_the_prior() -> None:
    known = Gaussian(("viscosity", "clearance"), (0.1, 9e-5), ((1e-6, 5e-10), (5e-10, 1e-12)))
    assert wear_settings(prior="tuning", posterior=known).nuisance_prior == known
    np.testing.assert_allclose(known.std, [1e-3, 1e-6])


def test_model_and_section_belong_together() -> None:
    with pytest.raises(ConfigError, match="sdof has no settings of its own"):
        FitSettings("sdof", model_settings=wear_settings())
    with pytest.raises(ConfigError, match="worn-bearing needs the section 'wear'"):
        FitSettings("worn-bearing")


PIPELINE = """frfs: frf.csv
identify:
  wear:
    model: worn-bearing
    wear:
      rotor: ROTOR
      bearing: bearing 1
      response: dFRF
      terms: cross
      objective: log
      lines: [15.9 Hz, 81.3 Hz]
      depth_limit: 40 um
      angle_limit: 15 deg
      start_depths: [10 um, 20 um]
      start_angles: [-5 deg, 5 deg]
      clearance: 90 um +- 2 %
      cavitation_pressure: -0.2 bar +- 0.05 bar
"""


@pytest.fixture
def pipeline(tmp_path: Path, root: Path) -> Path:
    (tmp_path / "frf.csv").write_text("frequency_hz\n")
    path = tmp_path / "p.yaml"
    path.write_text(PIPELINE.replace("ROTOR", str(root / "configs/rotors/mendes.yaml")))
    return path


def test_section_as_people_write_it(pipeline: Path) -> None:
    (fit,) = load_pipeline(pipeline).fits
    wear = fit.model_settings
    assert wear is not None and wear.rig is not None and wear.rig.speed == 50
    assert (wear.response, wear.terms, wear.objective, wear.bearing) == ("dFRF", "cross", "log", "bearing 1")
    assert wear.lines == (15.9, 81.3) and wear.depth_limit == pytest.approx(40e-6)
    assert np.rad2deg(wear.start_angles) == pytest.approx([-5, 5])
    assert wear.nuisance_prior.mean == pytest.approx(
        (90e-6, -2e4)
    ) and wear.nuisance_prior.std == pytest.approx([1.8e-6, 5e3])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "bearing: bearing 1",
            "bearing: bearing 3",
            "p.yaml:7:7: identify.wear.wear.bearing: no bearing 'bearing 3'",
        ),
        ("rotors/mendes.yaml", "rotors/mends.yaml", "p.yaml:6:7: identify.wear.wear.rotor: no such file"),
        ("terms: cross", "terms: crss", "did you mean 'cross'"),
        ("depth_limit: 40 um", "depth_limit: 40 deg", "depth_limit"),
        ("depth_limit: 40 um", "cells_around: 121", "wear.cells_around: an oil film of 121 x 30 cells"),
        ("depth_limit: 40 um", "depth_limit: 0 um", "wear.depth_limit: depth_limit must be positive"),
    ],
)
def test_faults_of_the_section_stand_at_their_place(pipeline: Path, old: str, new: str, message: str) -> None:
    pipeline.write_text(pipeline.read_text().replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_pipeline(pipeline)
    assert message in str(caught.value)


def test_faults_of_the_rotor_file_are_named_with_the_pipeline_s(
    pipeline: Path, tmp_path: Path, root: Path
) -> None:
    rotor = tmp_path / "broken.yaml"
    rotor.write_text((root / "configs/rotors/mendes.yaml").read_text().replace("count: 4", "cont: 4"))
    pipeline.write_text(pipeline.read_text().replace(str(root / "configs/rotors/mendes.yaml"), "broken.yaml"))
    with pytest.raises(ConfigError, match=r"broken.yaml:8:\d+: elements.3.cont: unknown key"):
        load_pipeline(pipeline)

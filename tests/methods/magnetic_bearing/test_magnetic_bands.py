"""What the bearing file predicts against what sliding bands find on the virtual rig that is closed by the
same loop in its recording.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from labpipe.methods.magnetic_bearing.loop import dynamic_stiffness
from labpipe.project.bearing_file import open_bearing


@pytest.fixture
def bands(labpipe: Callable[..., Any], root: Path, tmp_path: Path) -> list[dict[str, Any]]:
    """The 79 fits of the shipped sliding pipeline, on a recording of the rig under its control loop."""
    rig = root / "configs/virtual-hmb-loop.yaml"
    assert labpipe("simulate", rig, "--run", "radial-0rpm", "--seed", "1", "-o", tmp_path / "rig").code == 0
    pipeline = yaml.safe_load((root / "pipelines/radial-sliding.yaml").read_text(encoding="utf-8"))
    pipeline |= {
        "rig": str(root / "configs/hmb-radial.yaml"),
        "recordings": str(tmp_path / "rig/radial-0rpm.parquet"),
    }
    del pipeline["expect"]
    (tmp_path / "loop.yaml").write_text(yaml.safe_dump(pipeline), encoding="utf-8")
    assert (
        labpipe("run", tmp_path / "loop.yaml", "-o", tmp_path / "out", "--set", "report.formats=[]").code == 0
    )
    fits: list[dict[str, Any]] = json.loads(
        (tmp_path / "out/identification.json").read_text(encoding="utf-8")
    )["fits"]
    return fits


@pytest.mark.long
def test_prediction_lies_in_the_95_percent_interval_of_nine_bands_in_ten(
    bands: list[dict[str, Any]], root: Path
) -> None:
    """K_eq and C_eq of configs/bearings/hmb-magnetic.yaml at the bands' centres."""
    plant = open_bearing(root / "configs/bearings/hmb-magnetic.yaml").settings().suspension()
    omega = 2 * np.pi * np.array([np.mean(fit["band_hz"]) for fit in bands])
    predicted = dynamic_stiffness(plant.loop, plant.negative_stiffness, omega)
    assert omega.size == 79
    for name, truth in (("k_yy", predicted.real), ("c_yy", predicted.imag / omega)):
        found = [next(each for each in fit["parameters"] if each["name"] == name) for fit in bands]
        low, high = np.array([each["ci95"] for each in found]).T
        assert np.mean((low <= truth) & (truth <= high)) >= 0.9, name


@pytest.mark.long
def test_the_rig_closed_in_time_is_predicted_in_nine_bands_in_ten(
    labpipe: Callable[..., Any], root: Path, tmp_path: Path
) -> None:
    """Mean share of the shipped comparison; bands share lines, so a single recording may miss several at
    once.

    Twelve seeds gave 97 % of the bands for k (92 to 100 %), 96 % for c (89 to 100 %).
    """
    pipeline = yaml.safe_load((root / "pipelines/magnetic-loop.yaml").read_text(encoding="utf-8"))
    pipeline |= {"rig": str(root / "configs/hmb-loop.yaml"), "expect": {}, "report": {"formats": []}}
    theory = {"bearing": str(root / "configs/bearings/hmb-magnetic.yaml")}
    pipeline["compare"] = {"loop": {**pipeline["compare"]["loop"], "theory": theory}}
    shares = []
    for seed in (2, 3):
        folder = tmp_path / str(seed)
        rig = root / "configs/virtual-hmb-loop.yaml"
        assert labpipe("simulate", rig, "--run", "loop-0rpm", "--seed", seed, "-o", folder).code == 0
        pipeline["recordings"] = str(folder / "loop-0rpm.parquet")
        (folder / "loop.yaml").write_text(yaml.safe_dump(pipeline), encoding="utf-8")
        assert labpipe("run", folder / "loop.yaml", "-o", folder / "out").code == 0
        (found,) = json.loads((folder / "out/identification.json").read_text(encoding="utf-8"))["comparisons"]
        amounts = {amount["name"]: amount["value"] for amount in found["amounts"]}
        assert amounts["bands"] == 79 and amounts["chi2_p"] > 1e-3
        shares.append((amounts["share_k"], amounts["share_c"]))
    assert np.all(np.mean(shares, axis=0) >= 0.9), shares

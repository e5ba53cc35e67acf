"""A project from a recording whose force, rate and periods are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from labpipe.errors import DataError, LabpipeError
from labpipe.project.first_guess import guess_channels
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.proposals import first_look
from labpipe.project.scaffold import channel_line, scaffold
from labpipe.project.settings_reader import DECIDE
from labpipe.raw_files.table import open_table
from tests.project.laboratory import recording


def test_rate_period_and_band_are_those_of_the_recording(tmp_path: Path) -> None:
    """Three periods of 1 s at 100 Hz, the force at 1-45 Hz.

    The resonance of 0.79 kg on 18 kN/m is at 24.0 Hz.
    """
    (tmp_path / "soft.csv").write_text(recording(18e3))
    first = first_look(open_table(tmp_path / "soft.csv"))
    assert first.rate == pytest.approx(100.0) and first.time == "t [s]" and first.rows.shape == (300, 2)
    assert [channel.role for channel in first.channels] == ["input", "output"]
    made = scaffold([tmp_path / "soft.csv"], tmp_path)
    pipeline = yaml.safe_load(made.pipeline)
    assert pipeline["frf"] == {"excitation": "periodic", "period": "1 s", "skip": 1, "band": "1-45 Hz"}
    (fit,) = pipeline["identify"].values()
    low, high = (float(edge) for edge in fit["band"].removesuffix(" Hz").split("-"))
    # Two and a half half-power widths of 4 Hz, c / (2 pi m), to either side of the line at 24 Hz.
    assert (low, high) == (14.0, 34.0)


def test_a_file_of_two_rows_is_the_shortest(tmp_path: Path) -> None:
    (tmp_path / "two.csv").write_text("t [ms],f [N],x [um]\n0,2,3\n4,1,2\n")
    assert first_look(open_table(tmp_path / "two.csv")).rate == pytest.approx(250.0)
    (tmp_path / "one.csv").write_text("t [ms],f [N],x [um]\n0,1,2\n")
    with pytest.raises(DataError, match="holds too few samples"):
        first_look(open_table(tmp_path / "one.csv"))


def test_a_run_up_beside_tests_at_rest_asks_how_bearings_change_together(tmp_path: Path) -> None:
    """In whatever order the files come; tests at rest alone ask nothing."""
    shipped = Path(__file__).parents[2] / "sample_data/rotor-system"
    standing = [shipped / f"{name}.parquet" for name in ("free", "shaken-y")]
    assert "rotor_system" not in scaffold(standing, tmp_path).pipeline
    made = scaffold([shipped / "run-up.parquet", *standing], tmp_path)
    pipeline = yaml.safe_load(made.pipeline)
    assert [test["name"] for test in pipeline["tests"]] == ["free", "shaken-y"]
    section = pipeline["rotor_system"]
    assert section["small_errors"] == {"together": DECIDE} and section["rotor"] == DECIDE
    assert [test["kind"] for test in section["tests"]] == ["run-up", "response", "response"]
    asked = [line for line in made.pipeline.splitlines() if "together: " in line]
    assert len(asked) == 1 and "between rest and speed" in asked[0]
    (tmp_path / "rig.yaml").write_text(made.rig.replace(f"sample_rate: {DECIDE}", "sample_rate: 2 kHz"))
    (tmp_path / "pipeline.yaml").write_text(made.pipeline.replace(f"period: {DECIDE}", "period: 1 s"))
    with pytest.raises(LabpipeError, match=r"small_errors\.together: is still to be decided"):
        load_pipeline(tmp_path / "pipeline.yaml")


def test_a_channel_is_a_line_of_the_rig_file() -> None:
    """A point that points against its axis is inverted; the sensitivity of the file stands beside."""
    (channel,) = guess_channels(["12-Z"], {"12-Z": "m/s^2"})
    channel = replace(channel, sensitivity="10.2 mV/gn")
    line = channel_line(channel, "")
    assert yaml.safe_load(line) == {
        "ch_12_z": {
            "column": "12-Z",
            "quantity": "acceleration",
            "unit": "m/s^2",
            "role": "output",
            "dof": "z",
            "sensitivity": "10.2 mV/gn",
            "invert": True,
        }
    }
    assert "invert" not in channel_line(replace(channel, invert=False), "")


@pytest.mark.parametrize(("volts_noise", "named"), [(1e-4, True), (0.05, False)])
def test_volts_cleaner_than_the_force_drive_the_shaker(
    tmp_path: Path, volts_noise: float, named: bool
) -> None:
    """Tones at 10, 12 and 15 Hz; the amplifier squares a tenth of them, which puts force on other lines."""
    draw = np.random.default_rng(3)
    time = np.arange(4000) / 200
    tones = sum(np.cos(2 * np.pi * f * time + f) for f in (10, 12, 15))
    force = tones + 0.1 * tones**2 + 0.05 * draw.standard_normal(time.size)
    columns = {
        "t [s]": time,
        "u [V]": tones + volts_noise * draw.standard_normal(time.size),
        "f [N]": force,
        "a [m/s^2]": force + 0.05 * draw.standard_normal(time.size),
    }
    pd.DataFrame(columns).to_csv(tmp_path / "shaken.csv", index=False)
    frf = yaml.safe_load(scaffold([tmp_path / "shaken.csv"], tmp_path).pipeline)["frf"]
    assert frf["excitation"] == "periodic" and frf["period"] == "1 s"
    low, high = (float(edge) for edge in frf["band"].removesuffix(" Hz").split("-"))
    if named:
        assert frf["reference"] == "u" and (low, high) == (10.0, 15.0)
    else:
        assert "reference" not in frf and low < 10.0 < 15.0 < high

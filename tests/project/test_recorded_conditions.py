"""Conditions that recordings show: means by hand calculation, scatter of samples, speed of a tacho,
faults.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.recording_file import open_recording
from labpipe.artefacts.writing import output_folder
from labpipe.errors import ConfigError
from labpipe.project.ingest import SourceFile, ingest
from labpipe.project.one_test import recorded_conditions
from labpipe.project.rig_file import load_rig
from labpipe.quantities import si_amount
from labpipe.records.rig import RecordedCondition

RIG = """name: R
sample_rate: 1 kHz
channels:
  w: {quantity: force, unit: V, sensitivity: 1 V/kN, role: reference}
  oil: {quantity: temperature, unit: degC}
  key: {quantity: tacho, unit: V}
  flow: {quantity: flow, unit: l/min}
"""


@pytest.fixture
def recording(tmp_path: Path):
    """4 s: a load of 2 kN with a sine of 0.1 kN, an oil that warms by 0.001 K a sample, 25 turns a second
    with two pulses each.
    """
    time = np.arange(4000) / 1000
    load = 2 + 0.1 * np.sin(2 * np.pi * 10 * time)
    key = (np.sin(2 * np.pi * 50 * time - 1.0) > 0).astype(float)
    columns = np.column_stack([load, 40 + np.arange(4000) * 1e-3, key, np.full(4000, 6.0)])
    np.savetxt(tmp_path / "run.csv", columns, delimiter=",", header="w,oil,key,flow", comments="")
    (tmp_path / "rig.yaml").write_text(RIG)
    with output_folder(tmp_path / "out") as output:
        ingest(SourceFile(tmp_path / "run.csv", load_rig(tmp_path / "rig.yaml")), output, "run", tmp_path)
    return open_recording(tmp_path / "out/run.recording.parquet")


def test_means_and_scatter_stand_in_the_conditions(recording) -> None:
    """Whole periods of a sine: mean 2 kN, standard deviation 0.1 / sqrt 2 kN; a ramp of n steps: s = step
    sqrt((n^2 - 1) / 12).
    """
    sources = {
        "load": RecordedCondition(channel="w"),
        "oil": RecordedCondition(channel="oil"),
        "flow": RecordedCondition(channel="flow"),
    }
    found = recorded_conditions([recording], sources)
    assert found == {"load": "2000 N +- 71 N", "oil": "41.9995 degC +- 1.2 K", "flow": "6 l/min +- 0 l/min"}
    assert si_amount(found["load"]) == (2000.0, "N")
    assert si_amount(found["oil"]) == (pytest.approx(315.1495), "K")


def test_the_speed_is_that_of_the_tacho(recording) -> None:
    """50 pulses a second, two a turn: 25 Hz = 1500 rpm.

    Pulse times interpolated between samples are exact to a share of a sample.
    """
    text = recorded_conditions([recording], {"speed": RecordedCondition(tacho="key", pulses=2)})["speed"]
    assert text.endswith("rpm") and si_amount(text)[0] == pytest.approx(25.0, rel=1e-3)


def test_the_mean_is_over_all_recordings_of_a_test(recording) -> None:
    twice = recorded_conditions([recording, recording], {"load": RecordedCondition(channel="w")})
    assert twice == {"load": "2000 N +- 71 N"}


def test_a_recording_without_noted_levels_is_read(recording) -> None:
    import dataclasses

    contents = {key: value for key, value in recording.header.contents.items() if key != "levels"}
    bare = dataclasses.replace(recording, header=dataclasses.replace(recording.header, contents=contents))
    assert recorded_conditions([bare], {"load": RecordedCondition(channel="w")}) == {"load": "2000 N +- 71 N"}


def test_an_unknown_channel_is_named(recording) -> None:
    with pytest.raises(ConfigError, match="has no channel 'lod'"):
        recorded_conditions([recording], {"load": RecordedCondition(channel="lod")})

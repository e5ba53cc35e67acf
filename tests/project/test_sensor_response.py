"""Correction tables of sensors: read beside the rig file, every fault at its key."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from labpipe.errors import ConfigError
from labpipe.project.rig_file import load_rig

RIG = 'sample_rate: 1 kHz\nchannels:\n  x: {quantity: displacement, response: "probe.csv"}\n'


def rig_with(folder: Path, table: str | None) -> Path:
    (folder / "rig.yaml").write_text(RIG)
    if table is not None:
        (folder / "probe.csv").write_text(table)
    return folder / "rig.yaml"


def test_the_table_stands_in_the_channel(tmp_path: Path) -> None:
    rig = load_rig(
        rig_with(tmp_path, "# calibrated\nfrequency_hz, gain, phase_deg\n0, 1, 0\n100, 0.98, -90\n")
    )
    assert rig.channels[0].channel.response == ((0.0, 1.0, 0.0), (100.0, 0.98, -math.pi / 2))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (None, "no such file 'probe.csv'"),
        ("f,g,p\n0,1,0\n1,1,0\n", "has other columns"),
        ("frequency_hz,gain,phase_deg\n0,1,0\n", "two or more increasing frequencies"),
        ("frequency_hz,gain,phase_deg\n5,1,0\n5,1,0\n", "two or more increasing frequencies"),
        ("frequency_hz,gain,phase_deg\n0,one,0\n", "is not a frequency, gain and phase"),
        ("frequency_hz,gain,phase_deg\n0,0,0\n1,1,0\n", "impossible: 0 Hz, gain 0, phase 0 deg"),
    ],
)
def test_faults_are_named_at_their_key(tmp_path: Path, table: str | None, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_rig(rig_with(tmp_path, table))
    assert message in str(caught.value) and "channels.x.response" in str(caught.value)

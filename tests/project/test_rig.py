"""Rig files: calibration to SI, directions, positions of faults."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from labpipe.errors import ConfigErrors
from labpipe.project.rig_file import load_rig
from labpipe.records.rig import Rig


def rig_of(tmp_path: Path, channels: str, head: str = "sample_rate: 20 kHz\n") -> Rig:
    path = tmp_path / "rig.yaml"
    path.write_text(f"name: R\n{head}channels:\n{channels}")
    return load_rig(path)


@pytest.mark.parametrize(
    ("entry", "scale"),
    [
        ("quantity: displacement, unit: um", 1e-6),
        ("quantity: displacement, unit: mil", 25.4e-6),
        ("quantity: displacement, unit: V, sensitivity: 8 V/mm", 1 / 8000),
        ("quantity: displacement, unit: mV, sensitivity: 8 V/mm", 1e-3 / 8000),
        ("quantity: displacement, unit: V, sensitivity: 125 um/V", 125e-6),
        ("quantity: force, unit: V, sensitivity: 22.5 mV/N", 1 / 0.0225),
        ("quantity: acceleration, unit: gn", 9.80665),
        ("quantity: force", 1.0),
        ("quantity: force, unit: kN, invert: true", -1000.0),
    ],
)
def test_recorded_numbers_become_si(tmp_path: Path, entry: str, scale: float) -> None:
    assert rig_of(tmp_path, f"  a: {{{entry}}}\n").channels[0].scale == pytest.approx(scale, rel=1e-12)


def test_temperature_has_an_offset(tmp_path: Path) -> None:
    (channel,) = rig_of(tmp_path, "  t: {quantity: temperature, unit: degC}\n").channels
    assert (channel.scale, channel.offset, channel.channel.role) == (1.0, 273.15, "reference")


@pytest.mark.parametrize(
    ("dof", "label", "angle"),
    [
        ("x", "x", 0.0),
        ("y", "y", math.pi / 2),
        ("45 deg", "45 deg", math.pi / 4),
        ("bearing2.y", "bearing2.y", None),
        ("1", "1", None),
    ],
)
def test_directions(tmp_path: Path, dof: str, label: str, angle: float | None) -> None:
    (channel,) = rig_of(tmp_path, f"  f: {{quantity: force, dof: {dof}}}\n").channels
    assert channel.channel.dof == label
    assert (
        channel.channel.angle == pytest.approx(angle) if angle is not None else channel.channel.angle is None
    )


def test_defaults_follow_the_key_and_the_quantity(tmp_path: Path) -> None:
    force, x = rig_of(tmp_path, "  f: {quantity: force}\n  x: {quantity: displacement}\n").channels
    assert [(c.column, c.unit, c.channel.role) for c in (force, x)] == [
        ("f", "N", "input"),
        ("x", "m", "output"),
    ]


@pytest.mark.parametrize(
    ("column", "scale"), [("t [s]", 1.0), ("t [ms]", 1e-3), ("Time (us)", 1e-6), ("t", 1.0), ("t [sec]", 1.0)]
)
def test_the_time_column_s_unit(tmp_path: Path, column: str, scale: float) -> None:
    assert rig_of(tmp_path, "  f: {quantity: force}\n", f'time: "{column}"\n').time_scale == pytest.approx(
        scale
    )


def test_ranges_at_which_the_logger_clips(tmp_path: Path) -> None:
    rig = rig_of(
        tmp_path,
        "  f: {quantity: force, range: 50 N}\n  y: {quantity: displacement, unit: V, sensitivity: "
        "8 V/mm, range: -5 V .. 10 V}\n",
    )
    assert [channel.limits for channel in rig.channels] == [(-50.0, 50.0), (-5.0, 10.0)]


@pytest.mark.parametrize(
    ("entry", "fault"),
    [
        (
            "quantity: displacement, unit: V",
            "rig.yaml:4:31: channels.a.unit: 'V' has the wrong dimension, m is needed",
        ),
        ("quantity: displacement, unit: V, sensitivity: 8 V/N", "does not lead from the channel's unit to m"),
        ("quantity: displacement, unit: V, sensitivity: 0 V/m", "the sensitivity '0 V/m' is zero"),
        (
            "quantity: displacement, unit: V, sensitivity: none.json#y",
            "'none.json' is not a readable identification.json",
        ),
        ("unit: um", "channels.a.quantity: is missing"),
        ("quantity: force, dof: 45 degg", "channels.a.dof: unknown unit 'degg'; did you mean 'deg'?"),
        ("quantity: force, range: big", "channels.a.range: 'big' is not a value with a unit"),
        ("quantity: force, delay: 3 Hz", "channels.a.delay: 'Hz' has the wrong dimension, s is needed"),
    ],
)
def test_faults_stand_at_their_place(tmp_path: Path, entry: str, fault: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        rig_of(tmp_path, f"  a: {{{entry}}}\n")
    assert fault in str(caught.value.faults[0])


def test_two_channels_of_one_column_and_no_channels(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match="takes the column 'c' of channel 'a'"):
        rig_of(tmp_path, "  a: {quantity: force, column: c}\n  b: {quantity: force, column: c}\n")
    (tmp_path / "bare.yaml").write_text("name: R\nsample_rate: 0 Hz\n")
    with pytest.raises(ConfigErrors) as caught:
        load_rig(tmp_path / "bare.yaml")
    assert len(caught.value.faults) == 2

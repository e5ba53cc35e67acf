"""Rig files beside their calibration: overrides, slopes of a calibration, sensor responses, all faults of all
channels at once.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from labpipe.errors import ConfigError, ConfigErrors, DataError
from labpipe.project.rig_file import load_rig, move
from labpipe.records.rig import Rig, RigChannel, time_scale

CHECKS = [HealthCheck.function_scoped_fixture]


def rig(folder: Path, text: str, *overrides: str) -> Rig:
    (folder / "rig.yaml").write_text(text)
    return load_rig(folder / "rig.yaml", overrides)


def channel(folder: Path, entry: str) -> RigChannel:
    (found,) = rig(folder, f"sample_rate: 1 kHz\nchannels:\n  a: {{{entry}}}\n").channels
    return found


def faults(folder: Path, text: str) -> list[str]:
    with pytest.raises(ConfigErrors) as caught:
        rig(folder, text)
    return [str(fault).removeprefix(f"{folder}/rig.yaml:") for fault in caught.value.faults]


@settings(max_examples=30, suppress_health_check=CHECKS)
@given(
    st.floats(1e-3, 1e3).map(lambda number: float(f"{number:.6g}")),
    st.sampled_from([("V/mm", 1e3), ("mV/um", 1e3), ("V/m", 1.0)]),
)
def test_a_sensitivity_is_divided_by_and_its_reciprocal_multiplied(
    tmp_path: Path, size: float, unit: tuple[str, float]
) -> None:
    """x = u / S for S in V/m, x = u R for R in m/V."""
    divided = channel(tmp_path, f"quantity: displacement, unit: V, sensitivity: {size!r} {unit[0]}")
    assert divided.scale == pytest.approx(1 / (size * unit[1]), rel=1e-9)
    multiplied = channel(tmp_path, f"quantity: displacement, unit: V, sensitivity: {size!r} um/V")
    assert multiplied.scale == pytest.approx(size * 1e-6, rel=1e-9)


@settings(max_examples=20, suppress_health_check=CHECKS)
@given(st.floats(-360, 360).map(lambda number: float(f"{number:.6g}")))
def test_a_direction_is_an_angle_from_x(tmp_path: Path, degrees: float) -> None:
    found = channel(tmp_path, f"quantity: force, dof: {degrees!r} deg")
    assert found.channel.angle == pytest.approx(math.radians(degrees), rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    ("quantity", "role"),
    [
        ("force", "input"),
        ("displacement", "output"),
        ("velocity", "output"),
        ("acceleration", "output"),
        ("tacho", "reference"),
        ("current", "reference"),
    ],
)
def test_the_role_follows_from_the_quantity_unless_it_is_stated(
    tmp_path: Path, quantity: str, role: str
) -> None:
    assert channel(tmp_path, f"quantity: {quantity}").channel.role == role
    assert channel(tmp_path, f"quantity: {quantity}, role: reference").channel.role == "reference"


@pytest.mark.parametrize(
    ("text", "limits"),
    [
        ("10 V", (-10.0, 10.0)),
        ("-5 V .. 10 V", (-5.0, 10.0)),
        ("0 V..5 V", (0.0, 5.0)),
        ("500 mV", (-0.5, 0.5)),
    ],
)
def test_limits_of_the_logger(tmp_path: Path, text: str, limits: tuple[float, float]) -> None:
    assert channel(tmp_path, f"quantity: voltage, range: {text}").limits == pytest.approx(limits)


def test_overrides_reach_any_depth(tmp_path: Path) -> None:
    text = "sample_rate: 1 kHz\nmass: 1 kg\nchannels:\n  f: {quantity: force}\n"
    found = rig(tmp_path, text, "mass=2 kg", "channels.f.dof=45 deg", "channels.x.quantity=displacement")
    assert found.mass == 2.0 and [one.channel.name for one in found.channels] == ["f", "x"]
    assert found.channels[0].channel.angle == pytest.approx(math.pi / 4)


def test_a_broken_override_is_named_as_such(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match="--set mass=2 m: mass: 'm' has the wrong dimension"):
        rig(tmp_path, "sample_rate: 1 kHz\nchannels: {f: {quantity: force}}\n", "mass=2 m")


def test_faults_of_all_channels_are_named_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    found = faults(
        tmp_path,
        "name: R\nsample_rat: 1 kHz\nmass: heavy\nchannels:\n"
        "  f: {quantity: farce}\n  x: {quantity: displacement, unit: N}\n  y: {quantity: displacement, "
        "delay: 3 m}\n  z: {unit: um}\n",
    )
    assert [fault.split(": ")[1] for fault in found] == [
        "sample_rat",
        "mass",
        "channels.f.quantity",
        "channels.x.unit",
        "channels.y.delay",
        "channels.z.quantity",
    ]
    assert [fault.split(":")[0] for fault in found] == ["2", "3", "5", "6", "7", "8"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: R\n", "channels: is missing"),
        ("channels: []\n", "channels: a mapping of keys to values is needed"),
        ("channels: {f: force}\n", "channels.f: a mapping of keys to values is needed"),
        ("sample_rate: -1 kHz\nchannels: {f: {quantity: force}}\n", "sample_rate: must be positive"),
        ("mass: -1 kg\nchannels: {f: {quantity: force}}\n", "mass: must be positive"),
        ("channels: {f: {quantity: force, range: 9 N .. -9 N}}\n", "channels.f.range: must rise"),
        ("channels: {f: {quantity: force, range: -9 N}}\n", "channels.f.range: must rise"),
        (
            "sample_rate: 1 kHz\ntime: t\nchannels: {f: {quantity: force}}\n",
            "one of sample_rate and time is needed, not both",
        ),
        (
            "channels: {f: {quantity: acceleration, unit: mV}}\n",
            "m/s^2 is needed; or state the sensor's 'sensitivity: 10 mV/(m/s^2)'",
        ),
        (
            "channels: {f: {quantity: force, sensitivity: 3}}\n",
            "'3' is not a sensitivity; for example '8 V/mm'",
        ),
        (
            "channels: {f: {quantity: force, unit: V, sensitivity: 3 V/m}}\n",
            "does not lead from the channel's unit to N",
        ),
        ("channels: {f: {quantity: force, response: none.csv}}\n", "no such file 'none.csv'"),
    ],
)
def test_faults_of_a_rig(tmp_path: Path, text: str, said: str) -> None:
    assert any(said in fault for fault in faults(tmp_path, text))


# sensitivities from a calibration


def calibration(folder: Path, *fits: tuple[str, float, str]) -> None:
    entries = [
        {"name": name, "parameters": [{"name": "slope", "value": value, "unit": unit}]}
        for name, value, unit in fits
    ]
    (folder / "cal.json").write_text(json.dumps({"fits": entries}))


def test_a_calibrated_slope_is_a_sensitivity(tmp_path: Path) -> None:
    calibration(tmp_path, ("probe_x", 8000.0, "V/m"), ("probe_y", 8200.0, "V/m"))
    assert channel(
        tmp_path, "quantity: displacement, unit: V, sensitivity: 'cal.json#probe_y'"
    ).scale == pytest.approx(1 / 8200)


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ("cal.json#probe_z", "'cal.json' holds no calibration fit 'probe_z'; did you mean 'probe_x'"),
        ("cal.json#cell", "the fit 'cell' of 'cal.json' has no slope: it is no line of `calibrate:`"),
        ("none.json#probe_x", "'none.json' is not a readable identification.json of a calibration"),
        ("bad.json#probe_x", "'bad.json' is not a readable identification.json of a calibration"),
        ("cal.json#force", "does not lead from the channel's unit to m"),
    ],
)
def test_a_slope_that_is_not_there(tmp_path: Path, reference: str, said: str) -> None:
    calibration(tmp_path, ("probe_x", 8000.0, "V/m"), ("force", 5.8, "N/A"))
    text = json.loads((tmp_path / "cal.json").read_text())
    text["fits"].append({"name": "cell", "parameters": [{"name": "gain", "value": 2e-3, "unit": "1"}]})
    (tmp_path / "cal.json").write_text(json.dumps(text))
    (tmp_path / "bad.json").write_text("[]")
    found = faults(
        tmp_path, f"channels:\n  a: {{quantity: displacement, unit: V, sensitivity: '{reference}'}}\n"
    )
    assert any(said in fault for fault in found), found


# frequency responses of sensors


def test_a_sensor_response_is_read_beside_its_rig(tmp_path: Path) -> None:
    (tmp_path / "sensor.csv").write_text("# cal 7\nfrequency_hz,gain,phase_deg\n10,1,0\n100,0.9,-90\n")
    found = channel(tmp_path, "quantity: displacement, response: sensor.csv")
    assert found.channel.response == ((10.0, 1.0, 0.0), (100.0, 0.9, pytest.approx(-math.pi / 2)))


@pytest.mark.parametrize(
    ("column", "scale"),
    [
        (None, 1.0),
        ("t", 1.0),
        ("t [min]", 60.0),
        ("t(h)", 3600.0),
        ("[s] t", 1.0),
        ("t [msec]", 1e-3),
        ("Time (microseconds)", 1e-6),
        ("t (sec)", 1.0),
    ],
)
def test_seconds_per_unit_of_the_time_column(column: str | None, scale: float) -> None:
    assert time_scale(column, {}) == scale


@pytest.mark.parametrize(
    ("stated", "scale"),
    [
        ("Milliseconds", 1e-3),
        ("seconds since 2024-03-01 00:00", 1.0),
        ("counts", None),
        ("1", None),
        ("N", None),
    ],
)
def test_the_unit_that_a_file_states_for_its_time_is_one_of_time(stated: str, scale: float | None) -> None:
    """By the prefixes of the SI; counts of an unknown clock are no seconds."""
    if scale is not None:
        assert time_scale("t", {"t": stated}) == scale
        return
    with pytest.raises(DataError, match=f"run.h5: 't' is in {stated}, which is not a unit.*known: s, ms, us"):
        time_scale("t", {"t": stated}, "run.h5")


def test_a_rig_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load_rig(tmp_path / "none.yaml")


def test_a_channel_that_moves_keeps_an_angle_as_direction(tmp_path: Path) -> None:
    force = "{quantity: force, unit: V, sensitivity: 1 V/N +- 1 %, dof: x +- 1 deg}"
    text = f"sample_rate: 1 kHz\nchannels:\n  f: {force}\n"
    found = move(rig(tmp_path, text), {"f": "45 deg"}).channels[0].channel
    assert found.angle == pytest.approx(math.pi / 4)
    # It is the same sensor, mounted anew.
    sources = {part.effect: part.uncertainty.source for part in found.uncertainties}
    assert sources == {"gain": "f.sensitivity 1 V/N", "direction": "f.dof 45 deg"}

"""Reading a sweep: keys, units, values, and what is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest

from labpipe.errors import ConfigError
from labpipe.project.bearing_file import parse_sweep
from labpipe.records.settings import setting


@dataclass(frozen=True)
class Inner:
    z: float = setting("value", "axial load", unit="N", default=0.0)


@dataclass(frozen=True)
class Owner:
    clearance: float = setting("value", "clearance", unit="m", default=0.0)
    ratio: float = setting("value", "a pure number", unit="1", default=0.5)
    angle: float = setting("value", "an angle", unit="rad", default=0.0)
    oil: float = setting("value", "a temperature", unit="K", default=293.15)
    elements: int = setting("integer", "number of elements", default=9)
    loads: Inner = setting("section", "loads", section=Inner, default=Inner())


@pytest.mark.parametrize(
    ("text", "unit", "values"),
    [
        ("loads.z=0:10:5", "N", [0, 5, 10]),
        (" loads.z = 0 : 10 : 5 ", "N", [0, 5, 10]),
        ("loads.z=0:1:0.5 kN", "N", [0, 500, 1000]),
        ("loads.z=-1e2:1e2:1e2", "N", [-100, 0, 100]),
        ("loads.z=10 N:0.03 kN:10", "N", [10, 20, 30]),
        ("clearance=10:-10:-10 um", "m", [1e-5, 0, -1e-5]),
        ("ratio=0.1:0.3:0.1", "1", [0.1, 0.2, 0.3]),
        ("ratio=10 %:30 %:10 %", "1", [0.1, 0.2, 0.3]),
        ("angle=0:90:45 deg", "rad", [0, math.pi / 4, math.pi / 2]),
        ("loads.z=0:9:5", "N", [0, 5]),
        ("oil=20:40:10 degC", "K", [293.15, 303.15, 313.15]),
        ("oil=20 degC:40 degC:10 K", "K", [293.15, 303.15, 313.15]),
    ],
)
def test_values_in_si_units(text: str, unit: str, values: list[float]) -> None:
    sweep = parse_sweep(text, Owner)
    assert sweep.unit == unit and list(sweep.values) == pytest.approx(values, rel=1e-12, abs=1e-20)
    assert sweep.label == f"{text.split('=')[0].strip()} [{unit}]"


def test_rounding_does_not_lose_the_last_value() -> None:
    """0.1 has no exact binary form; 0 to 100 in steps of 0.1 has 1001 values all the same."""
    sweep = parse_sweep("loads.z=0:100:0.1", Owner)
    assert sweep.values.size == 1001 and sweep.values[-1] == pytest.approx(100)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loads.z", "not a sweep; write --sweep loads.z=0:2000:50"),
        ("loads.z=0:1:2:3", "not a sweep"),
        ("loads.x=0:1:1", "loads.x: cannot be swept; did you mean 'loads.z'?"),
        ("loads=0:1:1", "loads: cannot be swept"),
        ("elements=7:9:1", "elements: cannot be swept"),
        ("loads.z=0:1 mm:1", "'mm' has the wrong dimension, N is needed"),
        ("loads.z=::", "'' is not a value with a unit"),
        ("loads.z=0:nan:1", "'nan N' is not a value with a unit"),
        ("loads.z=5:5:1", "the step does not lead from start to stop"),
        ("loads.z=0:5:-1", "the step does not lead from start to stop"),
        ("loads.z=0:1e9:1e-3", "are too many; at most 20000"),
    ],
)
def test_what_is_no_sweep_is_refused_with_its_text(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as fault:
        parse_sweep(text, Owner)
    assert str(fault.value).startswith(f"--sweep {text}: ") and message in str(fault.value)

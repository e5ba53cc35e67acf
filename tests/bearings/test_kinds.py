"""What a bearing takes from the rotor it stands on."""

from __future__ import annotations

import math

from labpipe.bearings.kinds import OperatingPoint, frequency_hz, synchronous


def test_speed_and_frequency_in_hertz() -> None:
    # 3000 rpm are 50 turns per second; 1 rad/s is 1 / (2 pi) Hz.
    point = OperatingPoint(load=(0.0, -10.0), speed=100 * math.pi, frequency=1.0)
    assert math.isclose(synchronous(point), 50.0) and math.isclose(frequency_hz(point), 0.15915494309189535)

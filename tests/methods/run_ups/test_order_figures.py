"""Figures of order tracking hold the tracked amplitudes, the whole motion and the orbits."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.run_ups.orders import gap_figure, orbit_series_figure, order_figure
from labpipe.records.response import Port
from labpipe.spectra.orders import OrderTrack, Plane

TIME = np.arange(5.0)
SPEED = np.linspace(10.0, 50.0, 5)
PLANE = Plane("front", (0, 1), (0.0, np.pi / 2))
X = 1e-6 * np.column_stack([np.linspace(1, 5, 5) + 0j, 2j * np.ones(5)])


def track(
    speed: np.ndarray = SPEED, amplitude: np.ndarray = X, labels: tuple[str, str] = ("x", "y")
) -> OrderTrack:
    ports = tuple(Port(label, label, label) for label in labels)
    variance = np.full(amplitude.shape, 2e-14)
    return OrderTrack(
        order=1.0,
        time=TIME,
        speed=speed,
        amplitude=amplitude,
        variance=variance,
        ports=ports,
        overall=1.5 * np.abs(amplitude),
        orbit=6e-6 * np.ones((5, 1)),
        mean=np.zeros(amplitude.shape),
        planes=(PLANE,),
    )


def test_amplitude_phase_and_circles_over_the_speed() -> None:
    circles = track(labels=("f", "b"))
    amplitude, phase, planes = order_figure("run", track(), (circles,), "displacement").graphic.panels
    series = {part.name: part for part in amplitude.series}
    assert amplitude.x.label == "speed [rpm]" and amplitude.y.label == "amplitude [um]"
    np.testing.assert_allclose(series["x"].x, 60 * SPEED)
    np.testing.assert_allclose(series["x"].y, [1, 2, 3, 4, 5])
    # Two standard deviations of 0.1 um along the value.
    np.testing.assert_allclose(series["x"].high - series["x"].y, 0.2)
    np.testing.assert_allclose(series["x, whole motion"].y, [1.5, 3, 4.5, 6, 7.5])
    assert {part.name: part.y[0] for part in phase.series} == {"x": 0.0, "y": pytest.approx(90.0)}
    assert (
        [part.name for part in planes.series] == ["f", "b"]
        and planes.y.low == 0.0
        and planes.y.high == pytest.approx(1.3 * 5.2)
    )


def test_a_steady_speed_is_drawn_over_the_time_and_mixed_quantities_in_si() -> None:
    amplitude = order_figure("run", track(np.full(5, 25.0)), (), "").graphic.panels[0]
    assert (
        amplitude.x.label == "time [s]"
        and amplitude.y.label == "amplitude [SI]"
        and amplitude.series[0].y[4] == pytest.approx(5e-6)
    )


def test_orbits_stand_against_the_gap_and_its_limit() -> None:
    (panel,) = gap_figure("run", track(), (track(labels=("f", "b")),), 60e-6, 0.5).graphic.panels
    series = {part.name: part for part in panel.series}
    np.testing.assert_allclose(series["front, whole motion"].y, 10.0)
    np.testing.assert_allclose(series["front, order 1"].y, 100 * np.array([3, 4, 5, 6, 7]) / 60)
    assert (
        series["50 % of the gap"].kind == "hline"
        and series["50 % of the gap"].y == [50.0]
        and panel.y.high == pytest.approx(57.5)
    )


def test_an_orbit_is_the_sum_of_both_circles() -> None:
    chart = orbit_series_figure("run", track(labels=("f", "b")), "displacement").graphic
    assert (chart.rows, chart.columns, len(chart.panels), chart.shared) == (2, 4, 5, "xy")
    panel = chart.panels[2]
    path, pulse = panel.series
    turn = np.linspace(0, 2 * np.pi, 181)
    # f = 3 um, b = 2j um: x = 3 cos - 2 sin, y = 3 sin - 2 cos.
    np.testing.assert_allclose(path.x, 3 * np.cos(turn) - 2 * np.sin(turn), atol=1e-12)
    np.testing.assert_allclose(path.y, 3 * np.sin(turn) - 2 * np.cos(turn), atol=1e-12)
    assert (
        (pulse.x[0], pulse.y[0]) == pytest.approx((3.0, -2.0)) and panel.title == "1800 rpm" and panel.equal
    )

"""Planes of a shaft by the names and angles of their dofs; the whole motion beside the order."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.records.recording import Channel, Recording
from labpipe.records.response import Port
from labpipe.spectra.orders import plane_track, planes_of, track_order
from labpipe.spectra.settings import ShaftLines


def ports(*dofs: str, angles: dict[str, float] | None = None) -> list[Port]:
    known = {"x": 0.0, "y": np.pi / 2, **(angles or {})}
    return [Port(dof, dof, dof, known.get(dof)) for dof in dofs]


@pytest.mark.parametrize(
    ("dofs", "names"),
    [
        (("x", "y"), [""]),
        (("x", "y", "z"), [""]),
        (("front.x", "rear.x", "front.y", "rear.y", "z"), ["front", "rear"]),
        (("front.x", "front.y", "rear.x"), ["front"]),
        (("x", "z"), []),
        (("a", "b"), []),
        (("front.x", "front.z"), []),
        (("bearing.1.x", "bearing.1.y"), ["bearing.1"]),
    ],
)
def test_planes_are_found_by_the_dofs(dofs: tuple[str, ...], names: list[str]) -> None:
    found = planes_of(ports(*dofs))
    assert [plane.name for plane in found] == names
    for plane in found:
        assert [dofs[column].rpartition(".")[2] for column in plane.columns] == ["x", "y"]


def test_angles_make_a_plane_unless_they_are_one() -> None:
    (plane,) = planes_of(ports("45 deg", "135 deg", angles={"45 deg": np.pi / 4, "135 deg": 3 * np.pi / 4}))
    np.testing.assert_allclose(plane.directions, np.array([[1, 1], [-1, 1]]) / np.sqrt(2))
    assert planes_of(ports("0 deg", "180 deg", angles={"0 deg": 0.0, "180 deg": np.pi})) == ()
    assert (plane.label("f"), planes_of(ports("front.x", "front.y"))[0].label("f")) == ("f", "front:f")


def test_whole_motion_and_orbit_of_two_ends() -> None:
    """Front: forward 30 um, backward 10 um, and 20 um of 2x forward; rear: half of it without 2x. Offsets
    count for nothing.

    Orbit by its closed form: |f| + |b| = 15 + 5 um at the rear; at the front the radius over a fine grid.
    """
    rate, speed = 10_000.0, 40.0
    turn = 2j * np.pi * speed * np.arange(50_000) / rate
    front = 30e-6 * np.exp(turn) + 10e-6 * np.exp(-turn) + 20e-6 * np.exp(2 * turn)
    rear = 0.5 * (30e-6 * np.exp(turn) + 10e-6 * np.exp(-turn))
    labels = ("front.x", "front.y", "rear.x", "rear.y")
    channels = tuple(Channel(label, "displacement", "output", label) for label in labels)
    samples = np.column_stack([front.real + 1e-3, front.imag, rear.real, rear.imag - 2e-3])
    track = track_order(Recording(channels, samples, rate, "run"), ShaftLines(speed=speed, harmonics=2))
    assert [plane.name for plane in track.planes] == ["front", "rear"]
    fine = np.exp(1j * np.linspace(0, 2 * np.pi, 20_000))
    path = 30e-6 * fine + 10e-6 / fine + 20e-6 * fine**2
    middle = (path.real.min() + path.real.max()) / 2 + 1j * (path.imag.min() + path.imag.max()) / 2
    np.testing.assert_allclose(track.orbit[:, 0], np.max(np.abs(path - middle)), rtol=2e-3)
    np.testing.assert_allclose(track.orbit[:, 1], 20e-6, rtol=1e-3)
    np.testing.assert_allclose(track.overall[:, 0], np.ptp(path.real) / 2, rtol=1e-3)
    circles = plane_track(track, track.planes[0])
    assert [port.label for port in circles.ports] == ["front:f", "front:b"]
    np.testing.assert_allclose(
        np.abs(circles.amplitude), np.tile([30e-6, 10e-6], (circles.time.size, 1)), rtol=1e-9
    )

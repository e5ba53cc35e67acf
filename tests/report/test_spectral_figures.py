"""Directional responses, distortion and partial coherence in the report.

Figures compared with closed forms of one rotor.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe import __version__
from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.document.render import html_report
from labpipe.records.identification import Identification
from labpipe.records.recording import Channel
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.spectra import ChannelSpectra
from labpipe.report import figures
from labpipe.report.document import Figure, Paragraph, Table
from labpipe.report.measurement import (
    channel_blocks,
    distortion_figure,
    half_axes,
    orbit,
    orbit_figure,
    resonances,
    spectral_blocks,
    two_sided_figure,
)
from labpipe.spectra.convert import directional

FREQUENCY = np.arange(30.0, 131.0, 0.5)
K, C, MASS = np.diag([620e3, 690e3]), np.diag([100.0, 100.0]), 2.4


def response(stiffness: np.ndarray = K) -> FrequencyResponse:
    w = 2 * np.pi * FREQUENCY[:, None, None]
    h = np.linalg.inv(stiffness + 1j * w * C - w**2 * MASS * np.eye(2))
    ports = Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2)
    return FrequencyResponse(
        FREQUENCY, h, ports, ports, covariance=diagonal_covariance(np.full(h.shape, 1e-16)), name="run 1"
    )


def curves(figure: Figure, panel: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(series.x, series.y) for series in figure.graphic.panels[panel].series if series.kind == "line"]


def test_resonances_of_an_isotropic_rotor_are_those_of_one_dof() -> None:
    found = resonances(directional(response(620e3 * np.eye(2))))
    f_0, zeta = np.sqrt(620e3 / MASS) / (2 * np.pi), 100 / (2 * np.sqrt(620e3 * MASS))
    assert set(found) == {"f", "b"}
    for peak in found.values():
        # The receptance's peak lies at f_0 sqrt(1 - 2 zeta^2), its half-power points beside f_0 sqrt(1 +- 2
        # zeta).
        assert peak.frequency == pytest.approx(f_0 * np.sqrt(1 - 2 * zeta**2), rel=1e-4)
        assert peak.damping_ratio == pytest.approx(zeta, rel=0.02)


def test_a_resonance_at_the_end_of_the_band_is_none() -> None:
    low = response()
    cut = directional(replace(low, frequency=FREQUENCY[:90], matrix=low.matrix[:90], covariance=None))
    assert resonances(cut) == {}
    blocks = spectral_blocks(cut)
    assert [type(block) for block in blocks] == [Figure, Paragraph]


def test_both_sides_stand_apart_and_half_power_points_on_the_curve() -> None:
    turned = directional(response())
    figure = two_sided_figure(turned, resonances(turned))
    lines = curves(figure)
    assert len(lines) == 4
    # Nothing stands between the sides, where nothing was measured.
    n = FREQUENCY.size
    assert np.isnan(lines[0][0][n]) and np.isnan(lines[0][1][n])
    (backward_f, backward), (forward_f, forward) = (
        (lines[0][0][side], lines[0][1][side]) for side in (slice(0, n), slice(n + 1, None))
    )
    assert np.all(backward_f < 0) and np.all(forward_f > 0)
    np.testing.assert_allclose(forward, 1e6 * np.abs(turned.matrix[:, 0, 0]), rtol=1e-12)
    np.testing.assert_allclose(backward[::-1], 1e6 * np.abs(turned.matrix[:, 1, 1]), rtol=1e-12)
    marks, levels = lines[2]
    assert levels[1] / levels[0] == levels[1] / levels[2] == pytest.approx(np.sqrt(2))
    np.testing.assert_allclose(levels, np.interp(marks, forward_f, forward), rtol=2e-3)


def test_an_orbit_is_the_motion_under_a_turning_force() -> None:
    plain, turned = response(), directional(response())
    theta = np.linspace(0, 2 * np.pi, 181)
    for column, force in ((0, [1, -1j]), (1, [1, 1j])):
        # Forward: f_x = cos, f_y = sin; backward: f_y = -sin.
        expected = (plain.matrix[100] @ np.array(force))[:, None] * np.exp(1j * theta)
        np.testing.assert_allclose(
            orbit(turned.matrix[100, :, column]), expected.real, rtol=1e-12, atol=1e-20
        )
    # Equal stiffness both ways: a circle, run through in the force's own sense.
    path = orbit(directional(response(620e3 * np.eye(2))).matrix[100, :, 1])
    np.testing.assert_allclose(np.hypot(*path), np.hypot(*path)[0], rtol=1e-12)
    assert np.all(path[0, :-1] * path[1, 1:] - path[1, :-1] * path[0, 1:] < 0)


def test_orbits_are_drawn_at_resonance_and_half_power_points() -> None:
    turned = directional(response())
    found = resonances(turned)
    figure = orbit_figure(turned, found)
    assert len(figure.graphic.panels) == 2 and all(panel.equal for panel in figure.graphic.panels)
    labels = list(dict.fromkeys(series.name for series in figure.graphic.panels[0].series if series.name))
    nearest = [
        FREQUENCY[np.argmin(abs(FREQUENCY - f))]
        for f in (found["f"].low, found["f"].frequency, found["f"].high)
    ]
    assert labels == [f"{frequency:g} Hz" for frequency in nearest]
    x, y = curves(figure)[0]
    line = int(np.argmin(abs(FREQUENCY - found["f"].low)))
    np.testing.assert_allclose([x, y], 1e6 * orbit(turned.matrix[line, :, 0]), rtol=1e-12)
    (first, *_) = (series for series in figure.graphic.panels[0].series if series.kind == "arrow")
    np.testing.assert_array_equal(first.x, x[[8, 12]])


def test_distortion_and_noise_are_the_parts_of_the_deviation() -> None:
    plain = response()
    level = np.full(plain.matrix.shape, 6e-9)
    level[:10] = 0.0
    figure = distortion_figure(replace(plain, distortion=level))
    lines = curves(figure)
    assert len(lines) == 12
    # sqrt((10 nm)^2 - (6 nm)^2) = 8 nm; no distortion is no point on a logarithmic axis.
    np.testing.assert_allclose(lines[1][1][10:], 6e-3, rtol=1e-12)
    assert np.all(np.isnan(lines[1][1][:10]))
    np.testing.assert_allclose(lines[2][1], np.where(np.arange(FREQUENCY.size) < 10, 10e-3, 8e-3), rtol=1e-9)


def test_signal_and_noise_of_a_channel_are_both_rms() -> None:
    """Two lines of 3 um from 0 to peak have 3 um rms; noise of E|e|^2 = 2 um^2 has 1."""
    channel = Channel("y", "displacement", "output", "y")
    spectra = ChannelSpectra(
        np.array([1.0, 2.0]), np.full((2, 1, 1), 3e-6), np.full((2, 1, 1, 1), 2e-12), (channel,), ("a",)
    )
    table = channel_blocks(spectra)[1]
    assert isinstance(table, Table) and table.rows[0][3:6] == ("3", "1", "2.12")


def test_a_log_that_repeats_exactly_has_no_noise() -> None:
    """What rounding leaves would stretch the axis of all channels to 1e-19."""
    channels = tuple(Channel(name, "current", "output", name) for name in "ri")
    covariance = np.zeros((2, 1, 2, 2))
    covariance[..., 0, 0], covariance[..., 1, 1] = 1e-37, 1e-8
    spectra = ChannelSpectra(np.array([1.0, 2.0]), np.full((2, 1, 2), 0.1), covariance, channels, ("a",))
    figure, table = channel_blocks(spectra)[2], channel_blocks(spectra)[1]
    assert isinstance(table, Table) and [row[4:6] for row in table.rows] == [
        ("0", "-"),
        ("7.07e-05", "1e+03"),
    ]
    assert isinstance(figure, Figure)
    shown = np.concatenate([series.y for series in figure.graphic.panels[0].series])
    assert np.nanmin(shown) > 1e-5


def test_what_stands_below_a_response() -> None:
    plain = response()
    assert spectral_blocks(plain) == ()
    assert [type(block) for block in spectral_blocks(directional(plain))] == [Figure, Table, Figure]
    assert [
        type(block) for block in spectral_blocks(replace(plain, distortion=np.full(plain.matrix.shape, 1e-9)))
    ] == [Figure]
    text = html_report(Identification((), "Rotor", responses=(directional(plain),))).decode()
    assert (
        "Resonances and half-power points" in text and "H_bb (backward)" in text and "Orbits of run 1" in text
    )


def test_partial_coherence_takes_the_place_of_ordinary_where_there_are_several_forces() -> None:
    plain = response()
    both = replace(
        plain, coherence=np.full(plain.matrix.shape, 0.5), partial_coherence=np.full(plain.matrix.shape, 0.9)
    )
    figure = figures.response_figure(both)
    assert figure.graphic.panels[1].y.label == "partial coherence" and curves(figure, 1)[0][1][0] == 0.9
    ordinary = figures.response_figure(replace(both, partial_coherence=None))
    assert ordinary.graphic.panels[1].y.label == "coherence" and "the other forces" not in ordinary.caption


def test_a_report_made_later_from_the_file_shows_the_same(tmp_path: Path) -> None:
    plain = response()
    both = replace(
        plain,
        distortion=np.full(plain.matrix.shape, 1e-9),
        partial_coherence=np.full(plain.matrix.shape, 0.9),
    )
    now = Identification((), "Rotor", responses=(both, directional(plain)), version=__version__)
    write_identification(tmp_path / "identification.json", now)
    assert html_report(read_identification(tmp_path / "identification.json")) == html_report(now)


@pytest.mark.parametrize(("turn", "minor"), [(1, 1.0), (-1, -1.0)])
def test_a_minor_half_axis_is_negative_where_the_orbit_turns_from_y_to_x(turn: int, minor: float) -> None:
    """x = 3 cos wt and y = sin wt turns from x to y; the samples themselves give the sense."""
    motion = np.array([3.0, -1j * turn])
    x, y = (motion[:, None] * np.exp(1j * np.array([0.0, 0.1]))).real
    assert np.sign(x[0] * y[1] - y[0] * x[1]) == turn
    assert half_axes(motion) == (pytest.approx(3.0), pytest.approx(minor))

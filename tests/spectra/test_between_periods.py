"""Runout beside periodic excitation: taken out without loss, and lines on which it cannot be told are dropped
or said.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.methods.floating_bearing.virtual_rig import FLOATING_RIG, FloatingRig
from labpipe.project.simulate import load_virtual_rig
from labpipe.records.recording import Channel, Recording
from labpipe.records.spectra import ChannelSpectra
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, ShaftLines
from labpipe.spectra.shaft import ShaftMotion
from labpipe.spectra.synchronous import smooth_motion

CONFIG = Path(__file__).parents[2] / "configs/virtual-floating.yaml"
RUNS = ("seal-plus", "seal-minus")
PERIODIC = FrfSettings("periodic", period="1 s", skip=0, band="10-100 Hz", result="spectra")
TACHO = ShaftLines(tacho="n", harmonics=2)


def turning(speed: float, **changes: object) -> FloatingRig:
    """The shipped seal at another speed: runout of 5 um at 1x and 2 um at 2x, an unbalance, noise of 0.2
    um.
    """
    rig = load_virtual_rig(CONFIG)
    assert isinstance(rig, FloatingRig)
    conditions = tuple((name, replace(condition, speed=speed)) for name, condition in rig.conditions)
    return replace(rig, conditions=conditions, **changes)  # type: ignore[arg-type]


def spectra(rig: FloatingRig, remove: ShaftLines | None, seed: int) -> ChannelSpectra:
    return channel_spectra(recordings(rig, seed, RUNS), replace(PERIODIC, remove=remove))


def errors(found: ChannelSpectra, exact: ChannelSpectra) -> tuple[np.ndarray, float]:
    """Root mean square error of every channel against the same excitation without noise, and e^H C^-1 e over
    the channels.
    """
    common = np.isin(np.round(exact.frequency, 6), np.round(found.frequency, 6))
    e = found.vectors - exact.vectors[common]
    chi2 = np.einsum("lrc,lrcd,lrd->lr", e.conj(), np.linalg.inv(found.covariance), e).real / 6
    return np.sqrt(np.mean(np.abs(e) ** 2, axis=(0, 1))), float(np.mean(chi2))


def shaft_lines(found: ChannelSpectra) -> list[str]:
    return [finding.message for finding in found.findings if finding.code == "shaft-line"]


@pytest.mark.parametrize(
    ("speed", "remove", "lines"),
    [(100 / 3, ShaftLines(speed=100 / 3 + 0.004, harmonics=2), 91), (33.5, TACHO, 90), (33.0, TACHO, 89)],
)
def test_runout_is_taken_out_without_loss(speed: float, remove: ShaftLines, lines: int) -> None:
    """As exact as recordings without runout and unbalance, with the same noise: within 2 %, and their
    covariance holds (nu / (nu - 6)).

    By the tacho or a given speed that is a little wrong; lines on 1x or 2x are dropped.
    """
    on, off = turning(speed), turning(speed, runout=(), unbalance=0.0)
    with_runout, without = [], []
    for seed in range(4):
        exact = spectra(FLOATING_RIG.noisy(off, 1e-6), None, seed)
        found = spectra(on, remove, seed)
        assert found.frequency.size == lines and len(shaft_lines(found)) == 2 * (91 - lines)
        with_runout.append(errors(found, exact))
        without.append(errors(spectra(off, None, seed), exact))
    ratio = np.mean([rmse for rmse, _ in with_runout], axis=0) / np.mean(
        [rmse for rmse, _ in without], axis=0
    )
    assert np.all(np.abs(ratio - 1) < 0.02)
    assert np.mean([chi2 for _, chi2 in with_runout]) == pytest.approx(154 / 148, abs=0.08)


def test_runout_on_an_excited_line_is_said_even_where_nothing_is_set() -> None:
    """33 Hz and 66 Hz, every run.

    The error is a hundred times the noise, and the scatter between periods does not show it.
    """
    exact = spectra(FLOATING_RIG.noisy(turning(33.0, runout=(), unbalance=0.0), 1e-6), None, 1)
    found = spectra(turning(33.0), None, 1)
    rmse, chi2 = errors(found, exact)
    assert chi2 > 1000 and rmse[2] > 100 * np.sqrt(np.mean(found.covariance[:, :, 2, 2].real))
    said = shaft_lines(found)
    assert (
        len(said) == 4 and "seal-plus: the excited line 33 Hz lies on 1x of the shaft's 33 Hz by n" in said[0]
    )
    assert not shaft_lines(spectra(turning(100 / 3), None, 1))


def test_a_dropped_line_is_named() -> None:
    found = spectra(turning(33.0), TACHO, 1)
    assert 33.0 not in np.round(found.frequency, 6) and 66.0 not in np.round(found.frequency, 6)
    assert "seal-plus: the excited line 33 Hz lies on 1x of the shaft's" in shaft_lines(found)[0]
    removed = [finding.message for finding in found.findings if finding.code == "synchronous-removed"]
    assert len(removed) == 12


def test_nothing_is_taken_out_where_the_tacho_stands_still() -> None:
    """A baseline beside tests of a turning shaft, under the same settings.

    Noise on the tacho is not a speed either.
    """
    still = turning(0.0)
    plain, found = spectra(still, None, 2), spectra(still, TACHO, 2)
    np.testing.assert_array_equal(found.vectors, plain.vectors)
    assert "the tacho n shows no revolution" in found.findings[0].message and not shaft_lines(plain)
    rng = np.random.default_rng(1)
    noisy = [
        replace(run, samples=run.samples + 1e-3 * rng.normal(size=run.samples.shape))
        for run in recordings(still, 2, RUNS)
    ]
    assert not shaft_lines(channel_spectra(noisy, PERIODIC))


def test_a_given_speed_without_runout_follows_no_noise() -> None:
    """Nothing turns: the given speed is kept, the vectors as good as they were."""
    still = turning(0.0, runout=(), unbalance=0.0)
    plain, found = spectra(still, None, 2), spectra(still, ShaftLines(speed=40.3, harmonics=2), 2)
    exact = spectra(FLOATING_RIG.noisy(still, 1e-6), None, 2)
    np.testing.assert_allclose(errors(found, exact)[0], errors(plain, exact)[0], rtol=0.02)


def test_a_response_matrix_loses_its_runout_too() -> None:
    """f and d alone as an FRF: its error against the matrix without noise is that without runout."""
    plain = FrfSettings("periodic", period="1 s", skip=0, band="10-100 Hz")
    off = turning(100 / 3, runout=(), unbalance=0.0)

    def matrix(rig: FloatingRig, remove: ShaftLines | None) -> np.ndarray:
        kept = []
        for run in recordings(rig, 1, RUNS):
            columns = [number for number, channel in enumerate(run.channels) if channel.name[0] in "fdn"]
            channels: tuple[Channel, ...] = tuple(run.channels[number] for number in columns)
            kept.append(Recording(channels, run.samples[:, columns], run.sample_rate, run.name))
        return measure(kept, replace(plain, remove=remove)).matrix

    exact = matrix(FLOATING_RIG.noisy(off, 1e-6), None)
    left_in, removed, without = (
        np.sqrt(np.mean(np.abs(matrix(rig, remove) - exact) ** 2))
        for rig, remove in ((turning(100 / 3), None), (turning(100 / 3), TACHO), (off, None))
    )
    assert removed == pytest.approx(without, rel=0.02) and left_in > 5 * without


def test_too_few_periods_are_refused() -> None:
    with pytest.raises(DataError, match="too few to tell the shaft from it"):
        channel_spectra(recordings(turning(33.3), 1, RUNS), replace(PERIODIC, remove=TACHO, skip=7))


def test_the_scatter_of_pulses_is_smoothed_and_a_real_course_kept() -> None:
    """Pulses rounded to samples of 1 ms: a steady and a slowly rising speed within a tenth of the rounding.

    A fast wave as it is.
    """
    exact = np.arange(1, 200) / 33.3
    steady = smooth_motion(ShaftMotion(np.round(exact, 3), np.arange(199.0)), 1000.0)
    assert np.max(np.abs(np.diff(steady.speeds))) < 1e-9 and np.mean(steady.speeds) == pytest.approx(
        33.3, rel=1e-4
    )
    t = np.linspace(0, 6, 60001)
    counts = 33 * t + 0.2 * t**2
    times = np.interp(np.arange(1, 200), counts, t)
    rising = smooth_motion(ShaftMotion(np.round(times, 3), np.arange(1.0, 200.0)), 1000.0)
    assert np.max(np.abs(rising.revolutions - np.interp(rising.times, t, counts))) < 0.01
    waving = ShaftMotion(exact + 0.01 * np.sin(2 * np.pi * 5 * exact), np.arange(199.0))
    assert smooth_motion(waving, 1000.0) is waving


def test_the_angle_of_a_curved_run_up_is_as_right_as_stated() -> None:
    """Counts of a speed that rises with the power 1.5 of time, in closed form, pulses known to a sample of
    2560 Hz. Lines between them, and a polynomial of eight degrees, are several standard errors off.
    """
    off = []
    for seed in range(10):
        turns = np.random.default_rng(seed).uniform() + np.arange(1, 2080)
        times = np.linspace(0, 60, 600_001)
        counts = 8 * times + 67 / 60**1.5 * times**2.5 / 2.5
        pulses = (np.floor(2560 * np.interp(turns, counts, times)) + 0.5) / 2560
        smooth = smooth_motion(ShaftMotion(pulses, turns), 2560.0)
        at = np.linspace(pulses[0], pulses[-1], 301)
        assert smooth.std_error is not None
        error = smooth.angle(at) / (2 * np.pi) - np.interp(at, times, counts)
        off.append(error / np.interp(at, smooth.times, smooth.std_error))
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.3)


def test_a_line_is_named_where_a_force_acts_alone() -> None:
    """One force at odd lines in the first recording and at even ones in the second: the shaft's 33 Hz is
    excited in one of them, its 66 Hz in the other.
    """
    rig = turning(33.0)
    names = [channel.name for channel in rig_channels(rig)]
    plus, minus = (
        with_lines(run, kept, [n for n, name in enumerate(names) if name.startswith("f")])
        for run, kept in zip(recordings(rig, 1, RUNS), (1, 0), strict=True)
    )
    said = shaft_lines(channel_spectra([plus, minus], PERIODIC))
    assert [(text.split(":")[0], text.split()[4]) for text in said] == [
        ("seal-plus", "33"),
        ("seal-minus", "66"),
    ]


def rig_channels(rig: FloatingRig) -> tuple[Channel, ...]:
    return recordings(rig, 1, RUNS)[0].channels


def with_lines(run: Recording, rest: int, forces: list[int]) -> Recording:
    """The recording whose force has the lines of 1 s that leave this rest by two alone."""
    samples = run.samples.copy()
    count = round(run.sample_rate)
    for column in forces:
        periods = samples[:, column].reshape(-1, count)
        noise = periods - periods.mean(axis=0)
        lines = np.fft.rfft(periods.mean(axis=0))
        lines[np.arange(lines.size) % 2 != rest] = 0.0
        samples[:, column] = (np.fft.irfft(lines, count) + noise).ravel()
    return replace(run, samples=samples)

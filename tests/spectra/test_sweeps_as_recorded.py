"""Swept sines as laboratories record them, on a simulated plate whose resonances take the force of its shaker
along: the force all but vanishes there, and one sweep looks like many.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.sweeps import find_sweeps

RATE, LENGTH, TOP = 2048.0, 20.0, 500.0
CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("a", "acceleration", "output", "x", 0.0))
# Natural frequency [Hz], damping ratio, share of a modal mass of 4 kg; 6 kg of rigid body; armature [kg].
MODES = (
    (45.0, 0.010, 1.0),
    (110.0, 0.006, 0.64),
    (170.0, 0.005, 0.81),
    (204.0, 0.004, 0.49),
    (212.0, 0.004, 0.64),
    (330.0, 0.004, 0.81),
    (410.0, 0.003, 0.49),
)
ARMATURE = 0.5
N = int(LENGTH * RATE)
TIME = np.arange(N) / RATE
# Linear from 0 Hz, as signal generators begin, and logarithmic from 2 Hz.
LINEAR = np.sin(np.pi * TOP / LENGTH * TIME**2)
GROWTH = np.log(TOP / 2) / LENGTH
LOGARITHMIC = np.sin(4 * np.pi * np.expm1(GROWTH * TIME) / GROWTH)
SHORT = np.sin(np.pi * TOP / (0.75 * LENGTH) * TIME[: 3 * N // 4] ** 2)
FALL, REST = 10 ** (-TIME / LENGTH), np.zeros(6 * int(RATE))
# What the shaker gets, and the sweeps in it: whole ones, parts that the record cuts.
DRIVES = {
    "linear": ([LINEAR, REST], 1, 0),
    "logarithmic": ([LOGARITHMIC, REST], 1, 0),
    "falling tenfold": ([LINEAR * FALL, REST], 1, 0),
    "down": ([LINEAR[::-1], REST], 1, 0),
    "repeated with a pause": ([LINEAR, REST, LINEAR, REST], 2, 0),
    "repeated without a pause": ([LINEAR, LINEAR, LINEAR], 3, 0),
    "up and down": ([LINEAR, LINEAR[::-1], REST], 2, 0),
    "of unequal lengths": ([LINEAR, REST, SHORT, REST], 2, 0),
    "begun within one": ([LINEAR[N // 2 :], LINEAR, REST], 1, 1),
    "ended within one": ([LINEAR, LINEAR[: N // 3]], 1, 1),
    "alone": ([LINEAR], 1, 0),
    "alone, logarithmic": ([LOGARITHMIC], 1, 0),
}


def accelerance(frequency: np.ndarray) -> np.ndarray:
    w = 2 * np.pi * frequency
    modes = [
        share / 4.0 / ((2 * np.pi * f) ** 2 - w**2 + 2j * zeta * 2 * np.pi * f * w)
        for f, zeta, share in MODES
    ]
    return np.asarray(1 / 6.0 - w**2 * np.sum(modes, axis=0))


def recorded(parts: list[np.ndarray]) -> np.ndarray:
    """Force and acceleration (n, 2) from rest, with 1 % of noise; the force is the drive over 1 + m A."""
    drive = np.concatenate([np.zeros(300), *parts])
    n = 2 * drive.size
    a = accelerance(fft.rfftfreq(n, 1 / RATE))
    force = fft.rfft(drive, n) / (1 + ARMATURE * a)
    columns = np.stack([fft.irfft(values, n)[: drive.size] for values in (force, force * a)], axis=1)
    noise = np.random.default_rng(3).normal(size=columns.shape)
    return np.asarray(columns + 0.01 * columns.std(axis=0) * noise)


@pytest.mark.parametrize("name", DRIVES)
def test_all_of_the_excited_range_is_one_sweep(name: str) -> None:
    """By the drive: as many sweeps as it has, of 15 Hz or less to 480 Hz or more, or its part."""
    parts, whole, cut = DRIVES[name]
    sweeps = find_sweeps(recorded(parts)[:, 0])
    complete = [sweep for sweep in sweeps if RATE * sweep.low < 16 and RATE * sweep.high > 480]
    assert (len(complete), len(sweeps)) == (whole, whole + cut)


@pytest.mark.parametrize(
    "name",
    [
        "linear",
        "falling tenfold",
        "repeated without a pause",
        "of unequal lengths",
        "begun within one",
        "ended within one",
        "alone",
        "alone, logarithmic",
    ],
)
def test_the_frf_is_that_of_the_plate_within_its_covariance(name: str) -> None:
    """Closed form of the plate: |H - A|^2 over the variance is 1 in the mean, and no line of the band is
    missing, those swept at an end of the record among them.
    """
    parts, whole, cut = DRIVES[name]
    recording = Recording(CHANNELS, recorded(parts), RATE, "plate")
    response = measure([recording], FrfSettings("sweep", band=(15.0, 495.0)))
    error = np.abs(response.matrix[:, 0, 0] - accelerance(response.frequency)) ** 2
    assert response.covariance is not None
    assert np.mean(error / response.covariance[:, 0, 0].real) == pytest.approx(1.0, abs=0.25)
    spacing = np.diff(response.frequency)
    assert response.frequency[0] < 15.5 and response.frequency[-1] > 494.5 and spacing.max() < 0.5
    (described,) = (finding.message for finding in response.findings if finding.code == "sweeps")
    assert f"{whole} sweep(s)" in described
    is_cut = "left out, since the record cuts it" in described
    assert is_cut == bool(cut)


def test_sweeps_from_rest_to_rest_are_repeats_and_lose_no_lines() -> None:
    """Three recordings of a sweep that is over 4 to 6 s before their end, against the closed form."""
    recordings = [
        Recording(CHANNELS, recorded([LINEAR, REST[: int(rest * RATE)]]), RATE, f"plate {rest}")
        for rest in (4.0, 5.0, 6.0)
    ]
    response = measure(recordings, FrfSettings("sweep", band=(15.0, 495.0)))
    assert response.repeat_names == ("sweep 1", "sweep 2", "sweep 3") and response.repeats_are == "sweeps"
    assert not [finding for finding in response.findings if finding.code == "sweep-leakage"]
    assert np.max(np.diff(response.frequency)) < 1.5 * np.min(np.diff(response.frequency))
    for repeat in response.repeats:
        error = np.abs(repeat[:, 0, 0] - accelerance(response.frequency))
        assert np.median(error / np.abs(accelerance(response.frequency))) < 0.05

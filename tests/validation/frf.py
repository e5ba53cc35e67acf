"""Frequency responses: printed figures of windows, closed forms of estimators, scipy's spectra, a measured
FRF.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import signal

from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.welch import WelchAverage
from labpipe.spectra.windows import noise_bandwidth, overlap_correlation, window_values
from tests.validation.claims import Claim, Method, within, worst
from tests.validation.peers import recorded, words
from tests.validation.shipped import LINE, PACKAGE, last_hit, variables

HARRIS = "Harris 1978, table 1"
# Equivalent noise bandwidth [lines], correlation at 75 % and 50 % overlap [per cent].
PRINTED = {
    "boxcar": (1.00, 75.0, 50.0),
    "bartlett": (1.33, 71.9, 25.0),
    "hann": (1.50, 65.9, 16.7),
    "hamming": (1.36, 70.7, 23.5),
}
FORCE, X = Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0)


def windows() -> list[Claim]:
    """Half a printed digit each; a row per quantity, and one for the figure that is off."""
    columns: dict[str, list[Claim]] = {
        "equivalent noise bandwidth": [],
        "correlation at 75 % overlap": [],
        "correlation at 50 % overlap": [],
    }
    for name, printed in PRINTED.items():
        window = window_values(name, 4096)
        quarter = 100 * np.sqrt(overlap_correlation(window, 1024))
        why = (
            "the sum in closed form, (a^2/2 - b^2/4) / (a^2 + b^2/2) with a = 0.54, b = 0.46, is 23.4 %"
            if name == "hamming"
            else ""
        )
        kind = "printed calculation"
        values = (
            (noise_bandwidth(window), 0.0051, "lines", ""),
            (quarter[0], 0.051, "%", ""),
            (quarter[1], 0.051, "%", why),
        )
        for column, reference, (value, tolerance, unit, off) in zip(
            columns.values(), printed, values, strict=True
        ):
            column.append(within(name, value, reference, tolerance, unit, kind, HARRIS, off))
    off = columns["correlation at 50 % overlap"].pop()
    return [
        *(worst(column, title) for title, column in columns.items()),
        replace(off, quantity="correlation at 50 % overlap, hamming"),
    ]


def spectra() -> list[Claim]:
    """All cross-spectra of three channels of noise by Welch's method against scipy.signal.csd: the largest
    difference of any line.
    """
    samples, found = np.random.default_rng(7).normal(size=(1000, 3)), []
    for window, step in (("hann", 32), ("boxcar", 64), ("flattop", 21)):
        average = WelchAverage(window_values(window, 64), step, 3)
        average.add(samples)
        ours = average.spectra(100.0).matrix[:-1]
        # scipy conjugates the first argument, and does not double the line at half the sampling rate, which
        # no measurement uses.
        asked = {"fs": 100.0, "window": window, "nperseg": 64, "noverlap": 64 - step, "detrend": "constant"}
        peer = [
            [signal.csd(samples[:, b], samples[:, a], **asked)[1][1:-1] for b in range(3)] for a in range(3)
        ]
        theirs = np.moveaxis(np.array(peer), 2, 0)
        difference = 100 * np.max(np.abs(ours - theirs)) / np.max(np.abs(theirs))
        found.append(
            within(
                f"largest difference, {window}",
                difference,
                0.0,
                1e-6,
                "% of the largest",
                "peer program",
                "scipy.signal.csd",
            )
        )
    return found


def noisy_gain(share: float) -> Recording:
    """y = 1e-6 u in metres, both sensors with noise of *share* of their rms; unit white force."""
    rng = np.random.default_rng(31)
    u, noise = rng.normal(size=40_000), share * rng.normal(size=(40_000, 2))
    return Recording((FORCE, X), np.column_stack([u + noise[:, 0], 1e-6 * (u + noise[:, 1])]), 256.0, "run")


def estimators() -> list[Claim]:
    """Half of the rms as noise on both sides: H1 is low by 1 / 1.25, H2 high by as much, Hv right."""
    found, recording = [], noisy_gain(0.5)
    for name, expected in (("H1", 1 / 1.25), ("H2", 1.25), ("Hv", 1.0)):
        response = measure([recording], FrfSettings(excitation="random", block=1.0, estimator=name))
        found.append(
            within(
                f"mean gain by {name}",
                np.mean(response.matrix.real) / 1e-6,
                expected,
                0.01,
                "1",
                "closed form",
                "bias of the estimator",
            )
        )
    return found


def delays() -> list[Claim]:
    """Three samples of 512 Hz late: the phase at 60 Hz is -2 pi 60 3 / 512, with a minus."""
    rng, found = np.random.default_rng(35), []
    n, period = 8192, 512
    forces = {
        "random": rng.normal(size=n),
        "periodic": np.tile(rng.normal(size=period), n // period),
        "impact": (np.arange(n) % 1024 == 200).astype(float),
    }
    for excitation, u in forces.items():
        length = {"period" if excitation == "periodic" else "block": 1.0}
        recording = Recording((FORCE, X), np.column_stack([u, np.roll(u, 3)]), 512.0, "run")
        response = measure([recording], FrfSettings(excitation=excitation, band=(5.0, 60.0), **length))
        phase = np.degrees(np.angle(response.matrix[:, 0, 0]))
        each = [
            within(f"{line:.0f} Hz", value, -360 * line * 3 / 512, 3.0, "deg", "closed form", "e^(-jwd)")
            for line, value in zip(response.frequency.tolist(), phase, strict=True)
        ]
        found.append(worst(each, f"phase of a delay, {excitation}"))
    return found


def measured() -> list[Claim]:
    """One hit on a beam against the analyser's average of many: the highest line and its height."""
    of = variables("case1.mat")
    analyser = np.abs(of["Hf_chan_2"].ravel())
    theirs = 640 + int(np.argmax(analyser[640:705]))
    response = measure([last_hit()], FrfSettings("impact", block=3.2, estimator="H1", band=(200.0, 220.0)))
    line = int(np.argmax(np.abs(response.matrix[:, 0, 0])))
    kind, height = "measured public data", 100 * np.abs(response.matrix[line, 0, 0]) / analyser[theirs]
    why = (
        "the recording begins within the pulse of the hammer, whose rise the analyser had and its file "
        "has not: the force is too small"
    )
    return [
        within(
            "highest line of the FRF, one hit",
            response.frequency[line],
            theirs * LINE,
            LINE / 2,
            "Hz",
            kind,
            f"{PACKAGE}, case1",
        ),
        within(
            "its height, one hit", height, 100.0, 5.0, "% of the analyser's", kind, f"{PACKAGE}, case1", why
        ),
    ]


def recorded_elsewhere() -> list[Claim]:
    """FRFs of measurements by others, whose files are not shipped: from the record."""
    sets, kind, note = recorded("measured")["sets"], "measured public data", words("measured")
    return [
        within(
            "an analyser's FRF from all of its recording, 5 to 480 Hz, median difference",
            1e6 * sets["piezo"]["spectra"]["median difference"],
            0.0,
            1000.0,
            "10^-6 of |H|",
            kind,
            "SSCSA",
            recorded=note,
        ),
        within(
            "lines at which two halves of a record differ by less than their 95 % regions",
            100 * sets["bench"]["spectra"]["lines held"],
            95.0,
            5.0,
            "%",
            kind,
            "FdiTools, multisines A and B",
            recorded=note,
        ),
    ]


METHOD = Method(
    "frf",
    "Frequency responses",
    {
        "windows": windows,
        "spectra": spectra,
        "estimators": estimators,
        "delays": delays,
        "measured": measured,
        "recorded": recorded_elsewhere,
    },
)

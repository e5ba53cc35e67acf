"""Predicted over observed variance of the FRF lies within 0.9 and 1.1 for every window and overlap offered.

Independent calculation: the scatter of many simulated measurements of a filter with a known response, noise
on the response.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

RATE, N, REPEATS = 128.0, 1920, 80
CHANNELS = (
    Channel("fx", "force", "input", "x", 0.0),
    Channel("fy", "force", "input", "y", np.pi / 2),
    Channel("x", "displacement", "output", "x", 0.0),
)


def recording(rng: np.random.Generator) -> Recording:
    forces = rng.normal(size=(N, 2))
    y = signal.lfilter([1.0, 0.4], [1.0, -0.3], forces[:, 0]) + 0.5 * forces[:, 1] + 0.7 * rng.normal(size=N)
    return Recording(CHANNELS, np.column_stack([forces, y]), RATE, "run")


WINDOWS = ("boxcar", "hann", "hamming", "blackman", "flattop", "bartlett", "kaiser 8", "tukey 0.5")
OVERLAPS = (0.0, 0.25, 0.5, 0.67, 0.75)
QUICK = (("boxcar", 0.0), ("hann", 0.5), ("kaiser 8", 0.75))
# Every window where blocks share most, and every overlap of a narrow one.
LONG = {*((window, 0.75) for window in WINDOWS), *(("flattop", overlap) for overlap in OVERLAPS)}
CASES = [*QUICK, *(pytest.param(*case, marks=pytest.mark.long) for case in sorted(LONG - {*QUICK}))]


@pytest.mark.parametrize(("window", "overlap"), CASES)
def test_predicted_variance_is_that_of_repeats(window: str, overlap: float) -> None:
    rng = np.random.default_rng(41)
    settings = FrfSettings(excitation="random", block=0.5, window=window, overlap=overlap, band=(6.0, 58.0))
    responses = [measure([recording(rng)], settings) for _ in range(REPEATS)]
    matrices = np.array([response.matrix for response in responses])
    predicted = np.mean([response.variance for response in responses], axis=0)
    ratio = np.mean(predicted / matrices.var(axis=0, ddof=1))
    assert 0.9 < ratio < 1.1

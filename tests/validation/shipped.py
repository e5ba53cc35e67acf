"""Measured files inside the package vibrationtesting (J. C.

Slater, MIT licence), which the tests have installed.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import files
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port

PACKAGE = "vibrationtesting"
# The mode that the package's documentation prints for the averaged FRF of case1, and its distance between
# lines [Hz].
PRINTED_MODE, LINE = 212.0925, 0.3125


def shipped(name: str) -> Path:
    (found,) = (path for path in files(PACKAGE) or () if path.name == name)
    return Path(str(found.locate()))


@cache
def variables(name: str) -> dict[str, np.ndarray]:
    return {key: value for key, value in loadmat(shipped(name)).items() if isinstance(value, np.ndarray)}


def analysed() -> FrequencyResponse:
    """The FRF that the analyser averaged, 1600 lines."""
    of = variables("case1.mat")
    port = (Port("y", "y", "y", None),)
    frequency = of["Freq_domain"].ravel()[1:].astype(float)
    return FrequencyResponse(frequency, of["Hf_chan_2"][1:, :, None], port, port, form="receptance")


def last_hit() -> Recording:
    """Force and acceleration of the last hit, 3.2 s at 1280 Hz."""
    of = variables("case1.mat")
    samples = np.column_stack([of["Time_chan_1"], of["Time_chan_2"]]).astype(float)
    return Recording(
        (Channel("f", "force", "input", "y", 0.0), Channel("a", "acceleration", "output", "y", 0.0)),
        samples,
        1280.0,
        "case1",
    )

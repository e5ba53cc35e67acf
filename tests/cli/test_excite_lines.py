"""Detection lines of labpipe excite: what is left out of the file's spectrum.

And its sweeps, against scipy.signal.chirp.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import signal as scipy_signal


def test_one_line_of_every_group_is_left_out(tmp_path: Path, labpipe) -> None:
    wanted = (
        "--band",
        "1-80 Hz",
        "--spacing",
        "1 Hz",
        "--rate",
        "200 Hz",
        "--periods",
        1,
        "--odd",
        "--leave-out",
        4,
        "--seed",
        3,
    )
    ended = labpipe("excite", "-o", tmp_path / "a.csv", *wanted)
    assert ended.code == 0 and "31 lines, 1-79 Hz" in ended.out
    signal = np.genfromtxt(tmp_path / "a.csv", delimiter=",", skip_header=1)[:, -1]
    size = np.abs(np.fft.rfft(signal))
    present = np.flatnonzero(size > 1e-3 * size.max())
    # 40 odd lines; nine whole groups of four between the first line and the last lose one each.
    assert present.size == 31 and np.all(present % 2 == 1) and {1, 79} <= set(present)
    assert labpipe("excite", "-o", tmp_path / "b.csv", *wanted[:-4], "--leave-out", 1).code == 2


@pytest.mark.parametrize("phases", ["schroeder", "random", "optimised"])
@pytest.mark.parametrize("rate", ["210 Hz", "1 kHz", "30.5 kHz"])
def test_the_crest_factor_bounds_the_peak_of_the_file_at_any_rate(
    tmp_path: Path, labpipe, phases: str, rate: str
) -> None:
    wanted = (
        "--band",
        "20-100 Hz",
        "--spacing",
        "2 Hz",
        "--rate",
        rate,
        "--periods",
        1,
        "--level",
        "3 V",
        "--phases",
        phases,
    )
    ended = labpipe("excite", "-o", tmp_path / "s.csv", *wanted)
    signal = np.genfromtxt(tmp_path / "s.csv", delimiter=",", skip_header=1)[:, -1]
    # Three decimals are printed. At 305 samples and more per period of the highest line the bound is the
    # peak.
    peak, told = np.abs(signal).max() / 3, float(ended.out.rsplit(" ", 1)[1])
    assert peak <= told + 5e-4 and (rate != "30.5 kHz" or told <= peak * (1 + 2e-4) + 5e-4)


@pytest.mark.parametrize(("law", "named"), [("linear", "4.9 Hz/s"), ("logarithmic", "33.9 octaves/min")])
def test_sweeps_are_chirps_with_pauses(tmp_path: Path, labpipe, law: str, named: str) -> None:
    """Up, then down, 1 V rms, 10 s each and 2 s of pause.

    Away from the fades the chirp of scipy, shifted by a quarter of a turn.
    """
    wanted = (
        "--sweep",
        law,
        "--direction",
        "up-down",
        "--band",
        "1-50 Hz",
        "--rate",
        "1 kHz",
        "--length",
        "10 s",
        "--pause",
        "2 s",
    )
    ended = labpipe("excite", "-o", tmp_path / "s.csv", *wanted, "--periods", 2)
    assert ended.code == 0 and f"2 sweep(s) up-down, 1-50 Hz, {law}, {named}; pauses of 2 s" in ended.out
    signal = np.genfromtxt(tmp_path / "s.csv", delimiter=",", skip_header=1)[:, -1]
    t = np.arange(10_000) / 1000
    assert signal.size == 24_000 and np.all(signal[10_000:12_000] == 0) and np.all(signal[22_000:] == 0)
    for start, (first, last) in ((0, (1, 50)), (12_000, (50, 1))):
        chirp = np.sqrt(2) * scipy_signal.chirp(t, first, 10, last, method=law, phi=-90)
        np.testing.assert_allclose(signal[start : start + 10_000][200:-200], chirp[200:-200], atol=1e-9)
    for option, value in (("--length", "0 s"), ("--pause", "-1 s"), ("--rate", "90 Hz")):
        assert labpipe("excite", "-o", tmp_path / "b.csv", *wanted, option, value).code == 2
    assert not (tmp_path / "b.csv").exists()

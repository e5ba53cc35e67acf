"""Speed as ratios within one run. The figures are printed.

Only gross failures (four times the usual ratio) fail the test.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy import fft, signal

from labpipe.spectra.welch import WelchAverage
from labpipe.spectra.windows import window_values


def cpu_seconds(action: Callable[[], object], repeats: int = 5) -> float:
    """Median CPU time of an action."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return statistics.median(times)


def test_help_against_an_empty_python() -> None:
    def seconds(code: str) -> float:
        times = []
        for _ in range(7):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
            times.append(time.perf_counter() - start)
        return min(times)

    ratio = seconds("from labpipe.cli.main import run_command; run_command(['--help'])") / seconds("pass")
    print(f"labpipe --help takes {ratio:.2f} times python -c pass (goal 4)")
    assert ratio < 16


def test_welch_against_the_bare_ffts_and_scipy(capsys) -> None:  # type: ignore[no-untyped-def]
    samples = np.random.default_rng(1).normal(size=(200_000, 4))
    n, step = 5120, 2560
    window = window_values("hann", n)

    def ours() -> None:
        average = WelchAverage(window, step, 4)
        for start in range(0, samples.shape[0], 65536):
            average.add(samples[start : start + 65536])
        average.spectra(1024.0)

    def bare() -> None:
        columns = np.ascontiguousarray(samples.T)
        for start in range(0, samples.shape[0] - n + 1, step):
            fft.rfft(columns[:, start : start + n], axis=1)

    def pair_by_pair() -> None:
        for a in range(4):
            for b in range(a, 4):
                signal.csd(samples[:, a], samples[:, b], fs=1024.0, nperseg=n, noverlap=n - step)

    floor, own, peer = cpu_seconds(bare), cpu_seconds(ours), cpu_seconds(pair_by_pair)
    with capsys.disabled():
        print(
            f"\ncross-spectra of 4 channels: {own / floor:.2f} times the bare FFTs; scipy.signal.csd "
            f"{peer / floor:.1f} times"
        )
    assert own < 16 * floor

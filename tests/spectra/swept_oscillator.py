"""A sweep on a simulated oscillator of 1 kg: its response by the closed form of H, over a time in which it
dies out.
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from labpipe.raw_files.excitation import Sweep
from labpipe.records.recording import Channel, Recording

RATE, F_N, ZETA = 512.0, 40.0, 0.02
W_N = 2 * np.pi * F_N
TRUTH = np.array([W_N**2, 2 * ZETA * W_N, F_N])
CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))
BAND = (20.0, 80.0)


def receptance(frequency: np.ndarray, zeta: float = ZETA) -> np.ndarray:
    w = 2 * np.pi * frequency
    return 1 / (W_N**2 - w**2 + 2j * zeta * W_N * w)


def motion(force: np.ndarray, rate: float = RATE, zeta: float = ZETA) -> np.ndarray:
    """Displacement [m] from rest: the product with H over so long a time that all has died out, and nothing
    comes round.
    """
    n = force.size + int(20 / (zeta * W_N) * rate)
    spectrum = fft.rfft(force, n) * receptance(fft.rfftfreq(n, 1 / rate), zeta)
    return fft.irfft(spectrum, n)[: force.size]


def record(
    seed: int, sweep: Sweep, count: int = 1, noise: tuple[float, float] = (0.0, 0.01), zeta: float = ZETA
) -> Recording:
    """*count* sweeps; noise of force and displacement, white, relative to their rms."""
    rng = np.random.default_rng([71, seed])
    force = sweep.samples(RATE, count)
    x = motion(force, zeta=zeta)
    columns = [
        force + noise[0] * force.std() * rng.normal(size=x.size),
        x + noise[1] * x.std() * rng.normal(size=x.size),
    ]
    return Recording(CHANNELS, np.column_stack(columns), RATE, "sweep")

"""A stepped sine on a simulated oscillator of 1 kg: steady state and transient of every dwell in closed form,
as expected values.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.records.recording import Channel, Recording

RATE, F_N, ZETA = 1000.0, 40.0, 0.02
W_N = 2 * np.pi * F_N
TRUTH = np.array([W_N**2, 2 * ZETA * W_N])
POLE = -ZETA * W_N + 1j * W_N * np.sqrt(1 - ZETA**2)
CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))
STEPS = np.arange(31.0, 49.5, 1.0)


def receptance(frequency: np.ndarray) -> np.ndarray:
    w = 2 * np.pi * frequency
    return 1 / (W_N**2 - w**2 + 2j * ZETA * W_N * w)


def motion(
    steps: Sequence[float], lengths: Sequence[float], rate: float = RATE
) -> tuple[np.ndarray, np.ndarray]:
    """Force [N] without jump of its phase, and displacement [m]: Re(H F e^(jwt)) + Re(C e^(pt)), C from the
    state before the step.
    """
    phase, x, v = 0.0, 0.0, 0.0
    forces, responses, start, number = [], [], 0.0, 0
    for f, length in zip(steps, lengths, strict=True):
        w, end = 2 * np.pi * f, start + length
        stop = int(np.ceil(end * rate))
        t = np.append(np.arange(number, stop) / rate, end) - start
        drive = np.exp(1j * (w * t + phase))
        gain = receptance(np.array([f]))[0]
        steady, at_step = gain * drive, gain * np.exp(1j * phase)
        # Re(C) and Re(p C) are what the steady state lacks of the state at the step.
        missing, slope = x - at_step.real, v - (1j * w * at_step).real
        free = (missing + 1j * (POLE.real * missing - slope) / POLE.imag) * np.exp(POLE * t)
        forces.append(drive[:-1].real)
        responses.append((steady + free)[:-1].real)
        x, v = (steady + free)[-1].real, (1j * w * steady + POLE * free)[-1].real
        phase, start, number = phase + w * length, end, stop
    return np.concatenate(forces), np.concatenate(responses)


def record(
    seed: int,
    steps: Sequence[float] = tuple(STEPS),
    lengths: Sequence[float] | float = 2.5,
    noise: tuple[float, float] = (0.01, 0.01),
) -> Recording:
    """Noise of the force, relative to it, and of the displacement, relative to its rms over all dwells."""
    rng = np.random.default_rng([57, seed])
    force, x = motion(steps, np.broadcast_to(lengths, (len(steps),)))
    columns = [force + noise[0] * rng.normal(size=x.size), x + noise[1] * x.std() * rng.normal(size=x.size)]
    return Recording(CHANNELS, np.column_stack(columns), RATE, "steps")

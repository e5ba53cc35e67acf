"""A planned test as it would be recorded if its noise were known: means free of noise, periods that scatter as the noise does.

Channel c has in period p of P, beside its signal, a_c exp(2 pi j c p / P) on every line. Over the periods these have the mean zero and are
orthogonal to each other, so that the average is what the rig does, and its covariance by the scatter, a_c^2 / (P - 1), that of white noise
in every sensor. What evaluates a recording, and its uncertainty budget, then give what is expected of the real one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray
from labpipe.errors import ConfigError
from labpipe.planner.campaigns import Rig
from labpipe.planner.schemes import Multisines
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES

# Periods beyond the number of channels: degrees of freedom of their covariance.
SPARE = 4
# Samples per period over the highest line.
SAMPLES = 2.6


def rehearsed(rig: Rig, test: Multisines, channels: Sequence[Channel], seconds: float, skip: int, highest: int) -> Recording:
    """The recording of *test* by *channels*, its noise that of an average over *seconds* [s], after *skip* periods that are dropped.

    highest: line of all tests, which have one sampling rate. ConfigError for a response whose noise the plan does not state.
    """
    density = {"force": rig.noise.force, "displacement": rig.noise.displacement, "acceleration": rig.noise.acceleration}
    mean = np.stack([_amplitudes(rig, test, channel) for channel in channels], axis=1)
    n_period, n_channel = len(channels) + SPARE, len(channels)
    n_sample = fft.next_fast_len(int(SAMPLES * highest) + 8, real=True)
    size = np.array([density[channel.quantity] for channel in channels]) * np.sqrt(2 / seconds * (n_period - 1))
    number = np.arange(1, n_channel + 1)
    periods = []
    for period in range(n_period):
        spectrum = np.zeros((n_sample // 2 + 1, n_channel), complex)
        spectrum[test.lines] = mean
        spectrum[1 : (n_sample + 1) // 2] += size * np.exp(2j * np.pi * number * period / n_period)
        periods.append(fft.irfft(spectrum * (n_sample / 2), n_sample, axis=0))
    samples = np.concatenate([periods[0]] * skip + periods)
    return Recording(tuple(channels), samples, n_sample * rig.spacing, test.name)


def _amplitudes(rig: Rig, test: Multisines, channel: Channel) -> ComplexArray:
    """Of what a channel measures, (n_line,) [SI]."""
    if channel.quantity == "force":
        return _force(rig, test, channel)
    along = rig.motion(test) @ _direction(channel, rig.model.n_dof)
    if channel.quantity == "displacement":
        return np.asarray(along)
    if channel.quantity == "acceleration":
        return np.asarray(-(rig.omega(test) ** 2) * along)
    raise ConfigError(f"the plan states no noise of {channel.name}, a {channel.quantity}", hint="displacement or acceleration", field="rig")


def _force(rig: Rig, test: Multisines, channel: Channel) -> ComplexArray:
    """That of the shaker whose direction the channel has, or of a pedestal's only one; zero where that does not run."""
    shaker = rig.shakers.index(channel.dof) if channel.dof in rig.shakers else 0
    return np.asarray(test.forces[:, shaker])


def _direction(channel: Channel, n_dof: int) -> ComplexArray:
    if n_dof == 1:
        return np.ones(1, complex)
    angle = AXIS_ANGLES[channel.dof] if channel.angle is None else channel.angle
    return np.array([np.cos(angle), np.sin(angle)], complex)

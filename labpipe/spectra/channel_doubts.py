"""What the doubts of channels' calibrations do to the vector of all channels: errors of gain, delay, phase and direction."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.records.channel_spectra import UncertainFactor
from labpipe.records.doubt import COURSES, ChannelDoubt
from labpipe.records.recording import Channel
from labpipe.records.rig import AXIS_ANGLES

Row = Callable[[Sequence[Channel], int], ComplexArray]


def calibration_factors(channels: Sequence[Channel], combined: ComplexArray) -> tuple[UncertainFactor, ...]:
    """One factor for each doubt of a recorded channel; numbers of one source have one name, and so one error.

    channels: all of the vector, the recorded ones first; *combined* (n_channel, n_recorded) [SI units]: sums from recorded channels.
    """
    n_recorded = combined.shape[1]
    return tuple(
        UncertainFactor(doubt.doubt.source, 0.0, doubt.doubt.std_error, doubt.doubt.unit, derivative, power, doubt.doubt.source)
        for number, channel in enumerate(channels[:n_recorded])
        for doubt in channel.doubts
        for derivative, power in [_derivative(channels, combined, number, doubt)]
        if np.any(derivative)
    )


def _derivative(channels: Sequence[Channel], combined: ComplexArray, number: int, doubt: ChannelDoubt) -> tuple[ComplexArray, int]:
    """The change of the vector per unit of the error, and the power of the angular frequency that goes with it."""
    row, power = np.zeros(combined.shape[0], np.complex128), 0
    if doubt.effect == "direction":
        row += _turned(channels[: combined.shape[1]], number, combined.shape[0])
    else:
        row[number], power = COURSES[doubt.effect]
    return np.outer(combined[:, number], row), power


def _turned(channels: Sequence[Channel], number: int, size: int) -> ComplexArray:
    """The motion at right angles to a channel, from it and the one other of its quantity in a known direction; zero without one.

    A sensor at theta + d reads X(theta) + d X(theta + 90 deg).
    """
    row = np.zeros(size, np.complex128)
    known = {n: angle for n, one in enumerate(channels) if one.quantity == channels[number].quantity and (angle := _angle(one)) is not None}
    if number not in known or len(known) != 2:
        return row
    (other,) = known.keys() - {number}
    angle, pair = known[number], [number, other]
    angles = np.array([angle, known[other]])
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    if abs(np.linalg.det(directions)) > np.sin(np.deg2rad(1)):
        row[pair] = -np.array([-np.sin(angle), np.cos(angle)]) @ np.linalg.inv(directions)
    return row


def _angle(channel: Channel) -> float | None:
    return AXIS_ANGLES.get(channel.dof) if channel.angle is None else channel.angle

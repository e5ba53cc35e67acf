"""What the doubts of channels' calibrations do to the vector of all channels: errors of gain, delay, phase and direction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.records.channel_spectra import UncertainFactor
from labpipe.records.doubt import COURSES, ChannelDoubt
from labpipe.records.recording import Channel
from labpipe.records.rig import AXIS_ANGLES

FORCE = "force"


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
    n_channel, n_recorded = combined.shape
    if doubt.effect == "direction":
        change = np.zeros((n_recorded, n_channel), np.complex128)
        change[:, :n_recorded] = turned_channels(channels[:n_recorded], number)
        return combined @ change, 0
    row = np.zeros(n_channel, np.complex128)
    row[number], power = COURSES[doubt.effect]
    return np.outer(combined[:, number], row), power


def turned_channels(channels: Sequence[Channel], number: int) -> FloatArray:
    """Change (n, n) [1/rad] of all recorded *channels* by all of them, where the angle of one is written too large; zero where not known.

    Needed is the one other channel of its quantity in a known direction. A sensor at theta + d reads X(theta) + d X(theta + 90 deg). Forces
    f_j along n_j add up: f_j along n_j + d m_j, m_j at right angles, is f_j m_j d more, in components along all n.
    """
    change = np.zeros((len(channels), len(channels)))
    known_angles = {
        n: angle
        for n, channel in enumerate(channels)
        if channel.quantity == channels[number].quantity and (angle := _angle(channel)) is not None
    }
    if number not in known_angles or len(known_angles) != 2:
        return change
    pair = list(known_angles)
    angles = np.array(list(known_angles.values()))
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    if abs(np.linalg.det(directions)) <= np.sin(np.deg2rad(1)):
        return change
    across = np.array([-np.sin(known_angles[number]), np.cos(known_angles[number])])
    if channels[number].quantity == FORCE:
        change[pair, number] = np.linalg.solve(directions.T, across)
    else:
        change[number, pair] = -across @ np.linalg.inv(directions)
    return change


def _angle(channel: Channel) -> float | None:
    return AXIS_ANGLES.get(channel.dof) if channel.angle is None else channel.angle

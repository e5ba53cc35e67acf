"""Channels of recordings on their way to spectra: blocks, sums of channels, uncertainties of their
calibration.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, Number, SampleSource
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.spectra import UncertainFactor
from labpipe.records.uncertain import COURSES, ChannelUncertainty

# Samples of a block: a few blocks fit into the cache together with their spectra.
READ_SAMPLES = 1 << 17


class DerivedRecording:
    """What a recording that is made of another *source* takes over from it; with `blocks` a SampleSource."""

    def __init__(self, source: SampleSource) -> None:
        self.source, self.channels, self.name = source, source.channels, source.name
        self.sample_rate, self.n_sample = source.sample_rate, source.n_sample

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Those of the source, which reading it may add to."""
        return self.source.findings


def columns_of(channels: Sequence[Channel], role: str) -> list[int]:
    """The columns of the *channels* of a *role*: input, output or reference."""
    return [number for number, channel in enumerate(channels) if channel.role == role]


def checked_blocks(source: SampleSource) -> Iterator[FloatArray]:
    """The recording's blocks (n, n_channel) [unit of the channel]. DataError at the first sample that is no
    number, and at the end for a force that does not vary.
    """
    start = 0
    silent: dict[int, float] = {}
    for block in source.blocks(READ_SAMPLES):
        # The sum is not finite if any sample is missing; only then is the sample searched for.
        with np.errstate(over="ignore", invalid="ignore"):
            total = block.sum()
        if not np.isfinite(total):
            refuse_missing(source, block, range(block.shape[1]), start)
        if start == 0:
            silent = {column: block[0, column] for column in columns_of(source.channels, "input")}
        silent = {column: level for column, level in silent.items() if np.all(block[:, column] == level)}
        start += block.shape[0]
        yield block
    for column in silent:
        what = f"the force channel '{source.channels[column].name}' of '{source.name}' does not vary"
        raise DataError(what, hint="is the sensor connected?")


def refuse_missing(source: SampleSource, block: FloatArray, columns: Sequence[int], start: int = 0) -> None:
    """DataError at the first sample that is not a number of a *block* (n, n_column) [unit of the channel]
    from sample *start* on.
    """
    missing = np.argwhere(~np.isfinite(block))
    if not missing.size:
        return
    sample, column = (int(n) for n in missing[0])
    where = f"sample {start + sample} ({(start + sample) / source.sample_rate:g} s)"
    hint = "labpipe does not fill gaps; cut the recording there or record it again"
    name = source.channels[columns[column]].name
    what = f"channel '{name}' of '{source.name}' has no number at {where}"
    # Of joined files the one that holds the channel.
    raise DataError(what, getattr(source, "files", {}).get(name, ""), hint)


FORCE = "force"


def calibration_factors(channels: Sequence[Channel], combined: ComplexArray) -> tuple[UncertainFactor, ...]:
    """One factor for each uncertainty of a recorded channel; numbers of one source have one name, and so one
    error. channels: all of the vector, the recorded ones first; *combined* (n_channel, n_recorded) [SI
    units]: sums from recorded channels.
    """
    factors = []
    for number, channel in enumerate(channels[: combined.shape[1]]):
        for calibration in channel.uncertainties:
            derivative, power = _derivative(channels, combined, number, calibration)
            if np.any(derivative):
                source, error = calibration.uncertainty.source, calibration.uncertainty.std_error
                unit = calibration.uncertainty.unit
                factors.append(UncertainFactor(source, 0.0, error, unit, derivative, power, source))
    return tuple(factors)


def _derivative(
    channels: Sequence[Channel], combined: ComplexArray, number: int, uncertainty: ChannelUncertainty
) -> tuple[ComplexArray, int]:
    n_channel, n_recorded = combined.shape
    if uncertainty.effect == "direction":
        change = np.zeros((n_recorded, n_channel), np.complex128)
        change[:, :n_recorded] = turned_channels(channels[:n_recorded], number)
        return combined @ change, 0
    row = np.zeros(n_channel, np.complex128)
    row[number], power = COURSES[uncertainty.effect]
    return np.outer(combined[:, number], row), power


def turned_channels(channels: Sequence[Channel], number: int) -> FloatArray:
    """Change (n, n) [1/rad] of all recorded *channels* by all of them, where the angle of one is written too
    large; zero where not known. Needed is the one other channel of its quantity in a known direction. A
    sensor at theta + d reads X(theta) + d X(theta + 90 deg). Forces f_j along n_j add up: f_j along n_j + d
    m_j, m_j at right angles, is f_j m_j d more, in components along all n.
    """
    change = np.zeros((len(channels), len(channels)))
    angles_of = [AXIS_ANGLES.get(c.dof) if c.angle is None else c.angle for c in channels]
    known_angles = {
        n: angle
        for n, (channel, angle) in enumerate(zip(channels, angles_of, strict=True))
        if channel.quantity == channels[number].quantity and angle is not None
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


class Lags:
    """Channels moved forward by the whole samples of their delays, block by block. What is left of a delay
    stays that of the channel.
    """

    def __init__(self, channels: Sequence[Channel], sample_rate: float) -> None:
        delays = np.array([channel.delay for channel in channels])
        late = np.round(sample_rate * delays)
        self._lags = (late - np.min(late)).astype(int)
        left = np.round(delays - self._lags / sample_rate, 12)
        self.channels = tuple(
            replace(channel, delay=float(delay)) if lag else channel
            for channel, delay, lag in zip(channels, left, self._lags, strict=True)
        )
        self.most = int(np.max(self._lags))
        self.restart()

    def restart(self) -> None:
        """Forget the samples that wait for late channels."""
        self._rest: FloatArray = np.empty((0, self._lags.size))

    def add(self, block: FloatArray) -> FloatArray:
        """The next samples that all channels have, with the *block*: (n, n_channel) [SI]."""
        if not self.most:
            return block
        samples = np.concatenate([self._rest, block])
        n = max(samples.shape[0] - self.most, 0)
        self._rest = samples[n:]
        return np.column_stack([c[lag : lag + n] for c, lag in zip(samples.T, self._lags, strict=True)])


class InTime(DerivedRecording):
    """A recording with its channels moved by their Lags; satisfies SampleSource."""

    def __init__(self, source: SampleSource) -> None:
        super().__init__(source)
        lags = Lags(source.channels, source.sample_rate)
        self.channels, self.n_sample = lags.channels, max(source.n_sample - lags.most, 0)

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks of at most *n_sample* samples, (n, n_channel) [SI]."""
        lags = Lags(self.source.channels, self.sample_rate)
        yield from (moved for block in self.source.blocks(n_sample) if (moved := lags.add(block)).size)


def in_time(sources: Sequence[SampleSource]) -> list[SampleSource]:
    """The recordings, each InTime where a channel is late by half a sample or more beside another."""
    moved = [InTime(source) for source in sources]
    return [new if new.channels != old.channels else old for new, old in zip(moved, sources, strict=True)]


def check_in_time(source: SampleSource, used: Iterable[Channel]) -> None:
    """DataError for a sum in use whose members have different delays or frequency responses: made sample by
    sample it is not the sum.
    """
    by_name = {channel.name: channel for channel in source.channels}
    for channel in used:
        members = [by_name[term.channel] for term in channel.terms if term.channel in by_name]
        if len({(member.delay, member.response) for member in members}) > 1:
            chains = ", ".join(
                f"{c.name}: {1e6 * c.delay:g} us{' and a response table' if c.response else ''}"
                for c in members
            )
            what = (
                f"channel '{channel.name}' is a sum of channels with different delays or frequency "
                f"responses ({chains})"
            )
            raise DataError(
                what, hint="frf: {result: spectra} sums them line by line after their corrections"
            )


def uncertain_numbers(channels: Iterable[Channel]) -> dict[Number, list[Channel]]:
    """The numbers with an uncertainty in sums of channels, each with the sums that it stands in."""
    used: dict[Number, list[Channel]] = {}
    for channel in channels:
        for number in dict.fromkeys(number for term in channel.terms for number in term.numbers):
            used.setdefault(number, []).append(channel)
    return used


def uncertainty_findings(sources: Sequence[SampleSource]) -> tuple[Finding, ...]:
    """Of sums that are inputs or outputs: uncertainties of their members' directions that no one channel
    across them propagates.
    """
    channels = dict.fromkeys(
        channel for source in sources for channel in source.channels if channel.role != "reference"
    )
    turned = {name for source in sources for name in _lone_directions(source.channels)}
    members = {
        channel.name: names
        for channel in channels
        if (names := [term.channel for term in channel.terms if term.channel in turned])
    }
    return tuple(
        Finding(
            "number-uncertainty",
            f"uncertainties of the direction of {', '.join(names)} in {name}: no one other channel of the "
            "quantity in a known direction "
            "tells what is read across, and they are not in the intervals of the FRF and of its fits",
        )
        for name, names in members.items()
    )


def _lone_directions(channels: Sequence[Channel]) -> Iterator[str]:
    """Recorded channels whose direction has an uncertainty, and across which no other one measures."""
    recorded = [channel for channel in channels if not channel.terms]
    for number, channel in enumerate(recorded):
        if any(uncertainty.effect == "direction" for uncertainty in channel.uncertainties) and not np.any(
            turned_channels(recorded, number)
        ):
            yield channel.name

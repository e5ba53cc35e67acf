"""A recording: calibrated, uniformly sampled channels of one run, sums of channels, and the overview of a
file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Protocol

import numpy as np

from labpipe.arrays import FloatArray, freeze
from labpipe.errors import DataError
from labpipe.quantities import QUANTITIES
from labpipe.records.finding import Finding
from labpipe.records.text import VIEWS, recording_line
from labpipe.records.uncertain import ChannelUncertainty
from labpipe.registry import nearest


@dataclass(frozen=True)
class Number:
    """A number with its uncertainty that stands in a sum: *value*, *std_error* [unit], an SI unit.

    Numbers of one *source* have one error.
    """

    name: str
    value: float
    std_error: float
    unit: str
    source: str = ""


@dataclass(frozen=True)
class SumTerm:
    """A channel in a sum, times *factor* [SI unit of the sum per SI unit of the channel].

    numbers: those in the factor that have an uncertainty; derivatives: of the factor by each of them.
    """

    channel: str
    factor: float
    numbers: tuple[Number, ...] = ()
    derivatives: tuple[float, ...] = ()

    def times(self, factor: float) -> SumTerm:
        """The term times a number without uncertainty."""
        return SumTerm(
            self.channel,
            factor * self.factor,
            self.numbers,
            tuple(factor * derivative for derivative in self.derivatives),
        )


ROLES = ("input", "output", "reference")


@dataclass(frozen=True)
class Channel:
    """One measured channel in SI units.

    *dof* is a label (``x``, ``y``, ``bearing2.y``); *angle* [rad] from x towards y is set when the direction
    is known as an angle (``dof: 45 deg``; x is 0, y is 90 deg). *role*: input (force), output (response) or
    reference (tacho, temperature, ...). *delay* [s] of the sensor chain and its frequency *response*, rows
    (frequency [Hz], gain [1], phase [rad]), are taken out of the FRF. *terms*: of a channel that is a sum of
    others in the recording; none for a measured one. *uncertainties* of its calibration. *position* [m] along
    the axis, if it is known.
    """

    name: str
    quantity: str
    role: str
    dof: str
    angle: float | None = None
    delay: float = 0.0
    response: tuple[tuple[float, float, float], ...] = ()
    terms: tuple[SumTerm, ...] = ()
    uncertainties: tuple[ChannelUncertainty, ...] = ()
    position: float | None = None

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            what = f"channel '{self.name}' has the unknown quantity '{self.quantity}'"
            raise DataError(what, hint=nearest(self.quantity, QUANTITIES))
        if self.role not in ROLES:
            what = f"channel '{self.name}' has the unknown role '{self.role}'"
            raise DataError(what, hint=nearest(self.role, ROLES))
        object.__setattr__(self, "response", tuple(map(tuple, self.response)))

    @property
    def unit(self) -> str:
        """The SI unit of the samples."""
        return QUANTITIES[self.quantity].si_unit

    @property
    def sensors(self) -> set[str]:
        """The names of the measured channels in it: its own, or those of its terms."""
        return {term.channel for term in self.terms} or {self.name}


class SampleSource(Protocol):
    """What the spectra need of a recording, in memory or on disk: its channels, rate, length and blocks in
    order.
    """

    @property
    def channels(self) -> tuple[Channel, ...]: ...
    @property
    def sample_rate(self) -> float: ...
    @property
    def n_sample(self) -> int: ...
    @property
    def findings(self) -> tuple[Finding, ...]: ...
    @property
    def name(self) -> str: ...
    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks of at most *n_sample* samples, each (n, n_channel) [SI]."""


@dataclass(frozen=True, repr=False)
class Recording:
    """A run in memory: *samples* (n_sample, n_channel) [SI] at *sample_rate* [Hz]. Satisfies SampleSource."""

    channels: tuple[Channel, ...]
    samples: FloatArray
    sample_rate: float
    name: str = ""
    findings: tuple[Finding, ...] = ()
    conditions: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [channel.name for channel in self.channels]
        if len(set(names)) != len(names):
            raise DataError(f"recording '{self.name}' has two channels of one name: {', '.join(names)}")
        if not self.sample_rate > 0:
            raise DataError(f"recording '{self.name}' has the sample rate {self.sample_rate} Hz")
        given = np.shape(self.samples)
        if len(given) == 2 and given[0] == len(names) != given[1]:
            what = f"recording '{self.name}' has the shape {given}, a row for each channel"
            raise DataError(what, hint="a column for each: samples.T")
        shape = (given[0] if given else 0, len(names))
        freeze(self, "samples", np.float64, shape, f"recording '{self.name}'")

    def __repr__(self) -> str:
        return recording_line(self)

    def to_frame(self) -> Any:
        """The channels over time [s] as a pandas data frame [SI units]."""
        return VIEWS["frame"](self)

    @property
    def n_sample(self) -> int:
        """Samples per channel."""
        return int(self.samples.shape[0])

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks (n_sample, n_channel) [SI units] of at most *n_sample* samples."""
        for start in range(0, self.n_sample, n_sample):
            yield self.samples[start : start + n_sample]


# Overview of a file: channels with levels, envelope over time and spectrum, and findings.


@dataclass(frozen=True)
class Envelope:
    """Smallest and largest value of every stretch of *step* samples, (n_stretch,) each [the channel's unit].

    NaN of missing ones.
    """

    step: int
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Spectrum:
    """Root of the power spectral density [unit/Hz^0.5] over *frequency* [Hz], (n_line,) each; mean of
    *blocks*.

    Without a known rate the frequency is in cycles per sample and the density per that.
    """

    frequency: FloatArray
    density: FloatArray
    blocks: int

    def __post_init__(self) -> None:
        n = len(self.frequency)
        for name in ("frequency", "density"):
            freeze(self, name, np.float64, (n,))


@dataclass(frozen=True)
class ChannelOverview:
    """One channel or column: *name*, *unit* as the file states it ('' where it does not), *about* (role and
    dof), levels in that unit.
    """

    name: str
    unit: str
    about: str
    _: KW_ONLY
    minimum: float
    maximum: float
    mean: float
    rms: float
    envelope: Envelope
    spectrum: Spectrum

    @property
    def label(self) -> str:
        """Name and unit, the unit once."""
        return self.name if not self.unit or self.unit in self.name else f"{self.name} [{self.unit}]"


@dataclass(frozen=True)
class Overview:
    """A recording as it lies on disk; *sample_rate* [Hz] or None where nobody knows it, *rate* in words,
    *time*: the time column or ''.

    contradictions: where a rig file says otherwise, in words; None where none was asked.
    """

    file: str
    kind: str
    _: KW_ONLY
    n_sample: int
    sample_rate: float | None
    rate: str
    channels: tuple[ChannelOverview, ...]
    findings: tuple[Finding, ...]
    time: str = ""
    contradictions: tuple[str, ...] | None = None

    @property
    def plotted(self) -> tuple[ChannelOverview, ...]:
        """The channels that are no time."""
        return tuple(channel for channel in self.channels if channel.name != self.time)

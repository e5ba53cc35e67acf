"""A recording: calibrated, uniformly sampled channels of one run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.quantities import QUANTITIES
from labpipe.records.arrays import frozen_array
from labpipe.records.channel_sum import Term, as_terms
from labpipe.records.doubt import ChannelDoubt, as_doubts
from labpipe.records.finding import Finding
from labpipe.records.text import recording_line
from labpipe.records.views import VIEWS

ROLES = ("input", "output", "reference")


@dataclass(frozen=True)
class Channel:
    """One measured channel in SI units.

    *dof* is a label (``x``, ``y``, ``bearing2.y``); *angle* [rad] from x towards y is set when the direction is known as an angle
    (``dof: 45 deg``; x is 0, y is 90 deg). *role*: input (force), output (response) or reference (tacho, temperature, ...).
    *delay* [s] of the sensor chain and its frequency *response*, rows (frequency [Hz], gain [1], phase [rad]), are taken out of the FRF.
    *terms*: of a channel that is a sum of others in the recording; none for a measured one. *doubts* of its calibration.
    *position* [m] along the axis, if it is known.
    """

    name: str
    quantity: str
    role: str
    dof: str
    angle: float | None = None
    delay: float = 0.0
    response: tuple[tuple[float, float, float], ...] = ()
    terms: tuple[Term, ...] = ()
    doubts: tuple[ChannelDoubt, ...] = ()
    position: float | None = None

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise DataError(f"channel '{self.name}' has the unknown quantity '{self.quantity}'")
        if self.role not in ROLES:
            raise DataError(f"channel '{self.name}' has the unknown role '{self.role}'")
        # A file gives lists.
        object.__setattr__(self, "response", tuple(tuple(row) for row in self.response))
        object.__setattr__(self, "terms", as_terms(self.terms))
        object.__setattr__(self, "doubts", as_doubts(self.doubts))

    @property
    def unit(self) -> str:
        """The SI unit of the samples."""
        return QUANTITIES[self.quantity].si_unit


class SampleSource(Protocol):
    """What the spectra need of a recording, in memory or on disk: its channels, rate, length and blocks in order."""

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
        shape = (np.shape(self.samples)[0] if np.ndim(self.samples) else 0, len(names))
        object.__setattr__(self, "samples", frozen_array(self.samples, np.float64, f"recording '{self.name}'", shape))

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

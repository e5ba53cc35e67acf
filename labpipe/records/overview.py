"""Overview of a file: channels with levels, envelope over time and spectrum, and findings."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.records.arrays import frozen_array
from labpipe.records.finding import Finding


@dataclass(frozen=True)
class Envelope:
    """Smallest and largest value of every stretch of *step* samples, (n_stretch,) each [the channel's unit]; NaN of missing ones."""

    step: int
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Spectrum:
    """Root of the power spectral density [unit/Hz^0.5] over *frequency* [Hz], (n_line,) each; mean of *blocks*.

    Without a known rate the frequency is in cycles per sample and the density per that.
    """

    frequency: FloatArray
    density: FloatArray
    blocks: int

    def __post_init__(self) -> None:
        n = len(self.frequency)
        for name in ("frequency", "density"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), np.float64, name, (n,)))


@dataclass(frozen=True)
class ChannelOverview:
    """One channel or column: *name*, *unit* as the file states it ('' where it does not), *about* (role and dof), levels in that unit."""

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
    """A recording as it lies on disk; *sample_rate* [Hz] or None where nobody knows it, *rate* in words, *time*: the time column or ''.

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

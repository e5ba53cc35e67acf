"""Whether a recording was filtered before it was sampled: power next to half the sampling rate beside the power in the band."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from scipy import fft

from labpipe.arrays import FloatArray
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, SampleSource
from labpipe.spectra.windows import hann

# One segment of this length is looked at in every block that is read.
SEGMENT = 1024
SHORTEST = 64
# Above this share of half the sampling rate a filter leaves less than this share of the power density in the band.
TOP_SHARE = 0.95
MOST_POWER = 0.1


class Watched:
    """A recording that keeps the mean power of its channels while it is read; satisfies SampleSource."""

    def __init__(self, source: SampleSource, hits: bool = False) -> None:
        """*hits*: the force is strong for moments only, so a block is looked at where it is strongest."""
        self._source = source
        self._n = min(SEGMENT, 1 << (max(source.n_sample, 1).bit_length() - 1))
        self._window = hann(self._n)[:, None]
        self._forces = [number for number, channel in enumerate(source.channels) if hits and channel.role == "input"]
        self._power = np.zeros((self._n // 2 + 1, len(source.channels)))
        self._n_segment = 0

    @property
    def channels(self) -> tuple[Channel, ...]:
        return self._source.channels

    @property
    def sample_rate(self) -> float:
        return self._source.sample_rate

    @property
    def n_sample(self) -> int:
        return self._source.n_sample

    @property
    def findings(self) -> tuple[Finding, ...]:
        return self._source.findings

    @property
    def name(self) -> str:
        return self._source.name

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """The recording's blocks as they are."""
        for block in self._source.blocks(n_sample):
            if block.shape[0] >= self._n >= SHORTEST:
                self._look(block)
            yield block

    def _look(self, block: FloatArray) -> None:
        strongest = int(np.argmax(np.max(np.abs(block[:, self._forces]), axis=1))) if self._forces else 0
        start = min(max(strongest - self._n // 2, 0), block.shape[0] - self._n)
        segment = block[start : start + self._n]
        self._n_segment += 1
        self._power += np.abs(fft.rfft((segment - segment.mean(axis=0)) * self._window, axis=0)) ** 2

    def powers(self, band: tuple[float, float] | None) -> FloatArray:
        """Power near half the sampling rate and in the band, per line, (2, n_channel) [unit^2]; 0 where nothing was seen to compare."""
        half = self.sample_rate / 2
        frequency = np.arange(self._power.shape[0]) * (self.sample_rate / self._n)
        low, high = band or (0.0, half)
        inside = (frequency >= low) & (frequency <= min(high, TOP_SHARE * half)) & (frequency > 0)
        above = (frequency > max(TOP_SHARE * half, high if band else 0.0)) & (frequency < half)
        if not np.any(inside) or not np.any(above):
            return np.zeros((2, len(self.channels)))
        scale = 1 / max(self._n_segment, 1) / np.sum(self._window**2)
        return scale * np.array([self._power[lines].mean(axis=0) for lines in (above, inside)])


def aliasing_findings(sources: Sequence[Watched], band: tuple[float, float] | None, channels: Collection[str]) -> tuple[Finding, ...]:
    """A warning for every one of *channels* whose power density just below half the sampling rate exceeds a tenth of that in the band.

    What lies above half the sampling rate is folded back there first; a filter before sampling leaves little of either. All
    recordings count together: a direction that a force does not move shows noise only. Forces are often white by design.
    """
    total: dict[str, FloatArray] = {}
    for source in sources:
        for channel, power in zip(source.channels, source.powers(band).T, strict=True):
            if channel.name in channels:
                total[channel.name] = total.get(channel.name, np.zeros(2)) + power
    found = {name: top / own for name, (top, own) in total.items() if top > MOST_POWER * own}
    rate = sources[0].sample_rate if sources else 0.0
    return tuple(
        Finding(
            "aliasing",
            f"channel {name}: the power just below half the sampling rate ({rate / 2:g} Hz) is {100 * share:.0f} % of that in the band, so "
            "frequencies above it are probably folded into the FRF; use the logger's anti-alias filter, or sample faster",
        )
        for name, share in found.items()
    )

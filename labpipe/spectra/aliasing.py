"""Aliasing check: power density just below half the sampling rate against that in the band."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from scipy import fft

from labpipe.arrays import FloatArray
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, SampleSource
from labpipe.spectra.windows import hann

# Length of the segment analysed in every block [samples].
SEGMENT = 1024
SHORTEST = 64
# Above TOP_SHARE of half the sampling rate an anti-alias filter leaves less than MOST_POWER of the power density in the band.
TOP_SHARE = 0.95
MOST_POWER = 0.1


class AliasingMonitor:
    """A recording that accumulates the power spectrum of its channels while its blocks are read; satisfies SampleSource."""

    def __init__(self, source: SampleSource, hits: bool = False) -> None:
        """*hits*: hammer excitation; each segment is then centred on the largest force of its block."""
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
        """The recording's blocks (n, n_channel) [channel unit], unchanged."""
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
        """Mean power per line above and inside the band, (2, n_channel) [unit^2]; 0 without complete segments or lines to compare.

        "Above": between TOP_SHARE of half the sampling rate (or the band's upper edge) and half the sampling rate.
        """
        half = self.sample_rate / 2
        frequency = np.arange(self._power.shape[0]) * (self.sample_rate / self._n)
        low, high = band or (0.0, half)
        inside = (frequency >= low) & (frequency <= min(high, TOP_SHARE * half)) & (frequency > 0)
        above = (frequency > max(TOP_SHARE * half, high if band else 0.0)) & (frequency < half)
        if not np.any(inside) or not np.any(above):
            return np.zeros((2, len(self.channels)))
        scale = 1 / max(self._n_segment, 1) / np.sum(self._window**2)
        return scale * np.array([self._power[lines].mean(axis=0) for lines in (above, inside)])


def aliasing_findings(
    sources: Sequence[AliasingMonitor], band: tuple[float, float] | None, channels: Collection[str]
) -> tuple[Finding, ...]:
    """Warnings for *channels* with aliasing: power density just below half the sampling rate above a tenth of that in the band.

    Components above half the sampling rate fold back to just below it first; behind an anti-alias filter neither is strong. The powers
    of all recordings are added, since an output that a force does not excite holds noise only. Force channels are left out by the
    caller: they are often white by design.
    """
    total: dict[str, FloatArray] = {}
    for source in sources:
        for channel, power in zip(source.channels, source.powers(band).T, strict=True):
            if channel.name in channels:
                total[channel.name] = total.get(channel.name, np.zeros(2)) + power
    ratios = {name: near_half / in_band for name, (near_half, in_band) in total.items() if near_half > MOST_POWER * in_band}
    rate = sources[0].sample_rate if sources else 0.0
    return tuple(
        Finding(
            "aliasing",
            f"channel {name}: the power just below half the sampling rate ({rate / 2:g} Hz) is {100 * share:.0f} % of that in the band, so "
            "frequencies above it are probably folded into the FRF; use the logger's anti-alias filter, or sample faster",
        )
        for name, share in ratios.items()
    )

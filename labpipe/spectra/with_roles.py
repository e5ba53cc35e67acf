"""A recording whose outputs are other channels than those that its rig names."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

from labpipe.arrays import FloatArray
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, SampleSource


class WithRoles:
    """The source with the named channels as its only outputs; its forces stay. Satisfies SampleSource."""

    def __init__(self, source: SampleSource, outputs: Collection[str]) -> None:
        self._source = source
        self.channels = tuple(_with_role(channel, channel.name in outputs) for channel in source.channels)
        self.sample_rate, self.n_sample = source.sample_rate, source.n_sample
        self.name = source.name
        self.findings: tuple[Finding, ...] = ()

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks (n, n_channel) [SI] of at most *n_sample* samples."""
        return self._source.blocks(n_sample)


def _with_role(channel: Channel, is_output: bool) -> Channel:
    if channel.role == "input":
        return channel
    return replace(channel, role="output" if is_output else "reference")

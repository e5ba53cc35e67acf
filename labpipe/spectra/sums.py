"""Sums of channels in recordings: where a sum in time holds, and the doubt of the numbers in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from labpipe.errors import DataError
from labpipe.records.channel_sum import Number
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, SampleSource
from labpipe.spectra.channel_doubts import turned_channels


def check_in_time(source: SampleSource, used: Iterable[Channel]) -> None:
    """DataError for a sum in use whose members have different delays or frequency responses: made sample by sample it is not the sum."""
    by_name = {channel.name: channel for channel in source.channels}
    for channel in used:
        members = [by_name[term.channel] for term in channel.terms if term.channel in by_name]
        if len({(member.delay, member.response) for member in members}) > 1:
            chains = ", ".join(f"{member.name}: {_chain(member)}" for member in members)
            what = f"channel '{channel.name}' is a sum of channels with different delays or frequency responses ({chains})"
            raise DataError(what, hint="frf: {result: spectra} sums them line by line after their corrections")


def _chain(channel: Channel) -> str:
    return f"{1e6 * channel.delay:g} us" + (" and a response table" if channel.response else "")


def doubtful_numbers(channels: Iterable[Channel]) -> dict[Number, list[Channel]]:
    """The numbers with a doubt in sums of channels, each with the sums that it stands in."""
    used: dict[Number, list[Channel]] = {}
    for channel in channels:
        for number in dict.fromkeys(number for term in channel.terms for number in term.numbers):
            used.setdefault(number, []).append(channel)
    return used


def doubt_findings(sources: Sequence[SampleSource]) -> tuple[Finding, ...]:
    """Of sums that are inputs or outputs: doubts of their members' directions that no one channel across them propagates."""
    channels = dict.fromkeys(channel for source in sources for channel in source.channels if channel.role != "reference")
    turned = {name for source in sources for name in _alone(source.channels)}
    members = {channel.name: names for channel in channels if (names := [term.channel for term in channel.terms if term.channel in turned])}
    return tuple(
        Finding(
            "number-doubt",
            f"doubts of the direction of {', '.join(names)} in {name}: no one other channel of the quantity in a known direction "
            "tells what is read across, and they are not in the intervals of the FRF and of its fits",
        )
        for name, names in members.items()
    )


def _alone(channels: Sequence[Channel]) -> Iterator[str]:
    """Recorded channels whose direction has a doubt, and that no other one tells the motion across."""
    recorded = [channel for channel in channels if not channel.terms]
    for number, channel in enumerate(recorded):
        if any(doubt.effect == "direction" for doubt in channel.doubts) and not np.any(turned_channels(recorded, number)):
            yield channel.name

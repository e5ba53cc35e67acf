"""A recording with other outputs: what becomes of its channels."""

from __future__ import annotations

import numpy as np

from labpipe.records.recording import Channel, Recording
from labpipe.spectra.channel_layout import WithRoles


def test_named_channels_are_the_only_outputs_and_forces_stay() -> None:
    channels = tuple(Channel(name, *rest, name) for name, *rest in CHANNELS)
    source = WithRoles(Recording(channels, np.zeros((2, 4)), 10.0), ["b", "f"])
    assert [(channel.name, channel.role) for channel in source.channels] == [
        ("f", "input"), ("a", "reference"), ("b", "output"), ("t", "reference"),
    ]  # fmt: skip


CHANNELS = (
    ("f", "force", "input"), ("a", "displacement", "output"), ("b", "displacement", "reference"), ("t",
    "tacho", "reference"),
)  # fmt: skip

"""The conditions of a test as its recordings show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from labpipe.artefacts.recording_file import StoredRecording
from labpipe.errors import ConfigError
from labpipe.quantities import QUANTITIES, to_display
from labpipe.raw_files.screening import ChannelScreen
from labpipe.records.rig import RecordedCondition
from labpipe.registry import nearest
from labpipe.spectra.channels import READ_SAMPLES
from labpipe.spectra.settings import ShaftLines
from labpipe.spectra.shaft import shaft_motion

# A scatter is of the same unit without the offset of its scale.
SCATTER_UNITS = {"degC": "K"}


def recorded_conditions(
    recordings: Sequence[StoredRecording], recorded: Mapping[str, RecordedCondition]
) -> dict[str, str]:
    """Every condition as text, "1000.2 N +- 3.1 N": its mean over all recordings, and the scatter of the
    samples (of revolutions: speeds).

    ConfigError for a channel that a recording lacks; DataError for a tacho without pulses.
    """
    return {name: _text(*_amount(recordings, source)) for name, source in recorded.items()}


def _amount(recordings: Sequence[StoredRecording], source: RecordedCondition) -> tuple[float, float, str]:
    """Mean and standard deviation [SI], and the unit in which people read them."""
    parts = [
        _speed(recording, source) if source.tacho else _level(recording, source.channel)
        for recording in recordings
    ]
    mean = float(np.mean([part[0] for part in parts]))
    spread = float(np.sqrt(np.mean([part[1] ** 2 + (part[0] - mean) ** 2 for part in parts])))
    return mean, spread, parts[0][2]


def _level(recording: StoredRecording, name: str) -> tuple[float, float, str]:
    channel = next((channel for channel in recording.channels if channel.name == name), None)
    if channel is None:
        names = [channel.name for channel in recording.channels]
        raise ConfigError(f"recording '{recording.name}' has no channel '{name}'", hint=nearest(name, names))
    mean, scatter = recording.levels.get(name) or _levels_of(recording)[name]
    return mean, scatter, QUANTITIES[channel.quantity].display_unit


def _levels_of(recording: StoredRecording) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of every channel, for a recording whose header does not state them."""
    names = [channel.name for channel in recording.channels]
    screen = ChannelScreen(names)
    for block in recording.blocks(READ_SAMPLES):
        screen.add(block)
    return screen.levels()


def _speed(recording: StoredRecording, source: RecordedCondition) -> tuple[float, float, str]:
    motion = shaft_motion(recording, ShaftLines(tacho=source.tacho, pulses=source.pulses))
    turned = motion.revolutions[-1] - motion.revolutions[0]
    return (
        float(turned / (motion.times[-1] - motion.times[0])),
        float(np.std(motion.speeds)),
        QUANTITIES["speed"].display_unit,
    )


def _text(mean: float, scatter: float, unit: str) -> str:
    spread = abs(to_display(scatter, unit) - to_display(0.0, unit))
    return f"{to_display(mean, unit):.7g} {unit} +- {spread:.2g} {SCATTER_UNITS.get(unit, unit)}"

"""Reading one entry of the ``compare:`` section: a question to tests that differ in a condition."""

from __future__ import annotations

from labpipe.campaign.settings import CompareSettings
from labpipe.config.faults import join
from labpipe.config.reader import read_settings
from labpipe.config.reading import Reading
from labpipe.marked_yaml import Marked
from labpipe.registry import nearest


def read_comparison(node: Marked, key: str, name: str, reading: Reading) -> CompareSettings | None:
    """The settings of a comparison; faults for a name that a fit has already, and for a fit that is not there."""
    faults = reading.faults
    if name in reading.names:
        faults.add(node, key, "a fit or calibration has this name already", "rules could not tell them apart")
    settings = read_settings(CompareSettings, node, key, faults, name=name)
    if settings is not None and settings.fit and settings.fit not in reading.names:
        faults.add(node.content["fit"], join(key, "fit"), f"there is no fit '{settings.fit}'", nearest(settings.fit, reading.names))
    return settings

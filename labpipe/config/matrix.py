"""Reading one entry of the ``matrix:`` section."""

from __future__ import annotations

from labpipe.campaign.matrix_settings import MatrixSettings
from labpipe.config.faults import join
from labpipe.config.reader import read_settings
from labpipe.config.reading import Reading
from labpipe.marked_yaml import Marked
from labpipe.registry import nearest


def read_matrix(node: Marked, key: str, name: str, reading: Reading) -> MatrixSettings | None:
    """The settings of a matrix; faults for a name that is taken already, and for a fit that is not there."""
    faults = reading.faults
    if name in reading.names:
        faults.add(node, key, f"the name '{name}' is taken already", "rules could not tell them apart")
    settings = read_settings(MatrixSettings, node, key, faults, name=name)
    if settings is not None and settings.fit not in reading.names:
        faults.add(node.content["fit"], join(key, "fit"), f"there is no fit '{settings.fit}'", nearest(settings.fit, reading.names))
    return settings

"""What the reader of a pipeline's section may know: the faults so far, the rig, and the names that are taken."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.config.faults import Faults
from labpipe.records.rig import Rig


@dataclass(frozen=True)
class Reading:
    """A pass over a pipeline file; *names*: those of the sections that were read before, by which rules address them."""

    faults: Faults
    rig: Rig | None
    names: tuple[str, ...]

"""Doubts of the probes and of the keyphasor of run-ups, as errors of their phasors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.records.doubt import COURSES, Doubt, doubt_of
from labpipe.records.run_up import DIRECTIONS, ProbeError
from labpipe.records.uncertain import Uncertain

KEYPHASOR = "keyphasor"


@dataclass(frozen=True)
class ProbeDoubts:
    """Doubts of the probes of a table: relative gain [1], phase [rad], delay [s] of each, angle [rad] of the keyphasor; None for none."""

    gain: Uncertain | None = None
    phase: Uncertain | None = None
    delay: Uncertain | None = None
    keyphasor: Uncertain | None = None

    def errors(self, planes: Sequence[str]) -> tuple[ProbeError, ...]:
        """The errors of every probe, named by plane and direction; each is its own, unless the doubt names a source."""
        errors = []
        for effect, unit in (("gain", "1"), ("phase", "rad"), ("delay", "s")):
            number: Uncertain | None = getattr(self, effect)
            if number is None or number.std_error == 0:
                continue
            slope, power = COURSES[effect]
            for at, plane in enumerate(planes):
                for axis, direction in enumerate(DIRECTIONS):
                    matrix = np.zeros((len(planes), 2, 2), np.complex128)
                    matrix[at, axis, axis] = slope
                    errors.append(ProbeError(doubt_of(number, f"{plane} {direction}.{effect}", unit), matrix, power))
        if self.keyphasor is not None and self.keyphasor.std_error > 0:
            errors.extend(turning(doubt_of(self.keyphasor, KEYPHASOR, "rad"), len(planes)))
        return tuple(errors)


def turning(doubt: Doubt, n_plane: int) -> tuple[ProbeError, ...]:
    """The error of the keyphasor's angle, which turns all phasors alike."""
    return (ProbeError(doubt, np.tile(1j * np.eye(2), (n_plane, 1, 1))),)

"""Measuring planes of a shaft: two responses that stand in known directions at one end, by the names of their dofs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.records.response import Port
from labpipe.records.rig import AXIS_ANGLES
from labpipe.spectra.directional import SMALLEST_ANGLE


@dataclass(frozen=True)
class Plane:
    """Two responses of one plane: its *name* ("front" of front.x and front.y, empty for x and y), their *columns* and *angles* [rad]."""

    name: str
    columns: tuple[int, int]
    angles: tuple[float, float]

    @property
    def directions(self) -> FloatArray:
        """Rows (cos, sin) of the two responses."""
        return np.column_stack([np.cos(self.angles), np.sin(self.angles)])

    def labelled(self, what: str) -> str:
        """What a column of the plane is called: "front:f", or "f" where there is only one plane without a name."""
        return f"{self.name}:{what}" if self.name else what


def planes_of(ports: Sequence[Port]) -> tuple[Plane, ...]:
    """The planes with two responses in directions that are known and differ, in the order of the responses.

    A dof "bearing2.y" stands at 90 deg in the plane "bearing2"; a dof without direction (z) is in no plane.
    """
    found: dict[str, list[tuple[int, float]]] = {}
    for column, port in enumerate(ports):
        name, _, axis = port.dof.rpartition(".") if port.angle is None else ("", "", "")
        angle = AXIS_ANGLES.get(axis) if port.angle is None else port.angle
        if angle is not None:
            found.setdefault(name, []).append((column, angle))
    pairs = {name: members for name, members in found.items() if len(members) == 2}
    planes = [Plane(name, (one[0], two[0]), (one[1], two[1])) for name, (one, two) in pairs.items()]
    return tuple(plane for plane in planes if abs(np.linalg.det(plane.directions)) >= SMALLEST_ANGLE)

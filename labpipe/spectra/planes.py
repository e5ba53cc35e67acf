"""Measuring planes of a shaft: pairs of outputs in known directions, grouped by the names of their dofs."""

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
    """Two outputs of one plane: its *name* ("front" of front.x and front.y, empty for x and y), their *columns* and *angles* [rad]."""

    name: str
    columns: tuple[int, int]
    angles: tuple[float, float]

    @property
    def directions(self) -> FloatArray:
        """Rows (cos, sin) of the two outputs, (2, 2) [1]."""
        return np.column_stack([np.cos(self.angles), np.sin(self.angles)])

    def labelled(self, what: str) -> str:
        """Label of a column of the plane: "front:f", or "f" for a plane without a name."""
        return f"{self.name}:{what}" if self.name else what


def planes_of(ports: Sequence[Port]) -> tuple[Plane, ...]:
    """The planes with two outputs in known, different directions, in the order of the outputs.

    A dof "bearing2.y" points at 90 deg in the plane "bearing2"; a dof without direction (z) is in no plane.
    """
    members_of: dict[str, list[tuple[int, float]]] = {}
    for column, port in enumerate(ports):
        name, _, axis = port.dof.rpartition(".") if port.angle is None else ("", "", "")
        angle = AXIS_ANGLES.get(axis) if port.angle is None else port.angle
        if angle is not None:
            members_of.setdefault(name, []).append((column, angle))
    pairs = {name: members for name, members in members_of.items() if len(members) == 2}
    planes = [Plane(name, (first[0], second[0]), (first[1], second[1])) for name, (first, second) in pairs.items()]
    return tuple(plane for plane in planes if abs(np.linalg.det(plane.directions)) >= SMALLEST_ANGLE)

"""What a model needs to know of the measurement, and the pieces that models are made of."""

from __future__ import annotations

from dataclasses import dataclass, replace

from labpipe.arrays import FloatArray
from labpipe.identify.model import Matrices, Term, no_matrices
from labpipe.identify.settings import FitSettings
from labpipe.records.response import Port
from labpipe.records.rig import AXIS_ANGLES

UNITS = {"stiffness": "N/m", "damping": "N.s/m", "mass": "kg", "force": "1"}


@dataclass(frozen=True)
class Setup:
    """What a model needs to know of the measurement: its ports, whether in a closed loop, and the fit's settings."""

    outputs: tuple[Port, ...]
    inputs: tuple[Port, ...]
    settings: FitSettings
    closed_loop: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """(n_output, n_input)."""
        return len(self.outputs), len(self.inputs)


def entry_term(name: str, kind: str, places: list[tuple[int, int]], shape: tuple[int, int], droppable: bool = True) -> Term:
    """A parameter that enters the same in all *places* of one matrix; *shape* is (n_dof, n_input)."""
    empty = no_matrices(*shape)
    matrix = getattr(empty, kind).copy()
    for place in places:
        matrix[place] = 1.0
    return Term(name, UNITS[kind], replace(empty, **{kind: matrix}), droppable)


def fixed_matrices(mass: FloatArray, force: FloatArray) -> Matrices:
    """Fixed mass (n, n) [kg] and force factors (n, n_input); no prior of stiffness and damping."""
    return replace(no_matrices(*force.shape), mass=mass, force=force)


def labels(ports: tuple[Port, ...]) -> str:
    """Labels of the ports, for messages."""
    return ", ".join(port.label for port in ports)


def angle_of(port: Port) -> float | None:
    """Direction [rad] from x towards y, None if unknown."""
    return port.angle if port.angle is not None else AXIS_ANGLES.get(port.dof)

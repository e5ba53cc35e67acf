"""Result of a bearing model of any kind: stiffness and damping at its load and speed, and its equilibrium position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.records.arrays import frozen_array
from labpipe.records.finding import Finding

TILTS = ("bx", "by", "bz")


@dataclass(frozen=True)
class Amount:
    """A number of the equilibrium: its name, its value in the SI unit, and that unit."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class PressureField:
    """Pressure of an oil film against ambient (n_theta, n_axial) [Pa], over the angle from +y to +z [rad] and from mid width [m].

    thickness (n_theta,) [m]: of the film.
    """

    theta: FloatArray
    axial: FloatArray
    pressure: FloatArray
    thickness: FloatArray


@dataclass(frozen=True)
class BearingCoefficients:
    """Stiffness and damping (n_dof, n_dof): force in the row's dof per displacement or velocity in the column's [SI units].

    rest: equilibrium position; element_state: arrays per rolling element by name; lowest, highest: stiffness over one ball passage
    (rolling bearings); notes: further numbers of the model; shaft: results of the rigid shaft on the bearing, if the file describes one;
    shares: contribution of each element of a control loop to the direct coefficients; poles: of the closed loop [rad/s]; words: verdicts
    by name; film: pressure of an oil film (journal bearings).
    """

    dofs: tuple[str, ...]
    stiffness: FloatArray
    damping: FloatArray
    rest: tuple[Amount, ...] = ()
    _: KW_ONLY
    element_state: Mapping[str, FloatArray] = field(default_factory=dict)
    lowest: FloatArray | None = None
    highest: FloatArray | None = None
    notes: tuple[Amount, ...] = ()
    shaft: tuple[Amount, ...] = ()
    findings: tuple[Finding, ...] = ()
    shares: tuple[Amount, ...] = ()
    poles: ComplexArray | None = None
    words: Mapping[str, str] = field(default_factory=dict)
    film: PressureField | None = None

    def __post_init__(self) -> None:
        n = len(self.dofs)
        for name in ("stiffness", "damping", "lowest", "highest"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen_array(getattr(self, name), np.float64, name, (n, n)))

    def unit(self, row: int, column: int) -> str:
        """Unit of a stiffness coefficient: N/m, N/rad (force per tilt, the same as moment per displacement N.m/m) or N.m/rad."""
        tilts = (self.dofs[row] in TILTS) + (self.dofs[column] in TILTS)
        return ("N/m", "N/rad", "N.m/rad")[tilts]

    @property
    def relative(self) -> FloatArray:
        """Relative coupling K_ij / sqrt(|K_ii K_jj|), (n_dof, n_dof) [1]; zero where a diagonal term is zero."""
        diagonal = np.sqrt(np.abs(np.diag(self.stiffness)))
        scale = np.outer(diagonal, diagonal)
        relative: FloatArray = np.divide(self.stiffness, scale, out=np.zeros_like(scale), where=scale > 0)
        return relative

    def lateral(self, y: str, z: str) -> BearingCoefficients:
        """The coefficients of the dofs *y* and *z* alone, (2, 2), the other dofs held."""
        places = np.ix_(*[[self.dofs.index(y), self.dofs.index(z)]] * 2)
        return BearingCoefficients(("y", "z"), self.stiffness[places], self.damping[places], findings=self.findings)

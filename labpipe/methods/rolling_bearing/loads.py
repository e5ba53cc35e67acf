"""Rolling bearings after Lim and Singh: loads between displaced rings, and their exact derivative, the
stiffness matrix.

Coordinates q = (x, y, z, bx, by): displacement of the inner relative to the outer ring, z along the axis, bx
and by tilts about x, y; loads f = (Fx, Fy, Fz, Mx, My). T. C. Lim and R. Singh, J. Sound Vib. 139 (1990)
179-199, eqs. 2-8.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import ConfigError

DOFS = ("x", "y", "z", "bx", "by")
BALL_EXPONENT, ROLLER_EXPONENT = 3 / 2, 10 / 9
# With two elements one radial direction has no stiffness.
MIN_ELEMENTS = 3
# Slewing rings have some hundred.
MAX_ELEMENTS = 10_000
ROLLER_REACH = 0.02


@dataclass(frozen=True)
class RollingBearing:
    """One row of *elements* balls or rollers with Q = K_n delta^n, n = 3/2 (balls) or 10/9 (rollers).

    stiffness_constant: K_n of inner and outer contact in series [N/m^n]; pitch_radius: radius r of the inner
    groove's curvature centres (balls) or of the pitch circle (rollers) [m]; contact_angle: unloaded angle a0
    [rad]; clearance: radial clearance r_L, half the diametral one; negative means interference [m];
    groove_distance: unloaded distance A0 of the groove centres [m], balls only: with it the contact angle
    changes under load, without it (rollers) it is constant. Raises ConfigError for an impossible geometry.
    """

    elements: int
    stiffness_constant: float
    pitch_radius: float
    contact_angle: float = 0.0
    clearance: float = 0.0
    groove_distance: float | None = None

    def __post_init__(self) -> None:
        if self.elements < MIN_ELEMENTS:
            raise ConfigError(
                f"{self.elements} rolling elements do not make a bearing", hint=f"{MIN_ELEMENTS} or more"
            )
        if self.elements > MAX_ELEMENTS:
            raise ConfigError(
                f"a bearing of {self.elements} rolling elements is not computed", hint=f"up to {MAX_ELEMENTS}"
            )
        for name in ("stiffness_constant", "pitch_radius", "groove_distance"):
            amount = getattr(self, name)
            if amount is not None and not 0 < amount < np.inf:
                raise ConfigError(f"{name} must be above zero, found {amount:g}")
        if not abs(self.contact_angle) < np.pi / 2:
            raise ConfigError("the contact angle must lie between -90 and 90 deg")
        if self.groove_distance is not None and self.clearance >= self.groove_distance * np.cos(
            self.contact_angle
        ):
            raise ConfigError(
                "the clearance is larger than the groove centres' radial distance",
                hint="it is the radial clearance",
            )

    @property
    def is_ball(self) -> bool:
        return self.groove_distance is not None

    @property
    def exponent(self) -> float:
        """n of Q = K_n delta^n."""
        return BALL_EXPONENT if self.is_ball else ROLLER_EXPONENT

    @property
    def reach(self) -> float:
        """Largest deflection of the model [m]: the groove centres' distance, about 5 % of a ball; 2 % of the
        pitch radius for rollers.
        """
        return self.groove_distance or ROLLER_REACH * self.pitch_radius

    def angles(self, cage_angle: ArrayLike = 0.0) -> FloatArray:
        """psi_j = cage angle + 2 pi j / z [rad], (z,), or (n_case, z) for cage angles (n_case,)."""
        steps = 2 * np.pi * np.arange(self.elements) / self.elements
        return np.asarray(cage_angle, np.float64)[..., None] + steps


@dataclass(frozen=True)
class ElementFrame:
    """Directions of the elements: dr_j = e_r . q, dz_j = e_z . q, e_r = (cos, sin, 0, 0, 0), e_z = (0, 0, 1,
    l sin, -l cos) of psi_j.

    radial, axial: (z, 5) [-] for all load cases, or (n_case, z, 5). l is the pitch radius, or 1 where tilts
    are multiplied by it. Equation (roll-kinematics).
    """

    radial: FloatArray
    axial: FloatArray

    @classmethod
    def at(cls, angles: FloatArray, lever: float) -> ElementFrame:
        """The frame of elements at *angles* (z,) or (n_case, z) [rad]; *lever* l [m]."""
        cos, sin, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
        axial = np.stack([zero, zero, zero + 1, lever * sin, -lever * cos], -1)
        return cls(np.stack([cos, sin, zero, zero, zero], -1), axial)

    @cached_property
    def squares(self) -> FloatArray:
        """e_r e_r^T, e_r e_z^T + e_z e_r^T and e_z e_z^T of every element, (3 z, 25) [-].

        For a frame common to all load cases.
        """
        r, a = self.radial, self.axial
        mixed = r[:, :, None] * a[:, None, :]
        pairs = (
            r[:, :, None] * r[:, None, :],
            mixed + np.swapaxes(mixed, 1, 2),
            a[:, :, None] * a[:, None, :],
        )
        return np.concatenate(pairs).reshape(-1, 25)

    def of_cases(self, cases: BoolArray | slice) -> ElementFrame:
        """The frame of the load cases *cases* (n_case,)."""
        return self if self.radial.ndim == 2 else ElementFrame(self.radial[cases], self.axial[cases])


def weighted_sum(weights: FloatArray, vectors: FloatArray) -> FloatArray:
    """sum_j w_j v_j, (n_case, k) [unit of w v]: *weights* (n_case, m), *vectors* (m, k) or (n_case, m, k)."""
    if vectors.ndim == 2:
        return weights @ vectors
    return (weights[:, None, :] @ vectors)[:, 0]


def _along(vectors: FloatArray, q: FloatArray) -> FloatArray:
    """v_j . q: (n_case, z)."""
    if vectors.ndim == 2:
        return q @ vectors.T
    return (vectors @ q[:, :, None])[:, :, 0]


@dataclass(frozen=True)
class Contacts:
    """Contacts of the elements, all (n_case, z): deflection delta [m] (zero where loose), load Q [N],
    direction of the load cos, sin of the contact angle, slope dQ/ddelta [N/m], and turning Q/A [N/m], the
    geometric stiffness across the load (balls).
    """

    deflection: FloatArray
    load: FloatArray
    cos: FloatArray
    sin: FloatArray
    slope: FloatArray
    turning: FloatArray


def contacts(bearing: RollingBearing, q: FloatArray, frame: ElementFrame) -> Contacts:
    """Deflections and loads of the elements at displacements *q* (n_case, 5) [m, rad] or, with tilts times
    the pitch radius, [m].

    Balls: delta = A - A0 with A^2 = (A0 sin a0 + dz)^2 + (A0 cos a0 + dr)^2, written without the difference
    of nearly equal lengths: A - A0 = (2 A0 (dz sin a0 + dr cos a0) + dz^2 + dr^2) / (A + A0). Rollers: delta
    = dr cos a0 + dz sin a0. Equation (roll-deflection).
    """
    dz, dr = _along(frame.axial, q), _along(frame.radial, q) - bearing.clearance
    sin0, cos0 = np.sin(bearing.contact_angle), np.cos(bearing.contact_angle)
    approach = dz * sin0 + dr * cos0
    if bearing.groove_distance is None:
        delta = np.maximum(approach, 0.0)
        load, slope = _hertz(delta, bearing)
        return Contacts(delta, load, np.full_like(dz, cos0), np.full_like(dz, sin0), slope, np.zeros_like(dz))
    a0 = bearing.groove_distance
    axial, radial = a0 * sin0 + dz, a0 * cos0 + dr
    distance = np.sqrt(axial**2 + radial**2)
    delta = np.maximum((2 * a0 * approach + dz**2 + dr**2) / (distance + a0), 0.0)
    load, slope = _hertz(delta, bearing)
    # Where the groove centres coincide, the element is loose and its direction has no influence.
    length = np.maximum(distance, np.finfo(np.float64).tiny)
    return Contacts(delta, load, radial / length, axial / length, slope, load / length)


def _hertz(delta: FloatArray, bearing: RollingBearing) -> tuple[FloatArray, FloatArray]:
    """Q = K_n delta^n and dQ/ddelta = n K_n delta^(n-1)."""
    root = np.sqrt(delta) if bearing.is_ball else delta ** (bearing.exponent - 1)
    stiff = bearing.stiffness_constant * root
    return stiff * delta, bearing.exponent * stiff


def load_sum(at: Contacts, frame: ElementFrame) -> FloatArray:
    """f = sum_j Q_j (cos a_j e_r + sin a_j e_z), (n_case, 5) [N, N m]. Equation (roll-loads)."""
    return weighted_sum(at.load * at.cos, frame.radial) + weighted_sum(at.load * at.sin, frame.axial)


def stiffness_sum(at: Contacts, frame: ElementFrame) -> FloatArray:
    """K = df/dq = sum_j dQ/ddelta n n^T + Q/A t t^T, (n_case, 5, 5) [N/m, N/rad, N m/rad].

    n = cos a e_r + sin a e_z, t = cos a e_z - sin a e_r. Equation (roll-stiffness).
    """
    if frame.radial.ndim == 3:
        along = at.cos[..., None] * frame.radial + at.sin[..., None] * frame.axial
        across = at.cos[..., None] * frame.axial - at.sin[..., None] * frame.radial
        return _squared(along, at.slope) + _squared(across, at.turning)
    weights = (
        at.slope * at.cos**2 + at.turning * at.sin**2,
        (at.slope - at.turning) * at.sin * at.cos,
        at.slope * at.sin**2 + at.turning * at.cos**2,
    )
    # The same sum as one matrix product, since all load cases have the same e_r and e_z.
    return (np.concatenate(weights, axis=1) @ frame.squares).reshape(-1, 5, 5)


def _squared(vectors: FloatArray, weights: FloatArray) -> FloatArray:
    """sum_j w_j v_j v_j^T: *vectors* (n_case, z, 5), *weights* (n_case, z) -> (n_case, 5, 5)."""
    return np.swapaxes(vectors * weights[..., None], 1, 2) @ vectors


def bearing_loads(bearing: RollingBearing, q: ArrayLike, cage_angle: ArrayLike = 0.0) -> FloatArray:
    """Loads (Fx, Fy, Fz [N], Mx, My [N m]) on the inner ring at displacements *q* (n_case, 5) [m, rad]."""
    displacement = np.atleast_2d(np.asarray(q, np.float64))
    frame = ElementFrame.at(bearing.angles(cage_angle), bearing.pitch_radius)
    return load_sum(contacts(bearing, displacement, frame), frame)


def bearing_stiffness(bearing: RollingBearing, q: ArrayLike, cage_angle: ArrayLike = 0.0) -> FloatArray:
    """K = d(loads)/dq at the displacements *q* (n_case, 5) [m, rad]: (n_case, 5, 5) [N/m, N/rad, N m/rad],
    symmetric.
    """
    displacement = np.atleast_2d(np.asarray(q, np.float64))
    frame = ElementFrame.at(bearing.angles(cage_angle), bearing.pitch_radius)
    return stiffness_sum(contacts(bearing, displacement, frame), frame)

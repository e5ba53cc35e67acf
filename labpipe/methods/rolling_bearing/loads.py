"""Rolling bearings after Lim and Singh: loads between displaced rings, and their exact derivative, the
stiffness matrix.

Coordinates q = (x, y, z, bx, by): displacement of the inner relative to the outer ring, z along the axis, bx
and by tilts about x, y; loads f = (Fx, Fy, Fz, Mx, My). T. C. Lim and R. Singh, J. Sound Vib. 139 (1990)
179-199, eqs. 2-8.

A shaft on one rolling bearing: natural frequencies, transfer matrices, and bending in series with the
bearing (R. J. W. Knaapen 1997, chapter 3).

M q'' + C q' + K q = f, q = (x, y, z, bx, by) at the bearing's centre, which is the shaft's centre of mass; C
= beta K.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError, SettingError
from labpipe.records.response import FrequencyResponse, Port

DOFS = ("x", "y", "z", "bx", "by")
LOADS, LOAD_UNITS = ("x", "y", "z", "mx", "my"), ("N", "N", "N", "N.m", "N.m")
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
            what = f"{self.elements} rolling elements do not make a bearing"
            raise SettingError("elements", what, f"{MIN_ELEMENTS} or more")
        if self.elements > MAX_ELEMENTS:
            what = f"a bearing of {self.elements} rolling elements is not computed"
            raise SettingError("elements", what, f"up to {MAX_ELEMENTS}")
        for name in ("stiffness_constant", "pitch_radius", "groove_distance"):
            amount = getattr(self, name)
            if amount is not None and not 0 < amount < np.inf:
                raise SettingError(name, f"{name} must be above zero, found {amount:g}")
        if not abs(self.contact_angle) < np.pi / 2:
            raise SettingError("contact_angle", "the contact angle must lie between -90 and 90 deg")
        if self.clearance >= (self.groove_distance or np.inf) * np.cos(self.contact_angle):
            what = "the clearance is larger than the groove centres' radial distance"
            raise SettingError("clearance", what, "it is the radial clearance")

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
    l sin, -l cos) of psi_j. radial, axial: (z, 5) [-] for all load cases, or (n_case, z, 5). l is the pitch
    radius, or 1 where tilts are multiplied by it. Equation (roll-kinematics).
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
        """e_r e_r^T, e_r e_z^T + e_z e_r^T and e_z e_z^T of every element, (3 z, 25) [-]. For a frame common
        to all load cases.
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
    the pitch radius, [m]. Balls: delta = A - A0 with A^2 = (A0 sin a0 + dz)^2 + (A0 cos a0 + dr)^2, written
    without the difference of nearly equal lengths: A - A0 = (2 A0 (dz sin a0 + dr cos a0) + dz^2 + dr^2) / (A
    + A0). Rollers: delta = dr cos a0 + dz sin a0. Equation (roll-deflection).
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
        return _square(along, at.slope) + _square(across, at.turning)
    weights = (
        at.slope * at.cos**2 + at.turning * at.sin**2,
        (at.slope - at.turning) * at.sin * at.cos,
        at.slope * at.sin**2 + at.turning * at.cos**2,
    )
    # The same sum as one matrix product, since all load cases have the same e_r and e_z.
    return (np.concatenate(weights, axis=1) @ frame.squares).reshape(-1, 5, 5)


def _square(vectors: FloatArray, weights: FloatArray) -> FloatArray:
    return np.swapaxes(vectors * weights[..., None], 1, 2) @ vectors


@dataclass(frozen=True)
class RigidShaft:
    """A rigid shaft: mass m [kg], moments of inertia about x and y [kg m^2]."""

    mass: float
    inertia_x: float
    inertia_y: float

    def __post_init__(self) -> None:
        for name in ("mass", "inertia_x", "inertia_y"):
            if not 0 < getattr(self, name) < np.inf:
                raise ConfigError(f"the shaft's {name} must be above zero")

    @property
    def inertias(self) -> FloatArray:
        """Diagonal of M = diag(m, m, m, Jx, Jy), (5,) [kg, kg m^2]."""
        return np.array([self.mass, self.mass, self.mass, self.inertia_x, self.inertia_y])


@dataclass(frozen=True)
class UndampedModes:
    """Undamped modes in ascending order: frequency (5,) [Hz]; shape (5, 5), columns with phi^T M phi = 1.

    share (5, 5): share of dof i (row) of the modal mass of mode r (column), M_ii phi_ir^2; rows and columns
    sum to one.
    """

    frequency: FloatArray
    shape: FloatArray
    share: FloatArray

    def damping_ratio(self, beta: float) -> FloatArray:
        """zeta_r = beta w_r / 2 of Rayleigh damping C = beta K, beta [s]; (5,)."""
        return np.pi * beta * self.frequency

    def main_mode(self, dof: str) -> int:
        """The mode with the largest share of the dof's inertia: its peak in the direct transfer function."""
        return int(np.argmax(self.share[DOFS.index(dof)]))


def modes(shaft: RigidShaft, stiffness: FloatArray) -> UndampedModes:
    """Eigenvalues of K phi = w^2 M phi; *stiffness* (5, 5) [N/m, N/rad, N m/rad], a dof without stiffness
    gives 0 Hz. Raises FitError for a stiffness that is not positive semidefinite (beyond rounding): such an
    equilibrium is unstable. Equation (roll-modes).
    """
    scale = 1 / np.sqrt(shaft.inertias)
    squares, vectors = np.linalg.eigh((stiffness + stiffness.T) / 2 * np.outer(scale, scale))
    if squares[0] < -1e-9 * squares[-1]:
        raise FitError("the stiffness matrix has a negative eigenvalue", hint="the shaft does not rest there")
    return UndampedModes(
        np.sqrt(np.maximum(squares, 0.0)) / (2 * np.pi), scale[:, None] * vectors, vectors**2
    )


def theoretical_response(
    shaft: RigidShaft, stiffness: FloatArray, frequency: FloatArray, beta: float
) -> FrequencyResponse:
    """The transfer_matrix of a rigid shaft as a frequency response; *stiffness* (5, 5) [N/m, N/rad, N m/rad],
    *frequency* (n_frequency,) [Hz], *beta* [s].
    """
    ports = tuple(Port(dof, dof, dof) for dof in DOFS)
    matrix = transfer_matrix(shaft, stiffness, frequency, beta)
    return FrequencyResponse(frequency, matrix, ports, ports, form="receptance", name="theory")


def sdof_stiffness(shaft: RigidShaft, stiffness: FloatArray) -> FloatArray:
    """Stiffness from a one-dof fit at each dof's main peak, lightly damped: k_i = w_r^2 / phi_ir^2, (5,)
    [N/m, N m/rad].

    With a known mass M_ii in place of the modal 1/phi_ir^2 it is k_i = M_ii w_r^2. Neither equals K_ii: at
    the peak the coupled dofs move as well, M_ii w_r^2 = K_ii + sum_j K_ij phi_jr / phi_ir,
    which makes the lower mode of a coupled pair appear softer and the upper one stiffer. A measured fit is
    therefore to be compared with the fit of the theoretical curve, not with K_ii. Equation (roll-sdof).
    """
    shaft_modes = modes(shaft, stiffness)
    main = [shaft_modes.main_mode(dof) for dof in DOFS]
    squares = (2 * np.pi * shaft_modes.frequency[main]) ** 2
    return squares * shaft.inertias / shaft_modes.share[range(len(DOFS)), main]


RADIAL = (0, 1)


def add_shaft_bending(stiffness: NDArray[np.inexact], bending: float) -> ComplexArray:
    """K_total = (K^-1 + S)^-1, S = diag(1, 1, 0, 0, 0) / k_s: the bending shaft k_s [N/m] in series in x and
    y, (..., 5, 5). By Woodbury's identity K - K E (E^T K E + k_s)^-1 E^T K, so that K may be singular.
    ConfigError for k_s not above zero. Equation (roll-series-matrix).
    """
    if not bending > 0:
        what = f"the bending stiffness of the shaft is {bending:g} N/m"
        raise ConfigError(what, hint="it must be above zero")
    whole = np.asarray(stiffness, np.complex128)
    if np.isinf(bending):
        return whole
    columns = whole[..., :, RADIAL]
    return whole - columns @ np.linalg.solve(
        columns[..., RADIAL, :] + bending * np.eye(len(RADIAL)), whole[..., RADIAL, :]
    )


def transfer_matrix(
    shaft: RigidShaft, stiffness: FloatArray, frequency: FloatArray, beta: float, bending: float = np.inf
) -> ComplexArray:
    """Receptance H(w) = (K_total(w) - w^2 M)^-1, (n_frequency, 5, 5) [m/N, rad/N, rad/(N m)].

    K_total: (1 + j w beta) K of the bearing, *stiffness* (5, 5) [N/m, N/rad, N m/rad], *beta* [s], in series
    with the *bending* shaft [N/m], which has no losses; *frequency* [Hz]. FitError where the dynamic
    stiffness is singular: at 0 Hz with a dof without stiffness, or on an undamped resonance. Equation
    (roll-transfer).
    """
    w = 2 * np.pi * np.asarray(frequency, np.float64)[:, None, None]
    dynamic = add_shaft_bending((1 + 1j * w * beta) * stiffness, bending) - w**2 * np.diag(shaft.inertias)
    try:
        return np.linalg.inv(dynamic)
    except np.linalg.LinAlgError:
        hint = "give a damping factor, or leave out 0 Hz"
        raise FitError("the dynamic stiffness is singular at a line", hint=hint) from None

"""Equilibrium of a rolling bearing under prescribed loads and displacements: Newton's method on the load potential.

The potential Phi(q) = sum_j K_n delta_j^(n+1) / (n+1) - f . q is convex (delta is a convex function of q for balls, linear for rollers),
so a line search makes the solution independent of its start; loose elements, clearance and zero contact angle need no special case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from labpipe.arrays import BoolArray, FloatArray
from labpipe.bearings.rolling import DOFS, Contacts, ElementFrame, RollingBearing, contacts, load_sum, stiffness_sum
from labpipe.bearings.rolling_limits import check_carried, check_request, explain_failure
from labpipe.bearings.rolling_newton import Problem, solve
from labpipe.errors import ConfigError

# Load cases solved together: many enough for a small overhead of numpy, few enough for the cache.
CASES_AT_ONCE = 512


@dataclass(frozen=True)
class Equilibrium:
    """The state of n_case load cases.

    displacement (n_case, 5) [m, rad]; load (n_case, 5) [N, N m] on the inner ring, reactions of fixed dofs included; stiffness K = dF/dq
    (n_case, 5, 5); contacts: deflection, load and direction of every element; angles psi_j (n_case, z) [rad]; free: names of the dofs
    with prescribed load.
    """

    bearing: RollingBearing
    displacement: FloatArray
    load: FloatArray
    stiffness: FloatArray
    contacts: Contacts
    angles: FloatArray
    free: tuple[str, ...]

    @property
    def contact_angle(self) -> FloatArray:
        """Loaded contact angles a_j (n_case, z) [rad]."""
        angles: FloatArray = np.arctan2(self.contacts.sin, self.contacts.cos)
        return angles

    @property
    def mirrored(self) -> BoolArray:
        """Load cases (n_case,) in which an element of an angular-contact bearing carries at the opposite contact angle.

        The equations allow it; a bearing with one shoulder does not.
        """
        opposite = self.contacts.sin * np.sign(self.bearing.contact_angle) < 0
        return np.any(opposite & (self.contacts.load > 1e-9 * self.contacts.load.max(axis=1, keepdims=True)), axis=1)

    @property
    def determinate(self) -> BoolArray:
        """Load cases (n_case,) whose position is unique: the stiffness of the free dofs is not singular."""
        index = [DOFS.index(name) for name in self.free]
        if not index:
            return np.ones(len(self.load), dtype=bool)
        scale = np.array([1, 1, 1, 1 / self.bearing.pitch_radius, 1 / self.bearing.pitch_radius])
        eigenvalues = np.linalg.eigvalsh((self.stiffness * np.outer(scale, scale))[:, index][:, :, index])
        unique: BoolArray = eigenvalues[:, 0] > 1e-10 * eigenvalues[:, -1]
        return unique


def equilibrium(
    bearing: RollingBearing,
    loads: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    displacements: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    fixed_dofs: Sequence[str] = (),
    cage_angle: ArrayLike = 0.0,
) -> Equilibrium:
    """The equilibrium of the bearing: F_i(q) = f_i for every dof except *fixed_dofs*, where q_i is given.

    *loads* (5,) or (n_case, 5) [N, N m]; *displacements* (5,) or (n_case, 5) [m, rad], used for the dofs named in *fixed_dofs* (x y z
    bx by); *cage_angle* scalar or (n_case,) [rad], angle of the first element from x. Raises ConfigError for a load that this kind of
    bearing cannot carry or displacements beyond the model's reach, FitError naming the load case when there is no equilibrium.
    """
    f, q = (np.atleast_2d(np.asarray(values, np.float64)) for values in (loads, displacements))
    cage = np.asarray(cage_angle, np.float64)
    check_request(bearing, f, q, fixed_dofs, cage)
    n_case = max(len(f), len(q), cage.size)
    if np.all(cage == cage.flat[0]):
        cage = cage.reshape(-1)[0]  # one frame for all cases
    f, q = (np.broadcast_to(values, (n_case, len(DOFS))) for values in (f, q))
    parts = []
    for start in range(0, n_case, CASES_AT_ONCE):
        part = slice(start, start + CASES_AT_ONCE)
        part_cage = cage[part] if cage.ndim else cage
        parts.append(_state(bearing, _solve_part(bearing, f, q, fixed_dofs, part_cage, part), fixed_dofs, part_cage))
    return _joined(parts)


def _solve_part(
    bearing: RollingBearing, f: FloatArray, q: FloatArray, fixed_dofs: Sequence[str], cage: FloatArray, part: slice
) -> FloatArray:
    """Displacements of a part of the load cases; tilts are solved in metres at the pitch radius."""
    scale = np.array([1, 1, 1, bearing.pitch_radius, bearing.pitch_radius])
    frame = ElementFrame.at(bearing.angles(cage), 1.0)
    free = np.array([name not in fixed_dofs for name in DOFS])
    problem = Problem(bearing, frame, np.where(free, f[part] / scale, 0.0), np.flatnonzero(free))
    u, solved = solve(problem, np.where(free, 0.0, q[part] * scale))
    if not solved.all():
        explain_failure(bearing, np.where(free, f, 0.0), part.start + int(np.flatnonzero(~solved)[0]))
    return u / scale


def _state(bearing: RollingBearing, displacement: FloatArray, fixed_dofs: Sequence[str], cage: FloatArray) -> Equilibrium:
    angles = bearing.angles(cage)
    frame = ElementFrame.at(angles, bearing.pitch_radius)
    at = contacts(bearing, displacement, frame)
    free = tuple(name for name in DOFS if name not in fixed_dofs)
    case_angles = np.broadcast_to(angles, at.load.shape)
    return Equilibrium(bearing, displacement, load_sum(at, frame), stiffness_sum(at, frame), at, case_angles, free)


def _joined(parts: Sequence[Equilibrium]) -> Equilibrium:
    """The load cases of all parts as one."""
    at = Contacts(*(np.concatenate([getattr(part.contacts, field.name) for part in parts]) for field in fields(Contacts)))
    check_carried(parts[0].bearing, at)
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("displacement", "load", "stiffness", "angles")}
    return Equilibrium(parts[0].bearing, contacts=at, free=parts[0].free, **joined)


def load_vector(**loads: float) -> FloatArray:
    """(Fx, Fy, Fz, Mx, My) from named loads, (5,) [N, N m]: load_vector(y=-24, z=427); names x y z mx my.

    ConfigError for another name.
    """
    names = ("x", "y", "z", "mx", "my")
    unknown = [name for name in loads if name not in names]
    if unknown:
        raise ConfigError(f"no load '{unknown[0]}'", hint=f"known: {', '.join(names)}")
    return np.array([loads.get(name, 0.0) for name in names])

"""Equilibrium of rolling bearings under prescribed loads and displacements: Newton's method on the convex
load potential.

The potential Phi(q) = sum_j K_n delta_j^(n+1) / (n+1) - f . q is convex (delta is a convex function of q for
balls, linear for rollers), so a line search makes the solution independent of its start; loose elements,
clearance and zero contact angle need no special case.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.errors import ConfigError, FitError
from labpipe.methods.rolling_bearing.loads import (
    DOFS,
    LOAD_UNITS,
    LOADS,
    Contacts,
    ElementFrame,
    RollingBearing,
    contacts,
    load_sum,
    stiffness_sum,
)


def _case(case: int, n_case: int) -> str:
    return f"load case {case + 1}: " if n_case > 1 else ""


TOLERANCE = 1e-12  # of the residual against the loads
ACCEPTABLE = 1e-9  # where steps are down to the rounding of positions
ROUNDING = 4 * np.finfo(np.float64).eps
# Deflection over the longest step that counts as zero: an unloaded bearing is in equilibrium as well.
NEGLIGIBLE = 1e-6
# A dozen as a rule; changing to the opposite contact angle takes hundreds of short steps.
MAX_ITERATIONS = 1000
MAX_CUTS = 40
# Largest displacement of an equilibrium over the pitch radius.
REACH = 0.2


@dataclass(frozen=True)
class EquilibriumProblem:
    """Load cases of one bearing: u with F_i(u) = f_i for the *free* dofs (indices), the others fixed.

    load (n_case, 5) [N]; moments are divided and tilts multiplied by the pitch radius, so that all five have
    one unit.
    """

    bearing: RollingBearing
    frame: ElementFrame
    load: FloatArray
    free: IntArray

    def of_cases(self, cases: BoolArray) -> EquilibriumProblem:
        """The problem of the load cases *cases* (n_case,)."""
        return EquilibriumProblem(self.bearing, self.frame.of_cases(cases), self.load[cases], self.free)

    def at(self, u: FloatArray) -> Trial:
        """The state at displacements u (n_case, 5) [m]. Equation (roll-potential)."""
        state = contacts(self.bearing, u, self.frame)
        residual = (self.load - load_sum(state, self.frame))[:, self.free]
        strain = np.einsum("nj,nj->n", state.load, state.deflection) / (self.bearing.exponent + 1)
        work = np.einsum("nf,nf->n", self.load[:, self.free], u[:, self.free])
        return Trial(u, state, residual, strain - work)

    def misfit(self, trial: Trial) -> FloatArray:
        """|f - F| relative to the acting loads, prescribed or between the rings, (n_case,) [1]."""
        least = self.bearing.stiffness_constant * (NEGLIGIBLE * self.bearing.reach) ** self.bearing.exponent
        acting = np.linalg.norm(self.load, axis=1) + trial.state.load.sum(axis=1) + least
        return np.linalg.norm(trial.residual, axis=1) / acting


@dataclass(frozen=True)
class Trial:
    """A position u (n_case, 5) [m], the contacts there, the residual f - F of the free dofs [N], and the
    potential [J].
    """

    u: FloatArray
    state: Contacts
    residual: FloatArray
    potential: FloatArray

    def of_cases(self, cases: BoolArray) -> Trial:
        """The trial positions of the load cases *cases* (n_case,)."""
        state = Contacts(*(getattr(self.state, field.name)[cases] for field in fields(Contacts)))
        return Trial(self.u[cases], state, self.residual[cases], self.potential[cases])


def solve(problem: EquilibriumProblem, fixed: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Positions u (n_case, 5) [m], and whether each is an equilibrium; *fixed* (n_case, 5): displacements,
    zero where free.
    """
    u = starting_point(problem, fixed)
    unsolved = np.arange(len(u))
    solved = np.zeros(len(u), dtype=bool)
    limit = REACH * problem.bearing.pitch_radius
    for _ in range(MAX_ITERATIONS):
        trial = problem.at(u[unsolved])
        misfit, step = problem.misfit(trial), newton_step(problem, trial)
        finest = ROUNDING * (problem.bearing.reach + np.abs(trial.u).max(axis=1))
        converged = (misfit <= TOLERANCE) | ((misfit <= ACCEPTABLE) & (np.abs(step).max(axis=1) <= finest))
        solved[unsolved[converged]] = True
        active = ~converged & (np.abs(trial.u).max(axis=1) < limit)
        if not active.any():
            return u, solved
        if not active.all():
            unsolved, step = unsolved[active], step[active]
            problem, trial = problem.of_cases(active), trial.of_cases(active)
        u[unsolved] = line_search(problem, trial, step)
    return u, solved


def newton_step(problem: EquilibriumProblem, trial: Trial) -> FloatArray:
    """(K + |f - F| / R) p = f - F, (n_case, 5) [m]: limited to the bearing's reach R without stiffness,
    converging quadratically. Equation (roll-newton).
    """
    k = stiffness_sum(trial.state, problem.frame)[:, problem.free[:, None], problem.free]
    floor = 1e-15 * np.trace(k, axis1=1, axis2=2) + np.finfo(np.float64).tiny
    restraint = np.linalg.norm(trial.residual, axis=1) / problem.bearing.reach + floor
    k = k + restraint[:, None, None] * np.eye(problem.free.size)
    step = np.zeros_like(trial.u)
    step[:, problem.free] = np.linalg.solve(k, trial.residual[:, :, None])[:, :, 0]
    return step


def line_search(problem: EquilibriumProblem, trial: Trial, step: FloatArray) -> FloatArray:
    """Next position u + t p, (n_case, 5) [m], from t = 1, reduced until the potential decreases or its slope
    along p is not positive. A reduction goes to the zero of the secant of the slope.
    """
    descent = np.einsum("nf,nf->n", trial.residual, step[:, problem.free])
    length = np.ones(len(step))
    open_cases = np.arange(len(step))
    for _ in range(MAX_CUTS):
        is_open = np.isin(np.arange(len(step)), open_cases)
        part = problem if is_open.all() else problem.of_cases(is_open)
        t, p, fall = length[open_cases], step[open_cases], descent[open_cases]
        there = part.at(trial.u[open_cases] + t[:, None] * p)
        rise = -np.einsum("nf,nf->n", there.residual, p[:, problem.free])
        fallen = there.potential <= trial.potential[open_cases] - 1e-4 * t * fall
        short = ~(fallen | (rise <= 0.1 * fall))
        if not short.any():
            break
        length[open_cases[short]] = (t * np.clip(fall / np.maximum(fall + rise, fall), 0.1, 0.7))[short]
        open_cases = open_cases[short]
    return trial.u + length[:, None] * step


def starting_point(problem: EquilibriumProblem, fixed: FloatArray) -> FloatArray:
    """A position in which all elements carry, (n_case, 5) [m]: the axial equilibrium under the sum of the
    loads; rollers at 0 deg: radial. *fixed* (n_case, 5): fixed displacements.
    """
    bearing, u = problem.bearing, fixed.copy()
    size = np.linalg.norm(problem.load, axis=1)
    if 2 in problem.free and (bearing.is_ball or bearing.contact_angle != 0):
        default = np.sign(bearing.contact_angle) or 1.0
        side = np.where(problem.load[:, 2] == 0, default, np.sign(problem.load[:, 2]))
        u[:, 2] = _axial_approach(bearing, size, side)
        return u
    per_element = 4 * size / (bearing.elements * np.cos(bearing.contact_angle))
    reach = (per_element / bearing.stiffness_constant) ** (1 / bearing.exponent) + max(bearing.clearance, 0.0)
    direction = problem.load[:, :2] / np.maximum(size, np.finfo(np.float64).tiny)[:, None]
    radial = [i for i in (0, 1) if i in problem.free]
    u[:, radial] = (reach[:, None] * direction)[:, radial]
    return u


def _axial_approach(bearing: RollingBearing, size: FloatArray, side: FloatArray) -> FloatArray:
    """dz [m] at which *size* [N] loads all elements equally towards *side* (+1, -1)."""
    sin0, cos0 = np.sin(bearing.contact_angle), np.cos(bearing.contact_angle)
    per_element = size / bearing.elements / bearing.stiffness_constant
    if bearing.groove_distance is None:
        delta = (per_element / abs(sin0)) ** (1 / bearing.exponent)
        return (delta + bearing.clearance * cos0) / sin0
    a0 = bearing.groove_distance
    radial = a0 * cos0 - bearing.clearance
    sin = np.full_like(size, np.sqrt(max(1 - (radial / a0) ** 2, 0.01)))
    for _ in range(4):
        distance = a0 + np.minimum((per_element / sin) ** (1 / bearing.exponent), a0 / 4)
        axial = np.sqrt(np.maximum(distance**2 - radial**2, (1e-6 * a0) ** 2))
        sin = axial / distance
    return side * axial - a0 * sin0


# Load cases solved together: many enough for a small overhead of numpy, few enough for the cache.
CASES_AT_ONCE = 512


@dataclass(frozen=True)
class Equilibrium:
    """The state of n_case load cases.

    displacement (n_case, 5) [m, rad]; load (n_case, 5) [N, N m] on the inner ring, reactions of fixed dofs
    included; stiffness K = dF/dq (n_case, 5, 5); contacts: deflection, load and direction of every element;
    angles psi_j (n_case, z) [rad]; free: names of the dofs with prescribed load.
    """

    bearing: RollingBearing
    displacement: FloatArray
    load: FloatArray
    stiffness: FloatArray
    contacts: Contacts
    angles: FloatArray
    free: tuple[str, ...]

    @cached_property
    def contact_angle(self) -> FloatArray:
        """Loaded contact angles a_j (n_case, z) [rad]."""
        return np.arctan2(self.contacts.sin, self.contacts.cos)

    @cached_property
    def mirrored(self) -> BoolArray:
        """Load cases (n_case,) in which an element of an angular-contact bearing carries at the opposite
        contact angle. The equations allow it.
        """
        opposite = self.contacts.sin * np.sign(self.bearing.contact_angle) < 0
        return np.any(
            opposite & (self.contacts.load > 1e-9 * self.contacts.load.max(axis=1, keepdims=True)), axis=1
        )

    @cached_property
    def determinate(self) -> BoolArray:
        """Load cases (n_case,) whose position is unique: the stiffness of the free dofs is not singular."""
        index = [DOFS.index(name) for name in self.free]
        if not index:
            return np.ones(len(self.load), dtype=bool)
        scale = 1 / np.array([1, 1, 1, self.bearing.pitch_radius, self.bearing.pitch_radius])
        eigenvalues = np.linalg.eigvalsh((self.stiffness * np.outer(scale, scale))[:, index][:, :, index])
        return eigenvalues[:, 0] > 1e-10 * eigenvalues[:, -1]


def equilibrium(
    bearing: RollingBearing,
    loads: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    displacements: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    fixed_dofs: Sequence[str] = (),
    cage_angle: ArrayLike = 0.0,
) -> Equilibrium:
    """The equilibrium of the bearing: F_i(q) = f_i for every dof except *fixed_dofs*, where q_i is given.

    *loads* (5,) or (n_case, 5) [N, N m]; *displacements* (5,) or (n_case, 5) [m, rad], used for the dofs
    named in *fixed_dofs* (x y z bx by); *cage_angle* scalar or (n_case,) [rad], angle of the first element
    from x. Raises ConfigError for a load that this kind of bearing cannot carry or displacements beyond the
    model's reach, FitError naming the load case when there is no equilibrium.
    """
    f, q = (np.atleast_2d(np.asarray(values, np.float64)) for values in (loads, displacements))
    cage = np.asarray(cage_angle, np.float64)
    if not bearing.is_ball:
        # ConfigError for dofs without support: rollers at a fixed contact angle resist three motions, at 0
        # deg two
        loose = [name for name in ("bx", "by") if name not in fixed_dofs]
        if loose:
            what = f"rollers at a fixed contact angle leave the tilt {loose[0]} without support"
            raise ConfigError(what, hint=f"hold it: displacements.{loose[0]}")
        if bearing.contact_angle == 0 and "z" not in fixed_dofs:
            if np.any(f[:, 2] != 0):
                what = "rollers at contact angle 0 carry no axial load"
                raise ConfigError(what, hint="remove loads.z, or give a contact angle")
            what = "rollers at contact angle 0 leave z without support"
            raise ConfigError(what, hint="hold it: displacements.z")
    n_case = max(len(f), len(q), cage.size)
    if np.all(cage == cage.flat[0]):
        cage = cage.reshape(-1)[0]  # one frame for all cases
    f, q = (np.broadcast_to(values, (n_case, len(DOFS))) for values in (f, q))
    parts = []
    for start in range(0, n_case, CASES_AT_ONCE):
        part = slice(start, start + CASES_AT_ONCE)
        part_cage = cage[part] if cage.ndim else cage
        displacement = _solve_part(bearing, f, q, fixed_dofs, part_cage, part)
        angles = bearing.angles(part_cage)
        frame = ElementFrame.at(angles, bearing.pitch_radius)
        at = contacts(bearing, displacement, frame)
        free = tuple(name for name in DOFS if name not in fixed_dofs)
        forces = load_sum(at, frame), stiffness_sum(at, frame)
        case_angles = np.broadcast_to(angles, at.load.shape)
        parts.append(Equilibrium(bearing, displacement, *forces, at, case_angles, free))
    return _join(parts)


def _solve_part(
    bearing: RollingBearing,
    f: FloatArray,
    q: FloatArray,
    fixed_dofs: Sequence[str],
    cage: FloatArray,
    part: slice,
) -> FloatArray:
    scale = np.array([1, 1, 1, bearing.pitch_radius, bearing.pitch_radius])
    frame = ElementFrame.at(bearing.angles(cage), 1.0)
    free = np.array([name not in fixed_dofs for name in DOFS])
    problem = EquilibriumProblem(bearing, frame, np.where(free, f[part] / scale, 0.0), np.flatnonzero(free))
    u, solved = solve(problem, np.where(free, 0.0, q[part] * scale))
    if not solved.all():
        # Raise the FitError of a load case without equilibrium; *loads* (n_case, 5) [N, N m]
        loads = np.where(free, f, 0.0)
        case = part.start + int(np.flatnonzero(~solved)[0])
        acting = ", ".join(
            f"{name} {amount:.4g} {unit}"
            for name, amount, unit in zip(LOADS, loads[case], LOAD_UNITS, strict=True)
            if amount
        )
        what = f"{_case(case, len(loads))}no rest position: the bearing cannot carry {acting or 'no load'}"
        of_rollers = "the load does not press the elements onto their tracks"
        raise FitError(what, hint="check the size of the loads" if bearing.is_ball else of_rollers)
    return u / scale


def _join(parts: Sequence[Equilibrium]) -> Equilibrium:
    def join_cases(of: Sequence[Any], names: Iterable[str]) -> dict[str, Any]:
        return {name: np.concatenate([getattr(part, name) for part in of]) for name in names}

    at = Contacts(**join_cases([part.contacts for part in parts], (field.name for field in fields(Contacts))))
    # FitError where the deflection exceeds the range of Hertzian contact, or the angle exceeds 90 deg
    bearing = parts[0].bearing
    for case, element in np.argwhere(at.deflection > bearing.reach)[:1].tolist():
        what = f"is pressed in by {1e6 * at.deflection[case, element]:.4g} um"
        hint = f"the model holds up to {1e6 * bearing.reach:.4g} um: check loads and displacements"
        raise FitError(f"{_case(case, len(at.load))}element {element + 1} {what}", hint=hint)
    for case, element in np.argwhere((at.deflection > 0) & (at.cos < 0))[:1].tolist():
        what = "carries at a contact angle beyond 90 deg: the rings have come apart"
        hint = "the bearing cannot carry this load"
        raise FitError(f"{_case(case, len(at.load))}element {element + 1} {what}", hint=hint)
    arrays = join_cases(parts, ("displacement", "load", "stiffness", "angles"))
    return replace(parts[0], contacts=at, **arrays)

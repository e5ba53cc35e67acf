"""Newton's method with a line search on the convex load potential of a rolling bearing, many load cases in parallel."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from labpipe.arrays import BoolArray, FloatArray, IntArray
from labpipe.bearings.rolling import Contacts, ElementFrame, RollingBearing, contacts, load_sum, stiffness_sum

TOLERANCE = 1e-12  # of the residual against the loads
ACCEPTABLE = 1e-9  # where steps are down to the rounding of positions
ROUNDING = 4 * np.finfo(np.float64).eps
NEGLIGIBLE = 1e-6  # deflection over the longest step that counts as zero: an unloaded bearing is in equilibrium as well
MAX_ITERATIONS = 1000  # a dozen as a rule; changing to the opposite contact angle takes hundreds of short steps
MAX_CUTS = 40
# Largest displacement of an equilibrium over the pitch radius.
REACH = 0.2


@dataclass(frozen=True)
class Problem:
    """Load cases of one bearing: u with F_i(u) = f_i for the *free* dofs (indices), the others fixed.

    load (n_case, 5) [N]; moments are divided and tilts multiplied by the pitch radius, so that all five have one unit.
    """

    bearing: RollingBearing
    frame: ElementFrame
    load: FloatArray
    free: IntArray

    def of_cases(self, cases: BoolArray) -> Problem:
        """The problem of the load cases *cases* (n_case,)."""
        return Problem(self.bearing, self.frame.of_cases(cases), self.load[cases], self.free)

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
        misfit: FloatArray = np.linalg.norm(trial.residual, axis=1) / acting
        return misfit


@dataclass(frozen=True)
class Trial:
    """A position u (n_case, 5) [m], the contacts there, the residual f - F of the free dofs [N], and the potential [J]."""

    u: FloatArray
    state: Contacts
    residual: FloatArray
    potential: FloatArray

    def of_cases(self, cases: BoolArray) -> Trial:
        """The trial positions of the load cases *cases* (n_case,)."""
        state = Contacts(*(getattr(self.state, field.name)[cases] for field in fields(Contacts)))
        return Trial(self.u[cases], state, self.residual[cases], self.potential[cases])


def solve(problem: Problem, fixed: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Positions u (n_case, 5) [m], and whether each is an equilibrium; *fixed* (n_case, 5): displacements, zero where free."""
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
            unsolved, problem, trial, step = unsolved[active], problem.of_cases(active), trial.of_cases(active), step[active]
        u[unsolved] = line_search(problem, trial, step)
    return u, solved


def newton_step(problem: Problem, trial: Trial) -> FloatArray:
    """(K + |f - F| / R) p = f - F, (n_case, 5) [m]: limited to the bearing's reach R without stiffness, converging quadratically.

    Equation (roll-newton).
    """
    k = stiffness_sum(trial.state, problem.frame)[:, problem.free[:, None], problem.free]
    floor = 1e-15 * np.trace(k, axis1=1, axis2=2) + np.finfo(np.float64).tiny
    restraint = np.linalg.norm(trial.residual, axis=1) / problem.bearing.reach + floor
    k = k + restraint[:, None, None] * np.eye(problem.free.size)
    step = np.zeros_like(trial.u)
    step[:, problem.free] = np.linalg.solve(k, trial.residual[:, :, None])[:, :, 0]
    return step


def line_search(problem: Problem, trial: Trial, step: FloatArray) -> FloatArray:
    """Next position u + t p, (n_case, 5) [m], from t = 1, reduced until the potential decreases or its slope along p is not positive.

    A convex potential decreases as long as its slope at the end of the step is not positive; that test also works where differences of
    the potential are below rounding. A reduction goes to the zero of the secant of the slope.
    """
    descent = np.einsum("nf,nf->n", trial.residual, step[:, problem.free])
    length = np.ones(len(step))
    open_cases = np.arange(len(step))
    for _ in range(MAX_CUTS):
        part = problem if open_cases.size == len(step) else problem.of_cases(_mask(open_cases, len(step)))
        t, p, fall = length[open_cases], step[open_cases], descent[open_cases]
        there = part.at(trial.u[open_cases] + t[:, None] * p)
        rise = -np.einsum("nf,nf->n", there.residual, p[:, problem.free])
        fallen = there.potential <= trial.potential[open_cases] - 1e-4 * t * fall
        short = ~(fallen | (rise <= 0.1 * fall))
        if not short.any():
            break
        length[open_cases[short]] = (t * np.clip(fall / np.maximum(fall + rise, fall), 0.1, 0.7))[short]
        open_cases = open_cases[short]
    position: FloatArray = trial.u + length[:, None] * step
    return position


def _mask(indices: IntArray, size: int) -> BoolArray:
    mask = np.zeros(size, dtype=bool)
    mask[indices] = True
    return mask


def starting_point(problem: Problem, fixed: FloatArray) -> FloatArray:
    """A position in which all elements carry, (n_case, 5) [m]: the axial equilibrium under the sum of the loads; rollers at 0 deg: radial.

    *fixed* (n_case, 5): fixed displacements. At q = 0 a bearing with contact angle 0 has no stiffness.
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
    """dz [m] at which *size* [N] loads all elements equally towards *side* (+1, -1), by fixed-point steps of the contact angle."""
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

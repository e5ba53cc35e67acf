"""An oil film solved independently of labpipe: stiffness and damping of a worn or grooved journal bearing by
exact complementarity.

Vertices instead of cells, those of the wear's edges on them; conductances by Gauss points; the pressure is
either above its least value or the surplus is zero, exactly, by active sets (each a sparse direct solution);
the linearisation is exact for the last active set. Frame: y horizontal, z up, theta from +y to +z, spin y to
z, K = -dF/dx, C = -dF/dx'. Mesh error on 960 x 120 vertices, from 1920 x 240: .02 to .09 % of the largest
coefficient (the front jumps from vertex to vertex).
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np
from scipy.sparse import csc_matrix, diags, kron
from scipy.sparse.linalg import SuperLU, splu

POINTS = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18
COARSEST = 150


@dataclass(frozen=True)
class Bearing:
    """Lengths [m], *clearance* radial, viscosity [Pa s], wear depth [m] at an angle [rad], two grooves of
    *groove* [rad].
    """

    diameter: float
    length: float
    clearance: float
    viscosity: float
    _: KW_ONLY
    depth: float = 0.0
    angle: float = 0.0
    groove: float = 0.0


class Film:
    """The dimensionless film on *around* vertices by half of *across* strips.

    Pressures over 6 mu Omega (R / c)^2.
    """

    def __init__(self, bearing: Bearing, around: int, across: int) -> None:
        depth = bearing.depth / bearing.clearance
        self.place = _vertices(around, depth, bearing.angle)
        self.arc = np.append(np.diff(self.place), self.place[0] + 2 * np.pi - self.place[-1])
        points = self.place[:, None] + self.arc[:, None] * POINTS
        self.bore = 1 + (
            np.maximum(0, depth - 1 - np.cos(points - np.pi / 2 - bearing.angle)) if depth > 0 else 0 * points
        )
        self.by_move = -np.stack([np.cos(points), np.sin(points)])
        self.strips = across // 2
        self.width = np.full(self.strips, 1 / self.strips)
        self.width[0] /= 2
        leak = 2 * np.eye(self.strips) - np.eye(self.strips, k=1) - np.eye(self.strips, k=-1)
        leak[0, 0] = 1
        self.leak = csc_matrix(leak * self.strips * (bearing.diameter / bearing.length) ** 2)
        from_split = np.abs(np.mod(self.place + np.pi / 2, np.pi) - np.pi / 2)
        self.free = np.repeat((from_split > bearing.groove / 2 + 1e-9) | (bearing.groove == 0), self.strips)
        self.weights = np.stack([np.kron(self.lumped(move), self.width) for move in self.by_move])
        self.active = self.free.copy()

    def lumped(self, values: np.ndarray) -> np.ndarray:
        """int f phi_i over the arcs on both sides of a vertex."""
        before, after = self.arc * (values * (1 - POINTS) @ WEIGHTS), self.arc * (values * POINTS @ WEIGHTS)
        return before + np.roll(after, 1)

    def wedge(self, thickness: np.ndarray) -> np.ndarray:
        """int h' phi_i = -int h phi_i'."""
        mean = thickness @ WEIGHTS
        return np.kron(mean - np.roll(mean, 1), self.width)

    def operator(self, conductance: np.ndarray) -> csc_matrix:
        n, here = self.arc.size, np.arange(self.arc.size)
        after, flow = (here + 1) % n, conductance @ WEIGHTS / self.arc
        rows, columns = np.concatenate([here, after, here, after]), np.concatenate([here, after, after, here])
        around = csc_matrix((np.concatenate([flow, flow, -flow, -flow]), (rows, columns)), (n, n))
        return csc_matrix(kron(around, diags(self.width)) + kron(diags(self.lumped(conductance)), self.leak))

    def solved(self, move: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force (2,), -dF/de and -dF/d(e'/Omega), (2, 2), at a displacement over clearance."""
        thickness = self.bore + np.tensordot(move, self.by_move, 1)
        assert thickness.min() > 0
        operator, wedge = self.operator(thickness**3), self.wedge(thickness)
        pressure, factors = self._complementary(operator, wedge)
        index = np.flatnonzero(self.active)
        stiffness, damping = np.empty((2, 2)), np.empty((2, 2))
        for axis, by_move in enumerate(self.by_move):
            change = self.wedge(by_move) + self.operator(3 * thickness**2 * by_move) @ pressure
            squeeze = 2 * np.kron(self.lumped(by_move), self.width)
            stiffness[:, axis] = self.weights[:, index] @ factors.solve(change[index])
            damping[:, axis] = self.weights[:, index] @ factors.solve(squeeze[index])
        return self.weights @ pressure, stiffness, damping

    def _complementary(self, operator: csc_matrix, wedge: np.ndarray) -> tuple[np.ndarray, SuperLU]:
        """p >= 0, A p + wedge >= 0, one of both zero."""
        for _ in range(100):
            index = np.flatnonzero(self.active)
            symmetric = {"SymmetricMode": True}
            factors = splu(
                operator[index][:, index].tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options=symmetric,
            )
            pressure = np.zeros(wedge.size)
            pressure[index] = factors.solve(-wedge[index])
            surplus = operator @ pressure + wedge
            active = np.where(self.active, pressure > 0, surplus < -1e-13 * np.abs(wedge).max()) & self.free
            if np.array_equal(active, self.active):
                return pressure, factors
            self.active = active
        raise AssertionError("the active set does not settle")

    def start_from(self, coarse: Film) -> None:
        """The active set of a coarser film as a start."""
        around = np.minimum(
            np.rint(np.arange(self.arc.size) * coarse.arc.size / self.arc.size).astype(int),
            coarse.arc.size - 1,
        )
        across = np.minimum(
            np.rint(np.arange(self.strips) * coarse.strips / self.strips).astype(int), coarse.strips - 1
        )
        self.active = coarse.active.reshape(-1, coarse.strips)[around][:, across].ravel() & self.free

    def balanced(self, load: np.ndarray, move: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Displacement in equilibrium with a *load* (2,), stiffness and damping there."""
        for _ in range(40):
            force, stiffness, damping = self.solved(move)
            step = np.linalg.solve(stiffness, load + force)
            thinnest = (self.bore + np.tensordot(move, self.by_move, 1)).min()
            while (self.bore + np.tensordot(move + step, self.by_move, 1)).min() < 0.2 * thinnest:
                step = step / 2
            move = move + step
            if np.abs(step).max() < 1e-7:
                return move, stiffness, damping
        raise AssertionError("no equilibrium")


def _vertices(around: int, depth: float, angle: float) -> np.ndarray:
    """Angles of the vertices: two of them on the edges of the wear, equal arcs between those."""
    if depth <= 0:
        return np.arange(around) * 2 * np.pi / around
    half = float(np.arccos(1 - depth))
    first, worn = 1.5 * np.pi + angle - half, round(around * half / np.pi)
    rest = around - worn
    return np.concatenate(
        [
            first + 2 * half * np.arange(worn) / worn,
            first + 2 * half + 2 * (np.pi - half) * np.arange(rest) / rest,
        ]
    )


def coefficients(
    bearing: Bearing, load: tuple[float, float], speed: float, around: int = 960, across: int = 120
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement over clearance (2,), K [N/m] and C [N s/m] (2, 2) under a *load* (2,) [N] at *speed*
    [rad/s].
    """
    scale = (
        6
        * bearing.viscosity
        * speed
        * (bearing.diameter / 2 / bearing.clearance) ** 2
        * bearing.diameter
        / 2
        * bearing.length
    )
    meshes = [(around, across)]
    while meshes[-1][0] > COARSEST:
        meshes.append((meshes[-1][0] // 2, max(2 * (meshes[-1][1] // 4), 8)))
    move, film = 0.3 * np.array(load) / np.hypot(*load), None
    for mesh in reversed(meshes):
        finer = Film(bearing, *mesh)
        if film is not None:
            finer.start_from(film)
        film = finer
        move, stiffness, damping = film.balanced(np.array(load) / scale, move)
    return move, stiffness * scale / bearing.clearance, damping * scale / (bearing.clearance * speed)

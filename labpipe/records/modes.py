"""Modes of a structure: shapes with their doubt, and the stabilisation diagram that they were chosen from."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.records.geometry import Geometry


@dataclass(frozen=True)
class StabilisationDiagram:
    """Poles of all orders: frequency (n,) [Hz], damping_ratio (n,) [1], order (n,), mode (n,): number of the mode from 0, -1 for none.

    indicator (n_line, n_indicator): complex mode indicator function, the singular values of the FRF matrix [unit of the FRF] over
    indicator_frequency (n_line,) [Hz] (Shih, Tsuei, Allemang and Brown 1988).
    """

    frequency: FloatArray
    damping_ratio: FloatArray
    order: IntArray
    mode: IntArray
    _: KW_ONLY
    indicator_frequency: FloatArray
    indicator: FloatArray


@dataclass(frozen=True)
class Modes:
    """Modes in ascending frequency: natural frequency f = |lambda| / 2 pi [Hz], damping ratio -Re lambda / |lambda| [1].

    shapes (n_point, n_mode) [1]: complex, the largest point of each is 1; shape_std_errors (n_point, n_mode) [1]: of the complex
    value, sqrt(variance of real + imaginary part). participation (n_mode, n_reference) [1], the largest 1; residues [unit of the
    FRF's receptance times rad/s] = scale * shape * participation, scale (n_mode,). points, references: labels of the two sides of the
    FRF matrix; *forces_move*: the points are forces (a roving hammer). mac (n_mode, n_mode) [1]: modal assurance criterion between the
    shapes; collinearity (n_mode,) [1]: modal phase collinearity, 1 for a real shape (Juang and Pappa 1985).
    lower, upper: numbers of residual terms s^-2, s^-4 ... and 1, s^2 ... in the fit. driving_points: dof at which mass, stiffness and
    damping of each mode are given, that with its largest residue; empty where no point is a reference.
    dofs: place and direction of every point of the shapes; geometry: where they are, if it is known.
    """

    frequency: FloatArray
    damping_ratio: FloatArray
    _: KW_ONLY
    shapes: ComplexArray
    shape_std_errors: FloatArray
    participation: ComplexArray
    scale: ComplexArray
    points: tuple[str, ...]
    references: tuple[str, ...]
    forces_move: bool
    mac: FloatArray
    collinearity: FloatArray
    lower: int
    upper: int
    driving_points: tuple[str, ...] = ()
    diagram: StabilisationDiagram | None = None
    dofs: tuple[str, ...] = ()
    geometry: Geometry | None = None

"""What fits of a model show beside their parameters, and the table of these records."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.records.rig import Geometry
from labpipe.registry import Registry


class FitDetail:
    """What a fit of a model shows beside its parameters; *key*: of its record in a result.

    in_time: what was measured are records over time. given_in_noise: what given numbers add is part of the
    standard errors by noise.
    """

    key: ClassVar[str]
    in_time: ClassVar[bool] = False
    given_in_noise: ClassVar[bool] = False

    def given_covariance(self, n_parameter: int) -> FloatArray:
        """Covariance (n_parameter, n_parameter) [units of the fitted parameters] by given numbers in these
        standard errors.
        """
        return np.zeros((n_parameter, n_parameter))

    @property
    def course(self) -> tuple[FloatArray, ComplexArray] | None:
        """Frequency (n,) [Hz] and the fitted dynamic stiffness (n, 2, 2) [N/m] over it, where the detail has
        one.
        """
        return None


@dataclass(frozen=True)
class FitDetailKind:
    """An entry of the table of details: the class of the record, and the blocks of the report for a fit with
    such a record.
    """

    record: type[FitDetail]
    blocks: Callable[[Any, Any], Iterable[Any]]


# FitDetailKinds by the key of their records.
DETAILS = Registry("fit detail")


# Modes of a structure: shapes with their uncertainty, and the stabilisation diagram that they were chosen
# from.


@dataclass(frozen=True)
class StabilisationDiagram:
    """Poles of all orders: frequency (n,) [Hz], damping_ratio (n,) [1], order (n,), mode (n,): number of the
    mode from 0, -1 for none.

    indicator (n_line, n_indicator): complex mode indicator function, the singular values of the FRF matrix
    [unit of the FRF] over indicator_frequency (n_line,) [Hz] (Shih, Tsuei, Allemang and Brown 1988).
    """

    frequency: FloatArray
    damping_ratio: FloatArray
    order: IntArray
    mode: IntArray
    _: KW_ONLY
    indicator_frequency: FloatArray
    indicator: FloatArray


@dataclass(frozen=True)
class Modes(FitDetail):
    """Modes in ascending frequency: natural frequency f = |lambda| / 2 pi [Hz], damping ratio -Re lambda /
    |lambda| [1].

    shapes (n_point, n_mode) [1]: complex, the largest point of each is 1; shape_std_errors (n_point, n_mode)
    [1]: of the complex value, sqrt(variance of real + imaginary part). participation (n_mode, n_reference)
    [1], the largest 1; residues [unit of the FRF's receptance times rad/s] = scale * shape * participation,
    scale (n_mode,). points, references: labels of the two sides of the FRF matrix; *forces_move*: the points
    are forces (a roving hammer). mac (n_mode, n_mode) [1]: modal assurance criterion between the shapes;
    collinearity (n_mode,) [1]: modal phase collinearity, 1 for a real shape (Juang and Pappa 1985). lower,
    upper: numbers of residual terms s^-2, s^-4 ... and 1, s^2 ... in the fit. driving_points: dof at which
    mass, stiffness and damping of each mode are given, that with its largest residue; empty where no point is
    a reference. dofs: place and direction of every point of the shapes; geometry: where they are, if it is
    known. returns (n_mode,) [1]: share of the orders of the diagram that have a pole at the mode. modal_a
    (n_mode,) [kg rad/s]: phi_d^2 / R of the shape phi and the residue R at the driving point d, 2 j w_d times
    the modal mass of a real mode; None without driving points.
    """

    key: ClassVar[str] = "modes"
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
    returns: FloatArray | None = None
    modal_a: ComplexArray | None = None


# What a fitted free decay shows beside its parameters: the course over time, and damping and frequency over
# amplitude.


@dataclass(frozen=True)
class AmplitudeLaw:
    """A' = -w (zeta_rest + zeta_slope A) A, phase' = w + frequency_slope A; A amplitude [SI unit of the
    output], w [rad/s].

    p_value: chance of residuals so unlike noise if the law is right.
    """

    omega: float
    zeta_rest: float
    zeta_slope: float
    frequency_slope: float
    p_value: float


@dataclass(frozen=True)
class OverAmplitude:
    """One mode piece by piece: damping ratio (n,) [1] and frequency (n,) [Hz] over amplitude (n,) [*unit*].

    Each with its standard error of the same shape and unit. law: where damping or frequency depend on the
    amplitude, else None.
    """

    amplitude: FloatArray
    damping: FloatArray
    damping_std_error: FloatArray
    frequency: FloatArray
    frequency_std_error: FloatArray
    _: KW_ONLY
    law: AmplitudeLaw | None = None
    unit: str = ""


@dataclass(frozen=True)
class RingDown(FitDetail):
    """The largest decay of a fit over time (n,) [s]: measured, fitted and residual, each (n,) [SI unit of the
    output].

    Of long decays the least and the largest value of every short stretch stand one after the other. *modes*:
    in ascending frequency.
    """

    key: ClassVar[str] = "ring_down"
    in_time: ClassVar[bool] = True
    recording: str
    output: str
    unit: str
    time: FloatArray
    measured: FloatArray
    fitted: FloatArray
    residual: FloatArray
    modes: tuple[OverAmplitude, ...] = ()


# What a fitted dynamic stiffness shows beside its parameters: the course over frequency, and what given
# numbers do to the estimates.


@dataclass(frozen=True)
class GivenUncertainty:
    """What the uncertainty of given numbers of one *source* does to the estimates; the same source is the
    same error in every fit.

    changes (n, n_parameter) [units of the fitted parameters]: n independent errors of one standard deviation
    each. std_error [unit] of the number, 1 of several.
    """

    source: str
    changes: FloatArray
    _: KW_ONLY
    std_error: float = 1.0
    unit: str = "1"


def systematic(uncertainties: Sequence[GivenUncertainty], n_parameter: int) -> FloatArray:
    """Covariance (n_parameter, n_parameter) [units of the fitted parameters] of all given numbers
    together.
    """
    rows = [np.zeros((1, n_parameter)), *(uncertainty.changes for uncertainty in uncertainties)]
    joint = np.concatenate(rows)
    return joint.T @ joint


@dataclass(frozen=True)
class OtherExcitation:
    """Ratios of the standard errors by noise that another excitation of the same time and peak force would
    have given, by K, C, M.
    """

    name: str
    matrices: tuple[str, ...]
    ratios: tuple[float, ...]


@dataclass(frozen=True)
class DynamicStiffness(FitDetail):
    """Dynamic stiffness H(w) [N/m] of a floating bearing, force in the row's direction per displacement in
    the column's, x then y.

    form, symmetry: of the model; values (n_parameter,): as they are fitted (of positive shape parameters the
    logarithm), noise (n_parameter, n_parameter): their covariance by noise and by what the form leaves
    unexplained, uncertainties: what given numbers add to it. frequency (n_line,) [Hz], measured (n_line, 2,
    2) [N/m]: line by line without a model, variance (n_line, 2, 2) [(N/m)^2] of the complex values; *paired*:
    of two neighbouring lines each, since a line alone has one vector. Empty where lines do not tell H.
    drawn_frequency (n,) [Hz] with fitted (n, 2,
    2) and, where there is one, baseline (n, 2, 2) [N/m]. effective_stiffness, effective_damping (n, 3): of
    forward circular orbits at drawn_frequency, value, lower and upper end of the 95 % interval [N/m, N.s/m].
    """

    key: ClassVar[str] = "dynamic_stiffness"
    given_in_noise: ClassVar[bool] = True
    form: str
    symmetry: str
    values: FloatArray
    noise: FloatArray
    uncertainties: tuple[GivenUncertainty, ...]
    _: KW_ONLY
    frequency: FloatArray
    measured: ComplexArray
    variance: FloatArray
    paired: bool
    drawn_frequency: FloatArray
    fitted: ComplexArray
    effective_stiffness: FloatArray
    effective_damping: FloatArray
    baseline: ComplexArray | None = None
    bands: tuple[float, ...] = ()
    absolute: bool = False
    excitations: tuple[OtherExcitation, ...] = ()

    def given_covariance(self, n_parameter: int) -> FloatArray:
        """Covariance (n_parameter, n_parameter) [units of the fitted parameters] by what was given, not
        fitted.
        """
        return systematic(self.uncertainties, n_parameter)

    @property
    def course(self) -> tuple[FloatArray, ComplexArray]:
        """Frequency (n,) [Hz] and the fitted dynamic stiffness (n, 2, 2) [N/m] over it."""
        return self.drawn_frequency, self.fitted


# A plant for robust control design: nominal model as state space, and the band around it that holds the
# true plant.


@dataclass(frozen=True)
class RobustPlant(FitDetail):
    """Nominal plant dx/dt = A x + B u, y = C x + D u, and |G - G_nominal| <= radius at all lines together
    with *confidence*.

    frequency (n_line,) [Hz]; nominal, radius [unit] and weight [1], (n_line, n_output, n_input): the weight
    is the radius over the largest singular value of G_nominal, |G| of one axis. a (n, n), b (n, n_input), c
    (n_output, n), d (n_output, n_input) [SI]. overbound (n_output, n_input, 3): k [1], zero and pole [Hz] of
    the least k (1 + j f / zero) / (1 + j f / pole) nowhere below the weight.
    """

    key: ClassVar[str] = "robust"
    frequency: FloatArray
    nominal: ComplexArray
    radius: FloatArray
    weight: FloatArray
    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    overbound: FloatArray
    confidence: float
    unit: str
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]

    def bound(self, output: int, input_number: int) -> FloatArray:
        """The overbound of one element at all lines, (n_line,) [1]."""
        gain, zero, pole = self.overbound[output, input_number]
        return np.asarray(gain * np.abs((1 + 1j * self.frequency / zero) / (1 + 1j * self.frequency / pole)))


@dataclass(frozen=True)
class Region(FitDetail):
    """Confidence region of two parameters: its closed *outline* (n_point, 2) [SI units], its *level*."""

    key: ClassVar[str] = "region"
    names: tuple[str, str]
    outline: FloatArray
    level: float

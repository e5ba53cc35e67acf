"""What a fitted dynamic stiffness shows beside its parameters: the course over frequency, and what given numbers do to the estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray


@dataclass(frozen=True)
class GivenDoubt:
    """What the doubt of given numbers of one *source* does to the estimates; the same source is the same error in every fit.

    changes (n, n_parameter) [units of the fitted parameters]: n independent errors of one standard deviation each. std_error [unit] of
    the number, 1 of several.
    """

    source: str
    changes: FloatArray
    _: KW_ONLY
    std_error: float = 1.0
    unit: str = "1"


def systematic(doubts: Sequence[GivenDoubt], n_parameter: int) -> FloatArray:
    """Covariance (n_parameter, n_parameter) [units of the fitted parameters] of all given numbers together."""
    rows = [np.zeros((1, n_parameter)), *(doubt.changes for doubt in doubts)]
    joint = np.concatenate(rows)
    return joint.T @ joint


@dataclass(frozen=True)
class OtherExcitation:
    """Ratios of the standard errors by noise that another excitation of the same time and peak force would have given, by K, C, M."""

    name: str
    matrices: tuple[str, ...]
    ratios: tuple[float, ...]


@dataclass(frozen=True)
class DynamicStiffness:
    """Dynamic stiffness H(w) [N/m] of a floating bearing, force in the row's direction per displacement in the column's, x then y.

    form, symmetry: of the model; values (n_parameter,): as they are fitted (of positive shape parameters the logarithm), noise
    (n_parameter, n_parameter): their covariance by noise alone, doubts: what given numbers add to it.
    frequency (n_line,) [Hz], measured (n_line, 2, 2) [N/m]: line by line without a model, variance (n_line, 2, 2) [(N/m)^2] of the complex
    values; *paired*: of two neighbouring lines each, since a line alone has one vector. Empty where lines do not tell H.
    drawn_frequency (n,) [Hz] with fitted (n, 2, 2) and, where there is one, baseline (n, 2, 2) [N/m].
    effective_stiffness, effective_damping (n, 3): of forward circular orbits at drawn_frequency, value, lower and upper end of the 95 %
    interval [N/m, N.s/m].
    """

    form: str
    symmetry: str
    values: FloatArray
    noise: FloatArray
    doubts: tuple[GivenDoubt, ...]
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

"""What doubts of geometry, oil, loads and gains do to the coefficients of a bearing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.coefficients import BearingCoefficients
from labpipe.records.doubt import Doubt


@dataclass(frozen=True)
class BearingDoubts:
    """Changes of the coefficients by one standard uncertainty of each of the *sources*, with their signs.

    stiffness, damping (n_source, n_dof, n_dof) [SI units of the coefficients]; rest (n_source, n_amount): of the amounts at rest.
    """

    sources: tuple[Doubt, ...]
    stiffness: FloatArray
    damping: FloatArray
    rest: FloatArray

    @property
    def stiffness_error(self) -> FloatArray:
        """Standard uncertainty (n_dof, n_dof) [SI units of the stiffness] by all sources, which are independent."""
        return np.asarray(np.sqrt(np.sum(self.stiffness**2, axis=0)))

    @property
    def damping_error(self) -> FloatArray:
        """Standard uncertainty (n_dof, n_dof) [SI units of the damping]."""
        return np.asarray(np.sqrt(np.sum(self.damping**2, axis=0)))

    @property
    def rest_error(self) -> FloatArray:
        """Standard uncertainty (n_amount,) of the amounts at rest [unit of each]."""
        return np.asarray(np.sqrt(np.sum(self.rest**2, axis=0)))

    def shares(self, changes: FloatArray) -> list[tuple[str, float]]:
        """Source and its share in the variance of one amount, the largest first; *changes* (n_source,) [unit of the amount]."""
        whole = float(np.sum(changes**2))
        parts = [(source.source, float(change**2) / whole) for source, change in zip(self.sources, changes, strict=True)] if whole else []
        return sorted(parts, key=lambda pair: -pair[1])


def bearing_doubts(sources: Sequence[Doubt], ends: Sequence[tuple[BearingCoefficients, BearingCoefficients]]) -> BearingDoubts:
    """Half the difference of the coefficients with every number one standard uncertainty above and below its value (GUM 5.1.3, note 2).

    *ends*: those two for each of *sources*; numbers of one source change together, so that their changes add up with their signs.
    Equation (unc-bearing).
    """
    names = list(dict.fromkeys(source.source for source in sources))
    first = {source.source: source for source in reversed(sources)}

    def changes(values: Sequence[FloatArray]) -> FloatArray:
        return np.array([sum(change for source, change in zip(sources, values, strict=True) if source.source == name) for name in names])

    return BearingDoubts(
        tuple(first[name] for name in names),
        changes([(high.stiffness - low.stiffness) / 2 for high, low in ends]),
        changes([(high.damping - low.damping) / 2 for high, low in ends]),
        changes([(_rest(high) - _rest(low)) / 2 for high, low in ends]),
    )


def _rest(coefficients: BearingCoefficients) -> FloatArray:
    return np.array([amount.value for amount in coefficients.rest])

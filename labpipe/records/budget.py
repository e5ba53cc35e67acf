"""The uncertainty budget of a fit: what noise and every systematic source leave of its parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.records.doubt import Doubt


@dataclass(frozen=True)
class Budget:
    """Doubts of the parameters *names* of a fit, in their units.

    random (n_parameter,) [unit of the parameter]: standard uncertainties by noise, with what the residual shows beyond it, NaN where there
    is none; random_dof behind them. sources: systematic ones; changes (n_source, n_parameter) [unit of the parameter]: change of every
    parameter by one standard uncertainty of the source, with its sign: their outer products are the covariance by each source.
    drawn (n_parameter, 3) [unit of the parameter]: scatter and ends of the 95 % interval of Monte Carlo draws of noise and sources, None
    where there are none.
    """

    names: tuple[str, ...]
    random: FloatArray
    random_dof: float | None
    sources: tuple[Doubt, ...]
    changes: FloatArray
    drawn: FloatArray | None = None

    @property
    def systematic(self) -> FloatArray:
        """Standard uncertainty (n_parameter,) [unit of the parameter] of all sources together; they are independent of each other.

        Equation (unc-systematic).
        """
        return np.asarray(np.sqrt(np.sum(self.changes**2, axis=0)))

    @property
    def combined(self) -> FloatArray:
        """Combined standard uncertainty (n_parameter,) [unit of the parameter]. Equation (unc-combined)."""
        return np.hypot(self.random, self.systematic)

    @property
    def dof(self) -> FloatArray:
        """Effective degrees of freedom (n_parameter,) [1]: u_c^4 / sum u_i^4 / nu_i (Welch and Satterthwaite, GUM G.4.1); inf: known.

        Equation (unc-dof).
        """
        terms = [self.random**4 / self.random_dof if self.random_dof else np.zeros_like(self.random)]
        terms += [change**4 / source.dof for change, source in zip(self.changes, self.sources, strict=True) if source.dof]
        total = np.sum(terms, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(total > 0, self.combined**4 / total, np.inf)

    def with_sources(self, sources: tuple[Doubt, ...], changes: FloatArray) -> Budget:
        """The budget with further sources and their changes (n_source, n_parameter) [unit of the parameter]; draws did not hold these."""
        return replace(self, sources=(*self.sources, *sources), changes=np.vstack([self.changes, changes]), drawn=None)

    def shares(self, name: str) -> dict[str, float]:
        """Share of every source in the variance of a parameter, noise among them, the largest first; they add up to 1.

        Equation (unc-share).
        """
        column = self.names.index(name)
        parts = {"noise": float(self.random[column] ** 2)}
        parts.update({source.source: float(change[column] ** 2) for source, change in zip(self.sources, self.changes, strict=True)})
        whole = sum(parts.values())
        return {part: value / whole for part, value in sorted(parts.items(), key=lambda pair: -pair[1])} if whole > 0 else parts

    def change_by(self, source: str, name: str) -> float:
        """Change of a parameter by one standard uncertainty of a source; zero for a source that the fit does not have."""
        column = self.names.index(name)
        numbers = [number for number, source_of_change in enumerate(self.sources) if source_of_change.source == source]
        return float(sum(self.changes[number, column] for number in numbers))

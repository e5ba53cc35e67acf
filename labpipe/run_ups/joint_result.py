"""Result of the joint fit and its predictions at any load: coefficients, critical speed and threshold with their intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import FitError
from labpipe.records.doubt import Doubt
from labpipe.records.settings import Uncertain
from labpipe.rigs.film_family import PARAMETERS, FilmFamily
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.rotors.threshold import CoefficientsAtSpeed

# Chi-square probability below which the family is rejected.
REJECTED = 1e-3
# Tolerance of the range of fitted loads, relative.
LOAD_SLACK = 0.01
# Parameters that are exponents, not logarithms of factors.
EXPONENTS = ("viscosity_speed", "viscosity_load")
# Step of a difference, in standard errors along each axis of the covariance.
STEP = 0.5


@dataclass(frozen=True, kw_only=True)
class JointFit:
    """Logarithms *values* (12,) of PARAMETERS about the rotor file's bearing, *covariance* (12, 12), at_bound (12,).

    loads [N]: those of the fit; chi2, n_datum: of responses and thresholds together; n_effective: parameters that the data determine
    against the priors; threshold_chi2, n_threshold: of the thresholds alone; rank, condition: of the data, in units of the priors;
    prior_dominated: combinations that the priors determine, as text; known: parameters that were not estimated. systematic (n_source,
    12): changes by one standard uncertainty of each of the *sources*, doubts of the probes; chi2 is without what these explain.
    """

    rig: RunUpRotor
    family: FilmFamily
    loads: tuple[float, ...]
    values: FloatArray
    covariance: FloatArray
    at_bound: BoolArray
    chi2: float
    n_datum: int
    n_effective: float
    threshold_chi2: float
    n_threshold: int
    rank: int
    condition: float
    prior_dominated: tuple[str, ...]
    steps: int
    known: tuple[str, ...] = ()
    sources: tuple[Doubt, ...] = ()
    systematic: FloatArray = field(default_factory=lambda: np.zeros((0, len(PARAMETERS))))

    @property
    def chi2_per_datum(self) -> float:
        """chi-square over degrees of freedom; near one where the bearing belongs to the family."""
        return self.chi2 / (self.n_datum - self.n_effective)

    @property
    def chi2_p(self) -> float:
        """Probability of a larger chi-square for a bearing of the family."""
        return chi2_tail(self.chi2, self.n_datum - self.n_effective)

    @property
    def rejected(self) -> bool:
        """True if chi-square rejects the family."""
        return self.chi2_p < REJECTED

    @property
    def widening(self) -> float:
        """Factor on all standard errors of predictions: sqrt(chi-square per datum), at least one."""
        return float(np.sqrt(max(1.0, self.chi2_per_datum)))

    @property
    def share_at_bound(self) -> float:
        return float(np.mean(self.at_bound))

    @property
    def std_error(self) -> FloatArray:
        """Posterior standard deviations of the logarithms (12,) [-], widened; NaN at a bound."""
        return np.where(self.at_bound, np.nan, np.sqrt(np.diag(self.whole_covariance)))

    @property
    def whole_covariance(self) -> FloatArray:
        """Of the logarithms (12, 12) [1]: by noise and priors, widened, and by the doubts of the probes."""
        return np.asarray(self.widening**2 * self.covariance + self.systematic.T @ self.systematic)

    def parameter(self, name: str) -> Uncertain:
        """The factor exp(value) on the rotor file's value, for the two slopes the exponent itself, with its standard error."""
        n = PARAMETERS.index(name)
        value, error = float(self.values[n]), float(self.std_error[n])
        if name in EXPONENTS:
            return Uncertain(value, error)
        return Uncertain(float(np.exp(value)), float(np.exp(value)) * error)

    def at_load(self, load: float) -> CoefficientsAtSpeed:
        """K and C (n_speed, 2, 2) as a function of speed [rad/s] under a *load* [N]."""
        return self.family.at_load(self.values, load)

    def coefficients(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The eight coefficients and their standard errors, (n_speed, 8) each [N/m, N s/m]."""
        speed = np.asarray(speed, np.float64)
        eight, slopes = self.family.coefficients_and_slopes(self.values, np.full(speed.size, load), speed)
        return eight, np.sqrt(np.einsum("nij,jk,nik->ni", slopes, self.whole_covariance, slopes))

    def critical_speed(self, load: float, plane: str = "") -> Uncertain:
        """Speed [rad/s] of the largest displacement under the known unbalance, at the last plane unless named."""
        return self._predicted(lambda values: self.rig.critical_speed(self.family.at_load(values, load), plane))

    def threshold(self, load: float) -> Uncertain | None:
        """Onset speed of instability [rad/s]; None when there is none up to twice the highest speed of the search."""
        if self.rig.threshold(self.at_load(load)) is None:
            return None
        return self._predicted(lambda values: self._threshold_or_error(values, load))

    def _threshold_or_error(self, values: FloatArray, load: float) -> float:
        speed = self.rig.threshold(self.family.at_load(values, load))
        if speed is None:
            hint = f"it is above {self.rig.search.highest * 30 / np.pi:.0f} rpm"
            raise FitError("the threshold speed leaves the range of the search within its own uncertainty", hint=hint)
        return speed

    def caution(self, load: float) -> str:
        """Warning on a prediction at a *load* [N]: family rejected, load extrapolated; empty otherwise."""
        parts = []
        if self.rejected:
            parts.append(
                f"chi-square per datum is {self.chi2_per_datum:.1f}: the bearing is not of the fitted family, and no interval is given"
            )
        low, high = min(self.loads), max(self.loads)
        if not low * (1 - LOAD_SLACK) <= load <= high * (1 + LOAD_SLACK):
            parts.append(
                f"{load:.3g} N lies outside the loads of the fit ({low:.3g} to {high:.3g} N): the interval holds for bearings of the "
                "fitted family only; chi-square tests the measured loads only"
            )
        return "; ".join(parts)

    def _predicted(self, predict: Callable[[FloatArray], float]) -> Uncertain:
        """A prediction with its standard error: central differences along the axes of the covariance."""
        sizes, axes = np.linalg.eigh(self.whole_covariance)
        variance = 0.0
        for size, axis in zip(np.sqrt(np.maximum(sizes, 0)), axes.T, strict=True):
            if size > 0:
                change = STEP * size * axis
                variance += ((predict(self.values + change) - predict(self.values - change)) / (2 * STEP)) ** 2
        return Uncertain(predict(self.values), float(np.sqrt(variance)))

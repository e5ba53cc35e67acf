"""Result of the joint fit with smooth factors and its predictions at any load, with the interface of the joint fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.records.doubt import Doubt
from labpipe.records.settings import Uncertain
from labpipe.rigs.film_family import as_matrices
from labpipe.rigs.run_up_rotor import RunUpRotor, largest_displacement
from labpipe.rotors.threshold import CoefficientsAtSpeed
from labpipe.run_ups.amplitudes import displacement_slopes
from labpipe.run_ups.joint_result import LOAD_SLACK
from labpipe.run_ups.problem import nearby_threshold
from labpipe.run_ups.process_field import ProcessFamily, SquaredExponential, places_of

# Half-width of the differences about a peak, as a part of its speed.
PEAK_STEP = 5e-3


@dataclass(frozen=True, kw_only=True)
class ProcessFit:
    """Parameters *values* and *covariance* (n_parameter, n_parameter) of the *family*; *loads* [N]: those of the fit.

    chi2, n_datum: of responses and thresholds; n_effective: parameters that the data determine against the priors; rank, condition: of
    the data, in units of the priors; n_determined: combinations that the data determine better than the priors do. systematic (n_source,
    n_parameter): changes by one standard uncertainty of each of the *sources*, doubts of probes; chi2 is without what these explain.
    """

    rig: RunUpRotor
    family: ProcessFamily
    loads: tuple[float, ...]
    values: FloatArray
    covariance: FloatArray
    chi2: float
    n_datum: int
    n_effective: float
    rank: int
    condition: float
    n_determined: int
    steps: int
    sources: tuple[Doubt, ...]
    systematic: FloatArray

    @property
    def kernel(self) -> SquaredExponential:
        """Size and lengths of the smooth factors, of maximum marginal likelihood."""
        return self.family.field.kernel

    @property
    def chi2_per_datum(self) -> float:
        """chi-square over degrees of freedom."""
        return self.chi2 / (self.n_datum - self.n_effective)

    @property
    def widening(self) -> float:
        """Factor on all standard errors of predictions: sqrt(chi-square per datum), at least one."""
        return max(1.0, float(np.sqrt(self.chi2_per_datum)))

    @property
    def statement(self) -> str:
        """Statement on the assumed factors and the combinations that the data determine."""
        kernel = self.kernel
        return (
            f"smooth factors with a standard deviation of {100 * kernel.size:.0f} %, correlated over {kernel.load:.2g} N and "
            f"{kernel.speed * 30 / np.pi:.0f} rpm, on the joint fit; of {self.values.size} parameters the data determine "
            f"{self.n_determined} combinations better than these assumptions do"
        )

    def at_load(self, load: float) -> CoefficientsAtSpeed:
        """K and C (n_speed, 2, 2) as a function of speed [rad/s] under a *load* [N]."""
        return self.family.at_load(self.values, load)

    def coefficients(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The eight coefficients and their standard errors, (n_speed, 8) each [N/m, N s/m]."""
        speed = np.asarray(speed, np.float64)
        eight, slopes = self.family.coefficients_and_slopes(self.values, np.full(speed.size, load), speed)
        variance = np.einsum("nij,jk,nik->ni", slopes, self.covariance, slopes)
        beyond = np.diagonal(self.family.field.unexplained(places_of(load, speed)))[:, None] * eight**2
        of_probes = np.sum((slopes @ self.systematic.T) ** 2, axis=2)
        return eight, np.sqrt(self.widening**2 * (variance + np.maximum(beyond, 0)) + of_probes)

    def factors(self, load: float, speed: FloatArray) -> FloatArray:
        """The smooth factors (n_speed, 8) [-]."""
        return self.family.factors(self.values, load, speed)

    def critical_speed(self, load: float, plane: str = "") -> Uncertain:
        """Speed [rad/s] of the largest displacement under the known unbalance, at the last plane unless named.

        Its error from d Omega = -d(A') / A'', A the displacement at the peak and at a little to both sides.
        """
        speed = self.rig.critical_speed(self.at_load(load), plane)
        step = PEAK_STEP * speed
        around = speed + step * np.array([-1.0, 0.0, 1.0])
        number = self.rig.plane_names.index(plane) if plane else -1
        eight = self.family.coefficients(self.values, load, around)
        response, slopes = self.rig.under_unbalance(around, self.rig.known_unbalance).response_and_slopes(*as_matrices(eight))
        size = largest_displacement(response.reshape(3, -1, 2))[:, number]
        bend = (size[0] - 2 * size[1] + size[2]) / step**2
        by_eight = displacement_slopes(response, slopes)[:, number] * np.array([1.0, 0.0, -1.0])[:, None] / (2 * step * bend)
        return Uncertain(speed, self._error(load, around, by_eight))

    def threshold(self, load: float) -> Uncertain | None:
        """Onset speed of instability [rad/s]; None when there is none up to twice the highest speed of the search."""
        onset = self.rig.threshold(self.at_load(load))
        if onset is None:
            return None
        speed, by_speed = nearby_threshold(self.rig, self.at_load(load), onset)
        stiffness, damping = self.at_load(load)(np.array([speed]))
        mode = self.rig.stability.least_stable(speed, stiffness[0], damping[0])
        by_eight = -np.concatenate([mode.by_stiffness.ravel(), mode.by_damping.ravel()]) / by_speed
        return Uncertain(speed, self._error(load, np.array([speed]), by_eight[None]))

    def caution(self, load: float) -> str:
        """Warning on a prediction at an extrapolated *load* [N]; empty within the loads of the fit."""
        low, high = min(self.loads), max(self.loads)
        if low * (1 - LOAD_SLACK) <= load <= high * (1 + LOAD_SLACK):
            return ""
        return (
            f"{load:.3g} N lies outside the loads of the fit ({low:.3g} to {high:.3g} N): the smooth factors are extrapolated, and the "
            f"interval assumes their correlation over {self.kernel.load:.2g} N"
        )

    def _error(self, load: float, speed: FloatArray, weights: FloatArray) -> float:
        """Standard error of a prediction with slopes *weights* (n_speed, 8) by the coefficients at *speed* (n_speed,)."""
        eight, slopes = self.family.coefficients_and_slopes(self.values, np.full(speed.size, load), speed)
        by_parameter = np.einsum("ni,nij->j", weights, slopes)
        by_field = weights * eight
        beyond = np.einsum("ni,nm,mi->", by_field, self.family.field.unexplained(places_of(load, speed)), by_field)
        noise = by_parameter @ self.covariance @ by_parameter + max(float(beyond), 0.0)
        return float(np.sqrt(self.widening**2 * noise + np.sum((self.systematic @ by_parameter) ** 2)))

"""A method for run-ups: all eight coefficients of the rotor file's bearing times one factor, the same at
every load and speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import FitError
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.run_ups.methods import AtLoad, Solved
from labpipe.methods.run_ups.misfit import LoadRuns, runs_by_load
from labpipe.methods.run_ups.records import TWO_SIDED, RunUp, RunUpMethod
from labpipe.methods.run_ups.rotor import RunUpRotor, as_eight
from labpipe.methods.run_ups.settings import RunUpSettings
from labpipe.records.finding import Parameter
from labpipe.records.uncertain import Uncertain

NAME = "common-factor"
# Steps of Gauss-Newton, and the step in standard errors that ends them.
MOST_STEPS, SMALL = 50, 1e-6
# Below this probability chi-square says that one factor is not enough.
REJECTED = 1e-3


@dataclass(frozen=True)
class CommonFactor:
    """The *factor* on the start coefficients, its standard error, and the sum of squares over all *n_datum*
    real data.
    """

    rig: RunUpRotor
    factor: float
    std_error: float
    chi2: float
    n_datum: int

    @property
    def chi2_p(self) -> float:
        """Probability of a larger sum of squares if one factor were enough."""
        return chi2_tail(self.chi2, self.n_datum - 1)

    @property
    def rejected(self) -> bool:
        return self.chi2_p < REJECTED

    @property
    def about(self) -> tuple[float, float, float]:
        """The factor less its standard error, the factor, and the factor with it."""
        return self.factor - self.std_error, self.factor, self.factor + self.std_error

    def coefficients(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The eight coefficients and their standard errors (n_speed, 8) [N/m, N.s/m] at any load [N] and
        speed [rad/s].
        """
        start = as_eight(*self.rig.start_coefficients(load, speed))
        return self.factor * start, self.std_error * np.abs(start)


def fit_common_factor(rig: RunUpRotor, runs: Sequence[RunUp]) -> CommonFactor:
    """min |r(p)|^2 over the responses r with the coefficients exp(p) times those of the rotor file.

    FitError without a minimum.
    """
    groups = runs_by_load(rig, runs)
    exponent = 0.0
    for _ in range(MOST_STEPS):
        residual, slope = residual_and_slope(rig, groups, exponent)
        step = float(slope @ residual / (slope @ slope))
        exponent -= step
        if abs(step) * np.linalg.norm(slope) < SMALL:
            break
    else:
        raise FitError(
            "no common factor was found", hint="check unbalance, phases, standard errors and the rotor file"
        )
    residual, slope = residual_and_slope(rig, groups, exponent)
    factor = float(np.exp(exponent))
    return CommonFactor(
        rig, factor, factor / float(np.linalg.norm(slope)), float(residual @ residual), residual.size
    )


def residual_and_slope(
    rig: RunUpRotor, groups: Sequence[LoadRuns], exponent: float
) -> tuple[FloatArray, FloatArray]:
    """Computed less measured over the standard errors (n_datum,), and its derivative by the exponent."""
    residuals, slopes = [], []
    for group in groups:
        eight = np.exp(exponent) * as_eight(*rig.start_coefficients(group.load, group.speed))
        residual, by_eight = group.residual_and_slopes(eight)
        residuals.append(residual.ravel())
        slopes.append(np.einsum("nij,nj->ni", by_eight, eight).ravel())
    return np.concatenate(residuals), np.concatenate(slopes)


def solve_common_factor(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:  # noqa: ARG001 (one signature)
    """The method as labpipe asks for it: its record, what predicts every run, and the fit that metamodels can
    ask.
    """
    fit = fit_common_factor(rig, trained)
    method = RunUpMethod(
        NAME,
        "common factor",
        "rejected" if fit.rejected else "not rejected",
        predictions=(),
        unknowns=1,
        rank=1,
        condition=1.0,
        chi2_per_datum=fit.chi2 / (fit.n_datum - 1),
        chi2_p=fit.chi2_p,
        n_datum=fit.n_datum,
        n_effective=1.0,
        parameters=(_parameter(fit),),
        remarks=("All eight coefficients of the rotor file's bearing times one factor.",),
    )
    return Solved(method, lambda rotor, run: _at(fit, rotor, run), anywhere=fit)


def _parameter(fit: CommonFactor) -> Parameter:
    """The factor; one that chi-square rejects has no standard error, since none would be honest."""
    if fit.rejected:
        return Parameter("factor", fit.factor, "1")
    interval = (fit.factor - TWO_SIDED * fit.std_error, fit.factor + TWO_SIDED * fit.std_error)
    return Parameter("factor", fit.factor, "1", std_error=fit.std_error, ci95=interval)


def _at(fit: CommonFactor, rotor: RunUpRotor, run: RunUp) -> AtLoad:
    """The method at a run: critical speed and threshold with the standard errors that the factor's brings."""

    def scaled(factor: float) -> CoefficientsAtSpeed:
        def at_speed(speed: FloatArray) -> tuple[FloatArray, FloatArray]:
            stiffness, damping = rotor.start_coefficients(run.load, speed)
            return factor * stiffness, factor * damping

        return at_speed

    def critical(plane: str) -> Uncertain:
        low, middle, high = (rotor.critical_speed(scaled(factor), plane) for factor in fit.about)
        return Uncertain(middle, abs(high - low) / 2)

    def threshold() -> Uncertain | None:
        low, middle, high = (rotor.threshold(scaled(factor)) for factor in fit.about)
        return (
            None if low is None or middle is None or high is None else Uncertain(middle, abs(high - low) / 2)
        )

    eight, error = fit.coefficients(run.load, run.speed)
    if fit.rejected:
        return AtLoad(scaled(fit.factor), eight)
    return AtLoad(scaled(fit.factor), eight, error, critical, threshold)

"""Run-ups that could be made, and what each would tell of the film's parameters: its Fisher information.

With the slopes J of the joint fit's residual at expected parameters, a run tells J^T J of the logarithms of
PARAMETERS. Readings have standard errors of a share of the amplitude, with a floor, and of the phase; where
the rotor is unstable, or moves farther than the limits allow, it is not run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import FitError
from labpipe.methods.rotor.response import GROWTH_TOLERANCE
from labpipe.methods.run_ups.joint import MeasuredThreshold
from labpipe.methods.run_ups.misfit import ExcitedRun, LoadRuns
from labpipe.methods.run_ups.records import RunUp, Shaker
from labpipe.methods.run_ups.rotor import FilmFamily, RunUpRotor, as_matrices, largest_displacement
from labpipe.records.uncertain import Uncertain

# Readings with a larger relative error are not planned with: a fit weighs along and across the measured
# phasor, which is noise then.
LARGEST_ERROR = 0.2


@dataclass(frozen=True)
class Reading:
    """Standard errors at one speed: *amplitude* [1] relative, a *displacement* [m] added in squares, *phase*
    [rad], *threshold* [1].
    """

    amplitude: float
    displacement: float
    phase: float
    threshold: float


@dataclass(frozen=True)
class ExpectedRig:
    """The rotor with the family of its film, and the expected logarithms *values* (12,) [-] of PARAMETERS.

    *reading*: its noise.
    """

    rig: RunUpRotor
    family: FilmFamily
    values: FloatArray
    reading: Reading

    def coefficients(self, load: float, speed: FloatArray) -> FloatArray:
        """The eight coefficients (n_speed, 8) [N/m, N s/m] at a load [N] and speeds (n_speed,) [rad/s]."""
        return self.family.coefficients(self.values, load, speed)

    def threshold(self, load: float) -> float | None:
        """Expected threshold of instability [rad/s] under a load [N]; None for none within the search."""
        return self.rig.threshold(self.family.at_load(self.values, load))


@dataclass(frozen=True)
class RunCandidate:
    """A run under a *load* [N] at speeds (n_speed,) [rad/s], under an unbalance [kg m] by plane or a shaker.

    Or on to the threshold.
    """

    name: str
    load: float
    speed: FloatArray
    unbalance: Mapping[str, complex]
    shaker: Shaker | None = None
    to_threshold: bool = False

    @property
    def excitation(self) -> str:
        """What excites the rotor, in words."""
        if self.shaker is not None:
            where = f"shaker at {self.shaker.plane}: {self.shaker.x:g} N in x"
            return f"{where}, {self.shaker.frequency_ratio:g} of the speed"
        return "; ".join(
            f"{plane}: {1e6 * abs(size):.4g} g mm at {np.degrees(np.angle(size)):.4g} deg"
            for plane, size in self.unbalance.items()
        )


@dataclass(frozen=True)
class Limits:
    """Largest displacement 0-to-peak at a plane and of the journal [m]; None: no limit."""

    displacement: float | None = None
    journal: float | None = None


def expected_run(expected: ExpectedRig, candidate: RunCandidate) -> RunUp:
    """The run as it is expected, without noise, with the standard errors of its readings."""
    rig, speed = expected.rig, candidate.speed
    shape = (speed.size, len(rig.planes), 2)
    ones = np.ones(shape)
    unit = RunUp(
        candidate.name,
        candidate.load,
        speed,
        rig.plane_names,
        ones + 0j,
        amplitude_error=ones,
        phase_error=ones,
        unbalance=candidate.unbalance,
        shaker=candidate.shaker,
    )
    matrices = as_matrices(expected.coefficients(candidate.load, speed))
    response = rig.excited(unit).response(*matrices).reshape(shape)
    reading = expected.reading
    floor = reading.displacement / np.abs(response)
    threshold = expected.threshold(candidate.load) if candidate.to_threshold else None
    return replace(
        unit,
        response=response,
        amplitude_error=np.hypot(reading.amplitude, floor) * np.abs(response),
        phase_error=np.hypot(reading.phase, floor),
        threshold=None if threshold is None else Uncertain(threshold, reading.threshold * threshold),
    )


def information(expected: ExpectedRig, candidate: RunCandidate) -> FloatArray:
    """What a run tells of the logarithms of PARAMETERS, (12, 12) [-]; FitError for a threshold that the
    search does not find.

    Equation (plan-run-up).
    """
    run = expected_run(expected, candidate)
    speeds = LoadRuns(run.load, run.speed, (ExcitedRun.of(expected.rig, run),))
    rows = speeds.residual(expected.family, expected.values)[1]()
    matrix = rows.T @ rows
    if run.threshold is not None:
        measured = MeasuredThreshold(expected.rig, run.load, run.threshold)
        row = measured.residual(expected.family, expected.values)[1]()
        matrix = matrix + row.T @ row
    elif candidate.to_threshold:
        what = f"no threshold is expected under {candidate.load:.4g} N"
        raise FitError(what, hint="leave to_threshold out")
    return np.asarray(matrix)


def allowed_speeds(expected: ExpectedRig, candidate: RunCandidate, limits: Limits) -> BoolArray:
    """Speeds (n_speed,) at which the rotor is stable, no displacement exceeds its limit, and every reading is
    above its noise.
    """
    run = expected_run(expected, replace(candidate, to_threshold=False))
    stiffness, damping = as_matrices(expected.coefficients(run.load, run.speed))
    good = expected.rig.stability.growth(run.speed, stiffness, damping) <= GROWTH_TOLERANCE
    good &= np.all(run.amplitude_error <= LARGEST_ERROR * np.abs(run.response), axis=(1, 2))
    if limits.displacement is not None:
        good &= np.all(largest_displacement(run.response) <= limits.displacement, axis=1)
    if limits.journal is not None:
        journal = expected.rig.excited(run).journal(stiffness, damping)[0]
        good &= largest_displacement(journal) <= limits.journal
    return np.asarray(good)


def at_allowed_speeds(expected: ExpectedRig, candidate: RunCandidate, limits: Limits) -> RunCandidate | None:
    """The candidate at the speeds that are allowed; None where fewer than two are left."""
    good = allowed_speeds(expected, candidate, limits)
    return replace(candidate, speed=candidate.speed[good]) if np.count_nonzero(good) > 1 else None

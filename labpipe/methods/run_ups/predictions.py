"""Prediction of a method for one run: critical speed, threshold, response, coefficients, and notes on missing
values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.rotor.rig import Unbalance
from labpipe.methods.run_ups.measured import column, motions
from labpipe.methods.run_ups.records import Amount, RunPrediction, RunUp
from labpipe.methods.run_ups.rotor import RPM, RunUpRotor
from labpipe.records.uncertain import Uncertain

# Step of the speeds at which curves are drawn [rad/s].
CURVE_STEP = 40 * RPM
# About a peak, where the phasor turns fast: step [rad/s] and points to either side.
PEAK_STEP, PEAK_POINTS = 8 * RPM, 16


@dataclass(frozen=True)
class AtLoad:
    """Prediction of a method at one load: K and C over speed, coefficients and their errors (n_speed, 8)
    [N/m, N s/m] at the run's speeds.

    critical, threshold: with their errors, where the method has them; else they are computed from *at_speed*.
    """

    at_speed: CoefficientsAtSpeed
    coefficients: FloatArray
    std_error: FloatArray | None = None
    critical: Callable[[], Uncertain] | None = None
    threshold: Callable[[], Uncertain | None] | None = None
    notes: tuple[str, ...] = ()


def with_unbalance_of(rig: RunUpRotor, run: RunUp) -> RunUpRotor:
    """The rotor with a run's unbalance; unchanged where it is the rotor file's."""
    file_unbalance = rig.known_unbalance
    same = run.shaker is not None or (
        run.unbalance.keys() == file_unbalance.keys()
        and all(
            abs(size - file_unbalance[plane]) <= 1e-9 * abs(size) for plane, size in run.unbalance.items()
        )
    )
    if same:
        return rig
    amounts = tuple(
        Unbalance(rig.node(plane), abs(size), float(np.angle(size))) for plane, size in run.unbalance.items()
    )
    return replace(rig, unbalances=amounts)


def excited_as(rig: RunUpRotor, runs: Iterable[RunUp]) -> RunUpRotor:
    """The rotor with the unbalance of the first of *runs* that has one, where its file states none."""
    stated = [run for run in runs if run.shaker is None]
    return rig if rig.unbalances or not stated else with_unbalance_of(rig, stated[0])


def predict(
    rig: RunUpRotor, run: RunUp, solution: AtLoad | str, plane: str, curves: bool = True
) -> RunPrediction:
    """Prediction of a method for one run, reasons of missing values in its notes. *rig*: the rotor with the
    run's unbalance.
    """
    if isinstance(solution, str):
        return RunPrediction(run.name, None, None, notes=(solution,))
    notes = list(solution.notes)
    critical = (
        _tried(lambda: _critical(rig, solution, plane), "no critical speed", notes)
        if run.shaker is None
        else None
    )
    before = len(notes)
    threshold = _tried(lambda: _threshold(rig, solution), "no threshold", notes)
    stable = f"no threshold below {rig.search.highest / RPM:.0f} rpm"
    notes += [stable] if threshold is None and len(notes) == before else []
    speed = _drawn_speeds(run, threshold, critical)
    motion = motions(run.planes, _curve(rig, run, solution, speed)) if curves else ()
    return RunPrediction(
        run.name,
        critical,
        threshold,
        speed=column(speed) if curves else (),
        motions=motion,
        coefficient_speed=column(run.speed),
        coefficients=tuple(column(row) for row in solution.coefficients),
        std_errors=() if solution.std_error is None else tuple(column(row) for row in solution.std_error),
        notes=tuple(notes),
    )


def _tried(give: Callable[[], Amount | None], title: str, notes: list[str]) -> Amount | None:
    try:
        return give()
    except FitError as error:
        notes.append(f"{title}: {error.what}")
        return None


def _critical(rig: RunUpRotor, solution: AtLoad, plane: str) -> Amount:
    if solution.critical is not None and plane in ("", rig.plane_names[-1]):
        speed = solution.critical()
        return Amount(speed.value, speed.std_error)
    return Amount(rig.critical_speed(solution.at_speed, plane))


def _threshold(rig: RunUpRotor, solution: AtLoad) -> Amount | None:
    if solution.threshold is not None:
        speed = solution.threshold()
        return None if speed is None else Amount(speed.value, speed.std_error)
    value = rig.threshold(solution.at_speed)
    return None if value is None else Amount(value)


def _drawn_speeds(run: RunUp, threshold: Amount | None, critical: Amount | None) -> FloatArray:
    """Speeds of the run, denser about the peak, up to the predicted threshold, beyond which there is no
    steady motion.
    """
    last = float(run.speed[-1]) if threshold is None else min(float(run.speed[-1]), threshold.value)
    speed = np.linspace(
        run.speed[0], max(last, run.speed[0]), max(2, round((last - run.speed[0]) / CURVE_STEP) + 1)
    )
    if critical is None:
        return speed
    about = critical.value + np.arange(-PEAK_POINTS, PEAK_POINTS + 1) * PEAK_STEP
    return np.union1d(speed, about[(about > speed[0]) & (about < speed[-1])])


def _curve(rig: RunUpRotor, run: RunUp, solution: AtLoad, speed: FloatArray) -> ComplexArray:
    shape = (speed.size, len(run.planes), 2)
    bare = replace(
        run,
        speed=speed,
        response=np.ones(shape) + 0j,
        amplitude_error=np.ones(shape),
        phase_error=np.ones(shape),
    )
    return np.asarray(rig.excited(bare).response(*solution.at_speed(speed)).reshape(shape))

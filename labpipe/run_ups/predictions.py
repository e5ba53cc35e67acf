"""What a method says of one run: its critical speed and threshold, its curve, its coefficients, and what cannot be given, in words."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.records.run_up import RunUp
from labpipe.records.run_up_result import Amount, RunPrediction
from labpipe.records.settings import Uncertain
from labpipe.rigs.rotor_rig import Unbalance
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.rotors.threshold import CoefficientsAtSpeed
from labpipe.run_ups.measured import column, motions

RPM = np.pi / 30
# Step of the speeds at which curves are drawn [rad/s].
CURVE_STEP = 40 * RPM
# About a peak, where the phasor turns fast: step [rad/s] and points to either side.
PEAK_STEP, PEAK_POINTS = 8 * RPM, 16


@dataclass(frozen=True)
class AtLoad:
    """What a method says at one load: K and C over speed, coefficients and their errors (n_speed, 8) at the run's speeds.

    critical, threshold: with their errors, where the method has them; else they are computed from *at_speed*.
    """

    at_speed: CoefficientsAtSpeed
    coefficients: FloatArray
    std_error: FloatArray | None = None
    critical: Callable[[], Uncertain] | None = None
    threshold: Callable[[], Uncertain | None] | None = None
    notes: tuple[str, ...] = ()


def with_unbalance_of(rig: RunUpRotor, run: RunUp) -> RunUpRotor:
    """The rotor under a run's unbalance, itself where that is the file's own."""
    known = rig.known_unbalance
    same = run.shaker is not None or (
        run.unbalance.keys() == known.keys() and all(abs(size - known[plane]) <= 1e-9 * abs(size) for plane, size in run.unbalance.items())
    )
    if same:
        return rig
    amounts = tuple(Unbalance(rig.node(plane), abs(size), float(np.angle(size))) for plane, size in run.unbalance.items())
    return replace(rig, unbalances=amounts)


def excited_as(rig: RunUpRotor, runs: Iterable[RunUp]) -> RunUpRotor:
    """The rotor with the unbalance of the first of *runs* that has one, where its file states none."""
    stated = [run for run in runs if run.shaker is None]
    return rig if rig.unbalances or not stated else with_unbalance_of(rig, stated[0])


def predict(own: RunUpRotor, run: RunUp, found: AtLoad | str, plane: str, curves: bool = True) -> RunPrediction:
    """A method's record for one run: what cannot be given is said in its notes. *own*: the rotor under the run's unbalance."""
    if isinstance(found, str):
        return RunPrediction(run.name, None, None, notes=(found,))
    notes = list(found.notes)
    critical = _tried(lambda: _critical(own, found, plane), "no critical speed", notes) if run.shaker is None else None
    before = len(notes)
    threshold = _tried(lambda: _threshold(own, found), "no threshold", notes)
    stable = f"no threshold below {own.search.highest / RPM:.0f} rpm"
    notes += [stable] if threshold is None and len(notes) == before else []
    speed = _drawn_speeds(run, threshold, critical)
    motion = motions(run.planes, _curve(own, run, found, speed)) if curves else ()
    return RunPrediction(
        run.name,
        critical,
        threshold,
        column(speed) if curves else (),
        motion,
        column(run.speed),
        tuple(column(row) for row in found.coefficients),
        () if found.std_error is None else tuple(column(row) for row in found.std_error),
        tuple(notes),
    )


def _tried(give: Callable[[], Amount | None], what: str, notes: list[str]) -> Amount | None:
    try:
        return give()
    except FitError as error:
        notes.append(f"{what}: {error.what}")
        return None


def _critical(own: RunUpRotor, found: AtLoad, plane: str) -> Amount:
    if found.critical is not None and plane in ("", own.plane_names[-1]):
        known = found.critical()
        return Amount(known.value, known.std_error)
    return Amount(own.critical_speed(found.at_speed, plane))


def _threshold(own: RunUpRotor, found: AtLoad) -> Amount | None:
    if found.threshold is not None:
        known = found.threshold()
        return None if known is None else Amount(known.value, known.std_error)
    value = own.threshold(found.at_speed)
    return None if value is None else Amount(value)


def _drawn_speeds(run: RunUp, threshold: Amount | None, critical: Amount | None) -> FloatArray:
    """Over the run's speeds, closer about the peak, up to the predicted threshold: beyond there is no steady motion."""
    last = float(run.speed[-1]) if threshold is None else min(float(run.speed[-1]), threshold.value)
    speed = np.linspace(run.speed[0], max(last, run.speed[0]), max(2, round((last - run.speed[0]) / CURVE_STEP) + 1))
    if critical is None:
        return speed
    about = critical.value + np.arange(-PEAK_POINTS, PEAK_POINTS + 1) * PEAK_STEP
    return np.union1d(speed, about[(about > speed[0]) & (about < speed[-1])])


def _curve(own: RunUpRotor, run: RunUp, found: AtLoad, speed: FloatArray) -> ComplexArray:
    shape = (speed.size, len(run.planes), 2)
    bare = replace(run, speed=speed, response=np.ones(shape) + 0j, amplitude_error=np.ones(shape), phase_error=np.ones(shape))
    return np.asarray(own.excited(bare).response(*found.at_speed(speed)).reshape(shape))

"""The ways to journal coefficients side by side: each with its doubt, and with what it predicts for every run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from labpipe.records.parameter import Parameter
from labpipe.records.run_up import RunUp
from labpipe.records.run_up_result import START, Amount, Convergence, RunUpMethod, StartSpread
from labpipe.rigs.film_family import PARAMETERS, as_eight
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.run_ups.amplitudes import AmplitudeFit, fit_amplitudes, perfect_but_wrong
from labpipe.run_ups.joint import fit_jointly
from labpipe.run_ups.joint_result import REJECTED, JointFit
from labpipe.run_ups.measured import column
from labpipe.run_ups.metamodels_grid import Fitted, Queried
from labpipe.run_ups.points import PointFit, fit_points
from labpipe.run_ups.predictions import RPM, AtLoad
from labpipe.run_ups.process import fit_with_process
from labpipe.run_ups.process_result import ProcessFit
from labpipe.run_ups.settings import RunUpSettings

# Loads are the same when they agree to a millionth.
SAME_LOAD = 1e-6
BEYOND = "above the last measured speed its K and Omega C are held, so that its threshold is extrapolated"
ELSEWHERE = "its coefficients exist at the fitted loads only; a metamodel carries them to this one"

# The method at a run, on a rotor with that run's unbalance; None with a reason where it has nothing to say.
Predictor = Callable[[RunUpRotor, RunUp], AtLoad | str]


@dataclass(frozen=True)
class Solved:
    """A method that has been fitted: its record without predictions, what makes them, and what metamodels can be made of.

    fits: one per load, at measured speeds only; anywhere: a fit that knows any load.
    """

    method: RunUpMethod
    predictor: Predictor
    fits: tuple[Fitted, ...] = ()
    anywhere: Queried | None = None


def solve_start(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:  # noqa: ARG001 (one signature for the table)
    """The rotor file's own bearing: what the source calls the original model."""

    def at(own: RunUpRotor, run: RunUp) -> AtLoad:
        return AtLoad(own.start(run.load), as_eight(*own.start_coefficients(run.load, run.speed)))

    return Solved(RunUpMethod(START, "original (start)", "not fitted", (), unknowns=0), at)


def solve_amplitudes(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:
    """(a): amplitudes alone, one search per point from the rotor file's values; the spread of many starts at one load."""
    unbalanced = [run for run in trained if run.shaker is None]
    fits = fit_amplitudes(rig, unbalanced, settings.bound, settings.search)
    method = RunUpMethod(
        "amplitudes",
        f"(a) amplitudes, {'pattern search' if settings.search == 'pattern' else 'COBYQA'}",
        _determined(fits),
        (),
        **_of_points(fits),
        convergence=(_convergence(fits[len(fits) // 2]),),
        spreads=_spreads(rig, unbalanced, settings),
        remarks=(f"{perfect_but_wrong(fits)}.", *_capped(fits)),
    )
    return Solved(method, _points_at(fits), tuple(fits))


def solve_points(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:
    """(b): complex amplitudes, point by point."""
    fits = fit_points(rig, trained, settings.bound, settings.ridge)
    held = f"a ridge of {100 * settings.ridge:g} % about the start values holds what the data do not see"
    remark = f"{held}; its standard deviations include that doubt."
    method = RunUpMethod("points", "(b) complex, point by point", _determined(fits), (), **_of_points(fits), remarks=(remark,))
    return Solved(method, _points_at(fits), tuple(fits))


def solve_joint(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:  # noqa: ARG001
    """(c): one fit of the physical family to everything."""
    fit = fit_jointly(rig, trained)
    return Solved(joint_method("joint", "(c) joint physical fit", fit), _joint_at(fit, fit.rejected), anywhere=fit)


def solve_process(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:  # noqa: ARG001
    """(d): the joint fit times smooth factors."""
    joint = fit_jointly(rig, trained)
    fit = fit_with_process(rig, trained, joint)
    left = fit.n_datum - fit.n_effective
    p_value = float(chdtrc(left, fit.chi2))
    method = RunUpMethod(
        "process",
        "(d) joint fit with factors",
        "rejected" if p_value < REJECTED else "not rejected",
        (),
        unknowns=int(fit.values.size),
        rank=fit.n_determined,
        condition=fit.condition,
        chi2_per_datum=fit.chi2_per_datum,
        chi2_p=p_value,
        n_datum=fit.n_datum,
        n_effective=fit.n_effective,
        remarks=(f"{fit.statement}.",),
    )
    return Solved(method, _joint_at(fit, p_value < REJECTED), anywhere=fit)


def joint_method(name: str, title: str, fit: JointFit) -> RunUpMethod:
    """The record of a joint fit, its predictions to come."""
    return RunUpMethod(
        name,
        title,
        "rejected" if fit.rejected else "not rejected",
        (),
        unknowns=len(PARAMETERS),
        rank=fit.rank,
        condition=fit.condition,
        share_at_bound=fit.share_at_bound,
        chi2_per_datum=fit.chi2_per_datum,
        chi2_p=fit.chi2_p,
        n_datum=fit.n_datum,
        n_effective=fit.n_effective,
        free=fit.held_by_priors,
        parameters=tuple(_parameter(fit, parameter) for parameter in PARAMETERS),
    )


def _parameter(fit: JointFit, name: str) -> Parameter:
    found, bound = fit.parameter(name), bool(fit.at_bound[PARAMETERS.index(name)])
    if bound:
        return Parameter(name, found.value, "1", at_bound=True)
    if fit.rejected:
        return Parameter(name, found.value, "1")
    return Parameter(name, found.value, "1", found.std_error, None, Amount(found.value, found.std_error).ci95)


def _joint_at(fit: JointFit | ProcessFit, rejected: bool) -> Predictor:
    """Predictions at any load; those of a fit that chi-square rejects have no errors, since none would be honest."""

    def at(own: RunUpRotor, run: RunUp) -> AtLoad:
        there = replace(fit, rig=own)
        eight, error = fit.coefficients(run.load, run.speed)
        caution = fit.caution(run.load)
        notes = (caution,) if caution else ()
        if rejected:
            return AtLoad(fit.at_load(run.load), eight, notes=notes)
        return AtLoad(fit.at_load(run.load), eight, error, lambda: there.critical_speed(run.load), lambda: there.threshold(run.load), notes)

    return at


def _points_at(fits: Sequence[PointFit] | Sequence[AmplitudeFit]) -> Predictor:
    def at(_own: RunUpRotor, run: RunUp) -> AtLoad | str:
        found = next((fit for fit in fits if abs(fit.load / run.load - 1) < SAME_LOAD), None)
        if found is None:
            return ELSEWHERE
        at_speed = found.at_speed()
        same = found.speed.shape == run.speed.shape and np.allclose(found.speed, run.speed)
        error = found.std_error if same and isinstance(found, PointFit) else None
        return AtLoad(at_speed, as_eight(*at_speed(run.speed)), error, notes=(BEYOND,))

    return at


def _of_points(fits: Sequence[PointFit] | Sequence[AmplitudeFit]) -> dict[str, Any]:
    """What all points together say of their doubt; the worst rank and condition."""
    chi2, datum, effective = sum(f.chi2 for f in fits), sum(f.n_datum for f in fits), sum(f.n_effective for f in fits)
    left = datum - effective
    shares = np.concatenate([np.asarray(fit.at_bound).ravel() for fit in fits])
    return {
        "rank": int(min(fit.rank.min() for fit in fits)),
        "condition": float(max(fit.condition.max() for fit in fits)),
        "share_at_bound": float(np.mean(shares)),
        "chi2_per_datum": chi2 / left if left > 0.5 else None,
        "chi2_p": float(chdtrc(left, chi2)) if left > 0.5 else None,
        "n_datum": datum,
        "n_effective": float(effective),
    }


def _determined(fits: Sequence[PointFit] | Sequence[AmplitudeFit]) -> str:
    return "determined" if min(int(fit.rank.min()) for fit in fits) == 8 else "not determined"


def _capped(fits: Sequence[AmplitudeFit]) -> list[str]:
    capped, most = sum(int(fit.capped.sum()) for fit in fits), max(int(fit.evaluations.max()) for fit in fits)
    every = sum(fit.speed.size for fit in fits)
    return [f"{capped} of {every} searches ended at the cap of {most} evaluations, not by their mesh."] if capped else []


def _convergence(fit: AmplitudeFit) -> Convergence:
    """Of the point whose search took longest."""
    point = int(np.argmax(fit.evaluations))
    rows = fit.history.of(point)
    evaluations = np.diff(rows.evaluations[:, 0], prepend=0)
    best = fit.factors[int(np.argmin(fit.objectives[:, point])), point]
    where = f"{fit.load:.3g} N, {fit.speed[point] / RPM:.0f} rpm"
    objective, mesh, counts = (column(values) for values in (rows.objective[:, 0], rows.mesh[:, 0], evaluations))
    return Convergence(where, objective, mesh, counts, bool(fit.capped[point]), column(best))


def _spreads(rig: RunUpRotor, runs: Sequence[RunUp], settings: RunUpSettings) -> tuple[StartSpread, ...]:
    """Where the starts end at the load in the middle: at the speed of the largest response and at the highest."""
    if settings.starts < 2:
        return ()
    loads = sorted({run.load for run in runs})
    middle = loads[len(loads) // 2]
    (fit,) = fit_amplitudes(
        rig, [run for run in runs if run.load == middle], settings.bound, settings.search, settings.starts, settings.seed
    )
    points = dict.fromkeys([int(np.argmax(fit.measured)), fit.speed.size - 1])
    found = []
    for point in points:
        spread = fit.spread(point)
        where = f"{fit.load:.3g} N, {spread.speed / RPM:.0f} rpm"
        # The relative misfit of the amplitudes says more than the sum of their squares.
        misfit = np.sqrt(spread.objective / spread.measured)
        found.append(StartSpread(where, tuple(column(row) for row in spread.factors), column(misfit)))
    return tuple(found)

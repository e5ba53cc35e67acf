"""Identification methods of journal coefficients, each with its uncertainty and its prediction for every
run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from labpipe.methods.run_ups.amplitudes import AmplitudeFit, fit_amplitudes, perfect_but_wrong
from labpipe.methods.run_ups.film_family import PARAMETERS, as_eight
from labpipe.methods.run_ups.joint import EXPONENTS, JointFit, fit_jointly
from labpipe.methods.run_ups.joint import REJECTED as LEAST_PROBABILITY
from labpipe.methods.run_ups.measured import column
from labpipe.methods.run_ups.metamodel_kinds import Fitted, Queried
from labpipe.methods.run_ups.points import PointFit, fit_points
from labpipe.methods.run_ups.predictions import RPM, AtLoad
from labpipe.methods.run_ups.process import ProcessFit, fit_with_process
from labpipe.methods.run_ups.records import (
    REJECTED,
    START,
    TWO_SIDED,
    Amount,
    Convergence,
    RunUp,
    RunUpMethod,
    StartSpread,
)
from labpipe.methods.run_ups.rotor import RunUpRotor
from labpipe.methods.run_ups.settings import RunUpSettings
from labpipe.records.finding import Contribution, Parameter

# Loads are the same when they agree to a millionth.
SAME_LOAD = 1e-6
BEYOND = "above the last measured speed K and Omega C stay constant: its threshold is extrapolated"
WITHOUT_INTERVAL = (
    "chi-square rejects the fit: critical speed, threshold and coefficients are values without an interval"
)
ELSEWHERE = "its coefficients exist at the fitted loads only; a metamodel extends them to this load"

# Prediction of a method for a run, on a rotor with the run's unbalance; the reason, as text, where there is
# none.
Predictor = Callable[[RunUpRotor, RunUp], AtLoad | str]


@dataclass(frozen=True)
class Solved:
    """A fitted method: its record without predictions, its predictor, and the fits for metamodels.

    fits: one per load, at measured speeds only; anywhere: a fit at any load.
    """

    method: RunUpMethod
    predictor: Predictor
    fits: tuple[Fitted, ...] = ()
    anywhere: Queried | None = None


def solve_start(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:  # noqa: ARG001 (one signature for the table)
    """Coefficients of the rotor file's bearing: the original model of the source."""

    def at(run_rig: RunUpRotor, run: RunUp) -> AtLoad:
        return AtLoad(run_rig.start(run.load), as_eight(*run_rig.start_coefficients(run.load, run.speed)))

    return Solved(RunUpMethod(START, "original (start)", "not fitted", predictions=(), unknowns=0), at)


def solve_amplitudes(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:
    """(a): amplitudes alone, one search per point from the rotor file's values.

    The spread of many starts at one load.
    """
    unbalanced = [run for run in trained if run.shaker is None]
    fits = fit_amplitudes(rig, unbalanced, settings.bound, settings.search)
    method = RunUpMethod(
        "amplitudes",
        f"(a) amplitudes, {'pattern search' if settings.search == 'pattern' else 'COBYQA'}",
        _determined(fits),
        predictions=(),
        **_of_points(fits),
        convergence=(_convergence(fits[len(fits) // 2]),),
        spreads=_spreads(rig, unbalanced, settings),
        remarks=(f"{perfect_but_wrong(fits)}.", *_capped(fits)),
    )
    return Solved(method, _points_at(fits), tuple(fits))


def solve_points(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:
    """(b): complex amplitudes, point by point."""
    fits = fit_points(rig, trained, settings.bound, settings.ridge)
    ridge_text = (
        f"a ridge of {100 * settings.ridge:g} % about the start values determines what the data do not"
    )
    remark = f"{ridge_text}; its standard deviations include this."
    method = RunUpMethod(
        "points",
        "(b) complex, point by point",
        _determined(fits),
        predictions=(),
        **_of_points(fits),
        remarks=(remark,),
    )
    return Solved(method, _points_at(fits), tuple(fits))


def solve_joint(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:
    """(c): one fit of the physical family to all responses and thresholds."""
    fit = fit_jointly(rig, trained, known=settings.known)
    return Solved(
        joint_method("joint", "(c) joint physical fit", fit), _joint_at(fit, fit.rejected), anywhere=fit
    )


def solve_process(rig: RunUpRotor, trained: Sequence[RunUp], settings: RunUpSettings) -> Solved:  # noqa: ARG001
    """(d): the joint fit times smooth factors."""
    joint = fit_jointly(rig, trained)
    fit = fit_with_process(rig, trained, joint)
    n_redundant = fit.n_datum - fit.n_effective
    p_value = float(chdtrc(n_redundant, fit.chi2))
    method = RunUpMethod(
        "process",
        "(d) joint fit with factors",
        REJECTED if p_value < LEAST_PROBABILITY else "not rejected",
        predictions=(),
        unknowns=int(fit.values.size),
        rank=fit.n_determined,
        condition=fit.condition,
        chi2_per_datum=fit.chi2_per_datum,
        chi2_p=p_value,
        n_datum=fit.n_datum,
        n_effective=fit.n_effective,
        remarks=(f"{fit.statement}.",),
    )
    return Solved(method, _joint_at(fit, p_value < LEAST_PROBABILITY), anywhere=fit)


def joint_method(name: str, title: str, fit: JointFit) -> RunUpMethod:
    """The record of a joint fit, its predictions to come."""
    return RunUpMethod(
        name,
        title,
        REJECTED if fit.rejected else "not rejected",
        predictions=(),
        unknowns=len(PARAMETERS) - len(fit.known),
        rank=fit.rank,
        condition=fit.condition,
        share_at_bound=fit.share_at_bound,
        chi2_per_datum=fit.chi2_per_datum,
        chi2_p=fit.chi2_p,
        n_datum=fit.n_datum,
        n_effective=fit.n_effective,
        free=fit.prior_dominated,
        parameters=tuple(
            _parameter(fit, parameter) for parameter in PARAMETERS if parameter not in fit.known
        ),
    )


def _parameter(fit: JointFit, name: str) -> Parameter:
    factor, bound = fit.parameter(name), bool(fit.at_bound[PARAMETERS.index(name)])
    if bound:
        return Parameter(name, factor.value, "1", at_bound=True)
    if fit.rejected:
        return Parameter(name, factor.value, "1")
    return with_sources_of(
        fit,
        Parameter(name, factor.value, "1", ci95=Amount(factor.value, factor.std_error).ci95),
        factor.std_error,
    )


def with_sources_of(fit: JointFit, parameter: Parameter, combined: float) -> Parameter:
    """The parameter with its *combined* error [1] in parts: of noise and priors, and of each uncertainty of
    the probes, largest first.
    """
    scale = 1.0 if parameter.name in EXPONENTS else parameter.value
    changes = scale * fit.systematic[:, PARAMETERS.index(parameter.name)]
    systematic = float(np.sqrt(np.sum(changes**2)))
    if not systematic:
        return replace(parameter, std_error=combined)
    noise = float(np.sqrt(max(combined**2 - systematic**2, 0.0)))
    pairs = [
        ("noise", noise),
        *((source.source, abs(float(change))) for source, change in zip(fit.sources, changes, strict=True)),
    ]
    parts = tuple(
        Contribution(name, size, size**2 / combined**2)
        for name, size in sorted(pairs, key=lambda pair: -pair[1])
    )
    return replace(
        parameter,
        std_error=noise,
        std_error_inflated=combined,
        systematic=systematic,
        combined=combined,
        expanded=TWO_SIDED * combined,
        coverage_factor=TWO_SIDED,
        budget=parts,
    )


def _joint_at(fit: JointFit | ProcessFit, rejected: bool) -> Predictor:
    """Predictions at any load.

    Without errors for a fit that chi-square rejects, whose errors would be wrong.
    """

    def at(run_rig: RunUpRotor, run: RunUp) -> AtLoad:
        run_fit = replace(fit, rig=run_rig)
        eight, error = fit.coefficients(run.load, run.speed)
        caution = fit.caution(run.load)
        notes = (caution,) if caution else ()
        if rejected:
            return AtLoad(fit.at_load(run.load), eight, notes=(WITHOUT_INTERVAL, *notes))
        return AtLoad(
            fit.at_load(run.load),
            eight,
            error,
            lambda: run_fit.critical_speed(run.load),
            lambda: run_fit.threshold(run.load),
            notes,
        )

    return at


def _points_at(fits: Sequence[PointFit] | Sequence[AmplitudeFit]) -> Predictor:
    def at(_rig: RunUpRotor, run: RunUp) -> AtLoad | str:
        load_fit = next((fit for fit in fits if abs(fit.load / run.load - 1) < SAME_LOAD), None)
        if load_fit is None:
            return ELSEWHERE
        at_speed = load_fit.at_speed()
        same = load_fit.speed.shape == run.speed.shape and np.allclose(load_fit.speed, run.speed)
        error = load_fit.std_error if same and isinstance(load_fit, PointFit) else None
        return AtLoad(at_speed, as_eight(*at_speed(run.speed)), error, notes=(BEYOND,))

    return at


def _of_points(fits: Sequence[PointFit] | Sequence[AmplitudeFit]) -> dict[str, Any]:
    """Fields of RunUpMethod on the uncertainty of all points: lowest rank, largest condition number,
    chi-square.
    """
    chi2, datum, effective = (
        sum(f.chi2 for f in fits),
        sum(f.n_datum for f in fits),
        sum(f.n_effective for f in fits),
    )
    n_redundant = datum - effective
    shares = np.concatenate([np.asarray(fit.at_bound).ravel() for fit in fits])
    return {
        "rank": int(min(fit.rank.min() for fit in fits)),
        "condition": float(max(fit.condition.max() for fit in fits)),
        "share_at_bound": float(np.mean(shares)),
        "chi2_per_datum": chi2 / n_redundant if n_redundant > 0.5 else None,
        "chi2_p": float(chdtrc(n_redundant, chi2)) if n_redundant > 0.5 else None,
        "n_datum": datum,
        "n_effective": float(effective),
    }


def _determined(fits: Sequence[PointFit] | Sequence[AmplitudeFit]) -> str:
    return "determined" if min(int(fit.rank.min()) for fit in fits) == 8 else "not determined"


def _capped(fits: Sequence[AmplitudeFit]) -> list[str]:
    capped, most = sum(int(fit.capped.sum()) for fit in fits), max(int(fit.evaluations.max()) for fit in fits)
    every = sum(fit.speed.size for fit in fits)
    return (
        [f"{capped} of {every} searches ended at the limit of {most} evaluations, not at the smallest mesh."]
        if capped
        else []
    )


def _convergence(fit: AmplitudeFit) -> Convergence:
    """Convergence of the longest search."""
    point = int(np.argmax(fit.evaluations))
    rows = fit.history.of(point)
    evaluations = np.diff(rows.evaluations[:, 0], prepend=0)
    best = fit.factors[int(np.argmin(fit.objectives[:, point])), point]
    place = f"{fit.load:.3g} N, {fit.speed[point] / RPM:.0f} rpm"
    objective, mesh, counts = (
        column(values) for values in (rows.objective[:, 0], rows.mesh[:, 0], evaluations)
    )
    return Convergence(place, objective, mesh, counts, bool(fit.capped[point]), column(best))


def _spreads(rig: RunUpRotor, runs: Sequence[RunUp], settings: RunUpSettings) -> tuple[StartSpread, ...]:
    """Spread of the starts at the middle load: at the speed of the largest response and at the highest
    speed.
    """
    if settings.starts < 2:
        return ()
    loads = sorted({run.load for run in runs})
    middle = loads[len(loads) // 2]
    (fit,) = fit_amplitudes(
        rig,
        [run for run in runs if run.load == middle],
        settings.bound,
        settings.search,
        settings.starts,
        settings.seed,
    )
    points = dict.fromkeys([int(np.argmax(fit.measured)), fit.speed.size - 1])
    spreads = []
    for point in points:
        spread = fit.spread(point)
        place = f"{fit.load:.3g} N, {spread.speed / RPM:.0f} rpm"
        # The relative misfit of the amplitudes, because the sum of squares has no scale.
        misfit = np.sqrt(spread.objective / spread.measured)
        spreads.append(StartSpread(place, tuple(column(row) for row in spread.factors), column(misfit)))
    return tuple(spreads)

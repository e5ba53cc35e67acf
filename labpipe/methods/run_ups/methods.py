"""Identification methods of journal coefficients, with their uncertainty and predictions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import FitError
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.rotor.posterior import rank_of
from labpipe.methods.rotor.rig import Unbalance
from labpipe.methods.run_ups import records
from labpipe.methods.run_ups.amplitudes import AmplitudeFit, SpeedwiseFit, fit_amplitudes, perfect_but_wrong
from labpipe.methods.run_ups.joint import EXPONENTS, JointFit, fit_jointly
from labpipe.methods.run_ups.measured import column, motions
from labpipe.methods.run_ups.metamodel_kinds import SAME_LOAD, Queried
from labpipe.methods.run_ups.misfit import LoadRuns, runs_by_load, scales, shared_noise, sources_of
from labpipe.methods.run_ups.process import ProcessFit, fit_with_process
from labpipe.methods.run_ups.rotor import PARAMETERS, RPM, RunUpRotor, as_eight
from labpipe.methods.run_ups.settings import RunUpSettings
from labpipe.records.finding import Contribution, Parameter
from labpipe.records.uncertain import Uncertain

# Step of the speeds at which curves are drawn [rad/s].
CURVE_STEP = 40 * RPM
# About a peak, where the phasor turns fast: step [rad/s] and points to either side.
PEAK_STEP, PEAK_POINTS = 8 * RPM, 16


@dataclass(frozen=True)
class AtLoad:
    """Prediction of a method at one load: K and C over speed, coefficients and their errors (n_speed, 8)
    [N/m, N s/m] at the run's speeds; critical (at a plane, '' the last one) and threshold, with their errors,
    where they are not computed from *at_speed*.
    """

    at_speed: CoefficientsAtSpeed
    coefficients: FloatArray
    std_error: FloatArray | None = None
    critical: Callable[[str], Uncertain] | None = None
    threshold: Callable[[], Uncertain | None] | None = None
    notes: tuple[str, ...] = ()


def with_unbalance_of(rig: RunUpRotor, run: records.RunUp) -> RunUpRotor:
    known, sizes = rig.known_unbalance, run.unbalance
    same = known.keys() == sizes.keys() and all(
        abs(size - known[plane]) <= 1e-9 * abs(size) for plane, size in sizes.items()
    )
    if same or run.shaker is not None:
        return rig
    amounts = tuple(
        Unbalance(rig.node(plane), abs(size), float(np.angle(size))) for plane, size in sizes.items()
    )
    return replace(rig, unbalances=amounts)


def with_unbalance_of_runs(rig: RunUpRotor, runs: Iterable[records.RunUp]) -> RunUpRotor:
    """The rotor with its own unbalance, or that of the first of *runs* that has one."""
    stated = [run for run in runs if run.shaker is None]
    return rig if rig.unbalances or not stated else with_unbalance_of(rig, stated[0])


def predict(
    rig: RunUpRotor, run: records.RunUp, solution: AtLoad | str, plane: str, curves: bool = True
) -> records.RunPrediction:
    """Prediction of a method for one run on the *rig* with its unbalance; notes say what is missing."""
    if isinstance(solution, str):
        return records.RunPrediction(run.name, None, None, notes=(solution,))
    notes = list(solution.notes)
    critical = threshold = None
    try:
        if run.shaker is None:
            stated = solution.critical
            critical = _amount(stated(plane) if stated else rig.critical_speed(solution.at_speed, plane))
    except FitError as error:
        notes.append(f"no critical speed: {error.what}")
    try:
        threshold = _amount(solution.threshold() if solution.threshold else rig.threshold(solution.at_speed))
        if threshold is None:
            notes.append(f"no threshold below {rig.search.highest / RPM:.0f} rpm")
    except FitError as error:
        notes.append(f"no threshold: {error.what}")
    speed = _drawn_speeds(run, threshold, critical)
    motion: tuple[records.Motion, ...] = ()
    if curves:
        outputs = rig.condense(speed, run.unbalance, run.shaker).response(*solution.at_speed(speed))
        motion = motions(run.planes, outputs.reshape(speed.size, len(run.planes), 2))
    return records.RunPrediction(
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


def _amount(speed: Uncertain | float | None) -> records.UncertainAmount | None:
    if isinstance(speed, Uncertain):
        return records.UncertainAmount(speed.value, speed.std_error)
    return None if speed is None else records.UncertainAmount(speed)


def _drawn_speeds(
    run: records.RunUp, threshold: records.UncertainAmount | None, critical: records.UncertainAmount | None
) -> FloatArray:
    last = float(run.speed[-1]) if threshold is None else min(float(run.speed[-1]), threshold.value)
    first = run.speed[0]
    speed = np.linspace(first, max(last, first), max(2, round((last - first) / CURVE_STEP) + 1))
    if critical is None:
        return speed
    about = critical.value + np.arange(-PEAK_POINTS, PEAK_POINTS + 1) * PEAK_STEP
    return np.union1d(speed, about[(about > speed[0]) & (about < speed[-1])])


MOST_STEPS = 60
TOLERANCE = 1e-6
LEAST_DAMPING = 1e-9


@dataclass(frozen=True, kw_only=True)
class PointFit(SpeedwiseFit):
    """std_error (n_speed, 8) [N/m, N s/m], probes included, NaN at a bound; n_effective: parameters that the
    data determine.
    """

    std_error: FloatArray
    n_effective: float


PointFits = Sequence[PointFit] | Sequence[AmplitudeFit]


def fit_points(
    rig: RunUpRotor, runs: Iterable[records.RunUp], bound: float = 0.3, ridge: float = 0.15
) -> list[PointFit]:
    """One PointFit per load; *bound* and *ridge* in parts of the `scales`. Equation (run-points)."""
    return [_fit_load(rig, group, bound, ridge) for group in runs_by_load(rig, runs)]


def _fit_load(rig: RunUpRotor, group: LoadRuns, bound: float, ridge: float) -> PointFit:
    start = as_eight(*rig.start_coefficients(group.load, group.speed))
    unit = scales(start)
    parts = _descend(group, start, unit, bound, ridge)
    eight = start + unit * parts
    residual, slopes = group.residual_and_slopes(eight)
    slopes = slopes * unit[:, None, :]
    at_bound = np.abs(parts) >= bound
    free = slopes * ~at_bound[:, None, :]
    covariance = np.linalg.inv(_normal(free) + np.eye(8) / ridge**2)
    less_baselines = (
        (run.run, run.by_baseline(run.residual_and_slopes(eight)[1] * (unit * ~at_bound)[:, None]))
        for run in group.runs
        if run.run.baseline is not None
    )
    noise = covariance + covariance @ shared_noise(less_baselines, len(unit[0])) @ covariance
    of_probes = np.zeros_like(start)
    for change in group.residual_changes([source.source for source in sources_of([group])]):
        of_probes += np.einsum("nij,nkj,nk->ni", covariance, free, change) ** 2
    deviation = np.sqrt(np.diagonal(noise, axis1=1, axis2=2) + of_probes) * unit
    rank, condition = rank_of(slopes)
    return PointFit(
        load=group.load,
        speed=group.speed,
        start=start,
        coefficients=eight,
        std_error=np.where(at_bound, np.nan, deviation),
        at_bound=at_bound,
        rank=rank,
        condition=condition,
        chi2=float(np.sum(residual**2)),
        n_datum=residual.size,
        n_effective=float(np.einsum("nij,nji->", covariance, _normal(free))),
    )


def _normal(slopes: FloatArray) -> FloatArray:
    return slopes.swapaxes(1, 2) @ slopes


def _descend(group: LoadRuns, start: FloatArray, unit: FloatArray, bound: float, ridge: float) -> FloatArray:
    """Of every point (n_speed, 8), damped where a step does not lower its sum of squares."""
    parts, damping = np.zeros_like(start), np.full(start.shape[0], 1e-6)
    residual, slopes = group.residual_and_slopes(start)
    cost = _cost(residual, parts, ridge)
    for _ in range(MOST_STEPS):
        trial = _step(residual, slopes * unit[:, None, :], parts, damping, bound, ridge)
        new_residual, new_slopes = group.residual_and_slopes(start + unit * trial)
        new_cost = _cost(new_residual, trial, ridge)
        better = new_cost < cost
        if np.max(np.abs(trial - parts)) < TOLERANCE or not np.any(better | (damping < 1e6)):
            return parts
        damping = np.where(better, np.maximum(damping / 10, LEAST_DAMPING), damping * 10)
        parts = np.where(better[:, None], trial, parts)
        cost = np.where(better, new_cost, cost)
        residual = np.where(better[:, None], new_residual, residual)
        slopes = np.where(better[:, None, None], new_slopes, slopes)
    what = f"the coefficients under {group.load:.4g} N were not found in {MOST_STEPS} steps"
    raise FitError(what, hint="check unbalance, phases, standard errors")


def _cost(residual: FloatArray, parts: FloatArray, ridge: float) -> FloatArray:
    return np.sum(residual**2, axis=1) + np.sum(parts**2, axis=1) / ridge**2


def _step(
    residual: FloatArray,
    slopes: FloatArray,
    parts: FloatArray,
    damping: FloatArray,
    bound: float,
    ridge: float,
) -> FloatArray:
    """A Gauss-Newton step within the box: coefficients beyond a bound are set to it."""
    gradient = (slopes.swapaxes(1, 2) @ residual[..., None])[..., 0] + parts / ridge**2
    fixed_mask = ((parts >= bound) & (gradient < 0)) | ((parts <= -bound) & (gradient > 0))
    normal = _normal(slopes) + np.eye(8) / ridge**2
    normal = normal + damping[:, None, None] * np.eye(8) * np.diagonal(normal, axis1=1, axis2=2)[:, None, :]
    step = np.zeros_like(parts)
    for _ in range(8):
        free = ~fixed_mask
        fixed = step * fixed_mask
        reduced = normal * (free[:, :, None] & free[:, None, :]) + np.eye(8) * fixed_mask[:, None, :]
        side = (gradient + (normal @ fixed[..., None])[..., 0]) * free
        step = fixed - np.linalg.solve(reduced, side[..., None])[..., 0]
        beyond = np.abs(parts + step) > bound * (1 + 1e-12)
        if not np.any(beyond):
            break
        step = np.clip(parts + step, -bound, bound) - parts
        fixed_mask = fixed_mask | beyond
    return np.clip(parts + step, -bound, bound)


BEYOND = "above the last measured speed K and Omega C stay constant: its threshold is extrapolated"
WITHOUT_INTERVAL = (
    "chi-square rejects the fit: critical speed, threshold and coefficients are values without an interval"
)
ELSEWHERE = "its coefficients exist at the fitted loads only; a metamodel extends them to this load"

# Prediction for a run, on a rotor with its unbalance, or why there is none.
Predictor = Callable[[RunUpRotor, records.RunUp], AtLoad | str]


@dataclass(frozen=True)
class Solved:
    """A fitted method: its record without predictions, its predictor; for metamodels its *fits* of every load
    at measured speeds, or one *anywhere*.
    """

    method: records.RunUpMethod
    predictor: Predictor
    fits: tuple[SpeedwiseFit, ...] = ()
    anywhere: Queried | None = None


def start() -> Solved:
    """The rotor file's bearing, without a fit."""

    def at(run_rig: RunUpRotor, run: records.RunUp) -> AtLoad:
        return AtLoad(run_rig.start(run.load), as_eight(*run_rig.start_coefficients(run.load, run.speed)))

    title, verdict = "original (start)", "not fitted"
    return Solved(records.RunUpMethod(records.START, title, verdict, predictions=(), unknowns=0), at)


def solve_amplitudes(rig: RunUpRotor, trained: Sequence[records.RunUp], settings: RunUpSettings) -> Solved:
    unbalanced = [run for run in trained if run.shaker is None]
    if not unbalanced:
        raise FitError("every trained run is under a shaker", hint="amplitudes are those of an unbalance")
    fits = fit_amplitudes(rig, unbalanced, settings.bound, settings.search)
    fit = fits[len(fits) // 2]
    point = int(np.argmax(fit.evaluations))
    rows = fit.history.of(point)
    evaluations = np.diff(rows.evaluations[:, 0], prepend=0)
    best = fit.factors[int(np.argmin(fit.objectives[:, point])), point]
    place = f"{fit.load:.3g} N, {fit.speed[point] / RPM:.0f} rpm"
    objective, mesh, counts = (
        column(values) for values in (rows.objective[:, 0], rows.mesh[:, 0], evaluations)
    )
    method = records.RunUpMethod(
        "amplitudes",
        f"(a) amplitudes, {'pattern search' if settings.search == 'pattern' else 'COBYQA'}",
        **_point_values(fits),
        convergence=(
            records.Convergence(place, objective, mesh, counts, bool(fit.capped[point]), column(best)),
        ),
        spreads=_spreads(rig, unbalanced, settings),
        remarks=(f"{perfect_but_wrong(fits)}.", *_cap(fits)),
    )
    return Solved(method, _points_at(fits), tuple(fits))


def solve_points(rig: RunUpRotor, trained: Sequence[records.RunUp], settings: RunUpSettings) -> Solved:
    fits = fit_points(rig, trained, settings.bound, settings.ridge)
    remark = (
        f"a ridge of {100 * settings.ridge:g} % about the start values determines what the data do not; its "
        "standard deviations include this."
    )
    method = records.RunUpMethod(
        "points", "(b) complex, point by point", **_point_values(fits), remarks=(remark,)
    )
    return Solved(method, _points_at(fits), tuple(fits))


def solve_joint(rig: RunUpRotor, trained: Sequence[records.RunUp], settings: RunUpSettings) -> Solved:
    fit = fit_jointly(rig, trained, known=settings.known)
    return Solved(joint_method(fit), joint_at(fit), anywhere=fit)


def solve_process(
    rig: RunUpRotor,
    trained: Sequence[records.RunUp],
    settings: RunUpSettings,  # noqa: ARG001
) -> Solved:
    fit = fit_with_process(rig, trained, fit_jointly(rig, trained))
    method = records.RunUpMethod(
        "process",
        "(d) joint fit with factors",
        unknowns=int(fit.values.size),
        rank=fit.n_determined,
        remarks=(f"{fit.statement}.",),
        **_fit_values(fit),
    )
    return Solved(method, joint_at(fit), anywhere=fit)


def joint_method(fit: JointFit) -> records.RunUpMethod:
    return records.RunUpMethod(
        "joint",
        "(c) joint physical fit",
        unknowns=len(PARAMETERS) - len(fit.known),
        rank=fit.rank,
        share_at_bound=fit.share_at_bound,
        free=fit.prior_dominated,
        parameters=tuple(
            _parameter(fit, parameter) for parameter in PARAMETERS if parameter not in fit.known
        ),
        **_fit_values(fit),
    )


NUMBERS = ("condition", "chi2_per_datum", "chi2_p", "n_datum", "n_effective")


def _fit_values(fit: JointFit | ProcessFit) -> dict[str, Any]:
    return {
        "verdict": records.REJECTED if fit.rejected else "not rejected",
        "predictions": (),
        **{name: getattr(fit, name) for name in NUMBERS},
    }


def _parameter(fit: JointFit, name: str) -> Parameter:
    factor, bound = fit.parameter(name), bool(fit.at_bound[PARAMETERS.index(name)])
    if bound or fit.rejected:
        return Parameter(name, factor.value, "1", at_bound=bound)
    ci95 = records.UncertainAmount(factor.value, factor.std_error).ci95
    return with_sources_of(fit, Parameter(name, factor.value, "1", ci95=ci95), factor.std_error)


def with_sources_of(fit: JointFit, parameter: Parameter, combined: float) -> Parameter:
    """The parameter with its *combined* error [1] in parts: of noise and priors, and of each source."""
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
        expanded=records.TWO_SIDED * combined,
        coverage_factor=records.TWO_SIDED,
        budget=parts,
    )


def joint_at(fit: JointFit | ProcessFit) -> Predictor:
    """Predictions by a joint fit at any load and speed, without intervals where chi-square rejects it."""

    def at(run_rig: RunUpRotor, run: records.RunUp) -> AtLoad:
        run_fit = replace(fit, rig=run_rig)
        eight, error = fit.coefficients(run.load, run.speed)
        caution = fit.caution(run.load)
        notes = (caution,) if caution else ()
        if fit.rejected:
            return AtLoad(fit.at_load(run.load), eight, notes=(WITHOUT_INTERVAL, *notes))
        return AtLoad(
            fit.at_load(run.load),
            eight,
            error,
            lambda plane: run_fit.critical_speed(run.load, plane),
            lambda: run_fit.threshold(run.load),
            notes,
        )

    return at


def _points_at(fits: PointFits) -> Predictor:
    def at(_rig: RunUpRotor, run: records.RunUp) -> AtLoad | str:
        load_fit = next((fit for fit in fits if abs(fit.load / run.load - 1) < SAME_LOAD), None)
        if load_fit is None:
            return ELSEWHERE
        at_speed = load_fit.at_speed()
        same = load_fit.speed.shape == run.speed.shape and np.allclose(load_fit.speed, run.speed)
        error = load_fit.std_error if same and isinstance(load_fit, PointFit) else None
        return AtLoad(at_speed, as_eight(*at_speed(run.speed)), error, notes=(BEYOND,))

    return at


def _point_values(fits: PointFits) -> dict[str, Any]:
    chi2, datum = sum(fit.chi2 for fit in fits), sum(fit.n_datum for fit in fits)
    effective = sum(fit.n_effective for fit in fits)
    n_redundant = datum - effective
    shares = np.concatenate([np.asarray(fit.at_bound).ravel() for fit in fits])
    rank = int(min(fit.rank.min() for fit in fits))
    return {
        "verdict": "determined" if rank == 8 else "not determined",
        "predictions": (),
        "rank": rank,
        "condition": float(max(fit.condition.max() for fit in fits)),
        "share_at_bound": float(np.mean(shares)),
        "chi2_per_datum": chi2 / n_redundant if n_redundant > 0.5 else None,
        "chi2_p": chi2_tail(chi2, n_redundant) if n_redundant > 0.5 else None,
        "n_datum": datum,
        "n_effective": float(effective),
    }


def _cap(fits: Sequence[AmplitudeFit]) -> list[str]:
    capped, every = sum(int(fit.capped.sum()) for fit in fits), sum(fit.speed.size for fit in fits)
    limit = f"the limit of {max(int(fit.evaluations.max()) for fit in fits)} evaluations"
    return [f"{capped} of {every} searches ended at {limit}, not at the smallest mesh."] if capped else []


def _spreads(
    rig: RunUpRotor, runs: Sequence[records.RunUp], settings: RunUpSettings
) -> tuple[records.StartSpread, ...]:
    if settings.starts < 2:
        return ()
    loads = sorted({run.load for run in runs})
    middle = loads[len(loads) // 2]
    of_middle = [run for run in runs if run.load == middle]
    search = settings.search, settings.starts, settings.seed
    (fit,) = fit_amplitudes(rig, of_middle, settings.bound, *search)
    points = dict.fromkeys([int(np.argmax(fit.measured)), fit.speed.size - 1])
    spreads = []
    for point in points:
        place = f"{fit.load:.3g} N, {fit.speed[point] / RPM:.0f} rpm"
        # The relative misfit of the amplitudes, because the sum of squares has no scale.
        misfit = np.sqrt(fit.objectives[:, point] / fit.measured[point])
        factors = tuple(column(row) for row in fit.factors[:, point])
        spreads.append(records.StartSpread(place, factors, column(misfit)))
    return tuple(spreads)

"""Weighted residuals of run-ups with analytic slopes, and what a set of run-ups can tell apart.

A round shaft under any unbalance moves its journal along one and the same complex vector (x_b, y_b): two
complex equations. Only a force that does not turn with the shaft moves the journal along another vector.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.estimation.statistics import combination_text
from labpipe.methods.rotor.pinned import CondensedRotor
from labpipe.methods.rotor.posterior import RANK_TOLERANCE, Residual, rank_of
from labpipe.methods.run_ups.records import RankRow, RunUp, Shaker
from labpipe.methods.run_ups.rotor import COEFFICIENTS, CoefficientFamily, RunUpRotor, as_eight, as_matrices
from labpipe.records.uncertain import Uncertainty


@dataclass(frozen=True)
class ExcitedRun:
    """A run and the rotor condensed under its excitation."""

    run: RunUp
    condensed: CondensedRotor

    @classmethod
    def of(cls, rig: RunUpRotor, run: RunUp) -> ExcitedRun:
        return cls(run, rig.excite(run))

    @property
    def n_equation(self) -> int:
        """Real equations per speed."""
        return 4 * len(self.run.planes)

    def residual_and_slopes(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(computed - measured) / error, (n_speed, n_equation), and its derivatives (n_speed, n_equation, 8)
        by *coefficients* (n_speed, 8) [N/m, N s/m]. Equation (run-weights).
        """
        response, slopes = self.condensed.response_and_slopes(*as_matrices(coefficients))
        weighted = self._weight(np.moveaxis(slopes, -1, 0))
        return self._weight(response - self._measured), np.moveaxis(weighted, 0, -1)

    def residual_changes(self, sources: Sequence[str]) -> FloatArray:
        """Changes (n_source, n_speed, n_equation) [-] of the residual by an uncertainty of each *source*."""
        changes, none = self.run.changes(), np.zeros_like(self.run.response)
        rows = [self._weight(-changes.get(source, none).reshape(self.run.n_speed, -1)) for source in sources]
        return np.array(rows).reshape(len(sources), self.run.n_speed, self.n_equation)

    def by_baseline(self, slopes: FloatArray) -> FloatArray:
        """J^T dr (n_speed, n_reading, n_parameter) [1/parameter unit] by one standard error of each reading
        of the baseline, along and across it, between two in their shares; *slopes* J (n_speed, n_equation,
        n_parameter) [1/parameter unit].
        """
        # Every output by itself: its two equations are apart.
        n_speed, n_output = self._measured.shape
        weighted = self._weight(self.run.baseline_changes()).reshape(2, -1, n_speed, 2, n_output)
        by = slopes.reshape(n_speed, 2, n_output, -1)
        return np.einsum("prnco,ncof->nprof", weighted, by).reshape(n_speed, -1, by.shape[-1])

    @property
    def _measured(self) -> ComplexArray:
        return self.run.response.reshape(self.run.n_speed, -1)

    def _weight(self, difference: ComplexArray) -> FloatArray:
        """Along the phasor over the amplitude's error, across it over amplitude times phase error."""
        run, shape = self.run, (self.run.n_speed, -1)
        size = np.abs(self._measured)
        turned = difference * (self._measured / size).conj()
        along = turned.real / run.amplitude_error.reshape(shape)
        return np.concatenate([along, turned.imag / (size * run.phase_error.reshape(shape))], axis=-1)


@dataclass(frozen=True)
class LoadRuns:
    """All runs of one load [N] at their shared speeds (n_speed,) [rad/s]."""

    load: float
    speed: FloatArray
    runs: tuple[ExcitedRun, ...]

    def residual_and_slopes(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As of a run, over the equations of all, (n_speed, n_equation) [-] and (n_speed, n_equation, 8)."""
        parts = [run.residual_and_slopes(coefficients) for run in self.runs]
        residuals, slopes = zip(*parts, strict=True)
        return np.concatenate(residuals, axis=1), np.concatenate(slopes, axis=1)

    def residual(self, model: CoefficientFamily, values: FloatArray) -> Residual:
        """(n,) [1] by a family at *values* (n_parameter,), and derivatives by these (n, n_parameter)."""
        load = np.full(self.speed.size, self.load)
        eight, by_parameter = model.coefficients_and_slopes(values, load, self.speed)
        residual, slopes = self.residual_and_slopes(eight)
        return residual.ravel(), lambda: (slopes @ by_parameter).reshape(-1, values.size)

    def residual_changes(self, sources: Sequence[str]) -> FloatArray:
        """As of each run, over the equations of all, (n_source, n_speed, n_equation) [-]."""
        return np.concatenate([run.residual_changes(sources) for run in self.runs], axis=2)


def sources_of(groups: Iterable[LoadRuns]) -> tuple[Uncertainty, ...]:
    """The uncertainties of the probes of all runs, each source once."""
    uncertainties: dict[str, Uncertainty] = {}
    for error in (error for group in groups for run in group.runs for error in run.run.uncertainties):
        uncertainties.setdefault(error.uncertainty.source, error.uncertainty)
    return tuple(uncertainties.values())


def shared_noise(parts: Iterable[tuple[RunUp, FloatArray]], n_parameter: int) -> FloatArray:
    """What J^T J (..., n_parameter, n_parameter) [1/parameter units] of runs less one baseline lacks: its
    noise is the same in all of them, and weights count it as anew in each. *parts*: a run, and of it J^T dr
    of `by_baseline`. Equation (run-baseline).
    """
    excess = np.zeros((n_parameter, n_parameter))
    sums: dict[bytes, FloatArray] = {}
    for run, part in parts:
        assert run.baseline is not None
        key = run.baseline.response.tobytes()
        sums[key] = sums.get(key, np.zeros_like(part)) + part
        excess = excess - part.swapaxes(-1, -2) @ part
    return excess + sum(part.swapaxes(-1, -2) @ part for part in sums.values())


def runs_by_load(rig: RunUpRotor, runs: Iterable[RunUp]) -> list[LoadRuns]:
    """The runs grouped by load, in order; DataError where runs of one load share no speed."""
    return _group(rig, runs, lambda run: (run.load,))


def runs_by_speeds(rig: RunUpRotor, runs: Iterable[RunUp]) -> list[LoadRuns]:
    """The runs grouped by load and speeds, in order: for a fit whose runs need share no speed."""
    return _group(rig, runs, lambda run: (run.load, run.speed.tobytes()))


def _group(rig: RunUpRotor, runs: Iterable[RunUp], key: Callable[[RunUp], Hashable]) -> list[LoadRuns]:
    groups: dict[Hashable, list[RunUp]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    if not groups:
        raise DataError("there is no run-up", hint="give at least one")
    return [_interpolate_to_shared_speeds(rig, group) for group in groups.values()]


def _interpolate_to_shared_speeds(rig: RunUpRotor, group: Sequence[RunUp]) -> LoadRuns:
    """Speeds are the same when they agree to a millionth."""
    load, shared = group[0].load, group[0].speed
    for run in group[1:]:
        shared = shared[np.min(np.abs(shared[:, None] / run.speed - 1), axis=1) < 1e-6]
    if shared.size == 0:
        names = ", ".join(run.name for run in group)
        what = f"the runs {names} under {load:.4g} N share no speed"
        raise DataError(what, hint="measure them at the same speeds")
    return LoadRuns(load, shared, tuple(ExcitedRun.of(rig, _select_speeds(run, shared)) for run in group))


def _select_speeds(run: RunUp, speed: FloatArray) -> RunUp:
    chosen = np.array([int(np.argmin(np.abs(run.speed - target))) for target in speed])
    return replace(
        run,
        speed=run.speed[chosen],
        response=run.response[chosen],
        amplitude_error=run.amplitude_error[chosen],
        phase_error=run.phase_error[chosen],
    )


def scales(start: FloatArray) -> FloatArray:
    """Unit of change (..., 8) [N/m, N s/m] of every coefficient: its size in *start* (..., 8), at least a
    fifth of the mean direct one, because K_yx crosses zero.
    """
    mean = np.sqrt(np.abs(start[..., [0, 4]] * start[..., [3, 7]]))
    return np.maximum(np.abs(start), 0.2 * np.repeat(mean, 4, axis=-1))


def displacement_slopes(response: ComplexArray, slopes: ComplexArray) -> FloatArray:
    """Derivatives (..., n_plane, 8) of the planes' largest displacements by the coefficients [N/m, N s/m],
    from outputs (..., n_output) [m] and their slopes (..., n_output, 8): d |f| = Re(f* df) / |f| of both
    circles f = X +- jY.
    """
    planes = response.reshape(*response.shape[:-1], -1, 2)
    by = slopes.reshape(*planes.shape, slopes.shape[-1])
    derivatives = np.zeros((*planes.shape[:-1], slopes.shape[-1]))
    for turn in (1j, -1j):
        circle = planes[..., 0] + turn * planes[..., 1]
        along = (circle / np.abs(circle)).conj()[..., None]
        derivatives += (along * (by[..., 0, :] + turn * by[..., 1, :])).real / 2
    return derivatives


def unseen_combinations(slopes: FloatArray, names: Sequence[str] = COEFFICIENTS) -> tuple[str, ...]:
    """Null space of a Jacobian (n_equation, n_parameter) [-] in words, one entry per direction."""
    _, singular, rows = np.linalg.svd(slopes, full_matrices=True)
    whole = np.zeros(rows.shape[0])
    whole[: singular.size] = singular
    return tuple(
        combination_text(names, row)
        for row, size in zip(rows, whole, strict=True)
        if size <= RANK_TOLERANCE * whole[0]
    )


AMPLITUDES = "amplitudes at the planes"
COMPLEX = "amplitude and phase in both directions"
SECOND = "the same, with a second unbalance run"
SHAKEN = "the same, with a run under a force that does not turn"
SEEN = (
    "the journal moves along one vector (x_b, y_b): only (k_xx + j Omega c_xx) x_b + (k_xy + j Omega c_xy) "
    "y_b and the same sum of the y row are measured"
)
WORDS = {
    2: "one number per plane is measured; six combinations of the eight coefficients are undetermined",
    4: f"{SEEN}; four combinations of the eight coefficients are undetermined",
    8: "all eight coefficients are determined",
}
ADVICE = "a second unbalance run adds no rank, a non-rotating shaker run does"
OF_SHAKER = "a run under an unbalance adds rank, and so does a shaker run in another direction"


def rank_statements(
    rig: RunUpRotor, load: float, speed: float, coefficients: FloatArray | None = None
) -> tuple[RankRow, ...]:
    """The statements for amplitudes, phasors, a second unbalance, and a shaker, at one *load* [N] and *speed*
    [rad/s], about *coefficients* (8,) [N/m, N s/m], or those of the rotor file.
    """
    place = np.array([speed])
    eight = as_eight(*rig.start_coefficients(load, place)) if coefficients is None else coefficients[None]
    unit = scales(eight)[0]
    # Of runs under a shaker alone no unbalance is known; its size says nothing of ranks.
    unbalance = rig.known_unbalance or {rig.plane_names[0]: 1.0 + 0j}
    first = _slopes(rig, place, eight, unbalance) * unit
    other = {rig.plane_names[-1]: 1j * max(abs(size) for size in unbalance.values())}
    second = _slopes(rig, place, eight, other) * unit
    shaker = _slopes(rig, place, eight, None) * unit
    both = np.concatenate([first, second])
    amplitudes = displacement_slopes(*_response(rig, place, eight, unbalance)) * unit
    return (
        _statement(AMPLITUDES, amplitudes),
        _statement(COMPLEX, first),
        _statement(SECOND, both, ADVICE),
        _statement(SHAKEN, np.concatenate([both, shaker])),
    )


def measured_statement(rig: RunUpRotor, runs: Iterable[RunUp], load: float, speed: float) -> RankRow:
    """The statement for the *runs* of one load at one speed."""
    runs = list(runs)
    place = np.array([speed])
    eight = as_eight(*rig.start_coefficients(load, place))
    unit = scales(eight)[0]
    acting = [(run.unbalance if run.shaker is None else None, run.shaker) for run in runs]
    parts = [_slopes(rig, place, eight, *of_run) * unit for of_run in acting]
    named = ", ".join(run.name for run in runs)
    shaken = [run.shaker is not None for run in runs]
    advice = OF_SHAKER if all(shaken) else ADVICE if len(runs) > 1 and not any(shaken) else ""
    return _statement(named, np.concatenate(parts), advice)


def _statement(source: str, slopes: FloatArray, advice: str = "") -> RankRow:
    rows = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    computed_rank, condition = rank_of(rows)
    rank = int(computed_rank)
    sentence = WORDS.get(rank, f"{rank} combinations of the eight coefficients are determined")
    return RankRow(source, rank, float(condition), sentence, unseen_combinations(rows), advice)


def _slopes(rig: RunUpRotor, *excitation: Any) -> FloatArray:
    slopes = _response(rig, *excitation)[1]
    return np.concatenate([slopes.real, slopes.imag])


def _response(
    rig: RunUpRotor,
    speed: FloatArray,
    eight: FloatArray,
    unbalance: Mapping[str, complex] | None,
    shaker: Shaker | None = None,
) -> tuple[ComplexArray, ComplexArray]:
    """Under an unbalance or, without one, a force along x at the first plane."""
    force = None if unbalance else shaker or Shaker(rig.plane_names[0], 1.0, 0.0)
    split = eight.reshape(1, 2, 2, 2)
    condensed = rig.condense(speed, unbalance or {}, force)
    response, slopes = condensed.response_and_slopes(split[:, 0], split[:, 1])
    return response[0], slopes[0]

"""Identifiability of the eight coefficients from run-ups at one load and speed: rank, condition, undetermined combinations.

A round shaft under any unbalance moves its journal along one and the same complex vector (x_b, y_b): two complex equations. Amplitudes
alone give one number per disc. Only a force that does not turn with the shaft moves the journal along another vector.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.records.run_up import RunUp, Shaker
from labpipe.records.run_up_result import RankRow
from labpipe.rigs.film_family import as_eight
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.run_ups.misfit import rank_of, scales, unseen_combinations

AMPLITUDES = "amplitudes at the planes"
COMPLEX = "amplitude and phase in both directions"
SECOND = "the same, with a second unbalance run"
SHAKEN = "the same, with a run under a force that does not turn"
SEEN = (
    "the journal moves along one vector (x_b, y_b): only (k_xx + j Omega c_xx) x_b + (k_xy + j Omega c_xy) y_b and the same sum "
    "of the y row are measured"
)
WORDS = {
    2: "one number per plane is measured; six combinations of the eight coefficients are undetermined",
    4: f"{SEEN}; four combinations of the eight coefficients are undetermined",
    8: "all eight coefficients are determined",
}
ADVICE = "a second unbalance run adds no rank, a non-rotating shaker run does"


def rank_statements(rig: RunUpRotor, load: float, speed: float, coefficients: FloatArray | None = None) -> tuple[RankRow, ...]:
    """The four statements for amplitudes, complex amplitudes, a second unbalance, and a shaker, at one *load* [N] and *speed* [rad/s].

    *coefficients* (8,) [N/m, N s/m]: about which, those of the rotor file unless given. Nothing measured is needed.
    """
    place = np.array([speed])
    eight = as_eight(*rig.start_coefficients(load, place)) if coefficients is None else np.asarray(coefficients, np.float64)[None]
    unit = scales(eight)[0]
    first = _slopes(rig, place, eight, rig.known_unbalance) * unit
    other = rig.plane_names[-1]
    second = _slopes(rig, place, eight, {other: 1j * max(abs(size) for size in rig.known_unbalance.values())}) * unit
    shaker = _slopes(rig, place, eight, None) * unit
    both = np.concatenate([first, second])
    return (
        _statement(AMPLITUDES, _amplitude_slopes(rig, place, eight) * unit),
        _statement(COMPLEX, first),
        _statement(SECOND, both, ADVICE),
        _statement(SHAKEN, np.concatenate([both, shaker])),
    )


def measured_statement(rig: RunUpRotor, runs: Iterable[RunUp], load: float, speed: float) -> RankRow:
    """The statement for the *runs* at hand (of one load, at one speed), with *advice* where a second unbalance adds no rank."""
    runs = list(runs)
    place = np.array([speed])
    eight = as_eight(*rig.start_coefficients(load, place))
    unit = scales(eight)[0]
    parts = [_slopes(rig, place, eight, run.unbalance if run.shaker is None else None, run.shaker) * unit for run in runs]
    named = ", ".join(run.name for run in runs)
    without_shaker = len(runs) > 1 and all(run.shaker is None for run in runs)
    return _statement(named, np.concatenate(parts), ADVICE if without_shaker else "")


def _statement(source: str, slopes: FloatArray, advice: str = "") -> RankRow:
    rows = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    computed_rank, condition = rank_of(rows)
    rank = int(computed_rank)
    sentence = WORDS.get(rank, f"{rank} combinations of the eight coefficients are determined")
    return RankRow(source, rank, float(condition), sentence, unseen_combinations(rows), advice)


def _slopes(
    rig: RunUpRotor, speed: FloatArray, eight: FloatArray, unbalance: Mapping[str, complex] | None, shaker: Shaker | None = None
) -> FloatArray:
    """Of real and imaginary parts (4 n_plane, 8), under an unbalance or, without one, a force along x at the first plane."""
    _, slopes = _response(rig, speed, eight, unbalance, shaker)
    return np.concatenate([slopes.real, slopes.imag])


def _response(
    rig: RunUpRotor, speed: FloatArray, eight: FloatArray, unbalance: Mapping[str, complex] | None, shaker: Shaker | None = None
) -> tuple[ComplexArray, ComplexArray]:
    shape = (1, len(rig.planes), 2)
    force = None if unbalance else shaker or Shaker(rig.plane_names[0], 1.0, 0.0)
    run = RunUp(
        "",
        1.0,
        speed,
        rig.plane_names,
        np.ones(shape, np.complex128),
        amplitude_error=np.ones(shape),
        phase_error=np.ones(shape),
        unbalance=unbalance or {},
        shaker=force,
    )
    split = eight.reshape(1, 2, 2, 2)
    response, slopes = rig.excited(run).response_and_slopes(split[:, 0], split[:, 1])
    return response[0], slopes[0]


def _amplitude_slopes(rig: RunUpRotor, speed: FloatArray, eight: FloatArray) -> FloatArray:
    """Of the largest displacement of every plane, (n_plane, 8): d |f| = Re(f* df) / |f| for both circles of the orbit."""
    response, slopes = _response(rig, speed, eight, rig.known_unbalance)
    response, slopes = response.reshape(-1, 2), slopes.reshape(-1, 2, 8)
    derivatives = np.zeros((response.shape[0], 8))
    for turn in (1j, -1j):
        circle = response[:, 0] + turn * response[:, 1]
        derivatives += ((circle / np.abs(circle)).conj()[:, None] * (slopes[:, 0] + turn * slopes[:, 1])).real / 2
    return derivatives

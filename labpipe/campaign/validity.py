"""Up to which amplitude of motion coefficients are those of small motions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from labpipe.campaign.bandwise import holm
from labpipe.distributions import normal_tail
from labpipe.records.condition_matrix import ConditionMatrix, MatrixPoint

# A condition of this dimension and with a name that begins so is the size of the motion.
AMPLITUDES = ("amplitude", "orbit")


def amplitude_statement(matrix: ConditionMatrix, level: float) -> str:
    """The largest amplitude whose coefficients do not differ from those at the smallest, as a sentence; empty where none is tested.

    Each coefficient at each amplitude against that at the smallest, at equal other conditions: z = (v - v_0) / sqrt(s^2 + s_0^2) of the
    errors by noise, Holm's correction over all of them, at *level* [1]. Equation (comp-validity).
    """
    place = next((n for n, axis in enumerate(matrix.axes) if axis.unit == "m" and axis.name.lower().startswith(AMPLITUDES)), None)
    if place is None or len(matrix.axes[place].levels) < 2:
        return ""
    pairs = list(_pairs(matrix, place))
    corrected = holm(np.array([chance for _, _, chance in pairs]))
    differing = [(number, name) for (number, name, _), p in zip(pairs, corrected, strict=True) if p < level]
    axis = matrix.axes[place]
    if not differing:
        return f"No coefficient differs up to {axis.text(axis.levels[-1])}"
    first = min(number for number, _ in differing)
    names = ", ".join(dict.fromkeys(name for number, name in differing if number == first))
    valid, changed = axis.text(axis.levels[first - 1]), axis.text(axis.levels[first])
    return f"The coefficients of small motions hold up to {valid}; at {changed} {names} differ"


def _pairs(matrix: ConditionMatrix, place: int) -> Sequence[tuple[int, str, float]]:
    """(level of the amplitude, coefficient, p-value against the smallest amplitude) at equal other conditions."""
    groups: dict[tuple[int, ...], list[MatrixPoint]] = {}
    for point in matrix.points:
        groups.setdefault(point.place[:place] + point.place[place + 1 :], []).append(point)
    return [
        (point.place[place], name, chance)
        for points in groups.values()
        for point, name in itertools.product(sorted(points, key=lambda one: one.place[place])[1:], matrix.names)
        if (chance := _chance(min(points, key=lambda one: one.place[place]), point, name)) is not None
    ]


def _chance(first: MatrixPoint, other: MatrixPoint, name: str) -> float | None:
    a, b = first.value(name), other.value(name)
    if a is None or b is None or a.parameter.derived or a.parameter.std_error is None or b.parameter.std_error is None:
        return None
    size = float(np.hypot(a.parameter.std_error, b.parameter.std_error))
    return 2 * normal_tail(abs(b.parameter.value - a.parameter.value) / size) if size > 0 else None

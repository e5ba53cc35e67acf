"""Choice of the physical poles from those of all orders: the poles of the structure return at every order, those of noise do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import FitError
from labpipe.modal.lscf import NormalEquations, Poles

# Two poles of different orders are one mode where they differ by less than half the decay rate and a share of the frequency, and act on
# the references alike.
SHARE_OF_DECAY, SHARE_OF_FREQUENCY, ALIKE = 0.5, 2e-4, 0.7
# A mode returns in this share of the orders from FIRST_ORDER on; lower orders cannot hold all modes of the band.
LEAST_SHARE, FIRST_ORDER = 0.25, 10
# Damping ratio above which a pole describes the background of the band.
MOST_DAMPING = 0.5
# Of more orders than this one in two shows as much.
MANY_ORDERS = 40
# Number of highest orders whose poles with least bias are averaged.
HIGH_ORDERS = 8


@dataclass(frozen=True)
class Diagram:
    """Poles of all orders [rad/s], and the modes chosen from them: *poles*; *group* (n_pole,): index of the mode, -1 for none.

    *modes*: one row per mode, ascending in frequency; *share* (n_mode,): share of the orders in which the mode appears.
    """

    poles: Poles
    group: IntArray
    modes: Poles
    share: FloatArray


def stabilisation(equations: NormalEquations, band: tuple[float, float], highest: int) -> Diagram:
    """The diagram of the orders up to *highest* and the modes inside *band* [rad/s] that it shows; of many orders every second one.

    Equation (modal-stable).
    """
    orders = range(highest, 1, -(1 + highest // MANY_ORDERS))
    poles = _joined([_inside(equations.poles(order), band) for order in orders])
    counted = [order for order in orders if order >= min(FIRST_ORDER, highest)]
    group, share = _groups(poles, counted)
    modes = _least_biased(equations, poles, group, band, counted[:HIGH_ORDERS])
    return Diagram(poles, group, modes, share)


def nearest_modes(equations: NormalEquations, frequencies: FloatArray, order: int) -> Poles:
    """The pole of *order* nearest to each of *frequencies* (n,) [rad/s], for a choice by hand; of a lower order where that has none.

    FitError where no order has a pole.
    """
    of_orders = (equations.poles(lower) for lower in range(order, 0, -1))
    poles = next((poles for poles in of_orders if poles.values.size), None)
    if poles is None:
        raise FitError(f"no order up to {order} has a pole: no mode stands out of the noise of this band", hint="choose another band")
    index = [int(np.argmin(np.abs(np.abs(poles.values) - frequency))) for frequency in frequencies]
    return Poles(poles.values[index], poles.participation[index], poles.orders[index])


def damping_ratio(poles: ComplexArray) -> FloatArray:
    """-Re / |pole| [1] of *poles* (n,)."""
    return -poles.real / np.abs(poles)


def similarity(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Modal assurance criterion |a^H b|^2 / (|a|^2 |b|^2) of rows of *a* (n, k) and *b* (m, k), (n, m) [1] (Allemang and Brown 1982).

    Equation (modal-mac).
    """
    product = np.abs(a.conj() @ b.T) ** 2
    return np.asarray(product / (np.sum(np.abs(a) ** 2, axis=1)[:, None] * np.sum(np.abs(b) ** 2, axis=1)))


def _inside(poles: Poles, band: tuple[float, float]) -> Poles:
    frequency = np.abs(poles.values)
    keep = (frequency >= band[0]) & (frequency <= band[1]) & (damping_ratio(poles.values) < MOST_DAMPING)
    return Poles(poles.values[keep], poles.participation[keep], poles.orders[keep])


def _joined(parts: list[Poles]) -> Poles:
    return Poles(
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.participation for part in parts]),
        np.concatenate([part.orders for part in parts]),
    )


def _near(poles: Poles, values: ComplexArray, participation: ComplexArray) -> BoolArray:
    """Whether each of *values* (n,) is the mode of each pole, (n, n_pole)."""
    limit = SHARE_OF_DECAY * np.abs(values.real) + SHARE_OF_FREQUENCY * np.abs(values)
    return (np.abs(values[:, None] - poles.values) < limit[:, None]) & (similarity(participation, poles.participation) > ALIKE)


def _groups(poles: Poles, counted: list[int]) -> tuple[IntArray, FloatArray]:
    """Greedy choice: the pole with neighbours in most orders takes them out, until none returns in enough orders."""
    group = np.full(poles.values.size, -1)
    near = _near(poles, poles.values, poles.participation)
    position = {order: n for n, order in enumerate(counted)}
    column = np.array([position.get(int(order), -1) for order in poles.orders], np.intp)
    centres: list[int] = []
    shares: list[float] = []
    while True:
        free = near & (group < 0) & (group < 0)[:, None] & (column >= 0)
        present = np.zeros((poles.values.size, len(counted)), np.bool_)
        rows, members = np.nonzero(free)
        present[rows, column[members]] = True
        count = np.sum(present, axis=1)
        if count.size == 0 or count.max() < LEAST_SHARE * len(counted):
            break
        # Of the poles with the most neighbours the one nearest to their median.
        best = np.flatnonzero(count == count.max())
        middle = np.median(poles.values[best].real) + 1j * np.median(poles.values[best].imag)
        centre = int(best[np.argmin(np.abs(poles.values[best] - middle))])
        group[near[centre] & (group < 0)] = len(centres)
        centres.append(centre)
        shares.append(float(count.max()) / len(counted))
    order = np.argsort(np.abs(poles.values[centres])) if centres else np.empty(0, np.intp)
    rank = np.empty(len(centres), np.intp)
    rank[order] = np.arange(len(centres))
    named = np.where(group >= 0, rank[group] if centres else -1, -1)
    return named.astype(np.intp), np.array(shares)[order]


def _least_biased(equations: NormalEquations, poles: Poles, group: IntArray, band: tuple[float, float], orders: list[int]) -> Poles:
    """The modes with the poles of the constraint of least bias: at each high order the nearest one, then the median."""
    n_mode = int(group.max(initial=-1)) + 1
    centre = np.array([_median(poles.values[group == mode]) for mode in range(n_mode)], np.complex128)
    participation = np.array(
        [_middle(poles.participation[group == mode], poles.values[group == mode]) for mode in range(n_mode)], np.complex128
    ).reshape(n_mode, equations.n_input)
    if not n_mode:
        return Poles(centre, participation, np.empty(0, np.intp))
    near_poles: list[list[complex]] = [[] for _ in range(n_mode)]
    for order in orders:
        refined = _inside(equations.poles(order, stable_noise=True), (0.9 * band[0], 1.1 * band[1]))
        alike = _near(refined, centre, participation)
        for mode in range(n_mode):
            index = np.flatnonzero(alike[mode])
            if index.size:
                near_poles[mode].append(refined.values[index[np.argmin(np.abs(refined.values[index] - centre[mode]))]])
    values = np.array([_median(np.array(near_poles[mode])) if near_poles[mode] else centre[mode] for mode in range(n_mode)])
    return Poles(values, participation, np.full(n_mode, max(orders)))


def _median(values: ComplexArray) -> complex:
    return complex(np.median(values.real), np.median(values.imag))


def _middle(participation: ComplexArray, values: ComplexArray) -> ComplexArray:
    """The participation of the pole nearest to the median."""
    return np.asarray(participation[np.argmin(np.abs(values - _median(values)))])

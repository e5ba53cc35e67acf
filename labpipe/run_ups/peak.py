"""The measured critical speed: the peak of a run-up's response, interpolated between the measured speeds.

Near a critical speed all outputs are dominated by the same two modes and have one common denominator,

    X_o(x) = (a_o + b_o x) / (1 + c x + d x^2),   x: speed, scaled to the points about the peak,

fitted to the complex amplitudes by linear least squares, reweighted with the last denominator (Sanathanan & Koerner 1963). The largest
displacement of the fitted orbit gives the speed; its error is that of refits under the stated noise, together with what two points fewer
and the doubts of the probes change. Polynomials through the amplitudes alone miss the peak by one to two per cent at steps of 100 rpm,
twenty times their own errors.
"""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.run_up import RunUp
from labpipe.records.settings import Uncertain
from labpipe.registry import nearest
from labpipe.rigs.run_up_rotor import largest_displacement

POINTS = 11
FEWEST_POINTS = 7
REWEIGHTED = 4
REFITS = 64
SEED = 20260101
# Range of the peak search relative to the fitted range, and number of its speeds.
INNER = 0.95
FINE = 1601


def measured_critical_speed(run: RunUp, plane: str = "") -> Uncertain:
    """Speed [rad/s] of the largest displacement at a plane (the last one unless named), with its standard error.

    DataError when there is no such plane, or no peak with measured speeds on both sides. Equation (run-peak).
    """
    if plane and plane not in run.planes:
        raise DataError(f"no plane '{plane}' in run '{run.name}'", hint=nearest(plane, run.planes))
    number = run.planes.index(plane) if plane else len(run.planes) - 1
    top = _top(run, number)
    wide, narrow = (_peak(run, number, _about(run, top, size), run.response) for size in (POINTS, POINTS - 2))
    rng = np.random.default_rng(SEED)
    chosen = _about(run, top, POINTS)
    again = [_peak(run, number, chosen, _noisy(run, rng)) for _ in range(REFITS)]
    of_probes = [(_peak(run, number, chosen, run.response + change) - wide) for change in run.changes().values()]
    return Uncertain(wide, float(np.sqrt(np.std(again) ** 2 + (wide - narrow) ** 2 + np.sum(np.square(of_probes)))))


def _top(run: RunUp, number: int) -> int:
    displacement = largest_displacement(run.response)[:, number]
    top = int(np.argmax(displacement))
    if run.n_speed < FEWEST_POINTS or not 2 <= top < run.n_speed - 2:
        hint = f"measure {FEWEST_POINTS} speeds or more on both sides of a peak"
        raise DataError(f"run '{run.name}' has no critical speed within its speeds", hint=hint)
    return top


def _about(run: RunUp, top: int, size: int) -> slice:
    """*size* points about the peak, or fewer where the run is shorter."""
    size = min(size, run.n_speed)
    first = max(0, min(top - size // 2, run.n_speed - size))
    return slice(first, first + size)


def _noisy(run: RunUp, rng: np.random.Generator) -> ComplexArray:
    relative = run.amplitude_error / np.abs(run.response)
    shape = run.response.shape
    turned = np.exp(1j * run.phase_error * rng.standard_normal(shape))
    noisy: ComplexArray = run.response * (1 + relative * rng.standard_normal(shape)) * turned
    return noisy


def _peak(run: RunUp, number: int, chosen: slice, response: ComplexArray) -> float:
    speed = run.speed[chosen]
    middle, half = float(np.mean(speed[[0, -1]])), float(np.ptp(speed)) / 2
    outputs = response[chosen].reshape(speed.size, -1)
    errors = run.amplitude_error[chosen].reshape(speed.size, -1)
    place = np.linspace(-INNER, INNER, FINE)
    fitted = _rational((speed - middle) / half, outputs, errors, place).reshape(FINE, -1, 2)
    return middle + half * float(place[np.argmax(largest_displacement(fitted)[:, number])])


def _rational(x: FloatArray, outputs: ComplexArray, errors: FloatArray, place: FloatArray) -> ComplexArray:
    """The fitted outputs (n_place, n_output) at *place* from outputs and errors (n_point, n_output) at *x*."""
    n, m = outputs.shape
    denominator = np.ones(n, np.complex128)
    for _ in range(REWEIGHTED):
        weight = 1 / (errors * np.abs(denominator)[:, None])
        rows = np.zeros((m, n, 2 * m + 2), np.complex128)
        for number in range(m):
            rows[number, :, 2 * number] = weight[:, number]
            rows[number, :, 2 * number + 1] = weight[:, number] * x
            rows[number, :, -2] = -weight[:, number] * outputs[:, number] * x
            rows[number, :, -1] = -weight[:, number] * outputs[:, number] * x**2
        solution = np.linalg.lstsq(rows.reshape(m * n, -1), (weight * outputs).T.ravel(), rcond=None)[0]
        denominator = 1 + solution[-2] * x + solution[-1] * x**2
    top = solution[0:-2:2] + solution[1:-2:2] * place[:, None]
    fitted: ComplexArray = top / (1 + solution[-2] * place + solution[-1] * place**2)[:, None]
    return fitted

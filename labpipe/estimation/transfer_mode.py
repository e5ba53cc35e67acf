"""One mode seen from another point than it is driven at: its residue has either sign, and any phase."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import Matrices, Setup, Term, angle_of
from labpipe.estimation.regression import solve_scaled
from labpipe.estimation.statistics import stack
from labpipe.records.response import Port

# Cosine between two directions of one point below which the response is across the force.
ACROSS = 0.5
REWEIGHTINGS = 12
# Damping ratio of a start without another.
LIGHT = 0.01
# Peaks that a fit starts from as well, and damping ratios there.
PEAKS, DAMPED = 3, (0.005, 0.03)


@dataclass(frozen=True)
class TransferMode:
    """H(w) = (A + j B) / (w_n^2 - w^2 + 2 j zeta w_n w) + C + j D: a mode, and a constant for those outside
    the band.

    Parameters: f_n [Hz], zeta [1], the modal constant A [1/kg] = psi_o psi_i / m with its sign, B [1/kg] its
    part in quadrature, C and D [m/N]. A delay or a gain that changes evenly with frequency turns the residue
    and leaves a constant: w_n and zeta stay what they are. Equation (est-transfer-mode).
    """

    name: str = "sdof"
    names: tuple[str, ...] = (
        *("f_n", "zeta", "modal_constant", "modal_constant_quadrature", "residual_re", "residual_im"),
    )
    units: tuple[str, ...] = ("Hz", "1", "1/kg", "1/kg", "m/N", "m/N")
    # The parameters have no matrices.
    terms: tuple[Term, ...] = ()

    def start_of(self, values: FloatArray) -> FloatArray:
        """From start values (6,) of a mode with a residue of any phase [parameter units]."""
        return values

    def whole(self, parameters: FloatArray) -> Matrices:
        """Those of an oscillator of 1 kg with the mode's frequency and damping; *parameters* (6,) [SI]."""
        w_n, zeta = 2 * np.pi * parameters[0], parameters[1]
        unit = np.ones((1, 1))
        return Matrices(w_n**2 * unit, 2 * zeta * w_n * unit, unit, parameters[2] * unit)

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H [m/N] at *parameters* (6,) [parameter units], (n_line, 1, 1); *omega* (n_line,) [rad/s]."""
        numerator, constant = complex(*parameters[2:4]), complex(*parameters[4:])
        return (numerator / _denominator(parameters, omega) + constant)[:, None, None]

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp, (6, n_line, 1, 1) [m/N per parameter unit]."""
        w_n, zeta = 2 * np.pi * parameters[0], parameters[1]
        below = 1 / _denominator(parameters, omega)
        slope = -complex(*parameters[2:4]) * below**2
        unit = np.ones(omega.size, np.complex128)
        of_mode = [slope * 2 * np.pi * (2 * w_n + 2j * zeta * omega), slope * 2j * w_n * omega]
        return np.array([*of_mode, below, 1j * below, unit, 1j * unit])[:, :, None, None]


@dataclass(frozen=True)
class DrivingMode(TransferMode):
    """H(w) = 1 / (k + j w c - w^2 m) + C + j D at a driving point: a mode, and a constant for those outside
    the band. Parameters: k [N/m], c [N.s/m], m [kg] of the mode, C and D [m/N]. Equation (est-driving-mode).
    """

    names: tuple[str, ...] = ("k", "c", "m", "residual_re", "residual_im")
    units: tuple[str, ...] = ("N/m", "N.s/m", "kg", "m/N", "m/N")

    def start_of(self, values: FloatArray) -> FloatArray:
        """From start values (6,) of a mode whose residue has the size 1 / m: (5,) [parameter units]."""
        w_n, mass = 2 * np.pi * values[0], 1 / max(float(np.hypot(*values[2:4])), np.finfo(float).tiny)
        return np.array([w_n**2 * mass, 2 * abs(values[1]) * w_n * mass, mass, *values[4:]])

    def whole(self, parameters: FloatArray) -> Matrices:
        """Matrices (1, 1) of the mode at *parameters* (5,) [parameter units]."""
        k, c, m = (value * np.ones((1, 1)) for value in parameters[:3])
        return Matrices(k, c, m, np.ones((1, 1)))

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H [m/N] at *parameters* (5,) [parameter units], (n_line, 1, 1); *omega* (n_line,) [rad/s]."""
        k, c, m = parameters[:3]
        mode = 1 / (k + 1j * omega * c - omega**2 * m)
        return (mode + complex(*parameters[3:]))[:, None, None]

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp, (5, n_line, 1, 1) [m/N per parameter unit]."""
        square = (self.receptance(np.array([*parameters[:3], 0, 0]), omega)[:, 0, 0]) ** 2
        unit = np.ones(omega.size, np.complex128)
        rows = [-square, -1j * omega * square, omega**2 * square, unit, 1j * unit]
        return np.array(rows)[:, :, None, None]


def _denominator(parameters: FloatArray, omega: FloatArray) -> ComplexArray:
    w_n, zeta = 2 * np.pi * parameters[0], parameters[1]
    return w_n**2 - omega**2 + 2j * zeta * w_n * omega


def is_transfer(output: Port, force: Port) -> bool:
    """True where force and response are at different points, or across each other at one: by their dofs.

    A dof that is no more than the name of a channel ("acc", "f") is no point, but with a number. Where one of
    the two is a point without a direction, the other is elsewhere, or its dof would say so.
    """
    if not output.dof or not force.dof or output.dof == force.dof:
        return False
    angles = angle_of(output), angle_of(force)
    if output.place and force.place and output.place != force.place:
        return True
    if not (_is_place(output) and _is_place(force)):
        return angles == (None, None) and (_is_place(output) or _is_place(force))
    if angles[0] is not None and angles[1] is not None:
        return bool(abs(np.cos(angles[0] - angles[1])) < ACROSS)
    return angles[0] is None and angles[1] is None


def _is_place(port: Port) -> bool:
    is_named = port.dof not in (port.label, port.channel) or any(letter.isdigit() for letter in port.dof)
    return bool(port.dof) and (angle_of(port) is not None or is_named)


def place_notes(setup: Setup) -> tuple[str, ...]:
    """As what a single FRF between two dofs of different names is taken."""
    if setup.shape != (1, 1) or not setup.settings.kind.one_frf:
        return ()
    output, force = setup.outputs[0], setup.inputs[0]
    if output.dof == force.dof or not (output.dof and force.dof):
        return ()
    taken = "a transfer FRF" if transfer_of(setup) else "a driving point"
    return (
        f"{setup.settings.model}: the response at dof '{output.dof}' to the force at dof '{force.dof}' is "
        f"taken as {taken}; `dof` in the rig file, or in the entry under frfs:, says where both are.",
    )


def transfer_of(setup: Setup) -> bool:
    """True where a setup is of a single transfer FRF."""
    return setup.shape == (1, 1) and is_transfer(setup.outputs[0], setup.inputs[0])


def transfer_start(measured: Measured) -> FloatArray:
    """Start values (6,) [parameter units]: least squares of (k + j w c) H - (A + j B) - (C + j D) (k - w^2 +
    j w c) = w^2 H.

    Equations are divided by the denominator of the last pass (Sanathanan and Koerner 1963). From the largest
    line where no pass gives an oscillation; FitError for fewer lines than determine them.
    """
    h, w = measured.matrix[:, 0, 0], measured.omega
    if h.size < 5:
        raise FitError(f"{h.size} lines cannot determine a mode and its residual term", hint="widen the band")
    weight = unit = np.ones(h.size, np.complex128)
    start = None
    for _ in range(REWEIGHTINGS):
        # C + j D times the denominator is a polynomial: its terms in w^2 and w are columns of their own.
        columns = [h, 1j * w * h, -unit, -1j * unit, w**2 * unit, 1j * w**2, w * unit, 1j * w]
        rows = stack(np.array([column * weight for column in columns])).T
        solved = solve_scaled(rows, stack(weight * w**2 * h))[0]
        below = solved[0] - w**2 + 1j * w * solved[1]
        if solved[0] > 0:
            start = solved[:2]
        weight = 1 / below
    if start is None:
        peak = float(w[np.argmax(np.abs(h))])
        start = np.array([peak**2, 2 * LIGHT * peak])
    return _with_amounts(measured, start)


def peak_starts(measured: Measured) -> list[FloatArray]:
    """Start values (6,) [parameter units] at the largest peaks of |H|, with light and with more damping."""
    size, w = np.abs(measured.matrix[:, 0, 0]), measured.omega
    inner = (size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:])
    peaks = np.flatnonzero(inner) + 1
    largest = peaks[np.argsort(size[peaks])[::-1][:PEAKS]]
    starts = (np.array([w[n] ** 2, 2 * zeta * w[n]]) for n in largest for zeta in DAMPED)
    return [_with_amounts(measured, start) for start in starts]


def _with_amounts(measured: Measured, start: FloatArray) -> FloatArray:
    h, w, unit = measured.matrix[:, 0, 0], measured.omega, np.ones(measured.omega.size, np.complex128)
    below = start[0] - w**2 + 1j * w * start[1]
    rows = stack(np.array([1 / below, 1j / below, unit, 1j * unit])).T
    amounts = solve_scaled(rows, stack(h))[0]
    w_n = np.sqrt(start[0])
    return np.array([w_n / (2 * np.pi), start[1] / (2 * w_n), *amounts])

"""Damping and frequency of a decay over its amplitude: piece by piece, and as a law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.decay.likelihood import Decayed
from labpipe.decay.pieces import Piece
from labpipe.records.ring_down import OverAmplitude

# Stretches of one decay at most, periods of one at least, and amplitudes over their standard error below which nothing is seen.
MOST_STRETCHES, LEAST_PERIODS, LEAST_RATIO = 16, 3.0, 10.0


@dataclass(frozen=True)
class Stretches:
    """A mode of one decay stretch by stretch: middle (n,) [s], complex amplitudes (n,) that decay, std_error (n,) [unit of the output]."""

    middle: FloatArray
    amplitudes: ComplexArray
    std_error: FloatArray


def stretches(piece: Piece, fitted: Decayed, number: int, mode: int, output: int) -> Stretches:
    """Amplitudes of a mode of the piece of this *number* on stretches of its rows in time, everything else subtracted as fitted.

    Each is a least-squares fit of C e^(lambda t) with the fitted lambda to one stretch: what differs from a constant C is what one
    exponential does not say.
    """
    solved, pole = fitted.pieces[number], fitted.poles[mode]
    n = piece.time.size
    count = int(min(MOST_STRETCHES, n * pole.imag / (2 * np.pi * LEAST_PERIODS) * (piece.time[-1] / n if n > 1 else 0.0)))
    # The residual in time: of a band without what lies outside it.
    left = _in_time(piece, solved.residual[:, output])
    amplitude = solved.amplitudes[mode, output]
    course = np.exp(pole * piece.time)
    parts = [part for part in np.array_split(np.arange(n), max(count, 1)) if part.size > 4]
    variance = float(fitted.variance[number, output])
    middles, values, errors = [], [], []
    for part in parts:
        columns = np.stack([course[part].real, -course[part].imag], axis=1)
        change, _, rank, _ = np.linalg.lstsq(columns, left[part], rcond=None)
        if rank < 2:
            continue
        middle = float(np.mean(piece.time[part]))
        size = abs(np.exp(pole * middle))
        middles.append(middle)
        values.append((amplitude + change[0] + 1j * change[1]) * size)
        errors.append(np.sqrt(variance * np.trace(np.linalg.inv(columns.T @ columns)) / 2) * size)
    return Stretches(np.array(middles), np.array(values), np.array(errors))


def _in_time(piece: Piece, residual: FloatArray) -> FloatArray:
    """Rows (n_row,) of a residual as samples (n_sample,) [unit of the output]."""
    if piece.lines is None:
        return residual
    half = piece.lines.size
    spectrum = np.zeros(piece.time.size // 2 + 1, np.complex128)
    spectrum[piece.lines] = (residual[:half] + 1j * residual[half:]) * np.sqrt(piece.time.size / 2)
    return np.asarray(np.fft.irfft(spectrum, piece.time.size))


def over_amplitude(pieces: Sequence[Piece], fitted: Decayed, mode: int, output: int) -> OverAmplitude:
    """Damping ratio and frequency between neighbouring stretches of all pieces, in ascending amplitude.

    ln(A_1 / A_2) / (w dt) and the turn of the phase between them; first-order standard errors. Equation (decay-stretches).
    """
    pole = fitted.poles[mode]
    omega = abs(pole)
    rows: list[tuple[float, ...]] = []
    for number, piece in enumerate(pieces):
        course = stretches(piece, fitted, number, mode, output)
        size = np.abs(course.amplitudes)
        seen = int(np.argmin(np.append(size > LEAST_RATIO * course.std_error, False)))
        for k in range(seen - 1):
            span = course.middle[k + 1] - course.middle[k]
            spread = float(np.hypot(course.std_error[k] / size[k], course.std_error[k + 1] / size[k + 1]))
            turn = float(np.angle(course.amplitudes[k + 1] / course.amplitudes[k]))
            rows.append(
                (
                    float(np.sqrt(size[k] * size[k + 1])),
                    float(np.log(size[k] / size[k + 1])) / (omega * span),
                    spread / (omega * span),
                    (omega + turn / span) / (2 * np.pi),
                    spread / span / (2 * np.pi),
                )
            )
    table = np.array(sorted(rows)).reshape(-1, 5).T
    return OverAmplitude(*table)

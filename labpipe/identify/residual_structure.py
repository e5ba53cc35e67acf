"""Whether the residual of a fit is noise, where the size of the noise is not known: its structure against that of noise under the same fit.

A residual is what noise becomes after the fit has taken its part, (I - P) n with P the projection on the Jacobian's columns. So noise is
drawn, projected likewise, and the same statistics are computed of the draws: their p-values are exact whatever the band.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.model import ReceptanceModel
from labpipe.identify.output_error import OutputError
from labpipe.identify.weights import NOISE_FREE, equal_weights, has_noise
from labpipe.records.finding import Finding

STRUCTURE_P = 0.01
# Draws of noise: the least p-value of four statistics cannot be below about 4 / draws.
DRAWS, FEWEST_DRAWS = 1999, 599
# Number of complex values in all draws together that is aimed at, and beyond which there is no test.
VALUES, MOST_VALUES = 2_000_000, 20_000_000
LAGS = 8
WIDTHS = (3, 6, 12)
DEGREE = 3
SAID = (
    "it is alike on neighbouring lines",
    "it stays on one side over several lines",
    "it grows with the response",
    "it follows a smooth curve",
)


@dataclass(frozen=True)
class Structure:
    """*p_value*: probability [1] of so much structure in noise, the best of all statistics counted once; *said*: what it looks like."""

    p_value: float
    said: str


def structure_findings(measured: Measured, model: ReceptanceModel, values: FloatArray, n_band: int = 1) -> list[Finding]:
    """A finding where the residual of an unweighted output-error fit is not noise; *values* (n_parameter,) [parameter units].

    p-values are for the best of *n_band* bands (Bonferroni). None where the noise is known, which chi-square judges, or where there is
    none. Noise is taken as independent from line to line: a window whose lines share noise looks like structure, and the message says so.
    """
    if has_noise(measured):
        return []
    problem = OutputError(measured, model, equal_weights(measured))
    try:
        residual, jacobian = problem.residual(values), problem.jacobian(values)
    except FitError:
        return []
    if np.linalg.norm(residual) <= NOISE_FREE * problem.size:
        return []
    structure = residual_structure(residual, jacobian, np.abs(measured.matrix).reshape(measured.omega.size, -1))
    if structure is None or structure.p_value * n_band >= STRUCTURE_P:
        return []
    message = (
        f"the residual is not noise: {structure.said} (p = {structure.p_value:.2g} for noise under the same fit). The model is incomplete "
        "(a mode is missing or leaks in from beside the band, gain or stiffness changed), or the window of an analyser makes neighbouring "
        "lines share their noise. The intervals do not hold; narrow the band, or use a richer model"
    )
    return [Finding("model-mismatch", message)]


def residual_structure(residual: FloatArray, jacobian: FloatArray, size: FloatArray) -> Structure | None:
    """The structure of a residual (n_equation,) [1] of a fit with *jacobian* (n_equation, n_parameter) [1 per parameter unit].

    *size* (n_line, n_element) [m/N]: amplitude of the response. Both parts are ordered as in `output_error`: real parts line by line, then
    imaginary parts. None where the lines are too few for any structure.
    """
    n_line = size.shape[0]
    if n_line <= LAGS + DEGREE + 1:
        return None
    errors = _by_line(residual, n_line)
    levels = np.sqrt(np.mean(np.abs(errors) ** 2, axis=0))
    if np.any(levels == 0):
        return None
    n_draw = int(np.clip(VALUES // errors.size, FEWEST_DRAWS, DRAWS))
    if n_draw * errors.size > MOST_VALUES:
        return None
    basis = np.linalg.qr(jacobian)[0]
    noise = np.random.default_rng(n_line).standard_normal((residual.size, n_draw))
    noise *= np.tile(levels, 2 * n_line)[:, None]
    noise -= basis @ (basis.T @ noise)
    return _least_p(_statistics(errors[:, :, None], size)[0], _statistics(_by_line(noise, n_line), size))


def _by_line(values: FloatArray, n_line: int) -> ComplexArray:
    """Real parts, then imaginary parts, (n_equation, ...) as complex (n_line, n_element, ...)."""
    half = values.shape[0] // 2
    return np.asarray((values[:half] + 1j * values[half:]).reshape(n_line, -1, *values.shape[1:]))


def _statistics(residual: ComplexArray, size: FloatArray) -> FloatArray:
    """Four statistics (n_draw, 4) of residuals (n_line, n_element, n_draw) that structure makes large, whatever their size."""
    scaled = residual / np.sqrt(np.mean(np.abs(residual) ** 2, axis=0))
    lags = [np.abs(np.sum(scaled[d:] * scaled[:-d].conj(), axis=0)) ** 2 for d in range(1, LAGS + 1)]
    sums = np.cumsum(np.concatenate([np.zeros_like(scaled[:1]), scaled]), axis=0)
    moving = [np.max(np.abs(sums[width:] - sums[:-width]) ** 2, axis=(0, 1)) / width for width in WIDTHS]
    weight = (size**2 / np.mean(size**2, axis=0))[:, :, None]
    smooth = np.linalg.qr(np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, scaled.shape[0]), DEGREE))[0]
    energy = np.abs(np.einsum("ln,led->ned", smooth, scaled)) ** 2
    statistics = [np.sum(lags, axis=(0, 1)), np.max(moving, axis=0), np.sum(np.abs(scaled) ** 2 * weight, axis=(0, 1))]
    return np.stack([*statistics, np.sum(energy, axis=(0, 1))], axis=-1)


def _least_p(observed: FloatArray, draws: FloatArray) -> Structure:
    """The least p-value of the statistics *observed* (4,), against the least ones of the draws (n_draw, 4)."""
    n_draw = draws.shape[0]
    p_values = (1 + np.sum(draws >= observed, axis=0)) / (n_draw + 1)
    ranks = n_draw - np.argsort(np.argsort(draws, axis=0), axis=0)
    least = np.min(ranks / (n_draw + 1), axis=1)
    best = int(np.argmin(p_values))
    return Structure(float((1 + np.sum(least <= p_values[best])) / (n_draw + 1)), SAID[best])

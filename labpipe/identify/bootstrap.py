"""Bootstrap: the fit repeated on the fitted FRF plus random noise of the measured covariance."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.weights import has_noise, whitener
from labpipe.records.identification import Parameter

FEWEST_REPEATS = 50
# Largest share of failed refits: above it the intervals would be biased towards the successful ones.
MOST_FAILED = 0.05

Refit = Callable[[Measured], tuple[Parameter, ...]]


def bootstrapped(
    parameters: tuple[Parameter, ...], measured: Measured, fitted: ComplexArray, refit: Refit, repeats: int, name: str
) -> tuple[tuple[Parameter, ...], str]:
    """Parameters with standard errors and 95 % intervals from the scatter of *repeats* refits, and a note.

    *fitted* (n_line, n_output, n_input) [m/N]. The seed follows from the fit's *name*, so that a run is reproducible. FitError for an
    unknown noise, too few repeats, or failed refits.
    """
    if repeats < FEWEST_REPEATS:
        raise FitError(f"bootstrap: {repeats} repeats give no 95 % interval", hint=f"at least {FEWEST_REPEATS}, 200 is usual")
    if not has_noise(measured):
        raise FitError("bootstrap needs the noise of the FRF, which is not known", hint="leave `bootstrap` out")
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    refits = [values for _ in range(repeats) if (values := _refitted(refit, redrawn(measured, fitted, rng)))]
    if len(refits) < (1 - MOST_FAILED) * repeats:
        raise FitError(f"bootstrap: {repeats - len(refits)} of {repeats} refits failed", hint="widen the band")
    note = f"Standard errors and intervals come from {len(refits)} refits on noise drawn from the FRF's covariance (bootstrap)."
    scatter = {parameter.name: [values[parameter.name] for values in refits if parameter.name in values] for parameter in parameters}
    scattered = [_with_scatter(parameter, scatter[parameter.name]) for parameter in parameters]
    return tuple(scattered), note


def redrawn(measured: Measured, fitted: ComplexArray, rng: np.random.Generator) -> Measured:
    """*fitted* (n_line, n_output, n_input) [m/N] with circular noise of the measured covariance. Equation (est-bootstrap)."""
    assert measured.covariance is not None
    n = measured.covariance.shape[1]
    values, vectors = np.linalg.eigh(measured.covariance)
    if measured.noise is not None:
        noise = np.linalg.solve(whitener(measured), measured.noise.drawn(rng, n)[:, :, None])[:, :, 0]
        return replace(measured, matrix=fitted + noise.reshape(fitted.shape))
    # The refits' lines are independent: stronger noise gives the scatter of lines that share noise.
    white = rng.standard_normal((2, values.shape[0], n)) * np.sqrt(measured.shared_noise * np.maximum(values, 0.0) / 2)
    noise = np.einsum("lab,lb->la", vectors, white[0] + 1j * white[1])
    return replace(measured, matrix=fitted + noise.reshape(fitted.shape))


def _refitted(refit: Refit, measured: Measured) -> dict[str, float]:
    """Parameter values by name; empty where the refit fails."""
    try:
        return {parameter.name: parameter.value for parameter in refit(measured)}
    except FitError:
        return {}


def _with_scatter(parameter: Parameter, values: list[float]) -> Parameter:
    if parameter.std_error is None or len(values) < FEWEST_REPEATS * (1 - MOST_FAILED):
        return parameter
    low, high = np.percentile(values, [2.5, 97.5])
    error = float(np.std(values, ddof=1))
    t_ratio = None if parameter.t_ratio is None else parameter.value / error
    significant = None if parameter.significant is None else bool(low > 0 or high < 0)
    return replace(parameter, std_error=error, ci95=(float(low), float(high)), t_ratio=t_ratio, significant=significant)

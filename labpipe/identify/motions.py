"""Independent motions of the responses: singular values of the FRF against those of its noise."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.identify.measured import Measured
from labpipe.identify.weights import has_noise

# Least ratio of a motion's singular value to the largest one of noise alone.
STANDS_OUT = 1.5


def independent_motions(measured: Measured) -> tuple[FloatArray, int]:
    """Singular values (n_output,) [1] of the FRF in units of its noise, and the number of them above the noise.

    The matrix has outputs as columns, lines and forces as rows. Circular noise of variance 1 has singular values up to sqrt(n_row) +
    sqrt(n_column) (Geman 1980). Only the variance of each output is used, not their covariance: a common factor of the outputs is a
    motion, whatever its noise. Equation (est-motions).
    """
    n_line, n_output, n_input = measured.matrix.shape
    assert measured.covariance is not None
    noise = np.sqrt(np.mean(np.einsum("lii->li", measured.covariance).real.reshape(n_line, n_output, n_input), axis=(0, 2)))
    rows = (measured.matrix / noise[None, :, None]).transpose(0, 2, 1).reshape(-1, n_output)
    values = np.linalg.svd(rows, compute_uv=False)
    limit = np.sqrt(rows.shape[0]) + np.sqrt(rows.shape[1])
    return values, int(np.sum(values > STANDS_OUT * limit))


def motion_notes(measured: Measured) -> tuple[str, ...]:
    """A note where fewer independent motions than outputs are above the noise."""
    if len(measured.outputs) < 2 or not has_noise(measured):
        return ()
    values, count = independent_motions(measured)
    if count >= values.size:
        return ()
    value_list = ", ".join(f"{value:.3g}" for value in values)
    moving = "one independent motion" if count == 1 else f"{count} independent motions"
    return (f"The {values.size} responses hold {moving}: singular values of the FRF in units of its noise {value_list}.",)

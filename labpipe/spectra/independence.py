"""Independence of forces and of outputs: condition numbers, and errors where an FRF matrix cannot be formed."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.spectra.ports import Layout

# Largest condition number of the force matrix at which its inverse is used.
WORST_FORCE_CONDITION = 1e3


def condition_number(correlation: ComplexArray) -> FloatArray:
    """Largest over smallest eigenvalue [1], (n_frequency,), of Hermitian matrices (n_frequency, n, n) with ones on the diagonal."""
    if correlation.shape[1] == 2:
        # Two channels, the usual case: the eigenvalues are 1 +- |c|.
        c = np.minimum(np.abs(correlation[:, 0, 1]), 1.0)
        smallest, largest = 1 - c, 1 + c
    else:
        values = np.linalg.eigvalsh(correlation)
        smallest, largest = np.maximum(values[:, 0], 0.0), values[:, -1]
    return np.divide(largest, smallest, out=np.full(smallest.shape, np.inf), where=smallest > 0)


def _worst_condition(correlation: ComplexArray) -> float:
    """The largest condition number [1] of matrices as in condition_number, or a bound of it that is far below what matters.

    Between a determinant d and the smallest of n eigenvalues of mean 1 stands d <= smallest (n / (n - 1))^(n - 1), and the largest is below
    n: eigenvalues cost ten times a determinant, and are needed only where that bound is large.
    """
    n = correlation.shape[1]
    if n > 2:
        smallest = np.linalg.det(correlation).real * ((n - 1) / n) ** (n - 1)
        correlation = correlation[n > smallest * WORST_FORCE_CONDITION]
    return float(np.max(condition_number(correlation), initial=1.0))


def force_inverse(forces: ComplexArray, layout: Layout) -> ComplexArray:
    """Pseudo-inverse [1/N] of the forces (n_line, n_input, n_experiment), (n_line, n_experiment, n_input).

    DataError when the forces do not span every input at every line.
    """
    n_input, n_experiment = forces.shape[1:]
    names = ", ".join(port.label for port in layout.inputs)
    if n_experiment < n_input:
        hint = f"{n_input} forces ({names}) need {n_input} recordings with independent forces"
        raise DataError(f"{n_experiment} recording(s) cannot separate {n_input} forces", hint=hint)
    size = np.max(np.abs(forces), axis=(0, 2))
    singular = np.linalg.svd(forces / size[:, None], compute_uv=False)
    if np.any(singular[:, -1] * WORST_FORCE_CONDITION < singular[:, 0]):
        raise DataError(f"the forces {names} do not act in independent directions", hint="excite each direction in its own recording")
    return np.linalg.pinv(forces / size[:, None]) / size[None, None, :]


def check_forces(s_uu: ComplexArray, layout: Layout) -> None:
    """DataError unless the forces with spectra (n_frequency, n_input, n_input) [N^2/Hz] are independent at every line."""
    scale = np.sqrt(np.einsum("fii->fi", s_uu).real)
    if np.any(scale == 0):
        raise DataError("a force has no power at a line of the band", hint="narrow `band` to what is excited")
    if _worst_condition(s_uu / (scale[:, :, None] * scale[:, None, :])) > WORST_FORCE_CONDITION**2:
        names = ", ".join(port.label for port in layout.inputs)
        raise DataError(f"the forces {names} do not act independently", hint="excite each direction in its own recording")


def check_responses(s_yy: ComplexArray, layout: Layout, estimator: str) -> None:
    """DataError unless *estimator* can use the outputs with spectra (n_frequency, n_output, n_output) [unit^2/Hz].

    No output may be silent; for H2 the outputs must also be independent, since their cross-spectra are inverted.
    """
    power = np.einsum("foo->fo", s_yy).real
    silent = [port.label for port, values in zip(layout.outputs, power.T, strict=True) if np.any(values == 0)]
    if silent:
        hint = "is the sensor connected? H1 does not need it"
        raise DataError(f"{estimator} needs responses at every line; silent: {', '.join(silent)}", hint=hint)
    scale = np.sqrt(power)
    condition = condition_number(s_yy / (scale[:, :, None] * scale[:, None, :]))
    if estimator == "H2" and np.any(condition > WORST_FORCE_CONDITION**2):
        raise DataError("the responses do not move independently, so H2 cannot be formed", hint="use H1 or Hv")

"""Objectives of a wear identification: weighted complex residuals or log amplitudes, with the prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.identify.weights import equal_weights, has_noise, weight_doubt, whitened, whitener
from labpipe.wear.measured import WornReceptance
from labpipe.wear.model import WornModel

# From (modelled terms, their slopes) to (residual, its slopes), both as real columns.
Compared = Callable[[ComplexArray, ComplexArray], tuple[FloatArray, FloatArray]]


@dataclass
class Misfit:
    """Residual (n_equation,) [1] and its Jacobian at scaled parameters; unit variance for a right model once *size* is known.

    The last point is cached, because optimisers ask for residual and Jacobian one after the other. size: standard deviation of the
    residual as `compared` gives it; 1 where the noise of the FRF is known. The prior's rows stand last.
    """

    model: WornModel
    receptance: WornReceptance
    _: KW_ONLY
    compared: Compared
    weighted: bool
    size: float = 1.0
    excess: float = 1.0
    evaluations: int = 0
    _last: tuple[bytes, FloatArray, FloatArray] | None = field(default=None, repr=False)

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Weighted residual (n_equation,) [1] at scaled parameters (n,), the prior's rows last."""
        return self._at(parameters)[0]

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """Derivatives of the residual by the scaled parameters, (n_equation, n) [1]."""
        return self._at(parameters)[1]

    def chi2(self, parameters: FloatArray) -> float:
        """Sum of squares [1] at scaled parameters (n,), the prior's rows included."""
        residual = self.residual(parameters)
        return float(residual @ residual)

    @property
    def n_prior(self) -> int:
        """Number of the prior's rows."""
        return len(self.model.prior.names)

    def sized(self, size: float) -> Misfit:
        """The misfit in units of another standard deviation."""
        return replace(self, size=size, _last=None)

    def _at(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = np.asarray(parameters, float).tobytes()
        if self._last is None or self._last[0] != key:
            self.evaluations += 1
            response, slopes = self.model.response(parameters)
            residual, jacobian = self.compared(self.receptance.terms(response), self.receptance.terms(slopes))
            rows, mean = _prior_rows(self.model)
            joined = np.concatenate([residual / self.size, rows @ parameters - mean])
            self._last = (key, joined, np.concatenate([jacobian / self.size, rows]))
        return self._last[1], self._last[2]


def _prior_rows(model: WornModel) -> tuple[FloatArray, FloatArray]:
    """R and r of the prior's rows R p - r, of unit variance."""
    prior = model.prior
    if not prior.names:
        return np.zeros((0, len(model.names))), np.zeros(0)
    root = np.linalg.inv(np.linalg.cholesky(np.array(prior.covariance)))
    rows = np.zeros((len(prior.names), len(model.names)))
    first = len(model.names) - len(prior.names)
    rows[:, first:] = root * model.scale[first:]
    return rows, root @ np.array(prior.mean)


def complex_misfit(model: WornModel, measured: WornReceptance) -> Misfit:
    """e^H C^-1 e over the lines, e the complex residual of all terms and C its covariance; equal weights where no noise is known.

    A covariance estimated from few averages inflates the residual: it is scaled back so that its weight beside the prior is right.
    Equation (wear-complex).
    """
    chosen = measured.chosen
    weighted = has_noise(chosen)
    weights = whitener(chosen) if weighted else equal_weights(chosen)
    doubt = weight_doubt(measured.measured, max(chosen.n_equation - len(model.names), 1)) if weighted else None

    def compared(response: ComplexArray, slopes: ComplexArray) -> tuple[FloatArray, FloatArray]:
        return whitened(weights, response - chosen.matrix), whitened(weights, slopes).T

    size, excess = (1.0, 1.0) if doubt is None else (float(np.sqrt(doubt.inflation)), doubt.excess / doubt.inflation)
    return Misfit(model, measured, compared=compared, weighted=weighted, size=size, excess=excess)


def log_misfit(model: WornModel, measured: WornReceptance) -> Misfit:
    """log10(|H_model| / |H_measured|) of every line and term, all alike (Mendes et al. 2017); phases do not enter. Equation (wear-log)."""
    matrix = measured.chosen.matrix

    def compared(response: ComplexArray, slopes: ComplexArray) -> tuple[FloatArray, FloatArray]:
        residual = np.log10(np.abs(response) / np.abs(matrix)).reshape(-1)
        return residual, ((slopes / response).real / np.log(10)).reshape(slopes.shape[0], -1).T

    return Misfit(model, measured, compared=compared, weighted=False)


MISFITS: dict[str, Callable[[WornModel, WornReceptance], Misfit]] = {"complex": complex_misfit, "log": log_misfit}

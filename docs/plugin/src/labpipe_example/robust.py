"""robust: ml in which lines far from the model weigh less, so that a few disturbed lines do not pull the
coefficients.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.errors import FitError
from labpipe.estimation.likelihood import maximum_likelihood
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import ResponseModel
from labpipe.estimation.statistics import Estimate

# Misfit of a line, in standard deviations of its noise, from which it weighs less (Huber); and how often the
# weights are renewed.
LIMIT, ROUNDS = 2.5, 5


def robust(measured: Measured, model: ResponseModel, weight: str = "noise") -> Estimate:
    """The ml estimate with Huber's weights: a line at m > LIMIT standard deviations has its covariance
    multiplied by m / LIMIT.
    """
    if measured.covariance is None:
        raise FitError("robust needs the noise of the FRF", hint="measure more periods, or use ls")
    sigma = np.sqrt(np.einsum("lii->li", measured.covariance).real).reshape(measured.matrix.shape)
    weighted, lowered = measured, 0
    for _ in range(ROUNDS):
        estimate = maximum_likelihood(weighted, model, weight)
        misfit = np.max(
            np.abs(measured.matrix - model.receptance(estimate.values, measured.omega)) / sigma, axis=(1, 2)
        )
        factor = np.maximum(misfit / LIMIT, 1.0)
        lowered = int(np.sum(factor > 1))
        weighted = replace(measured, covariance=measured.covariance * factor[:, None, None])
    return replace(estimate, notes=(*estimate.notes, f"robust: {lowered} of {misfit.size} lines weigh less."))

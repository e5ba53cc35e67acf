"""Whether there is any wear at all: the probability of a healthy bearing beside one with some wear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.integrate import trapezoid

from labpipe.identify.worn_misfit import Misfit
from labpipe.identify.worn_profile import profile_distance
from labpipe.identify.worn_search import Minimum, descend, refined

# Beyond this increase of chi-square the sum below is that of a narrow peak, and the healthy bearing has lost.
NARROW = 40.0
N_DEPTH, N_ANGLE = 13, 7


def healthy_minimum(misfit: Misfit, best: Minimum) -> tuple[Misfit, Minimum]:
    """The least misfit without wear, refined on the films; no start finds it, because depth has no slope there."""
    nuisances = range(2, len(misfit.model.names))
    healthy = descend(misfit, np.array([0.0, 0.0, *best.parameters[2:]]), nuisances)
    own, healthy = refined(misfit, healthy, nuisances)
    return own, replace(healthy, starts=0)


def healthy_probability(misfit: Misfit, best: Minimum, healthy_chi2: float) -> float:
    """P(no wear | response), even odds before, and wear evenly likely over the whole range of depth and angle.

    1 / (1 + B), B the mean over that range of exp(-(chi2(depth, angle) - chi2(0)) / 2), the other parameters estimated again at every
    point (their spread is the same with and without wear, so it cancels).
    """
    gain = healthy_chi2 - best.chi2
    share = _peak_share(misfit, best) if gain > NARROW else _mean_likelihood(misfit, best)
    return float(np.exp(-gain / 2) / (np.exp(-gain / 2) + share))


def _peak_share(misfit: Misfit, best: Minimum) -> float:
    """Mean over the range of exp(-(chi2 - chi2_min) / 2) for one narrow peak: 2 pi sqrt(det cov) over the area."""
    jacobian = misfit.jacobian(best.parameters)
    covariance = np.linalg.pinv(jacobian.T @ jacobian)[:2, :2]
    area = float(np.prod(misfit.model.high[:2] - misfit.model.low[:2]))
    return min(float(2 * np.pi * np.sqrt(max(np.linalg.det(covariance), 1e-12))) / area, 1.0)


def _mean_likelihood(misfit: Misfit, best: Minimum) -> float:
    """The same mean on a mesh that is dense at small depths, where alone a wear is this hard to see."""
    low, high = misfit.model.low[:2], misfit.model.high[:2]
    depths = high[0] * np.linspace(0, 1, N_DEPTH) ** 3
    angles = np.linspace(low[1], high[1], N_ANGLE)
    likelihood = np.zeros((N_DEPTH, N_ANGLE))
    for row, depth in enumerate(depths):
        for column, angle in enumerate(angles):
            far = profile_distance(misfit, best, {0: float(depth), 1: float(angle)})
            likelihood[row, column] = np.exp(-(far**2) / 2)
        if row > 1 and likelihood[row].max() < 1e-6:
            break
    along_angle = trapezoid(likelihood, angles, axis=1)
    return float(trapezoid(along_angle, depths)) / float(np.prod(high - low))

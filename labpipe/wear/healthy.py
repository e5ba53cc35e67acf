"""Probability of a healthy bearing against one with wear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.integrate import trapezoid

from labpipe.arrays import FloatArray
from labpipe.wear.misfit import Misfit
from labpipe.wear.profile import profile_distance
from labpipe.wear.search import Minimum, descend, refined

# Increase of chi-square beyond which the integral over wear is that of one narrow peak.
NARROW = 20.0
# The same beyond which nothing that refining could change brings the probability of no wear back from zero.
HOPELESS = 6000.0
N_DEPTH, N_ANGLE = 13, 5
# Mesh around the best wear, in standard errors.
AROUND = np.linspace(-3.0, 3.0, 7)
# Least information on a parameter without sensitivity, as the angle at zero depth: a standard error of 10,000 scaled units.
LEAST_INFORMATION = 1e-8


def healthy_minimum(misfit: Misfit, best: Minimum) -> tuple[Misfit, Minimum]:
    """Minimum at zero depth, refined on the films; no start leads there, because the slope by depth is zero."""
    nuisances = range(2, len(misfit.model.names))
    healthy = descend(misfit, np.array([0.0, 0.0, *best.parameters[2:]]), nuisances)
    refined_misfit, healthy = refined(misfit, healthy, nuisances, best.chi2 + HOPELESS)
    return refined_misfit, replace(healthy, starts=0)


def healthy_probability(misfit: Misfit, best: Minimum, healthy_chi2: float) -> float:
    """P(no wear | response), even odds before, and wear evenly likely over the whole range of depth and angle.

    1 / (1 + B), B the mean over that range of exp(-(chi2(depth, angle) - chi2(0)) / 2), the other parameters estimated again at every
    point (their spread is the same with and without wear, so it cancels). Equation (wear-healthy).
    """
    gain = healthy_chi2 - best.chi2
    share = _peak_share(misfit, best) if gain > NARROW else _mean_likelihood(misfit, best)
    return float(np.exp(-gain / 2) / (np.exp(-gain / 2) + share))


def _peak_share(misfit: Misfit, best: Minimum) -> float:
    """Mean over the range of exp(-(chi2 - chi2_min) / 2) for one narrow peak: 2 pi sqrt(det cov) over the area."""
    area = float(np.prod(misfit.model.high[:2] - misfit.model.low[:2]))
    return min(float(2 * np.pi * np.sqrt(max(np.linalg.det(_spread(misfit, best)), 1e-12))) / area, 1.0)


def _spread(misfit: Misfit, best: Minimum) -> FloatArray:
    """Covariance of depth and angle (2, 2), scaled."""
    jacobian = misfit.jacobian(best.parameters)
    spread: FloatArray = np.linalg.inv(jacobian.T @ jacobian + LEAST_INFORMATION * np.eye(jacobian.shape[1]))[:2, :2]
    return spread


def _mean_likelihood(misfit: Misfit, best: Minimum) -> float:
    """Mean over the range of exp(-(chi2 - chi2_min) / 2) on a mesh that is dense at small depths and around the best wear."""
    low, high = misfit.model.low[:2], misfit.model.high[:2]
    widths = np.minimum(np.sqrt(np.diag(_spread(misfit, best))), (high - low) / 8)
    places = [best.parameters[number] + widths[number] * AROUND for number in (0, 1)]
    depths = _mesh(high[0] * np.linspace(0, 1, N_DEPTH) ** 3, places[0], low[0], high[0])
    angles = _mesh(np.linspace(low[1], high[1], N_ANGLE), places[1], low[1], high[1])
    along_angle = np.zeros(depths.size)
    for row, depth in enumerate(depths):
        distances = [profile_distance(misfit, best, {0: float(depth), 1: float(angle)}) for angle in angles]
        along_angle[row] = trapezoid(np.exp(-np.square(distances) / 2), angles)
        if depth > best.parameters[0] and along_angle[row] < 1e-6 * along_angle.max():
            break
    return float(trapezoid(along_angle, depths)) / float(np.prod(high - low))


def _mesh(ticks: FloatArray, around: FloatArray, low: float, high: float) -> FloatArray:
    """Union of both, rising, within the range."""
    both = np.concatenate([ticks, around])
    return np.unique(both[(both >= low) & (both <= high)])

"""Wear of a journal bearing: depth of the worn arc about a given angle (Dufrane et al. 1983, rotated by an angle)."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray


def wear_edges(depth: float, angle: float) -> tuple[float, float]:
    """First and last angle of the wear, theta_s, theta_f = 3 pi/2 + angle -+ arccos(1 - depth) [rad], theta_s in [0, 2 pi).

    *depth*: largest wear over radial clearance [-]; *angle* of the deepest point from the bottom, positive with the spin [rad].
    Mendes et al. (2017) eq. 9, there modulo 2 pi. Equation (jour-wear-edges).
    """
    half = float(np.arccos(1 - depth))
    start = float(np.mod(1.5 * np.pi + angle - half, 2 * np.pi))
    return start, start + 2 * half


def worn_depth(theta: FloatArray, depth: float, angle: float) -> FloatArray:
    """Added film thickness max(0, depth - 1 - cos(theta - pi/2 - angle)) over radial clearance [-], same shape as *theta* [rad].

    Equation (jour-wear).
    """
    added: FloatArray = np.maximum(0.0, depth - 1 - np.cos(theta - np.pi / 2 - angle))
    return added


def mean_worn_depth(theta: FloatArray, depth: float, angle: float, width: float) -> FloatArray:
    """`worn_depth` averaged over an arc of *width* [rad] about every *theta* [rad], same shape [-]; exact.

    On a mesh the bare profile, with its kink at both edges, makes results jump as an edge moves from cell to cell; the mean over
    one cell does not, and preserves the worn volume. Equation (jour-wear-mean).
    """
    if depth <= 0:
        return np.zeros_like(theta)
    from_deepest = np.mod(theta - np.pi / 2 - angle, 2 * np.pi) - np.pi
    half = np.arccos(1 - depth)
    first = np.clip(from_deepest - width / 2, -half, half)
    last = np.clip(from_deepest + width / 2, -half, half)
    mean: FloatArray = ((depth - 1) * (last - first) + np.sin(last) - np.sin(first)) / width
    return np.maximum(mean, 0.0)

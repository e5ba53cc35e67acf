"""Gaussian process of every coefficient over load and speed: a plane plus a smooth field.

y (standardised: zero mean, unit deviation) has the covariance p^2 (1 + w w' + s s') + a^2 exp(-((w - w') / l_w)^2 / 2 - ((s - s') /
l_s)^2 / 2), w and s coded to -1 to 1, and noise n^2 (Rasmussen and Williams 2006, sections 2.2, 2.7 and 5.4.1). a, l_w, l_s and n of each
coefficient maximise the marginal likelihood times their log-normal priors (HYPER); p is PLANE.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import linalg, optimize

from labpipe.arrays import FloatArray
from labpipe.run_ups.metamodels_grid import Extent, Grid

PLANE = 3.0
# Medians and standard deviations of the logarithms of a, l_w, l_s and n.
HYPER = ((0.7, 1.0), (1.0, 0.7), (0.7, 0.7), (0.05, 1.5))
SEARCH = {"xatol": 0.02, "fatol": 0.02, "maxfev": 200}
# Added to the diagonal, so that a covariance of close points can be decomposed.
JITTER = 1e-9


@dataclass(frozen=True)
class GaussianProcess:
    """grid: fitted coefficients; hyper (8, 4) [-]: a, l_w, l_s, n of every coefficient; factors, weights: of their covariances."""

    grid: Grid
    extent: Extent
    hyper: FloatArray
    factors: tuple[FloatArray, ...]
    weights: FloatArray

    kind: ClassVar[str] = "process"

    @property
    def speeds(self) -> tuple[float, float]:
        """Range of speeds [rad/s] that it holds for."""
        return self.extent.speeds

    @classmethod
    def of(cls, grid: Grid, hyper: FloatArray) -> GaussianProcess:
        """The process of a grid with given *hyper* (8, 4) [-]: a, l_w, l_s, n of every coefficient."""
        extent = Extent.of(grid)
        coded, scaled = extent.coded(grid.load, grid.speed), _scaled(grid)
        factors = tuple(_factor(coded, row) for row in hyper)
        weights = [linalg.cho_solve((factor, True), column) for factor, column in zip(factors, scaled.T, strict=True)]
        return cls(grid, extent, hyper, factors, np.array(weights))

    @property
    def statement(self) -> str:
        """Statement on lengths and noise of maximum marginal likelihood; medians over the eight coefficients."""
        (first, last), (low, high) = self.extent.loads, self.extent.speeds
        load, speed, noise = np.median(self.hyper[:, 1:], axis=0) * [(last - first) / 2, (high - low) / 2, 1.0]
        return (
            f"a plane and a smooth field, correlated over {load:.2g} N and {speed * 30 / np.pi:.0f} rpm, with a noise of "
            f"{100 * noise:.2g} % of the standard deviation (medians over the eight coefficients)"
        )

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The eight coefficients (n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        places, training = self.extent.coded(load, speed), self.extent.coded(self.grid.load, self.grid.speed)
        scaled = [_covariance(places, training, hyper) @ weights for hyper, weights in zip(self.hyper, self.weights, strict=True)]
        middle, deviation = _scale(self.grid)
        return middle + deviation * np.stack(scaled, axis=-1)

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Standard errors of a new point (n_point, 8) [N/m, N s/m], noise included, at loads [N] and speeds [rad/s]."""
        places, training = self.extent.coded(load, speed), self.extent.coded(self.grid.load, self.grid.speed)
        columns = []
        for hyper, factor in zip(self.hyper, self.factors, strict=True):
            explained = linalg.solve_triangular(factor, _covariance(training, places, hyper), lower=True)
            prior_variance = PLANE**2 * (1 + np.sum(places**2, axis=-1)) + hyper[0] ** 2 + hyper[3] ** 2
            columns.append(np.sqrt(np.maximum(prior_variance - np.sum(explained**2, axis=0), hyper[3] ** 2)))
        return np.asarray(_scale(self.grid)[1] * np.stack(columns, axis=-1))

    def to_entries(self) -> dict[str, Any]:
        arrays = {"load": self.grid.load, "speed": self.grid.speed, "eight": self.grid.eight, "hyper": self.hyper}
        return {"kind": self.kind, **self.extent.to_entries(), **{name: array.tolist() for name, array in arrays.items()}}

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> GaussianProcess:
        load, speed, eight, hyper = (np.array(entries[name], np.float64) for name in ("load", "speed", "eight", "hyper"))
        return cls.of(Grid(load, speed, eight), hyper)


def fit_process(grid: Grid, seed: int = 0) -> GaussianProcess:  # noqa: ARG001 one signature for all kinds
    """Deterministic: a simplex search of the four hyperparameters of each coefficient from the medians of their priors.

    Equation (run-process).
    """
    coded = Extent.of(grid).coded(grid.load, grid.speed)
    return GaussianProcess.of(grid, np.array([_likeliest(coded, column) for column in _scaled(grid).T]))


def _likeliest(coded: FloatArray, scaled: FloatArray) -> FloatArray:
    median, deviation = (np.array(column) for column in zip(*HYPER, strict=True))

    def cost(parts: FloatArray) -> float:
        factor = _factor(coded, median * np.exp(deviation * parts))
        whitened = linalg.solve_triangular(factor, scaled, lower=True)
        return float((whitened @ whitened + parts @ parts) / 2 + np.sum(np.log(np.diag(factor))))

    options: Any = {"initial_simplex": np.concatenate([np.zeros((1, 4)), np.eye(4)]), **SEARCH}
    search = optimize.minimize(cost, np.zeros(4), method="Nelder-Mead", options=options)
    return np.asarray(median * np.exp(deviation * search.x))


def _covariance(first: FloatArray, second: FloatArray, hyper: FloatArray) -> FloatArray:
    difference = (first[:, None, :] - second[None, :, :]) / hyper[1:3]
    return np.asarray(PLANE**2 * (1 + first @ second.T) + hyper[0] ** 2 * np.exp(-0.5 * np.sum(difference**2, axis=-1)))


def _factor(coded: FloatArray, hyper: FloatArray) -> FloatArray:
    return np.linalg.cholesky(_covariance(coded, coded, hyper) + (hyper[3] ** 2 + JITTER) * np.eye(coded.shape[0]))


def _scale(grid: Grid) -> tuple[FloatArray, FloatArray]:
    deviation = grid.eight.std(axis=0)
    return grid.eight.mean(axis=0), np.where(deviation > 0, deviation, 1.0)


def _scaled(grid: Grid) -> FloatArray:
    middle, deviation = _scale(grid)
    return (grid.eight - middle) / deviation

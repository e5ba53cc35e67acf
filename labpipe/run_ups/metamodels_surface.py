"""Second-order response surface of the eight coefficients over load and speed, with its statistics.

    y = b_0 + b_1 w + b_2 s + b_3 w s + b_4 w^2 + b_5 s^2,   w, s: load and speed coded to -1 to 1

by least squares (Falah and Khorshid, equation 13; Myers, Montgomery and Anderson-Cook 2016, chapters 2 and 3). PRESS is the sum of the
squared errors of every point predicted from all others, e_i / (1 - h_ii).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import special

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.run_ups.metamodels_grid import Extent, Grid

TERMS = ("1", "load", "speed", "load x speed", "load^2", "speed^2")


@dataclass(frozen=True, kw_only=True)
class ResponseSurface:
    """beta (6, 8) [N/m, N s/m] of TERMS by coefficient; inverse (6, 6): (X^T X)^-1; spread (8,): residual standard deviation.

    r2, press, total (8,): coefficient of determination, PRESS, sum of squares about the mean; n_point: fitted points.
    """

    extent: Extent
    beta: FloatArray
    inverse: FloatArray
    spread: FloatArray
    r2: FloatArray
    press: FloatArray
    total: FloatArray
    n_point: int

    kind: ClassVar[str] = "surface"

    @property
    def speeds(self) -> tuple[float, float]:
        """Range of speeds [rad/s] that it holds for."""
        return self.extent.speeds

    @property
    def std_errors(self) -> FloatArray:
        """Standard errors of beta (6, 8) [N/m, N s/m]."""
        return np.sqrt(np.diag(self.inverse))[:, None] * self.spread

    @property
    def t(self) -> FloatArray:
        """t ratio of beta (6, 8) [-]."""
        return self.beta / self.std_errors

    @property
    def p(self) -> FloatArray:
        """Probability of a larger |t| (6, 8) [-] if the term were zero."""
        return np.asarray(2 * special.stdtr(self.n_point - len(TERMS), -np.abs(self.t)))

    @property
    def r2_adjusted(self) -> FloatArray:
        """R^2 adjusted for the number of terms (8,) [-]."""
        return 1 - (1 - self.r2) * (self.n_point - 1) / (self.n_point - len(TERMS))

    @property
    def r2_predicted(self) -> FloatArray:
        """1 - PRESS / total (8,) [-]."""
        return 1 - self.press / self.total

    @property
    def statement(self) -> str:
        """Statement on R^2, adjusted and predicted: ranges over the eight coefficients."""
        kinds = {"R²": self.r2, "adjusted R²": self.r2_adjusted, "predicted R² (PRESS)": self.r2_predicted}
        ranges = "; ".join(f"{name} {values.min():.3f} to {values.max():.3f}" for name, values in kinds.items())
        return f"{self.n_point} points, over the eight coefficients {ranges}"

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The eight coefficients (n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        return np.asarray(_terms(self.extent.coded(load, speed)) @ self.beta)

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Standard errors of a new point (n_point, 8) [N/m, N s/m]: of the surface and of points about it."""
        terms = _terms(self.extent.coded(load, speed))
        leverage = np.einsum("ni,ij,nj->n", terms, self.inverse, terms)
        return np.asarray(np.sqrt(1 + leverage)[:, None] * self.spread)

    def to_entries(self) -> dict[str, Any]:
        arrays = {name: getattr(self, name).tolist() for name in ("beta", "inverse", "spread", "r2", "press", "total")}
        return {"kind": self.kind, **self.extent.to_entries(), "terms": list(TERMS), "n_point": self.n_point, **arrays}

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> ResponseSurface:
        arrays = {name: np.array(entries[name], np.float64) for name in ("beta", "inverse", "spread", "r2", "press", "total")}
        return cls(extent=Extent.from_entries(entries), n_point=int(entries["n_point"]), **arrays)


def fit_surface(grid: Grid, seed: int = 0) -> ResponseSurface:  # noqa: ARG001 one signature for all kinds
    """Least-squares fit of the surface; FitError when the grid has fewer than three loads or three speeds. Equation (run-surface)."""
    extent = Extent.of(grid)
    terms = _terms(extent.coded(grid.load, grid.speed))
    n, m = terms.shape
    if n <= m or np.linalg.matrix_rank(terms, tol=1e-8 * np.sqrt(n)) < m:
        raise FitError("a second-order surface needs three loads and three speeds at least", hint="measure more, or use another metamodel")
    inverse = np.linalg.inv(terms.T @ terms)
    beta = inverse @ terms.T @ grid.eight
    residual = grid.eight - terms @ beta
    leverage = np.einsum("ni,ij,nj->n", terms, inverse, terms)
    total = np.sum((grid.eight - grid.eight.mean(axis=0)) ** 2, axis=0)
    squares = np.sum(residual**2, axis=0)
    press = np.sum((residual / (1 - leverage)[:, None]) ** 2, axis=0)
    return ResponseSurface(
        extent=extent,
        beta=beta,
        inverse=inverse,
        spread=np.sqrt(squares / (n - m)),
        r2=1 - squares / total,
        press=press,
        total=total,
        n_point=n,
    )


def _terms(coded: FloatArray) -> FloatArray:
    w, s = coded.T
    return np.stack([np.ones_like(w), w, s, w * s, w**2, s**2], axis=-1)

"""Metamodels that need numpy alone, and the grid of coefficients over load and speed that all are fitted to.

A second-order response surface of every coefficient,

    y = b_0 + b_1 w + b_2 s + b_3 w s + b_4 w^2 + b_5 s^2,   w, s: load and speed coded to -1 to 1

by least squares (Falah and Khorshid, equation 13; Myers, Montgomery and Anderson-Cook 2016, chapters 2 and
3), where PRESS is the sum of the squared errors of every point predicted from all others, e_i / (1 - h_ii);
and the physical fit, the film's family with the parameters of a joint fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError, FitError
from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.run_ups.amplitudes import SpeedwiseFit
from labpipe.methods.run_ups.joint import JointFit, fit_jointly
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.rotor import FilmFamily, RunUpRotor

# Relative difference below which two loads are the same.
SAME_LOAD = 1e-6
TERMS = ("1", "load", "speed", "load x speed", "load^2", "speed^2")
NO_OTHER_LOAD = "there is no other load to fit"
SURFACE_ARRAYS = ("beta", "inverse", "spread", "r2", "press", "total")


class Queried(Protocol):
    """A fit with coefficients (n_speed, 8) and their errors at any load and speed."""

    def coefficients(self, load: float, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n_speed, 8) [N/m, N s/m] each, at a *load* [N] and speeds (n_speed,) [rad/s]."""
        ...


@dataclass(frozen=True)
class Grid:
    """load [N], speed [rad/s] (n_point,), eight (n_point, 8) [N/m, N s/m]; DataError for impossible ones."""

    load: FloatArray
    speed: FloatArray
    eight: FloatArray

    def __post_init__(self) -> None:
        n = np.size(self.load)
        if np.shape(self.load) != np.shape(self.speed) or np.shape(self.eight) != (n, 8) or n == 0:
            raise DataError("a metamodel needs one load, one speed and eight coefficients per point")
        if not (np.all(np.isfinite(self.eight)) and np.all(np.append(self.load, self.speed) > 0)):
            raise DataError("loads and speeds of a metamodel are positive and its coefficients finite")

    @classmethod
    def of(cls, fits: Iterable[SpeedwiseFit]) -> Grid:
        """From one fit per load."""
        return cls._join((fit.load, fit.speed, fit.coefficients) for fit in fits)

    @classmethod
    def sample(cls, fit: Queried, loads: Iterable[float], speed: FloatArray) -> Grid:
        """From a fit at any load, at *loads* [N] and *speed* (n_speed,) [rad/s]."""
        return cls._join((load, speed, fit.coefficients(load, speed)[0]) for load in loads)

    @classmethod
    def _join(cls, parts: Iterable[tuple[float, FloatArray, FloatArray]]) -> Grid:
        columns = [(np.full(speed.size, load), speed, eight) for load, speed, eight in parts]
        return cls(*(np.concatenate(column) for column in zip(*columns, strict=True)))

    @property
    def loads(self) -> tuple[float, ...]:
        rising = np.sort(self.load)
        return tuple(rising[np.append(True, rising[1:] > rising[:-1] * (1 + SAME_LOAD))].tolist())

    def at(self, load: float, others: bool = False) -> Grid:
        """The points of a *load* [N], or all *others*."""
        chosen = (np.abs(self.load / load - 1) > SAME_LOAD) == others
        return Grid(self.load[chosen], self.speed[chosen], self.eight[chosen])


@dataclass(frozen=True)
class Extent:
    """Lowest and highest *loads* [N] and *speeds* [rad/s] of a grid, coded to -1 to 1."""

    loads: tuple[float, float]
    speeds: tuple[float, float]

    @classmethod
    def of(cls, grid: Grid) -> Extent:
        return cls(*((float(np.min(axis)), float(np.max(axis))) for axis in (grid.load, grid.speed)))

    def code(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Coded coordinates (n_point, 2) [-] of loads [N] and speeds [rad/s]."""
        columns = []
        for places, (low, high) in ((load, self.loads), (speed, self.speeds)):
            half = (high - low) / 2 or 1.0
            columns.append((np.asarray(places, np.float64) - (low + high) / 2) / half)
        return np.stack(np.broadcast_arrays(*columns), axis=-1).reshape(-1, 2)

    def to_entries(self) -> dict[str, Any]:
        return {"loads": list(self.loads), "speeds": list(self.speeds)}

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> Extent:
        (first, last), (low, high) = entries["loads"], entries["speeds"]
        return cls((float(first), float(last)), (float(low), float(high)))


class WithinExtent:
    """A metamodel that holds for the speeds of its extent."""

    extent: Extent

    @property
    def speeds(self) -> tuple[float, float]:
        """Range of speeds [rad/s] that it holds for."""
        return self.extent.speeds


@dataclass(frozen=True, kw_only=True)
class ResponseSurface(WithinExtent):
    """beta (6, 8) [N/m, N s/m] of TERMS by coefficient, inverse (6, 6) = (X^T X)^-1, residual *spread* (8,);
    r2, press, total (8,): coefficient of determination, PRESS, sum of squares about the mean of n_point
    points.
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
    def r2_adjusted(self) -> FloatArray:
        """(8,) [-], for the number of terms."""
        return 1 - (1 - self.r2) * (self.n_point - 1) / (self.n_point - len(TERMS))

    @property
    def r2_predicted(self) -> FloatArray:
        """1 - PRESS / total (8,) [-]."""
        return 1 - self.press / self.total

    @property
    def statement(self) -> str:
        kinds = {"R²": self.r2, "adjusted R²": self.r2_adjusted, "predicted R² (PRESS)": self.r2_predicted}
        ranges = "; ".join(f"{name} {r2.min():.3f} to {r2.max():.3f}" for name, r2 in kinds.items())
        return f"{self.n_point} points, over the eight coefficients {ranges}"

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """(n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        return _terms(self.extent.code(load, speed)) @ self.beta

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Of a new point (n_point, 8) [N/m, N s/m]: of the surface and of points about it."""
        terms = _terms(self.extent.code(load, speed))
        leverage = np.einsum("ni,ij,nj->n", terms, self.inverse, terms)
        return np.sqrt(1 + leverage)[:, None] * self.spread

    def to_entries(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            **self.extent.to_entries(),
            "terms": list(TERMS),
            "n_point": self.n_point,
            **{name: getattr(self, name).tolist() for name in SURFACE_ARRAYS},
        }

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> ResponseSurface:
        arrays = {name: np.array(entries[name], np.float64) for name in SURFACE_ARRAYS}
        return cls(extent=Extent.from_entries(entries), n_point=int(entries["n_point"]), **arrays)


def fit_surface(grid: Grid, seed: int = 0) -> ResponseSurface:  # noqa: ARG001 one signature for all kinds
    """By least squares; FitError for fewer than three loads or three speeds. Equation (run-surface)."""
    extent = Extent.of(grid)
    terms = _terms(extent.code(grid.load, grid.speed))
    n, m = terms.shape
    if n <= m or np.linalg.matrix_rank(terms, tol=1e-8 * np.sqrt(n)) < m:
        hint = "measure more, or use another metamodel"
        raise FitError("a second-order surface needs three loads and three speeds at least", hint=hint)
    inverse = np.linalg.inv(terms.T @ terms)
    beta = inverse @ terms.T @ grid.eight
    residual = grid.eight - terms @ beta
    leverage = np.einsum("ni,ij,nj->n", terms, inverse, terms)
    total = np.sum((grid.eight - grid.eight.mean(axis=0)) ** 2, axis=0)
    squares = np.sum(residual**2, axis=0)
    return ResponseSurface(
        extent=extent,
        beta=beta,
        inverse=inverse,
        spread=np.sqrt(squares / (n - m)),
        r2=1 - squares / total,
        press=np.sum((residual / (1 - leverage)[:, None]) ** 2, axis=0),
        total=total,
        n_point=n,
    )


def _terms(coded: FloatArray) -> FloatArray:
    w, s = coded.T
    return np.stack([np.ones_like(w), w, s, w * s, w**2, s**2], axis=-1)


@dataclass(frozen=True)
class PhysicalFit:
    """Logarithms *values* (12,) and *covariance* (12, 12) [-] of a *family*, fitted within an *extent*."""

    extent: Extent
    family: FilmFamily
    values: FloatArray
    covariance: FloatArray
    kind: ClassVar[str] = "physical"

    @property
    def speeds(self) -> tuple[float, float]:
        """Range of speeds [rad/s] that it holds for: all, as far as the film's table goes."""
        return (0.0, float("inf"))

    @classmethod
    def of(cls, fit: JointFit, speeds: tuple[float, float]) -> PhysicalFit:
        """Of a joint fit to run-ups between two *speeds* [rad/s]."""
        extent = Extent((min(fit.loads), max(fit.loads)), speeds)
        return cls(extent, fit.model, fit.values, fit.whole_covariance)

    @property
    def statement(self) -> str:
        return (
            "the film's own coefficients with the parameters of the joint fit, refitted without each "
            "load in turn for the validation"
        )

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """(n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]; FitError outside the film's table."""
        return self.family.coefficients(self.values, load, speed)

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """(n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        places = np.broadcast_arrays(np.asarray(load, np.float64), np.asarray(speed, np.float64))
        _, slopes = self.family.coefficients_and_slopes(self.values, *(np.ravel(place) for place in places))
        return np.sqrt(np.einsum("nij,jk,nik->ni", slopes, self.covariance, slopes))

    def to_entries(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            **self.extent.to_entries(),
            "bearing": asdict(self.family.bearing),
            "reference": [self.family.load, self.family.speed],
            "values": self.values.tolist(),
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> PhysicalFit:
        load, speed = entries["reference"]
        family = FilmFamily(JournalBearing(**entries["bearing"]), float(speed), float(load))
        values, covariance = (np.array(entries[name], np.float64) for name in ("values", "covariance"))
        return cls(Extent.from_entries(entries), family, values, covariance)


def physical_without(
    rig: RunUpRotor, runs: Sequence[RunUp], known: Sequence[str] = ()
) -> Callable[[float], PhysicalFit]:
    """The joint fit of all *runs* but those of a load [N], a function of it; FitError without another."""

    def refit(load: float) -> PhysicalFit:
        training = [run for run in runs if abs(run.load / load - 1) > SAME_LOAD]
        if not training:
            raise FitError(NO_OTHER_LOAD)
        speeds = (min(float(run.speed[0]) for run in training), max(float(run.speed[-1]) for run in training))
        return PhysicalFit.of(fit_jointly(rig, training, known=known), speeds)

    return refit

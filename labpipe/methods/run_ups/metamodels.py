"""Metamodels of the journal coefficients: surrogates of k_xx ... c_yy over load and speed.

METAMODELS are fitted to coefficients on a grid (see `Grid`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.methods.run_ups.film_family import coefficient_errors
from labpipe.methods.run_ups.joint import LOAD_SLACK
from labpipe.methods.run_ups.metamodel_kinds import (
    Extent,
    Grid,
    PhysicalFit,
    ResponseSurface,
    fit_surface,
    physical_without,
)
from labpipe.methods.run_ups.metamodels_learned import GaussianProcess, Network, fit_network, fit_process
from labpipe.registry import nearest

__all__ = [
    "METAMODELS",
    "Extent",
    "GaussianProcess",
    "Grid",
    "LeftOut",
    "Metamodel",
    "Network",
    "PhysicalFit",
    "ResponseSurface",
    "caution",
    "fit_metamodel",
    "from_entries",
    "leave_one_load_out",
    "physical_without",
]

# Fit functions by name, each of a grid and a seed.
METAMODELS: dict[str, Callable[[Grid, int], Metamodel]] = {
    "surface": fit_surface,
    "process": fit_process,
    "network": fit_network,
}
READERS: dict[str, Callable[[Mapping[str, Any]], Metamodel]] = {
    model_class.kind: model_class.from_entries
    for model_class in (ResponseSurface, GaussianProcess, Network, PhysicalFit)
}


class Metamodel(Protocol):
    """Coefficients (n_point, 8) [N/m, N s/m] over load [N] and speed [rad/s]."""

    @property
    def kind(self) -> str: ...
    @property
    def extent(self) -> Extent: ...
    @property
    def speeds(self) -> tuple[float, float]: ...
    @property
    def statement(self) -> str: ...
    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The eight coefficients (n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        ...

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Their standard errors (n_point, 8) [N/m, N s/m]."""
        ...

    def to_entries(self) -> dict[str, Any]: ...


def fit_metamodel(kind: str, grid: Grid, seed: int = 0) -> Metamodel:
    """One of METAMODELS on a grid.

    ConfigError with the nearest name on a miss, or where a package is not installed.
    """
    if kind not in METAMODELS:
        raise ConfigError(f"no metamodel '{kind}'", hint=nearest(kind, METAMODELS))
    return METAMODELS[kind](grid, seed)


def from_entries(entries: Mapping[str, Any]) -> Metamodel:
    """The metamodel of its `to_entries`; DataError where they are not those of one."""
    kind = entries.get("kind") if isinstance(entries, Mapping) else None
    if kind not in READERS:
        raise DataError(
            f"these are not the entries of a metamodel: kind '{kind}'", hint=nearest(str(kind), READERS)
        )
    try:
        model = READERS[kind](entries)
        shape = model.predict(model.extent.loads[0], np.array([model.extent.speeds[0]])).shape
    except (KeyError, TypeError, ValueError, IndexError, np.linalg.LinAlgError) as error:
        raise DataError(
            f"the entries of this {kind} metamodel are damaged: {error}",
            hint="write it again from its run-ups",
        ) from error
    if shape != (1, 8):
        raise DataError(f"this {kind} metamodel does not give eight coefficients")
    return model


def caution(model: Metamodel, load: float) -> str:
    """Warning on a prediction at an extrapolated *load* [N]; empty within the loads of the fit."""
    low, high = model.extent.loads
    if low * (1 - LOAD_SLACK) <= load <= high * (1 + LOAD_SLACK):
        return ""
    scope = (
        "its error is valid under its assumptions only"
        if model.kind in ("physical", "process")
        else "its error does not cover extrapolation"
    )
    return (
        f"{load:.3g} N lies outside the loads of this metamodel ({low:.3g} to {high:.3g} N), an "
        f"extrapolation: {scope}"
    )


@dataclass(frozen=True)
class LeftOut:
    """A metamodel fitted without one *load* [N], compared with the coefficients there: errors (8,) [-], rms
    over the rms coefficient.

    *failed*: reason of a failed fit, then errors are NaN; *beyond*: the load is the lowest or the highest, an
    extrapolation.
    """

    kind: str
    load: float
    errors: FloatArray
    beyond: bool
    failed: str = ""

    @property
    def rms(self) -> float:
        """Over the eight coefficients [-]."""
        return float(np.sqrt(np.mean(self.errors**2)))


def leave_one_load_out(
    grid: Grid,
    kinds: Iterable[str] = tuple(METAMODELS),
    physical: Callable[[float], Metamodel] | None = None,
    seed: int = 0,
) -> list[LeftOut]:
    """Leave-one-load-out validation of every kind, against the grid's coefficients at that load.

    *physical*: the physical fit without a load, see `physical_without`. Where a fit fails, the row states the
    reason.
    """
    rows = []
    for load in grid.loads:
        training = grid.without(load) if len(grid.loads) > 1 else grid
        for kind in kinds:
            rows.append(_validated(kind, grid, load, partial(fit_metamodel, kind, training, seed)))
        if physical is not None:
            rows.append(_validated(PhysicalFit.kind, grid, load, partial(physical, load)))
    return rows


def _validated(kind: str, grid: Grid, load: float, fitted: Callable[[], Metamodel]) -> LeftOut:
    beyond, points = load in (grid.loads[0], grid.loads[-1]), grid.only(load)
    try:
        errors = coefficient_errors(fitted().predict(points.load, points.speed), points.eight)
    except FitError as error:
        return LeftOut(kind, load, np.full(8, np.nan), beyond, error.what)
    return LeftOut(kind, load, errors, beyond)

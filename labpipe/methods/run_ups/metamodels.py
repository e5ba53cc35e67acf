"""Metamodels of the journal coefficients over load and speed by scikit-learn, and all of them by name.

Gaussian process: standardised y has the covariance p^2 (1 + w w' + s s') + a^2 exp(-((w - w') / l_w)^2 / 2 -
((s - s') / l_s)^2 / 2), w and s coded to -1 to 1, and noise n^2 (Rasmussen and Williams 2006, sections 2.2,
2.7 and 5.4.1). a, l_w, l_s and n maximise the marginal likelihood times log-normal priors (HYPER); p is
PLANE.

Network: two inputs, one hidden layer of tanh, eight outputs, trained by L-BFGS with weight decay; the mean
over repeats with different seeds, and their spread, which is the effect of the start weights only.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Protocol

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.methods.run_ups import metamodel_kinds
from labpipe.methods.run_ups.joint import outside
from labpipe.methods.run_ups.measured import column
from labpipe.methods.run_ups.records import LeftOut
from labpipe.methods.run_ups.rotor import TabulatedCoefficients, coefficient_errors
from labpipe.registry import nearest

PLANE = 3.0
# Medians and standard deviations of the logarithms of a, l_w, l_s and n.
HYPER = ((0.7, 1.0), (1.0, 0.7), (0.7, 0.7), (0.05, 1.5))
# Ends of the search, which the priors keep it from.
WIDE = (1e-10, 1e6)
# Added to the diagonal, so that a covariance of close points can be decomposed.
JITTER = 1e-9
HIDDEN = 8
REPEATS = 10
WEIGHT_DECAY = 1e-3
MOST_ITERATIONS = 4000

# Weights and offsets of the hidden and of the output layer: (2, h), (h,), (h, 8), (8,).
Layers = tuple[FloatArray, ...]


def scikit_learn(name: str, what: str) -> Any:
    """A module of scikit-learn; ConfigError that names *what* needs it where it is not installed."""
    try:
        return importlib.import_module(f"sklearn.{name}")
    except ImportError:
        hint = "install labpipe[metamodels], or leave it out of the metamodels"
        raise ConfigError(f"{what} is fitted by scikit-learn, which is not installed", hint=hint) from None


@dataclass(frozen=True)
class GaussianProcess(metamodel_kinds.WithinExtent):
    """hyper (8, 4) [-]: a, l_w, l_s, n of every coefficient of the *grid*, *regressors*: scikit-learn's."""

    grid: metamodel_kinds.Grid
    extent: metamodel_kinds.Extent
    hyper: FloatArray
    regressors: tuple[Any, ...]

    kind: ClassVar[str] = "process"

    @classmethod
    def of(
        cls, grid: metamodel_kinds.Grid, hyper: FloatArray, search: Callable[..., Any] | None = None
    ) -> GaussianProcess:
        """The process of a grid with *hyper* (8, 4) [-], from which a *search* starts."""
        processes = scikit_learn("gaussian_process", "a Gaussian process")
        kernels = processes.kernels
        extent = metamodel_kinds.Extent.of(grid)
        coded, regressors = extent.code(grid.load, grid.speed), []
        for (a, l_w, l_s, n), eight in zip(hyper, grid.eight.T, strict=True):
            plane = kernels.ConstantKernel(PLANE**2, "fixed") * kernels.DotProduct(1.0, "fixed")
            kernel = (
                plane
                + kernels.ConstantKernel(a**2, WIDE) * kernels.RBF((l_w, l_s), WIDE)
                + kernels.WhiteKernel(n**2, WIDE)
            )
            regressor = processes.GaussianProcessRegressor(
                kernel, alpha=JITTER, optimizer=search, normalize_y=True
            )
            regressors.append(regressor.fit(coded, eight))
        scales = np.exp([regressor.kernel_.theta for regressor in regressors])
        # The first and the last of scikit-learn are variances.
        return cls(grid, extent, np.sqrt(scales) ** [1, 2, 2, 1] if search else hyper, tuple(regressors))

    @property
    def statement(self) -> str:
        (first, last), (low, high) = self.extent.loads, self.extent.speeds
        ranges = (last - first) / 2, (high - low) / 2, 1.0
        load, speed, noise = np.median(self.hyper[:, 1:], axis=0) * ranges
        return (
            f"a plane and a smooth field, correlated over {load:.2g} N and {speed * 30 / np.pi:.0f} rpm, "
            f"with a noise of {100 * noise:.2g} % of the standard deviation (medians over the eight "
            "coefficients)"
        )

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """(n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        coded = self.extent.code(load, speed)
        return np.stack([regressor.predict(coded) for regressor in self.regressors], axis=-1)

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Of a new point (n_point, 8) [N/m, N s/m], noise included, at loads [N] and speeds [rad/s]."""
        coded = self.extent.code(load, speed)
        return np.stack([process.predict(coded, return_std=True)[1] for process in self.regressors], axis=-1)

    def to_entries(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            **self.extent.to_entries(),
            "load": self.grid.load.tolist(),
            "speed": self.grid.speed.tolist(),
            "eight": self.grid.eight.tolist(),
            "hyper": self.hyper.tolist(),
        }

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> GaussianProcess:
        load, speed, eight, hyper = (
            np.array(entries[name], np.float64) for name in ("load", "speed", "eight", "hyper")
        )
        return cls.of(metamodel_kinds.Grid(load, speed, eight), hyper)


def fit_process(
    grid: metamodel_kinds.Grid,
    seed: int = 0,  # noqa: ARG001 one signature for all kinds
) -> GaussianProcess:
    """A descent of the hyperparameters from the medians of their priors. Equation (run-process)."""
    return GaussianProcess.of(grid, np.tile([median for median, _ in HYPER], (8, 1)), _likeliest)


def _likeliest(cost: Callable[..., Any], start: FloatArray, bounds: FloatArray) -> tuple[FloatArray, float]:
    # Of ln a^2, l_w, l_s, n^2.
    powers = np.array([2.0, 1.0, 1.0, 2.0])
    medians, deviations = np.array(HYPER).T
    middle, spread = powers * np.log(medians), powers * deviations

    def with_priors(theta: FloatArray) -> tuple[float, FloatArray]:
        value, slope = cost(theta, eval_gradient=True)
        parts = (theta - middle) / spread
        return float(value + parts @ parts / 2), slope + parts / spread

    search: Any = scipy.optimize.minimize(with_priors, start, jac=True, method="L-BFGS-B", bounds=bounds)
    return search.x, search.fun


@dataclass(frozen=True)
class Network(metamodel_kinds.WithinExtent):
    """Layers of all *repeats*, of which n_converged; middle, deviation (8,) [N/m, N s/m] of the outputs."""

    extent: metamodel_kinds.Extent
    repeats: tuple[Layers, ...]
    middle: FloatArray
    deviation: FloatArray
    seed: int
    n_converged: int

    kind: ClassVar[str] = "network"

    @property
    def statement(self) -> str:
        hidden = self.repeats[0][1].size
        ended = "all of them" if self.n_converged == len(self.repeats) else f"{self.n_converged} of them"
        return (
            f"{len(self.repeats)} repeats of 2 inputs, {hidden} hidden units and 8 outputs, seeds from "
            f"{self.seed} on; the training of {ended} converged; errors are the spread of the repeats"
        )

    def repeat_predictions(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """(n_repeat, n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]. Equation (run-network)."""
        coded = self.extent.code(load, speed)
        scaled = [
            np.tanh(coded @ first + offset) @ second + last for first, offset, second, last in self.repeats
        ]
        return self.middle + self.deviation * np.array(scaled)

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The mean of the repeats (n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        return self.repeat_predictions(load, speed).mean(axis=0)

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Deviation of the repeats (n_point, 8) [N/m, N s/m]; NaN of a single one."""
        repeats = self.repeat_predictions(load, speed)
        if len(self.repeats) < 2:
            return np.full(repeats.shape[1:], np.nan)
        return repeats.std(axis=0, ddof=1)

    def to_entries(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            **self.extent.to_entries(),
            "seed": self.seed,
            "n_converged": self.n_converged,
            "middle": self.middle.tolist(),
            "deviation": self.deviation.tolist(),
            "repeats": [[layer.tolist() for layer in layers] for layers in self.repeats],
        }

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> Network:
        repeats = tuple(
            tuple(np.array(layer, np.float64) for layer in layers) for layers in entries["repeats"]
        )
        middle, deviation = (np.array(entries[name], np.float64) for name in ("middle", "deviation"))
        return cls(
            metamodel_kinds.Extent.from_entries(entries),
            repeats,
            middle,
            deviation,
            int(entries["seed"]),
            int(entries["n_converged"]),
        )


def fit_network(
    grid: metamodel_kinds.Grid, seed: int = 0, repeats: int = REPEATS, hidden: int = HIDDEN
) -> Network:
    """Networks with seeds *seed*, *seed* + 1 and so on; ConfigError without scikit-learn."""
    networks, exceptions = (
        scikit_learn(name, "a feed-forward network") for name in ("neural_network", "exceptions")
    )
    extent = metamodel_kinds.Extent.of(grid)
    middle, deviation = grid.eight.mean(axis=0), grid.eight.std(axis=0)
    deviation = np.where(deviation > 0, deviation, 1.0)
    inputs, outputs = extent.code(grid.load, grid.speed), (grid.eight - middle) / deviation
    trained, converged = [], 0
    for repeat in range(repeats):
        network = networks.MLPRegressor(
            hidden_layer_sizes=(hidden,),
            activation="tanh",
            solver="lbfgs",
            alpha=WEIGHT_DECAY,
            max_iter=MOST_ITERATIONS,
            random_state=seed + repeat,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", exceptions.ConvergenceWarning)
            network.fit(inputs, outputs)
        converged += int(network.n_iter_ < MOST_ITERATIONS)
        (first, second), (offset, last) = network.coefs_, network.intercepts_
        trained.append((first, offset, second, last))
    return Network(extent, tuple(trained), middle, deviation, seed, converged)


# Fit functions by name, each of a grid and a seed; ConfigError where a package is not installed.
METAMODELS: dict[str, Callable[[metamodel_kinds.Grid, int], Metamodel]] = {
    "surface": metamodel_kinds.fit_surface,
    "process": fit_process,
    "network": fit_network,
}
CLASSES = (metamodel_kinds.ResponseSurface, GaussianProcess, Network, metamodel_kinds.PhysicalFit)
READERS: dict[str, Callable[[Mapping[str, Any]], Metamodel]] = {
    model.kind: model.from_entries for model in CLASSES
}


class Metamodel(TabulatedCoefficients, Protocol):
    """Coefficients (n_point, 8) [N/m, N s/m] over load [N] and speed [rad/s]."""

    @property
    def kind(self) -> str: ...
    @property
    def extent(self) -> metamodel_kinds.Extent: ...
    @property
    def statement(self) -> str: ...
    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """(n_point, 8) [N/m, N s/m]."""
        ...

    def to_entries(self) -> dict[str, Any]: ...


def from_entries(entries: Mapping[str, Any]) -> Metamodel:
    """The metamodel of its `to_entries`; DataError where they are not those of one."""
    kind = entries.get("kind") if isinstance(entries, Mapping) else None
    if kind not in READERS:
        hint = nearest(str(kind), READERS)
        raise DataError(f"these are not the entries of a metamodel: kind '{kind}'", hint=hint)
    try:
        model = READERS[kind](entries)
        shape = model.predict(model.extent.loads[0], np.array([model.extent.speeds[0]])).shape
    except (KeyError, TypeError, ValueError, IndexError, np.linalg.LinAlgError) as error:
        hint = "write it again from its run-ups"
        raise DataError(f"the entries of this {kind} metamodel are damaged: {error}", hint=hint) from error
    if shape != (1, 8):
        raise DataError(f"this {kind} metamodel does not give eight coefficients")
    return model


def caution(model: Metamodel, load: float) -> str:
    """Warning on a *load* [N] beyond those of the fit, or empty."""
    beyond, scope = outside(load, *model.extent.loads, "this metamodel"), "does not cover extrapolation"
    if model.kind in ("physical", "process"):
        scope = "is valid under its assumptions only"
    return beyond and f"{beyond}, an extrapolation: its error {scope}"


def _leave_out(grid: metamodel_kinds.Grid, load: float, kind: str, seed: int) -> Metamodel:
    if len(grid.loads) < 2:
        raise FitError(metamodel_kinds.NO_OTHER_LOAD)
    return METAMODELS[kind](grid.at(load, others=True), seed)


def leave_one_load_out(
    grid: metamodel_kinds.Grid,
    kinds: Iterable[str],
    physical: Callable[[float], Metamodel] | None = None,
    seed: int = 0,
) -> dict[str, list[LeftOut]]:
    """Every kind, and the *physical* fit (`physical_without`), without each load in turn, against the grid's
    coefficients there; a row states why a fit fails.
    """
    kinds = tuple(kinds)
    every = (*kinds, *([metamodel_kinds.PhysicalFit.kind] if physical else []))
    rows: dict[str, list[LeftOut]] = {kind: [] for kind in every}
    for load in grid.loads:
        fits = {kind: partial(_leave_out, grid, load, kind, seed) for kind in kinds}
        if physical is not None:
            fits[metamodel_kinds.PhysicalFit.kind] = partial(physical, load)
        is_end, points = load in (grid.loads[0], grid.loads[-1]), grid.at(load)
        for kind, fitted in fits.items():
            errors, failed = np.full(8, np.nan), ""
            try:
                errors = coefficient_errors(fitted().predict(points.load, points.speed), points.eight)
            except FitError as error:
                failed = error.what
            rows[kind].append(LeftOut(load, column(errors), is_end, failed))
    return rows

"""Feed-forward network of the eight coefficients: two inputs, one hidden layer, eight outputs, several repeats with different seeds.

Inputs are coded to -1 to 1, outputs standardised (zero mean, unit deviation), hidden units are tanh; trained by scikit-learn
(L-BFGS with weight decay). Predictions are the mean over the repeats and their standard error is the spread of the repeats, the effect
of the start weights only. Reading a network back needs no scikit-learn.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.run_ups.metamodels_grid import Extent, Grid

HIDDEN = 8
REPEATS = 10
WEIGHT_DECAY = 1e-3
MOST_ITERATIONS = 4000

# Weights and offsets of the hidden and of the output layer: (2, h), (h,), (h, 8), (8,).
Layers = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Network:
    """*repeats*: layers of each; middle, deviation (8,) [N/m, N s/m] of the outputs; n_converged: repeats whose training converged."""

    extent: Extent
    repeats: tuple[Layers, ...]
    middle: FloatArray
    deviation: FloatArray
    seed: int
    n_converged: int

    kind: ClassVar[str] = "network"

    @property
    def speeds(self) -> tuple[float, float]:
        """Range of speeds [rad/s] that it holds for."""
        return self.extent.speeds

    @property
    def statement(self) -> str:
        """Statement on layers, repeats and convergence."""
        hidden = self.repeats[0][1].size
        ended = "all of them" if self.n_converged == len(self.repeats) else f"{self.n_converged} of them"
        return (
            f"{len(self.repeats)} repeats of 2 inputs, {hidden} hidden units and 8 outputs, seeds from {self.seed} on; the training of "
            f"{ended} converged; errors are the spread of the repeats"
        )

    def repeat_predictions(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Coefficients of every repeat, (n_repeat, n_point, 8) [N/m, N s/m], at loads [N] and speeds [rad/s] (n_point,).

        Equation (run-network).
        """
        coded = self.extent.coded(load, speed)
        scaled = [np.tanh(coded @ first + offset) @ second + last for first, offset, second, last in self.repeats]
        return np.asarray(self.middle + self.deviation * np.array(scaled))

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The eight coefficients (n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]: the mean of the repeats."""
        return np.asarray(self.repeat_predictions(load, speed).mean(axis=0))

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Standard deviation of the repeats (n_point, 8) [N/m, N s/m]; NaN of a single repeat."""
        repeats = self.repeat_predictions(load, speed)
        return np.full(repeats.shape[1:], np.nan) if len(self.repeats) < 2 else np.asarray(repeats.std(axis=0, ddof=1))

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
        repeats = tuple(_layers(*(np.array(layer, np.float64) for layer in layers)) for layers in entries["repeats"])
        middle, deviation = (np.array(entries[name], np.float64) for name in ("middle", "deviation"))
        return cls(Extent.from_entries(entries), repeats, middle, deviation, int(entries["seed"]), int(entries["n_converged"]))


def _layers(first: FloatArray, offset: FloatArray, second: FloatArray, last: FloatArray) -> Layers:
    return first, offset, second, last


def fit_network(grid: Grid, seed: int = 0, repeats: int = REPEATS, hidden: int = HIDDEN) -> Network:
    """Networks with seeds *seed*, *seed* + 1 and so on; ConfigError without scikit-learn."""
    regressor, unfinished = _scikit_learn()
    extent = Extent.of(grid)
    middle, deviation = grid.eight.mean(axis=0), grid.eight.std(axis=0)
    deviation = np.where(deviation > 0, deviation, 1.0)
    inputs, outputs = extent.coded(grid.load, grid.speed), (grid.eight - middle) / deviation
    trained, converged = [], 0
    for repeat in range(repeats):
        network = regressor(
            hidden_layer_sizes=(hidden,),
            activation="tanh",
            solver="lbfgs",
            alpha=WEIGHT_DECAY,
            max_iter=MOST_ITERATIONS,
            random_state=seed + repeat,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", unfinished)
            network.fit(inputs, outputs)
        converged += int(network.n_iter_ < MOST_ITERATIONS)
        trained.append(_layers(network.coefs_[0], network.intercepts_[0], network.coefs_[1], network.intercepts_[1]))
    return Network(extent, tuple(trained), middle, deviation, seed, converged)


def _scikit_learn() -> tuple[Any, type[Warning]]:
    """The regressor and its warning of an unfinished training."""
    try:
        networks, exceptions = importlib.import_module("sklearn.neural_network"), importlib.import_module("sklearn.exceptions")
    except ImportError as error:
        hint = "install labpipe[networks], or leave the network out of the metamodels"
        raise ConfigError("a feed-forward network is trained by scikit-learn, which is not installed", hint=hint) from error
    return networks.MLPRegressor, exceptions.ConvergenceWarning

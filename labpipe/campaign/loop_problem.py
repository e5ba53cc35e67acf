"""Measured responses of a control loop beside the prediction of a bearing file: the residual over its unknowns, and what moves it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_kind import MagneticFile
from labpipe.campaign.loop_file import Unknown, with_unknowns
from labpipe.campaign.loop_sources import merged
from labpipe.errors import ConfigError
from labpipe.identify.budget import support_doubts
from labpipe.identify.measured import Measured
from labpipe.identify.settings import Support
from labpipe.identify.weights import whitened, whitener
from labpipe.records.doubt import Doubt, MatrixError

STEP = 1e-5

# Predicted response of a file on the measured lines, with the (stiffness, damping) of the support.
Predict = Callable[[MagneticFile, tuple[float, float]], ComplexArray]
# What one standard uncertainty of every source does to measured less predicted, at the same.
Errors = Callable[[MagneticFile, tuple[float, float]], Sequence[MatrixError]]


@dataclass(frozen=True)
class LoopObservation:
    """A *measured* response of a loop, the prediction by a *file* on the same lines, and the *support* beside the bearings.

    *nuisance*: real numbers that the prediction takes from the measurement. *errors*: of channels, and of numbers that the prediction rests
    on; the support is no part of them.
    """

    measured: Measured
    predict: Predict
    file: MagneticFile
    support: Support = Support()
    nuisance: int = 0
    errors: Errors = lambda *_: ()


@dataclass(frozen=True)
class LoopProblem:
    """Whitened residual of all responses over u: unknowns as shares of their start, then the support's deviations in standard errors.

    *support*: 0 for stiffness or 1 for damping, with its standard error, of every number of the support that has one.
    """

    observations: tuple[LoopObservation, ...]
    unknowns: tuple[Unknown, ...]
    support: tuple[tuple[int, float], ...]

    @cached_property
    def weights(self) -> list[ComplexArray]:
        """Whitener of every observation, (n_line, n, n) [1/unit of the response] each."""
        return [whitener(observation.measured) for observation in self.observations]

    @property
    def size(self) -> float:
        pairs = zip(self.observations, self.weights, strict=True)
        return float(np.linalg.norm(np.concatenate([whitened(weight, loop.measured.matrix) for loop, weight in pairs])))

    def file_values(self, u: FloatArray) -> dict[str, float]:
        """The unknowns by name at u (n_parameter,) [1]."""
        return {entry.name: entry.value * (1 + float(share)) for entry, share in zip(self.unknowns, u, strict=False)}

    def residual(self, u: FloatArray) -> FloatArray:
        """(n_equation,) [1]: measured minus predicted, then the support's deviations from its nominal values."""
        residuals = []
        for observation, weight in zip(self.observations, self.weights, strict=True):
            predicted = observation.predict(*self._at(observation, u))
            residuals.append(whitened(weight, observation.measured.matrix - predicted))
        return np.concatenate([*residuals, u[len(self.unknowns) :]])

    def _at(self, observation: LoopObservation, u: FloatArray) -> tuple[MagneticFile, tuple[float, float]]:
        """The file of an observation with its unknowns, and stiffness and damping of its support."""
        support = [observation.support.stiffness.value, observation.support.damping.value]
        for (which, error), deviation in zip(self.support, u[len(self.unknowns) :], strict=True):
            support[which] += error * float(deviation)
        return with_unknowns(observation.file, self.file_values(u)), (support[0], support[1])

    def changes(self, u: FloatArray) -> tuple[tuple[Doubt, ...], FloatArray]:
        """All sources but the support, and the change (n_source, n_equation) [1] of the residual by one standard uncertainty of each.

        A source of several responses changes all of them.
        """
        doubts: dict[str, Doubt] = {}
        parts: list[dict[str, FloatArray]] = []
        for observation, weight in zip(self.observations, self.weights, strict=True):
            errors = merged(observation.errors(*self._at(observation, u)))
            doubts = {**{error.doubt.source: error.doubt for error in errors}, **doubts}
            parts.append({error.doubt.source: whitened(weight, error.change) for error in errors})
        sizes = [observation.measured.n_equation for observation in self.observations]
        rows = [
            np.concatenate([*(part.get(source, np.zeros(n)) for part, n in zip(parts, sizes, strict=True)), np.zeros(len(self.support))])
            for source in doubts
        ]
        return tuple(doubts.values()), np.array(rows).reshape(len(doubts), sum(sizes) + len(self.support))

    @property
    def support_sources(self) -> tuple[Doubt, ...]:
        """Doubts of the support, in the order of its deviations."""
        return tuple(doubt for _, doubt in support_doubts(self.observations[0].support))

    def jacobian(self, u: FloatArray) -> FloatArray:
        """(n_equation, n_parameter) [1] by centred differences, at the edge of what a bearing can have by one-sided ones."""
        if not u.size:
            return np.zeros((self.residual(u).size, 0))
        return np.column_stack([self._slope(u, step) for step in STEP * np.eye(u.size)])

    def _slope(self, u: FloatArray, step: FloatArray) -> FloatArray:
        ahead, behind = (self.residual_within(u + sign * step) for sign in (1.0, -1.0))
        if ahead is None or behind is None:
            middle = self.residual(u)
            return (ahead - middle if ahead is not None else middle - behind if behind is not None else 0 * middle) / STEP
        return (ahead - behind) / (2 * STEP)

    def residual_within(self, u: FloatArray) -> FloatArray | None:
        """The residual (n_equation,) [1] at u (n_parameter,) [1]; None for values that no bearing can have."""
        try:
            return self.residual(u)
        except ConfigError:
            return None

    def chi2(self, u: FloatArray) -> float:
        """Sum of squares [1] at u (n_parameter,) [1]; infinite for values that no bearing can have."""
        residual = self.residual_within(u)
        return float("inf") if residual is None else float(residual @ residual)

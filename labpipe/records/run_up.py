"""A run-up: the 1x response of a rotor over speed at several planes, its excitation and the static load on its bearing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.arrays import frozen_array
from labpipe.records.doubt import Doubt
from labpipe.records.settings import Uncertain

DIRECTIONS = ("x", "y")


@dataclass(frozen=True)
class Shaker:
    """A force that does not turn: *plane* where it acts, its components [N] and its frequency over the shaft's speed."""

    plane: str
    x: float
    y: float
    frequency_ratio: float = 1.0


@dataclass(frozen=True)
class ProbeError:
    """What an error of a probe or of the keyphasor does to a run: d w^power (matrix @ X) at every plane, X = (x, y).

    doubt: of the number that errs by d [its unit]; matrix (n_plane, 2, 2) complex [1/unit of the number], w the frequency of the response.
    """

    doubt: Doubt
    matrix: ComplexArray
    power: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "matrix", frozen_array(self.matrix, np.complex128, f"matrix of {self.doubt.source}", np.shape(self.matrix))
        )


@dataclass(frozen=True)
class RunUp:
    """One run under one static *load* [N]; x along the load, y a quarter turn further with the spin.

    speed (n_speed,) [rad/s], rising; response (n_speed, n_plane, 2): complex phasors [m], 0-to-peak, from x(t) = Re(X exp(j w t)), w
    the frequency of the excitation; amplitude_error [m] and phase_error [rad], like response: standard errors. unbalance [kg m] by
    plane, complex with its angle from x at time zero; shaker: what excited the rotor instead; threshold [rad/s]: of instability, where
    it was measured. doubts: of the probes' calibration. DataError where these do not fit together.
    """

    name: str
    load: float
    speed: FloatArray
    planes: tuple[str, ...]
    response: ComplexArray
    _: KW_ONLY
    amplitude_error: FloatArray
    phase_error: FloatArray
    unbalance: Mapping[str, complex] = field(default_factory=dict)
    shaker: Shaker | None = None
    threshold: Uncertain | None = None
    doubts: tuple[ProbeError, ...] = ()

    def __post_init__(self) -> None:
        n, shape = np.size(self.speed), (np.size(self.speed), len(self.planes), 2)
        for name, dtype, wanted in (("speed", np.float64, (n,)), ("response", np.complex128, shape)):
            object.__setattr__(self, name, frozen_array(getattr(self, name), dtype, name, wanted))
        for name in ("amplitude_error", "phase_error"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), np.float64, name, shape))
            if not np.all(getattr(self, name) > 0):
                raise DataError(f"the {name.replace('_', ' ')} of run '{self.name}' is not positive everywhere", hint="weights need it")
        self._check_plain()
        self._check_excitation()

    def _check_plain(self) -> None:
        if not 0 < self.load < np.inf:
            raise DataError(f"the load of run '{self.name}' is positive, not {self.load:g} N")
        if not self.planes or len(set(self.planes)) < len(self.planes):
            raise DataError(f"run '{self.name}' needs planes of different names")
        if self.speed.size == 0 or self.speed[0] <= 0 or np.any(np.diff(self.speed) <= 0):
            raise DataError(f"the speeds of run '{self.name}' must rise from above zero")
        if self.threshold is not None and not (self.threshold.value > 0 and self.threshold.std_error > 0):
            raise DataError(f"the threshold of run '{self.name}' needs a positive speed and a positive uncertainty")

    def _check_excitation(self) -> None:
        named = [*self.unbalance, *([self.shaker.plane] if self.shaker is not None else [])]
        for plane in named:
            if plane not in self.planes:
                raise DataError(f"run '{self.name}' is excited at '{plane}', which is not among its planes", hint=", ".join(self.planes))
        if bool(self.unbalance) == (self.shaker is not None):
            raise DataError(f"run '{self.name}' needs either an unbalance or a shaker, and not both")

    def changes(self) -> dict[str, ComplexArray]:
        """Change (n_speed, n_plane, 2) [m] of the response by one standard uncertainty of every source; one source errs as one."""
        omega = self.speed if self.shaker is None else self.shaker.frequency_ratio * self.speed
        changes: dict[str, ComplexArray] = {}
        for error in self.doubts:
            course = error.doubt.std_error * omega**error.power
            change = course[:, None, None] * np.einsum("pij,npj->npi", error.matrix, self.response)
            changes[error.doubt.source] = changes.get(error.doubt.source, np.zeros_like(self.response)) + change
        return changes

    @property
    def n_speed(self) -> int:
        return int(self.speed.size)

    @property
    def rpm(self) -> FloatArray:
        """Speeds (n_speed,) [rpm]."""
        return self.speed * 30 / np.pi

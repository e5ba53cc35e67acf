"""Run-ups and their results: measurements, predictions of every method, identifiability."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, freeze
from labpipe.errors import DataError
from labpipe.records.finding import Finding, Parameter
from labpipe.records.uncertain import Uncertain, Uncertainty

DIRECTIONS = ("x", "y")


@dataclass(frozen=True)
class Shaker:
    """A force that does not turn: its *plane*, components [N], frequency over the shaft's speed."""

    plane: str
    x: float
    y: float
    frequency_ratio: float = 1.0


@dataclass(frozen=True)
class ProbeError:
    """What an error d of a probe or keyphasor does to a run: d w^power (matrix @ X) at every plane, X = (x,
    y), w its frequency; *uncertainty* of d, matrix (n_plane, 2, 2) complex [1/unit of d].
    """

    uncertainty: Uncertainty
    matrix: ComplexArray
    power: int = 0

    def __post_init__(self) -> None:
        what, shape = f"matrix of {self.uncertainty.source}", np.shape(self.matrix)
        freeze(self, "matrix", np.complex128, shape, what)


@dataclass(frozen=True)
class RunUp:
    """One run under one static *load* [N]; x along the load, y a quarter turn further with the spin.

    speed (n_speed,) [rad/s], rising; response (n_speed, n_plane, 2): complex phasors [m], 0-to-peak, from
    x(t) = Re(X exp(j w t)), w the frequency of the excitation; amplitude_error [m] and phase_error [rad],
    like response: standard errors. unbalance [kg m] by plane, complex with its angle from x at time zero;
    shaker: what excited the rotor instead; threshold [rad/s]: of instability, where it was measured.
    uncertainties: of the probes' calibration; baseline: the run that was subtracted, at its own speeds, whose
    noise all runs less it have in common; findings: on the tacho. DataError where these do not fit together.
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
    uncertainties: tuple[ProbeError, ...] = ()
    baseline: RunUp | None = None
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        n, shape = np.size(self.speed), (np.size(self.speed), len(self.planes), 2)
        freeze(self, "speed", np.float64, (n,))
        freeze(self, "response", np.complex128, shape)
        for name in ("amplitude_error", "phase_error"):
            freeze(self, name, np.float64, shape)
            if not np.all(getattr(self, name) > 0):
                what = f"the {name.replace('_', ' ')} of run '{self.name}' is not positive everywhere"
                raise DataError(what, hint="weights need it")
        self._check_plain()
        self._check_excitation()
        if np.any(self.response == 0):
            at = self.rpm[np.argwhere(self.response == 0)[0, 0]]
            what = f"a probe of run '{self.name}' does not move at {at:.4g} rpm: it has no phase there"
            raise DataError(what, hint="leave out that speed, or look at the probe")

    def _check_plain(self) -> None:
        if not 0 < self.load < np.inf:
            raise DataError(f"the load of run '{self.name}' is positive, not {self.load:g} N")
        if not self.planes or len(set(self.planes)) < len(self.planes):
            raise DataError(f"run '{self.name}' needs planes of different names")
        if self.speed.size == 0 or self.speed[0] <= 0 or np.any(np.diff(self.speed) <= 0):
            raise DataError(f"the speeds of run '{self.name}' must rise from above zero")
        if self.threshold is not None and not (self.threshold.value > 0 and self.threshold.std_error > 0):
            what = f"the threshold of run '{self.name}' needs a positive speed and a positive uncertainty"
            raise DataError(what)

    def _check_excitation(self) -> None:
        named = [*self.unbalance, *([self.shaker.plane] if self.shaker is not None else [])]
        for plane in named:
            if plane not in self.planes:
                what = f"run '{self.name}' is excited at '{plane}', which is not among its planes"
                raise DataError(what, hint=", ".join(self.planes))
        if bool(self.unbalance) == (self.shaker is not None):
            raise DataError(f"run '{self.name}' needs either an unbalance or a shaker, and not both")

    def baseline_changes(self) -> ComplexArray:
        """Change (2, n_reading, n_speed, n_output) [m] of the response by one standard error of each reading
        of the baseline, along and across it, read between its speeds in their shares.
        """
        base = self.baseline
        assert base is not None
        shares = [np.interp(self.speed, base.speed, reading) for reading in np.eye(base.n_speed)]
        unit = base.response / np.abs(base.response)
        errors = np.array([unit * base.amplitude_error, 1j * base.response * base.phase_error])
        return np.array(shares)[..., None] * errors.reshape(2, base.n_speed, 1, -1)

    def changes(self) -> dict[str, ComplexArray]:
        """Change (n_speed, n_plane, 2) [m] of the response by one standard uncertainty of every source."""
        omega = self.speed if self.shaker is None else self.shaker.frequency_ratio * self.speed
        changes: dict[str, ComplexArray] = {}
        for error in self.uncertainties:
            course = error.uncertainty.std_error * omega**error.power
            change = course[:, None, None] * np.einsum("pij,npj->npi", error.matrix, self.response)
            source = error.uncertainty.source
            changes[source] = changes.get(source, np.zeros_like(change)) + change
        return changes

    @property
    def n_speed(self) -> int:
        return int(self.speed.size)

    @property
    def rpm(self) -> FloatArray:
        """Speeds (n_speed,) [rpm]."""
        return self.speed * 30 / np.pi


TRAINED, HELD_OUT = "trained", "held-out"
# Verdict of a method whose family chi-square rejects: its speeds are values without an interval.
REJECTED = "rejected"
VERDICTS = (REJECTED, "not rejected", "determined", "not determined", "not fitted")
# Words of the notes on an extrapolated load.
OUTSIDE = "outside the loads"
# Name of the model without a fit: the rotor file's bearing.
START = "start"
# Two-sided 95 % of a normal distribution.
TWO_SIDED = 1.959964
Column = tuple[float, ...]


@dataclass(frozen=True)
class UncertainAmount:
    """A value with its standard error, None where none can be given; SI units."""

    value: float
    std_error: float | None = None

    @property
    def ci95(self) -> tuple[float, float] | None:
        if self.std_error is None:
            return None
        return self.value - TWO_SIDED * self.std_error, self.value + TWO_SIDED * self.std_error


@dataclass(frozen=True)
class Motion:
    """Phasor real + j imag (n_speed,) [m], 0-to-peak, of a direction of a plane; errors where measured."""

    plane: str
    direction: str
    real: Column
    imag: Column
    amplitude_error: Column = ()
    phase_error: Column = ()


@dataclass(frozen=True)
class Cascade:
    """Spectra of one response by blocks: speed (n_block,) [Hz], frequency (n_line,) [Hz], amplitude [m]."""

    label: str
    speed: Column
    frequency: Column
    amplitude: tuple[Column, ...]


@dataclass(frozen=True)
class MeasuredRun:
    """One run-up: *load* [N], *role* (TRAINED or HELD_OUT), speed (n_speed,) [rad/s], measured critical speed
    and threshold [rad/s]; printed_...: what a source prints (measured, original, enhanced) [Hz].
    """

    name: str
    load: float
    role: str
    _: KW_ONLY
    excitation: str
    speed: Column
    motions: tuple[Motion, ...]
    critical_speed: UncertainAmount | None = None
    threshold: UncertainAmount | None = None
    subtracted: str = ""
    printed_critical_speed: Column = ()
    printed_threshold: Column = ()
    cascades: tuple[Cascade, ...] = ()


@dataclass(frozen=True)
class RunPrediction:
    """A method at the load of one *run*: critical speed and threshold [rad/s], motions over *speed* (n,)
    [rad/s], eight coefficients and std_errors (none of some methods, null at a bound) for each of
    `coefficient_speed` [rad/s]; *notes*: reasons of missing values, warnings.
    """

    run: str
    critical_speed: UncertainAmount | None
    threshold: UncertainAmount | None
    _: KW_ONLY
    speed: Column = ()
    motions: tuple[Motion, ...] = ()
    coefficient_speed: Column = ()
    coefficients: tuple[Column, ...] = ()
    std_errors: tuple[Column, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Convergence:
    """Objective, mesh size and evaluations (n_iteration,) of a search; *capped*: ended by a limit."""

    where: str
    objective: Column
    mesh: Column
    evaluations: Column
    capped: bool
    best: Column = ()


@dataclass(frozen=True)
class StartSpread:
    """Final points of several starts of one search: eight factors, and its objective, of each."""

    where: str
    factors: tuple[Column, ...]
    objective: Column


class Predicts:
    predictions: tuple[RunPrediction, ...]

    def prediction(self, run: str) -> RunPrediction | None:
        return next((prediction for prediction in self.predictions if prediction.run == run), None)


@dataclass(frozen=True)
class RunUpMethod(Predicts):
    """One identification method: uncertainty, None where it has no such number, and predictions. rank:
    unknowns that the data determine, of *unknowns*; condition: within it, the worst; free: combinations that
    no datum holds, in words; parameters: what was estimated, where they are few.
    """

    name: str
    title: str
    verdict: str
    _: KW_ONLY
    predictions: tuple[RunPrediction, ...]
    unknowns: int = 8
    rank: int | None = None
    condition: float | None = None
    share_at_bound: float | None = None
    chi2_per_datum: float | None = None
    chi2_p: float | None = None
    n_datum: int = 0
    n_effective: float | None = None
    free: tuple[str, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    convergence: tuple[Convergence, ...] = ()
    spreads: tuple[StartSpread, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class RankRow:
    """Rank [1] of the eight coefficients from *data* at one load and speed, *condition* [1] within it, in
    *words*; *free*: undetermined combinations, in parts of the coefficients' sizes; *advice* if any.
    """

    data: str
    rank: int
    condition: float
    words: str
    free: tuple[str, ...]
    advice: str = ""


@dataclass(frozen=True)
class Surface:
    """Values [coefficient][load][speed] in SI units over load (n_load,) [N] and speed (n_speed,) [rad/s]."""

    load: Column
    speed: Column
    values: tuple[tuple[Column, ...], ...]


@dataclass(frozen=True)
class LeftOut:
    """Relative rms errors [-] (8,) of a metamodel at a load that is not in its fit; outside: it lies beyond
    the others; *failed*: reason of a failed fit.
    """

    load: float
    errors: Column
    outside: bool
    failed: str = ""

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.errors))))


@dataclass(frozen=True)
class MetamodelResult(Predicts):
    """Coefficients over load and speed from one method's points; *model*: entries that it is read from."""

    name: str
    title: str
    surface: Surface
    left_out: tuple[LeftOut, ...]
    predictions: tuple[RunPrediction, ...]
    remarks: tuple[str, ...] = ()
    model: dict[str, Any] = field(default_factory=dict)


# What has predictions of every run.
Model = RunUpMethod | MetamodelResult


@dataclass(frozen=True)
class RunUpResult:
    """Run-ups of one rotor, all methods; *plane*: of the critical speeds; metamodels_of: the method that they
    were fitted to; ranks: at rank_load [N] and rank_speed [rad/s], measured_rank: of the runs there; *source*
    of printed columns.
    """

    rotor: str
    plane: str
    bearing: str
    _: KW_ONLY
    runs: tuple[MeasuredRun, ...]
    methods: tuple[RunUpMethod, ...]
    metamodels: tuple[MetamodelResult, ...] = ()
    metamodels_of: str = ""
    ranks: tuple[RankRow, ...] = ()
    rank_load: float = 0.0
    rank_speed: float = 0.0
    measured_rank: RankRow | None = None
    source: str = ""
    findings: tuple[Finding, ...] = ()

    @property
    def predictors(self) -> tuple[Model, ...]:
        return (*self.methods, *self.metamodels)

    def method(self, name: str) -> RunUpMethod | None:
        return next((method for method in self.methods if method.name == name), None)


def findings(result: RunUpResult) -> tuple[tuple[str, Finding], ...]:
    return tuple(("run-ups", finding) for finding in result.findings)

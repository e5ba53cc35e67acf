"""What the tests of one rotor say together: unknowns, tests, small errors, predictions, weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field

from labpipe.arrays import FloatArray
from labpipe.records.finding import Finding

# How unknowns of sensors begin.
SENSORS = ("gain ", "phase ", "sensor ")


@dataclass(frozen=True)
class UnknownResult:
    """An unknown: *value* with its standard *error*, and *prior* with *prior_error*, all in *unit*; relative
    errors of a factor are those of its logarithm. told: the share of the prior's error that is left is below
    .7. by_test: the test without which its error would be largest, by the factor *wider*.
    """

    name: str
    value: float
    error: float
    prior: float
    prior_error: float
    unit: str
    group: str = ""
    told: bool = True
    by_test: str = ""
    wider: float = 1.0


@dataclass(frozen=True)
class SystemTestResult:
    """A test: chi-square of its *n* data with its probability, and the unknown that it pulls most against all
    others, by *z* standard errors of that.
    """

    name: str
    kind: str
    chi2: float
    n: int
    probability: float
    pulled: str
    z: float


@dataclass(frozen=True)
class SmallErrorResult:
    """A group of small errors: its *declared* standard deviation, and the one that the tests ask for."""

    name: str
    declared: float
    found: float


@dataclass(frozen=True)
class Campbell:
    """Modes over *speed* (n_speed,) [Hz], followed: frequency [Hz], log_decrement and whirl [1], (n_speed,
    n_mode), with the standard errors of the first two; NaN where a mode is gone.
    """

    speed: FloatArray
    frequency: FloatArray
    frequency_error: FloatArray
    log_decrement: FloatArray
    log_decrement_error: FloatArray
    whirl: FloatArray


@dataclass(frozen=True)
class CriticalResult:
    """A critical speed where the unbalance response at *place* shows it: speed [Hz], amplification factor and
    amplitude [m] with their 95 % intervals. margin: separation from the operating speed that there is, and
    that API 684 asks for [%]; met: probability that it is kept. missing: share of draws without the peak or
    its half-power points.
    """

    place: str
    speed: float
    speed_interval: tuple[float, float]
    amplification: float | None
    amplification_interval: tuple[float, float] | None
    amplitude: float
    amplitude_interval: tuple[float, float]
    margin: tuple[float, float] | None
    met: float | None
    missing: float


@dataclass(frozen=True)
class WeightResult:
    """A weight in the plane at a *node*: size [kg m] and angle [rad] from the mark, in the direction of
    spin.
    """

    node: int
    size: float
    angle: float


@dataclass(frozen=True)
class VibrationResult:
    """Rms of the probes (n_speed,) [m] over *speed* (n_speed,) [Hz], *before* and *after* weights, with the
    95 % interval of the latter, *low* to *high*.
    """

    speed: FloatArray
    before: FloatArray
    after: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class InfluenceResult:
    """What the rotor's tests say of the vibration z_0 [m] and the influence alpha [m/(kg m)] of the *planes*
    at every reading: *mean* (n,) and *root* (n, n_axis) of their joint covariance, a row for the real part of
    each, then for the imaginary part of each; by reading, z_0 before the planes. widened: factor that the
    root holds.
    """

    planes: tuple[str, ...]
    readings: tuple[str, ...]
    mean: FloatArray
    root: FloatArray
    widened: float = 1.0


@dataclass(frozen=True)
class BalanceResult:
    """Weights without a trial run; rms of the readings *before* and *after* them [m] with the 95 % interval
    of the latter; *next_runs*: what is expected to be left [m] if that run is made first; *influence*: what
    `labpipe balance` takes trial runs together with; *vibration*: what the weights do over the speeds.
    """

    speeds: tuple[float, ...]
    weights: tuple[WeightResult, ...]
    before: float
    after: float
    interval: tuple[float, float]
    next_runs: Mapping[str, float] = field(default_factory=dict)
    influence: InfluenceResult | None = None
    vibration: VibrationResult | None = None


@dataclass(frozen=True)
class RotorSystemResult:
    """The posterior of a rotor in numbers that people read. operating: speed of the rotor file [Hz].

    decrement: the least logarithmic decrement there, its standard error, and the probability that it is above
    .1. onset: speed [Hz] of instability and standard error of its logarithm. alternative: what the model was
    replaced by; widened: factor on intervals of predictions. next_tests: standard error of ln decrement
    there, if that test is made once more; budget: the shares [1] of the variance of ln decrement there that
    would go if one unknown, or all small errors of a group, were known. measured: (speed, natural frequency)
    [Hz] of tests in the bearings.
    """

    rotor: str
    operating: float
    _: KW_ONLY
    unknowns: tuple[UnknownResult, ...]
    tests: tuple[SystemTestResult, ...]
    small_errors: tuple[SmallErrorResult, ...]
    campbell: Campbell
    decrement: tuple[float, float, float]
    criticals: tuple[CriticalResult, ...] = ()
    onset: tuple[float, float] | None = None
    balance: BalanceResult | None = None
    next_tests: Mapping[str, float] = field(default_factory=dict)
    budget: Mapping[str, float] = field(default_factory=dict)
    measured: tuple[tuple[float, float], ...] = ()
    ln_evidence: float = 0.0
    alternative: str = ""
    widened: float = 1.0
    findings: tuple[Finding, ...] = ()

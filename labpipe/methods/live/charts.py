"""Self-starting charts of a running fit, and the forecast of how long it still takes.

Each new average is compared with the fit before it. Together they raise a false alarm in at most one sound
test of a hundred. Hawkins (1987), self-starting CUSUM charts; Siegmund (1985) for their limits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.artefacts.json_file import named_entries
from labpipe.distributions import chi2_tail, normal_quantile, normal_tail
from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings
from labpipe.methods.live import running_fit
from labpipe.quantities import locate_units, parse_value
from labpipe.records.finding import NORMAL, Finding, Parameter
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel
from labpipe.records.uncertain import MatrixError
from labpipe.registry import nearest
from labpipe.spectra.settings import FrfSettings

# Probability of a false alarm in a whole test of so many averages.
ALPHA, HORIZON = 0.01, 50
# Shares of it: a jump of the energy, of the scores, slow changes, scores that follow the level.
ENERGY_JUMP, SCORE_JUMP, CHANGE, LEVEL = 0.2, 0.3, 0.4, 0.1
# What theory expects of a series counts as so many averages; past values beyond this count as this.
PRIOR, CLIPPED_PAST = 6, 3.0
# Cumulative sums: half the change they are made for, and the largest step [standard deviations].
SLACK, LARGEST_STEP = 0.5, 4.0
# Averages that may be dropped as isolated faults, as a share.
MOST_DROPPED = 0.2
LEVEL_LOOKS = (8, 16, 32, 64)
# Overshoot of a cumulative sum beyond its limit, both ends together (Siegmund 1985).
OVERSHOOT = 1.166


def cusum_limit(alarm: float) -> float:
    """Limit h of a two-sided cumulative sum that raises a false alarm within HORIZON averages with the
    probability *alarm* [1].

    Run length of one side (exp(2 k b) - 2 k b - 1) / (2 k^2), k the SLACK, b = h + 1.166 (Siegmund 1985).
    """

    def excess(b: float) -> float:
        return (np.expm1(2 * SLACK * b) - 2 * SLACK * b) / (2 * SLACK**2) - 2 * HORIZON / alarm

    return float(scipy.optimize.brentq(excess, 0.1, 60.0)) - OVERSHOOT


@dataclass
class ScoreSeries:
    """Normal scores of a series whose values theory expects to have the mean 0 and the deviation 1."""

    past: list[float] = field(default_factory=list)
    # Cumulative sums of rises and of falls, and the averages since which they are not zero.
    sums: list[float] = field(default_factory=lambda: [0.0, 0.0])
    since: list[int] = field(default_factory=lambda: [0, 0])

    def score(self, value: float) -> float:
        """The normal score of the next *value*, studentised by the values before it."""
        dof = PRIOR + len(self.past)
        spread = np.sqrt((PRIOR + sum(entry**2 for entry in self.past)) / dof)
        size = -float(scipy.special.ndtri(max(scipy.special.stdtr(dof, -abs(value) / spread), 1e-300)))
        return float(np.copysign(size, value))

    def take(self, value: float, score: float, number: int) -> None:
        """Keep a value that was no isolated fault, and move the cumulative sums by its *score*."""
        self.past.append(float(np.clip(value, -CLIPPED_PAST, CLIPPED_PAST)))
        step = float(np.clip(score, -LARGEST_STEP, LARGEST_STEP))
        for side, rise in enumerate((step, -step)):
            if self.sums[side] == 0:
                self.since[side] = number
            self.sums[side] = max(0.0, self.sums[side] + rise - SLACK)

    def changed_since(self, limit: float) -> int | None:
        """The average since which the series has moved, None while it has not."""
        side = int(np.argmax(self.sums))
        return self.since[side] if self.sums[side] > limit else None


@dataclass(frozen=True)
class AverageVerdict:
    """What the charts say of a new average: it is a *jump* to be left out; *change* since that average;
    *with_level*: the coefficients follow the level of the hits.
    """

    jump: bool = False
    change: int | None = None
    with_level: bool = False


class Charts:
    def __init__(self, fit: running_fit.RunningFit) -> None:
        self._fit = fit
        # Of the energy, and of every coefficient.
        self._series = [ScoreSeries() for _ in range(1 + len(fit.equation.model.names))]
        self._pairs: list[tuple[float, FloatArray]] = []
        self._change_limit = cusum_limit(CHANGE * ALPHA / len(self._series))

    def monitors(
        self, z: ComplexArray, sums: running_fit.Sums, before: running_fit.RunningEstimate
    ) -> tuple[FloatArray, float]:
        """Whitened shift r (n_parameter,) of the coefficients by the average *z* (n_line, n_experiment,
        n_channel) against the fit *before*, and its energy T [1].
        """
        mean, covariance = sums.mean, sums.covariance()
        _, inverse, _, slopes, _ = self._fit.parts(mean, covariance, before.values)
        errors = np.empty((0, *z.shape), np.complex128)
        if isinstance(sums, running_fit.HitSums):
            share, errors = np.abs(z[..., -1]) ** 2 / sums.force_power, sums.common([z])
            z = z / z[..., -1:]
        else:
            share = np.full(z.shape[:2], 1.0 / sums.n)
        gain = self._fit.equation.gain(before.values)[:, None]
        of_energy = share
        if before.misfit or len(errors):
            # What the model does not explain, and what all lines of the hits before err by together, is in
            # the fit before: this average is compared with those before it.
            z, of_energy = z - mean, share / (1 + share)
        residual = (gain @ z[..., None])[..., 0]
        scaled_residual = (inverse @ residual[..., None])[..., 0]
        # Errors that lines have in common are more unknowns, each of the size 1.
        moved, unit = np.moveaxis((gain @ errors[..., None])[..., 0], 0, -1), np.eye(len(errors))
        (information, gradient), (of_errors, pull) = (
            running_fit.normal_equations(
                columns, by[..., None, None] * (inverse @ columns), by[..., None] * scaled_residual
            )
            for columns, by in ((np.concatenate([slopes, moved], axis=-1), share), (moved, of_energy))
        )
        n = len(before.values)
        information[n:, n:] += unit
        scale = np.append(running_fit.rescale(before.information)[1], np.ones(len(errors)))
        here = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)
        shift, here = -(here @ (gradient / scale))[:n], here[:n, :n]
        known = before.information / np.outer(scale[:n], scale[:n])
        others = np.mean(share) * here if len(errors) else np.linalg.pinv(known, hermitian=True)
        whitened = np.linalg.solve(np.linalg.cholesky(here + others), shift)
        energy = np.sum(of_energy * np.sum((residual.conj() * scaled_residual).real, axis=2))
        energy -= pull @ np.linalg.solve(of_errors + unit / (1 + np.mean(share)), pull) / 2
        return whitened, float(energy / residual.size)

    def _score(
        self, z: ComplexArray, sums: running_fit.Sums, before: running_fit.RunningEstimate
    ) -> tuple[list[float], list[float], bool]:
        """Values and normal scores of the energy and coefficients of *z*, and whether it is a jump."""
        number, n_parameter = sums.n + 1, len(self._series) - 1
        whitened, energy = self.monitors(z, sums, before)
        size = z.shape[0] * z.shape[1] * self._fit.equation.n_output
        smoothed = (number - 2) * (2 * running_fit.HALF_WIDTH + 1)
        expected = smoothed / max(smoothed - self._fit.equation.n_output, 1)
        expected *= 1 + (0 if before.misfit else n_parameter / (2 * size * (number - 1)))
        variance = (1 + 1 / (number - 2)) / size
        # The logarithm of a mean of squares is nearly normal.
        raised = float((np.log(energy) - np.log(expected) + variance / 2) / np.sqrt(variance))
        values = [raised, *(float(value) for value in whitened)]
        scores = [series.score(value) for series, value in zip(self._series, values, strict=True)]
        of_energy = 2 * normal_tail(abs(scores[0]))
        of_scores = chi2_tail(sum(score**2 for score in scores[1:]), n_parameter)
        jump = min(of_energy / ENERGY_JUMP, of_scores / SCORE_JUMP) < ALPHA / HORIZON
        return values, scores, bool(jump)

    def jumps(self, z: ComplexArray, sums: running_fit.Sums, others: running_fit.RunningEstimate) -> bool:
        """Whether *z* (n_line, n_experiment, n_channel) [units of channels] disagrees with the *others*."""
        return self._score(z, sums, others)[2]

    def judge(
        self, z: ComplexArray, sums: running_fit.Sums, before: running_fit.RunningEstimate, level: float
    ) -> AverageVerdict:
        """The verdict on the next average *z* (n_line, n_experiment, n_channel), its force of *level* [N]."""
        number = sums.n + 1
        if number < 3:
            return AverageVerdict()
        values, scores, jump = self._score(z, sums, before)
        if jump:
            return AverageVerdict(jump=True)
        for series, value, score in zip(self._series, values, scores, strict=True):
            series.take(value, score, number)
        changes = [series.changed_since(self._change_limit) for series in self._series]
        self._pairs.append((float(np.log(level)) if level > 0 else 0.0, np.array(scores[1:])))
        return AverageVerdict(
            change=next((change for change in changes if change is not None), None),
            with_level=isinstance(sums, running_fit.HitSums) and self._follows_level(),
        )

    def _follows_level(self) -> bool:
        if len(self._pairs) not in LEVEL_LOOKS:
            return False
        levels, scores = (np.array(column) for column in zip(*self._pairs, strict=True))
        if np.ptp(levels) == 0:
            return False
        limit = LEVEL * ALPHA / (len(LEVEL_LOOKS) * scores.shape[1])
        return any(scipy.stats.pearsonr(levels, column).pvalue < limit for column in scores.T)


BAND = normal_quantile(0.9)
# Averages beyond which a goal counts as out of reach.
FAR = 10**6
# Squared variation of the information of single hits, worth so many hits before any was seen.
HIT_VARIATION, PSEUDO_HITS = 0.4, 5


@dataclass(frozen=True)
class OtherForces:
    """So many *more* averages reach a goal if *forces* that did not act yet take turns with the others."""

    forces: tuple[str, ...]
    more: int

    def text(self, what: str) -> str:
        """With y by turns 24 more periods."""
        return f"with {' and '.join(self.forces)} by turns {self.more} more {what}s"


@dataclass(frozen=True)
class Forecast:
    """Averages in all until a goal is reached, with an 80 % band; None: never; *others*: by other forces."""

    expected: int | None
    low: int | None = None
    high: int | None = None
    others: OtherForces | None = None

    def after(self, averages: int) -> dict[str, int | None]:
        """How many are to come after so many *averages*: as expected, from *low* to *high*; at twice the
        level of force, where the noise is that of the sensors; with other directions.
        """
        more, low, high = (None if n is None else n - averages for n in (self.expected, self.low, self.high))
        twice, others = None if more is None else -(-more // 4), self.others.more if self.others else None
        return {"averages": more, "at_twice_the_level": twice, "by_turns": others, "low": low, "high": high}


def half_of_noise(std_error: FloatArray, dof: FloatArray) -> FloatArray:
    """t(nu) sqrt(1 + 2 / nu) s (n_parameter,) [parameter units]: it holds 95 % at the stop."""
    return scipy.special.stdtrit(dof, 0.975) * np.sqrt(1 + 2 / dof) * std_error


def averages_needed(
    estimate: running_fit.RunningEstimate, number: int, goal: float, scale: float = 1.0
) -> int | None:
    """Averages that give coefficient *number* the half-width *goal*, its variance times *scale* [1]."""
    n, dof = estimate.n, estimate.dof[number]
    error = estimate.std_error[number] * np.sqrt(scale)

    def half(averages: float) -> float:
        later = dof * (averages - 1) / (n - 1)
        return float(half_of_noise(error * np.sqrt(n / averages), later))

    if half(n) <= goal:
        return n
    if not goal > 0 or half(FAR) > goal:
        return None
    return math.ceil(scipy.optimize.brentq(lambda averages: half(averages) - goal, n, FAR))


def forecast(
    estimate: running_fit.RunningEstimate, number: int, goal: float, variation: float = 0.0
) -> Forecast:
    """When coefficient *number* reaches the half-width *goal* [parameter unit].

    *variation*: squared coefficient of variation of the information of single averages (0 of periods).
    """
    expected = averages_needed(estimate, number, goal)
    if expected is None:
        return Forecast(None)
    n, dof = estimate.n, estimate.dof[number]
    if expected <= n:
        return Forecast(n, n, n)
    later = dof * (expected - 1) / (n - 1)
    gained = later - dof
    spread = np.sqrt(2 / gained + 2 / dof) * gained / later
    relative = estimate.std_error[number] / abs(estimate.values[number])
    moved = np.sqrt(4 * relative**2 * (1 - n / expected) + variation * (1 / n - 1 / expected))
    ends = [averages_needed(estimate, number, goal, float(np.exp(sign * BAND * spread))) for sign in (-1, 1)]
    low = None if ends[0] is None else max(n + 1, int(np.floor(ends[0] * np.exp(-BAND * moved))))
    latest = FAR if ends[1] is None else np.ceil(ends[1] * np.exp(min(BAND * moved, 100.0)))
    high = int(latest) if latest < FAR else None
    return Forecast(expected, low, high)


def hit_variation(energies: Sequence[float]) -> float:
    """Squared coefficient of variation of the energy of hits, beside what is usual, [1]."""
    if len(energies) < 2:
        return HIT_VARIATION
    ratio = float(np.var(energies, ddof=1) / np.mean(energies) ** 2)
    return (PSEUDO_HITS * HIT_VARIATION + (len(energies) - 1) * ratio) / (PSEUDO_HITS + len(energies) - 1)


def no_longer_falls(widths: Sequence[float]) -> bool:
    """Whether half-widths (n,) fell less than half as fast as noise over the last doubling."""
    n = len(widths)
    return n >= 4 and widths[-1] > widths[n // 2 - 1] * 2 ** (-0.25)


def sequence_factor(n: float, tuned: float, dof: float, alpha: float = 0.05) -> float:
    """Half-width over standard error of an interval that holds for all numbers of averages at once, [1].

    rho = n_opt / (-W_-1(-alpha^2 / e) - 1), q = (sqrt((n + rho) / rho) / alpha)^(2 / (nu + 1)),
    factor^2 = nu (q - 1) / (1 - q rho / (n + rho)); infinite where the denominator is not positive.
    """
    rho = tuned / (-float(scipy.special.lambertw(-(alpha**2) / math.e, -1).real) - 1)
    q = (np.sqrt((n + rho) / rho) / alpha) ** (2 / (dof + 1))
    below = 1 - q * rho / (n + rho)
    return float(np.sqrt(dof * (q - 1) / below)) if below > 0 else np.inf


# What a rule may name: half the width of the stated interval, or the standard error of noise.
WIDTHS = ("expanded", "std_error")
# Updates that are remembered for the course of the test.
MOST_UPDATES = 2000
_RULE = re.compile(r"\s*(?:(?P<fit>[\w-]+)\.)?(?P<name>[\w-]+)\.(?P<width>\w+)\s*<=?\s*(?P<limit>.+?)\s*")


@dataclass(frozen=True)
class Goal:
    """The width, *limit*, that coefficient *name* of fit *fit* ('' for all that have it) shall have."""

    text: str
    fit: str
    name: str
    width: str
    limit: str

    @classmethod
    def of(cls, text: str) -> Goal:
        """The goal of a rule such as `k.expanded<=1%`; ConfigError for a rule on a value."""
        match = _RULE.fullmatch(text)
        if match is None or match["width"] not in WIDTHS:
            hint = "k.expanded<=1% or support.c.expanded<=20 N.s/m: a test ends by the width of an interval"
            raise ConfigError(f"--until: '{text}' is not a rule on a width", hint=hint)
        return cls(text, match["fit"] or "", match["name"], match["width"], match["limit"])

    def half(self, parameter: Parameter) -> float:
        """The width that is asked for in the parameter's unit; ConfigError for another unit."""
        with locate_units(f"--until: '{self.text}'"):
            limit = parse_value(self.limit, "1" if self.limit.endswith("%") else parameter.unit)
        if limit <= 0:
            raise ConfigError(f"--until: '{self.text}': no interval is so narrow", hint="a width above zero")
        return limit * abs(parameter.value) if self.limit.endswith("%") else limit


@dataclass(frozen=True)
class CommonPart:
    """What more averages do not take from the interval of a coefficient: its *half*-width by model error and
    stated numbers, the *shift* [parameter unit] of the value by the former, the *reason*; *scatter*: that by
    what hits scatter beyond their noise, which falls with every hit.
    """

    half: float
    shift: float
    reason: str
    scatter: float = 0.0

    def whole(self, value: float, half: float) -> tuple[float, float]:
        """The value and half-width with these, by those of noise [parameter unit]."""
        return value + self.shift, math.hypot(half, self.half, self.scatter)


def lasting(fit: Fit, errors: Iterable[MatrixError]) -> dict[str, float]:
    """By the names of parameters, the half-width [parameter unit] by model error and stated numbers, which
    averages do not take away: noise of the force within its window, an error of the FRF in the fit's budget
    among all *errors*, falls with every hit.
    """
    falling, stated = {error.uncertainty.source: 0.0 for error in errors if error.by_repeat}, {}
    if falling and fit.budget is not None:
        budget = fit.budget.enlarge(falling)
        stated = dict(zip(budget.names, map(float, budget.systematic), strict=True))
    return {
        p.name: NORMAL * math.hypot(parts.discrepancy, stated.get(p.name, parts.systematic))
        for p in fit.parameters
        if (parts := p.interval) is not None
    }


def hits_as_repeats(hits: Sequence[ComplexArray], n_output: int) -> dict[str, Any]:
    """Every hit (n_line, 1, n_channel) [channels' units] as a repeat of an FRF; nothing of none."""
    h = [(z[..., :n_output] / z[..., n_output:]).swapaxes(1, 2) for z in hits]
    names = tuple(f"hit {number}" for number in range(1, len(h) + 1))
    return {"repeats": np.array(h), "repeat_names": names, "repeats_are": "hits"} if h else {}


# Chance below which hits scatter beyond their noise.
SCATTER_P = 1e-3


def scatter_of_repeats(parameter: Parameter) -> float:
    """The half-width [parameter unit] by the scatter of repeats, as of a run; 0 where noise may be all."""
    of, parts = parameter.repeats, parameter.interval
    if not (of and parts and parts.noise > 0):
        return 0.0
    squares = float(np.var(of.values)) * len(of.values) / (of.used * parts.noise**2)
    return NORMAL * parts.repeats if chi2_tail(squares, len(of.values) - 1) < SCATTER_P else 0.0


@dataclass(frozen=True)
class Standing:
    """A coefficient, its *goal* and *floor* as half-widths [its unit], what is *remaining*."""

    parameter: Parameter
    goal: float | None = None
    remaining: Forecast | None = None
    floor: float = 0.0

    @property
    def half(self) -> float:
        """Half of the 95 % interval [parameter unit], infinite without one."""
        interval = self.parameter.ci95
        return math.inf if interval is None else (interval[1] - interval[0]) / 2

    @property
    def reached(self) -> bool:
        return self.goal is not None and self.half <= self.goal

    @property
    def held_up(self) -> bool:
        """Whether no number of averages reaches the goal."""
        return self.goal is not None and self.floor >= self.goal

    def no_help(self, label: str, cause: str = "") -> Finding:
        """That averages do not help *label*: the floor by its interval's reason, or the width by *cause*."""
        share = 100 * (self.half if cause else self.floor) / abs(self.parameter.value)
        cause = cause or self.parameter.reason or "stated uncertainties"
        return Finding("floor", f"{label}: more averages do not help: {cause}, floor {share:.2g} %")


@dataclass(frozen=True)
class Update:
    """What the bench says after an average: *standings* by `fit.parameter`, *findings*, whether to *stop*;
    *seconds* that one takes, *events* of this one, *levels*: the largest size of every channel in it [SI].
    """

    averages: int
    _: KW_ONLY
    standings: Mapping[str, Standing] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    stop: bool = False
    seconds: float = 0.0
    events: tuple[str, ...] = ()
    levels: Mapping[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """One line of `labpipe live --json`."""
        parameters, remaining = {}, {}
        for name, standing in self.standings.items():
            parameter = standing.parameter
            parameters[name] = named_entries(parameter, "value", "unit", "std_error", "ci95")
            if standing.goal is not None:
                parameters[name]["goal"] = standing.goal
            if standing.remaining is not None:
                left = standing.remaining.after(self.averages)
                more = left["averages"]
                remaining[name] = {**left, "seconds": None if more is None else more * self.seconds}
        return {
            "averages": self.averages,
            "parameters": parameters,
            "findings": [named_entries(finding, "code", "message") for finding in self.findings],
            **named_entries(self, "events", "levels"),
            "remaining": remaining,
            "stop": self.stop,
        }


@dataclass
class GoalWatch:
    """What follows the samples of *channels* for the fits of *settings*, until its *goals* are reached."""

    channels: tuple[Channel, ...]
    sample_rate: float
    frf: FrfSettings
    settings: Sequence[FitSettings]
    goals: Sequence[Goal] = ()
    averages: int = field(default=0, init=False)
    updates: list[Update] = field(default_factory=list, init=False)

    def check_goals(self, names: Mapping[str, Sequence[str]]) -> None:
        """ConfigError for a goal on a fit or coefficient that is not among the *names* of each fit, or on an
        expanded uncertainty of another coverage than that of the intervals that are followed.
        """
        for goal in self.goals:
            if goal.fit and goal.fit not in names:
                raise ConfigError(f"--until: no fit '{goal.fit}'", hint=nearest(goal.fit, names))
            of_fits = [goal.fit] if goal.fit else list(names)
            coefficients = [name for fit in of_fits for name in names[fit]]
            if goal.name not in coefficients:
                hint = nearest(goal.name, coefficients)
                raise ConfigError(f"--until: no coefficient '{goal.name}'", hint=hint)
            for fit in self.settings:
                if goal.width == WIDTHS[0] and fit.name in of_fits and fit.coverage != FitSettings.coverage:
                    what = f"identify.{fit.name}: coverage {100 * fit.coverage:g} % is not followed"
                    raise ConfigError(what, hint=f"a goal on {goal.name}.std_error, or coverage: 95 %")

    @property
    def what(self) -> str:
        """What an average of the test is."""
        names = {"impact": "hit", "periodic": "period", "decay": "decay"}
        return names.get(self.frf.excitation, "average")

    def keep(self, update: Update) -> None:
        self.updates.append(update)
        if len(self.updates) > MOST_UPDATES:
            del self.updates[1:-1:2]

    def goal_of(self, fit: str, parameter: Parameter, floor: float) -> float | None:
        """The half-width [parameter unit] that is asked for, None where nothing is; of a standard error of
        noise, twice that beside the *floor* which averages do not take away.
        """
        asked = [goal for goal in self.goals if goal.name == parameter.name and goal.fit in ("", fit)]
        halves = ((goal.width, goal.half(parameter)) for goal in asked)
        return min(
            (half if width == "expanded" else math.hypot(2 * half, floor) for width, half in halves),
            default=None,
        )

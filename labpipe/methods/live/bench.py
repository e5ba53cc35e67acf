"""The bench: averages in, after each the wanted coefficients with intervals that hold at this moment.

Stopping on the width of a corrected interval keeps its coverage, stopping on the value does not: a rule of
`--until` names a width. What speaks against a stop (a misfit, a change during the test) comes before it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np
from scipy import special

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.damping import damped
from labpipe.estimation.derived import reported_parameters
from labpipe.estimation.linear_models import form_view
from labpipe.estimation.measured import chosen_ports
from labpipe.estimation.model import DynamicModel, Setup
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate as FitEstimate
from labpipe.estimation.transfer_mode import transfer_of
from labpipe.methods.live.averages import CUTTERS, Average, Cutter
from labpipe.methods.live.charts import (
    MOST_DROPPED,
    Charts,
    Forecast,
    forecast,
    hit_variation,
    no_longer_falls,
)
from labpipe.methods.live.running_fit import Equation, Estimate, HitSums, PeriodSums, RunningFit
from labpipe.quantities import UnitError, parse_value
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Goodness
from labpipe.records.recording import Channel, Recording
from labpipe.records.settings import ESTIMATE
from labpipe.registry import nearest
from labpipe.spectra.bands import lines_in
from labpipe.spectra.period_average import LineSpectrum, excited_lines, smoothed_noise
from labpipe.spectra.ports import Layout, find_layout, sensor_response
from labpipe.spectra.settings import FrfSettings

# What a rule may name: half the width of the stated interval, or the standard error of noise.
WIDTHS = ("expanded", "std_error")
_RULE = re.compile(r"\s*(?:(?P<fit>[\w-]+)\.)?(?P<name>[\w-]+)\.(?P<width>\w+)\s*<=?\s*(?P<limit>.+?)\s*")
# A coefficient that would take so many times the averages of the slowest reachable goal is not told by this
# direction.
OUT_OF_REACH = 20


@dataclass(frozen=True)
class Goal:
    """The width that coefficient *name* of fit *fit* ('' for the only one that has it) shall have.

    limit: of the value [1] where *relative*, else in *unit*.
    """

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
            raise ConfigError(f"--until: '{text}' is no rule on a width", hint=hint)
        return cls(text, match["fit"] or "", match["name"], match["width"], match["limit"])

    def half(self, parameter: Parameter) -> float:
        """The width that is asked for in the parameter's unit; ConfigError for another unit."""
        try:
            if self.limit.endswith("%"):
                return parse_value(self.limit, "1") * abs(parameter.value)
            return parse_value(self.limit, parameter.unit)
        except UnitError as error:
            raise ConfigError(f"--until: '{self.text}': {error.what}", hint=error.hint) from None


@dataclass(frozen=True)
class Standing:
    """One coefficient after an average, the half-width *goal* asked for, and the averages *remaining*."""

    parameter: Parameter
    half: float
    goal: float | None = None
    remaining: Forecast | None = None

    @property
    def reached(self) -> bool:
        """Whether it is known as well as was asked for."""
        return self.goal is not None and self.half <= self.goal


@dataclass(frozen=True)
class Update:
    """What the bench says after an average: *standings* by `fit.parameter`, *findings*, whether to *stop*.

    seconds: that one average takes; *events*: what happened to this average.
    """

    averages: int
    _: KW_ONLY
    standings: Mapping[str, Standing] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    stop: bool = False
    seconds: float = 0.0
    events: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """One line of `labpipe live --json`."""
        parameters, remaining = {}, {}
        for name, standing in self.standings.items():
            parameter = standing.parameter
            parameters[name] = {
                "value": parameter.value,
                "unit": parameter.unit,
                "std_error": parameter.std_error,
                "ci95": None if parameter.ci95 is None else list(parameter.ci95),
            }
            if standing.goal is not None:
                parameters[name]["goal"] = standing.goal
            if standing.remaining is not None:
                left = standing.remaining
                remaining[name] = {
                    "averages": None if left.expected is None else left.expected - self.averages,
                    "low": None if left.low is None else left.low - self.averages,
                    "high": None if left.high is None else left.high - self.averages,
                    "seconds": None
                    if left.expected is None
                    else (left.expected - self.averages) * self.seconds,
                }
        return {
            "averages": self.averages,
            "parameters": parameters,
            "findings": [{"code": f.code, "message": f.message} for f in self.findings],
            "events": list(self.events),
            "remaining": remaining,
            "stop": self.stop,
        }


def check_names(goals: Sequence[Goal], names: Mapping[str, Sequence[str]]) -> None:
    """ConfigError for a goal on a fit or coefficient that is not among the *names* of each fit."""
    for goal in goals:
        if goal.fit and goal.fit not in names:
            raise ConfigError(f"--until: no fit '{goal.fit}'", hint=nearest(goal.fit, names))
        known = names[goal.fit] if goal.fit else [name for listed in names.values() for name in listed]
        if goal.name not in known:
            raise ConfigError(f"--until: no coefficient '{goal.name}'", hint=nearest(goal.name, known))


class FollowedFit:
    """One fit of the pipeline, followed average by average on its own lines and channels."""

    def __init__(self, settings: FitSettings, layout: Layout, frequency: FloatArray, by_energy: bool) -> None:
        rows = chosen_ports(layout.outputs, settings.output, "response")
        columns = chosen_ports(layout.inputs, settings.input, "force")
        outputs = tuple(layout.outputs[row] for row in rows)
        inputs = tuple(layout.inputs[column] for column in columns)
        self.settings, self.setup = settings, Setup(outputs, inputs, settings)
        if settings.mass == ESTIMATE and settings.kind.one_frf and transfer_of(self.setup):
            raise ConfigError(
                f"identify.{settings.name}: a transfer FRF of unknown mass is not followed live",
                hint="give the mass, or measure at the point of the force",
            )
        model = damped(settings.kind.model(self.setup), settings)
        if not isinstance(model, DynamicModel):
            raise ConfigError(
                f"identify.{settings.name}: damping: {settings.damping} is not followed live", hint="viscous"
            )
        self._channels = [layout.output_columns[0][row] for row in rows]
        self._channels += [layout.input_columns[0][column] for column in columns]
        band = settings.band or (settings.bands[0] if settings.bands else None)
        self._lines = np.flatnonzero(lines_in(frequency, band))
        if self._lines.size <= len(model.names):
            raise ConfigError(
                f"identify.{settings.name}: {self._lines.size} lines in the band cannot tell "
                f"{len(model.names)} coefficients",
                hint="widen the band",
            )
        chosen, view = frequency[self._lines], form_view(layout.form, settings)
        sensors = (*layout.output_sensors, *layout.input_sensors)
        picked = [sensors[row] for row in rows]
        picked += [sensors[len(layout.outputs) + column] for column in columns]
        self._sensors = np.array([sensor_response(sensor, chosen) for sensor in picked]).T
        equation = Equation(model, 2 * np.pi * chosen, view.factor(chosen), view.offset)
        self.fit = RunningFit(equation, settings.coverage)
        self.sums: PeriodSums | HitSums = HitSums() if by_energy else PeriodSums()
        self.charts = Charts(self.fit)
        self.model = model
        self.estimate: Estimate | None = None
        self.widths: dict[str, list[float]] = {}
        self.first: list[tuple[int, ComplexArray]] = []

    def picked(self, average: Average) -> ComplexArray:
        """The amplitudes of the fit's lines and channels, (n_line, 1, n_channel) [channels' units], sensors
        taken out.
        """
        z = average.amplitude[self._lines][:, self._channels] / self._sensors
        return z[:, None, :]

    def parameters(self) -> tuple[Parameter, ...]:
        """The coefficients and what is derived of them, with the interval that holds at this moment."""
        estimate = self.estimate
        assert estimate is not None
        dof = np.maximum(estimate.dof.astype(int), 1)
        design = (
            np.linalg.cholesky(_scaled(estimate.information)).T if estimate.identifiable else np.eye(dof.size)
        )
        widened = 1 + 2 / float(estimate.dof.min())
        both = []
        for factor in (1.0, widened * (estimate.reduced if estimate.misfit else 1.0)):
            fitted = FitEstimate(
                values=estimate.values,
                covariance=factor * estimate.covariance,
                scaled_design=design,
                gof=Goodness(0.0, 0.0, estimate.reduced, None),
                dof=int(dof.min()),
                parameter_dof=dof,
            )
            both.append(reported_parameters(fitted, self.model, self.setup))
        plain, wide = both
        return tuple(
            replace(parameter, std_error=narrow.std_error)
            for narrow, parameter in zip(plain, wide, strict=True)
        )


def _scaled(information: FloatArray) -> FloatArray:
    scale = np.sqrt(np.diag(information))
    return np.asarray(information / np.outer(scale, scale))


def is_followed(settings: FitSettings, frf: FrfSettings) -> bool:
    """Whether a fit can be followed average by average: a model linear in its parameters, by maximum
    likelihood, on plain periods or hits.
    """
    plain = not (settings.eliminate or settings.bootstrap or settings.monte_carlo or settings.compare)
    single = settings.sliding is None and not settings.peaks and len(settings.bands) <= 1
    return (
        settings.kind.equations is not None
        and settings.estimates.likelihood
        and plain
        and single
        and frf.single_averages
    )


class Bench:
    """All fits of a pipeline, followed over the samples of one stream."""

    def __init__(
        self,
        channels: Sequence[Channel],
        sample_rate: float,
        frf: FrfSettings,
        fits: Sequence[FitSettings],
        goals: Sequence[Goal] = (),
    ) -> None:
        self.channels, self.sample_rate, self.frf, self.goals = (
            tuple(channels),
            sample_rate,
            frf,
            tuple(goals),
        )
        self._settings = tuple(fits)
        self.cutter: Cutter = CUTTERS[frf.excitation](self.channels, sample_rate, frf)
        sample = Recording(self.channels, np.zeros((2, len(self.channels))), sample_rate)
        self.layout = find_layout([sample])
        self.fits: list[FollowedFit] = []
        self.averages = self.dropped = 0
        self._waiting: list[Average] = []
        self._energies: list[float] = []
        self._last_start = 0
        # First samples of the averages that count.
        self._starts: list[int] = []
        self.findings: dict[tuple[str, str], Finding] = {}
        self.updates: list[Update] = []
        names = {fit.name: _known_names(fit, self.layout) for fit in self._settings}
        check_names(self.goals, names)

    @property
    def hits(self) -> bool:
        """Whether the averages are hits of a hammer."""
        return self.frf.excitation == "impact"

    def add(self, block: FloatArray) -> list[Update]:
        """What the next samples (n, n_channel) [SI] change, average by average."""
        made = []
        for average in self.cutter.add(block):
            self._last_start = average.start
            update = self._taken(average)
            self.updates.append(update)
            made.append(update)
        return made

    def _taken(self, average: Average) -> Update:
        at = average.start / self.sample_rate
        what = "hit" if self.hits else "period"
        if average.fault:
            self.dropped += 1
            return self._update((f"{what} {average.number} at {at:.3f} s is left out: {average.fault}",))
        if not self.fits:
            self._waiting.append(average)
            if len(self._waiting) < 2:
                self.averages = len(self._waiting)
                return self._update(())
            self._begin()
            waiting, self._waiting, self.averages = self._waiting, [], 0
            for earlier in waiting[:-1]:
                self._follow(earlier)
            average = waiting[-1]
        fault = self._follow(average)
        if fault:
            self.dropped += 1
            return self._update((f"{what} {average.number} at {at:.3f} s is left out: {fault}",))
        return self._update((f"{what} {average.number} at {at:.3f} s",))

    def _begin(self) -> None:
        """Choose the lines by the first two averages, and set up the fits."""
        frequency = self.cutter.frequency
        amplitudes = np.array([average.amplitude for average in self._waiting])
        excited = np.ones(frequency.size, bool)
        if not self.hits:
            mean = amplitudes.mean(axis=0)
            spread = amplitudes[0] - mean
            noise = spread[:, :, None] * spread[:, None, :].conj()
            spectrum = smoothed_noise(
                LineSpectrum(frequency, mean, noise, 2, np.ones(frequency.size)), self.frf.smooth
            )
            for column in self.layout.input_columns[0]:
                excited &= excited_lines(spectrum, [column])
        chosen = excited & lines_in(frequency, self.frf.band, self.frf.exclude)
        if not chosen.any():
            raise FitError("no line of the force exceeds its noise", hint="check `period` and `band`")
        self.lines = np.flatnonzero(chosen)
        self.frequency = frequency[chosen]
        self.fits = [FollowedFit(fit, self.layout, self.frequency, self.hits) for fit in self._settings]

    def _follow(self, average: Average) -> str:
        """Hold the average against the fits before it, and take it in; why it is left out instead, or ''."""
        average = replace(average, amplitude=average.amplitude[self.lines])
        force = average.amplitude[:, list(self.layout.input_columns[0])]
        level = float(np.sqrt(np.mean(np.abs(force) ** 2)))
        parts = [fit.picked(average) for fit in self.fits]
        for fit, z in zip(self.fits, parts, strict=True):
            if fit.estimate is None:
                continue
            verdict = fit.charts.judge(z, fit.sums, fit.estimate, level)
            if verdict.jump:
                return "it does not agree with the averages before it"
            if verdict.change is not None:
                begun = self._time_of(verdict.change)
                message = f"{fit.settings.name}: the rig changes since about {begun}"
                self._note(Finding("changes", message))
            if verdict.with_level:
                message = f"{fit.settings.name}: the coefficients follow the level of the hits"
                self._note(Finding("level-dependent", message))
        self._energies.append(level**2)
        self.averages += 1
        for fit, z in zip(self.fits, parts, strict=True):
            fit.sums.add(z)
            if fit.sums.n >= 2:
                fit.estimate = fit.fit.update(fit.sums)
            else:
                fit.first.append((average.number, z))
        self._starts.append(average.start)
        return ""

    def _time_of(self, number: int) -> str:
        start = self._starts[min(number, len(self._starts)) - 1]
        return f"average {number} ({start / self.sample_rate:.1f} s)"

    def _note(self, finding: Finding) -> None:
        self.findings.setdefault((finding.code, finding.message.split(":")[0]), finding)

    @property
    def seconds(self) -> float:
        """Time that one average takes, by those so far [s]."""
        if not self.hits:
            return self.cutter.n_sample / self.sample_rate
        return self._last_start / self.sample_rate / max(self.averages + self.dropped - 1, 1)

    def _update(self, events: tuple[str, ...]) -> Update:
        standings: dict[str, Standing] = {}
        variation = hit_variation(self._energies) if self.hits else 0.0
        for fit in self.fits:
            if fit.estimate is not None:
                for parameter in fit.parameters():
                    standings[f"{fit.settings.name}.{parameter.name}"] = self._standing(
                        fit, parameter, variation
                    )
        if self.dropped > MOST_DROPPED * max(self.averages + self.dropped, 5):
            share = 100 * self.dropped / (self.averages + self.dropped)
            message = f"{share:.0f} % of the averages are left out: a loose connection, or bad hits"
            self._note(Finding("bad-averages", message))
        findings = (*self.findings.values(), *self._of_fits(standings))
        return Update(
            self.averages,
            standings=standings,
            findings=findings,
            stop=self._enough(standings),
            seconds=self.seconds,
            events=events,
        )

    def _standing(self, fit: FollowedFit, parameter: Parameter, variation: float) -> Standing:
        half = np.inf if parameter.ci95 is None else (parameter.ci95[1] - parameter.ci95[0]) / 2
        fit.widths.setdefault(parameter.name, []).append(half)
        goals = [
            goal for goal in self.goals if goal.name == parameter.name and goal.fit in ("", fit.settings.name)
        ]
        if not goals:
            return Standing(parameter, half)
        wanted = min(goal.half(parameter) * (1.0 if goal.width == "expanded" else 2.0) for goal in goals)
        estimate = fit.estimate
        assert estimate is not None
        remaining = None
        if parameter.name in fit.model.names and estimate.identifiable:
            number = fit.model.names.index(parameter.name)
            factor = np.sqrt(estimate.reduced) if estimate.misfit else 1.0
            remaining = forecast(estimate, number, wanted / factor, fit.settings.coverage, variation)
        return Standing(parameter, half, wanted, remaining)

    def _of_fits(self, standings: Mapping[str, Standing]) -> list[Finding]:
        """What speaks of the fits as they stand now: a misfit, a floor, coefficients that are not told."""
        findings = []
        for fit in self.fits:
            estimate, name = fit.estimate, fit.settings.name
            if estimate is None:
                continue
            if not estimate.identifiable:
                findings.append(
                    Finding(
                        "collinear",
                        f"{name}: this excitation does not tell the coefficients apart; turn the shaker, or "
                        "excite a second direction",
                    )
                )
            if estimate.misfit and estimate.n >= 3:
                findings.append(
                    Finding(
                        "model-mismatch",
                        f"{name}: chi-square per degree of freedom is {estimate.reduced:.3g}: the model does "
                        "not explain the averages within their noise; intervals count that",
                    )
                )
            for label, standing in standings.items():
                owner, _, parameter = label.partition(".")
                missing = owner == name and standing.goal and not standing.reached and estimate.misfit
                if missing and no_longer_falls(fit.widths[parameter]):
                    floor = 100 * standing.half / abs(standing.parameter.value)
                    message = f"{label}: more averages do not help: model error, floor {floor:.2g} %"
                    findings.append(Finding("floor", message))
        return [*findings, *self._not_told(standings)]

    def _not_told(self, standings: Mapping[str, Standing]) -> list[Finding]:
        reachable = [
            left.expected
            for standing in standings.values()
            if (left := standing.remaining) is not None and left.expected is not None
        ]
        findings = []
        for label, standing in standings.items():
            left = standing.remaining
            if left is None or standing.reached:
                continue
            far = left.expected is None or left.expected > OUT_OF_REACH * max(min(reachable), 3)
            if far and self.averages >= 5:
                findings.append(
                    Finding(
                        "not-told",
                        f"{label} is not identifiable with this direction and level: turn the shaker, or "
                        "raise the level",
                    )
                )
        return findings

    def _enough(self, standings: Mapping[str, Standing]) -> bool:
        """Whether every goal is reached and nothing speaks against a stop."""
        wanted = [standing for standing in standings.values() if standing.goal is not None]
        judged = all(fit.estimate is not None and fit.estimate.judged for fit in self.fits)
        if not wanted or not judged or any(not standing.reached for standing in wanted):
            return False
        return not any(code in ("changes", "bad-averages") for code, _ in self.findings)

    def by_hand(self) -> dict[str, tuple[float, float]]:
        """Intervals that hold at whatever moment the test is ended: 95 % for all averages at once.

        The t mixture sequence (Wang and Ramdas 2023), tuned to the number of averages there are.
        """
        intervals: dict[str, tuple[float, float]] = {}
        for fit in self.fits:
            estimate = fit.estimate
            if estimate is None:
                continue
            scale = np.sqrt(estimate.reduced) if estimate.misfit else 1.0
            for name, value, error, dof in zip(
                fit.model.names, estimate.values, estimate.std_error, estimate.dof, strict=True
            ):
                half = scale * error * sequence_factor(estimate.n, estimate.n, float(dof))
                intervals[f"{fit.settings.name}.{name}"] = (float(value - half), float(value + half))
        return intervals


def sequence_factor(n: float, tuned: float, dof: float, alpha: float = 0.05) -> float:
    """Half-width over standard error of an interval that holds for all numbers of averages at once, [1].

    rho = n_opt / (-W_-1(-alpha^2 / e) - 1), q = (sqrt((n + rho) / rho) / alpha)^(2 / (nu + 1)),
    factor^2 = nu (q - 1) / (1 - q rho / (n + rho)); infinite where the denominator is not positive.
    """
    rho = tuned / (-float(special.lambertw(-(alpha**2) / math.e, -1).real) - 1)
    q = (np.sqrt((n + rho) / rho) / alpha) ** (2 / (dof + 1))
    below = 1 - q * rho / (n + rho)
    return float(np.sqrt(dof * (q - 1) / below)) if below > 0 else np.inf


def _known_names(settings: FitSettings, layout: Layout) -> tuple[str, ...]:
    rows = chosen_ports(layout.outputs, settings.output, "response")
    columns = chosen_ports(layout.inputs, settings.input, "force")
    setup = Setup(
        tuple(layout.outputs[row] for row in rows), tuple(layout.inputs[c] for c in columns), settings
    )
    names = settings.kind.model(setup).names
    return (*names, "f_n", "zeta") if settings.kind.one_mode else names

"""Where a running test stands: what is asked for, what each coefficient is known to, what is left."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np

from labpipe.errors import ConfigError
from labpipe.methods.live.charts import Forecast
from labpipe.quantities import UnitError, parse_value
from labpipe.records.finding import Finding, Parameter
from labpipe.records.recording import Channel
from labpipe.registry import nearest
from labpipe.spectra.settings import FrfSettings

# What a rule may name: half the width of the stated interval, or the standard error of noise.
WIDTHS = ("expanded", "std_error")
# Updates that are remembered for the course of the test.
MOST_UPDATES = 2000
_RULE = re.compile(r"\s*(?:(?P<fit>[\w-]+)\.)?(?P<name>[\w-]+)\.(?P<width>\w+)\s*<=?\s*(?P<limit>.+?)\s*")


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
    """One coefficient after an average, the half-width *goal* asked for, and the averages *remaining*.

    floor: the half-width that more averages do not take away [parameter unit].
    """

    parameter: Parameter
    half: float
    goal: float | None = None
    remaining: Forecast | None = None
    floor: float = 0.0

    @property
    def reached(self) -> bool:
        return self.goal is not None and self.half <= self.goal

    @property
    def held_up(self) -> bool:
        """Whether no number of averages reaches the goal."""
        return self.goal is not None and self.floor >= self.goal


@dataclass(frozen=True)
class Update:
    """What the bench says after an average: *standings* by `fit.parameter`, *findings*, whether to *stop*.

    seconds: that one average takes; *events*: what happened to this average; *levels*: the largest size of
    every channel in it [SI].
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
            "levels": dict(self.levels),
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


class Watch:
    def __init__(
        self, channels: Sequence[Channel], sample_rate: float, frf: FrfSettings, goals: Sequence[Goal]
    ) -> None:
        self.channels, self.sample_rate, self.frf = tuple(channels), sample_rate, frf
        self.goals = tuple(goals)
        self.averages = 0
        self.updates: list[Update] = []

    def keep(self, update: Update) -> None:
        self.updates.append(update)
        if len(self.updates) > MOST_UPDATES:
            del self.updates[1:-1:2]

    def goal_of(self, fit: str, parameter: Parameter) -> float | None:
        """The half-width [parameter unit] that is asked for, None where nothing is."""
        wanted = [
            goal.half(parameter) * (1.0 if goal.width == "expanded" else 2.0)
            for goal in self.goals
            if goal.name == parameter.name and goal.fit in ("", fit)
        ]
        return min(wanted, default=None)


def half_width(parameter: Parameter) -> float:
    """Half of the 95 % interval [parameter unit], infinite without one."""
    return float(np.inf) if parameter.ci95 is None else (parameter.ci95[1] - parameter.ci95[0]) / 2

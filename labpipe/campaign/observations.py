"""What a comparison looks at: one parameter of one fit in every test, with the conditions of the test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.settings import CompareSettings
from labpipe.errors import ConfigError, FitError
from labpipe.quantities import UnitError, si_amount
from labpipe.records.comparison import ComparedPoint
from labpipe.records.identification import Fit, Parameter
from labpipe.registry import nearest


@dataclass(frozen=True)
class Observation:
    """A parameter of a test's fit; *condition* in SI (NaN where none is asked for), *group* as written."""

    fit: Fit
    parameter: Parameter
    condition: float
    group: str

    @property
    def value(self) -> float:
        return self.parameter.value

    @property
    def std_error(self) -> float:
        """The standard error; FitError where the fit could give none."""
        if self.parameter.std_error is None:
            raise FitError(f"'{self.parameter.name}' of test {self.fit.test} has no standard error", hint="a comparison needs one")
        return self.parameter.std_error

    @property
    def relative(self) -> float:
        """Standard error over value; FitError for a value that is not above zero."""
        if not self.value > 0:
            raise FitError(f"'{self.parameter.name}' of test {self.fit.test} is {self.value:g}", hint="only positive values have a ratio")
        return self.std_error / self.value

    def point(self) -> ComparedPoint:
        condition = None if np.isnan(self.condition) else self.condition
        return ComparedPoint(self.fit.test, self.value, self.parameter.ci95, condition, self.group)


@dataclass(frozen=True)
class Campaign:
    """The observations of one comparison, in rising condition, with the units of value and condition."""

    settings: CompareSettings
    observations: tuple[Observation, ...]
    condition_unit: str

    @property
    def unit(self) -> str:
        return self.observations[0].parameter.unit

    @property
    def condition(self) -> FloatArray:
        return np.array([each.condition for each in self.observations])

    @property
    def value(self) -> FloatArray:
        return np.array([each.value for each in self.observations])

    @property
    def std_error(self) -> FloatArray:
        return np.array([each.std_error for each in self.observations])

    @property
    def relative(self) -> FloatArray:
        return np.array([each.relative for each in self.observations])

    @property
    def subject(self) -> str:
        """What is compared, in words: "k of z, fit peaks"."""
        term = f" of {self.settings.term}" if self.settings.term else ""
        return f"{self.settings.parameter}{term}, fit {self.settings.fit}"

    def points(self) -> tuple[ComparedPoint, ...]:
        return tuple(each.point() for each in self.observations)


def observed(settings: CompareSettings, fits: Sequence[Fit], conditions: Mapping[str, Mapping[str, Any]]) -> Campaign:
    """The observations that the settings ask for, sorted by condition; *conditions* of every test by its name.

    ConfigError for a fit, term, parameter or condition that is not there; FitError for fewer than two tests.
    """
    chosen = _chosen(settings, fits)
    found, units = [], set()
    for fit in chosen:
        own = conditions.get(fit.test, {})
        value, unit = condition_of(settings, fit.test, own) if settings.over else (float("nan"), "")
        units.add(unit)
        found.append(Observation(fit, _parameter(settings, fit), value, group_of(settings, fit.test, own)))
    if len(units) > 1:
        raise ConfigError(f"the condition '{settings.over}' has the units {', '.join(sorted(units))}", hint="write it in one dimension")
    if len(found) < 2:
        raise FitError(f"comparison '{settings.name}' has {len(found)} test(s)", hint="at least two are needed")
    ordered = sorted(found, key=lambda each: (each.condition, each.group)) if settings.over else found
    return Campaign(settings, tuple(ordered), units.pop())


def _chosen(settings: CompareSettings, fits: Sequence[Fit]) -> list[Fit]:
    """The one fit of every test; ConfigError where there is none, or several in a test."""
    named = [fit for fit in fits if fit.name == settings.fit]
    if not named:
        raise ConfigError(f"no fit '{settings.fit}' to compare", hint=nearest(settings.fit, {fit.name for fit in fits}))
    found = [fit for fit in named if not settings.term or fit.term == settings.term]
    if not found:
        raise ConfigError(f"fit '{settings.fit}' has no term '{settings.term}'", hint=nearest(settings.term, {f.term for f in named}))
    tests = [fit.test for fit in found]
    twice = next((test for test in tests if tests.count(test) > 1), None)
    if twice is not None:
        raise ConfigError(f"fit '{settings.fit}' has several results in test '{twice}'", hint="name one with `term`, or fit one band")
    return found


def _parameter(settings: CompareSettings, fit: Fit) -> Parameter:
    try:
        return fit.parameter(settings.parameter)
    except KeyError:
        known = [parameter.name for parameter in fit.parameters]
        raise ConfigError(f"fit '{fit.name}' has no '{settings.parameter}'", hint=nearest(settings.parameter, known)) from None


def _given(name: str, test: str, conditions: Mapping[str, Any]) -> str:
    if name not in conditions:
        raise ConfigError(f"test '{test}' has no condition '{name}'", hint="write it under the test's `conditions`")
    return str(conditions[name])


def group_of(settings: CompareSettings, test: str, conditions: Mapping[str, Any]) -> str:
    return _given(settings.group, test, conditions) if settings.group else ""


def condition_of(settings: CompareSettings, test: str, conditions: Mapping[str, Any]) -> tuple[float, str]:
    """A condition as a number in SI with its unit: "427 N" -> (427.0, "N"); ConfigError for what is no amount."""
    try:
        return si_amount(_given(settings.over, test, conditions))
    except UnitError as error:
        raise ConfigError(f"condition {settings.over} of test '{test}': {error.what}", hint=error.hint) from None

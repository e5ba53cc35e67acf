"""Inputs of a comparison: one parameter of one fit in every test, with the conditions of the test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.quantities import UnitError, si_amount
from labpipe.records.comparison import ComparedPoint, Comparison
from labpipe.records.dataset import amount_of
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.registry import nearest
from labpipe.uncertainty.amounts import parameter_changes, random_error, source_dofs
from labpipe.uncertainty.settings import CompareSettings


@dataclass(frozen=True)
class Observation:
    """A parameter of a test's fit. *condition* and *second* one in SI (NaN where the settings name none),
    *group* as written.
    """

    fit: Fit
    parameter: Parameter
    condition: float
    second: float
    group: str

    @property
    def value(self) -> float:
        return self.parameter.value

    @property
    def std_error(self) -> float:
        """That of this test alone, without errors in common. FitError for a parameter without one."""
        error = random_error(self.fit, self.parameter)
        if error is None:
            what = f"'{self.parameter.name}' of test {self.fit.test} has no standard error"
            raise FitError(what, hint="a comparison needs one")
        return error

    @property
    def relative(self) -> float:
        """Standard error over value; FitError for a value that is not above zero."""
        if self.value > 0:
            return self.std_error / self.value
        what = f"'{self.parameter.name}' of test {self.fit.test} is {self.value:g}"
        causes = [finding.message for finding in self.fit.findings if finding.code == "unphysical"]
        raise FitError(what, hint="; ".join(["only positive values have a ratio", *causes]))

    def point(self) -> ComparedPoint:
        condition, second = (None if np.isnan(amount) else amount for amount in (self.condition, self.second))
        return ComparedPoint(
            self.fit.test,
            self.value,
            ci95=self.parameter.ci95,
            condition=condition,
            second=second,
            group=self.group,
        )


@dataclass(frozen=True)
class Campaign:
    """The observations of one comparison, in ascending order of the conditions."""

    settings: CompareSettings
    observations: tuple[Observation, ...]
    condition_unit: str
    second_unit: str = ""

    @property
    def unit(self) -> str:
        return self.observations[0].parameter.unit

    @property
    def condition(self) -> FloatArray:
        """Condition of every test, (n_test,) [condition_unit]."""
        return np.array([observation.condition for observation in self.observations])

    @property
    def second(self) -> FloatArray:
        """Second condition of every test, (n_test,) [second_unit]."""
        return np.array([observation.second for observation in self.observations])

    @property
    def value(self) -> FloatArray:
        """Parameter of every test, (n_test,) [unit]."""
        return np.array([observation.value for observation in self.observations])

    @property
    def std_error(self) -> FloatArray:
        """Standard error of every test alone, (n_test,) [unit]."""
        return np.array([observation.std_error for observation in self.observations])

    @property
    def relative(self) -> FloatArray:
        """Relative standard error of every test alone, (n_test,) [1]."""
        return np.array([observation.relative for observation in self.observations])

    @property
    def common(self) -> FloatArray:
        """Changes (n_source, n_test) [unit] by one standard uncertainty of every common source."""
        return parameter_changes(
            [observation.fit for observation in self.observations], self.observations[0].parameter.name
        )

    @property
    def common_dof(self) -> FloatArray:
        """Degrees of freedom (n_source,) [1] behind every common source."""
        return source_dofs([observation.fit for observation in self.observations])

    @property
    def subject(self) -> str:
        """Subject of the comparison in words: "k of z, fit peaks"."""
        term = f" of {self.settings.term}" if self.settings.term else ""
        return f"{self.observations[0].parameter.name}{term}, fit {self.settings.fit}"

    def points(self) -> tuple[ComparedPoint, ...]:
        return tuple(observation.point() for observation in self.observations)

    def comparison(self, amounts: Sequence[Parameter], verdict: str, statement: str) -> Comparison:
        """The comparison of these tests."""
        return Comparison(
            name=self.settings.name,
            kind=self.settings.kind,
            subject=self.subject,
            unit=self.unit,
            points=self.points(),
            amounts=tuple(amounts),
            verdict=verdict,
            statement=statement,
            condition=self.settings.condition,
            condition_unit=self.condition_unit,
            second=self.settings.second,
            second_unit=self.second_unit,
        )


def campaign_of(
    settings: CompareSettings,
    fits: Sequence[Fit],
    conditions: Mapping[str, Mapping[str, Any]],
    parameter: str = "",
) -> Campaign:
    """The observations of the settings; *conditions* of every test by its name; *parameter*: in place of
    theirs. ConfigError for an unknown fit, term, parameter or condition; FitError for fewer than two tests.
    """
    chosen = _choose(settings, fits)
    none = "", np.full(len(chosen), np.nan)
    amounts = [amounts_of(name, chosen, conditions) for name in settings.over]
    (unit, first), (second_unit, second) = (*amounts, none, none)[:2]
    observations = [
        Observation(
            fit,
            _parameter(parameter or settings.parameter, fit),
            float(first[number]),
            float(second[number]),
            group_of(settings, fit.test, conditions.get(fit.test, {})),
        )
        for number, fit in enumerate(chosen)
    ]
    if len(observations) < 2:
        what = f"comparison '{settings.name}' has {len(observations)} test(s)"
        raise FitError(what, hint="at least two are needed")
    if settings.over:
        two = bool(settings.second)
        observations.sort(key=lambda of: (of.condition, *([of.second] if two else []), of.group))
    return Campaign(settings, tuple(observations), unit, second_unit)


def select_fits(name: str, fits: Sequence[Fit]) -> list[Fit]:
    """The *fits* of that name; ConfigError where there is none."""
    named = [fit for fit in fits if fit.name == name]
    if not named:
        raise ConfigError(f"no fit '{name}' to compare", hint=nearest(name, {fit.name for fit in fits}))
    return named


def check_single(fits: Sequence[Fit], hint: str) -> None:
    """ConfigError for a test with several of the *fits*."""
    tests = [fit.test for fit in fits]
    twice = next((fit for fit in fits if tests.count(fit.test) > 1), None)
    if twice is not None:
        raise ConfigError(f"fit '{twice.name}' has several results in test '{twice.test}'", hint=hint)


def _choose(settings: CompareSettings, fits: Sequence[Fit]) -> list[Fit]:
    named = select_fits(settings.fit, fits)
    chosen = [fit for fit in named if not settings.term or fit.term == settings.term]
    if not chosen:
        what = f"fit '{settings.fit}' has no term '{settings.term}'"
        raise ConfigError(what, hint=nearest(settings.term, {f.term for f in named}))
    check_single(chosen, "name one with `term`, or fit one band")
    return chosen


def _parameter(name: str, fit: Fit) -> Parameter:
    try:
        return fit.parameter(name)
    except KeyError:
        names = [parameter.name for parameter in fit.parameters]
        raise ConfigError(f"fit '{fit.name}' has no '{name}'", hint=nearest(name, names)) from None


def _condition(name: str, test: str, conditions: Mapping[str, Any]) -> str:
    if name not in conditions:
        hint = nearest(name, conditions) if conditions else "write it under the test's `conditions`"
        raise ConfigError(f"test '{test}' has no condition '{name}'", hint=hint)
    return str(conditions[name])


def group_of(settings: CompareSettings, test: str, conditions: Mapping[str, Any]) -> str:
    if settings.group:
        written = _condition(settings.group, test, conditions)
        # 30degC of a file's name is 30 degC.
        amount = amount_of(written)
        alike = (of for of in settings.groups if of == written or (amount and amount_of(of) == amount))
        return next(alike, written)
    return test if settings.groups else ""


def amounts_of(
    name: str, fits: Sequence[Fit], conditions: Mapping[str, Mapping[str, Any]]
) -> tuple[str, FloatArray]:
    """A condition of the tests of all *fits*: its SI unit, and values (n_fit,) in it [that unit]. ConfigError
    where it has several units.
    """
    pairs = [condition_of(name, fit.test, conditions.get(fit.test, {})) for fit in fits]
    units = sorted({unit for _, unit in pairs})
    if len(units) > 1:
        what = f"the condition '{name}' has the units {', '.join(units)}"
        raise ConfigError(what, hint="write it in one dimension")
    return units[0], np.array([value for value, _ in pairs])


def condition_of(name: str, test: str, conditions: Mapping[str, Any]) -> tuple[float, str]:
    """A condition as a number in SI with its unit: "427 N" -> (427.0, "N"). ConfigError for what is no
    amount.
    """
    try:
        return si_amount(_condition(name, test, conditions))
    except UnitError as error:
        hint = f"{error.hint}; tests that differ in words are compared by `group`"
        raise ConfigError(f"condition {name} of test '{test}': {error.what}", hint=hint) from None

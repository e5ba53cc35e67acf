"""What a fitted loop says of its closed loop: margins, peak of the sensitivity, modes with their decrements, each with its interval."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_kind import MagneticFile
from labpipe.bearings.magnetic_stability import Levitated, closed_loop_poles, sampled, sampled_poles, unstable_poles
from labpipe.bearings.margins import margins
from labpipe.bearings.open_loop import open_loop
from labpipe.campaign.amount_budget import with_budget
from labpipe.campaign.loop_file import with_unknowns
from labpipe.campaign.loop_fit import BENT, LoopFit
from labpipe.campaign.loop_minimum import REACH
from labpipe.errors import ConfigError
from labpipe.records.budget import Budget
from labpipe.records.doubt import Doubt
from labpipe.records.finding import Finding
from labpipe.records.identification import Parameter

# Step of differences in standard errors of the unknowns.
STEP = 0.02
# Upper end of the search without a sampling rate [Hz], and of modes as a share of the sampling rate.
HIGHEST, NYQUIST = 20e3, 0.5
# Amounts whose logarithm is nearer to a normal distribution than they are themselves.
LOGARITHMIC = ("sensitivity_peak", "gain_margin_lower", "gain_margin_upper", "disk_margin", "delay_margin")
UNITS = {"phase_margin": "rad", "delay_margin": "s", "sensitivity_frequency": "Hz", "f_n": "Hz", "pole_real": "1/s", "pole_imag": "rad/s"}


# From values of the unknowns by name to the amounts by name.
Amounts = Callable[[Mapping[str, float]], dict[str, float]]


@dataclass(frozen=True)
class ClosedLoop:
    """Amounts by name at the fitted unknowns, their covariance by noise (n, n) [their units], in the same order; *unstable* poles.

    changes (n_source, n) [their units]: by one standard uncertainty of each of the *sources*. bent: names of the amounts that do not
    follow the unknowns in a straight line within their errors.
    """

    amounts: dict[str, float]
    covariance: FloatArray
    unstable: int
    sources: tuple[Doubt, ...] = ()
    changes: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    bent: tuple[str, ...] = ()

    def error(self, name: str) -> float:
        """Combined standard uncertainty of an amount [its unit]."""
        place = list(self.amounts).index(name)
        systematic = float(np.sum(self.changes[:, place] ** 2)) if len(self.changes) else 0.0
        return float(np.sqrt(max(self.covariance[place, place], 0.0) + systematic))

    def modes(self) -> list[str]:
        """Names of the logarithmic decrements."""
        return [name for name in self.amounts if name.startswith("log_decrement")]

    def parameters(self, quantile: float) -> tuple[tuple[Parameter, ...], Budget | None]:
        """All amounts with 95 % intervals, *quantile* standard errors to either side, of factors by their logarithm, and their budget."""
        plain = [self._parameter(number, name, quantile) for number, name in enumerate(self.amounts)]
        return with_budget(plain, self.sources, self.changes, logarithmic=LOGARITHMIC) if self.sources else (tuple(plain), None)

    def _parameter(self, number: int, name: str, quantile: float) -> Parameter:
        value, error = self.amounts[name], float(np.sqrt(max(self.covariance[number, number], 0.0)))
        unit = next((unit for start, unit in UNITS.items() if name.startswith(start)), "1")
        ends = (value - quantile * error, value + quantile * error)
        if name in LOGARITHMIC and value > 0:
            reach = np.exp(quantile * error / value)
            ends = (value / reach, value * reach)
        return Parameter(name, value, unit, std_error=error, ci95=(float(ends[0]), float(ends[1])), derived=True)


def closed_loop(file: MagneticFile, fit: LoopFit, rate: float | None, highest_mode: float) -> ClosedLoop:
    """The closed loop of the file with its fitted unknowns; modes up to *highest_mode* [Hz], first order in the unknowns' errors.

    Equation (comp-closed-loop).
    """
    values = fit.values()
    plant = with_unknowns(file, values).levitated()
    unstable = unstable_of(plant, rate)
    poles = modes_of(loop_poles(plant, rate), highest_mode)

    def at(changed: Mapping[str, float]) -> dict[str, float]:
        other = with_unknowns(file, changed).levitated()
        return _amounts(other, rate, _nearest(loop_poles(other, rate), poles), unstable == 0)

    here = at(values)
    slopes = np.array([_slope(at, values, parameter, list(here)) for parameter in fit.parameters]).reshape(len(fit.parameters), len(here))
    if not fit.usable:
        return ClosedLoop(here, np.zeros((len(here), len(here))), unstable)
    changes = fit.changes @ slopes
    sources = () if fit.budget is None else fit.budget.sources
    bent = _bent(at, values, slopes, fit.covariance + fit.changes.T @ fit.changes)
    return ClosedLoop(here, slopes.T @ fit.covariance @ slopes, unstable, sources, changes, bent)


def _bent(at: Amounts, values: Mapping[str, float], slopes: FloatArray, covariance: FloatArray) -> tuple[str, ...]:
    """Names of the amounts whose course is not straight where the unknowns move REACH combined standard errors along an amount's slope."""
    here = at(values)
    errors = np.sqrt(np.maximum(np.einsum("ji,jk,ki->i", slopes, covariance, slopes), 0.0))
    bent = []
    for column, (name, error) in enumerate(zip(here, errors, strict=True)):
        if not error > 0:
            continue
        away = REACH * covariance @ slopes[:, column] / error
        for sign in (1.0, -1.0):
            moved = {entry: value + sign * float(step) for (entry, value), step in zip(values.items(), away, strict=True)}
            try:
                reached = at(moved).get(name, np.nan)
            except ConfigError:
                reached = np.nan
            if not abs(reached - here[name] - sign * REACH * error) <= BENT * REACH * error:
                bent.append(name)
                break
    return tuple(bent)


def _slope(at: Amounts, values: Mapping[str, float], parameter: Parameter, names: list[str]) -> FloatArray:
    """Slopes (n,) of all amounts [their units] over one unknown."""
    step = STEP * (parameter.std_error or 0.0) or 1e-6 * abs(parameter.value)
    ahead, behind = (at({**values, parameter.name: parameter.value + sign * step}) for sign in (1, -1))
    return np.array([(ahead.get(name, np.nan) - behind.get(name, np.nan)) / (2 * step) for name in names])


def bent_findings(loop: ClosedLoop) -> list[Finding]:
    """A warning where what the fitted loop says does not follow its unknowns in a straight line within their errors."""
    if not loop.bent:
        return []
    names = ", ".join(loop.bent)
    what = f"two standard errors away from the fitted unknowns, first order fails for {names} of the fitted loop: their intervals are rough"
    return [Finding("first-order", what)]


def loop_poles(plant: Levitated, rate: float | None) -> ComplexArray:
    """Poles s [rad/s] (n_pole,) of the sampled loop, without a rate by Pade approximation of the delay."""
    return closed_loop_poles(plant) if rate is None else sampled_poles(sampled(plant, rate), rate)


def unstable_of(plant: Levitated, rate: float | None) -> int:
    """Number of poles that grow."""
    return unstable_poles(plant) if rate is None else int(np.sum(loop_poles(plant, rate).real > 0))


def modes_of(poles: ComplexArray, highest: float) -> ComplexArray:
    """The poles (n_mode,) [rad/s] of modes that swing, by their natural frequency up to *highest* [Hz]."""
    chosen = poles[(poles.imag > 1e-9 * np.abs(poles)) & (np.abs(poles) <= 2 * np.pi * highest)]
    return chosen[np.argsort(np.abs(chosen))]


def _nearest(poles: ComplexArray, modes: ComplexArray) -> ComplexArray:
    return np.array([poles[np.argmin(np.abs(poles - mode))] for mode in modes], np.complex128)


def _amounts(plant: Levitated, rate: float | None, modes: ComplexArray, stable: bool) -> dict[str, float]:
    """Margins where the loop is stable, then f_n, logarithmic decrement 2 pi z / sqrt(1 - z^2) and pole of every mode."""
    amounts: dict[str, float] = {}
    if stable:
        highest = HIGHEST if rate is None else NYQUIST * rate * (1 - 1e-9)
        of = margins(lambda omega: open_loop(plant, omega, rate).loop, highest)
        named = {
            "sensitivity_peak": of.peak,
            "sensitivity_frequency": of.peak_frequency,
            "gain_margin_lower": of.gain_lower,
            "gain_margin_upper": of.gain_upper,
            "phase_margin": of.phase,
            "delay_margin": of.delay,
            "disk_margin": of.disk,
        }
        # What the loop never reaches is no number.
        amounts |= {name: value for name, value in named.items() if np.isfinite(value) and value > 0}
    for number, pole in enumerate(modes, 1):
        amounts[f"f_n_{number}"] = float(np.abs(pole) / (2 * np.pi))
        amounts[f"log_decrement_{number}"] = float(-2 * np.pi * pole.real / pole.imag)
        amounts[f"pole_real_{number}"], amounts[f"pole_imag_{number}"] = float(pole.real), float(pole.imag)
    return amounts

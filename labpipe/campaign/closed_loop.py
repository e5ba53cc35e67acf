"""What a fitted loop says of its closed loop: margins, peak of the sensitivity, modes with their decrements, each with its interval."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.magnetic_kind import MagneticFile
from labpipe.bearings.magnetic_stability import Levitated, closed_loop_poles, sampled, sampled_poles, unstable_poles
from labpipe.bearings.margins import margins
from labpipe.bearings.open_loop import open_loop
from labpipe.campaign.loop_file import with_unknowns
from labpipe.campaign.loop_fit import LoopFit
from labpipe.records.identification import Parameter

# Step of differences in standard errors of the unknowns.
STEP = 0.02
# Upper end of the search without a sampling rate [Hz], and of modes as a share of the sampling rate.
HIGHEST, NYQUIST = 20e3, 0.5
# Amounts whose logarithm is nearer to a normal distribution than they are themselves.
LOGARITHMIC = ("sensitivity_peak", "gain_margin_lower", "gain_margin_upper", "disk_margin", "delay_margin")
UNITS = {"phase_margin": "rad", "delay_margin": "s", "sensitivity_frequency": "Hz", "f_n": "Hz", "pole_real": "1/s", "pole_imag": "rad/s"}


@dataclass(frozen=True)
class ClosedLoop:
    """Amounts by name at the fitted unknowns, their covariance by noise (n, n) [their units], in the same order; *unstable* poles."""

    amounts: dict[str, float]
    covariance: FloatArray
    unstable: int

    def error(self, name: str) -> float:
        """Standard error of an amount [its unit]."""
        place = list(self.amounts).index(name)
        return float(np.sqrt(max(self.covariance[place, place], 0.0)))

    def modes(self) -> list[str]:
        """Names of the logarithmic decrements."""
        return [name for name in self.amounts if name.startswith("log_decrement")]

    def parameters(self, quantile: float) -> list[Parameter]:
        """All amounts with 95 % intervals, *quantile* standard errors to either side; those of a factor by its logarithm."""
        return [self._parameter(name, quantile) for name in self.amounts]

    def _parameter(self, name: str, quantile: float) -> Parameter:
        value, error = self.amounts[name], self.error(name)
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
    covariance = slopes.T @ unknowns_covariance(fit) @ slopes
    return ClosedLoop(here, covariance, unstable)


Amounts = Callable[[Mapping[str, float]], dict[str, float]]


def _slope(at: Amounts, values: Mapping[str, float], parameter: Parameter, names: list[str]) -> FloatArray:
    """Slopes (n,) of all amounts [their units] over one unknown."""
    step = STEP * (parameter.std_error or 0.0) or 1e-6 * abs(parameter.value)
    ahead, behind = (at({**values, parameter.name: parameter.value + sign * step}) for sign in (1, -1))
    return np.array([(ahead.get(name, np.nan) - behind.get(name, np.nan)) / (2 * step) for name in names])


def unknowns_covariance(fit: LoopFit) -> FloatArray:
    """Covariance (n, n) of the fitted unknowns [their units]."""
    errors = np.array([parameter.std_error or 0.0 for parameter in fit.parameters])
    names = [parameter.name for parameter in fit.parameters]
    matrix = np.diag(errors**2)
    for one, other, value in fit.correlations:
        i, j = names.index(one), names.index(other)
        matrix[i, j] = matrix[j, i] = value * errors[i] * errors[j]
    return matrix


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
    found: dict[str, float] = {}
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
        found |= {name: value for name, value in named.items() if np.isfinite(value) and value > 0}
    for number, pole in enumerate(modes, 1):
        found[f"f_n_{number}"] = float(np.abs(pole) / (2 * np.pi))
        found[f"log_decrement_{number}"] = float(-2 * np.pi * pole.real / pole.imag)
        found[f"pole_real_{number}"], found[f"pole_imag_{number}"] = float(pole.real), float(pole.imag)
    return found

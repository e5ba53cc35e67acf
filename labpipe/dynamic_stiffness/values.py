"""What people read of a fitted dynamic stiffness: coefficients, whirl, crossover, coefficients at the speed of the shaft.

*std_error* is what noise leaves, *std_error_inflated* with it what given numbers add (and a residual beyond the noise); intervals are by
the latter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.dynamic_stiffness.effective import crossover
from labpipe.dynamic_stiffness.forms import DAMPING, STIFFNESS, StiffnessModel
from labpipe.dynamic_stiffness.whirl import FORMS_WITH_WHIRL, LIMIT, Whirl, whirl
from labpipe.identify.statistics import derived, estimated, student_limit, widened
from labpipe.records.identification import Parameter
from labpipe.records.uncertain import Uncertain

# Ratio of the whole standard error to that of noise below which they are the same.
SAME = 1 + 1e-9


@dataclass(frozen=True)
class Doubted:
    """Estimated values (n_parameter,) as they are fitted, covariance by noise and in all (n_parameter, n_parameter) [their units]."""

    model: StiffnessModel
    values: FloatArray
    noise: FloatArray
    whole: FloatArray
    dof: int

    def error(self, slopes: FloatArray, *, whole: bool) -> float:
        """Standard error [its unit] of what has *slopes* (n_parameter,) over the values."""
        covariance = self.whole if whole else self.noise
        return float(np.sqrt(max(float(slopes @ covariance @ slopes), 0.0)))


@dataclass(frozen=True)
class Shaft:
    """The shaft: *speed* [Hz], negative where it turns from y to x; mass [kg] and stiffness [N/m] of a rotor whose onset is asked for."""

    speed: float | None = None
    rotor_mass: Uncertain | None = None
    rotor_stiffness: float | None = None

    @property
    def sense(self) -> float:
        return -1.0 if self.speed is not None and self.speed < 0 else 1.0


@dataclass(frozen=True)
class Valued:
    """A reported parameter and its *slopes* (n_parameter,) [its unit per parameter unit] over the fitted values."""

    parameter: Parameter
    slopes: FloatArray


def coefficients(found: Doubted, vifs: FloatArray) -> tuple[Valued, ...]:
    """The estimated parameters with variance inflation factors (n_parameter,) [1], then those that a symmetry ties to them."""
    model = found.model
    plain = [
        _estimated(found, number, name, unit, float(vif))
        for number, (name, unit, vif) in enumerate(zip(model.names[: model.n_linear], model.units, vifs, strict=False))
    ]
    shaped = [_shape(found, number, float(vifs[model.n_linear + number])) for number in range(model.n_shape)]
    return (*plain, *shaped, *(_tied(valued) for valued in plain if model.symmetry == "seal"))


def _estimated(found: Doubted, number: int, name: str, unit: str, vif: float) -> Valued:
    noise, whole = (float(np.sqrt(matrix[number, number])) for matrix in (found.noise, found.whole))
    shown = _wide(estimated(name, unit, float(found.values[number]), noise, found.dof, vif), noise, whole)
    return Valued(shown, np.eye(found.values.size)[number])


def _wide(parameter: Parameter, noise: float, whole: float) -> Parameter:
    """The interval and significance by the whole standard error."""
    return widened(parameter, whole / noise) if noise > 0 and whole > SAME * noise else parameter


def _shape(found: Doubted, number: int, vif: float) -> Valued:
    """A shape parameter; the interval of one that is positive is that of its logarithm."""
    declared, place = found.model.form.shape[number], found.model.n_linear + number
    inner, slope = float(found.values[place]), declared.slope(float(found.values[place]))
    noise, whole = (float(np.sqrt(matrix[place, place])) for matrix in (found.noise, found.whole))
    plain = _wide(estimated(declared.name, declared.unit, declared.shown(inner), slope * noise, found.dof, vif), noise, whole)
    reach = student_limit(found.dof) * whole
    shown = replace(plain, ci95=_finite(declared.shown(inner - reach), declared.shown(inner + reach)))
    return Valued(shown, slope * np.eye(found.values.size)[place])


def _finite(low: float, high: float) -> tuple[float, float] | None:
    return (float(low), float(high)) if np.isfinite(low) and np.isfinite(high) else None


def _tied(valued: Valued) -> Valued:
    """k_yy = k_xx and k_yx = -k_xy."""
    parameter = valued.parameter
    letter, suffix, *rest = _parts(parameter.name)
    name = "_".join([letter, {"xx": "yy", "xy": "yx"}[suffix], *rest])
    if suffix == "xx":
        return Valued(replace(parameter, name=name, derived=True), valued.slopes)
    interval = None if parameter.ci95 is None else (-parameter.ci95[1], -parameter.ci95[0])
    ratio = None if parameter.t_ratio is None else -parameter.t_ratio
    turned = replace(parameter, name=name, value=-parameter.value, ci95=interval, t_ratio=ratio, derived=True)
    return Valued(turned, -valued.slopes)


def _parts(name: str) -> list[str]:
    """Letters, suffix and number of a band: k_p_xx gives k_p, xx; k_xx_1 gives k, xx, 1."""
    parts = name.split("_")
    place = next(number for number, part in enumerate(parts) if part in ("xx", "xy", "yx", "yy"))
    return ["_".join(parts[:place]), parts[place], *parts[place + 1 :]]


def derived_values(found: Doubted, omega: FloatArray, shaft: Shaft) -> tuple[tuple[Valued, ...], Whirl | None]:
    """Whirl, crossover and coefficients at the speed, as far as they exist, and the whirl itself; omega (n_line,) [rad/s] of the fit."""
    turning = _whirl_of(found)
    parts = [*_whirl_values(found, turning, shaft), *_crossover(found, omega, shaft), *_synchronous(found, omega, shaft)]
    return tuple(parts), turning


def _whirl_of(found: Doubted) -> Whirl | None:
    full = found.model.symmetry != "direct" and found.model.form.name in FORMS_WITH_WHIRL
    return whirl(found.model, found.values, found.whole) if full else None


def _whirl_values(found: Doubted, turning: Whirl | None, shaft: Shaft) -> list[Valued]:
    """Whirl frequency ratio and onset speed; none where there is no whirl."""
    if turning is None or turning.square <= 0 or not shaft.speed:
        return []
    speed = 2 * np.pi * abs(shaft.speed)
    ratio = np.sqrt(turning.square) / speed
    slopes = turning.slopes / (2 * np.sqrt(turning.square) * speed)
    ends = [float(np.sqrt(max(end, 0.0)) / speed) for end in turning.interval]
    values = [_derived(found, "whirl_frequency_ratio", "1", float(ratio), slopes, _finite(ends[0], ends[1]))]
    if shaft.rotor_mass is not None and turning.stiffness > 0:
        values.append(_onset(found, turning, shaft, float(ratio), slopes))
    return values


def _onset(found: Doubted, turning: Whirl, shaft: Shaft, ratio: float, ratio_slopes: FloatArray) -> Valued:
    """Speed [Hz] W = sqrt(k / m) / WFR at which a rotor on these coefficients begins to whirl; k in series with the shaft's stiffness."""
    mass = shaft.rotor_mass
    assert mass is not None
    softer = 1 + turning.stiffness / shaft.rotor_stiffness if shaft.rotor_stiffness else 1.0
    value = np.sqrt(turning.stiffness / softer / mass.value) / ratio / (2 * np.pi)
    slopes = value * (turning.stiffness_slopes / (2 * turning.stiffness * softer) - ratio_slopes / ratio)
    of_mass = mass.std_error / (2 * mass.value)
    whole = float(np.hypot(found.error(slopes, whole=True), value * of_mass))
    reach = LIMIT * whole / value
    interval = _finite(float(value * np.exp(-reach)), float(value * np.exp(reach)))
    noise = found.error(slopes, whole=False)
    plain = derived("onset_speed", "Hz", float(value), noise, found.dof)
    return Valued(replace(plain, ci95=interval, std_error_inflated=_inflated(noise, whole)), slopes)


def _inflated(noise: float, whole: float) -> float | None:
    return whole if whole > SAME * noise else None


def _derived(found: Doubted, name: str, unit: str, value: float, slopes: FloatArray, interval: tuple[float, float] | None) -> Valued:
    noise, whole = found.error(slopes, whole=False), found.error(slopes, whole=True)
    shown = replace(derived(name, unit, value, noise, found.dof), ci95=interval, std_error_inflated=_inflated(noise, whole))
    return Valued(shown, slopes)


def _crossover(found: Doubted, omega: FloatArray, shaft: Shaft) -> list[Valued]:
    if found.model.symmetry == "direct":
        return []
    found_at = crossover(found.model, found.values, found.whole, omega, shaft.sense)
    if found_at is None:
        return []
    to_hertz = 1 / (2 * np.pi)
    low, high = (to_hertz * end for end in found_at.interval)
    value = to_hertz * found_at.omega
    return [_derived(found, "crossover_frequency", "Hz", value, to_hertz * found_at.slopes, _finite(low, high))]


def _synchronous(found: Doubted, omega: FloatArray, shaft: Shaft) -> list[Valued]:
    """Re H and Im H / W at the speed W of the shaft, where it lies in the band and the form is more than K and C."""
    if not shaft.speed or found.model.form.name == "kc":
        return []
    speed = 2 * np.pi * abs(shaft.speed)
    if not omega[0] <= speed <= omega[-1]:
        return []
    at = np.array([speed])
    h, slopes = found.model.stiffness(found.values, at)[0], found.model.jacobian(found.values, at)[:, 0]
    values = []
    for letter, unit, factor in (("k", STIFFNESS, 1.0), ("c", DAMPING, 1 / (1j * speed))):
        for i, row in enumerate("xy"):
            for j, column in enumerate("xy"):
                if found.model.symmetry == "direct" and i != j:
                    continue
                value, change = (factor * h[i, j]).real, (factor * slopes[:, i, j]).real
                whole = found.error(change, whole=True)
                reach = student_limit(found.dof) * whole
                values.append(
                    _derived(
                        found, f"{letter}_{row}{column}_synchronous", unit, float(value), change, _finite(value - reach, value + reach)
                    )
                )
    return values

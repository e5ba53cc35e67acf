"""What people read of decaying modes: natural frequency, damping ratio, logarithmic decrement; with a mass stiffness and damping."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.decay.amplitude_law import FittedLaw
from labpipe.decay.likelihood import Decayed
from labpipe.identify.statistics import correlation, derived, estimated
from labpipe.records.identification import Parameter


def mode_parameters(fitted: Decayed, mass: float | None) -> tuple[Parameter, ...]:
    """f_n, zeta and logarithmic decrement of every mode in ascending frequency; with a *mass* [kg] k = m w_n^2 and c = 2 zeta w_n m.

    w_n = |lambda|, zeta = -Re lambda / |lambda|, log decrement = -2 pi Re lambda / Im lambda; standard errors of first order.
    Equation (decay-values).
    """
    parameters: list[Parameter] = []
    for mode, pole in enumerate(fitted.poles):
        block = fitted.covariance[2 * mode : 2 * mode + 2, 2 * mode : 2 * mode + 2]
        suffix = f"_{mode + 1}"
        f_n, zeta = (
            estimated(name + suffix, unit, value, _error(gradient, block), fitted.dof, None)
            for name, unit, value, gradient in _frequency_and_damping(pole)
        )
        gradient = 2 * np.pi * np.array([-1 / pole.imag, pole.real / pole.imag**2])
        decrement = float(-2 * np.pi * pole.real / pole.imag)
        parameters.extend((f_n, zeta, derived("log_decrement" + suffix, "1", decrement, _error(gradient, block), fitted.dof)))
        if mass is not None:
            parameters.extend(_support(pole, block, mass, "" if fitted.poles.size == 1 else suffix, fitted.dof))
    if not fitted.converged:
        return tuple(without_interval(parameter) for parameter in parameters)
    return tuple(parameters)


def _frequency_and_damping(pole: complex) -> tuple[tuple[str, str, float, FloatArray], ...]:
    """(name, unit, value, gradient (2,) over Re and Im of the pole)."""
    size = abs(pole)
    towards = np.array([pole.real, pole.imag]) / (2 * np.pi * size)
    turned = np.array([-(pole.imag**2), pole.real * pole.imag]) / size**3
    return ("f_n", "Hz", float(size / (2 * np.pi)), towards), ("zeta", "1", float(-pole.real / size), turned)


def _support(pole: complex, block: FloatArray, mass: float, suffix: str, dof: int) -> tuple[Parameter, Parameter]:
    """k and c of the support under the mass."""
    stiffness, damping = float(mass * abs(pole) ** 2), float(-2 * mass * pole.real)
    k = derived("k" + suffix, "N/m", stiffness, _error(2 * mass * np.array([pole.real, pole.imag]), block), dof)
    return k, derived("c" + suffix, "N.s/m", damping, _error(np.array([-2 * mass, 0.0]), block), dof)


def _error(gradient: FloatArray, covariance: FloatArray) -> float:
    return float(np.sqrt(max(float(gradient @ covariance @ gradient), 0.0)))


def without_interval(parameter: Parameter) -> Parameter:
    """The value alone, where no interval is right."""
    return replace(parameter, std_error=None, t_ratio=None, ci95=None, significant=None)


def law_parameters(fitted: FittedLaw, mode: int, unit: str, dof: int) -> tuple[Parameter, Parameter, Parameter]:
    """Damping ratio at rest, its slope and that of the frequency over the amplitude [unit] of the mode of this number from 0."""
    law, errors = fitted.law, np.sqrt(np.diag(fitted.covariance))
    per = f"1/{unit}" if "/" not in unit else f"1/({unit})"
    return (
        derived(f"zeta_rest_{mode + 1}", "1", law.zeta_rest, float(errors[0]), dof),
        derived(f"zeta_slope_{mode + 1}", per, law.zeta_slope, float(errors[1]), dof),
        derived(f"f_slope_{mode + 1}", f"Hz{per[1:]}", law.frequency_slope / (2 * np.pi), float(errors[2]) / (2 * np.pi), dof),
    )


def pole_correlation(fitted: Decayed) -> FloatArray:
    """Correlation (2 n_mode, 2 n_mode) [1] of f_n_1, zeta_1, f_n_2, zeta_2 ..."""
    n = fitted.poles.size
    slopes = np.zeros((2 * n, 2 * n))
    for mode, pole in enumerate(fitted.poles):
        for row, (_, _, _, gradient) in enumerate(_frequency_and_damping(pole)):
            slopes[2 * mode + row, 2 * mode : 2 * mode + 2] = gradient
    return correlation(slopes @ fitted.covariance @ slopes.T)

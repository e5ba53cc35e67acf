"""Quantities derived from the estimates: resonance, modes, direction of the force, fixed or tied coefficients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.identify.base_motion import PER_MASS
from labpipe.identify.corrections import Estimated, is_corrected
from labpipe.identify.model import DynamicModel
from labpipe.identify.modes import Quantities, modal_quantities
from labpipe.identify.proportional import ProportionalModel
from labpipe.identify.settings import COEFFICIENT_UNITS
from labpipe.identify.setup import Setup
from labpipe.identify.statistics import derived
from labpipe.identify.transfer_mode import TransferMode, transfer_of
from labpipe.records.identification import Parameter

# What one band is fitted with.
BandModel = DynamicModel | ProportionalModel | TransferMode

# Steps of numerical slopes: in standard errors, and as a share of the value where there is no noise.
STEP, SMALLEST_STEP = 1e-3, 1e-7


def derived_parameters(total: Estimated, model: BandModel, setup: Setup, dof: int) -> list[Parameter]:
    """f_n and zeta (sdof, base), modes (mdof), forcing angle (rotor-2dof, one force), damping coefficients of proportional damping,
    totals where support or share changed the coefficients, and fixed coefficients. Equation (est-resonance).
    """
    settings = setup.settings
    parameters: list[Parameter] = []
    if settings.kind.one_mode:
        parameters.extend(_resonance(total, setup, dof))
    if isinstance(model, ProportionalModel):
        parameters.extend(_propagated_all(total, lambda values: _damping_coefficients(model, values), dof))
    if settings.kind.matrix_modes:
        ports = tuple(port.dof or port.label for port in setup.outputs), tuple(port.label for port in setup.inputs)
        parameters.extend(_propagated_all(total, lambda values: modal_quantities(model.whole(values), *ports), dof))
    if "b_x" in total.names and "b_y" in total.names:
        parameters.append(_forcing_angle(total, dof))
    if is_corrected(settings):
        for name, unit in zip(total.names, total.units, strict=True):
            if unit in ("N/m", "N.s/m"):
                parameters.append(derived(f"{name}_total", unit, total.value(name), total.std_error(name), dof))
    parameters.extend(Parameter(name, value, COEFFICIENT_UNITS[name[0]], derived=True) for name, value in settings.fixed)
    return parameters


def _damping_coefficients(model: ProportionalModel, values: FloatArray) -> Quantities:
    """c_i_j = alpha m_i_j + beta k_i_j of every stiffness coefficient; *values* (n_case, n_parameter)."""
    damping = model.whole(values).damping
    coefficients: Quantities = {}
    for term in model.terms:
        places = np.argwhere(term.matrices.stiffness != 0)
        if places.size:
            coefficients[f"c{term.name[1:]}"] = ("N.s/m", damping[:, places[0][0], places[0][1]])
    return coefficients


def _propagated_all(total: Estimated, quantities: Callable[[FloatArray], Quantities], dof: int) -> list[Parameter]:
    """Functions of the estimates with their standard errors to first order, derivatives by centred differences.

    Values without standard errors where the functions do not exist on both sides of the estimate.
    """
    steps = np.maximum(STEP * np.sqrt(np.diag(total.covariance)), SMALLEST_STEP * np.abs(total.values))
    quantities_at_steps = quantities(np.vstack([total.values, total.values + np.diag(steps), total.values - np.diag(steps)]))
    if not quantities_at_steps or np.any(steps == 0):
        centre = quantities(total.values[None])
        return [Parameter(name, float(value[0]), unit, derived=True) for name, (unit, value) in centre.items()]
    n = steps.size
    parameters = []
    for name, (unit, values) in quantities_at_steps.items():
        slope = (values[1 : n + 1] - values[n + 1 :]) / (2 * steps)
        error = float(np.sqrt(max(slope @ total.covariance @ slope, 0.0)))
        parameters.append(derived(name, unit, float(values[0]), error, dof))
    return parameters


def _resonance(total: Estimated, setup: Setup, dof: int) -> list[Parameter]:
    """f_n = sqrt(k/m) / 2 pi [Hz] and zeta = c / (2 m w_n) of the measured system, of a transfer FRF also its modal constant 1/m [1/kg].

    k and m of a transfer FRF, or of a sensor of the wrong sign, are negative together: the resonance is the same. None of it where k and
    m have different signs or are eliminated.
    """
    stiffness, damping = (next((n for n in (name, PER_MASS[name][0]) if n in total.names), "") for name in "kc")
    if not stiffness:
        return []
    k = total.value(stiffness)
    m = total.value("m") if "m" in total.names else 1.0 if stiffness != "k" else float(setup.settings.mass)  # type: ignore[arg-type]
    resonance = []
    if "m" in total.names and m != 0 and transfer_of(setup):
        resonance.append(derived("modal_constant", "1/kg", 1 / m, propagated(total, {"m": -1 / m**2}), dof))
    if k * m <= 0:
        return resonance
    w_n = np.sqrt(k / m)
    f_n = w_n / (2 * np.pi)
    slopes = {stiffness: f_n / (2 * k), "m": -f_n / (2 * m)}
    resonance.insert(0, derived("f_n", "Hz", float(f_n), propagated(total, slopes), dof))
    if damping:
        zeta = total.value(damping) / (2 * m * w_n)
        slopes = {damping: 1 / (2 * m * w_n), stiffness: -zeta / (2 * k), "m": -zeta / (2 * m)}
        resonance.insert(1, derived("zeta", "1", float(zeta), propagated(total, slopes), dof))
    return resonance


def _forcing_angle(total: Estimated, dof: int) -> Parameter:
    """atan2(b_y, b_x) [rad]."""
    x, y = total.value("b_x"), total.value("b_y")
    square = x**2 + y**2
    return derived("forcing_angle", "rad", float(np.arctan2(y, x)), propagated(total, {"b_x": -y / square, "b_y": x / square}), dof)


def propagated(total: Estimated, slopes: dict[str, float]) -> float:
    """Standard error of a function of the estimates to first order: sqrt(g^T cov g), g its derivatives by name. Equation (est-delta)."""
    gradient = np.array([slopes.get(name, 0.0) for name in total.names])
    return float(np.sqrt(max(gradient @ total.covariance @ gradient, 0.0)))

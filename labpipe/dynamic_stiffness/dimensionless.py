"""Coefficients without dimension, K c / W, C c w / W, M c w^2 / W of clearance c, load W and speed w, and the Sommerfeld number.

S = mu N L D / W (R / c)^2 with N in revolutions per second (Someya 1989, Journal-Bearing Databook).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.dynamic_stiffness.values import Valued
from labpipe.records.identification import Parameter

LETTERS = "kcm"


@dataclass(frozen=True)
class Bearing:
    """Radial *clearance* [m], *load* [N], viscosity [Pa s], diameter and length [m]; None where not given."""

    clearance: float | None = None
    load: float | None = None
    viscosity: float | None = None
    diameter: float | None = None
    length: float | None = None


def dimensionless(coefficients: Sequence[Valued], bearing: Bearing, speed: float | None) -> tuple[Valued, ...]:
    """k_xx_dimensionless ... at a *speed* [Hz], and the Sommerfeld number; as far as what they need is given.

    Equation (ds-dimensionless).
    """
    if not bearing.clearance or not bearing.load or not speed:
        return ()
    omega = 2 * np.pi * abs(speed)
    scaled = [
        _scaled(valued, bearing.clearance / bearing.load * omega ** LETTERS.index(letter))
        for valued in coefficients
        if (letter := valued.parameter.name.split("_")[0]) in LETTERS and len(valued.parameter.name) == len("k_xx")
    ]
    number = _sommerfeld(bearing, abs(speed))
    return (*scaled, *(Valued(parameter, np.zeros_like(coefficients[0].slopes)) for parameter in number))


def _scaled(valued: Valued, factor: float) -> Valued:
    parameter = valued.parameter
    interval = None if parameter.ci95 is None else (factor * parameter.ci95[0], factor * parameter.ci95[1])
    errors = [None if error is None else factor * error for error in (parameter.std_error, parameter.std_error_inflated)]
    scaled = replace(
        parameter,
        name=f"{parameter.name}_dimensionless",
        value=factor * parameter.value,
        unit="1",
        std_error=errors[0],
        std_error_inflated=errors[1],
        ci95=interval,
        vif=None,
        derived=True,
    )
    return Valued(scaled, factor * valued.slopes)


def _sommerfeld(bearing: Bearing, speed: float) -> tuple[Parameter, ...]:
    """Of numbers that are given as exact; none unless all are."""
    needed = (bearing.viscosity, bearing.length, bearing.diameter)
    if bearing.clearance is None or bearing.load is None or any(number is None for number in needed):
        return ()
    viscosity, length, diameter = (float(number) for number in needed if number is not None)
    value = viscosity * speed * length * diameter / bearing.load * (diameter / (2 * bearing.clearance)) ** 2
    return (Parameter("sommerfeld", value, "1", derived=True),)

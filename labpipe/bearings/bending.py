"""Bending shaft in series with its bearing: the bearing's share of a measured radial stiffness.

R. J. W. Knaapen (1997), chapter 3: 1/k_total = 1/k_bearing + 1/k_shaft for radial coefficients; tilts and axial ones need no correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.distributions import normal_quantile
from labpipe.errors import ConfigError, FitError
from labpipe.records.settings import Uncertain

NORMAL_95 = normal_quantile(0.975)


@dataclass(frozen=True)
class BendingShaft:
    """A round shaft that bends between two supports, loaded by a bearing: E [Pa], diameter, span [m], density [kg/m^3].

    ends: length that overhangs both supports together [m].
    """

    youngs_modulus: float
    diameter: float
    span: float
    density: float = 7850.0
    ends: float = 0.0

    def __post_init__(self) -> None:
        if not (self.youngs_modulus > 0 and self.diameter > 0 and self.span > 0 and self.density > 0 and self.ends >= 0):
            raise ConfigError("Young's modulus, diameter, span and density of the shaft must be above zero, its ends not below")

    @property
    def rigidity(self) -> float:
        """E I = E pi d^4 / 64 [N m^2]."""
        return self.youngs_modulus * np.pi * self.diameter**4 / 64

    def static_stiffness(self, load_point: float | None = None) -> float:
        """k = 48 E I / (3 l^2 s - 4 s^3) [N/m], the load s from a support, the deflection at mid span; 48 E I / l^3 for mid span.

        *load_point* s in (0, l/2] [m]: the contact angle of an angular-contact bearing moves the load off the middle.
        Equation (roll-bending).
        """
        s = self.span / 2 if load_point is None else load_point
        if not 0 < s <= self.span / 2 * (1 + 1e-12):
            raise ConfigError(f"the load point {s:g} m is not between a support and mid span")
        return 48 * self.rigidity / (3 * self.span**2 * s - 4 * s**3)

    def energy_stiffness(self) -> float:
        """k = int E I y''^2 dx = pi^4 E I / (2 l^3) [N/m] for the first mode y = cos(pi x / l), 1.5 % above the static one.

        Equation (roll-bending-energy).
        """
        return float(np.pi**4 * self.rigidity / (2 * self.span**3))

    def equivalent_mass(self) -> float:
        """m = int rho A y^2 dx = rho A l / 2 [kg] for y = cos(pi x / l), without the ends: mass that moves with mid span.

        Equation (roll-bending-mass).
        """
        return self.density * np.pi * self.diameter**2 / 4 * self.span / 2

    def total_mass(self) -> float:
        """rho A (l + ends) [kg]."""
        return self.density * np.pi * self.diameter**2 / 4 * (self.span + self.ends)


@dataclass(frozen=True)
class SeriesCorrection:
    """A bearing's stiffness without the shaft's bending [N/m], its 95 % interval, and the amplification of the relative error."""

    bearing: Uncertain
    ci95: tuple[float, float]
    amplification: float


def without_shaft(total: Uncertain, shaft: Uncertain) -> SeriesCorrection:
    """k_b = 1 / (1/k_total - 1/k_shaft); s_b/k_b = (k_b/k_total) s_total/k_total combined with (k_b/k_shaft) s_shaft/k_shaft.

    The interval is formed on the compliance, which is nearly linear in the measured stiffness, and inverted: it is wider upwards, and
    open (infinite) where the measurement is compatible with a rigid bearing. Raises FitError for k_total >= k_shaft.
    Equation (roll-series-shaft).
    """
    if not (total.value > 0 and shaft.value > 0):
        raise FitError("a stiffness in series must be above zero", hint="check the fit and the shaft")
    if total.value >= shaft.value:
        raise FitError(
            f"the measured stiffness {total.value:.4g} N/m is not below the shaft's {shaft.value:.4g} N/m",
            hint="two springs in series are softer than either: check the shaft's stiffness",
        )
    compliance = 1 / total.value - 1 / shaft.value
    std_error = float(np.hypot(total.std_error / total.value**2, shaft.std_error / shaft.value**2))
    bearing = 1 / compliance
    least = compliance - NORMAL_95 * std_error
    ci95 = (1 / (compliance + NORMAL_95 * std_error), 1 / least if least > 0 else np.inf)
    return SeriesCorrection(Uncertain(bearing, bearing**2 * std_error), ci95, bearing / total.value)


def damping_without_shaft(damping: Uncertain, total: Uncertain, shaft: Uncertain) -> Uncertain:
    """c_b = c_total (k_b / k_total)^2 [N s/m] for w c << k and a shaft without losses; all three uncertainties to first order.

    The damper is in the bearing, whose motion is k_total / k_b of the measured one: (k_total + j w c_total) in series.
    Equation (roll-series-damping).
    """
    stiffness = without_shaft(total, shaft).bearing.value
    factor = (stiffness / total.value) ** 2
    gap = shaft.value - total.value
    slopes = (factor, 2 * factor * damping.value / gap, 2 * factor * damping.value * total.value / (shaft.value * gap))
    errors = (damping.std_error, total.std_error, shaft.std_error)
    return Uncertain(factor * damping.value, float(np.linalg.norm(np.multiply(slopes, errors))))

"""From estimates to what is reported: derived quantities, the support subtracted, the load shared between equal bearings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import ConfigError
from labpipe.identify.settings import FitSettings, Support
from labpipe.identify.statistics import derived
from labpipe.records.identification import Parameter
from labpipe.records.settings import Uncertain

Vector = NDArray[np.floating]


@dataclass(frozen=True)
class Estimated:
    """Estimates with their joint covariance, by name."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Vector
    covariance: NDArray[np.floating]

    def index(self, name: str) -> int:
        return self.names.index(name)

    def std_error(self, name: str) -> float:
        return float(np.sqrt(self.covariance[self.index(name), self.index(name)]))

    def value(self, name: str) -> float:
        return float(self.values[self.index(name)])


def is_direct(name: str) -> bool:
    """Whether a coefficient acts in the direction of its own motion: k, c, k_xx, c_yy."""
    return name in ("k", "c") or (name[:2] in ("k_", "c_") and len(name) == 4 and name[2] == name[3])


def corrected(total: Estimated, settings: FitSettings) -> Estimated:
    """(total - support) / share for stiffness and damping: k_bearing = (k_total - k_support) / n.

    The support is one and the same for every direct coefficient, so its uncertainty adds fully correlated between them:
    cov = (cov_total + s^2 1 1^T) / n^2.
    """
    if settings.share < 1:
        raise ConfigError("share must be at least 1")
    values, covariance = total.values.copy(), total.covariance.copy()
    support = settings.subtract or Support()
    for kind, amount in (("k", support.stiffness), ("c", support.damping)):
        direct = np.array([is_direct(name) and name.startswith(kind) for name in total.names])
        values = values - np.where(direct, amount.value, 0.0)
        covariance = covariance + np.outer(direct, direct) * amount.std_error**2
    divisor = np.array([float(settings.share) if unit in ("N/m", "N.s/m") else 1.0 for unit in total.units])
    return Estimated(total.names, total.units, values / divisor, covariance / np.outer(divisor, divisor))


def is_corrected(settings: FitSettings) -> bool:
    """Whether the reported coefficients differ from the measured totals."""
    support = settings.subtract or Support()
    return settings.share > 1 or any(amount != Uncertain(0.0) for amount in (support.stiffness, support.damping))


def derived_parameters(total: Estimated, settings: FitSettings, dof: int) -> list[Parameter]:
    """f_n and zeta (sdof), the forcing angle (rotor-2dof with one force), and the totals where support or share changed them."""
    found: list[Parameter] = []
    if settings.model == "sdof":
        found.extend(_resonance(total, settings, dof))
    if "b_x" in total.names and "b_y" in total.names:
        found.append(_forcing_angle(total, dof))
    if is_corrected(settings):
        for name, unit in zip(total.names, total.units, strict=True):
            if unit in ("N/m", "N.s/m"):
                found.append(derived(f"{name}_total", unit, total.value(name), total.std_error(name), dof))
    return found


def _resonance(total: Estimated, settings: FitSettings, dof: int) -> list[Parameter]:
    """f_n = sqrt(k/m) / 2 pi [Hz] and zeta = c / (2 sqrt(k m)) of the measured system; none where k or m is negative or dropped."""
    if "k" not in total.names:
        return []
    k = total.value("k")
    m = total.value("m") if "m" in total.names else float(settings.mass)  # type: ignore[arg-type]
    if k <= 0 or m <= 0:
        return []
    f_n = np.sqrt(k / m) / (2 * np.pi)
    slopes = {"k": f_n / (2 * k), "m": -f_n / (2 * m)}
    found = [derived("f_n", "Hz", float(f_n), propagated(total, slopes), dof)]
    if "c" in total.names:
        c = total.value("c")
        zeta = c / (2 * np.sqrt(k * m))
        slopes = {"c": 1 / (2 * np.sqrt(k * m)), "k": -zeta / (2 * k), "m": -zeta / (2 * m)}
        found.append(derived("zeta", "1", float(zeta), propagated(total, slopes), dof))
    return found


def _forcing_angle(total: Estimated, dof: int) -> Parameter:
    """atan2(b_y, b_x) [rad]."""
    x, y = total.value("b_x"), total.value("b_y")
    square = x**2 + y**2
    return derived("forcing_angle", "rad", float(np.arctan2(y, x)), propagated(total, {"b_x": -y / square, "b_y": x / square}), dof)


def propagated(total: Estimated, slopes: dict[str, float]) -> float:
    """Standard error of a function of the estimates to first order: sqrt(g^T cov g), g its slopes by name."""
    gradient = np.array([slopes.get(name, 0.0) for name in total.names])
    return float(np.sqrt(max(gradient @ total.covariance @ gradient, 0.0)))

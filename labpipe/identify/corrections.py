"""Corrections of estimates: the support subtracted, the load shared between equal bearings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.identify.settings import FitSettings, Support
from labpipe.records.settings import Uncertain


@dataclass(frozen=True)
class Estimated:
    """Estimates (n_parameter,) with their joint covariance (n_parameter, n_parameter), by name, in *units* [SI]."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray

    def index(self, name: str) -> int:
        return self.names.index(name)

    def std_error(self, name: str) -> float:
        return float(np.sqrt(self.covariance[self.index(name), self.index(name)]))

    def value(self, name: str) -> float:
        return float(self.values[self.index(name)])


def is_direct(name: str) -> bool:
    """True for a coefficient in the direction of its own motion: k, c, m, k_xx, c_yy, k_1_1, m_2_2."""
    letter, _, place = name.partition("_")
    if letter not in ("k", "c", "m"):
        return False
    half = (len(place) - 1) // 2 if "_" in place else len(place) // 2
    return not place or place[:half] == place[-half:]


def corrected(total: Estimated, settings: FitSettings) -> Estimated:
    """(total - support) / share for stiffness and damping: k_bearing = (k_total - k_support) / n.

    The covariance is that of the estimates; the doubt of the support is a source of its own, common to all direct coefficients and to all
    tests. ConfigError for a share below 1. Equation (est-corrected).
    """
    if settings.share < 1:
        raise ConfigError("share must be at least 1")
    values = total.values.copy()
    support = settings.subtract or Support()
    for kind, amount in (("k", support.stiffness), ("c", support.damping)):
        direct = np.array([is_direct(name) and name.startswith(kind) for name in total.names])
        values = values - np.where(direct, amount.value, 0.0)
    divisor = np.array([float(settings.share) if unit in ("N/m", "N.s/m") else 1.0 for unit in total.units])
    return Estimated(total.names, total.units, values / divisor, total.covariance / np.outer(divisor, divisor))


def is_corrected(settings: FitSettings) -> bool:
    """True if the reported coefficients differ from the measured totals."""
    support = settings.subtract or Support()
    return settings.share > 1 or any(amount != Uncertain(0.0) for amount in (support.stiffness, support.damping))

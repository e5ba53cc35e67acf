"""Results of comparisons as parameters with standard error and interval."""

from __future__ import annotations

import math

from labpipe.records.identification import Parameter


def with_error(name: str, unit: str, value: float, std_error: float, quantile: float) -> Parameter:
    """value +- quantile standard errors."""
    reach = quantile * std_error
    ratio = value / std_error if std_error > 0 else None
    return Parameter(
        name, value, unit, std_error=std_error, t_ratio=ratio, ci95=(value - reach, value + reach), significant=abs(value) > reach
    )


def from_log(name: str, unit: str, log: float, log_error: float, quantile: float) -> Parameter:
    """exp(log) with the interval exp(log +- quantile log_error), wider upwards; its standard error to first order. Equation (comp-log)."""
    value = math.exp(log)
    interval = (math.exp(log - quantile * log_error), math.exp(log + quantile * log_error))
    return Parameter(name, value, unit, std_error=value * log_error, ci95=interval)


def relative_change(name: str, log: float, log_error: float, quantile: float) -> Parameter:
    """exp(log) - 1 with its interval: a relative difference."""
    factor = from_log(name, "1", log, log_error, quantile)
    assert factor.ci95 is not None
    low, high = factor.ci95
    return Parameter(name, factor.value - 1, "1", std_error=factor.std_error, ci95=(low - 1, high - 1), significant=not low <= 1 <= high)


def chance(name: str, p_value: float | None) -> Parameter:
    """A p-value; NaN where no test was possible."""
    return Parameter(name, math.nan if p_value is None else p_value, "1", derived=True)

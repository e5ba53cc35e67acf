"""Repeats of one coefficient at one point: their mean, with what repeating makes smaller and what it does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.campaign.weighted import weighted_mean
from labpipe.distributions import normal_quantile, student_quantile
from labpipe.records.condition_matrix import Repeated
from labpipe.records.parameter import Parameter


def repeated(parameters: Sequence[Parameter]) -> Repeated:
    """The mean of parameters of one name and unit, weighted by their standard errors.

    Standard error: s^2 = s_mean^2 + u^2. s_mean is that of the weighted mean of the errors by noise, enlarged where the repeats scatter
    more than these say; u, the mean of what stands in the full errors beyond noise, is common to all repeats and does not shrink.
    Where a repeat has no error, the plain mean with the standard error of the repeats' scatter, or none for one repeat.
    Equation (comp-repeats).
    """
    values = np.array([parameter.value for parameter in parameters])
    scatter = float(np.std(values, ddof=1)) if values.size > 1 else None
    if values.size == 1:
        return Repeated(parameters[0], 1)
    errors = np.array([np.nan if parameter.std_error is None else parameter.std_error for parameter in parameters])
    if not np.all(errors > 0):
        return Repeated(_of_scatter(parameters[0], float(np.mean(values)), scatter or 0.0, values.size), values.size, scatter=scatter)
    mean = weighted_mean(values, errors)
    full = np.array([parameter.full_error or 0.0 for parameter in parameters])
    common = float(np.mean(np.sqrt(np.maximum(full**2 - errors**2, 0.0))))
    noise = mean.std_error(0)
    whole = float(np.hypot(noise, common))
    # Student's quantile belongs to the part that was estimated from the scatter.
    reach = float(np.hypot(mean.quantile * noise, normal_quantile(0.975) * common))
    parameter = _parameter(parameters[0], float(mean.values[0]), noise, whole, reach)
    return Repeated(parameter, values.size, scatter=scatter, p_value=mean.p_value)


def _of_scatter(like: Parameter, value: float, scatter: float, number: int) -> Parameter:
    error = scatter / np.sqrt(number)
    if not error > 0:
        return replace(like, value=value, std_error=None, std_error_inflated=None, ci95=None, t_ratio=None, significant=None)
    return _parameter(like, value, float(error), float(error), float(student_quantile(0.975, number - 1) * error))


def _parameter(like: Parameter, value: float, noise: float, whole: float, reach: float) -> Parameter:
    return Parameter(
        like.name,
        value,
        like.unit,
        std_error=noise,
        t_ratio=value / whole,
        ci95=(value - reach, value + reach),
        significant=abs(value) > reach,
        derived=like.derived,
        std_error_inflated=whole if whole > noise else None,
    )

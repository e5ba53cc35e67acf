"""Posterior of a healthy rig's tuning, the prior of the wear fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.errors import ConfigError
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.registry import nearest
from labpipe.wear.settings import ANGLE, DEPTH, NUISANCES, Gaussian, WearSettings

# Standard error of a parameter at its bound, relative to its value.
LEAST_SHARE = 1e-3


def with_prior(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    """Settings with the posterior of the earlier fit that `prior` names; unchanged without `prior`. ConfigError if there is no such fit."""
    wear: WearSettings = settings.model_settings
    if not wear.prior:
        return settings
    for fit in fits:
        if fit.name == wear.prior:
            return replace(settings, model_settings=replace(wear, posterior=posterior(fit, wear.same_wear)))
    hint = nearest(wear.prior, [fit.name for fit in fits])
    raise ConfigError(f"wear.prior: no earlier fit '{wear.prior}'", hint=f"fits are made in their order; {hint}")


def posterior(fit: Fit, same_wear: bool = False) -> Gaussian:
    """Mean and covariance of the tuned parameters of a fit, [SI units]; of depth and angle as well where it was of the *same_wear*.

    Standard errors are taken as inflated where the residual exceeds the noise; ConfigError where the fit tuned nothing.
    """
    estimated = [parameter for parameter in fit.parameters if not parameter.derived]
    carried = (DEPTH, ANGLE, *NUISANCES) if same_wear else tuple(NUISANCES)
    numbers = [number for number, parameter in enumerate(estimated) if parameter.name in carried]
    if same_wear and not all(any(p.name == name and p.std_error for p in estimated) for name in (DEPTH, ANGLE)):
        what = f"wear.same_wear: the fit '{fit.name}' gives no depth and angle with standard errors"
        raise ConfigError(what, hint="begin with the test that tells both best")
    if not numbers:
        hint = "give it wear: {healthy: true, ...}"
        raise ConfigError(f"wear.prior: the fit '{fit.name}' tuned none of {', '.join(NUISANCES)}", hint=hint)
    chosen = [estimated[number] for number in numbers]
    errors = [parameter.std_error_inflated or parameter.std_error or LEAST_SHARE * max(abs(parameter.value), 1e-12) for parameter in chosen]
    covariance = fit.correlation[np.ix_(numbers, numbers)] * np.outer(errors, errors)
    rows = tuple(tuple(row) for row in covariance.tolist())
    return Gaussian(tuple(parameter.name for parameter in chosen), tuple(parameter.value for parameter in chosen), rows)

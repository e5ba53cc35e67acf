"""What the tuning of a healthy rig leaves known for the wear fit: the joint posterior of its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.errors import ConfigError
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.registry import nearest
from labpipe.wear.settings import NUISANCES, Gaussian, WearSettings

# A parameter that ended at its bound is known no better than this part of its value.
LEAST_SHARE = 1e-3


def with_prior(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    """The settings of a fit with what its `prior` found, an earlier fit; unchanged without one. ConfigError when there is none."""
    wear: WearSettings = settings.model_settings
    if not wear.prior:
        return settings
    for fit in fits:
        if fit.name == wear.prior:
            return replace(settings, model_settings=replace(wear, posterior=posterior(fit)))
    hint = nearest(wear.prior, [fit.name for fit in fits])
    raise ConfigError(f"wear.prior: no earlier fit '{wear.prior}'", hint=f"fits are made in their order; {hint}")


def posterior(fit: Fit) -> Gaussian:
    """Mean and covariance of the tuned parameters of a fit, [SI units].

    Standard errors are taken as inflated where the residual exceeds the noise; ConfigError where the fit tuned nothing.
    """
    estimated = [parameter for parameter in fit.parameters if not parameter.derived]
    numbers = [number for number, parameter in enumerate(estimated) if parameter.name in NUISANCES]
    if not numbers:
        hint = "give it wear: {healthy: true, ...}"
        raise ConfigError(f"wear.prior: the fit '{fit.name}' tuned none of {', '.join(NUISANCES)}", hint=hint)
    chosen = [estimated[number] for number in numbers]
    errors = [one.std_error_inflated or one.std_error or LEAST_SHARE * max(abs(one.value), 1e-12) for one in chosen]
    covariance = fit.correlation[np.ix_(numbers, numbers)] * np.outer(errors, errors)
    rows = tuple(tuple(row) for row in covariance.tolist())
    return Gaussian(tuple(one.name for one in chosen), tuple(one.value for one in chosen), rows)

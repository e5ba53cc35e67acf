"""Logarithmic decrements of the modes of a fit (an FRF's modal model, a ring-down, one degree of freedom) against a limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.campaign.amounts import with_error
from labpipe.campaign.certificate_settings import CertificateSettings
from labpipe.campaign.limits import Limit, below, verdict_of, words
from labpipe.campaign.settings import CompareSettings
from labpipe.distributions import normal_quantile
from labpipe.errors import ConfigError
from labpipe.records.comparison import Comparison
from labpipe.records.identification import Fit, Parameter

RATIO, DECREMENT = "zeta", "log_decrement"


def decrement_certificate(settings: CompareSettings, fits: Sequence[Fit]) -> Comparison:
    """The probability that every mode of the fits has its decrement; ConfigError for fits without damping ratios.

    Equation (comp-decrement).
    """
    certificate_settings = settings.certificate or CertificateSettings()
    amounts = [amount for fit in fits for amount in _decrements(fit, len(fits) > 1)]
    if not amounts:
        hint = "a fit of model modal, decay, or sdof"
        raise ConfigError(f"fit '{settings.fit}' has no damping ratio with a standard error", hint=hint)
    limits = [_limit(certificate_settings, amounts)]
    verdict = verdict_of(limits, certificate_settings.confidence)
    probability = Parameter(f"probability_{DECREMENT}", limits[0].probability, "1", derived=True)
    return Comparison(
        name=settings.name,
        kind="certificate",
        subject=f"logarithmic decrements of {settings.fit}",
        unit="1",
        points=(),
        amounts=(*amounts, probability),
        verdict=verdict,
        statement=f"{verdict.capitalize()}: {limits[0].sentence}.",
    )


def _decrements(fit: Fit, several: bool) -> list[Parameter]:
    """2 pi z / sqrt(1 - z^2) of every damping ratio with its interval, ends by the ends of z; or the decrement that the fit has."""
    given = [parameter for parameter in fit.parameters if parameter.name.startswith(DECREMENT)]
    decrements = given or [_of_ratio(parameter) for parameter in fit.parameters if parameter.name.partition("_")[0] == RATIO]
    suffix = f"_{fit.test}" if several and fit.test else ""
    return [replace(parameter, name=parameter.name + suffix) for parameter in decrements if parameter.full_error is not None]


def _of_ratio(ratio: Parameter) -> Parameter:
    name = DECREMENT + ratio.name.removeprefix(RATIO)
    if ratio.full_error is None or not abs(ratio.value) < 1:
        return Parameter(name, np.nan, "1")
    value, slope = 2 * np.pi * ratio.value / np.sqrt(1 - ratio.value**2), 2 * np.pi / (1 - ratio.value**2) ** 1.5
    plain = with_error(name, "1", float(value), float(slope) * ratio.full_error, normal_quantile(0.975))
    if ratio.ci95 is None or max(abs(end) for end in ratio.ci95) >= 1:
        return plain
    low, high = (float(2 * np.pi * end / np.sqrt(1 - end**2)) for end in ratio.ci95)
    return replace(plain, ci95=(low, high))


def _limit(own: CertificateSettings, amounts: Sequence[Parameter]) -> Limit:
    least = min(amounts, key=lambda amount: amount.value)
    probability = min(below(-amount.value, amount.full_error or 0.0, -own.log_decrement) for amount in amounts)
    said = f"log decrement {least.value:.3g} ({least.name}) is the least; above {own.log_decrement:g} with {words(probability)}"
    return Limit(DECREMENT, probability, said)

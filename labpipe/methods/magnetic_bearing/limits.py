"""Settings of a certificate, its limits of acceptance with the probability that each is kept, and logarithmic decrements against them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.distributions import normal_quantile, normal_tail
from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.stability import INPUT, OUTPUT
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.settings import Settings, setting
from labpipe.uncertainty.amounts import with_error
from labpipe.uncertainty.settings import CompareSettings

# The section `certificate:` of a comparison of that kind.

# Zones that a peak of the sensitivity may have to lie in; D has no upper end.
ZONE_NAMES = ("A", "B", "C")


@dataclass(frozen=True, kw_only=True)
class CertificateSettings(Settings):
    """What was recorded of the loop, how it is sampled, and the limits of acceptance."""

    before: tuple[str, ...] = setting("names", "responses ahead of the sums at which excitations are added, one per loop", default=())
    after: tuple[str, ...] = setting("names", "responses behind those sums, one per loop", default=())
    output: str = setting("text", "response that is the command behind the controller, [V]", default="")
    displacement: str = setting("text", "response that is the reading of the probe", default="")
    current: str = setting("text", "response that is the current", default="")
    injection: str = setting("choice", "where the excitation is added: the controller's side", choices=(INPUT, OUTPUT), default=INPUT)
    rate: float | None = setting("value", "sampling rate of the controller; default: that of discrete blocks", unit="Hz", default=None)
    filtered: bool = setting("flag", "current and displacement were recorded through a filter against aliasing", default=False)
    log_decrement: float = setting("value", "least logarithmic decrement of every mode", unit="1", default=0.1)
    zone: str = setting("choice", "worst zone of ISO 14839-3", choices=ZONE_NAMES, default="B")
    confidence: float = setting("value", "probability from which a limit counts as kept, or as broken", unit="1", default=0.95)

    def __post_init__(self) -> None:
        if not 0.5 < self.confidence < 1:
            raise ConfigError("'confidence' must lie between 50 and 100 %", field="confidence")
        if not self.log_decrement > 0:
            raise ConfigError("'log_decrement' must be above zero", field="log_decrement")
        if self.rate is not None and not self.rate > 0:
            raise ConfigError("'rate' must be above zero", field="rate")
        if self.before and len(self.before) != len(self.after):
            raise ConfigError(f"{len(self.before)} points ahead of a sum and {len(self.after)} behind", hint="one per loop", field="before")

    @property
    def recorded(self) -> tuple[str, ...]:
        """The responses that it names."""
        return tuple(name for name in (*self.before, *self.after, self.output, self.displacement, self.current) if name)


# Limits of acceptance, each with the probability that it is kept, and the verdict on all of them.

KEPT, BROKEN, UNDECIDED = "accepted", "not accepted", "undecided"


@dataclass(frozen=True)
class Limit:
    """A limit of acceptance: its *name*, the probability that it is kept, and the sentence that says so."""

    name: str
    probability: float
    sentence: str


def below(value: float, error: float, limit: float) -> float:
    """Probability that the truth of a normal estimate lies below a limit. Equation (mag-limit)."""
    if error <= 0:
        return float(value < limit)
    distance = abs(limit - value) / error
    return 1 - normal_tail(distance) if value <= limit else normal_tail(distance)


def words(probability: float) -> str:
    """A probability as people read it."""
    return "over 99.9 %" if probability > 0.999 else "under 0.1 %" if probability < 0.001 else f"{100 * probability:.3g} %"


def verdict_of(limits: Sequence[Limit], confidence: float) -> str:
    """Accepted where all limits are kept with that confidence, not accepted where one is broken with it."""
    if any(limit.probability < 1 - confidence for limit in limits):
        return BROKEN
    return KEPT if all(limit.probability >= confidence for limit in limits) else UNDECIDED


# Logarithmic decrements of the modes of a fit (an FRF's modal model, a ring-down, one degree of freedom)
# against a limit.

RATIO, DECREMENT = "zeta", "log_decrement"


def decrement_certificate(settings: CompareSettings, fits: Sequence[Fit]) -> Comparison:
    """The probability that every mode of the fits has its decrement; ConfigError for fits without damping ratios.

    Equation (comp-decrement).
    """
    certificate_settings: CertificateSettings = settings.kind_settings
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

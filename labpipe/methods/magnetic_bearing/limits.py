"""Settings of a certificate, its limits of acceptance with the probability that each is kept, and logarithmic
decrements against them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.distributions import normal_quantile, normal_tail
from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.stability import INPUT, OUTPUT
from labpipe.records.comparison import Comparison
from labpipe.records.finding import WARNING, Parameter, of_level
from labpipe.records.identification import Fit
from labpipe.records.settings import Settings, quantity, setting
from labpipe.uncertainty.amounts import with_error
from labpipe.uncertainty.settings import CompareSettings

# Zones that a peak of the sensitivity may have to lie in; D has no upper end.
ZONE_NAMES = ("A", "B", "C")
LEAST_DECREMENT = 0.1


@dataclass(frozen=True, kw_only=True)
class CertificateSettings(Settings):
    """What was recorded of the loop, how it is sampled, and the limits of acceptance."""

    before: tuple[str, ...] = setting(
        "names", "responses ahead of the sums at which excitations are added, one per loop", default=()
    )
    after: tuple[str, ...] = setting("names", "responses behind those sums, one per loop", default=())
    test: str = setting("text", "test whose loop it is, where the pipeline has several", default="")
    output: str = setting("text", "response that is the command behind the controller, [V]", default="")
    displacement: str = setting("text", "response that is the reading of the probe", default="")
    current: str = setting("text", "response that is the current", default="")
    injection: str = setting(
        "choice",
        "where the excitation is added: the controller's side",
        choices=(INPUT, OUTPUT),
        default=INPUT,
    )
    rate: float | None = quantity(
        "sampling rate of the controller; default: that of discrete blocks", "Hz", None
    )
    filtered: bool = setting(
        "flag", "current and displacement were recorded through a filter against aliasing", default=False
    )
    log_decrement: float | None = quantity(
        "least logarithmic decrement of every mode; default: 0.1 with a model or a fit, else none", "1", None
    )
    zone: str = setting("choice", "worst zone of ISO 14839-3", choices=ZONE_NAMES, default="B")
    confidence: float = quantity("probability from which a limit counts as kept, or as broken", "1", 0.95)

    def __post_init__(self) -> None:
        if not 0.5 < self.confidence < 1:
            raise ConfigError("'confidence' must lie between 50 and 100 %", field="confidence")
        if self.log_decrement is not None and not self.log_decrement > 0:
            raise ConfigError("'log_decrement' must be above zero", field="log_decrement")
        if self.rate is not None and not self.rate > 0:
            raise ConfigError("'rate' must be above zero", field="rate")
        if self.before and len(self.before) != len(self.after):
            raise ConfigError(
                f"{len(self.before)} points ahead of a sum and {len(self.after)} behind",
                hint="one per loop",
                field="before",
            )

    @property
    def least_decrement(self) -> float:
        """The least logarithmic decrement [1]."""
        return LEAST_DECREMENT if self.log_decrement is None else self.log_decrement

    @property
    def recorded(self) -> tuple[str, ...]:
        """The responses that it names."""
        return tuple(
            name for name in (*self.before, *self.after, self.output, self.displacement, self.current) if name
        )


# Limits of acceptance, each with the probability that it is kept, and the verdict on all of them.

KEPT, BROKEN, UNDECIDED = "accepted", "not accepted", "undecided"


@dataclass(frozen=True)
class Limit:
    """A limit of acceptance: its *name*, the probability that it is kept, and the sentence that says so.

    Without a probability it could not be judged, and *why* says the reason.
    """

    name: str
    probability: float | None
    sentence: str
    why: str = ""


def below(value: float, error: float, limit: float) -> float:
    """Probability that the truth of a normal estimate lies below a limit. Equation (mag-limit)."""
    if error <= 0:
        return float(value < limit)
    distance = abs(limit - value) / error
    return 1 - normal_tail(distance) if value <= limit else normal_tail(distance)


def words(probability: float) -> str:
    """A probability as people read it."""
    return (
        "over 99.9 %"
        if probability > 0.999
        else "under 0.1 %"
        if probability < 0.001
        else f"{100 * probability:.3g} %"
    )


def verdict_of(limits: Sequence[Limit], confidence: float) -> str:
    """Accepted where all limits are kept with that confidence, not accepted where one is broken with it, else
    undecided.
    """
    judged = [limit.probability for limit in limits if limit.probability is not None]
    if any(probability < 1 - confidence for probability in judged):
        return BROKEN
    kept = len(judged) == len(limits) > 0 and all(probability >= confidence for probability in judged)
    return KEPT if kept else UNDECIDED


def probabilities(limits: Sequence[Limit]) -> list[Parameter]:
    """The probability that each limit is kept, of those that were judged."""
    judged = ((limit.name, limit.probability) for limit in limits if limit.probability is not None)
    return [Parameter(f"probability_{name}", probability, "1", derived=True) for name, probability in judged]


def undecided(limits: Sequence[Limit]) -> list[tuple[str, str]]:
    """The probabilities that are not known, and the verdict that rests on them, with the reason."""
    unjudged = [limit for limit in limits if limit.probability is None]
    reasons = "; ".join(dict.fromkeys(limit.why for limit in unjudged))
    return [
        *((f"probability_{limit.name}", limit.why) for limit in unjudged),
        *([("verdict", reasons)] if reasons else []),
    ]


# Logarithmic decrements of the modes of a fit (an FRF's modal model.

RATIO, DECREMENT = "zeta", "log_decrement"


def decrement_certificate(settings: CompareSettings, fits: Sequence[Fit]) -> Comparison:
    """The probability that every mode of the fits has its decrement; ConfigError for fits without damping
    ratios.

    Equation (comp-decrement).
    """
    certificate_settings: CertificateSettings = settings.kind_settings
    several = len(fits) > 1
    amounts = [amount for fit in fits for amount in _decrements(fit, several)]
    if not amounts:
        hint = "a fit of model modal, decay, or sdof"
        raise ConfigError(f"fit '{settings.fit}' has no damping ratio", hint=hint)
    limits = [
        _limit(
            certificate_settings,
            amounts,
            "; ".join(filter(None, (_why_undecided(fit, several) for fit in fits))),
        )
    ]
    verdict = verdict_of(limits, certificate_settings.confidence)
    return Comparison(
        name=settings.name,
        kind="certificate",
        subject=f"logarithmic decrements of {settings.fit}",
        unit="1",
        points=(),
        amounts=(*amounts, *probabilities(limits)),
        verdict=verdict,
        statement=f"{verdict.capitalize()}: {limits[0].sentence}.",
        undecided=tuple(undecided(limits)),
    )


# Warnings of a fit with which its decrements decide nothing.
REJECTING = ("feedback", "no-convergence", "model-mismatch")


def _why_undecided(fit: Fit, several: bool) -> str:
    """Why the decrements of a fit decide nothing."""
    of_test = f" of test '{fit.test}'" if several and fit.test else ""
    codes = list(
        dict.fromkeys(
            finding.code for finding in of_level(WARNING, fit.findings) if finding.code in REJECTING
        )
    )
    if codes or not fit.converged:
        return f"the fit{of_test} is rejected ({', '.join(codes) or 'no-convergence'})"
    plain = [
        amount.name
        for amount in _decrements(fit, several)
        if amount.full_error is None and np.isfinite(amount.value)
    ]
    return f"{', '.join(plain)} has no standard error" if plain else ""


def _decrements(fit: Fit, several: bool) -> list[Parameter]:
    """2 pi z / sqrt(1 - z^2) of every damping ratio with its interval, ends by the ends of z.

    Or the decrement that the fit has.
    """
    given = [parameter for parameter in fit.parameters if parameter.name.startswith(DECREMENT)]
    decrements = given or [
        _of_ratio(parameter) for parameter in fit.parameters if parameter.name.partition("_")[0] == RATIO
    ]
    suffix = f"_{fit.test}" if several and fit.test else ""
    return [replace(parameter, name=parameter.name + suffix) for parameter in decrements]


def _of_ratio(ratio: Parameter) -> Parameter:
    """The decrement of a damping ratio; infinite to either side of a mode that does not swing, |z| >= 1."""
    name = DECREMENT + ratio.name.removeprefix(RATIO)
    if not abs(ratio.value) < 1:
        return Parameter(name, float(np.copysign(np.inf, ratio.value)), "1", derived=True)
    value, slope = (
        2 * np.pi * ratio.value / np.sqrt(1 - ratio.value**2),
        2 * np.pi / (1 - ratio.value**2) ** 1.5,
    )
    if ratio.full_error is None:
        return Parameter(name, float(value), "1", derived=True)
    plain = with_error(name, "1", float(value), float(slope) * ratio.full_error, normal_quantile(0.975))
    if ratio.ci95 is None or max(abs(end) for end in ratio.ci95) >= 1:
        return plain
    low, high = (float(2 * np.pi * end / np.sqrt(1 - end**2)) for end in ratio.ci95)
    return replace(plain, ci95=(low, high))


def _limit(own: CertificateSettings, amounts: Sequence[Parameter], why: str) -> Limit:
    least = min(amounts, key=lambda amount: amount.value)
    said = f"log decrement {least.value:.3g} ({least.name}) is the least; above {own.least_decrement:g}"
    if why:
        return Limit(DECREMENT, None, f"{said} not judged, since {why}", why)
    probability = min(
        below(-amount.value, amount.full_error or 0.0, -own.least_decrement) for amount in amounts
    )
    return Limit(DECREMENT, probability, f"{said} with {words(probability)}")

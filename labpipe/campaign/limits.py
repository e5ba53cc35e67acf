"""Limits of acceptance, each with the probability that it is kept, and the verdict on all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from labpipe.distributions import normal_tail

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

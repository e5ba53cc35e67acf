"""Predicted uncertainty budgets: a planned test rehearsed, and what systematic sources add to its noise.

Channel c has in period p of P, beside its signal, a_c exp(2 pi j c p / P) on every line. Over the periods
these have the mean zero and are orthogonal to each other, so that the average is what the rig does, and its
covariance by the scatter, a_c^2 / (P - 1), that of white noise in every sensor.

The changes of the coefficients by one standard uncertainty of every source, c, come from the budget of the
fit that will evaluate the test. Where an earlier result counts beside it, with information I_0 and changes
c_0 of its own, they are (I_0 + I)^-1 (I_0 c_0 + I c).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.display import difference_in, shown_unit
from labpipe.distributions import coverage_factor
from labpipe.errors import ConfigError
from labpipe.methods.planning.campaigns import Campaign, Multisines, Rig
from labpipe.methods.planning.expectation import Earlier
from labpipe.methods.planning.model import PlannedModel
from labpipe.methods.planning.records import PlannedCoefficient
from labpipe.methods.planning.settings import EXPANDED, PlanSettings
from labpipe.records.finding import Contribution
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.uncertain import Budget, Uncertainty
from labpipe.registry import nearest

# Periods beyond the number of channels: degrees of freedom of their covariance.
SPARE = 4
# Samples per period over the highest line.
SAMPLES = 2.6


def rehearsed(
    rig: Rig, test: Multisines, channels: Sequence[Channel], seconds: float, skip: int, highest: int
) -> Recording:
    """The recording of *test* by *channels*, its noise that of an average over *seconds* [s], after *skip*
    periods that are dropped.

    highest: line of all tests, which have one sampling rate. ConfigError for a response whose noise the plan
    does not state.
    """
    density = {
        "force": rig.noise.force,
        "displacement": rig.noise.displacement,
        "acceleration": rig.noise.acceleration,
    }
    mean = np.stack([_amplitudes(rig, test, channel) for channel in channels], axis=1)
    n_period, n_channel = len(channels) + SPARE, len(channels)
    n_sample = fft.next_fast_len(int(SAMPLES * highest) + 8, real=True)
    size = np.array([density[channel.quantity] for channel in channels]) * np.sqrt(
        2 / seconds * (n_period - 1)
    )
    number = np.arange(1, n_channel + 1)
    periods = []
    for period in range(n_period):
        spectrum = np.zeros((n_sample // 2 + 1, n_channel), complex)
        spectrum[test.lines] = mean
        spectrum[1 : (n_sample + 1) // 2] += size * np.exp(2j * np.pi * number * period / n_period)
        periods.append(fft.irfft(spectrum * (n_sample / 2), n_sample, axis=0))
    return Recording(
        tuple(channels), np.concatenate([periods[0]] * skip + periods), n_sample * rig.spacing, test.name
    )


def _amplitudes(rig: Rig, test: Multisines, channel: Channel) -> ComplexArray:
    """Of what a channel measures, (n_line,) [SI]."""
    if channel.quantity == "force":
        shaker = rig.shakers.index(channel.dof) if channel.dof in rig.shakers else 0
        return np.asarray(test.forces[:, shaker])
    along = rig.motion(test) @ _direction(channel, rig.model.n_dof)
    if channel.quantity == "displacement":
        return np.asarray(along)
    if channel.quantity == "acceleration":
        return np.asarray(-(rig.omega(test) ** 2) * along)
    raise ConfigError(
        f"the plan states no noise of {channel.name}, a {channel.quantity}",
        hint="displacement or acceleration",
        field="rig",
    )


def _direction(channel: Channel, n_dof: int) -> ComplexArray:
    if n_dof == 1:
        return np.ones(1, complex)
    angle = AXIS_ANGLES[channel.dof] if channel.angle is None else channel.angle
    return np.array([np.cos(angle), np.sin(angle)], complex)


COVERAGE = 0.95
# Share of the variance that is systematic from which on longer measuring hardly helps: less than a tenth of
# the combined uncertainty.
LASTING = 0.81
# Share of the variance that a goal leaves to noise, at least, where a source is to be calibrated for it.
FOR_NOISE = 0.1

# From tests with their whole periods to the budget of their evaluation; None where nothing is uncertain.
Rehearse = Callable[[Rig, Sequence[Multisines], Sequence[int]], Budget | None]


@dataclass(frozen=True)
class Goals:
    """Relative standard errors by noise and relative expanded uncertainties that are wanted, (n_coefficient,)
    [1] each; infinite: none.
    """

    random: FloatArray
    expanded: FloatArray

    @property
    def any(self) -> bool:
        return bool(np.any(np.isfinite(self.random) | np.isfinite(self.expanded)))


def goals_of(settings: PlanSettings, model: PlannedModel) -> Goals:
    """Those of the settings; ConfigError for a coefficient that the model does not have."""
    goals = {kind: np.full(len(model.names), np.inf) for kind in (False, True)}
    for name, (value,) in settings.goal:
        coefficient = name.removesuffix(EXPANDED)
        if coefficient not in model.names:
            raise ConfigError(
                f"the model has no coefficient {coefficient}",
                hint=nearest(coefficient, model.names),
                field="goal",
            )
        goals[name.endswith(EXPANDED)][model.names.index(coefficient)] = value
    return Goals(goals[False], goals[True])


def limits(goals: Goals, budget: Budget | None, scales: FloatArray) -> FloatArray:
    """Relative standard errors by noise (n_coefficient,) [1] that meet all goals beside the systematic part;
    zero where none does.

    scales (n_coefficient,) [units of the coefficients]: what errors are relative to. Equation (plan-limits).
    """
    if not goals.any:
        return np.ones(len(scales))
    systematic = np.zeros(len(scales)) if budget is None else budget.systematic / scales
    allowed = goals.expanded / factors(budget, len(scales))
    with np.errstate(invalid="ignore"):
        left = np.where(np.isfinite(allowed), np.sqrt(np.maximum(allowed**2 - systematic**2, 0.0)), np.inf)
    return np.asarray(np.minimum(goals.random, left))


def factors(budget: Budget | None, n: int) -> FloatArray:
    """Coverage factors (n_coefficient,) [1] by the effective degrees of freedom.

    *n* of the normal distribution without a budget.
    """
    if budget is None:
        return np.full(n, coverage_factor(COVERAGE, float("inf")))
    return np.array([coverage_factor(COVERAGE, float(dof)) for dof in budget.dof])


def aims(allowed: FloatArray, goals: Goals) -> FloatArray:
    """What a design aims at (n_coefficient,) [1]: the limits, or where none meets the goal a tenth of it, so
    that noise adds little.
    """
    return np.asarray(np.where(allowed > 0, allowed, goals.expanded / 10))


def predicted(budget: Budget, random: FloatArray) -> Budget:
    """The budget with the predicted standard uncertainties by noise (n_coefficient,) [units of the
    coefficients].
    """
    return replace(budget, random=random, drawn=None)


def beside_earlier(
    budget: Budget, earlier: Earlier, campaign: Campaign, model: PlannedModel, duration: float
) -> Budget:
    """The budget of a test of *duration* [s] and the earlier result together. Equation (plan-beside)."""
    assert campaign.known is not None
    information, scales = campaign.rate * duration, model.scales
    weight = np.linalg.inv(information + campaign.known.information)
    places = earlier.places(model)
    changes = []
    for source, change in zip(budget.sources, budget.changes, strict=True):
        pulled = information @ (change / scales)
        if source.source in earlier.sources:
            before = np.zeros(len(scales))
            for there, here in places:
                before[there] = earlier.changes[earlier.sources.index(source.source), here]
            pulled = pulled + campaign.known.information @ (before / scales)
        changes.append(scales * (weight @ pulled))
    return replace(budget, changes=np.array(changes))


def with_uncertainty(
    coefficients: Sequence[PlannedCoefficient], budget: Budget
) -> tuple[PlannedCoefficient, ...]:
    """The coefficients with systematic, combined and expanded uncertainty, relative to their scales, and the
    share of every source.
    """
    columns = zip(
        coefficients, budget.systematic, budget.combined, factors(budget, len(coefficients)), strict=True
    )
    return tuple(
        replace(
            c,
            systematic=float(systematic / c.scale),
            combined=float(combined / c.scale),
            coverage_factor=float(factor),
            expanded=float(factor * combined / c.scale),
            budget=tuple(
                Contribution(source, float(np.sqrt(share) * combined / c.scale), share)
                for source, share in budget.shares(c.name).items()
            ),
        )
        for c, systematic, combined, factor in columns
    )


def lasting_notes(coefficients: Sequence[PlannedCoefficient]) -> Iterator[str]:
    """Where longer measuring hardly helps, and which source it is."""
    by_source: dict[str, list[str]] = {}
    for c in coefficients:
        if c.systematic is not None and c.combined and (c.systematic / c.combined) ** 2 > LASTING:
            largest = max((part for part in c.budget if part.source != "noise"), key=lambda part: part.share)
            by_source.setdefault(largest.source, []).append(f"{c.name} ({100 * largest.share:.0f} %)")
    for source, names in by_source.items():
        yield (
            f"Longer measuring hardly helps {', '.join(names)}: the share in brackets of the variance is "
            f"that of {source}."
        )


def unreachable(goals: Goals, allowed: FloatArray) -> BoolArray:
    """Coefficients (n_coefficient,) whose goal no time meets; *allowed* (n_coefficient,) [1]: as of
    `limits`.
    """
    return np.asarray(np.isfinite(goals.expanded) & (allowed <= 0))


def calibration_notes(goals: Goals, budget: Budget, random: FloatArray, scales: FloatArray) -> Iterator[str]:
    """For every goal that no time meets, which source must be known how well.

    *random* (n_coefficient,) [units] of the planned test.
    """
    allowed = scales * goals.expanded / factors(budget, len(scales))
    for number in np.flatnonzero(unreachable(goals, limits(goals, budget, scales))):
        name, changes = budget.names[number], np.abs(budget.changes[:, number])
        noise = min(random[number] ** 2, (1 - FOR_NOISE) * allowed[number] ** 2)
        left = float(max(allowed[number] ** 2 - noise, FOR_NOISE * allowed[number] ** 2))
        largest = int(changes.argmax())
        rest = left - float(np.sum(np.delete(changes, largest) ** 2))
        what = f"{name} to {100 * goals.expanded[number]:.2g} % expanded is not met however long one measures"
        if rest > 0:
            source = budget.sources[largest]
            share = float(np.sqrt(rest)) / changes[largest]
            yield (
                f"{what}: {source.source} is known to {_size(source, 1.0)} and must be known to "
                f"{_size(source, share)}."
            )
        else:
            share = float(np.sqrt(left / np.sum(changes**2)))
            yield f"{what}: {_listed(budget, changes)} must all be known {1 / share:.2g} times better."


def _listed(budget: Budget, changes: FloatArray) -> str:
    """The sources that make nearly all of the systematic part, the largest first."""
    order = np.argsort(-changes)
    count = int(np.searchsorted(np.cumsum(changes[order] ** 2), 0.95 * np.sum(changes**2))) + 1
    return ", ".join(budget.sources[number].source for number in order[:count])


def _size(source: Uncertainty, share: float) -> str:
    """A standard uncertainty times a share, in per cent where it is relative.

    What has to be reached is rounded down.
    """
    size = source.std_error * share
    unit = "%" if source.unit == "1" else shown_unit(source.unit, size)
    shown = 100 * size if unit == "%" else difference_in(size, unit)
    digit = 10.0 ** (np.floor(np.log10(shown)) - 1)
    rounded = np.floor(shown / digit + (1e-9 if share < 1 else 0.5)) * digit
    return f"{rounded:.2g} {unit}"

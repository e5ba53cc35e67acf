"""Amounts of a comparison with what systematic sources add to their doubt, and the budget of all of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.identify.budget import contributed
from labpipe.identify.reported import INTERVAL, with_systematic
from labpipe.records.budget import Budget
from labpipe.records.doubt import Doubt
from labpipe.records.parameter import Parameter

# Share of a combined uncertainty below which the change by a source is rounding: the source cancels.
CANCELLED = 1e-9


def with_budget(
    amounts: Sequence[Parameter],
    sources: Sequence[Doubt],
    changes: FloatArray,
    dof: float | None = None,
    logarithmic: Collection[str] = (),
) -> tuple[tuple[Parameter, ...], Budget | None]:
    """The amounts with combined uncertainties, expanded intervals and shares, and their budget; as they are where every source cancels.

    changes (n_source, n_amount) [unit of the amount]: by one standard uncertainty of every source. dof: degrees of freedom behind the
    random parts, None where these are known. Intervals of the *logarithmic* amounts are those of a factor.
    """
    random = np.array([np.nan if amount.full_error is None else amount.full_error for amount in amounts])
    whole = Budget(tuple(amount.name for amount in amounts), random, dof, tuple(sources), changes)
    smallest = CANCELLED * np.hypot(np.nan_to_num(random), whole.systematic)
    counted = np.where((np.abs(changes) > smallest) & np.isfinite(random), changes, 0.0)
    kept = [number for number, row in enumerate(counted) if np.any(row)]
    if not kept:
        return tuple(amounts), None
    budget = replace(whole, sources=tuple(sources[number] for number in kept), changes=counted[kept])
    stated = contributed(with_systematic(amounts, budget), budget, INTERVAL)
    return tuple(_as_factor(amount) if amount.name in logarithmic else amount for amount in stated), budget


def _as_factor(amount: Parameter) -> Parameter:
    """The amount with the interval of its logarithm."""
    if amount.combined is None or amount.coverage_factor is None or not amount.value > 0:
        return amount
    reach = float(np.exp(amount.coverage_factor * amount.combined / amount.value))
    return replace(amount, ci95=(amount.value / reach, amount.value * reach))

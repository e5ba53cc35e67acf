"""Fits of one rig at several levels of excitation, compared with each other: what depends on the level is not
linear.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import chance_text, change_text
from labpipe.distributions import chi2_tail
from labpipe.quantities import UnitError, si_amount
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Fit, random_part

# Conditions of a test that say how strongly it was excited.
LEVELS = ("level", "amplitude", "force", "excitation")
AMPLITUDE_P = 0.01
# The share of a frequency within which it is an order of the shaft.
SAME_ORDER = 0.005
KINDS = {"N/m": "stiffness", "N.s/m": "damping"}

Conditions = Mapping[str, str]


# The level of a test in SI, and as people wrote it, with a fit of it.
_Test = tuple[float, str, Fit]


def with_level_findings(fits: Sequence[Fit], conditions: Mapping[str, Conditions]) -> list[Fit]:
    """The fits of one name, that of the highest level with a finding where it differs from that of the lowest
    by more than noise.

    *conditions* of every test by its name: compared are tests, bands and terms alike but for the level.
    Equation (est-levels).
    """
    groups: dict[tuple[object, ...], list[_Test]] = {}
    for fit in fits:
        stated = conditions.get(fit.test, {})
        levels = [name for name in LEVELS if name in stated]
        if levels:
            others = tuple(sorted((name, text) for name, text in stated.items() if name != levels[0]))
            text = str(stated[levels[0]])
            try:
                level, unit = si_amount(text)
            except UnitError:
                # "full" is not a number, and not above or below any.
                continue
            group = groups.setdefault((levels[0], unit, others, fit.band_hz, fit.term), [])
            group.append((level, text, fit))
    new = {}
    for tests in groups.values():
        low, high = (of(tests, key=lambda test: test[0]) for of in (min, max))
        if low[0] < high[0] and (message := _difference(low, high)):
            new[id(high[-1])] = Finding("amplitude", message)
    return [replace(fit, findings=(*fit.findings, new[id(fit)])) if id(fit) in new else fit for fit in fits]


def with_orders_named(fits: Sequence[Fit], conditions: Mapping[str, Conditions]) -> list[Fit]:
    """The fits; a finding of one line says with it which order of the shaft that is, at the speed which the
    *conditions* of a test, by its name, state.
    """
    named = []
    for fit in fits:
        speed, unit = 0.0, ""
        with contextlib.suppress(UnitError):
            speed, unit = si_amount(str(conditions.get(fit.test, {}).get("speed", "")))
        if unit == "Hz" and speed > 0:
            fit = replace(fit, findings=tuple(_with_order(finding, speed) for finding in fit.findings))
        named.append(fit)
    return named


def _with_order(finding: Finding, speed: float) -> Finding:
    order = (finding.line_hz or 0.0) / speed
    if order < 0.5 or abs(order - round(order)) > SAME_ORDER * order:
        return finding
    text = f"{finding.line_hz:.6g} Hz is {round(order)}x of the shaft at {60 * speed:.6g} rpm"
    return replace(finding, message=f"{finding.message}. {text}")


def _difference(low: _Test, high: _Test) -> str:
    (_, low_text, low_fit), (_, high_text, high_fit) = low, high
    before, after = _estimates(low_fit), _estimates(high_fit)
    if not before or [p.name for p in before] != [p.name for p in after]:
        return ""
    change = np.array([late.value - early.value for early, late in zip(before, after, strict=True)])
    information = np.linalg.pinv(_covariance(low_fit, before) + _covariance(high_fit, after), hermitian=True)
    together = chi2_tail(float(change @ information @ change), change.size)
    by_unit = [(kind, [p.value if p.unit == unit else 0.0 for p in before]) for unit, kind in KINDS.items()]
    shapes = {kind: np.array(values) for kind, values in by_unit}
    amounts = {kind: _amount(change, information, shape) for kind, shape in shapes.items() if np.any(shape)}
    p_values = {kind: chi2_tail((amount / error) ** 2, 1) for kind, (amount, error) in amounts.items()}
    p_value = min(1.0, min([together, *p_values.values()]) * (1 + len(p_values)))
    if p_value >= AMPLITUDE_P:
        return ""
    changes = ((kind, change_text(100 * by, 100 * error, "%")) for kind, (by, error) in amounts.items())
    listed = " and ".join(f"{kind} by {text}" for kind, text in changes)
    return (
        f"between {low_text} (test {low_fit.test}) and {high_text} (this test) {listed or 'the parameters'} "
        f"changed on the whole ({chance_text(p_value)}): the rig is not linear, and the coefficients hold "
        "for their level only. Measure at the level of use, or lower it until nothing changes"
    )


def _estimates(fit: Fit) -> tuple[Parameter, ...]:
    return fit.estimated if all(p.std_error for p in fit.estimated) else ()


def _covariance(fit: Fit, parameters: Sequence[Parameter]) -> FloatArray:
    """Covariance (n, n) of the estimates with model error; given numbers are the same at both levels."""
    errors = np.array([random_part(fit, p) or p.full_error or 0.0 for p in parameters])
    by_noise = np.array([parameter.std_error or 0.0 for parameter in parameters])
    for detail in fit.details:
        if detail.given_in_noise:
            of_given = np.diag(detail.given_covariance(errors.size))
            errors = np.sqrt(np.maximum(errors**2 - of_given, by_noise**2))
    return fit.correlation * np.outer(errors, errors)


def _amount(change: FloatArray, information: FloatArray, shape: FloatArray) -> tuple[float, float]:
    """Generalised least-squares factor [1] of *shape* (n,) in the *change*, and its standard error."""
    weight = float(shape @ information @ shape)
    return float(shape @ information @ change) / weight, weight**-0.5

"""Sensitivity of a control loop from an excitation added in the loop: its peak, the zone of ISO 14839-3,
margins without a model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.distributions import normal_quantile, student_quantile
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.measured import Measured, select_ports
from labpipe.methods.magnetic_bearing.bearing import MagneticFile, stability_findings, verdict
from labpipe.methods.magnetic_bearing.loop_fit import (
    LoopFit,
    fit_statement,
    goodness,
    identifiability_findings,
    loop_fit,
)
from labpipe.methods.magnetic_bearing.loop_problem import LoopObservation, response_errors, with_unknowns
from labpipe.methods.magnetic_bearing.stability import ZONES, sensitivity, zone_of
from labpipe.records.comparison import Comparison, Curve
from labpipe.records.finding import Finding, Parameter, note
from labpipe.records.response import FrequencyResponse
from labpipe.records.uncertain import Budget, MatrixError
from labpipe.uncertainty.amounts import with_budget, with_error
from labpipe.uncertainty.settings import CompareSettings

# Margins of a measured loop transfer function without a model, from the lines around its crossings.

# A margin by its name, of L (2,) at the lines around a crossing at omega (2,) [rad/s].
Margin = Callable[[ComplexArray, FloatArray], float]
STEP = 1e-4
# Lines of one local parabola.
LOCAL = 11
# Standard errors within which a function is zero all the way from one crossing to the next: both are one,
# crossed by noise.
SURE = 3.0


# A margin, its standard error, and its changes (n_source,), all in its unit.
Found = tuple[float, float, FloatArray]


def measured_margins(
    frequency: FloatArray,
    transfer: tuple[ComplexArray, FloatArray],
    changes: ComplexArray,
    quantile: float,
    suffix: str = "",
) -> list[tuple[Parameter, FloatArray]]:
    """Gain margins to either side, phase and delay margin of L (n_line,) [1] with its variance (n_line,) [1],
    as far as it crosses.

    Each with its change (n_source,) [its unit] by one standard uncertainty of every systematic source, that
    changes L by *changes* (n_source, n_line) [1].

    L follows a parabola over LOCAL lines, since noise makes it cross several times; where it does so all the
    same, one parabola over all these crossings and as much again, since the least of several would be too
    small. Intervals of 95 %, *quantile* standard errors to either side, hold the noise of these lines.
    *frequency* (n_line,) [Hz]. Equations (comp-margins) and (comp-margins-change).
    """
    plain, variance = transfer
    if frequency.size < LOCAL:
        return []
    omega, smoother = 2 * np.pi * frequency, _smoother(frequency)
    lines = _Lines(omega, plain, variance, changes, smoother)
    candidates: dict[str, list[Found]] = {}
    for near, n in lines.crossings(np.imag):
        if near.values[n].real + near.values[n + 1].real < 0:
            gain = _with_error(_gain, near, n)
            candidates.setdefault("gain_margin_lower" if gain[0] < 1 else "gain_margin_upper", []).append(
                gain
            )
    for near, n in lines.crossings(lambda values: np.abs(values) - 1):
        for name, margin in (("phase_margin", _phase), ("delay_margin", _delay)):
            candidates.setdefault(name, []).append(_with_error(margin, near, n))
    units = {"phase_margin": "rad", "delay_margin": "s"}
    chosen = {
        name: (max if name == "gain_margin_lower" else min)(margins, key=_value)
        for name, margins in candidates.items()
    }
    return [
        (with_error(f"measured_{name}{suffix}", units.get(name, "1"), value, error, quantile), moved)
        for name, (value, error, moved) in chosen.items()
    ]


def _value(found: Found) -> float:
    return found[0]


@dataclass(frozen=True)
class _Lines:
    """L at omega (n_line,) [rad/s]: *plain* as measured with its *variance* and its changes by every source
    (n_source, n_line), all [1].

    smoother (n_line, n_line) [1]: from these to smoothed values.
    """

    omega: FloatArray
    plain: ComplexArray
    variance: FloatArray
    plain_changes: ComplexArray
    smoother: FloatArray

    @cached_property
    def values(self) -> ComplexArray:
        """L smoothed, (n_line,) [1]."""
        return self.smoother @ self.plain

    @cached_property
    def covariance(self) -> FloatArray:
        """Of the smoothed values, (n_line, n_line) [1]."""
        return np.asarray(self.smoother * self.variance @ self.smoother.T)

    @cached_property
    def changes(self) -> ComplexArray:
        """Of the smoothed values by every source, (n_source, n_line) [1]."""
        return self.plain_changes @ self.smoother.T

    def crossings(self, function: Callable[[ComplexArray], FloatArray]) -> Iterator[tuple[_Lines, int]]:
        """Lines, and the number of the one behind which a real function of L changes its sign there."""
        signed = function(self.values)
        error = np.sqrt(np.diag(self.covariance) / 2)
        for first, last in _together(_changes(signed), np.abs(signed) > SURE * error):
            near = self if first == last else self._over(first, last)
            again = [n for n in _changes(function(near.values)) if first != last or n == first]
            if len(again) == 1:
                yield near, again[0]
            else:
                yield from ((self, n) for n in _changes(signed) if first <= n <= last)

    def _over(self, first: int, last: int) -> _Lines:
        """The lines from *first* to *last* and half as many to either side, L by one parabola through
        them.
        """
        reach = max(LOCAL // 2, (last - first + 1) // 2)
        part = slice(max(first - reach, 0), last + 2 + reach)
        omega = self.omega[part]
        x = (omega - omega[0]) / (omega[-1] - omega[0])
        columns = np.column_stack([np.ones_like(x), x, x**2])
        smoother = columns @ np.linalg.pinv(columns)
        return _Lines(omega, self.plain[part], self.variance[part], self.plain_changes[:, part], smoother)


def _together(crossings: Sequence[int], sure: BoolArray) -> list[tuple[int, int]]:
    """First and last of the *crossings* between which no line is *sure* (n_line,) of its sign."""
    groups: list[tuple[int, int]] = []
    for n in crossings:
        if groups and not np.any(sure[groups[-1][1] + 1 : n + 1]):
            groups[-1] = (groups[-1][0], n)
        else:
            groups.append((n, n))
    return groups


def _smoother(frequency: FloatArray) -> FloatArray:
    """(n_line, n_line) [1]: the value at every line of the parabola through the LOCAL lines around it."""
    n = frequency.size
    matrix = np.zeros((n, n))
    for line in range(n):
        first = min(max(line - LOCAL // 2, 0), n - LOCAL)
        x = frequency[first : first + LOCAL] - frequency[line]
        matrix[line, first : first + LOCAL] = np.linalg.pinv(np.column_stack([np.ones(LOCAL), x, x**2]))[0]
    return matrix


def _changes(values: FloatArray) -> list[int]:
    """Numbers of the lines behind which a function changes its sign."""
    return [int(n) for n in np.flatnonzero(values[:-1] * values[1:] < 0)]


def _gain(values: ComplexArray, _: FloatArray) -> float:
    """-1 / Re L where Im L = 0."""
    share = values[0].imag / (values[0].imag - values[1].imag)
    return float(-1 / (values[0] + share * (values[1] - values[0])).real)


def _crossing(values: ComplexArray) -> float:
    """Share of the way to the next line where |L| = 1."""
    sizes = np.log(np.abs(values))
    return float(sizes[0] / (sizes[0] - sizes[1]))


def _phase(values: ComplexArray, _: FloatArray) -> float:
    share = _crossing(values)
    return float(abs(np.angle(-(values[0] + share * (values[1] - values[0])))))


def _delay(values: ComplexArray, omega: FloatArray) -> float:
    share = _crossing(values)
    angle = float(np.angle(-(values[0] + share * (values[1] - values[0])))) % (2 * np.pi)
    return angle / float(omega[0] + share * (omega[1] - omega[0]))


def _with_error(margin: Margin, lines: _Lines, n: int) -> Found:
    """A margin, its standard error and its changes.

    Half of the covariance (n_line, n_line) [1] of L is of its real and half of its imaginary part.
    """
    pair, places, total = lines.values[n : n + 2], lines.omega[n : n + 2], 0.0
    changes = lines.changes[:, n : n + 2]
    moved = np.zeros(len(changes))
    for direction, part in ((1.0, changes.real), (1.0j, changes.imag)):
        steps = STEP * np.abs(pair).mean() * direction * np.eye(2)
        slopes = np.array(
            [
                (margin(pair + step, places) - margin(pair - step, places)) / (2 * abs(step).max())
                for step in steps
            ]
        )
        total += float(slopes @ lines.covariance[n : n + 2, n : n + 2] @ slopes) / 2
        moved += part @ slopes
    return margin(pair, places), float(np.sqrt(total)), moved


# Sensitivity of a control loop from an excitation added in the loop: its peak, the zone of ISO 14839-3, and
# the prediction.

# The peak is a parabola through the lines above this share of the highest one.
CREST = 0.93
FEWEST = 5
COMPLEX_PARTS = 2


@dataclass(frozen=True)
class MeasuredSensitivity:
    """S over *frequency* [Hz], complex (n_line,), with the standard error of |S| by noise; *quantile*: errors
    to either side of 95 %.

    *response*: the FRF it is computed from. errors: changes (n_line, 1, 1) [1] of S by one standard
    uncertainty of every source.
    """

    frequency: FloatArray
    values: ComplexArray
    error: FloatArray
    quantile: float
    response: FrequencyResponse
    errors: tuple[MatrixError, ...] = ()

    @property
    def size(self) -> FloatArray:
        """|S|, (n_line,) [1]."""
        return np.abs(self.values)

    @property
    def size_changes(self) -> FloatArray:
        """Changes of |S| by one standard uncertainty of every source, (n_source, n_line) [1]."""
        along = self.values.conj() / np.maximum(self.size, 1e-300)
        changes = np.array([error.change[:, 0, 0] for error in self.errors]).reshape(
            len(self.errors), self.values.size
        )
        return np.asarray((changes * along).real)

    @property
    def combined(self) -> FloatArray:
        """Combined standard uncertainty of |S|, (n_line,) [1]."""
        return np.asarray(np.sqrt(self.error**2 + np.sum(self.size_changes**2, axis=0)))

    def observation(self, file: MagneticFile) -> LoopObservation:
        """S with its noise, and its prediction by a file."""
        dof, averages = self.response.covariance_dof, self.response.averages
        shared = max(dof / (averages - 1), 1.0) if np.isfinite(dof) and averages > 1 else 1.0
        omega, variance = 2 * np.pi * self.frequency, (2 * self.error**2).astype(np.complex128)
        measured = Measured(
            omega=omega,
            matrix=self.values[:, None, None],
            covariance=variance[:, None, None],
            noise_dof=dof,
            noise_lines=shared,
            outputs=self.response.outputs[:1],
            inputs=self.response.inputs[:1],
        )
        return LoopObservation(
            measured,
            lambda changed, _: sensitivity(changed.levitated(), omega)[:, None, None],
            file,
            errors=lambda *_: self.errors,
        )


@dataclass(frozen=True)
class Peak:
    """The largest |S| with its standard error by noise and its frequency [Hz]; *at_edge*: at the edge of the
    measured band.

    frequency_error [Hz] by noise, None for that of a line. changes, frequency_changes (n_source,) [1] and
    [Hz]: by one standard uncertainty of every source.
    """

    value: float
    error: float
    frequency: float
    at_edge: bool
    changes: FloatArray
    frequency_error: float | None
    frequency_changes: FloatArray

    @property
    def combined(self) -> float:
        """Combined standard uncertainty of the value [1]."""
        return float(np.sqrt(self.error**2 + np.sum(self.changes**2)))

    def amounts(self, quantile: float, suffix: str = "") -> list[Parameter]:
        """The peak and its frequency with what noise leaves of them."""
        named = f"peak_frequency{suffix}"
        if self.frequency_error is None:
            place = Parameter(named, self.frequency, "Hz", derived=True)
        else:
            place = with_error(named, "Hz", self.frequency, self.frequency_error, quantile)
        return [with_error(f"peak{suffix}", "1", self.value, self.error, quantile), place]


def measured_sensitivity(response: FrequencyResponse, before: str, after: str) -> MeasuredSensitivity:
    """S = H_after / (H_after - H_before), both against the excitation that is added between them.

    after = before + e and before = -L after give S = 1 / (1 + L) = after / e; the quotient needs neither gain
    nor delay of the recorded excitation. To first order dS = (H_after dH_before - H_before dH_after) /
    (H_after - H_before)^2; half of E|dS|^2 is along |S|. Systematic errors of both go the same way, so that
    what they have in common cancels. ConfigError for unknown points, FitError without a covariance or where
    both points are the same. Equation (mag-measured-sensitivity).
    """
    rows, columns = select_ports(response, (), (before, after))
    if len(rows) != 2 or len(columns) != 1:
        raise ConfigError(
            f"'{before}' and '{after}' under one excitation are needed",
            hint="role: input for the excitation alone",
        )
    if response.covariance is None:
        hint = "average several periods or blocks"
        raise FitError("the noise of the response is not known, so the peak has no interval", hint=hint)
    index = [row * len(response.inputs) + columns[0] for row in rows]
    ahead, behind = response.matrix[:, rows, columns[0]].T
    added = behind - ahead
    if np.any(np.abs(added) < 1e-9 * np.abs(behind)):
        raise FitError(
            f"'{before}' and '{after}' are the same signal",
            hint="record one ahead of the sum and one behind it",
        )
    slopes = np.stack([behind, -ahead], axis=1) / added[:, None] ** 2
    covariance = response.covariance[:, index][:, :, index]
    variance = np.einsum("fi,fij,fj->f", slopes, covariance, slopes.conj()).real
    dof = COMPLEX_PARTS * response.covariance_dof
    quantile = student_quantile(0.975, dof) if np.isfinite(dof) else normal_quantile(0.975)
    errors = tuple(
        replace(error, change=np.einsum("fi,fic->fc", slopes, error.change)[:, :, None])
        for error in response_errors(response, rows, columns)
    )
    return MeasuredSensitivity(
        response.frequency, behind / added, np.sqrt(np.maximum(variance, 0.0) / 2), quantile, response, errors
    )


def peak_of(measured: MeasuredSensitivity) -> Peak:
    """The maximum of a parabola through the lines around the highest line; at an edge of the band the line
    itself.

    The highest line alone would be biased upwards by its noise. Errors are enlarged where the parabola's
    residual exceeds the noise. Systematic changes of the lines go through the same parabola, to first order.
    Equations (comp-peak) and (comp-peak-change).
    """
    frequency, size, error, changes = measured.frequency, measured.size, measured.error, measured.size_changes
    top = int(np.argmax(size))
    low, high = top, top
    while low > 0 and (size[low - 1] >= CREST * size[top] or high - low + 1 < FEWEST):
        low -= 1
    while high < size.size - 1 and (size[high + 1] >= CREST * size[top] or high - low + 1 < FEWEST):
        high += 1
    edge = Peak(
        float(size[top]),
        float(error[top]),
        float(frequency[top]),
        True,
        changes[:, top],
        None,
        np.zeros(len(changes)),
    )
    if top in (0, size.size - 1) or high - low + 1 < FEWEST:
        return edge
    width = float(frequency[high] - frequency[low])
    crest = slice(low, high + 1)
    x = (frequency[crest] - frequency[top]) / width
    columns = np.column_stack([np.ones_like(x), x, x**2])
    # All lines of the crest alike: errors of single lines, told by few periods, would weigh the noise itself.
    solution = np.linalg.pinv(columns)
    a, b, c = solution @ size[crest]
    place = -b / (2 * c)
    if c >= 0 or not x[0] <= place <= x[-1]:
        return edge
    left = size[crest] - columns @ np.array([a, b, c])
    excess = np.sum(left**2) / np.mean(error[crest] ** 2) / max(x.size - 3, 1)
    slopes = np.array([[1.0, place, place**2], width * np.array([0.0, -1.0, -2 * place]) / (2 * c)])
    spread = np.linalg.norm(slopes @ solution * error[crest], axis=1) * np.sqrt(max(excess, 1.0))
    moved = changes[:, crest] @ (slopes @ solution).T
    at = float(frequency[top] + place * width)
    return Peak(
        float(a - b**2 / (4 * c)), float(spread[0]), at, False, moved[:, 0], float(spread[1]), moved[:, 1]
    )


def loop_sensitivity(
    settings: CompareSettings, response: FrequencyResponse, file: MagneticFile | None
) -> Comparison:
    """Peak of the measured |S| with its zone, and the prediction of the bearing file, whose unknowns may be
    fitted to S.
    """
    measured = measured_sensitivity(response, settings.before, settings.after)
    peak = peak_of(measured)
    zone = zone_of(peak.value)
    theory = (
        None if file is None else _Theory(file, loop_fit([measured.observation(file)], settings.estimate))
    )
    predicted = None if theory is None else theory.size(theory.file, measured.frequency)
    measured_amounts, budget = _measured_amounts(measured, peak, predicted)
    amounts, budgets = list(measured_amounts), [budget]
    if theory is not None and predicted is not None:
        amounts += [
            *_predicted_amounts(measured, predicted),
            *goodness(theory.fitted),
            *theory.fitted.parameters,
        ]
        budgets.append(theory.fitted.budget)
    return Comparison(
        name=settings.name,
        kind="sensitivity",
        subject=f"|S| from {settings.before} and {settings.after}",
        unit="1",
        points=(),
        amounts=tuple(amounts),
        verdict=f"zone {zone}",
        statement=_statement(peak, measured_amounts[0], zone, predicted, theory),
        curves=(_curve(measured, predicted, theory),),
        correlations=() if theory is None else theory.fitted.correlations,
        findings=_findings(peak, zone, theory),
        budgets=tuple(budget_of_amount for budget_of_amount in budgets if budget_of_amount is not None),
    )


@dataclass(frozen=True)
class _Theory:
    """The bearing file, and its fit to the measured sensitivity."""

    file: MagneticFile
    fitted: LoopFit

    def size(self, file: MagneticFile, frequency: FloatArray) -> FloatArray:
        """|S| of a file."""
        return np.abs(sensitivity(file.levitated(), 2 * np.pi * frequency))


def _curve(measured: MeasuredSensitivity, predicted: FloatArray | None, theory: _Theory | None) -> Curve:
    reach = measured.quantile * measured.combined
    matched: tuple[float, ...] = ()
    if theory is not None and theory.fitted.usable:
        matched = tuple(
            theory.size(with_unknowns(theory.file, theory.fitted.values()), measured.frequency).tolist()
        )
    return Curve(
        measured.response.name,
        "sensitivity",
        "1",
        frequency=tuple(measured.frequency.tolist()),
        theory=() if predicted is None else tuple(predicted.tolist()),
        matched=matched,
        measured=tuple(measured.size.tolist()),
        low=tuple((measured.size - reach).tolist()),
        high=tuple((measured.size + reach).tolist()),
    )


def _measured_amounts(
    measured: MeasuredSensitivity, peak: Peak, predicted: FloatArray | None
) -> tuple[tuple[Parameter, ...], Budget | None]:
    """The peak, its frequency, and measured over predicted peak, with what systematic errors add."""
    amounts, changes = peak.amounts(measured.quantile), [peak.changes, peak.frequency_changes]
    if predicted is not None:
        highest = float(np.max(predicted))
        amounts.append(
            with_error("ratio", "1", peak.value / highest, peak.error / highest, measured.quantile)
        )
        changes.append(peak.changes / highest)
    dof = COMPLEX_PARTS * measured.response.covariance_dof
    return with_budget(
        amounts,
        [error.uncertainty for error in measured.errors],
        np.array(changes).T,
        dof if np.isfinite(dof) else None,
    )


def _predicted_amounts(measured: MeasuredSensitivity, predicted: FloatArray) -> tuple[Parameter, ...]:
    """The predicted peak within the measured band, and the share of lines whose interval holds the
    prediction.
    """
    holds = np.abs(measured.size - predicted) <= measured.quantile * measured.combined
    pairs = {"predicted_peak": float(np.max(predicted)), "share": float(np.mean(holds))}
    return tuple(Parameter(name, value, "1", derived=True) for name, value in pairs.items())


def _statement(
    peak: Peak, top: Parameter, zone: str, predicted: FloatArray | None, theory: _Theory | None
) -> str:
    assert top.ci95 is not None
    low, high = top.ci95
    peak_text = (
        f"|S| reaches {peak.value:.3f} (95 %: {low:.3f} to {high:.3f}) at {peak.frequency:.4g} Hz: "
        f"zone {zone} of ISO 14839-3"
    )
    ends = [zone_of(low), zone_of(high)]
    confidence = (
        "." if ends[0] == ends[1] else (f"; its interval reaches from zone {ends[0]} to zone {ends[1]}.")
    )
    limits = f" Limits: {', '.join(f'{name} below {end:g}' for name, end in ZONES)}."
    if theory is None or predicted is None:
        return peak_text + confidence + limits
    stability = verdict(theory.file.levitated())
    if stability.unstable:
        return (
            f"{peak_text}{confidence}{limits} The loop of the bearing file is unstable, so it cannot be "
            "the recorded one."
        )
    prediction_text = f" Predicted in this band: {float(np.max(predicted)):.3f}."
    if stability.peak.value > 1.01 * float(np.max(predicted)):
        where = f"{stability.peak.value:.3g} at {stability.peak.frequency:.3g} Hz, zone {stability.peak.zone}"
        prediction_text += f" Outside it the prediction reaches {where}, which this recording does not show."
    return f"{peak_text}{confidence}{limits}{prediction_text} {fit_statement(theory.fitted)}"


def _findings(peak: Peak, zone: str, theory: _Theory | None) -> tuple[Finding, ...]:
    findings = []
    if zone in ("C", "D"):
        findings.append(
            Finding(
                "sensitivity",
                f"the measured sensitivity lies in zone {zone} of ISO 14839-3, not fit for long operation",
            )
        )
    if peak.at_edge:
        what = (
            f"the largest sensitivity is at the edge of the band, {peak.frequency:.4g} Hz; it may be "
            "larger beyond"
        )
        findings.append(Finding("sensitivity-edge", what))
    if theory is not None:
        predicted = stability_findings(verdict(theory.file.levitated()))
        findings += [replace(finding, message=f"prediction: {finding.message}") for finding in predicted]
        findings += [*identifiability_findings(theory.fitted), note("assumptions", theory.file.assumptions())]
    return tuple(findings)

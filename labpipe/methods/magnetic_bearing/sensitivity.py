"""Sensitivity of loops from excitations added in them: its peak, zone of ISO 14839-3, prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import normal_quantile, student_quantile
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.estimation.diagnostics import ENOUGH_LINES, round_up
from labpipe.estimation.measured import Measured, chosen_ports, select_ports
from labpipe.methods.magnetic_bearing import loop_problem
from labpipe.methods.magnetic_bearing.bearing import MagneticFile, stability_findings, verdict
from labpipe.methods.magnetic_bearing.loop_fit import (
    LoopFit,
    fit_statement,
    goodness,
    identifiability_findings,
    loop_fit,
)
from labpipe.methods.magnetic_bearing.measured_margins import ResponseCourse, crest_of
from labpipe.methods.magnetic_bearing.stability import ZONES, sensitivity, zone_of
from labpipe.records.comparison import Comparison, QuantityCurve
from labpipe.records.finding import Finding, Parameter, note
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import Budget, MatrixError, Uncertainty
from labpipe.spectra.damping import half_power
from labpipe.uncertainty.amounts import with_budget, with_error
from labpipe.uncertainty.settings import CompareSettings

COMPLEX_PARTS = 2
# Share of |S| below which its error is rounding.
ROUNDING = 1e-15
# Ratio of predicted to measured S (1 - S) up to which a change is scaled by it: beyond is noise about zero.
MOST_SCALED = 2.0
# Half-power width of a Hann window [lines].
OF_WINDOW = 1.44


@dataclass(frozen=True)
class MeasuredSensitivity:
    """S over *frequency* [Hz], complex (n_line,), with the standard error of |S| by noise; *quantile*: errors
    to either side of 95 %. *response*: the FRF it is computed from. errors: changes (n_line, 1, 1) [1] of S
    by one standard uncertainty of every source.
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
        return (self._changes * along).real

    @property
    def _changes(self) -> ComplexArray:
        changes = [error.change[:, 0, 0] for error in self.errors]
        return np.array(changes).reshape(len(changes), self.values.size)

    @property
    def transfer(self) -> tuple[ComplexArray, FloatArray]:
        """L = 1 / S - 1, its variance |S|^-4 var S, (n_line,) each [1]. Equation (mag-loop-transfer)."""
        return (1 / self.values - 1), 2 * self.error**2 / self.size**4

    @property
    def transfer_changes(self) -> ComplexArray:
        """dL = -S^-2 dS by every source, (n_source, n_line) [1]. Equation (mag-transfer-change)."""
        return -self._changes / self.values**2

    @property
    def course(self) -> ResponseCourse:
        """S over omega with its noise and changes."""
        omega, dof = 2 * np.pi * self.frequency, self.response.covariance_dof
        return ResponseCourse(omega, self.values, 2 * self.error**2, self._changes, dof)

    @property
    def combined(self) -> FloatArray:
        """Combined standard uncertainty of |S|, (n_line,) [1]."""
        return np.sqrt(self.error**2 + np.sum(self.size_changes**2, axis=0))

    def observation(self, file: MagneticFile) -> loop_problem.LoopObservation:
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

        def errors(changed: MagneticFile, _: tuple[float, float]) -> list[MatrixError]:
            """Of the prediction: in proportion to the measurement a gain would shrink its noise with it.
            Gains and delays of both sides change S by S (1 - S).
            """
            there = sensitivity(changed.suspension(), omega)
            here = self.values * (1 - self.values)
            factor = np.divide(there * (1 - there), here, out=np.ones_like(here), where=here != 0)
            factor = np.where(np.abs(factor) < MOST_SCALED, factor, 1.0)[:, None, None]
            return [replace(error, change=error.change * factor) for error in self.errors]

        return loop_problem.LoopObservation(
            measured,
            lambda changed, _: sensitivity(changed.suspension(), omega)[:, None, None],
            file,
            errors=errors,
        )


@dataclass(frozen=True)
class Peak:
    """The largest |S| with its standard error by noise and its frequency [Hz]; *at_edge*: at the edge of the
    measured band. frequency_error [Hz] by noise, None for that of a line. changes, frequency_changes
    (n_source,) [1] and [Hz]: by one standard uncertainty of every source.
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

    def findings(self) -> list[Finding]:
        what = f"the largest sensitivity is at the edge of the band, {self.frequency:.4g} Hz"
        return [Finding("sensitivity-edge", f"{what}; it may be larger beyond")] if self.at_edge else []

    def amounts(self, quantile: float, suffix: str = "") -> list[Parameter]:
        named = f"peak_frequency{suffix}"
        place = Parameter(named, self.frequency, "Hz", derived=True)
        if self.frequency_error is not None:
            place = with_error(named, "Hz", self.frequency, self.frequency_error, quantile)
        return [with_error(f"peak{suffix}", "1", self.value, self.error, quantile), place]


def measured_sensitivity(response: FrequencyResponse, before: str, after: str) -> MeasuredSensitivity:
    """S = H_after / (H_after - H_before), both against the excitation that is added between them.

    after = before + e and before = -L after give S = 1 / (1 + L) = after / e. To first order dS = (H_after
    dH_before - H_before dH_after) / (H_after - H_before)^2. ConfigError for unknown points, FitError without
    a covariance or where both points are the same. Equation (mag-measured-sensitivity).
    """
    rows, columns = select_ports(response, (), (before, after))
    if len(rows) != 2 or len(columns) != 1:
        hint = "role: input for the excitation alone"
        raise ConfigError(f"'{before}' and '{after}' under one excitation are needed", hint=hint)
    return sensitivity_matrix(response, (before,), (after,)).loop(0)


def peak_of(measured: MeasuredSensitivity) -> Peak:
    """The maximum of |S| by a polynomial, at an edge the highest line. Equation (comp-peak-change)."""
    crest = crest_of(measured.course)
    if crest is None:
        top = int(np.argmax(measured.size))
        of_lines = measured.size_changes
        at_edge = float(measured.size[top]), float(measured.error[top]), float(measured.frequency[top])
        return Peak(*at_edge, True, of_lines[:, top], None, np.zeros(len(of_lines)))
    value, spread, moved = crest.value
    place, wide, shifted = crest.place
    turn = 2 * np.pi
    return Peak(value, spread, place / turn, False, moved, wide / turn if wide > 0 else None, shifted / turn)


def leakage_findings(measured: MeasuredSensitivity, peak: Peak) -> list[Finding]:
    """A warning where blocks of random data make the peak of |S| lower by more than its standard error: the
    mean over the window's spectrum is lower by up to (1.44 / W)^2 of a peak W lines wide (half power).
    """
    blocks = measured.response.blocks
    if blocks is None or blocks.degree or blocks.after_hit or peak.at_edge:
        return []
    try:
        around = half_power(measured.frequency, measured.values, (0.9 * peak.frequency, 1.1 * peak.frequency))
    except DataError:
        return []
    width = around.high - around.low
    lines = blocks.length * width
    lower, error = (OF_WINDOW / lines) ** 2, peak.error / peak.value
    if lower < error:
        return []
    what = (
        f"the peak of the sensitivity at {peak.frequency:.4g} Hz is {width:.2g} Hz wide (half power), "
        f"{lines:.2g} lines of blocks of {blocks.length:.3g} s: they make it lower, and margins beside it "
        f"larger, by up to {100 * lower:.2g} %, which no standard error shows; use blocks of at least "
        f"{round_up(max(2 * OF_WINDOW / error**0.5, ENOUGH_LINES) / width):g} s, or periodic excitation"
    )
    return [Finding("leakage", what)]


def loop_sensitivity(
    settings: CompareSettings, response: FrequencyResponse, file: MagneticFile | None
) -> Comparison:
    """Peak of the measured |S| with its zone, and the prediction of the bearing file."""
    measured = measured_sensitivity(response, settings.before, settings.after)
    peak = peak_of(measured)
    zone = zone_of(peak.value)
    predicted = None if file is None else _size(file, measured.frequency)
    measured_amounts, budget = _measured_amounts(measured, peak, predicted)
    amounts, budgets, theory = list(measured_amounts), [budget], None
    if file is not None and predicted is not None:
        fitted = loop_fit([measured.observation(file)], settings.estimate)
        theory = file, fitted
        holds = np.abs(measured.size - predicted) <= measured.quantile * measured.combined
        amounts += [
            Parameter("predicted_peak", float(np.max(predicted)), "1", derived=True),
            Parameter("share", float(np.mean(holds)), "1", derived=True),
            *goodness(fitted),
            *fitted.parameters,
        ]
        budgets.append(fitted.budget)
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
        correlations=() if theory is None else theory[1].correlations,
        findings=(*leakage_findings(measured, peak), *_findings(peak, zone, theory)),
        budgets=tuple(filter(None, budgets)),
    )


# A bearing file and the fit of its unknowns.
_Theory = tuple[MagneticFile, LoopFit]


def _size(file: MagneticFile, frequency: FloatArray) -> FloatArray:
    return np.abs(sensitivity(file.suspension(), 2 * np.pi * frequency))


def _curve(
    measured: MeasuredSensitivity, predicted: FloatArray | None, theory: _Theory | None
) -> QuantityCurve:
    parts = {} if predicted is None else {"theory": predicted}
    if theory is not None and theory[1].usable:
        changed = loop_problem.with_unknowns(theory[0], theory[1].values())
        parts["matched"] = _size(changed, measured.frequency)
    reach = measured.quantile * measured.combined
    parts |= {"measured": measured.size, "low": measured.size - reach, "high": measured.size + reach}
    return curve_of(measured.response.name, "sensitivity", "1", frequency=measured.frequency, **parts)


def curve_of(test: str, quantity: str, unit: str, **columns: FloatArray) -> QuantityCurve:
    """A curve of *columns* (n_line,) [unit], by the names of its fields."""
    return QuantityCurve(
        test, quantity, unit, **{name: tuple(part.tolist()) for name, part in columns.items()}
    )


def _measured_amounts(
    measured: MeasuredSensitivity, peak: Peak, predicted: FloatArray | None
) -> tuple[tuple[Parameter, ...], Budget | None]:
    amounts, changes = peak.amounts(measured.quantile), [peak.changes, peak.frequency_changes]
    if predicted is not None:
        highest = float(np.max(predicted))
        ratio, error = peak.value / highest, peak.error / highest
        amounts.append(with_error("ratio", "1", ratio, error, measured.quantile))
        changes.append(peak.changes / highest)
    dof = COMPLEX_PARTS * measured.response.covariance_dof
    sources = [error.uncertainty for error in measured.errors]
    return with_budget(amounts, sources, np.array(changes).T, dof if np.isfinite(dof) else None)


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
    if ends[0] != ends[1]:
        peak_text += f"; its interval reaches from zone {ends[0]} to zone {ends[1]}"
    peak_text += f". Limits: {', '.join(f'{name} below {end:g}' for name, end in ZONES)}."
    if theory is None or predicted is None:
        return peak_text
    (file, fitted), highest = theory, float(np.max(predicted))
    stability = verdict(file.suspension())
    if stability.unstable:
        return f"{peak_text} The loop of the bearing file is unstable, so it cannot be the recorded one."
    prediction_text = f" Predicted in this band: {highest:.3f}."
    if stability.peak.value > 1.01 * highest:
        where = f"{stability.peak.value:.3g} at {stability.peak.frequency:.3g} Hz, zone {stability.peak.zone}"
        prediction_text += f" Outside it the prediction reaches {where}, which this recording does not show."
    return f"{peak_text}{prediction_text} {fit_statement(fitted)}"


def _findings(peak: Peak, zone: str, theory: _Theory | None) -> tuple[Finding, ...]:
    findings = []
    if zone in ("C", "D"):
        what = f"the measured sensitivity lies in zone {zone} of ISO 14839-3, not fit for long operation"
        findings.append(Finding("sensitivity", what))
    findings += peak.findings()
    if theory is not None:
        file, fitted = theory
        predicted = stability_findings(verdict(file.suspension()))
        findings += [replace(finding, message=f"prediction: {finding.message}") for finding in predicted]
        findings += [*identifiability_findings(fitted), note("assumptions", file.assumptions())]
    return tuple(findings)


# Condition number of the injections of all runs beyond which they are one.
ONE_INJECTION = 1e6


def response_per_injection(spectra: ChannelSpectra) -> FrequencyResponse:
    """H = Y R^-1 of the runs, Y the channels of role output and R those of role input, dH = (dY - H dR) R^-1.

    Uncertainties of channels and of sums go the same way, but for directions that no other channel tells,
    which stay at their ports. ConfigError where there is not one run per injection, or where the runs do not
    tell them apart. Equation (comp-injection).
    """
    inputs, outputs = (
        [n for n, channel in enumerate(spectra.channels) if channel.role == role]
        for role in ("input", "output")
    )
    if len(spectra.runs) != len(inputs):
        hint = "one recording per injection, the injections alone with role: input"
        raise ConfigError(f"{len(spectra.runs)} run(s) for {len(inputs)} injection(s)", hint=hint)
    injected = spectra.vectors[:, :, inputs].swapaxes(1, 2)
    if np.any(np.linalg.cond(injected) > ONE_INJECTION):
        hint = "inject into one loop after the other"
        raise ConfigError("the runs do not tell the injections apart", hint=hint)
    inverse = np.linalg.inv(injected)
    matrix = spectra.vectors[:, :, outputs].swapaxes(1, 2) @ inverse
    return FrequencyResponse(
        spectra.frequency,
        matrix,
        tuple(_port(spectra, n) for n in outputs),
        tuple(_port(spectra, n) for n in inputs),
        form="other",
        covariance=_covariance(spectra, (outputs, inputs), matrix, inverse),
        covariance_dof=spectra.covariance_dof,
        blocks=spectra.blocks,
        line_correlation=spectra.line_correlation,
        errors=_errors(spectra, (outputs, inputs), matrix, inverse),
        name=spectra.name,
        findings=spectra.findings,
        conditions=dict(spectra.conditions),
    )


def _covariance(
    spectra: ChannelSpectra, places: tuple[list[int], list[int]], matrix: ComplexArray, inverse: ComplexArray
) -> ComplexArray:
    """E[dH dH^H] (n_line, n, n) row by row: of dY - H dR of every run, by its part in R^-1."""
    outputs, inputs = places
    rows = np.zeros((*matrix.shape[:2], len(spectra.channels)), np.complex128)
    rows[:, np.arange(len(outputs)), outputs] = 1.0
    rows[:, :, inputs] -= matrix
    noise = np.einsum("loc,lrcd,lpd->lrop", rows, spectra.covariance, rows.conj())
    joint = np.einsum("lrop,lri,lrj->loipj", noise, inverse, inverse.conj())
    n = matrix.shape[1] * matrix.shape[2]
    return joint.reshape(-1, n, n)


def _errors(
    spectra: ChannelSpectra, places: tuple[list[int], list[int]], matrix: ComplexArray, inverse: ComplexArray
) -> tuple[MatrixError, ...]:
    """dH (n_line, n_output, n_input) by every source in the channels and their sums."""
    outputs, inputs = places
    stated = (entry.uncertainty for channel in spectra.channels for entry in channel.uncertainties)
    uncertainties = {uncertainty.source: uncertainty for uncertainty in stated}
    omega = 2 * np.pi * spectra.frequency[:, None, None]
    errors = []
    for factor in spectra.factors:
        moved = factor.std_error * omega**factor.power * (spectra.vectors @ factor.derivative.T)
        change = (moved[:, :, outputs].swapaxes(1, 2) - matrix @ moved[:, :, inputs].swapaxes(1, 2)) @ inverse
        plain = Uncertainty(factor.source, factor.std_error, factor.unit)
        errors.append(MatrixError(uncertainties.get(factor.source, plain), change))
    return loop_problem.merge(errors)


def _port(spectra: ChannelSpectra, number: int) -> Port:
    channel = spectra.channels[number]
    sources = {factor.source for factor in spectra.factors}
    left = tuple(number for number in channel.uncertainties if number.uncertainty.source not in sources)
    return Port(channel.name, channel.name, channel.dof, channel.angle, left)


SAME_SIGNAL = 1e-9


@dataclass(frozen=True)
class SensitivityMatrix:
    """S over *frequency* [Hz], (n_line, n, n) [1] by loops, covariance (n_line, n^2, n^2) [1] of its elements
    row by row.

    dof: complex degrees of freedom behind the covariance; names of the loops. errors: changes (n_line, n, n)
    [1] of S by one standard uncertainty of every source.
    """

    response: FrequencyResponse
    values: ComplexArray
    covariance: ComplexArray
    errors: tuple[MatrixError, ...] = ()

    @property
    def loops(self) -> tuple[str, ...]:
        return tuple(port.label for port in self.response.inputs)

    @property
    def quantile(self) -> float:
        """Standard errors to either side of a 95 % interval by complex degrees of freedom."""
        dof = self.response.covariance_dof
        return student_quantile(0.975, COMPLEX_PARTS * dof) if np.isfinite(dof) else normal_quantile(0.975)

    def loop(self, number: int) -> MeasuredSensitivity:
        """S_ii of a loop."""
        part, place = slice(number, number + 1), number * (len(self.loops) + 1)
        values = self.values[:, number, number]
        error = np.sqrt(np.maximum(self.covariance[:, place, place].real / 2, 0.0))
        return MeasuredSensitivity(
            self.response.frequency,
            values,
            np.maximum(error, ROUNDING * np.abs(values)),
            self.quantile,
            self.response,
            tuple(replace(error, change=error.change[:, part, part]) for error in self.errors),
        )

    def largest(self) -> tuple[FloatArray, FloatArray]:
        """The largest singular value of S and its standard error, d s = Re u^H dS v, (n_line,) each [1]."""
        slopes = self._largest_slopes
        variance = np.einsum("lc,lcd,ld->l", slopes, self.covariance, slopes.conj()).real
        return np.linalg.svd(self.values, compute_uv=False)[:, 0], np.sqrt(np.maximum(variance / 2, 0.0))

    def largest_changes(self) -> FloatArray:
        """Its changes by every source, (n_source, n_line) [1]. Equation (mag-singular-change)."""
        slopes = self._largest_slopes
        changes = [np.sum(slopes * error.change.reshape(slopes.shape), axis=1).real for error in self.errors]
        return np.array(changes).reshape(len(self.errors), len(slopes))

    @cached_property
    def _largest_slopes(self) -> ComplexArray:
        """u_i* v_j of the largest singular value, (n_line, n^2) [1]."""
        left, _, right = np.linalg.svd(self.values)
        slopes = left[:, :, 0].conj()[:, :, None] * right[:, 0].conj()[:, None, :]
        return slopes.reshape(len(slopes), -1)


def sensitivity_matrix(
    response: FrequencyResponse, before: Sequence[str], after: Sequence[str]
) -> SensitivityMatrix:
    """S = H_after (H_after - H_before)^-1; without *before* the responses behind the sums are per excitation
    themselves, S = H_after. ConfigError where there is not one excitation per loop, FitError without a
    covariance or where both sides are one signal. Equation (mag-sensitivity-matrix).
    """
    try:
        rows, ahead = (
            [chosen_ports(response.outputs, (name,), "response")[0] for name in names]
            for names in (after, before)
        )
    except ConfigError as error:
        entry = "under recordings: {file: FILE, channels: {r: {role: input}, u: {role: output}}}"
        error.hint = (
            f"{error.hint}; the excitation is the one input, signals of the loop are outputs, {entry}"
        )
        raise
    n, n_input = len(rows), len(response.inputs)
    if n_input != n:
        hint = "role: input for the excitations alone, one per loop"
        raise ConfigError(f"{n} loop(s) and {n_input} excitation(s)", hint=hint)
    if response.covariance is None:
        hint = "average several periods or blocks"
        raise FitError("the noise of the response is not known, so nothing has an interval", hint=hint)
    if response.frequency[0] == 0:
        raise FitError("a loop is not excited at 0 Hz", hint="begin `band` above it, or leave the line out")
    h_after = response.matrix[:, rows]
    unit = np.broadcast_to(np.eye(n), h_after.shape).astype(np.complex128)
    added = h_after - response.matrix[:, ahead] if ahead else unit
    least = np.linalg.svd(added, compute_uv=False)[:, -1]
    same = np.flatnonzero(least <= SAME_SIGNAL * np.linalg.norm(h_after, axis=(1, 2)))
    if same.size:
        what = f"both sides of a sum are the same signal at {response.frequency[same[0]]:g} Hz"
        raise FitError(what, hint="record one ahead of the sum and one behind it")
    inverse = np.linalg.inv(added)
    values = h_after @ inverse
    # dS = (dH_after - S (dH_after - dH_before)) added^-1.
    picked = np.zeros((len(values), n, len(response.outputs)), np.complex128)
    picked[:, :, rows] += unit - values if ahead else unit
    if ahead:
        picked[:, :, ahead] += values
    slopes = np.einsum("lio,lkj->lijok", picked, inverse).reshape(len(values), n * n, -1)
    covariance = slopes @ response.covariance @ slopes.conj().swapaxes(1, 2)
    silent = np.einsum("lcc->l", covariance).real <= 0
    if silent.any() and not silent.all():
        what = f"the line at {response.frequency[np.argmax(silent)]:g} Hz has no noise, unlike the others"
        raise FitError(what, hint="leave it out (`exclude`), or average several periods or blocks")
    used = list(dict.fromkeys([*rows, *ahead]))
    errors = tuple(
        replace(error, change=picked[:, :, used] @ error.change @ inverse)
        for error in loop_problem.response_errors(response, used, list(range(n)))
    )
    return SensitivityMatrix(response, values, covariance, errors)

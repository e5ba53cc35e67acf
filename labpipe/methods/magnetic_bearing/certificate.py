"""Certificate of a closed loop: zone, margins, poles and decrements with intervals, and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import probability_text
from labpipe.distributions import normal_quantile
from labpipe.errors import ConfigError, SettingError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.magnetic_bearing import sensitivity, stability
from labpipe.methods.magnetic_bearing.bearing import MagneticFile, growing
from labpipe.methods.magnetic_bearing.limits import (
    Limit,
    LoopCertificateSettings,
    cause_of,
    probabilities,
    probability_below,
    recorded_loop,
    sound,
    undecided_limits,
    verdict_of,
)
from labpipe.methods.magnetic_bearing.loop import margins
from labpipe.methods.magnetic_bearing.loop_fit import (
    BENT,
    REACH,
    LoopFit,
    fit_statement,
    goodness,
    identifiability_findings,
    loop_fit,
)
from labpipe.methods.magnetic_bearing.loop_problem import with_unknowns
from labpipe.methods.magnetic_bearing.measured_margins import measured_margins, unsure_crossings
from labpipe.methods.magnetic_bearing.sampled_loop import Suspended, sampled_loop
from labpipe.records.comparison import Comparison, QuantityCurve
from labpipe.records.finding import Finding, Parameter, note
from labpipe.records.response import FrequencyResponse
from labpipe.records.uncertain import Budget, Uncertainty
from labpipe.uncertainty.amounts import with_budget, with_error
from labpipe.uncertainty.settings import CompareSettings

STEP = 0.02
# Upper end of the search without a sampling rate [Hz], and of modes as a share of the sampling rate.
HIGHEST, NYQUIST = 20e3, 0.5
# Amounts whose logarithm is nearer to a normal distribution than they are themselves.
LOGARITHMIC = ("sensitivity_peak", "gain_margin_lower", "gain_margin_upper", "disk_margin", "delay_margin")
UNITS = {
    "phase_margin": "rad",
    "delay_margin": "s",
    "sensitivity_frequency": "Hz",
    "f_n": "Hz",
    "pole_real": "1/s",
    "pole_imag": "rad/s",
}


Amounts = Callable[[Mapping[str, float]], dict[str, float]]


@dataclass(frozen=True)
class ClosedLoop:
    """Amounts by name at the fitted unknowns, their covariance by noise (n, n) [their units], in the same
    order; *unstable* poles.

    changes (n_source, n) [their units]: by one standard uncertainty of each of the *sources*. bent: names of
    the amounts that do not follow the unknowns in a straight line within their errors.
    """

    amounts: dict[str, float]
    covariance: FloatArray
    unstable: int
    sources: tuple[Uncertainty, ...]
    changes: FloatArray
    bent: tuple[str, ...]

    def error(self, name: str) -> float:
        """Combined standard uncertainty of an amount [its unit]."""
        place = list(self.amounts).index(name)
        random, systematic = self.covariance[place, place], np.sum(self.changes[:, place] ** 2)
        return float(np.sqrt(max(random, 0.0) + systematic))

    def modes(self) -> list[str]:
        return [name for name in self.amounts if name.startswith("log_decrement")]

    def parameters(self, quantile: float) -> tuple[tuple[Parameter, ...], Budget | None]:
        """All amounts with 95 % intervals, *quantile* standard errors to either side, and their budget."""
        plain = [self._parameter(number, name, quantile) for number, name in enumerate(self.amounts)]
        return with_budget(plain, self.sources, self.changes, logarithmic=LOGARITHMIC)

    def _parameter(self, number: int, name: str, quantile: float) -> Parameter:
        value, error = self.amounts[name], float(np.sqrt(max(self.covariance[number, number], 0.0)))
        unit = next((unit for start, unit in UNITS.items() if name.startswith(start)), "1")
        low, high = value - quantile * error, value + quantile * error
        if name in LOGARITHMIC and value > 0:
            reach = float(np.exp(quantile * error / value))
            low, high = value / reach, value * reach
        return Parameter(name, value, unit, std_error=error, ci95=(low, high), derived=True)


def closed_loop(file: MagneticFile, fit: LoopFit, rate: float | None, highest_mode: float) -> ClosedLoop:
    """The closed loop of the file with its fitted unknowns; modes up to *highest_mode* [Hz], first order in
    the unknowns' errors. Equation (comp-closed-loop).
    """
    values = fit.values()
    plant = with_unknowns(file, values).suspension()
    all_poles = loop_poles(plant, rate)
    unstable = stability.unstable_poles(plant) if rate is None else int(np.sum(all_poles.real > 0))
    poles = modes_of(all_poles, highest_mode)

    def at(changed: Mapping[str, float]) -> dict[str, float]:
        other = with_unknowns(file, changed).suspension()
        others = loop_poles(other, rate)
        near = np.array([others[np.argmin(np.abs(others - pole))] for pole in poles], np.complex128)
        return loop_amounts(other, rate, near, unstable == 0)

    here = at(values)
    slopes = np.array([_slope(at, values, parameter, list(here)) for parameter in fit.parameters])
    slopes = slopes.reshape(len(values), len(here))
    sources = () if fit.budget is None else fit.budget.sources
    bent = _bent_amounts(at, values, slopes, fit.covariance + fit.changes.T @ fit.changes)
    covariance = slopes.T @ fit.covariance @ slopes
    return ClosedLoop(here, covariance, unstable, sources, fit.changes @ slopes, bent)


def _bent_amounts(
    at: Amounts, values: Mapping[str, float], slopes: FloatArray, covariance: FloatArray
) -> tuple[str, ...]:
    """Names of amounts that are not straight REACH combined standard errors of the unknowns away."""
    here = at(values)
    errors = np.sqrt(np.maximum(np.einsum("ji,jk,ki->i", slopes, covariance, slopes), 0.0))
    bent = []
    for column, (name, error) in enumerate(zip(here, errors, strict=True)):
        if not error > 0:
            continue
        away = dict(zip(values, REACH * covariance @ slopes[:, column] / error, strict=True))
        for sign in (1.0, -1.0):
            try:
                moved = at({entry: value + sign * float(away[entry]) for entry, value in values.items()})
            except ConfigError:
                moved = {}
            if not abs(moved.get(name, np.nan) - here[name] - sign * REACH * error) <= BENT * REACH * error:
                bent.append(name)
                break
    return tuple(bent)


def _slope(at: Amounts, values: Mapping[str, float], parameter: Parameter, names: list[str]) -> FloatArray:
    step = STEP * (parameter.std_error or 0.0) or 1e-6 * abs(parameter.value)
    ahead, behind = (at({**values, parameter.name: parameter.value + sign * step}) for sign in (1, -1))
    return np.array([(ahead.get(name, np.nan) - behind.get(name, np.nan)) / (2 * step) for name in names])


def loop_poles(plant: Suspended, rate: float | None) -> ComplexArray:
    """Poles s [rad/s] (n_pole,) of the sampled loop, without a rate by Pade approximation of the delay."""
    if rate is None:
        return stability.closed_loop_poles(plant)
    return stability.sampled_poles(sampled_loop(plant, rate).a, rate)


def modes_of(poles: ComplexArray, highest: float) -> ComplexArray:
    """The poles (n_mode,) [rad/s] of modes that swing, by their natural frequency up to *highest* [Hz]."""
    chosen = poles[(poles.imag > 1e-9 * np.abs(poles)) & (np.abs(poles) <= 2 * np.pi * highest)]
    return chosen[np.argsort(np.abs(chosen))]


def loop_amounts(plant: Suspended, rate: float | None, modes: ComplexArray, stable: bool) -> dict[str, float]:
    """Margins of a stable loop; f_n, log decrement 2 pi z / sqrt(1 - z^2), pole of *modes* (n,) [rad/s]."""
    amounts: dict[str, float] = {}
    if stable:
        highest = HIGHEST if rate is None else NYQUIST * rate * (1 - 1e-9)
        of = margins(lambda omega: stability.open_loop(plant, omega, rate).loop, highest)
        named = {
            "sensitivity_peak": of.peak,
            "sensitivity_frequency": of.peak_frequency,
            "gain_margin_lower": of.gain_lower,
            "gain_margin_upper": of.gain_upper,
            "phase_margin": of.phase,
            "delay_margin": of.delay,
            "disk_margin": of.disk,
        }
        # What the loop never reaches is not a number.
        amounts |= {name: value for name, value in named.items() if np.isfinite(value) and value > 0}
    for number, pole in enumerate(modes, 1):
        amounts[f"f_n_{number}"] = float(np.abs(pole) / (2 * np.pi))
        if pole.imag:
            amounts[f"log_decrement_{number}"] = float(-2 * np.pi * pole.real / pole.imag)
        amounts[f"pole_real_{number}"], amounts[f"pole_imag_{number}"] = float(pole.real), float(pole.imag)
    return amounts


BEYOND = 1.5


def certificate(
    settings: CompareSettings, response: FrequencyResponse, file: MagneticFile | None
) -> Comparison:
    """The certificate of a test's loops. ConfigError for what does not fit, FitError without covariance."""
    own = resolve(settings)
    if file is None:
        able = ("before", "after", "test", "log_decrement", "zone", "confidence")
        own.check_written(able, "there is no theory", "theory: {bearing: FILE}, or leave it out")
    matrix = sensitivity.sensitivity_matrix(response, own.before, own.after)
    loops = [matrix.loop(number) for number in range(len(matrix.loops))]
    peaks = [sensitivity.peak_of(loop) for loop in loops]
    worst = max(peaks, key=lambda peak: peak.value)
    measured_amounts, budget = _measured_amounts(matrix, loops, peaks)
    model = None if file is None else _fit(settings, own, response, matrix, file)
    trusted = None if model is None else model.trusted
    limits = [_zone_limit(own, worst, trusted), *_decrement_limits(own, model)]
    amounts, budgets = list(measured_amounts), [budget]
    if model is not None and model.loop is not None:
        of_loop, budget = model.loop.parameters(normal_quantile(0.975))
        amounts += of_loop
        budgets.append(budget)
    amounts += probabilities(limits)
    unsure = undecided_limits(limits)
    verdict = verdict_of(limits, own.confidence)
    parts = [limit.sentence[0].upper() + limit.sentence[1:] for limit in limits]
    parts.append(f"measured without a model: |S| up to {worst.value:.3g} at {worst.frequency:.4g} Hz")
    statement = f"{verdict.capitalize()}: {'; '.join(parts)}."
    if model is not None:
        amounts += [*goodness(model.fit), *model.fit.parameters]
        budgets.append(model.fit.budget)
        statement += f" {fit_statement(model.fit)}"
        if model.rejected:
            unsure += [(name, model.rejected) for name in (*OF_LOOP, *settings.estimate)]
    return Comparison(
        name=settings.name,
        kind="certificate",
        subject=f"closed loop by {', '.join(own.after)}",
        unit="1",
        points=(),
        amounts=tuple(amounts),
        verdict=verdict,
        statement=statement,
        curves=_curves(matrix, loops, model),
        correlations=() if model is None else model.fit.correlations,
        findings=(*_leaking(loops, peaks), *_hidden_crossings(matrix, loops), *_findings(worst, model)),
        budgets=tuple(filter(None, budgets)),
        undecided=tuple(unsure),
    )


def _hidden_crossings(
    matrix: sensitivity.SensitivityMatrix, loops: Sequence[sensitivity.MeasuredSensitivity]
) -> Iterator[Finding]:
    """A finding where noise hides whether a loop crosses |L| = 1, as at a mode of the rotor."""
    frequency, dof = matrix.response.frequency, matrix.response.covariance_dof
    for name, loop in zip(matrix.loops, loops, strict=True):
        for low, high in unsure_crossings(frequency, loop.transfer, dof):
            what = (
                f"|L| of {name} passes 1 between {low:g} and {high:g} Hz, but not beyond its noise: no "
                "measured margin counts what is there, and true ones may be smaller. Inject more there, or "
                "record longer"
            )
            yield Finding("weak-injection", what)


@dataclass(frozen=True)
class FittedBearing:
    """A bearing *file* beside what was recorded: its *fit*, the closed *loop*, None where the fit has no
    intervals. rejected: why nothing is decided by it, empty where it is sound. rate [Hz] of sampling, None in
    continuous time. left_out: signals that the controller computes from, or makes of, the others.
    """

    file: MagneticFile
    fit: LoopFit
    loop: ClosedLoop | None
    rejected: str
    rate: float | None
    left_out: tuple[str, ...]

    @property
    def trusted(self) -> ClosedLoop | None:
        """The closed loop where it is sound."""
        return None if self.rejected else self.loop


# Amounts of a fitted closed loop by the first part of their names.
OF_LOOP = (
    *("sensitivity_*", "gain_margin_*", "phase_margin", "delay_margin", "disk_margin"),
    *("f_n_*", "log_decrement_*", "pole_*"),
)


def resolve(settings: CompareSettings) -> LoopCertificateSettings:
    certificate: LoopCertificateSettings = settings.kind_settings
    twice = {"before", "after"}.intersection(settings.written)
    if twice and (certificate.before or certificate.after):
        what = "the points of a loop are named in the comparison and in its section `certificate`"
        raise SettingError(min(twice), what, "leave them out of one")
    if certificate.after:
        return certificate
    return replace(certificate, before=(settings.before,), after=(settings.after,))


def _measured_amounts(
    matrix: sensitivity.SensitivityMatrix,
    loops: Sequence[sensitivity.MeasuredSensitivity],
    peaks: Sequence[sensitivity.Peak],
) -> tuple[tuple[Parameter, ...], Budget | None]:
    amounts: list[Parameter] = []
    changes: list[FloatArray] = []
    frequency, dof = matrix.response.frequency, matrix.response.covariance_dof
    for name, loop, peak in zip(matrix.loops, loops, peaks, strict=True):
        suffix = f"_{name}" if len(peaks) > 1 else ""
        amounts += peak.amounts(loop.quantile, suffix)
        changes += [peak.changes, peak.frequency_changes]
        noise = dof, loop.quantile
        margins = measured_margins(frequency, loop.transfer, loop.transfer_changes, noise, suffix)
        amounts += [margin for margin, _ in margins]
        changes += [change for _, change in margins]
    if len(peaks) > 1:
        size, error = matrix.largest()
        top = int(np.argmax(size))
        amounts.append(
            with_error("largest_singular_value", "1", float(size[top]), float(error[top]), matrix.quantile)
        )
        amounts.append(Parameter("largest_frequency", float(frequency[top]), "Hz", derived=True))
        changes += [matrix.largest_changes()[:, top], np.zeros(len(matrix.errors))]
    sources = [error.uncertainty for error in matrix.errors]
    return with_budget(amounts, sources, np.array(changes).T, 2 * dof if np.isfinite(dof) else None)


def _fit(
    settings: CompareSettings,
    acceptance: LoopCertificateSettings,
    response: FrequencyResponse,
    matrix: sensitivity.SensitivityMatrix,
    file: MagneticFile,
) -> FittedBearing:
    if len(matrix.loops) != 1:
        hint = "leave theory out, or certify one loop at a time"
        raise ConfigError("a bearing file describes one loop", hint=hint)
    if file.loop.cross is not None:
        what = "a cross-coupled controller couples x and y; a certificate with a theory is that of one loop"
        raise ConfigError(what, hint="leave cross out, or theory")
    rate = acceptance.rate or file.loop.rate
    if acceptance.filtered and rate is None:
        what, hint = "'filtered' is of a loop that is sampled", "rate: 10 kHz, or leave it out"
        raise SettingError("filtered", what, hint)
    observation = recorded_loop(acceptance, response, file, settings.estimate)
    fit = loop_fit([observation], settings.estimate)
    given = fit.usable or not settings.estimate
    loop = closed_loop(file, fit, rate, BEYOND * float(response.frequency[-1])) if given else None
    rejected = ""
    if not sound(fit):
        check = "check signs, units, delays and the controller of the bearing file"
        cause = cause_of(acceptance, response, file, settings.estimate)
        rejected = f"{_why_rejected(fit)}; {cause or check}"
    elif loop is not None and loop.unstable:
        rejected = f"the fitted loop is unstable, {growing(loop.unstable)}, so it cannot be the recorded one"
    return FittedBearing(file, fit, loop, rejected, rate, observation.left_out)


def _why_rejected(fit: LoopFit) -> str:
    if fit.chi2_p < MISMATCH_P:
        per_dof = f"chi-square per degree of freedom {fit.chi2_reduced:.3g}"
        return f"the fitted loop leaves more than noise ({per_dof})"
    return "the fit did not converge" if fit.determined else f"{' and '.join(fit.alike)} cannot be told apart"


def _zone_limit(
    acceptance: LoopCertificateSettings, worst: sensitivity.Peak, loop: ClosedLoop | None
) -> Limit:
    """Probability that the peak of |S| lies within the demanded zone, by its logarithm."""
    peak, error, whose = worst.value, worst.combined, "measured"
    if loop is not None and "sensitivity_peak" in loop.amounts:
        peak, error = loop.amounts["sensitivity_peak"], loop.error("sensitivity_peak")
        whose = "of the fitted loop"
    probability = probability_below(
        np.log(peak), error / peak, np.log(dict(stability.ZONES)[acceptance.zone])
    )
    zone = f"zone {stability.zone_of(peak)} of ISO 14839-3 (peak {peak:.3g} {whose})"
    if worst.at_edge and whose == "measured" and probability > 1 - acceptance.confidence:
        why = f"the largest |S| lies at the edge of the band, {worst.frequency:.4g} Hz: widen the band"
        return Limit("zone", None, f"{zone}; zone {acceptance.zone} or better not judged, since {why}", why)
    return Limit(
        "zone", probability, f"{zone}; zone {acceptance.zone} or better with {probability_text(probability)}"
    )


def _decrement_limits(acceptance: LoopCertificateSettings, model: FittedBearing | None) -> list[Limit]:
    if model is None and acceptance.log_decrement is None:
        return []
    why = "a decrement needs a model, theory: {bearing: FILE}" if model is None else model.rejected
    loop, limit = None if model is None else model.trusted, acceptance.least_decrement
    if loop is None:
        text = f"log decrement above {limit:g} not judged, since {why}"
        return [Limit("log_decrement", None, text, why)]
    if not loop.modes():
        return [Limit("log_decrement", 1.0, "no mode swings: no log decrement to keep")]
    least = min(loop.modes(), key=loop.amounts.__getitem__)
    probability = min(
        probability_below(-loop.amounts[name], loop.error(name), -limit) for name in loop.modes()
    )
    of_mode = f"log decrement {loop.amounts[least]:.3g} of mode {least.rpartition('_')[2]}"
    return [
        Limit(
            "log_decrement", probability, f"{of_mode}; above {limit:g} with {probability_text(probability)}"
        )
    ]


def _curves(
    matrix: sensitivity.SensitivityMatrix,
    loops: Sequence[sensitivity.MeasuredSensitivity],
    model: FittedBearing | None,
) -> tuple[QuantityCurve, ...]:
    curves, frequency, fitted = [], matrix.response.frequency, np.empty(0)
    if model is not None and model.loop is not None:
        plant = with_unknowns(model.file, model.fit.values()).suspension()
        fitted = np.abs(stability.open_loop(plant, 2 * np.pi * frequency, model.rate).sensitivity)
    several = len(loops) > 1
    sizes = [
        (f"sensitivity {name}" if several else "sensitivity", loop.size, loop.combined)
        for name, loop in zip(matrix.loops, loops, strict=True)
    ]
    if several:
        size, error = matrix.largest()
        combined = np.sqrt(error**2 + np.sum(matrix.largest_changes() ** 2, axis=0))
        sizes.append(("largest singular value", size, combined))
    for quantity, size, error in sizes:
        reach = matrix.quantile * error
        shown = {"matched": fitted, "measured": size, "low": size - reach, "high": size + reach}
        curves.append(sensitivity.curve_of("", quantity, "1", frequency=frequency, **shown))
    for name, loop in zip(matrix.loops, loops, strict=True):
        label, transfer = f"L {name}" if several else "L", loop.transfer[0]
        for quantity, part in ((f"{label} real", transfer.real), (f"{label} imaginary", transfer.imag)):
            curves.append(sensitivity.curve_of("", quantity, "1", frequency=frequency, measured=part))
    return tuple(curves)


def _leaking(
    loops: Sequence[sensitivity.MeasuredSensitivity], peaks: Sequence[sensitivity.Peak]
) -> Iterator[Finding]:
    for loop, peak in zip(loops, peaks, strict=True):
        yield from sensitivity.leakage_findings(loop, peak)


def _findings(worst: sensitivity.Peak, model: FittedBearing | None) -> tuple[Finding, ...]:
    findings = worst.findings()
    if model is None:
        return tuple(findings)
    if model.loop is not None and model.loop.unstable:
        what = f"the fitted loop is unstable: {growing(model.loop.unstable)}; check signs, mass and delay"
        findings.append(Finding("unstable-loop", what))
    findings += identifiability_findings(model.fit)
    if model.loop is not None and model.loop.bent:
        what = f"{', '.join(model.loop.bent)} of the fitted loop are not linear in its unknowns"
        what = f"over two standard errors {what}: their intervals are approximate"
        findings.append(Finding("first-order", what))
    if model.fit.chi2_p < MISMATCH_P:
        what = "What intervals there are count the misfit as noise; this model decides nothing"
        findings.append(Finding("model-mismatch", f"{model.rejected}. {what}"))
    if model.left_out:
        what = f"{', '.join(model.left_out)} and the command follow from each other by the controller's law"
        findings.append(note("computed", f"{what}: they count once"))
    return (*findings, note("assumptions", model.file.assumptions()))

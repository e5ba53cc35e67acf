"""What a certificate holds a loop against: its settings, the recorded signals beside their prediction, limits
with the probability that each is kept, and logarithmic decrements.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.display import probability_text
from labpipe.distributions import chi2_tail, normal_quantile, normal_tail
from labpipe.errors import ConfigError, FitError, SettingError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.estimation.measured import Measured, chosen_ports, matrix_errors, measured_part
from labpipe.methods.magnetic_bearing.bearing import MagneticFile
from labpipe.methods.magnetic_bearing.loop_fit import LoopFit, loop_fit
from labpipe.methods.magnetic_bearing.loop_problem import LoopObservation, LoopProblem, unknown, with_unknowns
from labpipe.methods.magnetic_bearing.sensitivity import MOST_SCALED
from labpipe.methods.magnetic_bearing.stability import INPUT, OUTPUT, open_loop
from labpipe.records.comparison import Comparison
from labpipe.records.finding import WARNING, Parameter, of_level
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import Settings, choice, flag, names, quantity, text
from labpipe.records.uncertain import MatrixError
from labpipe.uncertainty.amounts import with_error
from labpipe.uncertainty.settings import CompareSettings

# Zones that a peak of the sensitivity may have to lie in; D has no upper end.
ZONE_NAMES = ("A", "B", "C")
LEAST_DECREMENT = 0.1


@dataclass(frozen=True, kw_only=True)
class LoopCertificateSettings(Settings):
    """What was recorded of the loop, how it is sampled, and the limits of acceptance."""

    before: tuple[str, ...] = names(
        "responses ahead of the sums at which excitations are added, one per loop"
    )
    after: tuple[str, ...] = names("responses behind those sums, one per loop")
    test: str = text("test whose loop it is, where the pipeline has several")
    output: str = text("response that is the command behind the controller, [V]")
    displacement: str = text("response that is the reading of the probe")
    current: str = text("response that is the current")
    injection: str = choice("where the excitation is added: the controller's side", (INPUT, OUTPUT), INPUT)
    rate: float | None = quantity(
        "sampling rate of the controller; default: that of discrete blocks", "Hz", None
    )
    filtered: bool = flag("current and displacement were recorded through a filter against aliasing")
    log_decrement: float | None = quantity(
        "least logarithmic decrement of every mode; default: 0.1 with a model or a fit, else none", "1", None
    )
    zone: str = choice("worst zone of ISO 14839-3", ZONE_NAMES, "B")
    confidence: float = quantity("probability from which a limit counts as kept, or as broken", "1", 0.95)

    def __post_init__(self) -> None:
        if not 0.5 < self.confidence < 1:
            raise SettingError("confidence", "'confidence' must lie between 50 and 100 %")
        self.require_positive("log_decrement", "rate")
        signals = self.recorded[len(self.before) :]
        for name in signals:
            if signals.count(name) > 1:
                raise ConfigError(f"'{name}' is named for two signals", hint="one response for each")
        if self.before and len(self.before) != len(self.after):
            what = f"{len(self.before)} points ahead of a sum and {len(self.after)} behind"
            raise SettingError("before", what, "one per loop")
        if self.filtered and not (self.current or self.displacement):
            what, hint = "'filtered' is of a current or displacement", "name them, or leave it out"
            raise SettingError("filtered", what, hint)

    def check_written(self, able: Sequence[str], why: str, hint: str) -> None:
        """ConfigError for an entry that is none of those that *able* take effect."""
        for name in self.written:
            if name not in able:
                raise SettingError(name, f"'{name}' changes nothing: {why}", hint)

    @property
    def least_decrement(self) -> float:
        """The least logarithmic decrement [1]."""
        return LEAST_DECREMENT if self.log_decrement is None else self.log_decrement

    @property
    def recorded(self) -> tuple[str, ...]:
        return tuple(filter(None, (*self.before, *self.after, self.output, self.displacement, self.current)))


KEPT, BROKEN, UNDECIDED = VERDICTS = "accepted", "not accepted", "undecided"


@dataclass(frozen=True)
class Limit:
    """A limit of acceptance: its *name*, the probability that it is kept, and the sentence that says so.
    Without a probability it could not be judged, and *why* says the reason.
    """

    name: str
    probability: float | None
    sentence: str
    why: str = ""


def probability_below(value: float, error: float, limit: float) -> float:
    """Probability that the truth of a normal estimate lies below a limit. Equation (mag-limit)."""
    if error <= 0:
        return float(value < limit)
    distance = abs(limit - value) / error
    return 1 - normal_tail(distance) if value <= limit else normal_tail(distance)


def verdict_of(limits: Sequence[Limit], confidence: float) -> str:
    """Accepted where all limits are kept with that confidence, not where one is broken, else undecided."""
    judged = [limit.probability for limit in limits if limit.probability is not None]
    if any(probability < 1 - confidence for probability in judged):
        return BROKEN
    kept = len(judged) == len(limits) > 0 and all(probability >= confidence for probability in judged)
    return KEPT if kept else UNDECIDED


def probabilities(limits: Sequence[Limit]) -> list[Parameter]:
    judged = ((limit.name, limit.probability) for limit in limits if limit.probability is not None)
    return [Parameter(f"probability_{name}", probability, "1", derived=True) for name, probability in judged]


def undecided_limits(limits: Sequence[Limit]) -> list[tuple[str, str]]:
    """The probabilities that are not known, and the verdict that rests on them, with the reason."""
    unjudged = [limit for limit in limits if limit.probability is None]
    reasons = "; ".join(dict.fromkeys(limit.why for limit in unjudged))
    names = [(f"probability_{limit.name}", limit.why) for limit in unjudged]
    return [*names, ("verdict", reasons)] if reasons else names


RATIO, DECREMENT = "zeta", "log_decrement"


def decrement_certificate(settings: CompareSettings, fits: Sequence[Fit]) -> Comparison:
    """The probability that every mode of the fits has its decrement; ConfigError for fits without damping
    ratios, and for what is of a loop. Equation (comp-decrement).
    """
    acceptance: LoopCertificateSettings = settings.kind_settings
    why, hint = f"the fit '{settings.fit}' is judged by its decrements", "leave it out, or `fit`"
    acceptance.check_written(("test", "log_decrement", "confidence"), why, hint)
    for key in settings.written:
        if key not in ("kind", "fit"):
            raise SettingError(key, f"'{key}' changes nothing: {why}", hint)
    if acceptance.test:
        fits = [fit for fit in fits if fit.test == acceptance.test]
    # Bands of one test are told apart by their number.
    of_test = [fit.test for fit in fits]
    ends = [
        ("" if len(set(of_test)) < 2 or not fit.test else f"_{fit.test}")
        + (f"_band{1 + of_test[:n].count(fit.test)}" if of_test.count(fit.test) > 1 else "")
        for n, fit in enumerate(fits)
    ]
    amounts = [amount for fit, end in zip(fits, ends, strict=True) for amount in _decrements(fit, end)]
    if not amounts:
        of = f" in test '{acceptance.test}'" if acceptance.test else ""
        hint = "a fit of model modal, decay, or sdof"
        raise ConfigError(f"fit '{settings.fit}' has no damping ratio{of}", hint=hint)
    reasons = (_why_undecided(fit, end) for fit, end in zip(fits, ends, strict=True))
    limits = [_limit(acceptance, amounts, "; ".join(filter(None, reasons)))]
    verdict = verdict_of(limits, acceptance.confidence)
    return Comparison(
        name=settings.name,
        kind="certificate",
        subject=f"logarithmic decrements of {settings.fit}",
        unit="1",
        points=(),
        amounts=(*amounts, *probabilities(limits)),
        verdict=verdict,
        statement=f"{verdict.capitalize()}: {limits[0].sentence}.",
        undecided=tuple(undecided_limits(limits)),
    )


# Warnings of a fit with which its decrements decide nothing.
REJECTING = ("feedback", "no-convergence", "model-mismatch")


def _why_undecided(fit: Fit, end: str) -> str:
    of_test = f" of test '{fit.test}'" if end and fit.test else ""
    warnings = of_level(WARNING, fit.findings)
    codes = dict.fromkeys(finding.code for finding in warnings if finding.code in REJECTING)
    if codes or not fit.converged:
        return f"the fit{of_test} is rejected ({', '.join(codes) or 'no-convergence'})"
    there = [amount for amount in _decrements(fit, end) if np.isfinite(amount.value)]
    plain = ", ".join(amount.name for amount in there if amount.full_error is None)
    return f"{plain} has no standard error" if plain else ""


def _decrements(fit: Fit, end: str) -> list[Parameter]:
    """2 pi z / sqrt(1 - z^2) of every damping ratio with its interval, or the fit's own decrements."""
    given = [parameter for parameter in fit.parameters if parameter.name.startswith(DECREMENT)]
    decrements = given or [
        _decrement_of_ratio(parameter)
        for parameter in fit.parameters
        if parameter.name.partition("_")[0] == RATIO
    ]
    return [replace(parameter, name=parameter.name + end) for parameter in decrements]


def _decrement_of_ratio(ratio: Parameter) -> Parameter:
    """The decrement of a damping ratio; infinite to either side of a mode that does not swing, |z| >= 1."""
    name = DECREMENT + ratio.name.removeprefix(RATIO)
    if not abs(ratio.value) < 1:
        return Parameter(name, float(np.copysign(np.inf, ratio.value)), "1", derived=True)
    value, slope = _decrement(ratio.value), 2 * np.pi / (1 - ratio.value**2) ** 1.5
    if ratio.full_error is None:
        return Parameter(name, value, "1", derived=True)
    plain = with_error(name, "1", value, float(slope) * ratio.full_error, normal_quantile(0.975))
    if ratio.ci95 is None or max(abs(end) for end in ratio.ci95) >= 1:
        return plain
    return replace(plain, ci95=(_decrement(ratio.ci95[0]), _decrement(ratio.ci95[1])))


def _decrement(ratio: float) -> float:
    return float(2 * np.pi * ratio / np.sqrt(1 - ratio**2))


def _limit(acceptance: LoopCertificateSettings, amounts: Sequence[Parameter], why: str) -> Limit:
    least = min(amounts, key=lambda amount: amount.value)
    limit = acceptance.least_decrement
    text = f"log decrement {least.value:.3g} ({least.name}) is the least; above {limit:g}"
    if why:
        return Limit(DECREMENT, None, f"{text} not judged, since {why}", why)
    probability = min(
        probability_below(-amount.value, amount.full_error or 0.0, -limit) for amount in amounts
    )
    return Limit(DECREMENT, probability, f"{text} with {probability_text(probability)}")


# Powers of ten by which a signal of a wrong unit or sensitivity is off.
POWERS = (-9, -6, -3, -2, -1, 1, 2, 3, 6, 9)
# Share of the noise of a signal that is its own below which it is rounding; share of the scatter of what two
# signals leave of the controller's law below which one is computed from the other.
EXACT, COMPUTED = 1e-10, 0.5
# So many causes that come nearest before a fit are fitted.
FITTED_CAUSES = 4


def recorded_loop(
    acceptance: LoopCertificateSettings,
    response: FrequencyResponse,
    file: MagneticFile,
    estimate: Sequence[str] = (),
) -> LoopObservation:
    """All recorded signals and their prediction, but for those that the controller computes from others.

    With both sides of the sum what is truly added is a complex unknown of every line, the most likely one, so
    that neither gain nor delay of the recorded excitation counts.
    """
    rate = acceptance.rate or file.loop.rate
    named = {signal: getattr(acceptance, signal) for signal in ("output", "displacement", "current")}
    named = {"after": acceptance.after[0], **named, "before": "".join(acceptance.before)}
    rows = {key: chosen_ports(response.outputs, (name,), "response") for key, name in named.items() if name}
    signals = {signal: chosen[0] for signal, chosen in rows.items()}
    if len(response.inputs) != 1:
        hint = "role: input for the excitation alone"
        raise ConfigError(f"one loop has one excitation, not {len(response.inputs)}", hint=hint)
    lines = np.ones(response.frequency.size, bool)
    loop = replace(response, form="receptance")
    measured = measured_part(loop, list(signals.values()), [0], lines)
    computed = _computed_signals(acceptance, measured, list(signals), file, estimate)
    if computed:
        signals = {signal: row for signal, row in signals.items() if signal not in computed}
        measured = measured_part(loop, list(signals.values()), [0], lines)
    # sensitivity_matrix has refused a response without noise.
    assert measured.covariance is not None
    size = np.sqrt(np.einsum("lcc->lc", measured.covariance).real)
    scaled = measured.covariance / np.maximum(size[:, :, None] * size[:, None], np.finfo(float).tiny)
    exact = np.flatnonzero(np.linalg.eigvalsh(scaled)[:, 0] < EXACT)
    if exact.size:
        what = f"the noise at {response.frequency[exact[0]]:g} Hz is that of fewer signals than are named"
        why = "one has none, or is the sum of others (after = before + excitation of a digital controller)"
        raise FitError(f"{what}: {why}", hint="leave one out: `after` alone, where the excitation is exact")
    weights = np.linalg.inv(measured.covariance)

    def change_per_added(changed: MagneticFile) -> ComplexArray:
        loop = open_loop(changed.suspension(), measured.omega, rate, acceptance.filtered)
        predicted = loop.signals(acceptance.injection)
        return np.stack([predicted[name] for name in signals], axis=1)

    def along(per: ComplexArray, vectors: ComplexArray) -> ComplexArray:
        """The part of vectors (n_line, n_signal) that some true addition explains, the most likely one."""
        weighted = np.einsum("la,lab->lb", per.conj(), weights)
        added = np.sum(weighted * vectors, axis=1) / np.sum(weighted * per, axis=1)
        return per * added[:, None]

    def predict(changed: MagneticFile, _: tuple[float, float]) -> ComplexArray:
        per = change_per_added(changed)
        return (along(per, measured.matrix[:, :, 0]) if acceptance.before else per)[:, :, None]

    def errors(changed: MagneticFile, support: tuple[float, float]) -> Sequence[MatrixError]:
        # Changes of the predicted signals: in proportion to measured ones a gain would shrink their noise
        # with them. What is common to all of them is added then, and cancels to the last digit.
        uncertainties = matrix_errors(_prediction_of(measured, predict(changed, support)))
        if not acceptance.before:
            return uncertainties
        per = change_per_added(changed)
        return [
            replace(error, change=error.change - along(per, error.change[:, :, 0])[:, :, None])
            for error in uncertainties
        ]

    nuisance = 2 * measured.omega.size if acceptance.before else 0
    left_out = tuple(named[signal] for signal in computed)
    return LoopObservation(measured, predict, file, nuisance=nuisance, errors=errors, left_out=left_out)


def _prediction_of(measured: Measured, predicted: ComplexArray) -> Measured:
    """The responses *predicted* (n_line, n_signal, 1) [SI] in place of the measured ones, whose errors change
    them in proportion: those in proportion to what was measured would have its noise.
    """
    matrix = measured.matrix
    near = np.abs(matrix) > np.abs(predicted) / MOST_SCALED
    ratio = np.divide(predicted, matrix, out=np.ones_like(matrix), where=near)
    errors = tuple(replace(error, change=error.change * ratio) for error in measured.errors)
    return replace(measured, matrix=predicted, errors=errors)


# As in a fit, magnets may outgrow all numbers.
@np.errstate(over="ignore", invalid="ignore")
def _computed_signals(
    acceptance: LoopCertificateSettings,
    measured: Measured,
    signals: list[str],
    file: MagneticFile,
    estimate: Sequence[str],
) -> list[str]:
    """Those of the *signals* that tell nothing beside the others: a controller computes one from the other
    and logs both. What they leave of its law is leakage, of which all but the ends of the record cancels in
    the mean of the periods, and nothing in their scatter.
    """
    assert measured.covariance is not None
    moved = with_unknowns(file, {name: 1.01 * unknown(file, name).value for name in estimate})
    rate = acceptance.rate or file.loop.rate
    loop, other = (open_loop(each.suspension(), measured.omega, rate) for each in (file, moved))
    if acceptance.filtered or loop.sensor != other.sensor or np.any(loop.controller != other.controller):
        return []
    sensor = np.full_like(loop.controller, loop.sensor)
    reading = sensor * loop.controller if acceptance.injection == OUTPUT else sensor
    laws = [("displacement", *(("before", 0.0) if acceptance.before else ("after", 1.0)), reading)]
    if acceptance.injection == INPUT:
        laws.append(("output", "after", 0.0, 1 / loop.controller))
    computed = []
    for signal, of, added, law in laws:
        if signal in signals:
            slopes = np.zeros(measured.matrix.shape[:2], np.complex128)
            slopes[:, signals.index(of)], slopes[:, signals.index(signal)] = 1.0, -law
            left = np.einsum("la,la->l", slopes, measured.matrix[:, :, 0]) - added
            variance = np.einsum("la,lab,lb->l", slopes, measured.covariance, slopes.conj()).real
            chi2, dof = 2 * float(np.sum(np.abs(left) ** 2 / variance)), 2 * left.size
            if chi2 < COMPUTED * dof and chi2_tail(chi2, dof) > 1 - MISMATCH_P:
                computed.append(signal)
    return computed


def cause_of(
    acceptance: LoopCertificateSettings,
    response: FrequencyResponse,
    file: MagneticFile,
    estimate: Sequence[str],
) -> str:
    """The one change of sign, power of ten or place of injection with which the fit is good, or empty."""
    changes = []
    for what, changed_acceptance, changed in _changes(acceptance, response):
        observation = recorded_loop(changed_acceptance, changed, file, estimate)
        problem = LoopProblem((observation,), (), ())
        changes.append((problem.chi2(problem.start), what, observation))
    for _, what, observation in sorted(changes, key=lambda change: change[0])[:FITTED_CAUSES]:
        fit = loop_fit([observation], estimate)
        if sound(fit):
            return f"{what} the fit is good (chi-square per degree of freedom {fit.chi2_reduced:.3g})"
    return ""


def sound(fit: LoopFit) -> bool:
    """True where the fit has determined values, if it has unknowns, and leaves no more than noise."""
    return fit.chi2_p >= MISMATCH_P and (fit.usable or not fit.parameters)


def _changes(
    acceptance: LoopCertificateSettings, response: FrequencyResponse
) -> Iterator[tuple[str, LoopCertificateSettings, FrequencyResponse]]:
    place = INPUT if acceptance.injection == OUTPUT else OUTPUT
    yield f"with injection: {place}", replace(acceptance, injection=place), response
    signals = list(dict.fromkeys(acceptance.recorded))
    excitation = [] if acceptance.before else [response.inputs[0].label]
    for name in (*signals, *excitation):
        for factor in (-1.0, *(sign * 10.0**power for power in POWERS for sign in (1, -1))):
            # More of the excitation is less of all responses to it.
            scale = np.full(len(response.outputs), 1 / factor)
            if name in signals:
                scale[:] = 1.0
                scale[chosen_ports(response.outputs, (name,), "response")[0]] = factor
            assert response.covariance is not None
            changed = replace(
                response,
                matrix=response.matrix * scale[:, None],
                covariance=response.covariance * np.outer(scale, scale),
                errors=tuple(
                    replace(error, change=error.change * scale[:, None]) for error in response.errors
                ),
            )
            yield _words(name, factor), acceptance, changed


def _words(name: str, factor: float) -> str:
    if factor == -1:
        return f"with the sign of '{name}' changed (invert: in the rig file)"
    sign = " and its sign changed" if factor < 0 else ""
    return f"with '{name}' times {abs(factor):g}{sign} (its unit or sensitivity in the rig file)"

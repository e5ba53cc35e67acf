"""A test of several recordings, or hits, of the same FRFs: each is fitted alone, and parameters are means of
these repeats. What follows the level of the force is stated at the middle one, what drifts in the middle.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import FitError
from labpipe.estimation.derived import with_systematic
from labpipe.estimation.repeats import (
    LEAST_RANGE,
    PRIOR_SCALE,
    Kept,
    RepeatMean,
    drifts,
    follows,
    groups_of,
    groups_text,
    kept_repeats,
    mean_of_groups,
    repeat_mean,
)
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import restate, student_limit
from labpipe.records.finding import NORMAL, Finding, IntervalParts, Parameter, Repeats, note
from labpipe.records.identification import Fit, FittedCurve
from labpipe.records.response import FrequencyResponse, diagonal_covariance
from labpipe.records.uncertain import Budget

# Quantities that no gain changes, whose scatter is known from measured structures.
FREQUENCY, DAMPING = ("f_n",), ("zeta", "eta")
# Scale of the prior of others over their scatter or noise: three repeats then hold 95 % at any spread.
WIDER = 2.0
# What values may follow.
LEVEL, ORDER = "level of the force", "order of recording"
# Neighbouring lines that share the scatter of the aligned residuals, and the least share they divide by.
NEIGHBOURS, LEAST_REST = 15, 0.02
# Parameters of a numbered mode; half-power widths, and share of a frequency, within which two are the same.
MODE = re.compile(r"(f_n|zeta|eta|m|k|c)_(\d+)$")
NEAR_WIDTHS, NEAR = 4.0, 0.01
# The fits of a response by settings, whose residual is judged or not.
Fitting = Callable[[FrequencyResponse, FitSettings, bool], tuple[Fit, ...]]


@dataclass(frozen=True)
class _Test:
    response: FrequencyResponse
    settings: FitSettings
    fitting: Fitting

    def fits_of_one(self, place: int) -> tuple[Fit, ...]:
        """The fits of the recording at a *place*, whose noise its own residual shows; that of all weighs its
        lines. Of a sweep that zeros follow, lines d apart share sin(pi d s) / (pi d s), s its share.
        """
        of_all = None if self.settings.weight == "none" else self.response.covariance
        shares, correlation = self.response.repeat_shares, self.response.line_correlation
        if shares is not None:
            correlation = tuple(map(complex, np.sinc(shares[place] * np.arange(1, len(correlation) + 1))))
        assert self.response.repeats is not None
        recording = replace(
            self.response,
            matrix=self.response.repeats[place],
            line_correlation=correlation,
            covariance=None if of_all is None else len(self.response.repeat_names) * of_all,
            change=None,
            open_loop=None,
            distortion=None,
            repeats=None,
            repeat_names=(),
            repeat_levels=None,
            repeat_shares=None,
            averages=1.0,
            covariance_dof=float("inf"),
            findings=(),
        )
        fits = self.fitting(recording, self.settings, False)
        if not all(fit.converged for fit in fits):
            raise FitError("its fit does not converge")
        return fits

    def name_of(self, name: str) -> str:
        """One of them, as a sentence begins with it."""
        return f"recording '{name}'" if self.response.repeats_are == "recordings" else name

    def levels(self, places: Sequence[int]) -> FloatArray | None:
        """Of the force, (n,) [its unit], in the recordings at *places*; None where they are not known."""
        levels = self.response.repeat_levels
        return None if levels is None or not np.all(levels > 0) else levels[list(places)]


def mean_over_repeats(
    pooled: tuple[Fit, ...], response: FrequencyResponse, settings: FitSettings, fitting: Fitting
) -> tuple[Fit, ...]:
    """The fits with their parameters as means over the recordings, or the hits, of a *response*.

    *pooled*: the fits of all of them together; *fitting* makes those of one. As they are where fewer than
    two recordings can be fitted. Equations (repeats-mean), (repeats-aligned).
    """
    assert response.repeats is not None
    test = _Test(response, settings.kind.of_repeat(settings, pooled), fitting)
    # By place: recordings of several folders may have one name.
    repeats: dict[int, tuple[Fit, ...]] = {}
    failed = []
    for place in range(len(response.repeats)):
        try:
            fits = test.fits_of_one(place)
        except FitError as error:
            named = test.name_of(response.repeat_names[place])
            failed.append(note("repeat-left-out", f"{named} is left out: {error.what}"))
            continue
        if len(fits) == len(pooled):
            repeats[place] = tuple(map(_numbered_as, pooled, fits))
    pooled = tuple(replace(fit, findings=(*fit.findings, *failed)) for fit in pooled)
    if len(repeats) < 2:
        return pooled
    pooled = tuple(_drop_scatter(fit, response) for fit in pooled)
    by_fit = zip(pooled, zip(*repeats.values(), strict=True), strict=True)
    return tuple(_mean_over(fit, tuple(repeats), of_fit, test) for fit, of_fit in by_fit)


def _drop_scatter(pooled: Fit, response: FrequencyResponse) -> Fit:
    """The fit without that part of systematic errors that differs from repeat to repeat, since their scatter
    holds it.
    """
    left = {error.uncertainty.source: 0.0 for error in response.errors if error.by_repeat}
    calibrations = [c for port in (*response.outputs, *response.inputs) for c in port.uncertainties]
    left |= {c.uncertainty.source: 1 - c.shown for c in calibrations if c.shown}
    if not left or (budget := pooled.budget) is None:
        return pooled
    budget = budget.enlarge(left)
    kept = [number for number, source in enumerate(budget.sources) if source.std_error > 0]
    sources = tuple(budget.sources[number] for number in kept)
    budget = replace(budget, sources=sources, changes=budget.changes[kept], drawn=None)
    sizes = dict(zip(budget.names, map(float, budget.systematic), strict=True))
    parameters = tuple(replace(p, systematic=sizes.get(p.name) if kept else None) for p in pooled.parameters)
    return replace(pooled, parameters=parameters, budget=budget if kept else None)


def _numbered_as(pooled: Fit, fit: Fit) -> Fit:
    """The *fit* with every mode under the number of the mode of *pooled* that is nearest in frequency; modes
    far from all of them lose their parameters.
    """
    values = {parameter.name: parameter.value for parameter in pooled.parameters}
    ours, theirs = (
        {
            matched[2]: p.value
            for p in of.parameters
            if (matched := MODE.match(p.name)) and matched[1] == "f_n"
        }
        for of in (pooled, fit)
    )
    if ours.keys() == theirs.keys() and len(ours) < 2:
        return fit
    distance = np.abs(np.log(np.array(list(theirs.values()))[:, None] / np.array(list(ours.values()))))
    numbers = {}
    for place, other in zip(*scipy.optimize.linear_sum_assignment(distance), strict=True):
        number = list(ours)[other]
        if distance[place, other] < max(NEAR_WIDTHS * 2 * abs(values.get(f"zeta_{number}", 0.0)), NEAR):
            numbers[list(theirs)[place]] = number
    parameters = []
    for parameter in fit.parameters:
        match = MODE.match(parameter.name)
        if match is None or match[2] not in theirs:
            parameters.append(parameter)
        elif match[2] in numbers:
            parameters.append(replace(parameter, name=f"{match[1]}_{numbers[match[2]]}"))
    return replace(fit, parameters=tuple(parameters))


@dataclass(frozen=True)
class RepeatValues:
    """A parameter of every repeat: values, variances by noise (n,) [SI], of its logarithm where *log*."""

    values: FloatArray
    variances: FloatArray
    log: bool

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> RepeatValues:
        values = np.array([p.value for p in parameters])
        errors = np.array([p.std_error or 0.0 for p in parameters])
        if np.all(values * values[0] > 0):
            return cls(np.log(np.abs(values)), (errors / values) ** 2, True)
        return cls(values, errors**2, False)


def _mean_over(pooled: Fit, places: Sequence[int], repeats: Sequence[Fit], test: _Test) -> Fit:
    recordings = [test.response.repeat_names[place] for place in places]
    by_name = [{parameter.name: parameter for parameter in fit.parameters} for fit in repeats]
    names = [p.name for p in pooled.parameters if all(_usable(of.get(p.name)) for of in by_name)]
    if not names:
        return pooled
    columns = {name: RepeatValues.of([of_repeat[name] for of_repeat in by_name]) for name in names}
    judged = [name for name in names if name.startswith((*FREQUENCY, *DAMPING))] or names
    groups = groups_of(test.settings.repeat_groups, recordings) if test.settings.repeat_groups else ()
    levels = None if groups else test.levels(places)
    kept, course = _course(levels, [columns[name] for name in judged], groups)
    used = [bool(of_repeat) for of_repeat in kept.used]
    good = [fit for fit, is_used in zip(repeats, used, strict=True) if is_used]
    common = {parameter.name: parameter for parameter in _common(pooled, good, test)}
    ratios = {p.name.partition("_")[2]: abs(p.value) for p in pooled.parameters if p.name.startswith(DAMPING)}
    means, stated = {}, []
    for parameter in pooled.parameters:
        name = parameter.name
        # Of what some repeats do not show, the others are the repeats.
        shown = [
            place
            for place, of in enumerate(by_name)
            if used[place] and (name in columns or _usable(of.get(name)))
        ]
        if name in columns or 2 * len(shown) > len(good) > 1:
            of = RepeatValues.of([by_name[place][name] for place in shown])
            along = None if course is None else course.covariate[[sum(used[:place]) for place in shown]]
            scale = prior_scale(parameter, of, ratios)
            of_groups = [groups[place] for place in shown] if groups else ()
            means[name] = (
                mean_of_groups(of.values, of.variances, of_groups, scale)
                if len(set(of_groups)) > 1
                else repeat_mean(of.values, of.variances, scale, along)
            )
            summary = Repeats(
                len(test.response.repeat_names),
                of.values.size,
                means[name].spread,
                (),
                "" if course is None else course.of,
                None if course is None else course.at,
                len(set(of_groups)),
            )
            ends = () if groups or name not in columns else (0, -1)
            aside = [by_name[end][name] for end in ends if not used[end]]
            shared = common.get(name)
            stated.append(stated_mean(parameter, means[name], of, shared, pooled.error_dof, summary, aside))
        else:
            stated.append(parameter)
    stated, budget = _with_given(stated, pooled.budget, means)
    return replace(
        pooled,
        parameters=tuple(stated),
        budget=budget,
        findings=(*pooled.findings, *_findings(recordings, kept, means, test, course)),
        notes=(*pooled.notes, _wording(sum(used), tuple(dict.fromkeys(groups)), test, course)),
    )


def _with_given(
    stated: list[Parameter], budget: Budget | None, means: Mapping[str, RepeatMean]
) -> tuple[list[Parameter], Budget | None]:
    """The parameters, and what given numbers add to the uncertainty of the *means* among them."""
    if budget is None:
        return stated, None
    budget = budget.with_random({p.name: p.full_error for p in stated if p.name in means and p.full_error})
    plain = {p.name: p for p in stated}
    wide = {p.name: p for p in with_systematic([plain[name] for name in budget.names], budget)}
    return [wide.get(p.name, p) if p.name in means else p for p in stated], budget


@dataclass(frozen=True)
class _Covariate:
    """What values follow, *of* LEVEL or ORDER: the *covariate* (n_used,) [1], 0 where stated, *at*."""

    of: str
    covariate: FloatArray
    at: float


def _course(
    levels: FloatArray | None, judged: Sequence[RepeatValues], groups: Sequence[str]
) -> tuple[Kept, _Covariate | None]:
    """Which repeats are used, and what *judged* follows: their *levels* (n,) over the middle one less 1, else
    their order, from -1/2 to 1/2; None where neither, or of named *groups*.
    """
    values = np.stack([of.values for of in judged], axis=1)
    variances = np.stack([of.variances for of in judged], axis=1)
    if groups:
        return kept_repeats(values, variances, groups=groups), None
    middle = 1.0 if levels is None else float(np.median(levels))
    covariate = np.zeros(len(values)) if levels is None else levels / middle - 1
    kept = kept_repeats(values, variances, covariate if np.ptp(covariate) >= LEAST_RANGE else None)
    chosen = [(of.values[kept.used], of.variances[kept.used]) for of in judged]
    of_level, order = covariate[kept.used], np.linspace(-0.5, 0.5, len(values))[kept.used]
    if any(follows(*of, of_level) for of in chosen):
        return kept, _Covariate(LEVEL, of_level, middle)
    if any(drifts(*of, order) for of in chosen):
        return kept, _Covariate(ORDER, order, (len(values) + 1) / 2)
    return kept, None


def _usable(parameter: Parameter | None) -> bool:
    return parameter is not None and bool(parameter.std_error) and bool(np.isfinite(parameter.value))


def prior_scale(parameter: Parameter, of: RepeatValues, ratios: Mapping[str, float]) -> float:
    """Of the prior of the scatter: 0.3 zeta of ln f, 0.3 of ln zeta, else twice the scatter of the repeats or
    their noise, also that of the *parameter* of all together.
    """
    name = parameter.name
    if of.log and name.startswith(FREQUENCY):
        return PRIOR_SCALE * ratios.get(name.removeprefix("f_n").removeprefix("_"), 0.01)
    if of.log and name.startswith(DAMPING):
        return PRIOR_SCALE
    together = (parameter.std_error or 0.0) / (abs(parameter.value) if of.log and parameter.value else 1.0)
    noise = max(float(np.sqrt(np.median(of.variances))), together * float(np.sqrt(of.values.size)))
    return WIDER * max(float(np.std(of.values, ddof=1)), noise, float(np.finfo(float).tiny))


def _common(pooled: Fit, repeats: Sequence[Fit], test: _Test) -> tuple[Parameter, ...]:
    """Of the aligned mean: the mean residual of all repeats on the curve of the pooled fit has the model
    error that they share, and no longer what moved between them.
    """
    curves = [fit.curve for fit in repeats if fit.curve is not None]
    if pooled.curve is None or len(curves) < len(repeats):
        return ()
    aligned = _align(pooled.curve, curves, test.response)
    if aligned is None:
        return ()
    settings = replace(test.settings, band=pooled.band_hz, bands=(), sliding=None)
    try:
        fits = test.fitting(aligned, settings, True)
    except FitError:
        return ()
    return _numbered_as(pooled, fits[0]).parameters if len(fits) == 1 else ()


def _align(
    pooled: FittedCurve, curves: Sequence[FittedCurve], response: FrequencyResponse
) -> FrequencyResponse | None:
    """The curve of the pooled fit and the mean residual of its repeats, with the scatter of that; None of a
    part of the FRFs, or without scatter.
    """
    outputs = tuple(port for port in response.outputs if port.label in pooled.outputs)
    inputs = tuple(port for port in response.inputs if port.label in pooled.inputs)
    shape = pooled.fitted.shape
    if shape[1:] != (len(outputs), len(inputs)) or any(curve.fitted.shape != shape for curve in curves):
        return None
    residuals = np.array([curve.measured - curve.fitted for curve in curves])
    mean, n = np.mean(residuals, axis=0), len(curves)
    square = np.sum(np.abs(residuals - mean) ** 2, axis=0) / n**2 / max(1 - 1 / n, LEAST_REST)
    kernel = np.ones(min(NEIGHBOURS, shape[0]))
    counts = np.convolve(np.ones(shape[0]), kernel, mode="same")
    columns = [np.convolve(column, kernel, mode="same") / counts for column in square.reshape(shape[0], -1).T]
    smooth = np.array(columns).T.reshape(shape) * shape[0] / max(shape[0] - 4, 1)
    if not np.all(smooth > 0):
        return None
    matrix, covariance = pooled.fitted + mean, diagonal_covariance(smooth)
    aligned = FrequencyResponse(pooled.frequency, matrix, outputs, inputs, covariance=covariance)
    return replace(aligned, form=response.form, name=response.name)


def _common_part(common: Parameter | None, *, log: bool) -> tuple[float, FloatArray]:
    """Shift by the model error that all repeats share, and how far (2,) it reaches down and up from there, of
    the logarithm if *log*; without end where it leaves the parameter undetermined.
    """
    if common is None or common.fitted is None:
        return 0.0, np.zeros(2)
    if common.std_error is None or common.ci95 is None:
        return 0.0, np.full(2, np.inf)
    numbers = np.array([common.fitted, common.value, *common.ci95])
    unit = abs(common.value) if log else 1.0
    on_scale = np.log(np.abs(numbers)) if log and abs(np.sum(np.sign(numbers))) == 4 else numbers / unit
    fitted, value, low, high = on_scale.tolist()
    sides = np.maximum([value - min(low, high), max(low, high) - value], 0.0)
    noise = NORMAL * common.std_error / unit
    return value - fitted, np.sqrt(np.maximum(sides**2 - noise**2, 0.0))


def stated_mean(
    parameter: Parameter,
    mean: RepeatMean,
    of: RepeatValues,
    common: Parameter | None,
    dof: int,
    summary: Repeats,
    aside: Sequence[Parameter] = (),
) -> Parameter:
    """The mean with the hull of its interval, that with the shared model error, and the first or last repeat
    *aside*, which may be another state; without what given numbers add.
    """
    shift, extra = _common_part(common, log=of.log)
    between, (down, up) = mean.half_width, np.hypot(mean.half_width, extra).tolist()
    low = min(mean.value - between, mean.value + shift - down)
    high = max(mean.value + between, mean.value + shift + up)
    sign = float(np.sign(parameter.value)) if of.log else 1.0

    # An interval may reach as far as numbers do.
    @np.errstate(over="ignore")
    def back(value: float) -> float:
        return sign * float(np.exp(value)) if of.log else float(value)

    value, ends = back(mean.value), sorted((back(low), back(high)))
    unit, limit = abs(value) if of.log else 1.0, student_limit(dof)
    error = float(np.sqrt(mean.weights**2 @ of.variances)) * unit
    full, interval = max((high - low) / 2 / limit * unit, error), (ends[0], ends[1])
    for other in aside:
        reach = limit * float(np.hypot(other.std_error or 0.0, mean.spread * unit))
        interval = (min(interval[0], other.value - reach), max(interval[1], other.value + reach))
        between = max(between, (interval[1] - interval[0]) / 2 / unit)
    scatter = float(np.sqrt(max((between * unit / limit) ** 2 - error**2, 0.0)))
    full = max(full, float(np.hypot(scatter, error)))
    return restate(
        parameter,
        value,
        full,
        interval,
        std_error=error,
        interval=IntervalParts(error, repeats=scatter),
        systematic=None,
        fitted=None,
        reason=common.reason if common is not None and max(extra) > between else "",
        discrepancy=None if common is None else common.discrepancy,
        repeats=replace(summary, spread=mean.spread * unit, values=tuple(back(value) for value in of.values)),
    )


def _wording(used: int, groups: Sequence[str], test: _Test, course: _Covariate | None) -> str:
    response = test.response
    recorded, what = len(response.repeat_names), response.repeats_are
    over = f"{used} {what}" if used == recorded else f"{used} of {recorded} {what}"
    over += groups_text(groups)
    level = ""
    if course is not None and course.of == LEVEL:
        size = f"{'a peak' if what == 'hits' else 'an r.m.s.'} of {course.at:.3g} [SI]"
        level = (
            f" They follow the level of '{response.inputs[0].label}' and hold at {size}, the middle one; for "
            "levels that were not measured nothing is stated."
        )
    elif course is not None:
        level = f" They drift, and hold in the middle of the {what}."
    return (
        f"values are means over {over}, each fitted alone; intervals hold what these scatter by and the "
        f"model error that they share.{level} `repeats: pool` fits all of them together."
    )


def _findings(
    names: Sequence[str], kept: Kept, means: Mapping[str, RepeatMean], test: _Test, course: _Covariate | None
) -> list[Finding]:
    what = test.response.repeats_are
    if kept.two_populations:
        message = (
            f"more than a quarter of the {what}, or the first or last ones, lie apart from the others: two "
            "populations, and the mean is of both. Name the groups (repeat_groups)"
        )
        return [Finding("two-populations", message)]
    # One state before, or after, all others looks like a bad recording.
    step = "; the interval holds it as well, since it may be another state: name the groups (repeat_groups)"
    findings = [
        note(
            "repeat-left-out",
            f"{test.name_of(name)} is left out: its frequency or damping stands out"
            + (step if name in (names[0], names[-1]) else ""),
        )
        for name, is_used in zip(names, kept.used, strict=True)
        if not is_used
    ]
    judged = {name: mean for name, mean in means.items() if name.startswith((*FREQUENCY, *DAMPING))}
    if course is not None and course.of == ORDER:
        # Errors of a slope over the order are sqrt(12) times those of the mean.
        changes = ", ".join(
            f"{name} by {100 * mean.slopes[0]:+.2g} %"
            for name, mean in judged.items()
            if abs(mean.slopes[0]) > 12**0.5 * mean.half_width
        )
        message = (
            f"the values drift from the first of the {what} to the last ({changes}), and are those in the "
            "middle. Record what changes (temperature), or name the groups (repeat_groups)"
        )
        findings.append(note("repeats-in-order", message))
    ordered = [name for name, mean in judged.items() if mean.ordered]
    if ordered:
        message = (
            f"{', '.join(ordered)}: neighbouring {what} are alike, so the values drift or come in "
            "steps (temperature, mounting). The interval allows for it; record what changes, or name "
            "the groups (repeat_groups)"
        )
        findings.append(note("repeats-in-order", message))
    return findings

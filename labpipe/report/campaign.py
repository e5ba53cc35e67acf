"""The report of a campaign: every coefficient over the conditions of its tests, its control limits, and who
differs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import difference_in, unit_label, write_values
from labpipe.errors import DataError, FitError
from labpipe.quantities import display_unit, to_display
from labpipe.records.dataset import DATE, amount_of, day_of
from labpipe.records.identification import Fit, Identification, ListedParameter, listed_parameters, of_points
from labpipe.registry import few
from labpipe.report.chart import CONTROL, Axis, Panel, Series, control_lines, curve, dots, named_ticks, stack
from labpipe.report.cover import DATES, cover_facts
from labpipe.report.document import Block, Document, Figure, Paragraph, Section, Table
from labpipe.report.figures import CENTRE, sliding_curve, sliding_units
from labpipe.report.wording import round_to_error, unit_text
from labpipe.uncertainty import weighted
from labpipe.uncertainty.amounts import count_once, holm, sources_in_common


@dataclass(frozen=True, kw_only=True)
class Value(ListedParameter):
    """A parameter in one result; *label*: distinct label of the test; *when*: the date that its conditions
    give, maybe with an hour, '' where they give none; digests: of the files behind the result.
    """

    label: str
    conditions: Mapping[str, tuple[float, str]]
    when: str
    digests: frozenset[str]


@dataclass(frozen=True)
class CoefficientSeries(weighted.SeriesOfTests):
    """The values of one parameter of one fit, by dates where all have one, else in the order given. copies:
    of the same recordings as these, which count once.
    """

    fit: str
    name: str
    tests: tuple[Value, ...]
    copies: tuple[Value, ...] = ()

    @property
    def title(self) -> str:
        return f"{self.name} of {self.fit}"

    @property
    def unit(self) -> str:
        return display_unit(self.tests[0].parameter.unit)

    @property
    def axis(self) -> Axis:
        return Axis(self.name, unit_text(self.tests[0].parameter.unit))

    @property
    def dated(self) -> bool:
        return all(value.when for value in self.tests)

    @property
    def values(self) -> FloatArray:
        """Values (n,) [display unit]."""
        return np.array([to_display(value.parameter.value, self.unit) for value in self.tests])

    def errors(self) -> FloatArray:
        """Standard errors (n,) [display unit], NaN where a fit has none."""
        return self._in_unit([value.parameter.full_error for value in self.tests])

    def _in_unit(self, errors: Sequence[float | None]) -> FloatArray:
        return np.array([np.nan if error is None else difference_in(error, self.unit) for error in errors])

    @property
    def parted_errors(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of each test alone (n,), by sources (n_source, n) [display unit], dof (n_source,) [1]."""
        alone = self._in_unit([value.random_error for value in self.tests])
        changes, dofs = sources_in_common([(value.changes, value.dofs) for value in self.tests])
        return alone, difference_in(1.0, self.unit) * changes, dofs

    def intervals(self) -> FloatArray:
        """95 % intervals (n, 2) [display unit], NaN where there is none."""
        ends = [value.parameter.ci95 or (np.nan, np.nan) for value in self.tests]
        return np.array([[to_display(end, self.unit) for end in pair] for pair in ends])

    def over(self) -> dict[str, tuple[Axis, FloatArray]]:
        """condition -> (axis, values (n,) [axis unit]) for every amount that all tests have and that differs
        between them.
        """
        conditions = {}
        for name, (unit, amounts) in weighted.variable_conditions(
            [value.conditions for value in self.tests]
        ).items():
            shown = np.array([to_display(amount, display_unit(unit)) for amount in amounts])
            conditions[name] = (Axis(name, unit_text(unit)), shown)
        days = [day for value in self.tests if (day := day_of(value.when))]
        if self.dated and len(set(days)) > 1:
            since = np.array([float((day - min(days)).days) for day in days])
            conditions[DATE] = (Axis(f"days since {min(days).isoformat()}", "d"), since)
        return conditions

    @property
    def amounts(self) -> dict[str, FloatArray]:
        """Amounts (n,) [axis unit] of `over`."""
        return {name: amounts for name, (_, amounts) in self.over().items()}


SeriesTrend = weighted.Trend[CoefficientSeries]
AdjustedSeries = weighted.Adjusted[CoefficientSeries]


def coefficient_series(results: Sequence[tuple[str, Identification]]) -> list[CoefficientSeries]:
    """Every parameter that two results or more have, but for those of sliding fits."""
    groups: dict[tuple[str, str], list[Value]] = {}
    for result, identification in results:
        # Parameters that occur once for their fit, test and term
        rows = [listed for listed in listed_parameters(identification) if not of_points(listed.model)]
        keys = [(listed.fit, listed.test, listed.term, listed.parameter.name) for listed in rows]
        counts = Counter(keys)
        for listed in [listed for listed, key in zip(rows, keys, strict=True) if counts[key] == 1]:
            values = groups.setdefault((listed.title, listed.parameter.name), [])
            values.append(_value(result, identification, listed))
    return [
        _series(fit, name, values)
        for (fit, name), values in groups.items()
        if len(values) > 1 and len({value.parameter.unit for value in values}) == 1
    ]


def _series(fit: str, name: str, values: Sequence[Value]) -> CoefficientSeries:
    amounts = [(of.parameter.value, of.parameter.full_error, of.digests) for of in values]
    once, copies = count_once(values, amounts)
    if all(value.when for value in once):
        once.sort(key=lambda value: value.when)
    return CoefficientSeries(fit, name, tuple(once), tuple(copies))


def _label(result: str, test: str) -> str:
    return ", ".join(filter(None, (result, test)))


def _value(result: str, identification: Identification, listed: ListedParameter) -> Value:
    conditions = identification.test_conditions.get(listed.test, {})
    amounts = {name: amount for name, text in conditions.items() if (amount := amount_of(text))}
    dates = (str(text) for name, text in conditions.items() if name.lower() in DATES)
    when = next(filter(day_of, dates), "")
    label, digests = _label(result, listed.test), identification.digests
    return Value(**vars(listed), label=label, conditions=amounts, when=when, digests=digests)


MOST_TOGETHER = 12
LONGEST_NAME = 24
# Points of a trend line, so that its band bends smoothly.
N_TREND = 41


def trend_figure(series: CoefficientSeries, condition: str) -> Figure:
    """Values over a condition; of three or more their weighted line, or parabola of curved ones, at the mean
    of the conditions that are told apart from it.
    """
    axis, x = series.over()[condition]
    low, high = series.intervals().T
    tests = dots("tests", x, series.values, marker="o", size=4.0, bars=(low, high))
    line, law = _line(series, condition)
    chart = stack([Panel(axis, series.axis, (*line, tests))], 3.0)
    caption = (
        f"{series.title} over {condition}: tests with their 95 % intervals; line: weighted {law}, shaded: "
        "its 95 % interval."
    )
    return Figure(chart, caption, f"{series.title} of {len(series.tests)} tests over {condition}")


def _line(series: CoefficientSeries, condition: str) -> tuple[tuple[Series, ...], str]:
    names, rows = series.joint_conditions(condition)
    x, others = rows[0], f" at the mean {' and '.join(names[1:])}" if names[1:] else ""
    law = f"trend{others}" if others else "straight trend"
    line, columns = series.line_over(condition), weighted.straight_columns(rows)
    if line is None:
        return (), law
    drawn = np.linspace(x.min(), x.max(), N_TREND)
    along = np.zeros((N_TREND, columns.shape[1]))
    along[:, 0], along[:, 1] = 1.0, drawn - np.mean(x)
    if line.curved and len(set(x)) > 2:
        law = f"parabola, since the tests are curved{others}"
        columns = np.column_stack([columns, columns[:, 1] ** 2])
        along = np.column_stack([along, along[:, 1] ** 2])
        line = weighted.weighted_fit(columns, series.values, *series.parted_errors)
    middle = along @ line.values
    reach = np.array([line.reach(row) for row in along])
    return (curve("trend", drawn, middle, 1, band=(middle - reach, middle + reach)),), law


def control_figure(of: AdjustedSeries, limits: weighted.ControlLimits) -> Figure:
    """The values in their order with centre and limits; those outside are ringed."""
    series, values = of.series, of.values
    places, outside = np.arange(1, values.size + 1), list(limits.outside)
    ringed = dots("outside", places[outside], values[outside], 1, marker="o", size=10.0, hollow=True)
    tests = curve("tests", places, values, marker=".", size=4.0)
    names = [value.when if series.dated else value.label[-LONGEST_NAME:] for value in series.tests]
    x = Axis("tests by date" if series.dated else "tests in the order given", ticks=named_ticks(names, 1.0))
    lines = (*([ringed] if outside else []), *control_lines(limits.centre, limits.low, limits.high))
    alternative = f"Control chart of {series.title} with {len(outside)} values outside its limits"
    chart = stack([Panel(x, series.axis, (tests, *lines))], 3.0)
    return Figure(chart, f"{series.title}{of.without}: individuals chart; {CONTROL}.", alternative)


def sliding_overlays(results: Sequence[tuple[str, Identification]]) -> list[Figure]:
    """Every coefficient of the sliding fits of two tests or more over frequency, a curve per test."""
    groups: dict[tuple[str, str], dict[str, list[Fit]]] = {}
    for result, identification in results:
        for fit in identification.fits:
            tests = groups.setdefault((fit.name, fit.term), {})
            tests.setdefault(_label(result, fit.test), []).append(fit)
    figures: list[Figure] = []
    for (name, term), tests in groups.items():
        sliding = {
            label: fits for label, fits in tests.items() if len(fits) > 1 and not of_points(fits[0].model)
        }
        if len(sliding) > 1:
            units = sliding_units([fit for fits in sliding.values() for fit in fits])
            title = f"{name} of {term}" if term else name
            figures += [_overlay(title, parameter, unit, sliding) for parameter, unit in units.items()]
    return figures


def _overlay(title: str, parameter: str, unit: str, tests: dict[str, list[Fit]]) -> Figure:
    series = [
        sliding_curve(fits, parameter, label, number, 0.15)
        for number, (label, fits) in enumerate(list(tests.items())[:MOST_TOGETHER])
        if parameter in sliding_units(fits)
    ]
    more = f"; the first {MOST_TOGETHER} of {len(tests)}" if len(tests) > MOST_TOGETHER else ""
    caption = f"{title}: {parameter} over frequency of {len(tests)} tests, shaded: 95 % intervals{more}."
    chart = stack([Panel(CENTRE, Axis(parameter, unit_text(unit)), tuple(series))], 3.4)
    return Figure(chart, caption, f"{parameter} of {title} over frequency in {len(tests)} tests")


TREND_HEADER = (
    "coefficient", "over", "slope", "unit", "95 % interval", "p-value", "after Holm", "beyond chance",
    "verdict",
)  # fmt: skip
MOST_NAMED, MOST_COPIES = 2, 12
EXPLAINED = (
    "Every coefficient that two results share. Trends are straight lines weighted by the standard errors "
    "of the fits, over conditions that tests tell apart, each slope at the others held; where tests scatter "
    "more the line's errors are enlarged, and of those that bend off it a parabola is drawn (curved). "
    "Differences are of each value from the weighted mean of the others, or from their trend. All p-values "
    f"of one kind are corrected together after Holm: at most {100 * weighted.LEVEL:g} % chance of any false "
    "alarm among them."
)


def campaign_document(results: Sequence[tuple[str, Identification]]) -> Document:
    """The report of many results (name, identification); DataError where they share no coefficient."""
    everything = coefficient_series(results)
    series = [coefficient for coefficient in everything if len(coefficient.tests) > 1]
    copies = list(dict.fromkeys(value.label for coefficient in everything for value in coefficient.copies))
    overlays = sliding_overlays(results)
    if not series and not overlays:
        if copies:
            raise DataError("the results are of the same recordings", hint="a recording counts once")
        raise DataError(
            "the results share no coefficient", hint="a campaign needs the same fit in at least two tests"
        )
    trends = weighted.trends_of(series)
    adjusted = weighted.adjust(series, trends)
    differences = _find_apart(adjusted)
    sources = tuple(
        (name, source["path"], source["sha256"]) for name, result in results for source in result.sources
    )
    sections = (
        Section("Verdict", (*_verdict(adjusted, trends, differences), *_left_out(copies))),
        Section("Results", (_results(results),)),
        *([Section("Trends", (Paragraph(EXPLAINED), _trend_table(trends)))] if trends else []),
        *(
            Section(of.series.title, _blocks(of, apart))
            for of, apart in zip(adjusted, differences, strict=True)
        ),
        *([Section("Over frequency", tuple(overlays))] if overlays else []),
        Section("Provenance", (Table(("result", "source file", "SHA-256"), sources, "Source files"),)),
    )
    identifications = [identification for _, identification in results]
    titles = {identification.title for identification in identifications}
    title = titles.pop() if len(titles) == 1 else f"{len(results)} results compared"
    subtitle = f"Campaign report, labpipe {identifications[0].version}"
    return Document(f"Campaign: {title}", subtitle, sections, cover_facts(identifications))


def _name(trend: SeriesTrend) -> str:
    return f"{trend.series.title} over {trend.condition}"


def _outside(of: AdjustedSeries) -> list[str]:
    return [of.series.tests[place].label for place in of.limits.outside] if of.limits else []


# The difference of each value of a series from the others [display unit], and its p-value after Holm.
Apart = tuple[FloatArray, FloatArray]


def _find_apart(series: Sequence[AdjustedSeries]) -> list[Apart]:
    """Of every series, NaN where its values have no errors. All are corrected together."""
    each = [_from_the_rest(of) for of in series]
    corrected = [p for _, p in each]
    tested = [number for number, p in enumerate(corrected) if np.all(np.isfinite(p))]
    if tested:
        # Two values are one test, not two.
        counted = [corrected[number][: None if corrected[number].size > 2 else 1] for number in tested]
        parts = np.split(holm(np.concatenate(counted)), np.cumsum([part.size for part in counted])[:-1])
        for number, part in zip(tested, parts, strict=True):
            corrected[number] = np.resize(part, corrected[number].size)
    return [(difference, p) for (difference, _), p in zip(each, corrected, strict=True)]


def _from_the_rest(of: AdjustedSeries) -> Apart:
    errors, changes, dofs = of.series.parted_errors
    try:
        return weighted.from_the_rest(of.series.values, errors, changes, dofs, of.columns)
    except FitError:
        unknown = np.full(of.values.size, np.nan)
        return unknown, unknown


def _verdict(
    series: Sequence[AdjustedSeries], trends: Sequence[SeriesTrend], differences: Sequence[Apart]
) -> tuple[Block, ...]:
    charted = [of for of in series if of.limits is not None]
    labels = [(of.series.title + of.without, _outside(of)) for of in charted]
    outside = [f"{title} ({few(tests, MOST_NAMED, '; ')})" for title, tests in labels if tests]
    steep = [_name(trend) for trend in trends if trend.is_sure]
    n_apart = sum(int(np.sum(p < weighted.LEVEL)) for _, p in differences)
    n = len(charted)
    if outside:
        which = f"{len(outside)} of {n} charts have values beyond their limits: {', '.join(outside)}."
        lead = Paragraph(f"OUT OF CONTROL: {which}", "failed")
    elif charted:
        lead = Paragraph(f"In control: no value of {n} charts lies beyond its limits.", "passed")
    else:
        needed = f"at least {weighted.FEWEST} of one coefficient are needed"
        lead = Paragraph(f"Too few tests for control limits: {needed}.", "note")
    blocks = [lead]
    if trends:
        sentence = f"Trends beyond chance, of {len(trends)} looked at: {'; '.join(steep) or 'none'}."
        blocks.append(Paragraph(sentence, "warning" if steep else "note"))
        # Conditions that are fitted together have one curvature.
        bent = {(of.series.title, of.line.curved): of for of in reversed(trends) if of.line.curved}
        blocks += [Paragraph(f"{_name(of)}: {of.line.curved}.", "warning") for of in reversed(bent.values())]
    if series:
        values = sum(of.values.size for of in series)
        sentence = f"{n_apart} of {values} values differ from the others beyond the stated errors."
        blocks.append(Paragraph(sentence, "warning" if n_apart else "note"))
    return tuple(blocks)


def _left_out(copies: Sequence[str]) -> tuple[Block, ...]:
    which = few(copies, MOST_COPIES, "; ")
    text = f"A recording counts once; left out, since others are of the same: {which}."
    return (Paragraph(text, "note"),) if copies else ()


def _results(results: Sequence[tuple[str, Identification]]) -> Table:
    rows = []
    for name, identification in results:
        rules = "accepted" if identification.accepted else "NOT ACCEPTED"
        verdict = rules if identification.outcomes else "no rules"
        counts = str(len({fit.test for fit in identification.fits})), str(len(identification.fits))
        version = f"labpipe {identification.version}"
        rows.append((name or "result", identification.title, *counts, verdict, version))
    header = ("result", "title", "tests", "fits", "verdict", "computed by")
    return Table(header, tuple(rows), "Results read together", (2, 3))


def _trend_table(trends: Sequence[SeriesTrend]) -> Table:
    rows = []
    for trend in trends:
        line, (slope, error, quantile) = trend.line, trend.line.state(1)
        ends = slope - quantile * error, slope + quantile * error
        chances = f"{line.p_of(1):.2g}", f"{trend.p_value:.2g}", "yes" if trend.is_sure else "no"
        rows.append(
            (
                trend.series.title,
                trend.condition,
                round_to_error(slope, error),
                _slope_unit(trend),
                " to ".join(write_values(slope, error, *ends)[2:]),
                *chances,
                weighted.trend_verdict(slope, line.curved, sure=trend.is_sure),
            )
        )
    return Table(TREND_HEADER, tuple(rows), "Straight trends over the conditions", (2, 4, 5, 6))


def _slope_unit(trend: SeriesTrend) -> str:
    below = trend.series.over()[trend.condition][0].unit
    if not below:
        return unit_text(trend.series.tests[0].parameter.unit)
    return f"{trend.series.unit} per {below}" if "/" in trend.series.unit else f"{trend.series.unit}/{below}"


def _blocks(of: AdjustedSeries, apart: Apart) -> tuple[Block, ...]:
    coefficient = of.series
    bands = dict.fromkeys(
        f"{low:g}-{high:g} Hz" for low, high in (value.band_hz for value in coefficient.tests)
    )
    blocks: list[Block] = []
    if len(bands) > 1:
        what = f"Fits of several bands have this name: {', '.join(bands)}."
        blocks.append(Paragraph(f"{what} Their values may differ by the bands alone.", "warning"))
    blocks += [trend_figure(coefficient, condition) for condition in coefficient.over()]
    if (limits := of.limits) is not None:
        n, outside = of.values.size, "; ".join(_outside(of))
        which = f"outside: {outside}" if outside else "no value lies outside"
        centre, _, low, high = write_values(limits.centre, limits.rounding, limits.low, limits.high)
        ends = f"{low} to {high} {unit_label(coefficient.unit)}".rstrip()
        suppose = f"The limits suppose that all tests are of one condition{of.without}."
        text = f"{limits.formula}; centre {centre}, limits {ends}; {which}. {suppose}"
        if n < weighted.SETTLED:
            text += f" With {n} values, fewer than {weighted.SETTLED}, the limits are provisional."
        blocks.append(Paragraph(text, "warning" if outside else "note"))
        blocks.append(control_figure(of, limits))
    return (*blocks, _value_table(coefficient, apart))


def _value_table(coefficient: CoefficientSeries, apart: Apart) -> Table:
    rows = []
    over, (differences, corrected) = coefficient.over(), apart
    for n, (value, error) in enumerate(zip(coefficient.values, coefficient.errors(), strict=True)):
        (low, high), p = coefficient.intervals()[n], corrected[n]
        rows.append(
            (
                coefficient.tests[n].label,
                coefficient.tests[n].when if coefficient.dated else "",
                *(f"{amounts[n]:g}" for name, (_, amounts) in over.items() if name != DATE),
                round_to_error(value, error),
                " to ".join(write_values(value, error, low, high)[2:]) if np.isfinite(low) else "none",
                round_to_error(differences[n], error) if np.isfinite(differences[n]) else "",
                f"{p:.2g}{' *' if p < weighted.LEVEL else ''}" if np.isfinite(p) else "",
            )
        )
    named = tuple(axis.label for name, (axis, _) in over.items() if name != DATE)
    last = (coefficient.axis.label, "95 % interval", "from the others", "p after Holm")
    header = ("test", "date", *named, *last)
    caption = f"Values of {coefficient.title}; * differs from the others"
    return Table(header, tuple(rows), caption, tuple(range(2, len(header))))

"""The report of a campaign: every coefficient over the conditions of its tests, its control limits, and who differs from the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.bandwise import holm
from labpipe.campaign.control import SETTLED, control_limits, from_the_rest, straight_trend
from labpipe.display import written
from labpipe.errors import DataError, FitError
from labpipe.records.identification import Identification
from labpipe.report.campaign_figures import control_figure, sliding_overlays, trend_figure
from labpipe.report.coefficient_series import CoefficientSeries, coefficient_series
from labpipe.report.cover import cover_facts
from labpipe.report.document import Block, Document, Paragraph, Section, Table
from labpipe.report.wording import rounded, unit_text

LEVEL = 0.05
FEWEST = 3
MOST_NAMED = 2
EXPLAINED = (
    "Every coefficient that at least two results share. Trends are straight lines weighted by the standard errors of the fits; where the "
    "tests scatter more than these say, the line's errors are enlarged. Differences are of each value from the weighted mean of the "
    f"others. All p-values of one kind are corrected together after Holm: at most {100 * LEVEL:g} % chance of any false alarm among them."
)


@dataclass(frozen=True)
class Trend:
    """The slope of a series over a condition [display unit per unit of the condition], and the chance of one as steep without any."""

    series: CoefficientSeries
    condition: str
    slope: float
    error: float
    interval: tuple[float, float]
    p_value: float


def campaign_document(results: Sequence[tuple[str, Identification]]) -> Document:
    """The report of many results (name, identification); DataError where they share no coefficient."""
    series = coefficient_series(results)
    overlays = sliding_overlays(results)
    if not series and not overlays:
        raise DataError("the results share no coefficient", hint="a campaign needs the same fit in at least two tests")
    trends = [trend for coefficient in series for trend in _trends(coefficient)]
    differences = [_Differences.of(coefficient) for coefficient in series]
    corrected = holm(np.array([trend.p_value for trend in trends]))
    _correct(differences)
    sections = (
        Section("Verdict", _verdict(series, trends, corrected, differences)),
        Section("Results", (_results(results),)),
        *([Section("Trends", (Paragraph(EXPLAINED), _trend_table(trends, corrected)))] if trends else []),
        *(Section(coefficient.title, _blocks(coefficient, apart)) for coefficient, apart in zip(series, differences, strict=True)),
        *([Section("Over frequency", tuple(overlays))] if overlays else []),
        Section("Provenance", _provenance(results)),
    )
    identifications = [identification for _, identification in results]
    titles = list(dict.fromkeys(identification.title for identification in identifications))
    title = titles[0] if len(titles) == 1 else f"{len(results)} results compared"
    version = identifications[0].version
    return Document(f"Campaign: {title}", f"Campaign report, labpipe {version}", sections, cover_facts(identifications))


@dataclass
class _Differences:
    """Each value of a series against the others: difference, p-value and, once all have one, that corrected."""

    difference: FloatArray
    p_value: FloatArray
    corrected: FloatArray

    @classmethod
    def of(cls, coefficient: CoefficientSeries) -> _Differences:
        """The differences of a series; NaN where its values have no errors."""
        try:
            difference, p_value = from_the_rest(coefficient.shown(), coefficient.joint_errors())
        except FitError:
            difference = p_value = np.full(len(coefficient.values), np.nan)
        return cls(difference, p_value, p_value.copy())


def _correct(differences: Sequence[_Differences]) -> None:
    """Holm's correction over all differences; two values are one test, not two."""
    tested = [coefficient for coefficient in differences if np.all(np.isfinite(coefficient.p_value))]
    counted = [coefficient.p_value if coefficient.p_value.size > 2 else coefficient.p_value[:1] for coefficient in tested]
    if not counted:
        return
    corrected = np.split(holm(np.concatenate(counted)), np.cumsum([part.size for part in counted])[:-1])
    for coefficient, part in zip(tested, corrected, strict=True):
        coefficient.corrected = np.resize(part, coefficient.p_value.size)


def _trends(coefficient: CoefficientSeries) -> list[Trend]:
    """One straight trend for every condition that differs; none where errors or tests are missing."""
    trends = []
    for name, (_, condition) in coefficient.over().items():
        try:
            line = straight_trend(condition, coefficient.shown(), coefficient.joint_errors())
        except FitError:
            continue
        slope, error = float(line.values[1]), line.std_error(1)
        reach = line.quantile * error
        trends.append(Trend(coefficient, name, slope, error, (slope - reach, slope + reach), line.p_of(1)))
    return trends


def _verdict(
    series: Sequence[CoefficientSeries], trends: Sequence[Trend], corrected: FloatArray, differences: Sequence[_Differences]
) -> tuple[Block, ...]:
    """What a reader must know first: values out of control, trends, and values that differ."""
    outside = [f"{coefficient.title} ({_few(labels)})" for coefficient in series if (labels := _outside(coefficient))]
    steep = [f"{trend.series.title} over {trend.condition}" for trend, p in zip(trends, corrected, strict=True) if p < LEVEL]
    n_apart = sum(int(np.sum(apart.corrected < LEVEL)) for apart in differences)
    charted = sum(len(coefficient.values) >= FEWEST for coefficient in series)
    if outside:
        which = f"{len(outside)} of {charted} charts have values beyond their limits: {', '.join(outside)}."
        lead = Paragraph(f"OUT OF CONTROL: {which}", "failed")
    elif charted:
        lead = Paragraph(f"In control: no value of {charted} charts lies beyond its limits.", "passed")
    else:
        lead = Paragraph(f"Too few tests for control limits: at least {FEWEST} of one coefficient are needed.", "note")
    blocks = [lead]
    if trends:
        which = "; ".join(steep) if steep else "none"
        blocks.append(Paragraph(f"Trends beyond chance, of {len(trends)} looked at: {which}.", "warning" if steep else "note"))
    if series:
        values = sum(len(coefficient.values) for coefficient in series)
        sentence = f"{n_apart} of {values} values differ from the others beyond the stated errors."
        blocks.append(Paragraph(sentence, "warning" if n_apart else "note"))
    return tuple(blocks)


def _few(labels: Sequence[str]) -> str:
    more = f" and {len(labels) - MOST_NAMED} more" if len(labels) > MOST_NAMED else ""
    return "; ".join(labels[:MOST_NAMED]) + more


def _outside(coefficient: CoefficientSeries) -> list[str]:
    if len(coefficient.values) < FEWEST:
        return []
    return [coefficient.values[place].label for place in control_limits(coefficient.shown()).outside]


def _results(results: Sequence[tuple[str, Identification]]) -> Table:
    rows = []
    for name, identification in results:
        verdict = "no rules" if not identification.outcomes else "accepted" if identification.accepted else "NOT ACCEPTED"
        tests = str(len({fit.test for fit in identification.fits}))
        rows.append(
            (name or "result", identification.title, tests, str(len(identification.fits)), verdict, f"labpipe {identification.version}")
        )
    return Table(("result", "title", "tests", "fits", "verdict", "computed by"), tuple(rows), "Results read together", (2, 3))


def _trend_table(trends: Sequence[Trend], corrected: FloatArray) -> Table:
    rows = tuple(
        (
            trend.series.title,
            trend.condition,
            rounded(trend.slope, trend.error),
            _slope_unit(trend),
            " to ".join(written(trend.slope, trend.error, *trend.interval)[2:]),
            f"{trend.p_value:.2g}",
            f"{p:.2g}",
            "yes" if p < LEVEL else "no",
        )
        for trend, p in zip(trends, corrected, strict=True)
    )
    header = ("coefficient", "over", "slope", "unit", "95 % interval", "p-value", "after Holm", "beyond chance")
    return Table(header, rows, "Straight trends over the conditions", (2, 4, 5, 6))


def _slope_unit(trend: Trend) -> str:
    below = trend.series.over()[trend.condition][0].unit
    if not below:
        return unit_text(trend.series.values[0].parameter.unit)
    return f"{trend.series.unit} per {below}" if "/" in trend.series.unit else f"{trend.series.unit}/{below}"


def _blocks(coefficient: CoefficientSeries, apart: _Differences) -> tuple[Block, ...]:
    """Figures over the conditions, the control chart in words and as a figure, and every value with its difference."""
    blocks: list[Block] = [trend_figure(coefficient, condition) for condition in coefficient.over()]
    if len(coefficient.values) >= FEWEST:
        limits = control_limits(coefficient.shown())
        outside = "; ".join(coefficient.values[place].label for place in limits.outside)
        sentence = f"outside: {outside}" if outside else "no value lies outside"
        sentence += ". The limits suppose that all tests are of one condition"
        few = (
            f" With {len(coefficient.values)} values, fewer than {SETTLED}, the limits are provisional."
            if len(coefficient.values) < SETTLED
            else ""
        )
        ends = f"{limits.low:.5g} to {limits.high:.5g} {coefficient.unit}"
        text = f"{limits.formula}; centre {limits.centre:.5g}, limits {ends}; {sentence}.{few}"
        blocks.extend([Paragraph(text[0].upper() + text[1:], "warning" if outside else "note"), control_figure(coefficient, limits)])
    return (*blocks, _value_table(coefficient, apart))


def _value_table(coefficient: CoefficientSeries, apart: _Differences) -> Table:
    rows = []
    over = coefficient.over()
    for n, (value, error) in enumerate(zip(coefficient.shown(), coefficient.errors(), strict=True)):
        low, high = coefficient.intervals()[n]
        rows.append(
            (
                coefficient.values[n].label,
                *([str(coefficient.values[n].day or "")] if coefficient.dated else []),
                *(f"{amounts[n]:g}" for name, (_, amounts) in over.items() if name != "date"),
                rounded(value, error),
                "none" if not np.isfinite(low) else " to ".join(written(value, error, low, high)[2:]),
                "" if not np.isfinite(apart.difference[n]) else rounded(apart.difference[n], error),
                "" if not np.isfinite(apart.corrected[n]) else f"{apart.corrected[n]:.2g}{' *' if apart.corrected[n] < LEVEL else ''}",
            )
        )
    named = tuple(axis.label for name, (axis, _) in over.items() if name != "date")
    header = (
        "test",
        *(["date"] if coefficient.dated else []),
        *named,
        coefficient.axis.label,
        "95 % interval",
        "from the others",
        "p after Holm",
    )
    caption = f"Values of {coefficient.title}; * differs from the others"
    return Table(header, tuple(rows), caption, tuple(range(1 + coefficient.dated, len(header))))


def _provenance(results: Sequence[tuple[str, Identification]]) -> tuple[Block, ...]:
    rows = tuple((name, source["path"], source["sha256"]) for name, identification in results for source in identification.sources)
    return (Table(("result", "source file", "SHA-256"), rows, "Source files"),)

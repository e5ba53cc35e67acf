"""The report of a campaign: every coefficient over the conditions of its tests, its control limits, and who differs from the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labpipe.campaign.bandwise import holm
from labpipe.campaign.control import SETTLED, control_limits, from_the_rest, straight_trend
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
    trends = [trend for one in series for trend in _trends(one)]
    differences = [_Differences.of(one) for one in series]
    corrected = holm(np.array([trend.p_value for trend in trends]))
    _correct(differences)
    sections = (
        Section("Verdict", _verdict(series, trends, corrected, differences)),
        Section("Results", (_results(results),)),
        *([Section("Trends", (Paragraph(EXPLAINED), _trend_table(trends, corrected)))] if trends else []),
        *(Section(one.title, _blocks(one, own)) for one, own in zip(series, differences, strict=True)),
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
    """Each value of a series against the others: difference, p-value and, once all are known, the corrected one."""

    difference: NDArray[np.float64]
    p_value: NDArray[np.float64]
    corrected: NDArray[np.float64]

    @classmethod
    def of(cls, one: CoefficientSeries) -> _Differences:
        try:
            difference, p_value = from_the_rest(one.shown(), one.errors())
        except FitError:
            difference = p_value = np.full(len(one.values), np.nan)
        return cls(difference, p_value, p_value.copy())


def _correct(differences: Sequence[_Differences]) -> None:
    """Holm's correction over all differences; two values are one test, not two."""
    tested = [one for one in differences if np.all(np.isfinite(one.p_value))]
    counted = [one.p_value if one.p_value.size > 2 else one.p_value[:1] for one in tested]
    if not counted:
        return
    corrected = np.split(holm(np.concatenate(counted)), np.cumsum([part.size for part in counted])[:-1])
    for one, part in zip(tested, corrected, strict=True):
        one.corrected = np.resize(part, one.p_value.size)


def _trends(one: CoefficientSeries) -> list[Trend]:
    """One straight trend for every condition that differs; none where errors or tests are missing."""
    found = []
    for name, (_, condition) in one.over().items():
        try:
            line = straight_trend(condition, one.shown(), one.errors())
        except FitError:
            continue
        slope, error = float(line.values[1]), line.std_error(1)
        reach = line.quantile * error
        found.append(Trend(one, name, slope, error, (slope - reach, slope + reach), line.p_of(1)))
    return found


def _verdict(
    series: Sequence[CoefficientSeries], trends: Sequence[Trend], corrected: NDArray[np.float64], differences: Sequence[_Differences]
) -> tuple[Block, ...]:
    """What a reader must know first: values out of control, trends, and values that differ."""
    outside = [f"{one.title} ({_few(labels)})" for one in series if (labels := _outside(one))]
    steep = [f"{trend.series.title} over {trend.condition}" for trend, p in zip(trends, corrected, strict=True) if p < LEVEL]
    apart = sum(int(np.sum(own.corrected < LEVEL)) for own in differences)
    charted = sum(len(one.values) >= FEWEST for one in series)
    if outside:
        told = f"{len(outside)} of {charted} charts have values beyond their limits: {', '.join(outside)}."
        lead = Paragraph(f"OUT OF CONTROL: {told}", "failed")
    elif charted:
        lead = Paragraph(f"In control: no value of {charted} charts lies beyond its limits.", "passed")
    else:
        lead = Paragraph(f"Too few tests for control limits: at least {FEWEST} of one coefficient are needed.", "note")
    blocks = [lead]
    if trends:
        told = "; ".join(steep) if steep else "none"
        blocks.append(Paragraph(f"Trends beyond chance, of {len(trends)} looked at: {told}.", "warning" if steep else "note"))
    if series:
        values = sum(len(one.values) for one in series)
        said = f"{apart} of {values} values differ from the others beyond the stated errors."
        blocks.append(Paragraph(said, "warning" if apart else "note"))
    return tuple(blocks)


def _few(labels: Sequence[str]) -> str:
    more = f" and {len(labels) - MOST_NAMED} more" if len(labels) > MOST_NAMED else ""
    return "; ".join(labels[:MOST_NAMED]) + more


def _outside(one: CoefficientSeries) -> list[str]:
    if len(one.values) < FEWEST:
        return []
    return [one.values[place].label for place in control_limits(one.shown()).outside]


def _results(results: Sequence[tuple[str, Identification]]) -> Table:
    rows = []
    for name, one in results:
        verdict = "no rules" if not one.outcomes else "accepted" if one.accepted else "NOT ACCEPTED"
        tests = str(len({fit.test for fit in one.fits}))
        rows.append((name or "result", one.title, tests, str(len(one.fits)), verdict, f"labpipe {one.version}"))
    return Table(("result", "title", "tests", "fits", "verdict", "computed by"), tuple(rows), "Results read together", (2, 3))


def _trend_table(trends: Sequence[Trend], corrected: NDArray[np.float64]) -> Table:
    rows = tuple(
        (
            trend.series.title,
            trend.condition,
            rounded(trend.slope, trend.error),
            _slope_unit(trend),
            f"{rounded(trend.interval[0], trend.error)} to {rounded(trend.interval[1], trend.error)}",
            f"{trend.p_value:.2g}",
            f"{p:.2g}",
            "yes" if p < LEVEL else "no",
        )
        for trend, p in zip(trends, corrected, strict=True)
    )
    header = ("coefficient", "over", "slope", "unit", "95 % interval", "p-value", "after Holm", "beyond chance")
    return Table(header, rows, "Straight trends over the conditions", (2, 4, 5, 6))


def _slope_unit(trend: Trend) -> str:
    label = trend.series.over()[trend.condition][0]
    if "[" not in label:
        return unit_text(trend.series.values[0].parameter.unit)
    below = label.rpartition("[")[2].rstrip("]")
    return f"{trend.series.unit} per {below}" if "/" in trend.series.unit else f"{trend.series.unit}/{below}"


def _blocks(one: CoefficientSeries, own: _Differences) -> tuple[Block, ...]:
    """Figures over the conditions, the control chart in words and as a figure, and every value with its difference."""
    blocks: list[Block] = [trend_figure(one, condition) for condition in one.over()]
    if len(one.values) >= FEWEST:
        limits = control_limits(one.shown())
        outside = "; ".join(one.values[place].label for place in limits.outside)
        said = f"outside: {outside}" if outside else "no value lies outside"
        said += ". The limits suppose that all tests are of one condition"
        few = f" With {len(one.values)} values, fewer than {SETTLED}, the limits are provisional." if len(one.values) < SETTLED else ""
        text = f"{limits.formula}; centre {limits.centre:.5g}, limits {limits.low:.5g} to {limits.high:.5g} {one.unit}; {said}.{few}"
        blocks.extend([Paragraph(text[0].upper() + text[1:], "warning" if outside else "note"), control_figure(one, limits)])
    return (*blocks, _value_table(one, own))


def _value_table(one: CoefficientSeries, own: _Differences) -> Table:
    rows = []
    over = one.over()
    for n, (value, error) in enumerate(zip(one.shown(), one.errors(), strict=True)):
        low, high = one.intervals()[n]
        rows.append(
            (
                one.values[n].label,
                *([str(one.values[n].day or "")] if one.dated else []),
                *(f"{amounts[n]:g}" for name, (_, amounts) in over.items() if name != "date"),
                rounded(value, error),
                "none" if not np.isfinite(low) else f"{rounded(low, error)} to {rounded(high, error)}",
                "" if not np.isfinite(own.difference[n]) else rounded(own.difference[n], error),
                "" if not np.isfinite(own.corrected[n]) else f"{own.corrected[n]:.2g}{' *' if own.corrected[n] < LEVEL else ''}",
            )
        )
    named = tuple(label for name, (label, _) in over.items() if name != "date")
    header = ("test", *(["date"] if one.dated else []), *named, one.axis, "95 % interval", "from the others", "p after Holm")
    caption = f"Values of {one.title}; * differs from the others"
    return Table(header, tuple(rows), caption, tuple(range(1 + one.dated, len(header))))


def _provenance(results: Sequence[tuple[str, Identification]]) -> tuple[Block, ...]:
    rows = tuple((name, source["path"], source["sha256"]) for name, one in results for source in one.sources)
    return (Table(("result", "source file", "SHA-256"), rows, "Source files"),)

"""The part of a report that a Monte Carlo study fills: how near the fits come, and how true their uncertainty
is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from labpipe.records.identification import Identification
from labpipe.records.study import Studies, Study, StudyCase
from labpipe.report.chart import Axis, Panel, Series, curve, level, look, stacked
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.wording import threshold_text

CASE_HEADER = (
    "fit",
    "noise",
    "lines",
    "mean error",
    "variance",
    "median",
    "no result",
    "success",
    "RMSE / CRLB",
    "coverage",
)
PARAMETER_HEADER = ("parameter", "truth", "mean", "bias", "RMSE", "CRLB", "mean std. error", "coverage")
EXPLAINED = (
    "Error: sum of squared parameter errors, entries beside the diagonal of a symmetric matrix counted "
    "twice. No result: repeats that did not converge or were refused; their last numbers are in the errors, "
    "not in RMSE and coverage. RMSE / CRLB: scatter against the Cramer-Rao bound, 1 is the best an unbiased "
    "estimate can reach. Coverage: share of 95 % intervals that hold the truth."
)


def study_sections(studies: Studies, _identification: Identification) -> tuple[Section, ...]:
    """One section for every Monte Carlo study."""
    return tuple(Section(f"Study: {study.rig}", study_blocks(study)) for study in studies)


def study_blocks(study: Study) -> tuple[Block, ...]:
    """Tables and figures of a study."""
    first = study.cases[0]
    lead = (
        f"{study.rig}, {first.repeats} repeats of each case, seed {study.seed}; the same noise for every "
        f"fit. {EXPLAINED}"
    )
    success = f"Success: within {_per_cent(study.limits[0])} of the truth, all coefficients taken together."
    blocks: list[Block] = [Paragraph(f"{lead} {success}"), _case_table(study)]
    blocks.extend(Paragraph(threshold_text(threshold, study.share), "note") for threshold in study.thresholds)
    if len({case.noise for case in study.cases}) > 1:
        blocks.append(_noise_figure(study))
    noisiest = max(case.noise for case in study.cases)
    blocks.extend(
        _parameter_table(case) for case in study.cases if case.noise == noisiest and case.parameters
    )
    blocks.extend(_means_table(study, fit) for fit in dict.fromkeys(case.fit for case in study.cases))
    return tuple(blocks)


def _case_table(study: Study) -> Table:
    printed = dict(study.printed)
    levels = list(dict.fromkeys(case.noise for case in study.cases))
    header = (*CASE_HEADER, "printed mean error") if printed else CASE_HEADER
    rows = []
    for case in study.cases:
        row = (
            case.fit,
            _per_cent(case.noise),
            str(case.lines),
            f"{case.mean_error:.4g}",
            f"{case.error_variance:.3g}",
            f"{case.median_error:.4g}",
            f"{case.failed} of {case.repeats}",
            _per_cent(case.success[0]),
            "" if case.rmse_over_bound is None else f"{case.rmse_over_bound:.3f}",
            "" if case.coverage is None else _per_cent(case.coverage),
        )
        errors = printed.get(case.fit)
        rows.append((*row, f"{errors[levels.index(case.noise)]:g}" if errors else "") if printed else row)
    numeric = tuple(n for n in range(len(header)) if n != 0)
    return Table(header, tuple(rows), "Errors, success and coverage of every fit", numeric)


def _parameter_table(case: StudyCase) -> Table:
    rows = tuple(
        (
            p.name,
            f"{p.truth:.6g} {p.unit}",
            f"{p.mean:.6g}",
            f"{p.bias:.2g}",
            f"{p.rmse:.3g}",
            "" if p.bound is None else f"{p.bound:.3g}",
            "" if p.std_error is None else f"{p.std_error:.3g}",
            "" if p.coverage is None else _per_cent(p.coverage),
        )
        for p in case.parameters
    )
    return Table(
        PARAMETER_HEADER,
        rows,
        f"{case.fit} at {_per_cent(case.noise)} noise, {case.lines} lines",
        tuple(range(1, 8)),
    )


def _means_table(study: Study, fit: str) -> Table:
    """Mean of every coefficient over the noise levels, below the truth."""
    cases = [case for case in study.cases if case.fit == fit and case.parameters]
    names = [p.name for p in cases[0].parameters] if cases else []
    truth = ("truth", *(f"{p.truth:.4g}" for p in cases[0].parameters)) if cases else ()
    rows = [truth, *((_per_cent(case.noise), *(f"{p.mean:.4g}" for p in case.parameters)) for case in cases)]
    caption = f"{fit}: mean of the estimates, repeats without a result left out"
    return Table(("noise", *names), tuple(rows), caption, tuple(range(1 + len(names))))


def _noise_figure(study: Study) -> Figure:
    """Median error, RMSE over the bound, coverage and success over the noise; grey: required."""
    fits = list(dict.fromkeys(case.fit for case in study.cases))
    panels = []
    for title, unit, logarithmic, value, goal in _quantities(study):
        series = [
            _curve([case for case in study.cases if case.fit == fit], value, number)
            for number, fit in enumerate(fits)
        ]
        goals = [] if goal is None else [level(goal)]
        panels.append(
            Panel(Axis("noise", "%"), Axis(title, unit, logarithmic=logarithmic), (*series, *goals))
        )
    caption = (
        "Errors against the Cramer-Rao bound, coverage of the 95 % intervals, and success over the "
        "noise; grey: required."
    )
    alternative = (
        f"Study on {study.rig}: error, efficiency, coverage and success of {', '.join(fits)} over the noise"
    )
    return Figure(stacked(panels, 7.4), caption, alternative)


def _quantities(
    study: Study,
) -> tuple[tuple[str, str, bool, Callable[[StudyCase], float | None], float | None], ...]:
    """(title, unit, logarithmic axis, value of a case, required value) of every panel."""
    return (
        ("median error", "", True, lambda case: case.median_error, None),
        ("RMSE / CRLB", "", True, lambda case: case.rmse_over_bound, 1.0),
        ("coverage", "%", False, lambda case: None if case.coverage is None else 100 * case.coverage, 95.0),
        ("success", "%", False, lambda case: 100 * case.success[0], 100 * study.share),
    )


def _curve(cases: Sequence[StudyCase], value: Callable[[StudyCase], float | None], number: int) -> Series:
    """A quantity of one fit over the noise [%], NaN where a case has none."""
    values = [np.nan if (amount := value(case)) is None else amount for case in cases]
    return curve(cases[0].fit, [100 * case.noise for case in cases], values, *look(number), marker=".")


def _per_cent(share: float) -> str:
    return f"{100 * share:.4g} %"

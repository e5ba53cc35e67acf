"""The part of a report that a Monte Carlo study fills: how near the fits come, and how true their doubt is."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from labpipe.records.identification import Identification
from labpipe.records.study import Studies, Study, StudyCase
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import logarithmic, stacked_axes
from labpipe.report.wording import threshold_text

CASE_HEADER = ("fit", "noise", "lines", "mean error", "variance", "median", "no result", "success", "RMSE / CRLB", "coverage")
PARAMETER_HEADER = ("parameter", "truth", "mean", "bias", "RMSE", "CRLB", "mean std. error", "coverage")
EXPLAINED = (
    "Error: sum of squared parameter errors, entries beside the diagonal of a symmetric matrix counted twice. No result: repeats that "
    "did not converge or were refused; their last numbers are in the errors, not in RMSE and coverage. RMSE / CRLB: scatter against "
    "the Cramer-Rao bound, 1 is the best an unbiased estimate can reach. Coverage: share of 95 % intervals that hold the truth."
)


def study_sections(studies: Studies, _identification: Identification) -> tuple[Section, ...]:
    """One section for every study."""
    return tuple(Section(f"Study: {study.rig}", study_blocks(study)) for study in studies)


def study_blocks(study: Study) -> tuple[Block, ...]:
    """Tables and figures of a study."""
    first = study.cases[0]
    lead = f"{study.rig}, {first.repeats} repeats of each case, seed {study.seed}; the same noise for every fit. {EXPLAINED}"
    success = f"Success: within {_per_cent(study.limits[0])} of the truth, all coefficients taken together."
    blocks: list[Block] = [Paragraph(f"{lead} {success}"), _case_table(study)]
    blocks.extend(Paragraph(threshold_text(threshold, study.share), "note") for threshold in study.thresholds)
    if len({case.noise for case in study.cases}) > 1:
        blocks.append(_noise_figure(study))
    noisiest = max(case.noise for case in study.cases)
    blocks.extend(_parameter_table(case) for case in study.cases if case.noise == noisiest and case.parameters)
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
        known = printed.get(case.fit)
        rows.append((*row, f"{known[levels.index(case.noise)]:g}" if known else "") if printed else row)
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
    return Table(PARAMETER_HEADER, rows, f"{case.fit} at {_per_cent(case.noise)} noise, {case.lines} lines", tuple(range(1, 8)))


def _means_table(study: Study, fit: str) -> Table:
    """Mean of every coefficient over the noise levels, below the truth."""
    cases = [case for case in study.cases if case.fit == fit and case.parameters]
    names = [p.name for p in cases[0].parameters] if cases else []
    truth = ("truth", *(f"{p.truth:.4g}" for p in cases[0].parameters)) if cases else ()
    rows = [truth, *((_per_cent(case.noise), *(f"{p.mean:.4g}" for p in case.parameters)) for case in cases)]
    caption = f"{fit}: mean of the estimates, repeats without a result left out"
    return Table(("noise", *names), tuple(rows), caption, tuple(range(1 + len(names))))


def _noise_figure(study: Study) -> Figure:
    """Median error, RMSE over the bound, coverage and success over the noise."""
    curves: tuple[tuple[str, Callable[[StudyCase], float | None]], ...] = (
        ("median error", lambda case: case.median_error),
        ("RMSE / CRLB", lambda case: case.rmse_over_bound),
        ("coverage [%]", lambda case: None if case.coverage is None else 100 * case.coverage),
        ("success [%]", lambda case: 100 * case.success[0]),
    )
    fits = list(dict.fromkeys(case.fit for case in study.cases))
    with mpl.rc_context(STYLE):
        canvas, axes = stacked_axes(len(curves), 7.4, sharex=True)
        for own, (label, value) in zip(axes, curves, strict=True):
            for number, fit in enumerate(fits):
                _curve(own, [case for case in study.cases if case.fit == fit], value, fit, COLOURS[number % len(COLOURS)])
            own.set_ylabel(label)
        logarithmic(axes[0])
        logarithmic(axes[1])
        axes[1].axhline(1.0, color="0.5", linewidth=0.8)
        axes[2].axhline(95.0, color="0.5", linewidth=0.8)
        axes[3].axhline(100 * study.share, color="0.5", linewidth=0.8)
        axes[0].legend(ncols=4, fontsize=8)
        axes[-1].set_xlabel("noise [%]")
    caption = "Errors against the Cramer-Rao bound, coverage of the 95 % intervals, and success over the noise; grey: what is asked for."
    return Figure(canvas, caption, f"Study on {study.rig}: error, efficiency, coverage and success of {', '.join(fits)} over the noise")


def _curve(axes: Axes, cases: Sequence[StudyCase], value: Callable[[StudyCase], float | None], label: str, colour: str) -> None:
    values = [np.nan if (found := value(case)) is None else found for case in cases]
    axes.plot([100 * case.noise for case in cases], values, ".-", color=colour, label=label, linewidth=1)


def _per_cent(share: float) -> str:
    return f"{100 * share:.4g} %"

"""The section study: the fits of a pipeline repeated on its virtual rig, judged, listed and shown."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from labpipe.errors import locate_errors
from labpipe.project.judging import CompareNumber
from labpipe.project.rules import Rule
from labpipe.project.work import Work
from labpipe.quantities import parse_value
from labpipe.records.comparison import Studies, Study, StudyCase
from labpipe.records.finding import Parameter
from labpipe.records.identification import Identification, ListedParameter, RuleOutcome
from labpipe.records.sections import PipelineSection
from labpipe.registry import nearest
from labpipe.report.chart import Axis, Panel, Series, curve, level, look, stack
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.wording import threshold_text
from labpipe.uncertainty.study import StudySettings, run_study

ERRORS = ("mean error", "variance", "median")
CASE_HEADER = ("fit", "noise", "lines", *ERRORS, "no result", "success", "RMSE / CRLB", "coverage")
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
    with_parameters = [case for case in study.cases if case.parameters]
    blocks.extend(_parameter_table(case) for case in with_parameters if case.noise == noisiest)
    evaluated = dict.fromkeys(case.fit for case in with_parameters)
    blocks.extend(_means_table(study, fit) for fit in evaluated)
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
            _show(case.rmse_over_bound, ".3f"),
            _per_cent(case.coverage),
        )
        errors = printed.get(case.fit)
        rows.append((*row, f"{errors[levels.index(case.noise)]:g}" if errors else "") if printed else row)
    numeric = tuple(range(1, len(header)))
    return Table(header, tuple(rows), "Errors, success and coverage of every fit", numeric)


def _parameter_table(case: StudyCase) -> Table:
    rows = tuple(
        (
            p.name,
            f"{p.truth:.6g} {p.unit}",
            f"{p.mean:.6g}",
            f"{p.bias:.2g}",
            f"{p.rmse:.3g}",
            _show(p.bound, ".3g"),
            _show(p.std_error, ".3g"),
            _per_cent(p.coverage),
        )
        for p in case.parameters
    )
    caption = f"{case.fit} at {_per_cent(case.noise)} noise, {case.lines} lines"
    return Table(PARAMETER_HEADER, rows, caption, tuple(range(1, 8)))


def _means_table(study: Study, fit: str) -> Table:
    cases = [case for case in study.cases if case.fit == fit and case.parameters]
    names = [p.name for p in cases[0].parameters]
    truth = ("truth", *(f"{p.truth:.4g}" for p in cases[0].parameters))
    rows = [truth, *((_per_cent(case.noise), *(f"{p.mean:.4g}" for p in case.parameters)) for case in cases)]
    caption = f"{fit}: mean of the estimates, repeats without a result left out"
    return Table(("noise", *names), tuple(rows), caption, tuple(range(1 + len(names))))


def _noise_figure(study: Study) -> Figure:
    fits = list(dict.fromkeys(case.fit for case in study.cases))
    panels = []
    # Title, unit, logarithmic axis, value of a case, required value of every panel.
    quantities: tuple[tuple[str, str, bool, Callable[[StudyCase], float | None], float | None], ...] = (
        ("median error", "", True, lambda case: case.median_error, None),
        ("RMSE / CRLB", "", True, lambda case: case.rmse_over_bound, 1.0),
        ("coverage", "%", False, lambda case: None if case.coverage is None else 100 * case.coverage, 95.0),
        ("success", "%", False, lambda case: 100 * case.success[0], 100 * study.share),
    )
    for title, unit, logarithmic, value, goal in quantities:
        series = [
            _curve([case for case in study.cases if case.fit == fit], value, number)
            for number, fit in enumerate(fits)
        ]
        goals = [] if goal is None else [level(goal)]
        axis = Axis(title, unit, logarithmic=logarithmic)
        panels.append(Panel(Axis("noise", "%"), axis, (*series, *goals)))
    caption = (
        "Errors against the Cramer-Rao bound, coverage of the 95 % intervals, and success over the "
        "noise; grey: required."
    )
    alternative = (
        f"Study on {study.rig}: error, efficiency, coverage and success of {', '.join(fits)} over the noise"
    )
    return Figure(stack(panels, 7.4), caption, alternative)


def _curve(cases: Sequence[StudyCase], value: Callable[[StudyCase], float | None], number: int) -> Series:
    values = [np.nan if (amount := value(case)) is None else amount for case in cases]
    return curve(cases[0].fit, [100 * case.noise for case in cases], values, *look(number), marker=".")


def _show(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _per_cent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.4g} %"


def run_studies(settings: StudySettings, work: Work) -> Studies:
    """The study of all fits of the pipeline; LabpipeError names the section."""
    pipeline = work.pipeline
    assert settings.virtual_rig is not None
    with locate_errors(f"{pipeline.path}: study"):
        return (run_study(settings.virtual_rig, settings, pipeline.fits, pipeline.frf, work.tell, work.jobs),)


_STUDIED = re.compile(r"^(?P<fit>[^.\[\]]+)(?:\[(?P<noise>[^\]]*)\])?\.(?P<item>\w+)$")
_CASE_VALUES: dict[str, Callable[[StudyCase], float | None]] = {
    "mean_error": lambda case: case.mean_error,
    "median_error": lambda case: case.median_error,
    "failed": lambda case: float(case.failed),
    "success": lambda case: case.success[0],
    "rmse_over_bound": lambda case: case.rmse_over_bound,
    "coverage": lambda case: case.coverage,
}


def study_outcome(rule: Rule, studies: Studies, compare_number: CompareNumber) -> RuleOutcome:
    """A rule on "fit[noise].item", or all noise levels; threshold is the noise of the success limit."""
    match = _STUDIED.match(rule.item)
    if match is None:
        raise rule.fault("is not an address", "write study.fit[1 %].coverage")
    if match["item"] == "threshold":
        values = [t.noise for study in studies for t in study.thresholds if t.fit == match["fit"]]
    else:
        with rule.faults_of_units():
            noise = None if match["noise"] is None else parse_value(match["noise"], "1")
        values = [
            _value(rule, case, match["item"])
            for study in studies
            for case in study.cases
            if case.fit == match["fit"] and (noise is None or math.isclose(noise, case.noise))
        ]
    if not values:
        raise rule.fault("no such case in the study")
    return rule.outcome_of_all([compare_number(rule, value, "1") for value in values])


def _value(rule: Rule, case: StudyCase, item: str) -> float | None:
    if item not in _CASE_VALUES:
        raise rule.fault(f"the study has no '{item}'", nearest(item, [*_CASE_VALUES, "threshold"]))
    return _CASE_VALUES[item](case)


def listed_cases(studies: Studies) -> Iterator[ListedParameter]:
    """The results of every fit at every noise level, as "study.FIT" of test "NOISE %, N lines"."""
    for study in studies:
        for case in study.cases:
            test = f"{100 * case.noise:g} %, {case.lines} lines"
            for name in ("mean_error", "success", "rmse_over_bound", "coverage"):
                value = _CASE_VALUES[name](case)
                if value is not None and value == value:
                    yield ListedParameter(
                        fit=f"study.{case.fit}",
                        parameter=Parameter(name, value, "1", derived=True),
                        test=test,
                        model="study",
                        estimator=case.estimator,
                    )


def _study_lines(study: Study) -> Iterator[str]:
    yield f"study on {study.rig}, seed {study.seed}"
    columns = (
        f"{'noise':>8}{'lines':>7}{'mean error':>12}{'median':>10}"
        f"{'failed':>12}{'success':>9}{'RMSE/CRLB':>11}{'coverage':>10}"
    )
    yield f"  {'fit':<10}{columns}"
    for case in study.cases:
        bound = _show(case.rmse_over_bound, ".3f")
        coverage = "" if case.coverage is None else f"{100 * case.coverage:.1f} %"
        failed = f"{case.failed} of {case.repeats}"
        yield (
            f"  {case.fit:<10}{100 * case.noise:>6.3g} %{case.lines:>7}{case.mean_error:>12.4g}"
            f"{case.median_error:>10.4g}{failed:>12}{100 * case.success[0]:>7.1f} %{bound:>11}{coverage:>10}"
        )
    for threshold in study.thresholds:
        yield f"  {threshold_text(threshold, study.share)}"


STUDY = PipelineSection(
    words="The fits repeated on a virtual rig.",
    settings=StudySettings,
    standalone=True,
    run=run_studies,
    record=Studies,
    entry="studies",
    outcome=study_outcome,
    parameters=listed_cases,
    report=study_sections,
    terminal=lambda studies: itertools.chain.from_iterable(map(_study_lines, studies)),
)

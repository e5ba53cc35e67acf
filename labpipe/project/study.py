"""The section study: the fits of a pipeline repeated on its virtual rig, judged, listed and shown."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator

from labpipe.errors import ConfigError, LabpipeError
from labpipe.project.judging import CompareNumber
from labpipe.project.rules import Rule
from labpipe.project.work import Work
from labpipe.quantities import parse_value
from labpipe.records.finding import Parameter
from labpipe.records.identification import ListedParameter, RuleOutcome
from labpipe.records.sections import PipelineSection
from labpipe.records.study import Studies, Study, StudyCase
from labpipe.registry import nearest
from labpipe.report.study import study_sections
from labpipe.report.wording import threshold_text
from labpipe.uncertainty.study import StudySettings, run_study


def run_studies(settings: StudySettings, work: Work) -> Studies:
    """The study of all fits of the pipeline; LabpipeError names the section."""
    pipeline = work.pipeline
    assert settings.virtual_rig is not None
    try:
        return (run_study(settings.virtual_rig, settings, pipeline.fits, pipeline.frf, work.tell, work.jobs),)
    except LabpipeError as error:
        error.where = error.where or f"{pipeline.path}: study"
        raise


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
    """A rule on "fit[noise].item", or "fit.item" for every noise level.

    Threshold is the noise level of the success limit.
    """
    match = _STUDIED.match(rule.item)
    if match is None:
        raise ConfigError(
            f"{rule.section}.{rule.address}: is no address",
            where=rule.place,
            hint="write study.fit[1 %].coverage",
        )
    if match["item"] == "threshold":
        values = [t.noise for study in studies for t in study.thresholds if t.fit == match["fit"]]
    else:
        cases = [
            case
            for study in studies
            for case in study.cases
            if case.fit == match["fit"] and _is_noise(match["noise"], case.noise)
        ]
        values = [_studied(rule, case, match["item"]) for case in cases]
    if not values:
        raise ConfigError(f"{rule.section}.{rule.address}: no such case in the study", where=rule.place)
    outcomes = [compare_number(rule, value, "1") for value in values]
    return RuleOutcome(
        rule.section, rule.text, *next((outcome for outcome in outcomes if not outcome[1]), outcomes[0])
    )


def _studied(rule: Rule, case: StudyCase, item: str) -> float | None:
    if item not in _CASE_VALUES:
        hint = nearest(item, [*_CASE_VALUES, "threshold"])
        raise ConfigError(
            f"{rule.section}.{rule.address}: the study has no '{item}'", where=rule.place, hint=hint
        )
    return _CASE_VALUES[item](case)


def _is_noise(text: str | None, noise: float) -> bool:
    return text is None or math.isclose(parse_value(text, "1"), noise)


def listed_cases(studies: Studies) -> Iterator[ListedParameter]:
    """Mean error, success, RMSE over bound and coverage of every fit at every noise level, as "study.FIT" of
    test "NOISE %, N lines".
    """
    for study in studies:
        for case in study.cases:
            test = f"{100 * case.noise:g} %, {case.lines} lines"
            for name, value in _figures(case).items():
                parameter = Parameter(name, value, "1", derived=True)
                yield ListedParameter(
                    fit=f"study.{case.fit}",
                    parameter=parameter,
                    test=test,
                    model="study",
                    estimator=case.estimator,
                )


def _figures(case: StudyCase) -> dict[str, float]:
    figures = {
        "mean_error": case.mean_error,
        "success": case.success[0],
        "rmse_over_bound": case.rmse_over_bound,
        "coverage": case.coverage,
    }
    return {name: value for name, value in figures.items() if value is not None and value == value}


def study_lines(studies: Studies) -> Iterator[str]:
    """One line for every fit at every noise level, then the thresholds."""
    for study in studies:
        yield from _study_lines(study)


def _study_lines(study: Study) -> Iterator[str]:
    yield f"study on {study.rig}, seed {study.seed}"
    columns = (
        f"{'noise':>8}{'lines':>7}{'mean error':>12}{'median':>10}"
        f"{'failed':>12}{'success':>9}{'RMSE/CRLB':>11}{'coverage':>10}"
    )
    yield f"  {'fit':<10}{columns}"
    for case in study.cases:
        bound = "" if case.rmse_over_bound is None else f"{case.rmse_over_bound:.3f}"
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
    terminal=study_lines,
)

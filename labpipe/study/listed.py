"""Results of a study for lists of results."""

from __future__ import annotations

from collections.abc import Iterator

from labpipe.records.listed import ListedParameter
from labpipe.records.parameter import Parameter
from labpipe.records.study import Studies, StudyCase


def listed_cases(studies: Studies) -> Iterator[ListedParameter]:
    """Mean error, success, RMSE over bound and coverage of every fit at every noise level, as "study.FIT" of test "NOISE %, N lines"."""
    for study in studies:
        for case in study.cases:
            test = f"{100 * case.noise:g} %, {case.lines} lines"
            for name, value in _figures(case).items():
                parameter = Parameter(name, value, "1", derived=True)
                yield ListedParameter(fit=f"study.{case.fit}", parameter=parameter, test=test, model="study", estimator=case.estimator)


def _figures(case: StudyCase) -> dict[str, float]:
    figures = {
        "mean_error": case.mean_error,
        "success": case.success[0],
        "rmse_over_bound": case.rmse_over_bound,
        "coverage": case.coverage,
    }
    return {name: value for name, value in figures.items() if value is not None and value == value}

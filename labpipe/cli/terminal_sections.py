"""Results of a pipeline's sections on the terminal, line by line."""

from __future__ import annotations

import math
from collections.abc import Iterator

from labpipe.records.comparison import Comparisons
from labpipe.records.condition_matrix import ConditionMatrices
from labpipe.records.run_up_result import REJECTED, MeasuredRun, RunPrediction, RunUpResult
from labpipe.records.study import Studies, Study
from labpipe.report.wording import threshold_text


def comparison_lines(comparisons: Comparisons) -> Iterator[str]:
    """The statement of every comparison."""
    return (f"{comparison.name}: {comparison.statement}" for comparison in comparisons)


def matrix_lines(matrices: ConditionMatrices) -> Iterator[str]:
    """The statement of every matrix."""
    return (f"{matrix.name}: {matrix.statement}" for matrix in matrices)


def study_lines(studies: Studies) -> Iterator[str]:
    """One line for every fit at every noise level, then the thresholds."""
    for study in studies:
        yield from _study_lines(study)


def _study_lines(study: Study) -> Iterator[str]:
    yield f"study on {study.rig}, seed {study.seed}"
    columns = f"{'noise':>8}{'lines':>7}{'mean error':>12}{'median':>10}{'failed':>12}{'success':>9}{'RMSE/CRLB':>11}{'coverage':>10}"
    yield f"  {'fit':<10}{columns}"
    for case in study.cases:
        bound = "" if case.rmse_over_bound is None else f"{case.rmse_over_bound:.3f}"
        coverage = "" if case.coverage is None else f"{100 * case.coverage:.1f} %"
        yield (
            f"  {case.fit:<10}{100 * case.noise:>6.3g} %{case.lines:>7}{case.mean_error:>12.4g}{case.median_error:>10.4g}"
            f"{f'{case.failed} of {case.repeats}':>12}{100 * case.success[0]:>7.1f} %{bound:>11}{coverage:>10}"
        )
    for threshold in study.thresholds:
        yield f"  {threshold_text(threshold, study.share)}"


def run_up_lines(result: RunUpResult) -> Iterator[str]:
    """Critical and threshold speed of every run, measured and by every method, in rpm; then how far each method is determined."""
    yield f"run-ups of {result.rotor}: critical speed / threshold [rpm]"
    names = ["measured", *(f"{method.name} {REJECTED}" if method.verdict == REJECTED else method.name for method in result.methods)]
    yield f"  {'run':<12}{'load [N]':>9}" + "".join(f"{name:>17}" for name in names)
    for run in result.runs:
        columns = [run, *(method.prediction(run.name) for method in result.methods)]
        yield f"  {run.name:<12}{run.load:>9.4g}" + "".join(f"{_speeds(column):>17}" for column in columns)
    for method in result.methods:
        if method.rank is not None:
            chi2 = "" if method.chi2_per_datum is None else f", chi2 per datum {method.chi2_per_datum:.2f}"
            yield f"  {method.title}: {method.verdict}, rank {method.rank} of {method.unknowns}{chi2}"


def _speeds(owner: MeasuredRun | RunPrediction | None) -> str:
    speeds = () if owner is None else (owner.critical_speed, owner.threshold)
    return " / ".join("-" if speed is None else f"{speed.value * 30 / math.pi:.0f}" for speed in speeds) or "-"

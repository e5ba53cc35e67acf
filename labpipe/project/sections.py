"""The sections identify, compare and matrix: how each is read, judged and shown.

What computes is loaded by a run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from labpipe.estimation.settings import FitSettings
from labpipe.project.judging import comparison_outcome, matrix_outcome
from labpipe.project.pipeline_file import read_comparison, read_fit, read_matrix
from labpipe.project.work import Work, run_fits
from labpipe.records.comparison import Comparisons, ConditionMatrices, findings, matrix_findings, names
from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import Identification, ListedParameter
from labpipe.records.sections import PipelineSection
from labpipe.report.document import Section
from labpipe.uncertainty.settings import CompareSettings, MatrixSettings


def _run_comparisons(settings: Sequence[CompareSettings], work: Work) -> Comparisons:
    from labpipe.project.compare import run_comparisons

    return run_comparisons(settings, work)


def _run_matrices(settings: Sequence[MatrixSettings], work: Work) -> ConditionMatrices:
    from labpipe.project.compare import run_matrices

    return run_matrices(settings, work)


def _comparison_sections(comparisons: Comparisons, identification: Identification) -> tuple[Section, ...]:
    from labpipe.report.comparison import comparison_sections

    return comparison_sections(comparisons, identification)


def _matrix_sections(matrices: ConditionMatrices, identification: Identification) -> tuple[Section, ...]:
    from labpipe.report.condition_matrix import matrix_sections

    return matrix_sections(matrices, identification)


def listed_amounts(comparisons: Comparisons) -> Iterator[ListedParameter]:
    """Every amount under the name of its comparison."""
    for comparison in comparisons:
        codes = tuple(dict.fromkeys(finding.code for finding in of_level(WARNING, comparison.findings)))
        for amount in comparison.amounts:
            yield ListedParameter(
                fit=comparison.name, parameter=amount, model=comparison.kind, warnings=codes
            )


def listed_points(matrices: ConditionMatrices) -> Iterator[ListedParameter]:
    """Every coefficient at every point under the name of its matrix, as of the test "speed 3000 rpm, load 1
    kN".
    """
    for matrix in matrices:
        for point in matrix.points:
            place = matrix.text_of(point)
            for value in point.values:
                yield ListedParameter(
                    fit=matrix.name,
                    parameter=value.parameter,
                    test=place,
                    model="matrix",
                    warnings=point.warnings,
                )


def comparison_lines(comparisons: Comparisons) -> Iterator[str]:
    """The statement of every comparison."""
    return (f"{comparison.name}: {comparison.statement}" for comparison in comparisons)


def matrix_lines(matrices: ConditionMatrices) -> Iterator[str]:
    """The statement of every matrix."""
    return (f"{matrix.name}: {matrix.statement}" for matrix in matrices)


IDENTIFY = PipelineSection(
    words="One entry per fit, under a name of your choice.",
    settings=FitSettings,
    named=True,
    read=read_fit,
    run=run_fits,
    fits=True,
)
COMPARE = PipelineSection(
    words="One entry per question to tests that differ in a condition, under a name of your choice.",
    settings=CompareSettings,
    named=True,
    read=read_comparison,
    run=_run_comparisons,
    record=Comparisons,
    entry="comparisons",
    names=names,
    outcome=comparison_outcome,
    findings=findings,
    parameters=listed_amounts,
    report=_comparison_sections,
    terminal=comparison_lines,
)
MATRIX = PipelineSection(
    words="One entry per matrix of tests: the coefficients of a fit over two conditions or more, under a "
    "name of your choice.",
    settings=MatrixSettings,
    named=True,
    read=read_matrix,
    run=_run_matrices,
    record=ConditionMatrices,
    entry="matrices",
    names=names,
    outcome=matrix_outcome,
    findings=matrix_findings,
    parameters=listed_points,
    report=_matrix_sections,
    terminal=matrix_lines,
)

"""Amounts of comparisons and points of matrices as lists of results show them."""

from __future__ import annotations

from collections.abc import Iterator

from labpipe.records.comparison import Comparisons
from labpipe.records.condition_matrix import ConditionMatrices
from labpipe.records.finding import WARNING, of_level
from labpipe.records.listed import ListedParameter


def listed_amounts(comparisons: Comparisons) -> Iterator[ListedParameter]:
    """Every amount under the name of its comparison."""
    for comparison in comparisons:
        codes = tuple(dict.fromkeys(finding.code for finding in of_level(WARNING, comparison.findings)))
        for amount in comparison.amounts:
            yield ListedParameter(fit=comparison.name, parameter=amount, model=comparison.kind, warnings=codes)


def listed_points(matrices: ConditionMatrices) -> Iterator[ListedParameter]:
    """Every coefficient at every point under the name of its matrix, as of the test "speed 3000 rpm, load 1 kN"."""
    for matrix in matrices:
        for point in matrix.points:
            place = matrix.text_of(point)
            for value in point.values:
                yield ListedParameter(fit=matrix.name, parameter=value.parameter, test=place, model="matrix", warnings=point.warnings)

"""The covariance of an FRF in two factors: against numpy.kron, and what a response makes of it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.response import FactoredCovariance, FrequencyResponse, Port


def factors(rng: np.random.Generator, n_line: int = 4) -> FactoredCovariance:
    roots = [rng.normal(size=(n_line, n, n)) + 1j * rng.normal(size=(n_line, n, n)) for n in (3, 2)]
    outputs, inputs = (root @ root.conj().swapaxes(1, 2) for root in roots)
    return FactoredCovariance(outputs, inputs)


def response(covariance: FactoredCovariance | np.ndarray | None) -> FrequencyResponse:
    outputs, inputs = (
        tuple(Port(f"{kind}{n}", f"{kind}{n}", f"{kind}{n}") for n in range(number))
        for kind, number in (("y", 3), ("f", 2))
    )
    return FrequencyResponse(
        np.arange(1.0, 5.0), np.ones((4, 3, 2), complex), outputs, inputs, covariance=covariance
    )


def test_a_response_reads_as_with_the_kronecker_product(rng: np.random.Generator) -> None:
    covariance = factors(rng)
    expected = np.array(
        [np.kron(left, right) for left, right in zip(covariance.outputs, covariance.inputs, strict=True)]
    )
    given, kept = response(expected), response(covariance)
    assert given.variance is not None and kept.variance is not None
    np.testing.assert_allclose(kept.variance, given.variance, rtol=1e-14)
    np.testing.assert_allclose(kept.covariance_of(1, 4), expected[:, 1, 4], rtol=1e-14)
    np.testing.assert_allclose(pickle.loads(pickle.dumps(kept)).covariance, expected, rtol=1e-14)
    assert kept.covariance is not None
    np.testing.assert_allclose(kept.covariance, expected, rtol=1e-14, atol=1e-14)
    # Made once, and read-only as every array of a record.
    assert kept.covariance is kept.covariance
    assert not kept.covariance.flags.writeable
    np.testing.assert_allclose(kept.covariance_of(1, 4), expected[:, 1, 4], rtol=1e-14)


def test_a_response_with_more_findings_is_the_same_otherwise(rng: np.random.Generator) -> None:
    first = response(factors(rng))
    second = first.with_findings([Finding("drift", "it drifts")])
    assert [finding.code for finding in second.findings] == ["drift"]
    assert not first.findings
    assert second.variance is not None and first.variance is not None
    np.testing.assert_array_equal(second.variance, first.variance)


def test_factors_of_another_size_or_no_numbers_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(DataError, match=r"covariance has the shape \(5, 6, 6\), \(4, 6, 6\) is needed"):
        response(factors(rng, 5))
    good = factors(rng)
    bad = good.outputs.copy()
    bad[2, 0, 1] = np.nan
    with pytest.raises(DataError, match=r"covariance of the outputs is not finite at index \(2, 0, 1\)"):
        FactoredCovariance(bad, good.inputs)
    with pytest.raises(DataError, match="covariance of '' is not known"):
        response(None).covariance_of(0, 0)

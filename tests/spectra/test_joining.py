"""Responses that lie in several files as one matrix."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.response import Blocks, FrequencyResponse, Port
from labpipe.records.uncertain import MatrixError, Uncertainty
from labpipe.spectra.ports import join

FREQUENCY = np.array([1.0, 2.0, 3.0])


def part(output: str, reference: str, value: complex, name: str = "", **entries) -> FrequencyResponse:
    described = {"frequency": FREQUENCY, "form": "mobility", **entries}
    ports = [(Port(label, label, label),) for label in (output, reference)]
    return FrequencyResponse(
        **described, matrix=np.full((3, 1, 1), value), outputs=ports[0], inputs=ports[1], name=name
    )


def test_elements_come_to_their_places_in_the_order_of_their_numbers() -> None:
    """Points 1, 2, 10 measured in another order; H_oi = o + 100 j i."""
    response = join([part(f"p{o}", f"q{i}", o + 100j * i) for o in (10, 2, 1) for i in (20, 3)])
    assert [port.label for port in response.outputs] == ["p1", "p2", "p10"] and [
        port.label for port in response.inputs
    ] == ["q3", "q20"]
    np.testing.assert_array_equal(response.matrix[1], [[o + 100j * i for i in (3, 20)] for o in (1, 2, 10)])
    assert response.form == "mobility" and response.coherence is None and response.covariance is None


def test_coherence_and_noise_stay_with_their_elements() -> None:
    """Variances 1, 2, 3, 4 of independent files are the diagonal of the covariance."""
    pairs = [("a", "f"), ("a", "g"), ("b", "f"), ("b", "g")]
    parts = [
        part(
            o,
            i,
            1.0,
            covariance=np.full((3, 1, 1), n + 1.0),
            coherence=np.full((3, 1, 1), n / 10),
            covariance_dof=9.0 - n,
        )
        for n, (o, i) in enumerate(pairs)
    ]
    response = join(parts[::-1])
    np.testing.assert_array_equal(response.covariance[2], np.diag([1.0, 2.0, 3.0, 4.0]))
    np.testing.assert_array_equal(response.coherence[0], [[0.0, 0.1], [0.2, 0.3]])
    assert response.covariance_dof == 6.0


def test_blocks_of_bursts_have_their_mean_course_and_others_none() -> None:
    """0.9 and 1.1 are 1 on the mean; a burst beside steady data is neither."""
    bursts = [Blocks(1.0, "boxcar", 0.0, 9, "H1", bursts=course) for course in ((1.1, 0.0), (0.9, 0.0), ())]
    parts = [part(f"a{n}", "f", 1.0, blocks=of) for n, of in enumerate(bursts)]
    joined = join(parts[:2]).blocks
    assert joined is not None and joined.bursts == pytest.approx((1.0, 0.0))
    assert join(parts).blocks is None and join(parts[2:]).blocks == bursts[2]


def test_blocks_of_hits_are_those_of_a_point_that_rings_on() -> None:
    """One of two points rings on where its block ends: nothing is cut off at the other that counts."""
    rings = Blocks(1.0, "boxcar", 0.0, 1, "H1", after_hit=0.98)
    parts = [part("a1", "f", 1.0, blocks=rings), part("a2", "f", 1.0)]
    assert join(parts).blocks == rings == join(parts[::-1]).blocks
    assert join(parts[1:]).blocks is None


def test_errors_of_one_number_are_one_error_in_all_files() -> None:
    """The gain of the force is that of both files, the error of a sum in one of them that of its own
    element.
    """

    def error(source: str, value: complex) -> MatrixError:
        return MatrixError(Uncertainty(source, 0.01, "1"), np.full((3, 1, 1), value))

    parts = [
        part("a", "f", 1, errors=(error("gain", 2), error("sum", 5))),
        part("b", "f", 1, errors=(error("gain", 3j),)),
    ]
    found = {one.uncertainty.source: one.change for one in join(parts).errors}
    np.testing.assert_array_equal(found["gain"][1], [[2], [3j]])
    np.testing.assert_array_equal(found["sum"][1], [[5], [0]])
    # A file by itself is the whole matrix.
    (alone,) = join(parts[1:]).errors
    np.testing.assert_array_equal(alone.change, np.full((3, 1, 1), 3j))


@pytest.mark.parametrize(
    ("second", "fault"),
    [
        (part("a", "f", 2, "b.txt"), "a/f lies in a.txt and in b.txt"),
        (part("b", "g", 2, "b.txt"), "a/g, b/f was not measured"),
        (part("b", "f", 2, "b.txt", form="receptance"), "b.txt is a receptance, a.txt a mobility"),
        (
            part("b", "f", 2, "b.txt", frequency=np.array([1.0, 2.0, 3.1])),
            "b.txt differ from those of a.txt: 3.1 and 3 Hz at line 3",
        ),
    ],
)
def test_what_makes_no_matrix_is_refused_with_the_files(second: FrequencyResponse, fault: str) -> None:
    with pytest.raises(DataError, match=fault):
        join([part("a", "f", 1, "a.txt"), second])

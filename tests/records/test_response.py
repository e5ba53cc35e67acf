"""A frequency response: shapes, ports, the variance in its covariance."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labpipe.errors import DataError
from labpipe.quantities import parse_unit
from labpipe.records.response import FORMS, FrequencyResponse, Port, diagonal_covariance

X, Y = Port("x", "x1", "x", 0.0), Port("y", "y1", "y", math.pi / 2)
F, G = Port("f", "f", "45 deg", math.pi / 4), Port("g", "hammer", "bearing2.y")


def response(n_frequency: int = 3, **changes: object) -> FrequencyResponse:
    rng = np.random.default_rng(11)
    matrix = rng.normal(size=(n_frequency, 2, 2)) + 1j * rng.normal(size=(n_frequency, 2, 2))
    whole = FrequencyResponse(np.arange(1.0, n_frequency + 1), matrix, (X, Y), (F, G), name="427N")
    return dataclasses.replace(whole, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["y", "y1"])
def test_a_port_answers_to_label_channel_and_dof(name: str) -> None:
    assert Y.answers_to(name) and not X.answers_to(name)
    assert G.answers_to("bearing2.y") and G.answers_to("hammer") and G.answers_to("g")


@pytest.mark.parametrize("name", ["", "Y", "bearing2", "y2"])
def test_a_port_answers_to_nothing_else(name: str) -> None:
    assert not any(port.answers_to(name) for port in (X, Y, F, G))


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_allowed_and_has_a_unit(form: str) -> None:
    assert response(form=form).form == form
    parse_unit(FORMS[form])


def test_forms_follow_from_one_another_by_seconds() -> None:
    """Mobility is receptance per second, accelerance mobility per second: two dimensions that differ by s^-1
    each.
    """
    seconds = [parse_unit(FORMS[form]).dimension[2] for form in ("receptance", "mobility", "accelerance")]
    assert seconds == [2.0, 1.0, 0.0]


def test_another_form_is_refused_with_the_known_ones() -> None:
    with pytest.raises(DataError) as caught:
        response(form="inertance")
    assert str(caught.value) == (
        "unknown form 'inertance'; known: receptance, mobility, accelerance, transmissibility, other"
    )


@pytest.mark.parametrize("frequency", [[1.0, 1.0, 2.0], [3.0, 2.0, 1.0], [1.0, 3.0, 2.0]])
def test_frequencies_must_increase(frequency: list[float]) -> None:
    with pytest.raises(DataError, match="the frequencies of '427N' do not increase"):
        response(frequency=np.array(frequency))


def test_a_frequency_that_is_none_is_refused() -> None:
    with pytest.raises(DataError, match=r"frequency is not finite at index \(2,\)"):
        response(frequency=np.array([1.0, 2.0, np.inf]))


@pytest.mark.parametrize(
    ("side", "ports"), [("outputs", (X, X)), ("inputs", (F, dataclasses.replace(G, label="f")))]
)
def test_two_rows_or_columns_of_one_label_are_refused(side: str, ports: tuple[Port, ...]) -> None:
    label = ports[0].label
    with pytest.raises(DataError, match=f"two rows or columns of '427N' have one label: {label}, {label}"):
        response(**{side: ports})


def test_an_output_may_have_the_label_of_an_input() -> None:
    same = response(inputs=(dataclasses.replace(F, label="x"), G))
    assert same.inputs[0].label == same.outputs[0].label


RIGHT_SHAPES = {
    "covariance": (3, 4, 4),
    "coherence": (3, 2, 2),
    "multiple_coherence": (3, 2),
    "partial_coherence": (3, 2, 2),
    "distortion": (3, 2, 2),
}


@pytest.mark.parametrize(("name", "shape"), RIGHT_SHAPES.items())
def test_optional_parts_have_their_own_shape_and_are_read_only(name: str, shape: tuple[int, ...]) -> None:
    part = getattr(response(**{name: np.ones(shape)}), name)
    assert part.shape == shape and not part.flags.writeable
    assert getattr(response(), name) is None


@pytest.mark.parametrize(("name", "shape"), RIGHT_SHAPES.items())
@pytest.mark.parametrize("change", ["line", "short"])
def test_optional_parts_of_another_shape_are_refused(name: str, shape: tuple[int, ...], change: str) -> None:
    wrong = (shape[0] + 1, *shape[1:]) if change == "line" else (*shape[:-1], shape[-1] - 1)
    with pytest.raises(DataError, match=f"{name} has the shape"):
        response(**{name: np.ones(wrong)})


@pytest.mark.parametrize(("name", "shape"), RIGHT_SHAPES.items())
def test_optional_parts_hold_numbers_only(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(DataError, match=f"{name} is not finite at index"):
        response(**{name: np.full(shape, np.nan)})


def test_signal_to_noise_ratios_have_a_column_for_each_of_their_channels() -> None:
    assert response(snr=np.ones((3, 1)), snr_channels=("f",)).snr.shape == (3, 1)
    with pytest.raises(DataError, match="snr has the shape"):
        response(snr=np.ones((3, 2)), snr_channels=("f",))


@pytest.mark.parametrize("shape", [(3, 2), (3, 2, 1), (3, 1, 2), (2, 2, 2)])
def test_a_matrix_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(DataError, match="FRF matrix has the shape"):
        response(matrix=np.ones(shape))


def test_a_single_line_and_none_are_responses() -> None:
    assert response(1).n_frequency == 1
    assert response(0).n_frequency == 0


def test_without_covariance_there_is_no_variance() -> None:
    assert response().variance is None


@settings(derandomize=True, max_examples=40)
@given(st.integers(1, 3), st.integers(1, 3), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_variance_is_the_diagonal_of_the_covariance_output_by_output(
    n_output: int, n_input: int, n_frequency: int, seed: int
) -> None:
    """Index = output * n_input + input: the entry (o, i) of the variance stands at that place of the
    diagonal.
    """
    rng = np.random.default_rng(seed)
    n = n_output * n_input
    root = rng.normal(size=(n_frequency, n, n)) + 1j * rng.normal(size=(n_frequency, n, n))
    covariance = root @ root.conj().swapaxes(1, 2)
    measured = FrequencyResponse(
        np.arange(1.0, n_frequency + 1),
        np.ones((n_frequency, n_output, n_input)),
        tuple(Port(f"o{k}", f"o{k}", f"o{k}") for k in range(n_output)),
        tuple(Port(f"i{k}", f"i{k}", f"i{k}") for k in range(n_input)),
        covariance=covariance,
    )
    for o in range(n_output):
        for i in range(n_input):
            place = o * n_input + i
            np.testing.assert_array_equal(measured.variance[:, o, i], covariance[:, place, place].real)


@settings(derandomize=True, max_examples=30)
@given(st.integers(1, 3), st.integers(1, 3), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_elements_without_correlation_have_their_variance_back(
    n_output: int, n_input: int, n_frequency: int, seed: int
) -> None:
    variance = np.random.default_rng(seed).uniform(size=(n_frequency, n_output, n_input))
    covariance = diagonal_covariance(variance)
    n = n_output * n_input
    assert covariance.shape == (n_frequency, n, n)
    np.testing.assert_array_equal(covariance * (1 - np.eye(n)), 0)
    np.testing.assert_array_equal(np.einsum("fii->fi", covariance).real, variance.reshape(n_frequency, n))


def test_defaults_say_that_nothing_is_known_beyond_the_matrix() -> None:
    plain = response()
    assert (plain.form, plain.averages, plain.covariance_dof) == ("receptance", 1.0, math.inf)
    assert (plain.line_correlation, plain.findings, plain.conditions, plain.snr_channels) == ((), (), {}, ())

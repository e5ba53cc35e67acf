"""Arrays of records: the right shape, finite, their own copy, read-only."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labpipe.arrays import freeze_bases, frozen_array
from labpipe.errors import DataError

SHAPES = st.lists(st.integers(1, 4), min_size=1, max_size=3).map(tuple)


@settings(derandomize=True, max_examples=40)
@given(SHAPES, st.sampled_from([np.float64, np.complex128]))
def test_values_shape_and_type_are_kept(shape: tuple[int, ...], dtype: type) -> None:
    values = np.arange(np.prod(shape)).reshape(shape)
    array = frozen_array(values, dtype, "x", shape)
    assert array.shape == shape and array.dtype == dtype
    np.testing.assert_array_equal(array, values)


@settings(derandomize=True, max_examples=40)
@given(SHAPES, st.data())
def test_the_first_number_that_is_none_is_named_by_its_index(
    shape: tuple[int, ...], draw: st.DataObject
) -> None:
    values = np.zeros(shape)
    index = tuple(draw.draw(st.integers(0, n - 1)) for n in shape)
    values[index] = draw.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    with pytest.raises(DataError) as caught:
        frozen_array(values, np.float64, "speed", shape)
    assert str(caught.value) == f"speed is not finite at index {index}"


@settings(derandomize=True, max_examples=30)
@given(SHAPES, SHAPES)
def test_another_shape_is_refused_and_both_are_named(shape: tuple[int, ...], other: tuple[int, ...]) -> None:
    if shape == other:
        return
    with pytest.raises(DataError) as caught:
        frozen_array(np.zeros(shape), np.float64, "coherence", other)
    assert str(caught.value) == f"coherence has the shape {shape}, {other} is needed"


def test_it_cannot_be_written() -> None:
    array = frozen_array([1.0, 2.0], np.float64, "x", (2,))
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 3.0


def test_it_is_no_view_of_what_it_was_made_from() -> None:
    """A caller that goes on to fill its own buffer must not change the record."""
    buffer = np.array([1.0, 2.0])
    array = frozen_array(buffer, np.float64, "x", (2,))
    buffer[:] = 7.0
    np.testing.assert_array_equal(array, [1.0, 2.0])
    assert buffer.flags.writeable


def test_what_was_handed_over_is_taken_without_a_copy_and_can_no_longer_be_written() -> None:
    buffer = np.array([[1.0, 2.0], [3.0, 4.0]])
    array = frozen_array(freeze_bases(buffer.T), np.float64, "x", (2, 2))
    assert np.shares_memory(array, buffer)
    with pytest.raises(ValueError, match="read-only"):
        buffer[0, 0] = 7.0


def test_a_read_only_view_of_what_can_be_written_is_copied() -> None:
    buffer = np.array([1.0, 2.0])
    view = buffer.view()
    view.flags.writeable = False
    array = frozen_array(view, np.float64, "x", (2,))
    buffer[:] = 7.0
    np.testing.assert_array_equal(array, [1.0, 2.0])


def test_lists_and_whole_numbers_become_floats() -> None:
    array = frozen_array([[1, 2], [3, 4]], np.float64, "x", (2, 2))
    assert array.dtype == np.float64 and array[1, 0] == 3.0


def test_an_imaginary_part_that_is_none_is_found() -> None:
    with pytest.raises(DataError, match=r"H is not finite at index \(1,\)"):
        frozen_array([1.0, complex(0.0, np.nan)], np.complex128, "H", (2,))


def test_empty_arrays_are_allowed_where_the_shape_says_so() -> None:
    assert frozen_array(np.zeros((0, 3)), np.float64, "x", (0, 3)).size == 0

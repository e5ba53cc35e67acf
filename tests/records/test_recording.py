"""Channels and recordings: what they refuse, the units they state, the blocks they give."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labpipe.errors import DataError
from labpipe.quantities import QUANTITIES
from labpipe.records.finding import Finding
from labpipe.records.recording import ROLES, Channel, Recording

F = Channel("f", "force", "input", "x", 0.0)
X = Channel("x", "displacement", "output", "x", 0.0)


def recording(n_sample: int = 10, **changes: object) -> Recording:
    samples = np.arange(2.0 * n_sample).reshape(n_sample, 2)
    return dataclasses.replace(Recording((F, X), samples, 1000.0, "run 7"), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("quantity", list(QUANTITIES))
def test_a_channel_states_the_si_unit_of_its_quantity(quantity: str) -> None:
    assert Channel("a", quantity, "reference", "a").unit == QUANTITIES[quantity].si_unit


@pytest.mark.parametrize(
    ("quantity", "unit"),
    [
        ("force", "N"),
        ("displacement", "m"),
        ("velocity", "m/s"),
        ("acceleration", "m/s^2"),
        ("temperature", "K"),
        ("current", "A"),
    ],
)
def test_units_of_common_quantities(quantity: str, unit: str) -> None:
    assert Channel("a", quantity, "reference", "a").unit == unit


@pytest.mark.parametrize("role", ROLES)
def test_every_role_is_allowed(role: str) -> None:
    assert Channel("a", "force", role, "x").role == role


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"quantity": "weight"}, "channel 'f' has the unknown quantity 'weight'"),
        ({"quantity": ""}, "channel 'f' has the unknown quantity ''"),
        ({"role": "monitor"}, "channel 'f' has the unknown role 'monitor'"),
        ({"role": "Input"}, "channel 'f' has the unknown role 'Input'"),
    ],
)
def test_a_channel_that_cannot_be_is_refused(changes: dict[str, str], said: str) -> None:
    with pytest.raises(DataError) as caught:
        dataclasses.replace(F, **changes)  # type: ignore[arg-type]
    assert caught.value.what == said and str(caught.value).startswith(f"{said}; ")


def test_a_quantity_is_answered_by_the_nearest_one() -> None:
    with pytest.raises(DataError, match="did you mean 'force'"):
        dataclasses.replace(F, quantity="Force")


def test_rows_of_a_sensor_response_are_tuples_whatever_they_came_as() -> None:
    rows = [[10.0, 1.0, 0.0], [100.0, 0.9, -0.1]]
    channel = Channel("x", "displacement", "output", "x", response=rows)  # type: ignore[arg-type]
    assert channel.response == ((10.0, 1.0, 0.0), (100.0, 0.9, -0.1))
    assert hash(channel) == hash(dataclasses.replace(channel, response=tuple(tuple(row) for row in rows)))


def test_channels_and_recordings_cannot_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        F.name = "g"  # type: ignore[misc]
    with pytest.raises(dataclasses.FrozenInstanceError):
        recording().sample_rate = 2.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        recording().samples[0, 0] = 1.0


@pytest.mark.parametrize("rate", [0.0, -1000.0, math.nan])
def test_a_rate_that_is_not_above_zero_is_refused(rate: float) -> None:
    with pytest.raises(DataError, match=r"recording 'run 7' has the sample rate .* Hz"):
        recording(sample_rate=rate)


def test_two_channels_of_one_name_are_refused() -> None:
    with pytest.raises(DataError, match="recording 'run 7' has two channels of one name: f, f"):
        recording(channels=(F, dataclasses.replace(X, name="f")))


@pytest.mark.parametrize("shape", [(10,), (10, 1), (10, 3), (2, 10), (10, 2, 1)])
def test_samples_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(DataError, match="recording 'run 7' has the shape"):
        recording(samples=np.zeros(shape))


def test_rows_in_place_of_columns_are_told_what_to_do() -> None:
    with pytest.raises(DataError, match=r"\(2, 10\), a row for each channel; a column for each: samples\.T"):
        recording(samples=np.zeros((2, 10)))


def test_a_sample_that_is_no_number_is_named_by_sample_and_channel() -> None:
    samples = np.zeros((10, 2))
    samples[6, 1] = np.nan
    with pytest.raises(DataError, match=r"recording 'run 7' is not finite at index \(6, 1\)"):
        recording(samples=samples)


@settings(derandomize=True, max_examples=60)
@given(st.integers(0, 40), st.integers(1, 50))
def test_blocks_together_are_the_recording(n_sample: int, block: int) -> None:
    whole = recording(n_sample)
    parts = list(whole.blocks(block))
    assert [len(part) for part in parts] == [block] * (n_sample // block) + (
        [n_sample % block] if n_sample % block else []
    )
    np.testing.assert_array_equal(np.concatenate(parts) if parts else np.zeros((0, 2)), whole.samples)


def test_the_number_of_samples_is_that_of_the_array() -> None:
    assert recording(7).n_sample == 7
    assert recording(0).n_sample == 0


def test_findings_and_conditions_are_the_recording_s_own() -> None:
    gap = Finding("gap", "12 samples are missing at 3 s")
    assert recording(findings=(gap,), conditions={"speed": "3000 rpm"}).findings == (gap,)
    assert recording().conditions == {} and recording().conditions is not recording().conditions

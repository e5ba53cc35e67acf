"""What names and units of columns say of channels, and what only a person can decide."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labpipe.project.first_guess import (
    GuessedChannel,
    copies,
    guess_channels,
    time_columns,
    without_static_forces,
)
from labpipe.project.settings_reader import DECIDE


def guess(name: str, unit: str = "") -> GuessedChannel:
    (channel,) = guess_channels([name], {name: unit} if unit else {})
    return channel


@pytest.mark.parametrize(
    ("name", "unit", "quantity", "role"),
    [
        ("force", "N", "force", "input"),
        ("Kraft", "kN", "force", "input"),
        ("anything", "N", "force", "input"),
        ("x", "um", "displacement", "output"),
        ("x", "mm/s", "velocity", "output"),
        ("acc 3", "gn", "acceleration", "output"),
        ("oil", "degC", "temperature", "reference"),
        ("feed", "bar", "pressure", "reference"),
        ("coil", "A", "current", "reference"),
        ("torque", "N.m", "moment", "reference"),
        ("tacho", "V", "tacho", "reference"),
        ("Drehzahl", "", "tacho", "reference"),
        ("keyphasor", "V", "tacho", "reference"),
        ("KEY", "V", "tacho", "reference"),
        ("LC_X", "V", "force", "input"),
    ],
)
def test_unit_and_name_say_the_quantity(name: str, unit: str, quantity: str, role: str) -> None:
    found = guess(name, unit)
    assert (found.quantity, found.role) == (quantity, role) and found.column == name


def test_a_name_that_its_unit_contradicts_is_for_a_person() -> None:
    """A column called force in um or g: neither the name nor the unit is believed."""
    for unit, measured in (("um", "displacement"), ("g", "acceleration")):
        found = guess("force", unit)
        assert found.quantity == DECIDE and found.decisions[-1] == f"the name says force, the unit {measured}"


def test_the_g_of_accelerometers_is_an_acceleration() -> None:
    assert (
        guess("channel 1", "g").quantity == "acceleration"
        and guess("channel 1", "mg").quantity == "acceleration"
    )


@pytest.mark.parametrize(
    ("sensitivity", "quantity", "role"),
    [
        ("100 mV/g", "acceleration", "output"),
        ("2.3 mV/N", "force", "input"),
        ("8 V/mm", "displacement", "output"),
    ],
)
def test_a_sensitivity_of_the_file_says_what_is_measured(sensitivity: str, quantity: str, role: str) -> None:
    (found,) = guess_channels(["ai0"], {"ai0": "V"}, {"ai0": sensitivity})
    assert (found.quantity, found.role, found.sensitivity, found.decisions) == (
        quantity,
        role,
        sensitivity,
        (),
    )
    (scaled,) = guess_channels(["ai0"], {"ai0": "m/s^2"}, {"ai0": sensitivity})
    assert scaled.sensitivity == "" and scaled.quantity == "acceleration"


def test_nodes_and_signs_of_points_become_dofs() -> None:
    names = ["1+Z", "12-Z", "3+X_2"]
    found = guess_channels(names, dict.fromkeys(names, "m/s^2"))
    assert [(channel.dof, channel.invert) for channel in found] == [
        ("1.z", False),
        ("12.z", True),
        ("3.x", False),
    ]


def test_copies_of_a_channel_are_named() -> None:
    """y again, y under an exponential and under a force window.

    A quarter of y and noise are channels of their own.
    """
    rng = np.random.default_rng(8)
    y = rng.normal(size=500)
    windows = [np.exp(-np.arange(500) / 80), np.arange(500) < 50, np.full(500, 0.25)]
    rows = np.column_stack([y, y, *(y * window for window in windows), rng.normal(size=500), np.zeros(500)])
    names = ["y", "again", "exponential", "cut", "quarter", "noise", "zero"]
    assert copies(names, rows) == {
        "again": "a copy of y",
        "exponential": "a windowed copy of y",
        "cut": "a windowed copy of y",
    }


@pytest.mark.parametrize(
    ("name", "quantity", "example"),
    [
        ("probe x", "displacement", "8 V/mm"),
        ("hammer", "force", "10 mV/N"),
        ("acc z", "acceleration", "10 mV/(m/s^2)"),
    ],
)
def test_volts_of_a_sensor_need_its_sensitivity(name: str, quantity: str, example: str) -> None:
    found = guess(name, "V")
    assert (found.quantity, found.unit, found.sensitivity) == (quantity, "V", DECIDE)
    assert found.decisions == (
        f"recorded volts per quantity, for example {example}",
        f"{quantity} is a guess from the name",
    )


def test_a_number_without_a_unit_needs_one() -> None:
    found = guess("force")
    assert (found.quantity, found.unit) == ("force", DECIDE)
    assert found.decisions == (
        "the unit of the recorded numbers, for example N",
        "force is a guess from the name",
    )


def test_what_nothing_is_known_of_is_left_to_a_person() -> None:
    found = guess("channel 7")
    assert (found.quantity, found.unit, found.role) == (DECIDE, DECIDE, "")
    assert len(found.decisions) == 2 and found.decisions[0].startswith(
        "what is measured: force, displacement"
    )


def test_what_says_everything_leaves_nothing_to_decide() -> None:
    assert guess("x", "um").decisions == ()


@pytest.mark.parametrize(
    ("name", "dof"),
    [
        ("probe x", "x"),
        ("probeY", "y"),
        ("z [um]", "z"),
        ("acc_x_2", "x"),
        ("1x", "x"),
        ("max", "max"),
        ("yaw", "yaw"),
        ("Force [N]", "force"),
    ],
)
def test_directions_are_words_or_last_letters(name: str, dof: str) -> None:
    assert guess(name, "um").dof == dof


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("Force [N]", "force"),
        ("probe-x (um)", "probe_x"),
        ("1", "ch_1"),
        ("  a  b ", "a_b"),
        ("[N]", "channel"),
        ("Ü1", "ü1"),
        ("Null [N]", "ch_null"),
        ("true", "ch_true"),
    ],
)
def test_keys_are_letters_digits_and_underscores(name: str, key: str) -> None:
    assert guess(name).key == key


@given(st.lists(st.text("ab 1[]N", min_size=1, max_size=5), min_size=1, max_size=6, unique=True))
def test_keys_are_unique_and_channels_as_many_as_columns(names: list[str]) -> None:
    channels = guess_channels(names, {})
    assert [channel.column for channel in channels] == names
    assert len({channel.key for channel in channels}) == len(names)
    assert all(channel.key[0].isalpha() for channel in channels)


def test_the_key_of_a_second_channel_is_that_of_the_first_with_a_number() -> None:
    """Keys begin with a letter."""
    channels = guess_channels(["1 [N]", "1 [um]", "1 [V]", "x", "x [um]"], {})
    assert [channel.key for channel in channels] == ["ch_1", "ch_1_2", "ch_1_3", "x", "x_2"]


def test_a_force_without_direction_acts_along_the_only_response() -> None:
    force, _ = guess_channels(["force", "probe y"], {"force": "N", "probe y": "um"})
    assert force.dof == "y"
    force, *_ = guess_channels(["force", "x", "y"], {"force": "N", "x": "um", "y": "um"})
    assert force.dof == "force"
    force, _ = guess_channels(["force x", "y"], {"force x": "N", "y": "um"})
    assert force.dof == "x"


# time axes


@given(st.floats(1e-6, 10), st.integers(3, 50))
def test_even_rising_steps_are_a_time_axis(step: float, n: int) -> None:
    t = np.arange(n) * step
    rows = np.column_stack([t, np.cos(np.arange(n)), -t, np.zeros(n)])
    assert time_columns(["t", "wave", "backwards", "still"], rows) == ["t"]


@pytest.mark.parametrize(("jitter", "is_time"), [(0.0, True), (5e-4, True), (5e-3, False)])
def test_steps_alike_to_a_thousandth_are_even(jitter: float, is_time: bool) -> None:
    steps = np.full(100, 0.01)
    steps[50] *= 1 + jitter
    assert time_columns(["t"], np.cumsum(steps)[:, None]) == (["t"] if is_time else [])


def test_a_preload_beside_the_force_of_a_shaker_drives_nothing(rng: np.random.Generator) -> None:
    """A force that rests at 200 N is a reference; alone it stays a force, whatever it is."""
    channels = guess_channels(["Force [N]", "Preload [N]"], {"Force [N]": "N", "Preload [N]": "N"}, {})
    rows = np.column_stack([30 * rng.normal(size=500), 200 + rng.normal(size=500)])
    assert [c.role for c in without_static_forces(channels, rows)] == ["input", "reference"]
    assert [c.role for c in without_static_forces(channels[1:], rows[:, 1:])] == ["input"]

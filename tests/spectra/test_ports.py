"""The layout of a common matrix from recordings with different forces."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.ports import find_layout, sensor_response

X, Y = (
    Channel("x", "displacement", "output", "x", 0.0),
    Channel("y", "displacement", "output", "y", np.pi / 2),
)
TACHO = Channel("tacho", "voltage", "reference", "tacho")


def run(name: str, *channels: Channel) -> Recording:
    return Recording(channels, np.zeros((4, len(channels))), 100.0, name)


def shaker(dof: str, name: str = "f", delay: float = 0.0) -> Channel:
    return Channel(name, "force", "input", dof, {"x": 0.0, "y": np.pi / 2}.get(dof), delay)


def test_two_runs_with_one_shaker_have_two_inputs_named_by_direction() -> None:
    layout = find_layout([run("a", shaker("x"), X, Y), run("b", X, shaker("y"), Y)])
    assert [port.label for port in layout.inputs] == ["x", "y"]
    assert layout.input_columns == ((0, -1), (-1, 1))
    assert layout.output_columns == ((1, 2), (0, 2))
    assert layout.form == "receptance"


def test_references_are_no_part_of_the_matrix() -> None:
    layout = find_layout([run("a", TACHO, shaker("x"), X)])
    assert layout.input_columns == ((1,),) and layout.output_columns == ((2,),)


def test_padding_puts_every_channel_in_its_place() -> None:
    layout = find_layout([run("a", shaker("x"), X, Y), run("b", X, shaker("y"), Y)])
    spectra = np.arange(9.0).reshape(1, 3, 3) + 0j
    padded = layout.pad(1, spectra, 2)[0]
    # Inputs x (absent) and y, then outputs x and y: columns 1, 0, 2 of the recording.
    assert np.all(padded[0] == 0) and np.all(padded[:, 0] == 0)
    np.testing.assert_array_equal(padded[1:, 1:], spectra[0][np.ix_([1, 0, 2], [1, 0, 2])])


def test_delays_turn_the_phase_by_their_difference() -> None:
    late = Channel("x", "displacement", "output", "x", 0.0, delay=3e-3)
    layout = find_layout([run("a", shaker("x", delay=1e-3), late)])
    np.testing.assert_allclose(
        layout.sensor_factor(np.array([25.0])),
        np.exp(2j * np.pi * 25 * 2e-3) * np.ones((1, 1, 1)),
        rtol=1e-12,
    )


def test_labels_stay_unique() -> None:
    layout = find_layout([run("a", shaker("x", "f"), shaker("x", "g"), X)])
    assert [port.label for port in layout.inputs] == ["f", "g"]
    layout = find_layout(
        [run("a", shaker("x", "f"), X), run("b", shaker("y", "f"), X), run("c", shaker("x", "g"), X)]
    )
    assert [port.label for port in layout.inputs] == ["f@x", "y", "g"]


def base(quantity: str) -> Channel:
    return Channel(f"base {quantity}", quantity, "input", "b")


@pytest.mark.parametrize(
    ("causes", "form"),
    [
        (("displacement",), "transmissibility"),
        (("acceleration",), "transmissibility"),
        (("displacement", "acceleration"), "other"),
        (("force",), "receptance"),
        (("force", "displacement"), "other"),
        (("voltage",), "other"),
    ],
)
def test_motion_over_the_motion_of_a_base_is_a_transmissibility(causes: tuple[str, ...], form: str) -> None:
    """As long as all inputs are one motion: a probe and an accelerometer on the base are no inputs of one
    matrix.
    """
    layout = find_layout([run("a", *(base(quantity) for quantity in causes), X)])
    assert layout.form == form
    # Displacement over acceleration is motion over motion after two integrations of the base's.
    assert layout.derivatives == (-2 if causes == ("acceleration",) else 0)


@pytest.mark.parametrize(
    ("quantity", "form"),
    [
        ("displacement", "receptance"),
        ("velocity", "mobility"),
        ("acceleration", "accelerance"),
        ("voltage", "other"),
    ],
)
def test_the_form_follows_the_quantities(quantity: str, form: str) -> None:
    assert find_layout([run("a", shaker("x"), Channel("r", quantity, "output", "x"))]).form == form
    drive = Channel("u", "voltage", "input", "x")
    assert find_layout([run("a", drive, Channel("r", quantity, "output", "x"))]).form == "other"


def test_what_gives_no_matrix_is_refused() -> None:
    with pytest.raises(DataError, match="'a' has no force"):
        find_layout([run("a", X)])
    with pytest.raises(DataError, match="'a' has no response"):
        find_layout([run("a", shaker("x"))])
    with pytest.raises(DataError, match=r"of several quantities .*a `dof` of its own"):
        find_layout([run("a", shaker("x"), X, Channel("v", "velocity", "output", "x"))])
    with pytest.raises(DataError, match="of several quantities"):
        find_layout([run("a", shaker("x"), X, Channel("s", "strain", "output", "y"))])
    with pytest.raises(DataError, match="of several quantities"):
        find_layout(
            [run("a", Channel("u", "voltage", "input", "x"), X, Channel("v", "velocity", "output", "y"))]
        )


def test_motions_of_several_quantities_are_turned_to_that_of_most() -> None:
    """Two probes and a velocity per force are receptances, v / (j w); beside an accelerometer on a base an
    acceleration is one already, and a displacement lacks two derivatives.
    """
    v, a = (Channel(name, name, "output", name) for name in ("velocity", "acceleration"))
    layout = find_layout([run("a", shaker("x"), v, X, Y)])
    assert (layout.form, layout.orders, layout.derivatives) == ("receptance", (1, 0, 0), 0)
    frequency = np.array([10.0, 20.0])
    expected = np.stack([1 / (2j * np.pi * frequency), np.ones(2), np.ones(2)], axis=1)
    np.testing.assert_allclose(layout.sensor_factor(frequency)[:, :, 0], expected, rtol=1e-14)
    layout = find_layout([run("a", base("acceleration"), a, X)])
    assert (layout.form, layout.orders) == ("transmissibility", (0, -2))
    # Per volt of a drive nothing is turned.
    layout = find_layout([run("a", Channel("u", "voltage", "input", "x"), a)])
    assert (layout.form, layout.orders) == ("other", (0,))


@pytest.mark.parametrize(
    ("phases", "between"),
    [((0.0, -200.0, -400.0), (-100.0, -300.0)), ((170.0, -170.0, -150.0), (180.0, -160.0)),
     ((350.0, 10.0, 30.0), (0.0, 20.0)), ((0.0, 270.0, 540.0), (135.0, 405.0))],
)  # fmt: skip
def test_a_phase_runs_straight_between_the_rows_of_a_table(
    phases: tuple[float, ...], between: tuple[float, ...]
) -> None:
    """Half way between two rows the phase is half way between theirs, also beyond half a turn, by hand."""
    rows = zip((10.0, 20.0, 30.0), (1.0, 1.0, 1.0), np.radians(phases), strict=True)
    sensor = Channel("x", "displacement", "output", "x", response=tuple(rows))
    found = sensor_response(sensor, np.array([15.0, 25.0]))
    np.testing.assert_allclose(found, np.exp(1j * np.radians(between)), atol=1e-12)

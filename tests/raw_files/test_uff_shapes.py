"""Mode shapes of universal files, laid out by hand as the definition of dataset 55 has them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.raw_files.uff import read_shapes_uff

HEAD = "    -1\n    55\n" + 5 * "NONE\n"
NODES = (7, 12)
POLE = complex(-2.0, 60.0)


def normal(frequency: float, ratio: float, shape: list[list[float]], kind: int = 2) -> str:
    """A record of real numbers at two nodes: a normal mode, or what *kind* says."""
    text = HEAD + f"{1:10d}{kind:10d}{2:10d}{8:10d}{2:10d}{3:10d}\n{2:10d}{4:10d}{1:10d}{1:10d}\n"
    text += "".join(f"{value:13.5e}" for value in (frequency, 1.0, ratio, 0.0)) + "\n"
    for node, motion in zip(NODES, shape, strict=True):
        text += f"{node:10d}\n" + "".join(f"{value:13.5e}" for value in motion) + "\n"
    return text + "    -1\n"


def complex_mode(pole: complex, shape: list[list[complex]]) -> str:
    text = HEAD + f"{1:10d}{3:10d}{2:10d}{8:10d}{5:10d}{3:10d}\n{2:10d}{6:10d}{0:10d}{1:10d}\n"
    text += "".join(f"{value:13.5e}" for value in (pole.real, pole.imag, 1.0, 0.0, 1.0, 0.0)) + "\n"
    for node, motion in zip(NODES, shape, strict=True):
        numbers = [part for value in motion for part in (value.real, value.imag)]
        text += f"{node:10d}\n" + "".join(f"{value:13.5e}" for value in numbers) + "\n"
    return text + "    -1\n"


FIRST, SECOND = [[0.0, 1.0, 0.0], [0.0, 0.5, 0.0]], [[0.0, -0.5, 0.0], [0.0, 1.0, 0.0]]
THIRD = [[0.0, 1j, 0.0], [0.0, 1.0, 0.0]]


def test_normal_and_complex_modes_are_read_with_their_poles(tmp_path: Path) -> None:
    """A static deflection between them is none; MAC by hand: 0 of the orthogonal pair, (1 + 0.25) / 2.5."""
    path = tmp_path / "shapes.uff"
    static = normal(0.0, 0.0, FIRST, kind=1)
    path.write_text(
        normal(30.0, 0.01, FIRST) + static + normal(50.0, 0.0, SECOND) + complex_mode(POLE, THIRD)
    )
    shapes = read_shapes_uff(path)
    assert shapes is not None and shapes.others == 1
    assert shapes.points == ("7.x", "7.y", "7.z", "12.x", "12.y", "12.z")
    np.testing.assert_allclose(shapes.frequency, [30.0, 50.0, abs(POLE) / (2 * np.pi)])
    np.testing.assert_allclose(shapes.damping_ratio, [0.01, 0.0, 2.0 / abs(POLE)])
    np.testing.assert_allclose(shapes.shapes[[1, 4], 2], [1j, 1.0])
    np.testing.assert_allclose(shapes.mac, [[1, 0, 0.5], [0, 1, 0.5], [0.5, 0.5, 1]], atol=1e-12)


def test_inspect_shows_shapes_and_a_recording_is_asked_for_in_one_sentence(tmp_path: Path, labpipe) -> None:
    path = tmp_path / "shapes.uff"
    path.write_text(normal(30.0, 0.01, FIRST) + normal(50.0, 0.0, SECOND))
    ended = labpipe("inspect", path)
    assert ended.code == 0 and "2 mode shape(s) at 6 points and directions" in ended.out
    assert "mode 1: 30 Hz, damping ratio 0.01, largest at 7.y, MAC 0.00 with mode 2" in ended.out
    ended = labpipe("init", tmp_path / "rig", path)
    assert ended.code == 2 and "holds 2 mode shape(s) in records 55, and no recording or FRF" in ended.err


@pytest.mark.parametrize(
    ("part", "instead"),
    [
        ("  1.00000e+00  0.00000e+00\n", "  1.00000e+00\n"),
        ("         7\n", ""),
        ("  5.00000e-01", "  5.00000x-01"),
        ("  5.00000e-01", "          nan"),
        ("         2         8         2         3", "         2         8         9         3"),
        ("    -1\n", ""),
    ],
)
def test_a_damaged_record_is_refused(tmp_path: Path, part: str, instead: str) -> None:
    path = tmp_path / "shapes.uff"
    head, text = "    -1\n", normal(30.0, 0.01, FIRST)[7:]
    assert part in text
    path.write_text(head + text.replace(part, instead))
    with pytest.raises(DataError):
        read_shapes_uff(path)

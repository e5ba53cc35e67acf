"""Paths in steps against the places they came from."""

from __future__ import annotations

import re

import numpy as np
import pytest

from labpipe.document.small_svg import smaller, smaller_path


def places(path: str) -> list[list[float]]:
    """The corners of a path of M and l, read as the SVG recommendation says: pairs, small letters from the last corner."""
    corners: list[list[float]] = []
    for letter, text in re.findall(r"([Ml])([^Mlz]*)", path):
        numbers = [float(number) for number in re.findall(r"-?(?:\d+\.?\d*|\.\d+)", text)]
        for x, y in zip(numbers[0::2], numbers[1::2], strict=True):
            corners.append([x, y] if letter == "M" else [corners[-1][0] + x, corners[-1][1] + y])
    return corners


@pytest.mark.parametrize(("number", "finest"), [(5, 0.01), (3000, 0.1)])
def test_no_corner_moves_by_more_than_half_of_the_finest_step(rng: np.random.Generator, number: int, finest: float) -> None:
    corners = np.cumsum(rng.normal(size=(number, 2)), axis=0) + np.array([100.0, -0.004])
    path = "M {}".format("\nL ".join(f"{x:.6f} {y:.6f}" for x, y in corners))
    small = smaller_path(path)
    np.testing.assert_allclose(places(small), corners, rtol=0, atol=finest / 2 + 1e-9)
    assert len(small) < 0.6 * len(path)


def test_a_path_of_several_parts_and_curves_is_kept() -> None:
    assert smaller_path("M 1.5 2 L 2.75 1 z M 0 0 L 0 -0.5") == "M1.5 2l1.25-1zM0 0l0-.5"
    assert smaller_path("M 0 -3 C 0.79 -3 1.55 -2.68 2.12 -2.12 z") == "M0-3c.79 0 1.55 .32 2.12 .88z"


def test_fonts_and_empty_space_go_and_places_are_rounded() -> None:
    style = "font-size: 9px; font-family: 'DejaVu Sans', sans-serif; text-anchor: end"
    text = f'<g>\n <text style="{style}" x="1.23456" y="2.5">a b</text>\n</g>'
    assert smaller(text) == '<g><text style="font-size: 9px; text-anchor: end" x="1.23" y="2.5">a b</text></g>'


def test_marks_in_a_row_share_their_style() -> None:
    marks = "".join(f'<use xlink:href="#m" x="{x}" y="2.50" style="fill: #0072b2"/>' for x in (1, 2, 3))
    plain = "".join(f'<use href="#0" x="{x}" y="2.5"/>' for x in (1, 2, 3))
    assert smaller(marks) == f'<g style="fill: #0072b2">{plain}</g>'
    other = marks + '<use xlink:href="#m" x="4" y="2.50" style="fill: #d55e00"/>'
    assert smaller(other) == other.replace("#m", "#0")


def test_only_what_something_refers_to_is_named() -> None:
    text = '<g id="axes_1"><defs><path id="m5f"/></defs><clipPath id="p9"/><use xlink:href="#m5f"/><path clip-path="url(#p9)"/></g>'
    short = '<g><defs><path id="0"/></defs><clipPath id="1"/><use xlink:href="#0"/><path clip-path="url(#1)"/></g>'
    assert smaller(text) == short

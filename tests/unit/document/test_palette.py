"""Colours by number and by value; letters that can be read on them."""

from __future__ import annotations

import matplotlib as mpl
import pytest
from matplotlib.colors import to_rgb

from labpipe.document.page_parts import page_part
from labpipe.document.palette import GREY_TONE, HEAT, PALETTE, heat, ink_on, tone
from labpipe.report.chart import GREY, INK, PALETTE_SIZE


def test_numbers_go_round_the_palette_and_grey_is_apart() -> None:
    assert (
        tone(0) == tone(PALETTE_SIZE) == PALETTE[0] and tone(INK) == "#000000" and tone(GREY) == GREY_TONE and len(PALETTE) == PALETTE_SIZE
    )


@pytest.mark.parametrize("colour", [*PALETTE, GREY_TONE])
def test_every_colour_reaches_3_to_1_against_white(colour: str) -> None:
    # Contrast of WCAG 2.1: (L1 + 0.05) / (L2 + 0.05) of relative luminances, from linear sRGB.
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in to_rgb(colour)]
    assert 1.05 / (0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2] + 0.05) >= 3
    assert colour.lower() in page_part("report.css") or colour == GREY_TONE


def test_the_scale_of_heat_maps_goes_from_end_to_end() -> None:
    assert (heat(-1.0), heat(0.0), heat(1.0)) == (HEAT[0], HEAT[5], HEAT[-1])
    assert heat(-7.0) == HEAT[0] and heat(7.0) == HEAT[-1] and heat(float("nan")) == "#ffffff"


@pytest.mark.parametrize("value", [-0.97, -0.4, -0.05, 0.13, 0.5, 0.88])
def test_between_its_steps_it_is_that_of_colorbrewer(value: float) -> None:
    expected = mpl.colormaps["PuOr"]((value + 1) / 2)[:3]
    # The reference has 256 steps: half of one is up to 0.012 of a channel where the scale is steepest.
    assert to_rgb(heat(value)) == pytest.approx(expected, abs=0.012)


def test_letters_are_white_on_dark_and_black_on_light() -> None:
    assert (ink_on("#2d004b"), ink_on("#f7f7f7"), ink_on("#818181"), ink_on("#7f7f7f")) == ("#ffffff", "#000000", "#000000", "#ffffff")

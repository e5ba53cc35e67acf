"""Lines of a band, written out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.spectra.bands import line_range, lines_in, mask_findings

FREQUENCY = np.arange(1, 11) * 0.1


def test_edges_belong_to_the_band_whatever_rounding_does() -> None:
    # 3 x 0.1 is 0.30000000000000004 in floating point.
    assert np.flatnonzero(lines_in(FREQUENCY, (0.3, 0.7))).tolist() == [2, 3, 4, 5, 6]


def test_gaps_are_left_out_with_their_edges() -> None:
    chosen = lines_in(FREQUENCY, (0.2, 0.9), ((0.3, 0.4), (0.8, 5.0)))
    assert (np.flatnonzero(chosen) + 1).tolist() == [2, 5, 6, 7]
    assert lines_in(FREQUENCY, None).all()


@pytest.mark.parametrize(
    ("band", "first", "last"),
    [(None, 1, 50), ((10.0, 20.0), 10, 20), ((0.0, 3.0), 1, 3), ((49.5, 99.0), 50, 50)],
)
def test_line_range_leaves_the_mean_value_out(
    band: tuple[float, float] | None, first: int, last: int
) -> None:
    lines = line_range(100, 100.0, band)
    assert (lines.start, lines.stop - 1) == (first, last)


def test_the_note_on_masked_lines_names_those_of_the_band() -> None:
    bands = [(49.0, 51.0), (99.0, 101.0), (149.0, 151.0)]
    (some,), (none,) = mask_findings(bands, (60.0, 100.0)), mask_findings(bands, (60.0, 90.0))
    assert some.message == "lines of the shaft speed are left out: 99-101 Hz"
    assert none.message == "the band has no line of the shaft"
    assert mask_findings(bands, None)[0].message.count("Hz") == 3 and mask_findings([], None) == ()


def test_an_odd_number_of_samples_has_no_line_at_half_the_rate() -> None:
    assert line_range(101, 101.0, None).stop - 1 == 50


def test_a_band_without_lines_is_refused() -> None:
    with pytest.raises(DataError, match=r"no line lies in the band.*every 1 Hz up to 50 Hz"):
        line_range(100, 100.0, (10.2, 10.8))

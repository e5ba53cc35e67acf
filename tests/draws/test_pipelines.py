"""A fixed part of the draws of shipped pipelines; `python -m tests.draws.run` draws all of them for as long as you like."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.draws.pipelines import draw_pipeline
from tests.draws.tally import Row

PIPELINES = Path(__file__).parent.parent.parent / "pipelines"


def rows_of(name: str, draws: int, cases: int) -> list[Row]:
    tally = draw_pipeline(PIPELINES / f"{name}.yaml", draws, 600.0, cases, 1)
    assert tally is not None and not tally.failed
    return list(tally.rows())


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "draws", "cases"),
    [("budget", 200, 1), ("radial-two-directions", 200, 1), ("floating-bearing", 120, 1), ("levitated-magnet", 200, 1)],
)
@pytest.mark.filterwarnings("ignore")
def test_combined_uncertainties_are_those_of_drawn_worlds(name: str, draws: int, cases: int) -> None:
    """Scatter within 5 % of the combined uncertainty and 93-97 % of the intervals hold, beside three deviations of so many draws.

    A mass within limits, as the pedestal's, is no normal input: its interval holds more often.
    """
    rows = rows_of(name, draws, cases)
    bounded = ("pedestal.k",)
    bad = [row for row in rows if not (row.is_good or (row.name in bounded and abs(row.ratio - 1) < 0.05 + row.chance and row.held > 0.95))]
    assert not bad
    # Noise alone would not do.
    assert np.mean([row.by_noise for row in rows]) < 0.8


@pytest.mark.long
@pytest.mark.parametrize(("name", "draws"), [("preload-calibration", 300), ("magnetic-sensitivity", 150), ("repeatability", 20)])
@pytest.mark.filterwarnings("ignore")
def test_results_beside_fits_scatter_as_they_say(name: str, draws: int) -> None:
    """Lines of calibrations, unknowns of a loop, and what repeats of a test give, within three deviations of so many draws."""
    rows = rows_of(name, draws, 1)
    assert rows
    assert not [row for row in rows if not row.is_good]

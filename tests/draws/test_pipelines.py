"""A fixed part of the draws of shipped pipelines.

`python -m tests.draws.run` draws all of them for as long as you like.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.draws.pipelines import draw_pipeline
from tests.draws.tally import Row

ROOT = Path(__file__).parent.parent.parent
PIPELINES = ROOT / "pipelines"


def rows_of(name: str, draws: int, cases: int) -> list[Row]:
    tally = draw_pipeline(PIPELINES / f"{name}.yaml", draws, 600.0, cases, 1)
    assert tally is not None and not tally.failed
    return list(tally.rows())


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "draws", "cases"),
    [
        ("budget", 60, 1),
        ("radial-two-directions", 60, 1),
        ("floating-bearing", 60, 1),
        ("levitated-magnet", 60, 1),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_combined_uncertainties_are_those_of_drawn_worlds(name: str, draws: int, cases: int) -> None:
    """Scatter within 5 % of the combined uncertainty and 93-97 % of the intervals hold, beside three
    deviations of so many draws: 80 % are seen in 86 of 100.

    A mass within limits, as the pedestal's, is no normal input: its interval holds more often.
    """
    rows = rows_of(name, draws, cases)
    bounded = ("pedestal.k",)
    bad = [
        row
        for row in rows
        if not (
            row.is_good
            or (row.name in bounded and abs(row.ratio - 1) < 0.05 + row.chance and row.held > 0.95)
        )
    ]
    assert not bad
    # Noise alone would not do.
    assert np.mean([row.by_noise for row in rows]) < 0.8


@pytest.mark.long
@pytest.mark.parametrize(("name", "draws"), [("preload-calibration", 100), ("repeatability", 20)])
@pytest.mark.filterwarnings("ignore")
def test_results_beside_fits_scatter_as_they_say(name: str, draws: int) -> None:
    """Lines of calibrations, and what repeats give, within three deviations of so many draws."""
    rows = rows_of(name, draws, 1)
    assert rows
    assert not [row for row in rows if not row.is_good]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_a_sensitivity_scatters_with_its_channels(tmp_path: Path) -> None:
    """Peak, its frequency and three unknowns of a loop whose channels are drawn, within three deviations of
    so many draws.

    Gains of 0.2 %, for which first order holds; with those of usual size, 1 %, the bandwidth is known to a
    third only.
    """
    rig = (ROOT / "configs/hmb-injection.yaml").read_text()
    for name, uncertainty in (
        ("before", "uncertainty: {gain: 0.2 %}, delay: 0 s +- 1 us"),
        ("after", "uncertainty: {gain: 0.2 %, phase: 0.1 deg}"),
    ):
        line = f'{name}: {{column: "{name} [uV]", quantity: voltage, unit: uV, role: output'
        assert line in rig
        rig = rig.replace(line, f"{line}, {uncertainty}")
    (tmp_path / "rig.yaml").write_text(rig)
    pipeline = (PIPELINES / "magnetic-sensitivity.yaml").read_text()
    pipeline = pipeline.replace("../configs/hmb-injection.yaml", "rig.yaml").replace("../", f"{ROOT}/")
    (tmp_path / "pipeline.yaml").write_text(pipeline)
    tally = draw_pipeline(tmp_path / "pipeline.yaml", 60, 600.0, 1, 1)
    assert tally is not None and not tally.failed
    rows = list(tally.rows())
    assert {"unknowns.gap", "unknowns.delay", "unknowns.bandwidth", "sensitivity.peak"} <= {
        row.name for row in rows
    }
    # Where the highest of several lines lies is not a normal number: its interval holds, its scatter is
    # smaller than its standard uncertainty says.
    (place,) = (row for row in rows if row.name == "sensitivity.peak_frequency")
    assert place.held >= 0.88 and place.ratio < 1.1
    assert not [row for row in rows if row is not place and not row.is_good]
    # The loop tells its gains and delays better than they are stated: beside them noise alone is left.
    told = [row for row in rows if row.name.split(".")[1] in ("gap", "delay", "bandwidth")]
    assert np.mean([row.by_noise for row in told]) > 0.9
    assert {"unknowns.gap", "unknowns.delay", "unknowns.bandwidth"} == {row.name for row in told}

"""The virtual mass on a shaking table: its runs, what is refused, and the shipped recordings against their
recipe.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from labpipe.errors import ConfigError
from labpipe.simulate.linear import BASE_RUNS, BaseNoise, BaseRig
from labpipe.simulate.virtual_rigs import recordings

QUIET = BaseRig(
    "virtual-base-rig", 2.0, 126.33e3, 20.106, noise=BaseNoise(base=0.0, acceleration=0.0, displacement=0.0)
)


def test_what_is_measured_of_the_mass_belongs_together() -> None:
    """Of one noise: acceleration of the mass = that of the table + second derivative of the gap, line by
    line.
    """
    rig = replace(QUIET, duration=4.0, pause=1.0)
    absolute, relative = recordings(rig, 1, ["absolute", "relative"])
    spectra = [np.fft.rfft(run.samples, axis=0) for run in (absolute, relative)]
    frequency = np.fft.rfftfreq(absolute.n_sample, 1 / rig.sample_rate)
    inside = (frequency >= 10) & (frequency <= 100)
    ratio, gap = (spectrum[inside, 1] / spectrum[inside, 0] for spectrum in spectra)
    np.testing.assert_allclose(ratio, 1 - (2 * np.pi * frequency[inside]) ** 2 * gap, rtol=1e-6)
    assert (
        absolute.samples[:, 0].std() == pytest.approx(5.0) and np.max(np.abs(spectra[0][~inside, 0])) < 1e-8
    )
    assert rig.truth["f_n"] == pytest.approx(40.0, rel=1e-5) and rig.truth["zeta"] == pytest.approx(
        0.02, rel=1e-4
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stiffness": 0.0}, "stiffness must be positive"),
        ({"pause": 40.0}, "pause must lie between"),
        ({"band": (0.0, 9.0)}, "between 0.03125 Hz, a period in a run, and 256 Hz"),
    ],
)
def test_impossible_rigs_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(QUIET, **change)


def test_a_band_between_two_lines_of_a_run_is_refused() -> None:
    """Lines of a run of 2 s are 0.5 Hz apart, so there is none from 20.1 to 20.4 Hz."""
    with pytest.raises(ConfigError, match=r"no line of a run of 2 s lies in 20\.1-20\.4 Hz"):
        recordings(replace(QUIET, duration=2.0, pause=0.0, band=(20.1, 20.4)), 1, ["absolute"])


def test_the_shipped_recordings_are_made_by_their_recipe(root: Path, tmp_path: Path, labpipe) -> None:
    assert labpipe("simulate", "configs/virtual-base.yaml", "-o", tmp_path, "--seed", "1").code == 0
    shipped = root / "sample_data/base"
    assert (tmp_path / "truth.json").read_bytes() == (shipped / "truth.json").read_bytes()
    for name in BASE_RUNS:
        made, kept = (pq.read_table(folder / f"{name}.parquet").to_pandas() for folder in (tmp_path, shipped))
        # A rounding of the last bit may move a value by one step of the logger.
        assert np.max(np.abs(made.to_numpy() - kept.to_numpy())) <= 100

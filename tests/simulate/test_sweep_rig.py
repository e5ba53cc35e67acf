"""The virtual mass under swept sines, against its equation of motion, and the shipped recordings against
their recipe.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy import signal

from labpipe.errors import ConfigError
from labpipe.raw_files.excitation import Sweep
from labpipe.simulate.linear import PRETRIGGER, SWEEP_RUNS, SweepRig, response
from labpipe.simulate.virtual_rigs import recordings

RIG = SweepRig("virtual-sweep-rig", 2.0, 126.33e3, 10.053)


def test_the_motion_is_that_of_the_equation() -> None:
    """m y'' + c y' + k y = f by scipy.signal.lsim, 20 points per sample, with straight lines between them."""
    sweep, fine = Sweep((20.0, 80.0), 3.0, 5.0), 20
    dense = sweep.samples(fine * RIG.sample_rate, 1)
    solved = signal.lsim(
        ([1.0], [RIG.mass, RIG.damping, RIG.stiffness]),
        dense,
        np.arange(dense.size) / (fine * RIG.sample_rate),
    )[1]
    force = sweep.samples(RIG.sample_rate, 1)
    length, lines = RIG.from_rest(force.size)
    moved = response(RIG.receptance(lines), force, length)
    assert np.max(np.abs(moved - solved[::fine])) < 5e-3 * np.max(np.abs(moved))


def test_runs_have_their_sweeps() -> None:
    linear, several = recordings(replace(RIG, noise=0.0, force_noise=0.0), 1)
    before = round(PRETRIGGER * RIG.sample_rate)
    assert linear.n_sample == before + (27 * 512) and several.n_sample == before + 4 * (15 * 512)
    assert np.all(several.samples[:before, 0] == 0) and np.std(
        linear.samples[before + 512 : before + 23 * 512, 0]
    ) == pytest.approx(5, rel=0.01)
    assert RIG.truth["zeta"] == pytest.approx(0.01, rel=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": 0.0}, "mass must be positive"),
        ({"pause": -1.0}, "pause must not be negative"),
        ({"band": (20.0, 300.0)}, "and 256 Hz"),
    ],
)
def test_impossible_rigs_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(RIG, **change)


def test_the_shipped_recordings_are_made_by_their_recipe(root: Path, tmp_path: Path, labpipe) -> None:
    assert labpipe("simulate", "configs/virtual-sweep.yaml", "-o", tmp_path, "--seed", "1").code == 0
    shipped = root / "sample_data/sweep"
    assert (tmp_path / "truth.json").read_bytes() == (shipped / "truth.json").read_bytes()
    for name in SWEEP_RUNS:
        made, kept = (pq.read_table(folder / f"{name}.parquet").to_pandas() for folder in (tmp_path, shipped))
        # A rounding of the last bit may move a value by one step of the logger.
        assert np.max(np.abs(made.to_numpy() - kept.to_numpy())) <= 100

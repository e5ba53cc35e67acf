"""The virtual mass that is struck, against its equation of motion, and the shipped recordings against their
recipe.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.ring_down.virtual_rig import PRETRIGGER, RUNS, DecayRig, decay_runs, motion, truth
from labpipe.project.simulate import load_virtual_rig

CONFIG = Path(__file__).parents[3] / "configs/virtual-decay.yaml"
RIG = DecayRig("virtual-decay-rig", (40.0, 41.6), (0.005, 0.006))


def test_a_mode_obeys_its_equation() -> None:
    """y'' + 2 zeta w y' + w^2 y = 0 by central differences of 1e-5 s; from rest, as a push gives."""
    t = np.arange(2000) * 1e-5
    y, w = motion(RIG, "struck", t, 1.0), 2 * np.pi * 40
    second, first = (y[2:] - 2 * y[1:-1] + y[:-2]) / 1e-10, (y[2:] - y[:-2]) / 2e-5
    np.testing.assert_allclose(second + 2 * 0.005 * w * first + w**2 * y[1:-1], 0, atol=1e-3 * w**2)
    assert y[0] == 0.0


def test_the_joint_damps_by_its_amplitude() -> None:
    """Its peaks at 100 % and 80 % differ by the law: local damping ratio zeta + joint A, from peak to
    peak.
    """
    t = np.arange(40960) / 10240
    peaks = motion(RIG, "joint", t, 1.0)[64::256]
    middle = (np.log(peaks[:-1] / peaks[1:]) / (2 * np.pi))[:40]
    np.testing.assert_allclose(middle, 0.005 + 0.003 * np.sqrt(peaks[:-1] * peaks[1:])[:40], rtol=2e-3)


def test_hits_come_at_their_times_with_their_strength() -> None:
    (run,) = decay_runs(replace(RIG, noise=0.0, offset=0.0), 1, ["struck"])
    first = round(PRETRIGGER * 1024)
    peaks = [np.max(run.samples[first + n * 4096 : first + n * 4096 + 40]) for n in range(3)]
    np.testing.assert_allclose(peaks, 1e-4 * 0.8 ** np.arange(3) * peaks[0] / 1e-4, rtol=1e-9)
    assert np.all(run.samples[:first] == 0) and run.samples.size == first + 3 * 4096


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"damping_ratios": (0.01,)}, "one value for every frequency"),
        ({"frequencies": (40.0, 600.0)}, "between 0.25 Hz, a period after a hit, and 512 Hz"),
        ({"damping_ratios": (0.01, 1.0)}, "damping_ratios must be at least 0 and below 100 %"),
        ({"hits": 0}, "hits must be positive"),
        ({"noise": -1e-6}, "noise must not be negative"),
        ({"interval": 1e-4}, "'interval' is shorter than two samples"),
    ],
)
def test_impossible_rigs_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(RIG, **change)


def test_the_shipped_recordings_are_made_by_their_recipe(root: Path, tmp_path: Path, labpipe) -> None:
    assert labpipe("simulate", CONFIG, "-o", tmp_path, "--seed", 1).code == 0
    shipped = root / "sample_data/decay"
    for name in RUNS:
        made, kept = (
            np.array(pq.read_table(folder / f"{name}.parquet")["y [nm]"]) for folder in (tmp_path, shipped)
        )
        # A sine of another machine may round to the next step of 10 nm.
        assert np.max(np.abs(made - kept)) <= 10 and np.mean(made != kept) < 1e-3
    told = json.loads((shipped / "truth.json").read_text())["truth"]
    assert told == {name: truth(load_virtual_rig(CONFIG), [name]) for name in RUNS}
    assert told["struck"]["k"] == pytest.approx(2 * (80 * np.pi) ** 2) and told["joint"][
        "zeta_slope_1"
    ] == pytest.approx(30)
    assert sum(path.stat().st_size for path in shipped.iterdir()) < 1.2e5

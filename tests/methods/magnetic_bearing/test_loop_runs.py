"""Recordings of the rig closed in time: they hold the loop's signals, and what they show is the loop's
prediction.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.loop import ControlLoop, controller, dynamic_stiffness
from labpipe.methods.magnetic_bearing.virtual_mechanics import LevitationNoise
from labpipe.methods.magnetic_bearing.virtual_rig import LOOP_RUNS, RUNS, run_names, simulate
from labpipe.project.simulate import load_virtual_rig

ROOT = Path(__file__).parents[3]
RIG = load_virtual_rig(ROOT / "configs/virtual-hmb-loop.yaml")
QUIET = replace(RIG, noise=LevitationNoise(0.0, 0.0, 0.0))


def lines(samples: np.ndarray) -> np.ndarray:
    """Lines 1-250 Hz of the last period but the end's margin, by channel."""
    return np.fft.rfft(samples[-2000:], axis=0)[1:251].T


@pytest.fixture(scope="module")
def quiet() -> np.ndarray:
    (run,) = simulate(QUIET, 1, ["loop-0rpm"])
    assert [channel.name for channel in run.recording.channels] == ["f", "x", "y", "ix", "ux", "iy", "uy"]
    return run.recording.samples


def test_motion_is_that_of_the_frequency_domain_twin(quiet: np.ndarray) -> None:
    """The logger's filter acts on the motion alone, so ratios of recorded loop signals are compared, and
    motion below 200 Hz.
    """
    force, x, y, *_ = lines(quiet)
    (twin,) = simulate(QUIET, 1, ["radial-0rpm"])
    twin_force, twin_x, _ = lines(twin.recording.samples)
    np.testing.assert_allclose((x / force)[:200], (twin_x / twin_force)[:200], rtol=2e-3)
    np.testing.assert_allclose(x, y, rtol=1e-6)


def test_current_is_what_the_controller_makes_of_the_motion(quiet: np.ndarray) -> None:
    _, x, _, current, output, *_ = lines(quiet)
    omega = 2 * np.pi * np.arange(1.0, 251.0)
    loop = RIG.levitation.loop
    np.testing.assert_allclose(current / x, loop.sensor * loop.amplifier * controller(loop, omega), rtol=2e-3)
    before_delay = np.exp(1j * omega * loop.delay) * (1 + 1j * omega * loop.corners[0])
    np.testing.assert_allclose(output / x, loop.sensor * controller(loop, omega) * before_delay, rtol=2e-3)


def test_the_force_of_the_bearing_follows_from_current_and_motion(quiet: np.ndarray) -> None:
    """k_i i - k_n x = (K_eq + j w C_eq) x of each bearing: what a rig with current probes measures
    directly.
    """
    _, x, _, current, *_ = lines(quiet)
    run = simulate(QUIET, 1, ["loop-0rpm"])[0].truth
    omega = 2 * np.pi * np.arange(1.0, 251.0)
    force = 5.8 * current - run["negative_stiffness_per_bearing"] * x
    stated = np.array(run["k_per_bearing"]) + 1j * omega * np.array(run["c_per_bearing"])
    np.testing.assert_allclose(force / x, stated, rtol=1e-2)


def test_gains_change_the_controller_and_not_the_bias_field() -> None:
    for name, gain in (("gain-1.0", 1.0), ("gain-1.2", 1.2)):
        (run,) = simulate(QUIET, 1, [name])
        assert run.truth["negative_stiffness_per_bearing"] == pytest.approx(5.8 * 8000 * 0.75 - 1694)
        loop = replace(RIG.levitation.loop, proportional=gain)
        expected = dynamic_stiffness(
            loop, run.truth["negative_stiffness_per_bearing"], 2 * np.pi * np.arange(1.0, 251.0)
        )
        np.testing.assert_allclose(run.truth["k_per_bearing"], expected.real)
        force, x, _ = lines(run.recording.samples)
        total = np.cos(np.pi / 4) * (force / x)[:100]
        omega = 2 * np.pi * np.arange(1.0, 101.0)
        np.testing.assert_allclose(
            total, 134.5e3 + 3.682j * omega - 0.92 * omega**2 + 2 * expected[:100], rtol=2e-3, atol=100
        )


def test_injection_is_the_difference_of_both_sides_of_the_sum() -> None:
    (run,) = simulate(QUIET, 1, ["loop-injection"])
    added, before, after = run.recording.samples[2500:12500].T
    assert np.std(added) == pytest.approx(0.05, rel=0.02)
    np.testing.assert_allclose(after - before, added, atol=1e-3)


@pytest.mark.long
def test_a_run_up_shows_the_unbalance_of_both_ends() -> None:
    (run,) = simulate(QUIET, 1, ["run-up"])
    names = [channel.name for channel in run.recording.channels]
    assert names == ["front.x", "front.y", "rear.x", "rear.y", "z", "n"]
    # At 8000 rpm: m e w^2 / (K_eq + j w C_eq - m w^2), the rotor alone.
    omega = np.array([2 * np.pi * 8000 / 60])
    motion = (
        15e-6
        * 0.065
        * omega**2
        / np.abs(dynamic_stiffness(RIG.levitation.loop, 33106.0, omega) - 0.065 * omega**2)
    )
    last = run.recording.samples[-200:]
    assert np.ptp(last[:, 0]) / 2 == pytest.approx(motion[0], rel=0.05)
    assert np.ptp(last[:, 2]) / np.ptp(last[:, 0]) == pytest.approx(0.6, rel=0.05)


def test_the_same_seed_gives_the_same_samples_whatever_else_is_made() -> None:
    (alone,) = simulate(RIG, 3, ["loop-injection"])
    again = simulate(RIG, 3, ["run-up", "loop-injection"])[1]
    np.testing.assert_array_equal(alone.recording.samples, again.recording.samples)


def test_a_loop_of_blocks_has_no_gain_to_vary() -> None:
    loop = ControlLoop(controller=[{"form": "gain", "gain": 1.0}])
    names = run_names(replace(RIG, levitation=replace(RIG.levitation, loop=loop)))
    assert "loop-0rpm" in names and "gain-1.1" not in names and "gain-1.1" in run_names(RIG)


def test_a_rig_without_a_loop_has_no_such_runs() -> None:
    open_rig = load_virtual_rig(ROOT / "configs/virtual-hmb.yaml")
    with pytest.raises(ConfigError, match="no run 'loop-0rpm'"):
        simulate(open_rig, 1, ["loop-0rpm"])
    assert not set(LOOP_RUNS) & set(RUNS)


def test_shipped_recordings_are_what_the_command_makes(root: Path, tmp_path: Path, labpipe) -> None:
    rig = root / "configs/virtual-hmb-loop.yaml"
    assert labpipe("simulate", rig, "--seed", "1", "--run", "gain-1.1", "-o", tmp_path).code == 0
    # Not byte by byte: every version of pyarrow writes its own name into the file.
    made, shipped = (
        pq.read_table(folder / "gain-1.1.parquet") for folder in (tmp_path, root / "sample_data/hmb-loop")
    )
    assert made.equals(shipped, check_metadata=True)
    assert sum(path.stat().st_size for path in (root / "sample_data/hmb-loop").iterdir()) < 800_000


def test_an_unstable_loop_leaves_no_recording(root: Path, tmp_path: Path, labpipe) -> None:
    """The printed sign of the lag: the rotor alone is unstable, on the pedestal's springs it is not."""
    rig = root / "configs/virtual-hmb-loop.yaml"
    unstable = ("simulate", rig, "--set", "levitation.loop.lag=0.25", "-o", tmp_path / "out", "--run")
    ended = labpipe(*unstable, "loop-injection")
    assert ended.code == 2 and "the loop is unstable" in ended.err and not (tmp_path / "out").exists(), ended
    assert labpipe(*unstable, "gain-1.0").code == 0

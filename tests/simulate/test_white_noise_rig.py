"""The virtual rotor under white noise against its equation of motion, and the shipped recordings against
their recipe.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from labpipe.errors import ConfigError
from labpipe.project.simulate import load_virtual_rig
from labpipe.simulate.linear import SHAKEN_RUNS, SensorNoise, WhiteNoiseRig
from labpipe.simulate.virtual_rigs import recordings

K, C, MASS = np.array([[620e3, 30e3], [-20e3, 690e3]]), np.array([[190.0, 15.0], [15.0, 160.0]]), 2.4
RIG = WhiteNoiseRig("virtual-white-noise-rig", tuple(map(tuple, K)), tuple(map(tuple, C)), MASS, blocks=4)
SILENT = replace(RIG, noise=SensorNoise(0.0, 0.0))


def derivative(motion: np.ndarray, order: int) -> np.ndarray:
    """d^n/dt^n of a motion that is periodic in the record, line by line."""
    omega = 2 * np.pi * np.fft.rfftfreq(motion.shape[0], 1 / 1024)[:, None]
    return np.fft.irfft((1j * omega) ** order * np.fft.rfft(motion, axis=0), motion.shape[0], axis=0)


@pytest.mark.parametrize("name", list(SHAKEN_RUNS))
def test_the_motion_obeys_its_equation(name: str) -> None:
    (run,) = recordings(SILENT, 1, [name])
    force, motion = run.samples[:, 0], run.samples[:, 1:]
    # What K q + C q' + m q'' leaves beside the shaker is the unbalance, u W^2 = 5.43 N turning from x to y at
    # 50 Hz.
    total = motion @ K.T + derivative(motion, 1) @ C.T + MASS * derivative(motion, 2)
    total[:, "xy".index(SHAKEN_RUNS[name])] -= force
    turning = total[:, 0] + 1j * total[:, 1]
    np.testing.assert_allclose(np.abs(turning), 5.5e-5 * (100 * np.pi) ** 2, rtol=1e-6)
    turn = turning[1:] / turning[:-1]
    np.testing.assert_allclose(np.angle(turn), 2 * np.pi * 50 / 1024, rtol=1e-6)


def test_the_force_is_white_up_to_its_bandwidth() -> None:
    (run,) = recordings(SILENT, 1, ["along-x"])
    force = run.samples[:, 0]
    assert np.sqrt(np.mean(force**2)) == pytest.approx(30.0, rel=1e-12)
    power = np.abs(np.fft.rfft(force)) ** 2
    frequency = np.fft.rfftfreq(force.size, 1 / 1024)
    assert np.max(power[frequency > 400]) < 1e-20 * np.mean(power)
    # 4000 lines per half, each power exponential: the halves agree within 1 / sqrt(2000) x 3.
    low, high = (np.mean(power[(frequency > a) & (frequency <= a + 200)]) for a in (0, 200))
    assert low / high == pytest.approx(1, abs=0.07)


def test_noise_has_the_level_asked_for_and_runs_their_own() -> None:
    noise = [a.samples - b.samples for a, b in zip(recordings(RIG, 1), recordings(SILENT, 1), strict=True)]
    for one in noise:
        np.testing.assert_allclose(np.std(one, axis=0), [0.05, 5e-6, 5e-6], rtol=0.03)
    assert abs(np.corrcoef(noise[0][:, 0], noise[1][:, 0])[0, 1]) < 0.03


def test_the_support_is_stable_and_bends_near_82_hz() -> None:
    state = np.block([[np.zeros((2, 2)), np.eye(2)], [-K / MASS, -C / MASS]])
    roots = np.linalg.eigvals(state)
    assert np.all(roots.real < 0)
    assert np.all((abs(roots) / (2 * np.pi) > 80) & (abs(roots) / (2 * np.pi) < 86))
    peak = np.argmax(abs(RIG.receptance(np.arange(60.0, 100.0))[:, 0, 0]))
    assert peak + 60 == 81


def test_the_same_seed_gives_the_same_samples_whatever_else_is_made() -> None:
    (alone,), both = recordings(RIG, 7, ["along-y"]), recordings(RIG, 7)
    np.testing.assert_array_equal(alone.samples, both[1].samples)
    assert not np.array_equal(both[1].samples, recordings(RIG, 8)[1].samples)
    assert [(run.n_sample, run.channels[0].dof) for run in both] == [(20480, "x"), (20480, "y")]


def test_faults_are_named(root: Path) -> None:
    with pytest.raises(ConfigError, match="no run 'along-z'"):
        recordings(RIG, 1, ["along-z"])
    for change, message in (
        ({"stiffness": ((1.0,),)}, "stiffness is not a 2 x 2 matrix"),
        ({"mass": 0.0}, "mass must be positive"),
        ({"speed": 600.0}, "speed must lie below half the sampling rate, 512 Hz"),
    ):
        with pytest.raises(ConfigError, match=message):
            replace(RIG, **change)
    file = root / "configs/virtual-white-noise.yaml"
    assert load_virtual_rig(file, ["blocks=100"]).n_sample == 512000
    with pytest.raises(ConfigError, match="must be positive"):
        load_virtual_rig(file, ["blocks=0"])


def test_the_shipped_recordings_are_made_by_their_recipe(root: Path, tmp_path: Path, labpipe) -> None:
    assert (
        labpipe("simulate", root / "configs/virtual-white-noise.yaml", "-o", tmp_path, "--seed", 1).code == 0
    )
    shipped = root / "sample_data/white-noise"
    for name in ("along-x", "along-y"):
        made, kept = (pq.read_table(folder / f"{name}.parquet") for folder in (tmp_path, shipped))
        assert made.column_names == kept.column_names == ["force [N]", "x [um]", "y [um]"]
        for column in kept.column_names:
            # FFTs of another machine may round otherwise in the last digit of 32 bits.
            np.testing.assert_allclose(made[column], kept[column], rtol=1e-5, atol=1e-4)
    told = json.loads((shipped / "truth.json").read_text())["truth"]
    rig = load_virtual_rig(root / "configs/virtual-white-noise.yaml")
    assert told == rig.truth and told["k_yx"] == -20e3
    assert sum(path.stat().st_size for path in shipped.iterdir()) < 1.5e6

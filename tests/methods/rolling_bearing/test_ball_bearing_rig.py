"""The virtual ball-bearing rig: its samples against an independent solution line by line, its truth, its
scatter, its files.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.rolling_bearing.settings import Loads
from labpipe.methods.rolling_bearing.virtual_rig import (
    RigNoise,
    Sampling,
    VirtualBallBearingRig,
    run_names,
    shaker_tests,
    simulate_ball_bearing,
    true_preload,
)
from labpipe.project.simulate import load_virtual_rig

QUIET = RigNoise(0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def rig() -> VirtualBallBearingRig:
    return load_virtual_rig(Path(__file__).parents[3] / "configs/virtual-ball-bearing.yaml")


def test_the_stiffness_is_the_printed_one_times_the_ratio(rig) -> None:
    """Knaapen (1997), appendix A: NSK 6208 at 427 N, K_xx .2125e9, K_zz .1654e8.

    RPF 7208 at 445 N, K_zz .9993e8 (printed digits).
    """
    quiet = replace(rig, noise=QUIET)
    first, second = simulate_ball_bearing(quiet, 1, ["6208-427N-up-z", "7208-445N-up-z"])
    k = np.array(first.truth["stiffness"])
    assert k[0, 0] == pytest.approx(1.12 * 0.2125e9, rel=5e-4)
    assert k[2, 2] == pytest.approx(1.12 * 0.1654e8, rel=5e-4)
    assert np.array(second.truth["stiffness"])[2, 2] == pytest.approx(1.12 * 0.9993e8, rel=1e-3)


@pytest.mark.parametrize(("force", "row"), [("x", 0), ("z", 2), ("by", 4)])
def test_the_samples_are_the_steady_state_of_the_shaft(rig, force: str, row: int) -> None:
    """Accelerance of the recording's spectra against -w^2 (Z)^-1 with the bearing's and the shaft's
    compliances added literally.
    """
    quiet = replace(rig, noise=QUIET)
    (run,) = simulate_ball_bearing(quiet, 1, [f"6208-701N-up-{force}"])
    n = round(rig.sampling.rate / rig.sampling.spacing)
    spectra = np.fft.rfft(run.recording.samples[:n], axis=0)
    for line in (33, 250, 460):
        w = 2 * np.pi * line * rig.sampling.spacing
        bearing = np.array(run.truth["stiffness"]) * (1 + 1j * w * rig.damping_factor)
        total = np.linalg.inv(
            np.linalg.inv(bearing) + np.diag([1, 1, 0, 0, 0]) / rig.deep_groove.bending_stiffness
        )
        h = -(w**2) * np.linalg.inv(total - w**2 * np.diag([2.45, 2.45, 2.45, 1.24e-2, 1.24e-2]))
        lever = np.array([1, 1, 1, 0.1, 0.1])
        expected = (lever[:, None] * h * lever)[[0, 2, 4], row]
        np.testing.assert_allclose(spectra[line, 1:] / spectra[line, 0], expected, rtol=1e-6, atol=1e-9)


def test_noise_has_the_stated_size_and_the_periods_repeat_without_it(rig) -> None:
    (noisy,) = simulate_ball_bearing(rig, 1, ["6208-427N-up-x"])
    still = replace(rig, noise=replace(rig.noise, acceleration=0.0, force=0.0))
    (clean,) = simulate_ball_bearing(still, 1, ["6208-427N-up-x"])
    np.testing.assert_allclose(
        np.std(noisy.recording.samples - clean.recording.samples, axis=0), [0.1, 0.3, 0.3, 0.3], rtol=0.05
    )
    n = round(rig.sampling.rate / rig.sampling.spacing)
    np.testing.assert_allclose(
        clean.recording.samples[:n], clean.recording.samples[-n:], rtol=1e-9, atol=1e-9
    )


def test_a_setting_has_one_preload_and_settings_scatter_as_stated(rig) -> None:
    runs = simulate_ball_bearing(rig, 3, ["6208-701N-up-x", "6208-701N-up-z", "6208-701N-down-z"])
    assert runs[0].truth["preload"] == runs[1].truth["preload"] != runs[2].truth["preload"]
    test = shaker_tests(rig)["6208-701N-up-x"]
    set_values = np.array([true_preload(rig, test, seed) for seed in range(400)]) / 701
    assert np.mean(set_values) == pytest.approx(1.0, abs=3 * 0.005 / 20)
    assert np.std(set_values) == pytest.approx(0.005, rel=0.12)


def test_hysteresis_stiffens_the_way_down_only(rig) -> None:
    bent = replace(rig, noise=QUIET, hysteresis=0.03)
    up, down = simulate_ball_bearing(bent, 1, ["6208-427N-up-z", "6208-427N-down-z"])
    np.testing.assert_allclose(down.truth["stiffness"], 1.03 * np.array(up.truth["stiffness"]), rtol=1e-12)


def test_runs_are_named_by_bearing_preload_way_and_force(rig) -> None:
    names = run_names(rig)
    assert len(names) == 3 * 4 * 3 + 5 * 3 + 2
    assert {"6208-1721N-down-by", "7208-445N-up-x", "6208-701N-m5-r3-z", "string", "strip"} <= set(names)
    alone = replace(rig, angular=None)
    assert len(run_names(alone)) == 2 * 4 * 3 + 5 * 3 + 2


def test_a_run_does_not_depend_on_which_others_are_made(rig) -> None:
    (alone,) = simulate_ball_bearing(rig, 1, ["7208-852N-up-z"])
    among = {run.name: run for run in simulate_ball_bearing(rig, 1, ["6208-427N-up-x", "7208-852N-up-z"])}
    np.testing.assert_array_equal(alone.recording.samples, among["7208-852N-up-z"].recording.samples)


def test_calibration_tables_follow_their_laws(rig) -> None:
    """P = a f^2 with a = 0.009189, F = 2079 S + 0.0092 as printed by Knaapen (1997)."""
    string, strip = simulate_ball_bearing(replace(rig, noise=QUIET), 1, ["string", "strip"])
    np.testing.assert_allclose(
        string.table["force [N]"], 0.009189 * string.table["frequency [Hz]"] ** 2, rtol=1e-12
    )
    np.testing.assert_allclose(strip.table["force [N]"], 2079 * strip.table["strip [V]"] + 0.0092, rtol=1e-12)


def test_faults_are_named(rig) -> None:
    with pytest.raises(ConfigError, match="no run '6208-427N-up-y'"):
        simulate_ball_bearing(rig, 1, ["6208-427N-up-y"])
    with pytest.raises(ConfigError, match="shaft: is missing"):
        replace(rig.deep_groove, bearing=replace(rig.deep_groove.bearing, shaft=None))
    with pytest.raises(ConfigError, match="bending_stiffness"):
        replace(rig.deep_groove, bending_stiffness=0.0)
    for entry in ({"loads": Loads(z=500.0)}, {"damping_factor": 1e-5}):
        with pytest.raises(ConfigError, match="the rig sets it by"):
            replace(rig.deep_groove, bearing=replace(rig.deep_groove.bearing, **entry))
    for preloads, said in (((), "preloads: is empty"), ((427.0, 427.0001), "names one twice")):
        with pytest.raises(ConfigError, match=said):
            replace(rig.deep_groove, preloads=preloads)
    with pytest.raises(ConfigError, match="string must not be negative"):
        replace(rig.noise, string=-20.0)
    with pytest.raises(ConfigError, match="periods must be positive"):
        Sampling(periods=0)
    with pytest.raises(ConfigError, match="both bearings are named '6208'"):
        replace(rig, angular=replace(rig.angular, name="6208"))
    with pytest.raises(ConfigError, match="stiffness_ratio must be positive"):
        replace(rig, stiffness_ratio=0.0)
    with pytest.raises(ConfigError, match="'hysteresis' takes all stiffness away"):
        replace(rig, hysteresis=-1.0)
    with pytest.raises(ConfigError, match="not a whole number"):
        simulate_ball_bearing(replace(rig, sampling=Sampling(rate=3201.0)), 1, ["6208-427N-up-x"])


def test_the_sample_data_are_what_the_rig_gives(rig, labpipe, tmp_path, root) -> None:
    names = ["6208-427N-up-x", "6208-701N-m1-r1-z", "strip"]
    options = [part for name in names for part in ("--run", name)]
    assert (
        labpipe(
            "simulate", root / "configs/virtual-ball-bearing.yaml", "-o", tmp_path, "--seed", 1, *options
        ).code
        == 0
    )
    for name in names[:2]:
        made, kept = (
            pq.read_table(folder / f"{name}.parquet").to_pandas()
            for folder in (tmp_path, root / "sample_data/ball-bearing")
        )
        assert list(made) == list(kept)
        assert (
            np.max(np.abs(made.to_numpy(int) - kept.to_numpy(int))) <= 1
        )  # one step of the logger: rounding of the last digit
    assert (tmp_path / "strip.csv").read_text() == (root / "sample_data/ball-bearing/strip.csv").read_text()
    size = sum(file.stat().st_size for file in (root / "sample_data/ball-bearing").iterdir())
    assert size <= 2e6

"""Runs of one degree of freedom: the exact steady state, and the standard errors that its noise allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.virtual_mechanics import LevitationNoise, VirtualMagneticRig
from labpipe.methods.magnetic_bearing.virtual_rig import ONE_DOF, RUNS, expected_std_error, simulate
from labpipe.simulate import linear

RIG = VirtualMagneticRig("virtual-magnetic-rig")
REPEATS = 60


@pytest.mark.parametrize(
    ("name", "m", "k", "c"), [("pedestal", 0.79, 134.5e3, 3.682), ("axial", 0.13, 2471.0, 3.108)]
)
def test_steady_state_is_the_closed_form_line_by_line(name: str, m: float, k: float, c: float) -> None:
    # Masses, k and c: Lim et al. (2009), sections 4.2 and 6.
    run = ONE_DOF[name](RIG)
    omega = 2 * np.pi * run.force.spacing * run.force.lines
    motion = linear.steady_state(
        run.force, 1 / linear.dynamic_stiffness(m, k, c, omega), run.timing.n_sample, 1
    )
    force = run.force.samples(run.timing.sample_rate, 1)
    measured = np.fft.rfft(motion)[run.force.lines] / np.fft.rfft(force)[run.force.lines]
    np.testing.assert_allclose(measured, 1 / (k - m * omega**2 + 1j * omega * c), rtol=1e-10)
    (recorded,) = simulate(RIG, 1, [name])
    assert (recorded.truth["mass"], recorded.truth["k"], recorded.truth["c"]) == (m, k, c)


def test_standard_errors_are_the_scatter_of_repeated_runs() -> None:
    # Weighted means of Re D + m w^2 and Im D / w with D = F/Y over the lines of 60-70 Hz, weights from the
    # known noise.
    omega = np.pi * np.arange(120, 141)
    exact = 134.5e3 - 0.79 * omega**2 + 3.682j * omega
    weight = 1 / (np.abs(exact) ** 4 * (0.3e-6) ** 2 + np.abs(exact) ** 2 * 0.02**2)
    estimates = []
    for seed in range(REPEATS):
        (run,) = simulate(RIG, seed, ["pedestal"])
        averaged = run.recording.samples[6000:].reshape(5, 2000, 2).mean(axis=0)
        force, motion = np.fft.rfft(averaged, axis=0)[120:141].T
        stiffness = force / motion
        k = np.average(stiffness.real + 0.79 * omega**2, weights=weight)
        estimates.append((k, np.average(stiffness.imag / omega, weights=weight * omega**2)))
    scatter = np.std(estimates, axis=0, ddof=1)
    expected = expected_std_error(RIG, "pedestal", (60.0, 70.0))
    # A standard deviation of 60 repeats is itself known to 9 %.
    np.testing.assert_allclose(scatter, [expected["k"], expected["c"]], rtol=0.27)


def test_standard_errors_follow_noise_and_stiffness_slope() -> None:
    once = expected_std_error(RIG, "pedestal", (60.0, 70.0))
    tripled = replace(RIG, noise=LevitationNoise(3 * 0.3e-6, 3 * 0.02, 1e-6))
    assert expected_std_error(tripled, "pedestal", (60.0, 70.0)) == pytest.approx(
        {name: 3 * error for name, error in once.items()}
    )
    # dH/dc = j w dH/dk: the two errors differ by w, which is nearly w_n = 412.6 rad/s where the information
    # is.
    assert once["k"] / once["c"] == pytest.approx(412.6, rel=0.01)


def test_damping_is_lost_in_noise_only_when_force_noise_drowns_the_lines() -> None:
    # The source calls c insignificant, |t| < 2. White noise does that only from 1.58 N of force noise on: a
    # line of 0.0301 N then carries 2 * 1.58 / sqrt(5 * 2000) = 0.0316 N of noise after averaging, so that no
    # line is found at all.
    loud = replace(RIG, noise=LevitationNoise(0.3e-6, 1.58, 1e-6))
    assert 3.682 / expected_std_error(loud, "pedestal", (60.0, 70.0))["c"] == pytest.approx(2.0, rel=5e-3)
    assert linear.line_amplitude(ONE_DOF["pedestal"](loud).force) < 2 * 1.58 / np.sqrt(5 * 2000)


@pytest.mark.parametrize(
    ("rig", "name", "band", "what"),
    [
        (RIG, "static", (60.0, 70.0), "no single k and c"),
        (RIG, "pedestal", (60.1, 60.2), "no line of run 'pedestal' lies in 60.1-60.2 Hz"),
        (replace(RIG, noise=LevitationNoise(0.0, 0.0, 0.0)), "pedestal", (60.0, 70.0), "without noise"),
    ],
)
def test_what_has_no_standard_error_is_refused(
    rig: VirtualMagneticRig, name: str, band: tuple[float, float], what: str
) -> None:
    with pytest.raises(ConfigError, match=what):
        expected_std_error(rig, name, band)


def test_static_force_has_the_published_slope() -> None:
    (run,) = simulate(RIG, 1, ["static"])
    assert run.table is not None
    displacement, force = (np.asarray(column) for column in run.table.values())
    near = displacement <= 45
    # 1694 N/m over 45 um, Lim et al. (2009), section 2.2; the bend takes 0.6-2.3 % away, noise of 0.2 mN adds
    # 2 N/m.
    slope = np.sum(displacement[near] * force[near]) / np.sum(displacement[near] ** 2) * 1e6
    assert 1694 * 0.977 - 6 < slope < 1694 + 6


def test_all_samples_together_are_small() -> None:
    runs = [run for run in simulate(RIG, 1) if run.recording is not None]
    assert {run.name for run in runs} < set(RUNS)
    assert sum(4 * run.recording.samples.size for run in runs) < 3e6

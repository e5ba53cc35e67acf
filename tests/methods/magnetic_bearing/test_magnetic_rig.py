"""The virtual rig against its closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing import virtual_mechanics as mechanics
from labpipe.methods.magnetic_bearing.loop import ControlLoop
from labpipe.methods.magnetic_bearing.virtual_mechanics import Levitation, LevitationNoise, VirtualMagneticRig
from labpipe.methods.magnetic_bearing.virtual_rig import RUNS, simulate
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

RIG = VirtualMagneticRig("virtual-magnetic-rig")
SILENT = replace(RIG, noise=LevitationNoise(0.0, 0.0, 0.0))


def test_the_pedestal_s_recorded_frf_is_its_closed_form() -> None:
    (run,) = simulate(SILENT, 1, ["pedestal"])
    response = measure(
        [run.recording], FrfSettings(excitation="periodic", period=2.0, skip=7, smooth=0, band=(1.0, 100.0))
    )
    w = 2 * np.pi * response.frequency
    expected = 1 / (134.5e3 - 0.79 * w**2 + 3.682j * w)
    # After 7 periods of 2 s the free decay is down to exp(-zeta w 14 s) = 7e-15 of its start.
    np.testing.assert_allclose(response.matrix[:, 0, 0], expected, rtol=1e-9)


def test_the_motion_starts_at_rest_and_its_transient_dies() -> None:
    (run,) = simulate(SILENT, 1, ["pedestal"])
    y = run.recording.samples[:, 1]
    assert abs(y[0]) < 1e-18
    period = y.reshape(-1, 2000)
    deviation = np.max(np.abs(period - period[-1]), axis=1)
    assert deviation[0] > 1e-6 and deviation[3] < 1e-3 * deviation[0]


def test_bearing_law_limits_closed_form() -> None:
    law = Levitation(static=1694.0, dynamic=110e3, corner=150.0, bearings=2)
    omega = 2 * np.pi * np.array([1e-3, 150.0, 1e7])
    stiffness = mechanics.levitation_stiffness(law, omega)
    # k_0 at rest, k_0 + k_1/2 at the corner, k_0 + k_1 far above; the loss at the corner is k_1/2.
    np.testing.assert_allclose(stiffness.real / 2, [1694.0, 1694.0 + 55e3, 1694.0 + 110e3], rtol=1e-6)
    assert stiffness.imag[1] / 2 == pytest.approx(55e3)
    assert np.all(stiffness.imag > 0)


def test_the_rotor_stays_within_40_um_and_the_rig_is_symmetric() -> None:
    (run,) = simulate(SILENT, 1, ["radial-0rpm"])
    assert np.max(np.abs(run.recording.samples[:, 1:])) < 40e-6
    np.testing.assert_array_equal(run.recording.samples[:, 1], run.recording.samples[:, 2])


def test_1x_stands_in_the_rotating_run_only() -> None:
    amplitudes = []
    for run in simulate(SILENT, 1, ["radial-0rpm", "radial-8000rpm"]):
        x = run.recording.samples[2000:8000, 1]
        t = np.arange(6000) / 2000
        # 3 s hold 400 turns at 8000 rpm; the excited lines are multiples of 1 Hz and vanish at 133.33 Hz.
        amplitudes.append(abs(2 * np.mean(x * np.exp(-2j * np.pi * 8000 / 60 * t))))
    assert amplitudes[0] < 1e-9
    assert amplitudes[1] == pytest.approx(4e-6, rel=1e-3)


def test_noise_has_the_level_asked_for() -> None:
    (noisy,), (clean,) = simulate(RIG, 1, ["pedestal"]), simulate(SILENT, 1, ["pedestal"])
    difference = noisy.recording.samples - clean.recording.samples
    np.testing.assert_allclose(np.std(difference, axis=0), [0.02, 0.3e-6], rtol=0.03)


def test_two_directions_show_the_whole_matrix() -> None:
    runs = simulate(SILENT, 1, ["two-directions-x", "two-directions-y"])
    response = measure(
        [run.recording for run in runs], FrfSettings(excitation="periodic", period=1.0, skip=0, smooth=0)
    )
    w = 2 * np.pi * response.frequency[:, None, None]
    stiffness = np.linalg.inv(response.matrix) + 0.92 * w**2 * np.eye(2)
    np.testing.assert_allclose(
        stiffness.real, np.broadcast_to(mechanics.COUPLED_STIFFNESS, stiffness.shape), rtol=1e-6
    )
    np.testing.assert_allclose(
        (stiffness / w).imag,
        np.broadcast_to(mechanics.COUPLED_DAMPING, stiffness.shape),
        rtol=1e-5,
        atol=1e-3,
    )


@pytest.mark.parametrize("name", list(RUNS))
def test_same_seed_same_samples_whatever_else_is_made(name: str) -> None:
    (alone,) = simulate(RIG, 7, [name])
    among = next(run for run in simulate(RIG, 7) if run.name == name)
    (other,) = simulate(RIG, 8, [name])

    def samples(run) -> np.ndarray:  # type: ignore[no-untyped-def]
        return (
            run.recording.samples if run.recording is not None else np.column_stack(list(run.table.values()))
        )

    np.testing.assert_array_equal(samples(alone), samples(among))
    assert not np.array_equal(samples(alone), samples(other))


def test_unknown_runs_are_named() -> None:
    with pytest.raises(ConfigError, match="is above pedestal_mass"):
        VirtualMagneticRig("virtual-magnetic-rig", pedestal_mass=0.8, rotor_mass=0.8)
    for own, said in (
        ({"loop": ControlLoop(proportional=2.0)}, "'loop' is not of the law relaxation"),
        ({"law": "control-loop", "dynamic": 1e5}, "'dynamic' is not of the law control-loop"),
    ):
        with pytest.raises(ConfigError, match=said):
            Levitation(**own)
    with pytest.raises(ConfigError, match="force must not be negative"):
        LevitationNoise(force=-0.02)
    with pytest.raises(ConfigError, match="no run 'pedestel'") as caught:
        simulate(RIG, 1, ["pedestel"])
    assert caught.value.hint == "did you mean 'pedestal'?"

"""Sources of a study: their bounds against closed forms, their noise against its stated size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings
from labpipe.methods.magnetic_bearing.virtual_mechanics import VirtualMagneticRig
from labpipe.simulate.linear import Lines, VirtualMdofRig, noisy_response
from labpipe.spectra.settings import FrfSettings
from labpipe.uncertainty.study import source_of

ONE = VirtualMdofRig("virtual-mdof-rig", ((4.0,),), ((0.5,),), (1.0,), Lines(0.1, 0.6, 30), 0.02)
FRF = FrfSettings(excitation="periodic", period=2.0, skip=3, band=(50.0, 80.0))


def test_bounds_of_one_dof_are_the_closed_form() -> None:
    # d H / dk = -H^2, d H / dc = -j w H^2, each part of the noise of standard deviation s: F = sum |dH|^2 /
    # s^2, cross terms zero.
    source = source_of(ONE, 0.03, None, (), None)
    h = ONE.receptance[:, 0, 0]
    w = 2 * np.pi * ONE.frequency
    s = 0.03 * np.max(np.abs(h))
    slopes = np.array([-(h**2), -1j * w * h**2])
    information = (slopes.conj() @ slopes.T).real / s**2
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    found = source.bounds(FitSettings("mdof", mass=(1.0,)))
    assert [found["k_1_1"], found["c_1_1"]] == pytest.approx(list(expected), rel=1e-9)
    # What the fit estimates beside the rig's coefficients has no bound here.
    assert source.bounds(FitSettings("mdof", mass=(1.0,), scale_mass=True)) == {}


def test_noise_has_its_stated_size_and_follows_the_seed() -> None:
    rig = replace(ONE, lines=Lines(0.1, 0.6, 4000))
    exact = rig.receptance
    noise = noisy_response(rig, np.random.default_rng(1)).matrix - exact
    # A standard deviation of 4000 values is known to 1.1 %; three of those.
    for part in (noise.real, noise.imag):
        assert np.std(part) == pytest.approx(0.02 * np.max(np.abs(exact)), rel=0.034)
    source = source_of(rig, 0.02, None, (), None)
    first, again, other = (source.response(seed).matrix for seed in ((1, 0), (1, 0), (1, 1)))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_lines_change_the_count_not_the_band() -> None:
    source = source_of(ONE, 0.02, 60, (), None)
    response = source.response((1, 1))
    assert source.n_line == response.n_frequency == 60 and response.frequency[-1] == pytest.approx(0.6)


def test_the_magnetic_rig_is_measured_through_recordings() -> None:
    source = source_of(VirtualMagneticRig("virtual-magnetic-rig"), 1.0, None, ("pedestal",), FRF)
    assert source.truth["k"] == 134.5e3 and source.n_line == source.response((1, 3)).n_frequency
    known = FitSettings("sdof", mass=0.79, band=(60.0, 70.0))
    assert set(source.bounds(known)) == {"k", "c"} and source.bounds(replace(known, mass="estimate")) == {}
    quiet = source_of(VirtualMagneticRig("virtual-magnetic-rig"), 0.5, None, ("pedestal",), FRF)
    assert quiet.bounds(known)["k"] == pytest.approx(source.bounds(known)["k"] / 2, rel=1e-6)


@pytest.mark.parametrize(
    ("rig", "lines", "runs", "frf", "message"),
    [
        (ONE, None, ("pedestal",), None, "'runs': this rig has none"),
        (VirtualMagneticRig("virtual-magnetic-rig"), 30, ("pedestal",), FRF, "'lines'"),
        (VirtualMagneticRig("virtual-magnetic-rig"), None, (), FRF, "'runs': is missing"),
        (VirtualMagneticRig("virtual-magnetic-rig"), None, ("pedestall",), FRF, "no run 'pedestall'"),
        (VirtualMagneticRig("virtual-magnetic-rig"), None, ("pedestal",), None, "needs the frf: section"),
    ],
)
def test_what_a_rig_cannot_give_is_said(rig, lines, runs, frf, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError, match=message):
        source_of(rig, 1.0, lines, runs, frf)


@pytest.mark.parametrize(
    "change",
    [
        {"damping": ((0.1, 0.2),)},
        {"mass": (1.0, 2.0)},
        {"noise": -0.1},
        {"lines": Lines(0.6, 0.1, 30)},
        {"lines": Lines(0.1, 0.6, 1)},
    ],
)
def test_a_rig_that_cannot_be_is_refused(change: dict) -> None:
    with pytest.raises(ConfigError):
        replace(ONE, **change)

"""Test signals: spectrum, phases, crest factor."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.raw_files.excitation import PHASES, crest_factor, design_multisine


@pytest.mark.parametrize("phases", list(PHASES))
def test_the_spectrum_is_flat_and_the_level_as_asked(phases: str) -> None:
    samples = design_multisine((10.0, 40.0), 0.5, 2.0, phases=phases, seed=3).samples(200.0, 2)
    amplitude = np.abs(np.fft.rfft(samples[:400])) * 2 / 400
    # N lines of amplitude a have the rms a sqrt(N / 2).
    np.testing.assert_allclose(amplitude[20:81], 2.0 * np.sqrt(2 / 61), rtol=1e-9)
    assert np.max(np.delete(amplitude, range(20, 81))) < 1e-12
    assert np.sqrt(np.mean(samples**2)) == pytest.approx(2.0)
    np.testing.assert_allclose(samples[:400], samples[400:])


def test_schroeder_phases_closed_form() -> None:
    signal = design_multisine((1.0, 4.0), 1.0, 1.0)
    np.testing.assert_allclose(signal.phases, [0.0, -np.pi * 2 / 4, -np.pi * 6 / 4, -np.pi * 12 / 4])


def test_optimised_crest_factor_is_below_schroeder_and_random() -> None:
    crest = {name: design_multisine((1.0, 100.0), 0.5, 1.0, phases=name).crest_factor for name in PHASES}
    # Schroeder's flat multisine of the source's pedestal test: 1.766 (measured here, oversampled); a sine has
    # sqrt(2).
    assert crest["schroeder"] == pytest.approx(1.766, abs=0.005)
    assert np.sqrt(2) * 0.95 < crest["optimised"] < 0.85 * crest["schroeder"] < crest["random"]


def test_odd_lines_only() -> None:
    lines = design_multisine((1.0, 10.0), 1.0, 1.0, odd_only=True).lines
    assert lines.tolist() == [1, 3, 5, 7, 9]


def test_crest_factor_of_a_sine() -> None:
    assert crest_factor(np.sin(2 * np.pi * np.arange(1000) / 1000)) == pytest.approx(np.sqrt(2))


def test_what_makes_no_signal_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no line every 1 Hz lies in 1\.2-1\.8 Hz"):
        design_multisine((1.2, 1.8), 1.0, 1.0)
    with pytest.raises(ConfigError, match="unknown phases 'flat'"):
        design_multisine((1, 10), 1.0, 1.0, phases="flat")
    with pytest.raises(ConfigError, match="must be positive"):
        design_multisine((1, 10), 0.0, 1.0)
    with pytest.raises(ConfigError, match="more than 200 Hz of sampling rate"):
        design_multisine((1, 100), 1.0, 1.0).samples(150.0, 1)
    with pytest.raises(ConfigError, match="not a whole number") as caught:
        design_multisine((1, 10), 0.3, 1.0).samples(1000.0, 1)
    assert caught.value.hint == "the nearest sampling rate is 999.9 Hz"


def test_detection_lines_are_left_out_one_of_each_group() -> None:
    full = design_multisine((1.0, 99.0), 1.0, 1.0, odd_only=True)
    thinned = design_multisine((1.0, 99.0), 1.0, 1.0, odd_only=True, leave_out=4, phases="random", seed=3)
    missing = sorted(set(full.lines) - set(thinned.lines))
    assert full.lines.size == 50 and len(missing) == 12
    assert thinned.lines[0] == 1 and thinned.lines[-1] == 99
    # One in each group of four odd lines: neighbours are at most seven odd lines apart, never two in one
    # group.
    assert all((b - a) / 2 <= 7 for a, b in pairwise(missing))
    assert [(line - 3) // 8 for line in missing] == list(range(12))
    other = design_multisine((1.0, 99.0), 1.0, 1.0, odd_only=True, leave_out=4, phases="random", seed=4)
    assert set(other.lines) != set(thinned.lines)


@pytest.mark.parametrize("leave_out", [1, -2])
def test_leaving_every_line_out_is_refused(leave_out: int) -> None:
    with pytest.raises(ConfigError, match="leaves none"):
        design_multisine((1.0, 99.0), 1.0, 1.0, leave_out=leave_out)

"""Phases of least peak, against sines and against the crest factors that are known of flat multisines."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.planning.campaigns import least_peak_phases, schroeder_phases_of
from labpipe.raw_files.excitation import peaks


def test_peaks_of_known_sums() -> None:
    # One sine of amplitude 3; two cosines in phase, whose peaks meet at t = 0. The largest sine that meets no
    # sample is told exactly; others are told too high, by 1 - cos(pi / 192) at most.
    alone = peaks(np.array([7]), 3.0 * np.exp(1j * np.linspace(0, 2 * np.pi, 100))[None])
    assert np.all(alone >= 3.0 - 1e-12) and np.all(alone <= 3.0 / np.cos(np.pi / 192) + 1e-12)
    assert peaks(np.array([7, 8]), np.array([[1.0, 2.0], [1.0, 2.0j]])) == pytest.approx([2.0, 4.0], rel=1e-2)


def test_schroeder_phases_of_a_flat_spectrum() -> None:
    # phi_n = -pi n (n - 1) / N (Schroeder 1970).
    n = np.arange(1, 11)
    np.testing.assert_allclose(schroeder_phases_of(np.full(10, 3.0)), -np.pi * n * (n - 1) / 10, atol=1e-12)


def test_flat_multisine_comes_below_one_and_a_half() -> None:
    # Optimised crest factors of flat multisines of many lines lie at 1.4 to 1.5, Schroeder's at 1.7 to 1.9
    # (Guillaume et al. 1991).
    lines = np.arange(1, 101)
    gains = np.full((100, 1, 1), np.sqrt(2 / 100), complex)
    phases = least_peak_phases(lines, gains)
    assert peaks(lines, gains[:, 0] * np.exp(1j * phases))[0] < 1.45
    schroeder = schroeder_phases_of(np.ones(100))
    assert peaks(lines, gains[:, 0] * np.exp(1j * schroeder)[:, None])[0] > 1.6


def test_two_neighbours_beat() -> None:
    # a cos(n t) + a cos((n + 1) t): the envelope reaches 2 a whatever the phases; rms a.
    lines = np.array([100, 101])
    phases = least_peak_phases(lines, np.ones((2, 1, 1), complex))
    assert peaks(lines, np.exp(1j * phases))[0] == pytest.approx(2.0, rel=1e-2)


def test_sources_of_a_group_keep_their_difference() -> None:
    rng = np.random.default_rng(5)
    gains = rng.normal(size=(12, 2, 3)) + 1j * rng.normal(size=(12, 2, 3))
    groups = np.repeat(np.arange(6), 2)
    phases = least_peak_phases(np.arange(3, 15), gains, groups)
    difference = np.exp(1j * (phases[:, 1] - phases[:, 0]))
    np.testing.assert_allclose(difference[::2], difference[1::2], atol=1e-9)
    # The largest of three peaks is lower than with Schroeder's phases.
    start = schroeder_phases_of(np.sum(np.abs(gains) ** 2, axis=(1, 2)))
    begun = peaks(np.arange(3, 15), (gains * np.exp(1j * start)[:, None, None]).sum(axis=1)).max()
    assert peaks(np.arange(3, 15), (gains * np.exp(1j * phases)[:, :, None]).sum(axis=1)).max() < 0.85 * begun

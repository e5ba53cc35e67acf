"""Reciprocity judged against simulated uncertainty; the covariance of a dynamic stiffness."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gammaincc

from labpipe.errors import DataError
from labpipe.records.response import FrequencyResponse, Port
from labpipe.simulate.linear import WhiteNoiseRig
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.measurement import measure
from labpipe.spectra.quality import reciprocity
from labpipe.spectra.settings import FrfSettings

N = 40
FREQUENCY = np.arange(10.0, 10.0 + N)
TRUTH = np.array([[2.0 + 1.0j, 0.5 - 0.2j], [0.5 - 0.2j, 1.5 - 1.0j]])
ROOT = 0.05 * np.array([[1.0, 0, 0, 0], [0.3j, 0.8, 0, 0], [0.2, 0.1, 1.1, 0], [0, 0.4j, 0, 0.9]])
COVARIANCE = ROOT @ ROOT.conj().T
PORTS = (Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2))


def measured(
    rng: np.random.Generator, truth: np.ndarray = TRUTH, n: int = N, dof: float = np.inf
) -> FrequencyResponse:
    noise = (rng.normal(size=(n, 4)) + 1j * rng.normal(size=(n, 4))) / np.sqrt(2)
    covariance = np.broadcast_to(COVARIANCE, (n, 4, 4))
    if np.isfinite(dof):
        periods = (rng.normal(size=(n, 4, int(dof))) + 1j * rng.normal(size=(n, 4, int(dof)))) / np.sqrt(2)
        covariance = ROOT @ periods @ periods.conj().swapaxes(1, 2) @ ROOT.conj().T / dof
    matrix = truth + (noise @ ROOT.T).reshape(n, 2, 2)
    return FrequencyResponse(FREQUENCY[:n], matrix, PORTS, PORTS, covariance=covariance, covariance_dof=dof)


@pytest.mark.long
@pytest.mark.parametrize("dof", [np.inf, 12.0])
def test_p_values_are_spread_evenly_where_reciprocity_holds(dof: float) -> None:
    rng = np.random.default_rng(21)
    values = [reciprocity(measured(rng, dof=dof))[0].p_value for _ in range(400)]
    for level in (0.05, 0.2, 0.5, 0.8):
        assert np.mean(np.array(values) < level) == pytest.approx(
            level, abs=4 * np.sqrt(level * (1 - level) / 400) + 0.02
        )


@pytest.mark.parametrize(
    ("differences", "dof", "expected"),
    [
        # Two lines without correlation, |d|^2 / var of a sum s = 6: two exponentials, (1 + s) e^-s.
        ([6**0.5, 0], np.inf, 7 * np.exp(-6)),
        # Four degrees of freedom: a gamma of shape 2 (1 - 2 / 4) = 1, the mean 3 times 3 / 4.
        ([6**0.5, 0], 4.0, np.exp(-3 * 3 / 4)),
        # Four alike: r = 3/4, 1/2, 1/4, less 1/4 of their squares by chance, so 4 / (1 + 2 * 5/16) lines.
        ([1, 1j, -1, -1j], np.inf, gammaincc(32 / 13, 32 / 13)),
    ],
)
def test_a_p_value_by_hand(differences: list[complex], dof: float, expected: float) -> None:
    matrix = np.tile(TRUTH, (len(differences), 1, 1))
    matrix[:, 0, 1] += differences
    covariance = np.tile(np.eye(4) / 2, (len(differences), 1, 1))
    response = FrequencyResponse(
        FREQUENCY[: len(differences)], matrix, PORTS, PORTS, covariance=covariance, covariance_dof=dof
    )
    assert reciprocity(response)[0].p_value == pytest.approx(expected, rel=1e-9)


def test_noise_shared_between_lines_is_counted() -> None:
    # Noise summed over neighbours as a Hann window does: without the count 5 % would become far more.
    rng = np.random.default_rng(22)
    values = []
    for _ in range(800):
        plain = measured(rng, 0 * TRUTH, N)
        mixed = plain.matrix + 2 / 3 * (np.roll(plain.matrix, 1, axis=0) + np.roll(plain.matrix, -1, axis=0))
        mixed = mixed / np.sqrt(1 + 8 / 9) + TRUTH
        values.append(
            reciprocity(FrequencyResponse(FREQUENCY, mixed, PORTS, PORTS, covariance=plain.covariance))[
                0
            ].p_value
        )
    assert np.mean(np.array(values) < 0.05) < 0.08
    assert np.mean(np.array(values) < 0.5) == pytest.approx(0.5, abs=0.1)


def test_a_rotor_that_is_not_reciprocal_is_found(rng: np.random.Generator) -> None:
    gyroscopic = TRUTH + np.array([[0, 0.1], [-0.1, 0]])
    found = reciprocity(measured(rng, gyroscopic))[0]
    assert found.p_value < 1e-3 and found.ratio.mean() > 3
    assert (found.first, found.second) == ("x", "y")
    # |H_xy - H_yx| = 0.2 beside the mean size of both, and noise.
    both = np.sqrt(np.mean(np.abs([gyroscopic[0, 1], gyroscopic[1, 0]]) ** 2))
    assert found.difference == pytest.approx(0.2 / both, rel=0.3)


def test_what_cannot_be_compared_is_refused(rng: np.random.Generator) -> None:
    response = measured(rng)
    with pytest.raises(DataError, match="without the covariance"):
        reciprocity(FrequencyResponse(FREQUENCY, response.matrix, PORTS, PORTS))
    other = (Port("a", "a", "a"), Port("b", "b", "b"))
    with pytest.raises(DataError, match="two dofs"):
        reciprocity(
            FrequencyResponse(FREQUENCY, response.matrix, PORTS, other, covariance=response.covariance)
        )
    with pytest.raises(DataError, match="2 degrees of freedom"):
        reciprocity(
            FrequencyResponse(
                FREQUENCY, response.matrix, PORTS, PORTS, covariance=response.covariance, covariance_dof=2.0
            )
        )
    with pytest.raises(DataError, match="no variance"):
        reciprocity(
            FrequencyResponse(FREQUENCY, response.matrix, PORTS, PORTS, covariance=0 * response.covariance)
        )


@pytest.mark.parametrize(("k_yx", "verdict"), [(30e3, "within the noise"), (-20e3, "beyond the noise")])
def test_the_frf_stage_tells_of_it_in_a_note(k_yx: float, verdict: str) -> None:
    stiffness = ((620e3, 30e3), (k_yx, 690e3))
    rig = WhiteNoiseRig(
        "virtual-white-noise-rig", stiffness, ((190.0, 15.0), (15.0, 160.0)), 2.4, blocks=8, unbalance=0.0
    )
    response = measure(recordings(rig, 3), FrfSettings(excitation="random", block=5.0, band=(50.0, 110.0)))
    (finding,) = [f for f in response.findings if f.code == "reciprocity"]
    assert (
        finding.level == "note"
        and verdict in finding.message
        and finding.message.startswith("H of x to y and of y to x differ by")
    )
    alone = measure(
        recordings(rig, 3, ["along-x"]), FrfSettings(excitation="random", block=5.0, band=(50.0, 110.0))
    )
    assert not [f for f in alone.findings if f.code == "reciprocity"]

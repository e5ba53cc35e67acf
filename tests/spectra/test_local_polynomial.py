"""The local polynomial method against polynomials, a plain least squares, drawn noise, and Welch's averages
of the same records.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import ConfigError, DataError
from labpipe.records.recording import Channel, Recording
from labpipe.simulate.linear import SensorNoise, WhiteNoiseRig
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.local import freedom, local_polynomials, usual_half_width
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))


def circular(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def test_polynomials_of_its_degree_are_found_exactly(rng: np.random.Generator) -> None:
    """G = 2 - 0.1 k + 0.003 k^2 over the lines, leakage of every block quadratic as well, no noise: both are
    told apart exactly.
    """
    k = np.arange(60.0)
    gains = np.stack([2 - 0.1 * k + 0.003j * k**2, 1j + 0.05 * k], axis=1)
    forces = circular(rng, 3, 60, 2)
    leakage = np.polynomial.polynomial.polyval(k, circular(rng, 3, 3) * [[1], [0.1], [0.01]])[:, :, None]
    responses = np.sum(forces * gains, axis=2, keepdims=True) + leakage
    fitted = local_polynomials(forces, responses, 2, 6)
    np.testing.assert_allclose(fitted.matrix[:, 0], gains[6:-6], rtol=1e-9)
    assert np.max(np.abs(fitted.covariance)) < 1e-18 and np.min(fitted.multiple_coherence) > 1 - 1e-12


def test_it_is_a_plain_least_squares_around_every_line(rng: np.random.Generator) -> None:
    """The readable twin: forces times powers, and powers for each block, in one design.

    Covariance S_vv[o, p] (A^H A)^-1[i, j].
    """
    forces, responses, degree, n = circular(rng, 2, 30, 2), circular(rng, 2, 30, 2), 1, 5
    fitted = local_polynomials(forces, responses, degree, n)
    line, r = 7, np.arange(-n, n + 1) / n
    powers = r[:, None] ** np.arange(degree + 1)
    rows = []
    for block in range(2):
        u = forces[block, line : line + 2 * n + 1]
        of_leakage = np.zeros((r.size, 2 * (degree + 1)))
        of_leakage[:, block * (degree + 1) : (block + 1) * (degree + 1)] = powers
        rows.append(np.concatenate([*(u * powers[:, [s]] for s in range(degree + 1)), of_leakage], axis=1))
    design = np.concatenate(rows)
    y = np.concatenate(list(responses[:, line : line + 2 * n + 1]))
    values = np.linalg.lstsq(design, y, rcond=None)[0]
    residual = y - design @ values
    dof = design.shape[0] - design.shape[1]
    assert fitted.dof == dof == freedom(2, 2, degree, n)
    np.testing.assert_allclose(fitted.matrix[line], values[:2].T, rtol=1e-9)
    noise, inverse = residual.T @ residual.conj() / dof, np.linalg.inv(design.conj().T @ design)[:2, :2]
    np.testing.assert_allclose(fitted.covariance[line], np.kron(noise, inverse), rtol=1e-8)


@pytest.mark.parametrize(("n_block", "degree", "half_width"), [(1, 2, 6), (3, 2, 4), (2, 4, 7)])
def test_variance_and_correlation_are_those_of_drawn_noise(
    n_block: int, degree: int, half_width: int
) -> None:
    """8000 lines of noise alone: E|d|^2 / s^2 = q / (q - 1) for q degrees of freedom, and neighbours
    correlate as it says.
    """
    rng = np.random.default_rng(3)
    forces, noise = circular(rng, n_block, 8000, 1), circular(rng, n_block, 8000, 1)
    fitted = local_polynomials(forces, noise, degree, half_width)
    error, variance = fitted.matrix[:, 0, 0], fitted.covariance[:, 0, 0].real
    q = fitted.dof
    assert np.mean(np.abs(error) ** 2 / variance) == pytest.approx(q / (q - 1), rel=0.08)
    scaled = error / np.sqrt(np.abs(variance))
    measured = [
        np.mean(scaled[:-d] * scaled[d:].conj()).real / np.mean(np.abs(scaled) ** 2)
        for d in range(1, 2 * half_width + 1)
    ]
    # Lines share their noise over a window, so that the standard error of a mean is that of 8000 / (2 n + 1)
    # lines.
    np.testing.assert_allclose(measured, fitted.correlation, atol=4 * np.sqrt((2 * half_width + 1) / 8000))
    assert fitted.correlation[0] > 0.2


def test_many_lines_are_done_piece_by_piece(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    forces, responses = circular(rng, 1, 300, 1), circular(rng, 1, 300, 1)
    whole = local_polynomials(forces, responses, 2, 6)
    monkeypatch.setattr("labpipe.spectra.local.LINES_AT_ONCE", 37)
    pieces = local_polynomials(forces, responses, 2, 6)
    np.testing.assert_allclose(pieces.matrix, whole.matrix, rtol=1e-12)
    np.testing.assert_allclose(pieces.covariance, whole.covariance, rtol=1e-10)


@pytest.mark.parametrize(
    ("n_block", "n_input", "degree", "half_width"),
    [(1, 1, 2, 7), (4, 1, 2, 3), (1, 2, 2, 8), (100, 1, 2, 3), (1, 1, 4, 9)],
)
def test_the_usual_half_width_leaves_eight_degrees_of_freedom(
    n_block: int, n_input: int, degree: int, half_width: int
) -> None:
    """By hand: B (2 n - d) - (d + 1) n_u >= 8, and more lines to a side than the degree."""
    assert usual_half_width(n_block, n_input, degree) == half_width
    assert freedom(n_block, n_input, degree, half_width) >= 8


RIG = WhiteNoiseRig(
    "virtual-white-noise-rig",
    ((620e3, 30e3), (-20e3, 690e3)),
    ((30.0, 5.0), (5.0, 25.0)),
    2.4,
    blocks=1,
    block=40.0,
    unbalance=0.0,
    noise=SensorNoise(2e-6, 0.0),
)


def test_two_forces_give_their_matrix_within_its_covariance() -> None:
    """Two recordings of 40 s, one force each; 0.3 to 0.5 Hz of half-power width are 13 lines and more."""
    response = measure(
        recordings(RIG, 1),
        FrfSettings("random", block="40 s", local="polynomial", degree=4, band="60-110 Hz"),
    )
    error = response.matrix - RIG.receptance(response.frequency)
    ratio = np.mean(np.abs(error) ** 2 / response.variance)
    q = response.covariance_dof
    assert q >= 8
    assert ratio == pytest.approx(q / (q - 1), rel=0.25)
    assert (
        response.coherence is None
        and response.multiple_coherence is not None
        and response.line_correlation[0].real > 0.3
    )
    assert response.blocks.degree == 4 and response.blocks.number == 2 and response.n_frequency == 2001


def recording(n_sample: int, force: np.ndarray | None = None) -> Recording:
    rng = np.random.default_rng(1)
    f = rng.standard_normal(n_sample) if force is None else force
    return Recording(CHANNELS, np.column_stack([f, np.convolve(f, [1, 0.5, 0.2], "same")]), 100.0, "r")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"excitation": "impact"}, "'local' is not for impact excitation"),
        ({"estimator": "H2"}, "'local' takes the forces as exact, H2 does not"),
        ({"half_width": 2}, "'half_width' must exceed 'degree'"),
        ({"degree": 0}, "'degree' is 0"),
        ({"local": "polynom"}, "unknown|not one of|did you mean"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises((ConfigError, ValueError), match=message):
        FrfSettings(**{"excitation": "random", "block": "1 s", "local": "polynomial", **change})


def test_records_that_hold_too_little_are_refused() -> None:
    settings = FrfSettings("random", block="2 s", local="polynomial")
    with pytest.raises(DataError, match=r"is 1.5 s long, too short for one block of 2 s"):
        measure([recording(150)], settings)
    with pytest.raises(DataError, match=r"a block of 0.05 s holds 5 samples of '.*', 8 are needed"):
        measure([recording(150)], FrfSettings("random", block="50 ms", local="polynomial"))
    with pytest.raises(DataError, match="fewer lines than the window of 15"):
        measure([recording(24)], FrfSettings("random", block="0.2 s", local="polynomial", half_width=7))
    with pytest.raises(DataError, match="half_width: 3 leaves the noise unknown"):
        measure([recording(200)], FrfSettings("random", block="2 s", local="polynomial", half_width=3))
    with pytest.raises(DataError, match="too smooth over the lines"):
        measure([recording(200, np.eye(1, 200, 1)[0])], settings)


def test_the_noise_of_a_column_is_that_of_its_own_recording() -> None:
    """A tenth of the force and of the noise in the second: the relative error of both columns is one. With
    the noise of both together their variances were one to a hundred.
    """
    rng = np.random.default_rng(5)
    outputs = tuple(Channel(name, "displacement", "output", name) for name in "xy")
    sources = []
    for name, level in (("f", 1.0), ("g", 0.1)):
        force = level * rng.normal(size=(8000, 1))
        samples = np.hstack([force, force * [2.0, 0.3] + 0.1 * level * rng.normal(size=(8000, 2))])
        sources.append(Recording((Channel(name, "force", "input", name), *outputs), samples, 1e3, name))
    settings = FrfSettings("random", block="2 s", local="polynomial", band=(30.0, 300.0))
    variance = measure(sources, settings).variance.mean(axis=0)
    np.testing.assert_allclose(variance[:, 1] / variance[:, 0], 1.0, atol=0.15)


def test_noise_that_grows_with_the_level_of_a_recording_is_told_from_one_block_of_each() -> None:
    """Circular normal forces and noise, both ten times as large in the second block: the mean square of the
    errors of H = 2 is the mean of the variance. It was half as much again, with what the strong block leaves
    in the residual of the weak one.
    """
    rng = np.random.default_rng(3)
    u, v = rng.standard_normal((2, 2, 4000, 1)) + 1j * rng.standard_normal((2, 2, 4000, 1))
    level = np.array([1.0, 10.0])[:, None, None]
    fit = local_polynomials(level * u, level * (2 * u + v), 2, 4, np.arange(2))
    errors, variance = np.abs(fit.matrix[:, 0, 0] - 2) ** 2, fit.covariance[:, 0, 0].real
    assert np.mean(errors) == pytest.approx(np.mean(variance), rel=0.1)

"""Realisations of the phases: grouped, averaged, and their distortion compared with the scatter of many
single ones.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.errors import ConfigError, DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.measurement import measure
from labpipe.spectra.periodic import realisations, robust_mean
from labpipe.spectra.settings import FrfSettings

N, LINES = 512, np.arange(1, 80)
X = Channel("x", "displacement", "output", "x", 0.0)
Y = Channel("y", "displacement", "output", "y", np.pi / 2)
FORCES = (Channel("f", "force", "input", "x", 0.0), Channel("f", "force", "input", "y", np.pi / 2))
SETTINGS = FrfSettings(
    excitation="periodic", period=1.0, skip=0, smooth=5, band=(1.0, 79.0), realisations=True
)


def recording(
    rng: np.random.Generator,
    cube: float,
    noise: float,
    force: Channel = FORCES[0],
    outputs: tuple[Channel, ...] = (X,),
) -> Recording:
    """Six periods of y = u + cube u^3 with noise on y, the phases of u drawn anew."""
    spectrum = np.zeros(N // 2 + 1, complex)
    spectrum[LINES] = np.exp(2j * np.pi * rng.uniform(size=LINES.size))
    period = np.fft.irfft(spectrum, N)
    u = np.tile(period / np.std(period), 6)
    share = [1.0, 0.5] if force is FORCES[0] else [0.25, 2.0]
    y = [
        (u + cube * u**3) * share[number] + noise * rng.normal(size=u.size) for number in range(len(outputs))
    ]
    return Recording((force, *outputs), np.column_stack([u, *y]), float(N), f"run {force.dof}")


def test_a_linear_system_shows_noise_only(rng: np.random.Generator) -> None:
    response = measure([recording(rng, 0.0, 0.05) for _ in range(4)], SETTINGS)
    noise = np.sqrt(np.mean(np.einsum("fii->fi", response.covariance).real))
    assert response.distortion is not None and np.mean(response.distortion**2) < 4 * noise**2
    (finding,) = [f for f in response.findings if f.code == "distortion"]
    assert finding.level == "note" and finding.message.startswith("4 realisations of the phases")
    # 4 x 6 periods; degrees of freedom of the scatter, (4 - 1) x 11 lines, are the fewer.
    assert (response.averages, response.covariance_dof) == (24.0, 33.0)


def test_distortion_is_the_scatter_of_single_realisations(rng: np.random.Generator) -> None:
    single = FrfSettings(excitation="periodic", period=1.0, skip=0, smooth=5, band=(1.0, 79.0))
    many = np.array([measure([recording(rng, 0.05, 1e-4)], single).matrix[:, 0, 0] for _ in range(60)])
    scatter = np.sqrt(np.mean(np.var(many, axis=0, ddof=1)))
    found = [measure([recording(rng, 0.05, 1e-4) for _ in range(4)], SETTINGS) for _ in range(5)]
    levels = [np.sqrt(4 * np.mean(each.distortion**2)) for each in found]
    # 20 realisations of 79 lines against 60: each level is known to some 3 %.
    assert np.mean(levels) == pytest.approx(scatter, rel=0.1)


@pytest.mark.long
def test_the_covariance_of_the_mean_holds_both_noise_and_distortion(rng: np.random.Generator) -> None:
    found = [measure([recording(rng, 0.02, 0.05) for _ in range(3)], SETTINGS) for _ in range(40)]
    observed = np.mean(np.var([each.matrix[:, 0, 0] for each in found], axis=0, ddof=1))
    predicted = np.mean([each.variance for each in found])
    # 40 x 79 values of chi-square with two degrees of freedom, lines of the distortion not quite independent:
    # below 5 %.
    assert predicted / observed == pytest.approx(1.0, abs=0.15)


def test_directions_are_sorted_into_realisations(rng: np.random.Generator) -> None:
    runs = [recording(rng, 0.0, 1e-4, force, (X, Y)) for force in FORCES for _ in range(3)]
    for k, group in enumerate(realisations(runs)):
        assert [id(source) for source in group] == [id(runs[k]), id(runs[k + 3])]
    response = measure(runs, SETTINGS)
    np.testing.assert_allclose(
        response.matrix, np.broadcast_to([[1.0, 0.25], [0.5, 2.0]], response.matrix.shape), atol=1e-4
    )


def test_what_are_no_realisations_is_refused(rng: np.random.Generator) -> None:
    runs = [recording(rng, 0.0, 1e-4, force, (X, Y)) for force in FORCES]
    for wrong in (runs, [*runs, runs[0]]):
        with pytest.raises(DataError, match=r"recording\(s\) do not form realisations of one measurement"):
            measure(wrong, SETTINGS)
    with pytest.raises(ConfigError, match="'realisations' is not for random excitation"):
        FrfSettings(excitation="random", block=1.0, realisations=True)


def test_distortion_and_partial_coherence_survive_the_file(rng: np.random.Generator, tmp_path: Path) -> None:
    response = measure([recording(rng, 0.05, 1e-3) for _ in range(2)], SETTINGS)
    write_response(tmp_path / "a.frf.parquet", response, Header("frf", {}, inputs=()))
    again = read_response(tmp_path / "a.frf.parquet")
    np.testing.assert_array_equal(again.distortion, response.distortion)
    assert again.partial_coherence is None and again.line_correlation == ()
    runs = [recording(rng, 0.0, 0.1, force, (X, Y)) for force in FORCES]
    response = measure(runs, FrfSettings(excitation="random", block=0.5))
    write_response(tmp_path / "b.frf.parquet", response, Header("frf", {}, inputs=()))
    again = read_response(tmp_path / "b.frf.parquet")
    np.testing.assert_array_equal(again.partial_coherence, response.partial_coherence)
    assert again.line_correlation == response.line_correlation and len(again.line_correlation) >= 2
    # Each force in its own recording: the other's power is taken out, so what is left is the noise.
    assert np.median(again.partial_coherence) > np.median(again.coherence)


@pytest.mark.parametrize("single", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_resonance_that_follows_the_phases_scatters_by_what_its_interval_says(single: bool) -> None:
    """Closed form of 2 kg on a spring that scatters by 0.4 % from realisation to realisation: all lines of a
    resonance move together. 95 % intervals of six hold the mean stiffness in 33 of 40 draws or more: by the
    binomial distribution fewer have a chance of 0.0007. Single periods do not tell their noise.
    """
    rng, lines, held = np.random.default_rng(5), np.arange(20.0, 45.0, 0.5), 0
    w = 2 * np.pi * lines
    ports = (Port("x", "x", "x"),), (Port("f", "f", "x"),)
    for _ in range(40):
        runs = []
        for stiffness in 8e4 * (1 + 0.004 * rng.normal(size=6)):
            matrix = 1 / (stiffness - 2 * w**2 + 40j * w)
            noise = 1e-7 * (rng.normal(size=(2, w.size)).T @ [1, 1j])
            covariance = np.full((w.size, 1, 1), 2e-14)
            known = None if single else covariance
            runs.append(FrequencyResponse(lines, (matrix + noise)[:, None, None], *ports, covariance=known))
        (fit,) = identify(robust_mean(runs, 5), FitSettings("sdof", mass=2.0))
        low, high = fit.parameter("k").ci95 or (0.0, 0.0)
        held += low <= 8e4 <= high
    assert held >= 33


def test_lines_that_some_realisations_lack_are_left_out(rng: np.random.Generator) -> None:
    """A weak line stands out of the force's noise by chance; what most lines differ in is another signal."""
    lines = np.arange(20.0, 45.0, 0.5)
    ports = (Port("x", "x", "x"),), (Port("f", "f", "x"),)

    def one(chosen: np.ndarray) -> FrequencyResponse:
        noise = rng.normal(size=(2, chosen.size)).T @ [1, 1j]
        return FrequencyResponse(
            chosen, noise[:, None, None], *ports, covariance=np.full((chosen.size, 1, 1), 2.0)
        )

    mean = robust_mean([one(lines), one(np.delete(lines, 3)), one(np.delete(lines, 7))], 2)
    np.testing.assert_array_equal(mean.frequency, np.delete(lines, [3, 7]))
    assert mean.matrix.shape[0] == mean.covariance.shape[0] == lines.size - 2
    with pytest.raises(DataError, match="of 50 lines of realisation 1 only 20 are in all others"):
        robust_mean([one(lines), one(lines[:20])], 2)

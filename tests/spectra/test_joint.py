"""FRFs of closed loops by their reference: against the loop's own algebra, and on the virtual levitated
rotor.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.errors import ConfigError, DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.magnetic_bearing.levitated_loop import LevitatedRig, rotor_receptance
from labpipe.project.simulate import load_virtual_rig
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.convert import convert, directional
from labpipe.spectra.covariance import covariance_of_periodic
from labpipe.spectra.joint import covariance_by_neighbours, joint_estimate
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

CONFIGS = Path(__file__).parents[2] / "configs"
BAND = (10.0, 300.0)
RANDOM = FrfSettings("random", block=1.0, band=BAND, reference=("r_x",))
PERIODIC = FrfSettings("periodic", period=1.0, band=BAND, reference=("r_x",), skip=0)


def rig(axes: str = "x", **noise: float) -> LevitatedRig:
    shipped = load_virtual_rig(CONFIGS / "virtual-levitated.yaml")
    assert isinstance(shipped, LevitatedRig)
    cross = shipped.cross_stiffness if axes == "xy" else 0.0
    return replace(
        shipped, axes=axes, cross_stiffness=cross, force_recorded=True, noise=replace(shipped.noise, **noise)
    )


@lru_cache
def runs(names: tuple[str, ...], axes: str = "x", disturbance: float = 8.0) -> tuple[Recording, ...]:
    return recordings(rig(axes, disturbance=disturbance), 1, names)


def coverage(response: FrequencyResponse, exact: np.ndarray) -> float:
    """Share of the real and imaginary parts of all lines and elements in their 95 % intervals."""
    assert response.variance is not None
    apart = ((response.matrix - exact) / np.sqrt(response.variance / 2)).ravel()
    return float(np.mean(np.abs([apart.real, apart.imag]) < 1.96))


def loop_spectra(g: np.ndarray, c: np.ndarray, s_r: np.ndarray, s_v: np.ndarray) -> np.ndarray:
    """Exact spectra (n_line, 3 n, 3 n) of r, u, y in u = r - C y, y = G u + v, by the loop's algebra."""
    eye = np.broadcast_to(np.eye(g.shape[1]), g.shape)
    by_r = np.linalg.inv(eye + c @ g)
    by_v = np.linalg.inv(eye + g @ c)
    rows = ((eye, 0 * eye), (by_r, -c @ by_v), (g @ by_r, by_v))
    parts = np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1)
    driving = np.zeros((g.shape[0], 2 * g.shape[1], 2 * g.shape[1]), complex)
    n = g.shape[1]
    driving[:, :n, :n], driving[:, n:, n:] = s_r, s_v
    return parts @ driving @ parts.conj().swapaxes(1, 2)


def drawn(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.standard_normal((7, n, n)) + 1j * rng.standard_normal((7, n, n))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_exact_spectra_of_a_loop_give_its_plant(n: int, rng: np.random.Generator) -> None:
    """G to rounding, of any plant, controller, and correlated references and disturbances.

    W = v is what is left.
    """
    g, c = drawn(rng, n), drawn(rng, n)
    s_r, s_v = (a @ a.conj().swapaxes(1, 2) for a in (drawn(rng, n), drawn(rng, n)))
    estimate = joint_estimate(loop_spectra(g, c, s_r, s_v), [f"r{i}" for i in range(n)], n, 1e6)
    np.testing.assert_allclose(estimate.matrix, g, rtol=1e-7)
    residual = np.concatenate([-g, np.broadcast_to(np.eye(n), g.shape)], axis=2)
    left = residual @ estimate.noise @ residual.conj().swapaxes(1, 2)
    np.testing.assert_allclose(left * 1e6, s_v, rtol=1e-4, atol=1e-4)


def test_the_covariance_is_that_of_the_loop(rng: np.random.Generator) -> None:
    """cov(G_oi, G_pj) = S_ww[o, p] (S_ur^-H S_rr S_ur^-1)[j, i] / n, of G that is smooth over the lines."""
    g, c = (np.repeat(drawn(rng, 2)[:1], 7, axis=0) for _ in range(2))
    s_r, s_v = (a @ a.conj().swapaxes(1, 2) for a in (drawn(rng, 2), drawn(rng, 2)))
    spectra = loop_spectra(g, c, s_r, s_v)
    estimate = joint_estimate(spectra, ["r1", "r2"], 2, 1e5)
    covariance = covariance_by_neighbours(
        np.arange(7.0), estimate.matrix, estimate.columns, [estimate.noise] * 2
    )
    s_ur = spectra[:, 2:4, :2]
    spread = np.linalg.inv(s_ur).conj().swapaxes(1, 2) @ s_r @ np.linalg.inv(s_ur)
    expected = np.einsum("lop,lji->loipj", s_v, spread).reshape(7, 4, 4) / 1e5
    np.testing.assert_allclose(covariance, expected, rtol=1e-3, atol=1e-3 * np.max(np.abs(expected)))


def open_loop_limit(of: LevitatedRig, frequency: np.ndarray) -> np.ndarray:
    """(G |A|^2 S_r - L* S_v) / (|A|^2 S_r + |L|^2 S_v) of the rig, by hand: u = A r - L y, L = A C.

    A holds, delays and amplifies.
    """
    s = 2j * np.pi * frequency
    late = np.exp(-s * 1e-4) * (1 - np.exp(-s * 1e-4)) / (s * 1e-4)
    amplified = 80 * late / (1 + s / (2 * np.pi * 2000))
    fast = 2e4 * np.tanh(s / 2e4)
    controlled = amplified * (5e3 + 12 * fast / (1 + 2e-4 * fast) + 2e4 / fast)
    g = rotor_receptance(of, frequency)[:, 0, 0]
    s_r, s_v = (
        of.injection.rms**2 / 495,
        np.abs(g) ** 2 * of.noise.disturbance**2 / 1000 + of.noise.displacement**2 / 1000,
    )
    power = np.abs(amplified) ** 2 * s_r + np.abs(controlled) ** 2 * s_v
    return np.asarray((g * np.abs(amplified) ** 2 * s_r - controlled.conj() * s_v) / power)


def test_h1_is_biased_by_what_the_loop_says_and_the_reference_is_not() -> None:
    """H1 beside the joint FRF meets its limit, 10-60 % beside the plant here.

    The joint FRF meets the plant within its noise.
    """
    response = measure(runs(("random",)), RANDOM)
    exact = rotor_receptance(rig(), response.frequency)
    limit = open_loop_limit(rig(disturbance=8.0), response.frequency)
    assert response.open_loop is not None and response.variance is not None
    apart = np.abs(limit / exact[:, 0, 0] - 1)
    assert np.median(apart[:100]) > 0.08
    noise = np.sqrt(response.variance[:, 0, 0])
    # H1 scatters no more than the joint FRF: 291 lines meet the limit together far better than they meet the
    # plant.
    to_limit, to_plant = (
        np.mean(np.abs(response.open_loop[:, 0, 0] - h) ** 2 / noise**2) for h in (limit, exact[:, 0, 0])
    )
    assert to_limit < 1.1 and to_plant > 1.5
    assert coverage(response, exact) == pytest.approx(0.95, abs=0.025)


@pytest.mark.parametrize(("seconds", "told"), [(3.5, False), (12.0, True)])
def test_halves_too_short_for_the_noise_of_an_frf_are_not_held_against_each_other(
    seconds: float, told: bool
) -> None:
    """Blocks of 1 s that overlap by half: 1.9 effective averages in half of 3.5 s, about ten in half of 12 s;
    one reference needs 3.
    """
    (recording,) = runs(("random",))
    short = replace(recording, samples=recording.samples[: round(seconds * recording.sample_rate)])
    assert (measure([short], RANDOM).change is not None) is told


def test_a_rotor_left_alone_shows_minus_the_inverse_of_its_controller() -> None:
    """Without injection H1 = -1 / (A C), here to 3 % over 10-300 Hz.

    Labpipe's own H1 of the run without excitation.
    """
    (rest,) = runs(("rest",))
    response = measure([rest], FrfSettings("random", block=1.0, band=BAND))
    still = replace(rig(), injection=replace(rig().injection, rms=1e-12))
    limit = open_loop_limit(still, response.frequency)
    assert np.median(np.abs(response.matrix[:, 0, 0] / limit - 1)) < 0.03


@pytest.mark.long
def test_two_axes_by_two_references() -> None:
    """The 2 x 2 FRF of the coupled axes meets the rig's matrices within its covariance.

    Without references it does not.
    """
    settings = replace(RANDOM, reference=("r_x", "r_y"))
    both = measure(runs(("random",), "xy"), settings)
    exact = rotor_receptance(rig("xy"), both.frequency)
    assert coverage(both, exact) == pytest.approx(0.95, abs=0.02)
    assert coverage(measure(runs(("random",), "xy"), replace(settings, reference=())), exact) < 0.85
    # One axis at a time, silent in the other: the same from two recordings.
    single = measure(runs(("random-x", "random-y"), "xy"), settings)
    assert coverage(single, exact) == pytest.approx(0.95, abs=0.02)


def test_periods_in_a_loop_need_no_other_average() -> None:
    """Multisine on either axis: the mean over periods with the covariance of forces and responses together
    holds the rig's matrices.
    """
    settings = replace(PERIODIC, reference=("r_x", "r_y"))
    response = measure(runs(("multisine-x", "multisine-y"), "xy"), settings)
    exact = rotor_receptance(rig("xy"), response.frequency)
    assert coverage(response, exact) == pytest.approx(0.955, abs=0.02)
    assert response.open_loop is not None
    assert coverage(replace(response, matrix=response.open_loop), exact) < 0.9


@pytest.mark.parametrize(("names", "settings"), [(("random",), RANDOM), (("multisine-x",), PERIODIC)])
def test_a_mass_in_a_loop_gives_its_stiffness(names: tuple[str, ...], settings: FrfSettings) -> None:
    """k = -200 kN/m and c = 100 N.s/m within 3 standard errors; H1 is many away.

    Negative stiffness is not a fault where a loop holds it.
    """
    response = measure(runs(names), settings)
    (fit,) = identify(response, FitSettings("sdof", mass=4.0))
    (naive,) = identify(measure(runs(names), replace(settings, reference=())), FitSettings("sdof", mass=4.0))
    for name, true in (("k", -2e5), ("c", 100.0)):
        parameter = fit.parameter(name)
        assert parameter.std_error is not None
        assert abs(parameter.value - true) < 3 * parameter.std_error
    if settings is RANDOM:
        assert naive.parameter("k").value < -2.1e5
    assert "unphysical" not in [finding.code for finding in fit.findings]
    assert [finding.level for finding in fit.findings if finding.code == "closed-loop"] == ["note"]


def test_what_repeats_without_the_reference_is_left_out() -> None:
    """A hum of whole periods in force and response has no line in the reference: the loop's answer to it is
    not the rotor's.
    """
    (run,) = runs(("multisine-x",))
    sparse = replace(rig(disturbance=8.0), injection=replace(rig().injection, spacing=10.0, periods=200))
    (run,) = recordings(sparse, 1, ["multisine-x"])
    t = np.arange(run.n_sample) / run.sample_rate
    hum = np.cos(2 * np.pi * 55 * t)[:, None] * [20.0, 4e-5, 0.0]
    humming = replace(run, samples=run.samples + hum)
    settings = replace(PERIODIC, period=0.2, band=(10.0, 200.0))
    np.testing.assert_allclose(measure([humming], settings).frequency, np.arange(10.0, 201.0, 10.0))
    assert 55.0 in measure([humming], replace(settings, reference=())).frequency


def test_more_references_than_forces_are_used_together() -> None:
    """A second reference that adds independent noise of its own changes the FRF within its error."""
    (run,) = runs(("random",))
    extra = np.random.default_rng(2).standard_normal((run.n_sample, 1)) * 0.1
    more = replace(
        run,
        channels=(*run.channels, Channel("r_2", "current", "reference", "2")),
        samples=np.hstack([run.samples, extra]),
    )
    one, two = measure([run], RANDOM), measure([more], replace(RANDOM, reference=("r_x", "r_2")))
    assert one.variance is not None
    assert np.median(np.abs(one.matrix - two.matrix) ** 2 / one.variance) < 0.3
    assert two.covariance_dof == pytest.approx(one.covariance_dof - 1)


@pytest.mark.long
def test_h1_travels_beside_the_frf(tmp_path: Path) -> None:
    """Through file, conversion and directional terms as the FRF itself does."""
    response = measure(runs(("random",), "xy"), replace(RANDOM, reference=("r_x", "r_y")))
    assert response.open_loop is not None
    write_response(tmp_path / "a.frf.parquet", response, Header("frf", {}, inputs=()))
    read = read_response(tmp_path / "a.frf.parquet")
    np.testing.assert_array_equal(read.open_loop, response.open_loop)
    as_matrix = replace(response, matrix=response.open_loop)
    np.testing.assert_allclose(convert(response, "mobility").open_loop, convert(as_matrix, "mobility").matrix)
    np.testing.assert_allclose(directional(response).open_loop, directional(as_matrix).matrix)


def silent(run: Recording, column: int, values: float | np.ndarray = 0.0) -> Recording:
    samples = run.samples.copy()
    samples[:, column] = values
    return replace(run, samples=samples)


def test_what_is_no_reference_is_said() -> None:
    (run,) = runs(("random",))
    (two,) = runs(("random",), "xy")
    noise = np.random.default_rng(3).standard_normal(run.n_sample)
    with pytest.raises(ConfigError, match="'r_z' is not a channel"):
        measure([run], replace(RANDOM, reference=("r_z",)))
    with pytest.raises(ConfigError, match="'f_x' is a force of the FRF; the reference is injected"):
        measure([run], replace(RANDOM, reference=("f_x",)))
    with pytest.raises(DataError, match="r_x is silent"):
        measure([silent(run, 2)], RANDOM)
    with pytest.raises(DataError, match="does not move the force f_x beyond its noise"):
        measure([silent(run, 2, noise)], RANDOM)
    with pytest.raises(DataError, match=r"2 forces \(f_x, f_y\) need as many references"):
        measure([two], RANDOM)
    with pytest.raises(DataError, match="r_x, r_y are not independent"):
        measure([silent(two, 5, two.samples[:, 4])], replace(RANDOM, reference=("r_x", "r_y")))
    with pytest.raises(DataError, match="too few for the noise of an FRF by references"):
        measure([run], replace(RANDOM, block=10.0))
    (sines,) = runs(("multisine-x",))
    with pytest.raises(DataError, match="no line of the reference r_x exceeds its noise"):
        measure([silent(sines, 2, noise[: sines.n_sample])], PERIODIC)
    lacking = replace(run, channels=(*run.channels[:2], replace(run.channels[2], name="r_q")))
    with pytest.raises(DataError, match="has none of the references r_x"):
        measure([run, lacking], RANDOM)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"estimator": "H2"}, "joint input-output method, not by H2"),
        ({"local": "polynomial"}, "takes the loop as open"),
        (
            {"excitation": "impact"},
            "'reference' is not for impact excitation; leave it out; excitations "
            "that take it: periodic, random",
        ),
    ],
)
def test_keys_that_no_loop_has(other: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        replace(RANDOM, **other)


def test_the_covariance_of_a_line_does_not_know_its_error(rng: np.random.Generator) -> None:
    """Errors of lines weighted by 1 / variance have no mean; with the plain estimate they have that of the
    loop's cross-spectrum.

    Closed form of the second: twice C_wu / |U|^2 of the error w / U, for E(w u*) = C_wu, E|w|^2 = C_ww, of a
    constant G.
    """
    n, g = 40000, np.full((40000, 1, 1), 1 + 0j)
    w = (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / np.sqrt(2) * 0.2
    force = 1 - 0.8 * w
    vectors = np.stack([force, g[:, 0, 0] * force + w], axis=1)[:, :, None]
    noise = np.repeat((0.04 * np.array([[0.64, -0.8 + 0.64], [-0.8 + 0.64, 0.04]]))[None], n, axis=0).astype(
        complex
    )
    noise[:, 1, 1] = 0.04 * (1 - 0.8) ** 2
    matrix = (vectors[:, 1] / vectors[:, 0])[:, :, None]
    means = []
    for covariance in (
        covariance_by_neighbours(np.arange(float(n)), matrix, vectors, [noise]),
        covariance_of_periodic(matrix, 1 / vectors[:, :1], noise[None]),
    ):
        weight = 1 / covariance[:, 0, 0].real
        means.append(np.sum(weight * (matrix[:, 0, 0] - 1)) / np.sum(weight))
    assert abs(means[0]) < 0.004
    assert means[1].real == pytest.approx(2 * -0.8 * 0.04, rel=0.25)


def test_a_sharp_resonance_keeps_the_noise_of_its_own_lines(rng: np.random.Generator) -> None:
    """One mode 2 Hz wide on lines every 1 Hz, noise s of the force: var H = |H|^2 4 s^2 / (N n |U|^2). At the
    peak a thousandth of it was stated, as a straight line through the lines around tells |H| there.
    """
    n, n_period, s, lines = 400, 40, 0.05, np.arange(20, 120)
    spectrum = np.zeros(n // 2 + 1, complex)
    spectrum[lines] = n / 2 * np.exp(1j * rng.uniform(0, 2 * np.pi, lines.size))
    f = np.arange(n // 2 + 1)
    exact = 1 / (60.0**2 - f**2 + 2j * 0.0167 * 60 * f)
    drive, motion = (np.tile(np.fft.irfft(part), n_period) for part in (spectrum, exact * spectrum))
    force = drive + s * rng.normal(size=drive.size)
    channels = [
        Channel(name, quantity, role, "x", 0.0)
        for name, quantity, role in (
            ("r", "voltage", "reference"), ("f", "force", "input"), ("y", "displacement", "output"),
        )
    ]  # fmt: skip
    run = Recording(tuple(channels), np.column_stack([drive, force, motion]), float(n), "run")
    found = measure([run], FrfSettings("periodic", period=1.0, skip=0, reference=("r",)))
    true = np.abs(exact[lines]) ** 2 * 4 * s**2 / (n * n_period)
    assert found.frequency.tolist() == lines.tolist()
    ratio = found.variance[:, 0, 0] / true
    assert np.all(ratio[np.abs(lines - 60) < 4] == pytest.approx(1.0, abs=0.3))


def test_noise_that_grows_with_the_level_of_a_recording_counts_where_it_acts(
    rng: np.random.Generator,
) -> None:
    """A recording and ten times itself: with shares w of the power the variance of S_yr / S_rr is that of the
    one times sum w^2 = (1 + 10^4) / 101^2; equal noise in both would give half of it.
    """
    r, v, w = rng.standard_normal((3, 64 * 64))
    channels = tuple(
        Channel(name, quantity, role, "x")
        for name, quantity, role in (
            ("r", "voltage", "reference"),
            ("u", "force", "input"),
            ("y", "displacement", "output"),
        )
    )
    samples = np.column_stack([r, r + 0.2 * w, r + w + v])
    settings = FrfSettings("random", block=1.0, overlap=0.0, reference=("r",), band=(3.0, 29.0))
    one, both = (
        measure([Recording(channels, level * samples, 64.0) for level in levels], settings).variance
        for levels in ((1.0,), (1.0, 10.0))
    )
    assert one is not None and both is not None
    assert np.median(both / one) == pytest.approx(10001 / 101**2, rel=0.06)

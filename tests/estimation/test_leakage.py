"""Leakage of random data in the model and in its scatter, against the lag domain, drawn white noise and sums
written out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import ConfigError, DataError
from labpipe.estimation.diagnostics import leakage_findings
from labpipe.estimation.estimators import LS
from labpipe.estimation.fitting import identify
from labpipe.estimation.leakage import SmearedModel, leaking_noise
from labpipe.estimation.linear_models import sdof
from labpipe.estimation.measured import Measured, measured_part
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import FitSettings
from labpipe.project.ready_response import load_described
from labpipe.project.tests import ReadyFrf
from labpipe.records.finding import Finding
from labpipe.records.frf_layout import ElementColumns, FrfColumns, FrfLayout, WindowedSettings
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import Blocks, FrequencyResponse, Port, diagonal_covariance
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.windows import kernel_of, window_values

# 1 kg at 60 Hz, half-power width 1.2 Hz.
W_N, WIDTH = 2 * np.pi * 60.0, 1.2
STIFFNESS, DAMPING = W_N**2, 2 * np.pi * WIDTH
PORTS = (Port("x", "x", "x", 0.0),), (Port("f", "f", "x", 0.0),)
SETTINGS = FitSettings("sdof", mass=1.0)


# Blocks of 8 s in an analyser's table, 9.6 lines in the half-power width, and samples per second.
TABLE_BLOCK, TABLE_RATE = 8, 256
TABLE = FrfColumns(frequency="1", re="2", im="3", coherence="4")


RANDOM: dict[str, Any] = {"excitation": "random", "overlap": 0.5}


def table(path: Path, seed: int, number: int = 40, noise: float = 0.05) -> None:
    """H1 and coherence by scipy.signal of white force and its response, with *noise*: *number* Hann blocks
    that overlap by half. The response to the whole period of a force of twice the length is that of a rig at
    work.
    """
    rng, n = np.random.default_rng([seed, 5]), TABLE_BLOCK * TABLE_RATE
    used, whole = (number + 1) * n // 2, (number + 1) * n
    force = np.fft.rfft(rng.normal(size=whole))
    # Nothing near half the sampling rate, where a record at rest has no receptance of its own.
    force[int(0.9 * force.size) :] = 0.0
    h = receptance(np.fft.rfftfreq(whole, 1 / TABLE_RATE))[:, 0, 0]
    f, x = (np.fft.irfft(spectrum, whole)[:used] for spectrum in (force, h * force))
    x += noise * x.std() * rng.normal(size=used)
    kept = {"fs": TABLE_RATE, "nperseg": n, "noverlap": n // 2}
    frequency, cross = signal.csd(f, x, **kept)
    h1 = cross / signal.welch(f, **kept)[1]
    inside = (frequency > 50) & (frequency < 70)
    coherence = signal.coherence(f, x, **kept)[1]
    np.savetxt(path, np.column_stack([frequency, h1.real, h1.imag, coherence])[inside])


def of_table(path: Path, **stated: Any) -> FrequencyResponse:
    layout = FrfLayout(file=path.name, columns=TABLE, form="receptance", **{"window": "hann", **stated})
    return load_described(ReadyFrf((path,), layout, (("x",),), (("f",),)), layout, "", {})


def errors_of_tables(folder: Path, **stated: Any) -> np.ndarray:
    """Errors of the damping ratio of eight tables, over their standard errors [1]."""
    off = []
    for seed in range(8):
        table(folder / "h.txt", seed)
        zeta = identify(of_table(folder / "h.txt", **stated), SETTINGS)[0].parameter("zeta")
        assert zeta.std_error is not None
        off.append((zeta.value - DAMPING / 2 / W_N) / zeta.std_error)
    return np.array(off)


def of_two_masses(order: tuple[int, ...]) -> FrequencyResponse:
    """Two masses under white forces of unlike size, with noise of unlike size on the responses, and the
    channels in an *order*.
    """
    rng, n, rate = np.random.default_rng(5), 1 << 15, 512.0
    forces = np.array([[1.0], [3.0]]) * rng.normal(size=(2, 2 * n))
    s = 2j * np.pi * np.fft.rfftfreq(2 * n, 1 / rate)
    stiffness, damping = np.array([[3e5, -1e5], [-1e5, 2.5e5]]), np.array([[65.0, -20.0], [-20.0, 58.0]])
    inverse = stiffness + s[:, None, None] * damping + s[:, None, None] ** 2 * np.diag([1.0, 2.0])
    spectra = np.einsum("kij,jk->ik", np.linalg.inv(inverse), np.fft.rfft(forces))
    motion = np.fft.irfft(spectra, 2 * n)[:, :n]
    motion += np.array([[0.05], [0.2]]) * motion.std(axis=1, keepdims=True) * rng.normal(size=motion.shape)
    channels = [Channel(f"f{i}", "force", "input", f"p{i}") for i in order]
    channels += [Channel(f"x{i}", "displacement", "output", f"p{i}") for i in order]
    samples = np.column_stack([*forces[list(order), :n], *motion[list(order)]])
    return measure([Recording(tuple(channels), samples, rate, "run")], FrfSettings("random", block=2.0))


def test_the_order_of_the_channels_is_none_of_the_data() -> None:
    """Of the same samples the errors are the same, whichever force or response comes first."""
    errors = []
    for order in ((0, 1), (1, 0)):
        masses = tuple((1.0, 2.0)[i] for i in order)
        (fit,) = identify(of_two_masses(order), FitSettings("mdof", mass=masses, band=(20.0, 120.0)))
        every = [f"{letter}_p{i}_p{j}" for letter in "kc" for i in (0, 1) for j in (0, 1)]
        errors.append([fit.parameter(name).std_error for name in every])
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-6)


def test_fewer_lines_than_share_their_leakage_are_fitted() -> None:
    """Of lines every 0.5 Hz a Hann window ties two on either side together; 8 equations a line."""
    (fit,) = identify(of_two_masses((0, 1)), FitSettings("mdof", mass=(1.0, 2.0), band=(70.0, 70.5)))
    assert (fit.lines, fit.equations) == (2, 16) and [f.code for f in fit.findings if f.code == "few-lines"]


@pytest.mark.parametrize("averages", [40, 0])
def test_leakage_of_an_analyser_s_random_blocks_is_in_the_model(tmp_path: Path, averages: int) -> None:
    """Eight errors of unit variance have a mean within .7 and a mean square of .27 to 2.2 in 95 of 100."""
    off = errors_of_tables(tmp_path, averages=averages, **RANDOM)
    assert abs(np.mean(off)) < 0.7 and 0.27 < np.mean(off**2) < 2.2


def test_responses_of_one_record_share_what_leaks(tmp_path: Path) -> None:
    """One response written twice, hardly any noise: the damping is known no better than by one of them."""
    table(tmp_path / "h.txt", 1, noise=0.002)
    both = tmp_path / "both.txt"
    np.savetxt(both, np.loadtxt(tmp_path / "h.txt")[:, [0, 1, 2, 3, 1, 2, 3]])
    elements = tuple(
        (f"p{n}/f", ElementColumns(re=f"{3 * n + 2}", im=f"{3 * n + 3}", coherence=f"{3 * n + 4}"))
        for n in range(2)
    )
    stated = {"form": "receptance", "window": "hann", "averages": 40, **RANDOM}
    layout = FrfLayout(file="both.txt", columns=FrfColumns(frequency="1"), elements=elements, **stated)
    responses = (
        of_table(tmp_path / "h.txt", averages=40, **RANDOM),
        load_described(ReadyFrf((both,), layout, ((),), ((),)), layout, "", {}),
    )
    one, two = (
        identify(response, FitSettings("modal"))[0].parameter("zeta_1").std_error for response in responses
    )
    assert one is not None and two == pytest.approx(one, rel=0.1)


def test_unsaid_it_makes_the_damping_too_large(tmp_path: Path) -> None:
    """A Hann window adds some .5 % at ten lines in the half-power width; a standard error is .2 %. The
    coherence falls at the peak.
    """
    assert np.mean(errors_of_tables(tmp_path, averages=40)) > 1.4
    (leaking,) = of_table(tmp_path / "h.txt").findings
    assert leaking.code == "leakage" and "coherence falls at the peak at" in leaking.message
    assert not of_table(tmp_path / "h.txt", excitation="random").findings


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_the_response_hides_no_leakage_at_a_peak(tmp_path: Path, seed: int) -> None:
    """It lowers the coherence beside the peak: 1 - coherence rises less there than by leakage alone."""
    table(tmp_path / "h.txt", seed, noise=0.15)
    assert [f.code for f in of_table(tmp_path / "h.txt").findings] == ["leakage"]


def test_coherence_of_hits_falls_nowhere(tmp_path: Path) -> None:
    """Five hits with noise of response and force, and gains that differ by 3 %: none of 20 tables."""
    frequency = np.arange(50 * TABLE_BLOCK, 70 * TABLE_BLOCK) / TABLE_BLOCK
    h = receptance(frequency)[:, 0, 0]
    for seed in range(20):
        rng = np.random.default_rng([seed, 9])
        noise = rng.normal(size=(3, 5, h.size, 2)) @ np.array([1, 1j]) / np.sqrt(2)
        f, x = 1 + 0.03 * noise[0], h * (1 + 0.03 * noise[1]) + 0.02 * np.abs(h).mean() * noise[2]
        cross, of_f = np.mean(x * f.conj(), axis=0), np.mean(np.abs(f) ** 2, axis=0)
        coherence = np.abs(cross) ** 2 / of_f / np.mean(np.abs(x) ** 2, axis=0)
        columns = [frequency, (cross / of_f).real, (cross / of_f).imag, coherence]
        np.savetxt(tmp_path / "h.txt", np.column_stack(columns))
        assert not of_table(tmp_path / "h.txt").findings, seed


@pytest.mark.parametrize(
    ("lines", "stated", "fault"),
    [
        ((50.0, 50.1, 50.2, 50.35), {}, r"h\.txt: has lines that are not multiples of their distance"),
        ((50.0,), {}, "has one line, which tells no length of blocks"),
        ((50.0, 50.1), {"averages": 2, "overlap": 0.9}, "is of 1.1 independent averages by its `averages`"),
        ((50.0, 50.1), {"window": ""}, "leaks through the window of their blocks.* window: hann beside it"),
        ((50.0, 50.1), {"windowed": WindowedSettings(exponential=1.0)}, "and no 'windowed'"),
        ((50.0, 50.1), {"excitation": ""}, "'overlap' is that of blocks of random data.*excitation: random"),
        ((50.0, 50.1), {"overlap": 1.0}, "at least 0 and below 100 %"),
    ],
)
def test_blocks_that_cannot_be_meant(
    tmp_path: Path, lines: tuple[float, ...], stated: dict[str, Any], fault: str
) -> None:
    (tmp_path / "h.txt").write_text("".join(f"{line} 1 0 0.9\n" for line in lines))
    with pytest.raises((ConfigError, DataError), match=fault):
        of_table(tmp_path / "h.txt", **{**RANDOM, **stated})


def receptance(frequency: np.ndarray) -> np.ndarray:
    w = 2 * np.pi * frequency
    return (1 / (STIFFNESS - w**2 + 1j * w * DAMPING))[:, None, None]


def in_lag_domain(frequency: np.ndarray, length: float, window: str) -> np.ndarray:
    """Fourier integral of h(t) r(t), h = exp(-c t / 2) sin(w_d t) / w_d and r the window's autocorrelation
    over its energy.
    """
    n = 4096
    values = window_values(window, n)
    r = np.correlate(values, values, "full")[n - 1 :] / np.dot(values, values)
    t = np.arange(n) * length / n
    w_d = np.sqrt(STIFFNESS - DAMPING**2 / 4)
    h = np.exp(-DAMPING / 2 * t) * np.sin(w_d * t) / w_d
    return np.array([np.trapezoid(h * r * np.exp(-2j * np.pi * f * t), t) for f in frequency])[:, None, None]


def response(length: float, window: str = "hann", estimator: str = "H1") -> FrequencyResponse:
    """The expected H1 of 60 blocks on the lines of 40-80 Hz, with a covariance of 1 % of the peak."""
    frequency = np.arange(int(40 * length), int(80 * length) + 1) / length
    matrix = in_lag_domain(frequency, length, window)
    covariance = diagonal_covariance(np.full(matrix.shape, (0.01 * np.abs(matrix).max()) ** 2))
    blocks = Blocks(length, window, 0.5, 60, estimator)
    more = {
        "covariance": covariance,
        "averages": 57.0,
        "covariance_dof": 56.0,
        "line_correlation": (0.45, 0.03),
        "blocks": blocks,
    }
    return FrequencyResponse(frequency, matrix, *PORTS, **more)


def part(whole: FrequencyResponse, every: int = 1) -> Measured:
    return measured_part(whole, [0], [0], np.arange(whole.n_frequency) % every == 0)


def model() -> object:
    return sdof(Setup(*PORTS, SETTINGS))


@pytest.mark.parametrize("window", ["hann", "hamming", "blackman"])
@pytest.mark.parametrize("lines", [1.0, 2.0, 6.0])
def test_the_expected_response_is_that_of_the_lag_domain(window: str, lines: float) -> None:
    whole = response(lines / WIDTH, window)
    measured = part(whole)
    smeared = SmearedModel(model(), measured.leakage).receptance(
        np.array([STIFFNESS, DAMPING]), measured.omega
    )
    size = np.abs(whole.matrix).max()
    np.testing.assert_allclose(smeared, whole.matrix, atol=0.005 * size)
    assert np.abs(receptance(whole.frequency) - whole.matrix).max() > 2 * 0.005 * size


def test_its_derivatives_are_those_of_differences() -> None:
    measured = part(response(2.0), every=3)
    smeared, values = SmearedModel(model(), measured.leakage), np.array([STIFFNESS, DAMPING])
    for number, step in enumerate(values * 1e-5):
        moved = np.eye(2)[number] * step
        difference = smeared.receptance(values + moved, measured.omega) - smeared.receptance(
            values - moved, measured.omega
        )
        exact = smeared.jacobian(values, measured.omega)[number]
        np.testing.assert_allclose(difference / (2 * step), exact, atol=1e-5 * np.abs(exact).max())


@pytest.mark.parametrize("form", ["receptance", "accelerance"])
def test_damping_is_the_true_one_though_blocks_are_short(form: str) -> None:
    whole = response(2.0 / WIDTH)
    if form == "accelerance":
        # Leakage of what was measured, not of the receptance: the window multiplies the impulse response of
        # the acceleration.
        fine = np.arange(-96, 97) / 4
        kernel = kernel_of(whole.blocks)
        points = whole.frequency[:, None] + kernel.offsets / (4 * whole.blocks.length)
        assert kernel.offsets.size <= fine.size
        accelerance = (
            receptance(points.reshape(-1))[:, 0, 0].reshape(points.shape) * (2j * np.pi * points) ** 2
        )
        whole = replace(
            whole, matrix=(accelerance @ kernel.weights)[:, None, None], form=form, covariance=None
        )
    (fit,) = identify(whole, SETTINGS)
    assert fit.parameter("c").value == pytest.approx(DAMPING, rel=2e-3)
    (plain,) = identify(replace(whole, blocks=None), SETTINGS)
    # Without the blocks leakage is a model error: the interval holds the damping, and is far wider.
    c, modelled = plain.parameter("c"), fit.parameter("c")
    assert c.ci95[0] < DAMPING < c.ci95[1] and c.interval.discrepancy > 3 * modelled.full_error


def blocks_of_white_noise(rng: np.random.Generator, n: int, n_block: int) -> np.ndarray:
    """H1 of *n_block* half overlapping Hann blocks of n samples, no noise, mode as in `receptance` at 512 Hz
    by its sampled response.
    """
    from scipy import signal

    rate = 512.0
    pole = np.exp((-DAMPING / 2 + 1j * np.sqrt(STIFFNESS - DAMPING**2 / 4)) / rate)
    force = rng.normal(size=4096 + n // 2 * (n_block + 1))
    output = signal.lfilter([0.0, pole.imag], [1.0, -2 * pole.real, abs(pole) ** 2], force)
    window = window_values("hann", n)
    cut = [
        np.fft.rfft(np.lib.stride_tricks.sliding_window_view(x[4096:], n)[:: n // 2] * window, axis=1)
        for x in (force, output)
    ]
    return np.sum(cut[1] * cut[0].conj(), axis=0) / np.sum(np.abs(cut[0]) ** 2, axis=0)


@pytest.mark.long
def test_leakage_scatters_as_predicted(rng: np.random.Generator) -> None:
    # 400 records of 40 blocks of 853 samples (two lines in the half-power width).
    n, n_block = 853, 40
    draws = np.array([blocks_of_white_noise(rng, n, n_block) for _ in range(400)])
    length = n / 512.0
    lines = np.arange(int(60 * length) - 4, int(60 * length) + 6)
    drawn = draws[:, lines] / (
        np.abs(draws[:, lines].mean(axis=0)).max()
        / np.abs(in_lag_domain(lines / length, length, "hann")).max()
    )
    drawn = drawn - drawn.mean(axis=0)
    # Noise far below the leakage; covariances as a long record would give them, so that those of the model
    # can be read off.
    matrix = receptance(lines / length)
    whole = FrequencyResponse(
        lines / length, matrix, *PORTS, covariance=diagonal_covariance(np.full(matrix.shape, 1e-18)),
        covariance_dof=37.0, averages=38.0,
        line_correlation=(0.45, 0.03), blocks=Blocks(length, "hann", 0.5, n_block, "H1"),
    )  # fmt: skip
    measured = part(whole)
    values = np.array([STIFFNESS, DAMPING])
    points = measured.leakage.points_of(model(), values)
    deviation = points - np.einsum("m,lmoi->loi", measured.leakage.kernel.weights, points)[:, None]
    apparent = np.einsum("m,lmoi->l", measured.leakage.kernel.weights, np.abs(deviation) ** 2) / 37.0
    noise = leaking_noise(measured, model(), values)
    weights = rng.normal(size=(lines.size, 1, 6)) + 1j * rng.normal(size=(lines.size, 1, 6))
    predicted = np.einsum("kap,kap->p", weights.conj(), noise.times(weights)).real
    sums = (np.einsum("kp,rk->rp", weights[:, 0].conj(), drawn / np.sqrt(apparent))).real
    # 400 records: 7 % on a variance.
    np.testing.assert_allclose(2 * sums.var(axis=0), predicted, rtol=0.3)
    # The residual's power alone, line by line, would tell more scatter.
    assert noise.trace < 0.9 * lines.size


FINDING_CASES = [
    ("ml", "H1", 1.0, 1.5),
    ("ml", "H1", 2.0, 0),
    ("ls", "H1", 3.0, 10),
    ("ml", "H2", 3.0, 10),
    ("ls", "H1", 12.0, 0),
]


@pytest.mark.parametrize(("estimator", "frf", "lines", "needed"), FINDING_CASES)
def test_short_blocks_are_said_with_the_length_that_would_do(
    estimator: str, frf: str, lines: float, needed: float
) -> None:
    (fit,) = identify(response(lines / WIDTH, estimator=frf), replace(SETTINGS, estimator=estimator))
    messages = [finding.message for finding in fit.findings if finding.code == "leakage"]
    assert len(messages) == bool(needed)
    for message in messages:
        assert "use blocks of at least" in message and "narrow" not in message
        # That many lines in the fitted half-power width c / (2 pi m), rounded up to two digits.
        length = needed / (fit.parameter("c").value / (2 * np.pi))
        assert length <= float(message.split("at least ")[1].split(" s")[0]) <= 1.1 * length


def test_a_mismatch_beside_short_blocks_advises_longer_ones() -> None:
    whole = response(1.0 / WIDTH, estimator="H2")
    whole = replace(whole, covariance=whole.covariance / 1e4)
    (fit,) = identify(whole, SETTINGS)
    (message,) = [finding.message for finding in fit.findings if finding.code == "model-mismatch"]
    assert (
        "leakage of the short blocks" in message and "longer blocks" in message and "or narrow" not in message
    )
    (other,) = identify(replace(whole, blocks=None), SETTINGS)
    assert "or narrow the band" in next(f.message for f in other.findings if f.code == "model-mismatch")


def test_nothing_is_said_without_a_mode_in_the_band() -> None:
    measured = part(response(1.0))
    matrices = model().whole(np.array([STIFFNESS, DAMPING]))
    assert [type(finding) for finding in leakage_findings(measured, matrices, LS)] == [Finding]
    assert not leakage_findings(measured, replace(matrices, stiffness=100 * matrices.stiffness), LS)
    assert not leakage_findings(measured, replace(matrices, damping=-matrices.damping), LS)
    assert not leakage_findings(measured, replace(matrices, mass=0 * matrices.mass), LS)
    assert not leakage_findings(replace(measured, blocks=None), matrices, LS)


@pytest.mark.parametrize("length", [3.0, 4.0, 8.0])
def test_modes_of_random_data_have_not_the_damping_of_their_window(length: float) -> None:
    """Of the expected H1 in the lag domain; of a half-power width of 4.8 lines it was 7 % too large."""
    (fit,) = identify(response(length), FitSettings("modal", band=(40.0, 80.0)))
    expected = {"f_n_1": W_N / (2 * np.pi), "zeta_1": DAMPING / (2 * W_N)}
    found = {name: fit.parameter(name).value for name in expected}
    assert found == pytest.approx(expected, rel=1e-5)

"""Certificates: margins and decrements of the fitted loop against its truth, coupled loops, verdicts,
refusals, report.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from labpipe.artefacts.json_file import entry_of, record_of
from labpipe.errors import ConfigError, FitError
from labpipe.methods.magnetic_bearing.certificate import _bent_amounts, certificate, loop_amounts
from labpipe.methods.magnetic_bearing.limits import LoopCertificateSettings, recorded_loop
from labpipe.methods.magnetic_bearing.loop import ControlLoop, margins
from labpipe.methods.magnetic_bearing.loop_fit import BENT, REACH
from labpipe.methods.magnetic_bearing.sensitivity import response_per_injection, sensitivity_matrix
from labpipe.methods.magnetic_bearing.stability import open_loop
from labpipe.methods.magnetic_bearing.transfer import CrossControl
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Goodness
from labpipe.records.recording import Channel
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import MatrixError, Uncertainty
from labpipe.report.comparison import comparison_blocks
from labpipe.report.document import Figure
from labpipe.uncertainty.compare import Evidence, compare
from labpipe.uncertainty.settings import CompareSettings, TheorySettings
from tests.methods.magnetic_bearing.certified import (
    FILE,
    FREQUENCY,
    LOOP,
    RATE,
    UNKNOWNS,
    drawn,
    response,
    with_gain,
)

OWN = {"displacement": "x", "current": "i", "rate": RATE, "zone": "A"}


def asked(**own: object) -> CompareSettings:
    theory = TheorySettings(bearing="bearing.yaml")
    return CompareSettings(
        kind="certificate",
        name="certificate",
        theory=theory,
        estimate=UNKNOWNS,
        kind_settings=LoopCertificateSettings(**{**OWN, **own}),
    )


def truth() -> dict[str, float]:
    """Margins by the open loop; the pole by the roots of 1 + L, Newton from nearby."""
    of = margins(lambda w: open_loop(FILE.suspension(), w, RATE).loop, RATE / 2 * (1 - 1e-9))
    s = -350.0 + 900.0j
    for _ in range(50):
        values = [
            1 + open_loop(FILE.suspension(), np.array([(s + d) / 1j]), RATE).loop[0] for d in (0.0, 1e-3)
        ]
        s -= values[0] * 1e-3 / (values[1] - values[0])
    return {
        "sensitivity_peak": of.peak,
        "gain_margin_lower": of.gain_lower,
        "gain_margin_upper": of.gain_upper,
        "phase_margin": of.phase,
        "log_decrement_1": -2 * np.pi * s.real / s.imag,
        "pole_real_1": s.real,
    }


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("slope", [2.0, -2.0])
def test_amounts_that_bend_within_the_errors_are_named(side: float, slope: float) -> None:
    """b = slope a + bend, straight but for one side of the estimate: at REACH standard errors, 2 x .1 of a,
    its departure is told from BENT of the way that a straight line goes, 2 x 2 x .1.
    """
    way = REACH * 0.1 * abs(slope)

    def at(values: dict[str, float]) -> dict[str, float]:
        aside = side * (values["a"] - 1) / (REACH * 0.1)
        return {f"b_{part}": slope * values["a"] + part * BENT * way * max(aside, 0.0) for part in (0.9, 1.1)}

    slopes, covariance = np.full((1, 2), slope), np.array([[0.01]])
    assert _bent_amounts(at, {"a": 1.0}, slopes, covariance) == ("b_1.1",)
    assert _bent_amounts(at, {"a": 1.0}, -slopes, covariance) == ("b_0.9", "b_1.1")
    assert _bent_amounts(at, {"a": 1.0}, slopes, 0 * covariance) == ()


@pytest.mark.long
def test_a_clean_recording_gives_the_truth() -> None:
    found = certificate(asked(), response(None, 1e-5), FILE)
    for name, value in truth().items():
        assert found.amount(name).value == pytest.approx(value, rel=1e-6)
    assert found.verdict == "accepted" and "over 99.9 %" in found.statement
    assert found.amount("negative_stiffness").value == pytest.approx(33106.0, rel=1e-6)


@pytest.mark.long
def test_gain_and_delay_of_the_recorded_excitation_do_not_count(rng: np.random.Generator) -> None:
    plain = response(rng, 0.02)
    seen = 0.5 * np.exp(-0.7j)
    assert plain.covariance is not None
    other = replace(plain, matrix=plain.matrix * seen, covariance=plain.covariance * abs(seen) ** 2)
    ours, theirs = (certificate(asked(), each, FILE) for each in (plain, other))
    for amount in ours.amounts:
        assert theirs.amount(amount.name).value == pytest.approx(amount.value, rel=1e-4)


@pytest.mark.long
def test_one_draw_holds_the_truth_and_counts_its_equations(rng: np.random.Generator) -> None:
    found = certificate(asked(), response(rng, 0.05), FILE)
    assert 0.85 < found.amount("chi2_reduced").value < 1.15
    for name, value in truth().items():
        amount = found.amount(name)
        assert abs(amount.value - value) < 4 * amount.std_error


def test_without_a_model_the_peak_is_measured(rng: np.random.Generator) -> None:
    """0.5 % of noise: the parabola's peak within its interval, L = 1/S - 1 as it is."""
    settings = CompareSettings(
        kind="certificate", name="plain", kind_settings=LoopCertificateSettings(zone="A")
    )
    found = certificate(settings, response(rng, 0.005), None)
    peak = found.amount("peak")
    assert abs(peak.value - truth()["sensitivity_peak"]) < 4 * peak.std_error + 0.01
    real = next(part for part in found.curves if part.quantity == "L real")
    exact = open_loop(FILE.suspension(), 2 * np.pi * FREQUENCY, RATE).loop.real
    np.testing.assert_allclose(real.measured[10:60], exact[10:60], atol=0.2)
    assert "log decrement" not in found.statement


def test_points_are_named_once_and_a_theory_is_of_one_loop(rng: np.random.Generator) -> None:
    measured, points = response(rng), {"before": ("before",), "after": ("after",)}
    own = LoopCertificateSettings(**points)
    with pytest.raises(ConfigError, match="named in the comparison and in its section"):
        certificate(CompareSettings(kind="certificate", before="x", kind_settings=own), measured, None)
    coupled_loop = ControlLoop(controller=[{"form": "gain", "gain": 1.35}], cross=CrossControl())
    with pytest.raises(ConfigError, match="cross-coupled controller"):
        certificate(asked(**points, rate=None), measured, replace(FILE, loop=coupled_loop))
    with pytest.raises(ConfigError, match="'filtered' is of a loop that is sampled"):
        certificate(asked(**points, rate=None, filtered=True), measured, FILE)


def test_lines_that_tell_no_sensitivity_are_refused(rng: np.random.Generator) -> None:
    """Nothing on both sides, no noise on one of the lines, and a line at 0 Hz, which has no logarithm."""
    measured = response(rng)
    nothing, silent, frequency = measured.matrix.copy(), measured.covariance.copy(), FREQUENCY.copy()
    nothing[3], silent[3], frequency[0] = 0, 0, 0
    for change, said in (
        ({"matrix": nothing}, "the same signal at 25 Hz"),
        ({"covariance": silent}, "the line at 25 Hz has no noise"),
        ({"frequency": frequency}, "not excited at 0 Hz"),
    ):
        with pytest.raises(FitError, match=said):
            sensitivity_matrix(replace(measured, **change), ("before",), ("after",))


def test_signals_that_are_sums_of_others_are_refused(rng: np.random.Generator) -> None:
    """A controller that adds the excitation itself records after = before + excitation to the last bit."""
    measured = response(rng)
    exact, silent = measured.covariance.copy(), measured.covariance.copy()
    exact[:, 1], exact[:, :, 1] = exact[:, 0], exact[:, :, 0]
    exact[:, 1, 1] = exact[:, 0, 0]
    silent[3, 3], silent[3, :, 3] = 0, 0
    for covariance, at in ((exact, "10 Hz"), (silent, "25 Hz")):
        with pytest.raises(FitError, match=f"the noise at {at} is that of fewer signals"):
            certificate(
                asked(before=("before",), after=("after",)), replace(measured, covariance=covariance), FILE
            )


def test_a_gain_of_spectra_changes_what_is_predicted_not_the_noise(rng: np.random.Generator) -> None:
    """0.5 % of the signal without noise; of the measured one, a fit made the noise smaller by it."""
    seen = response(rng, 0.1)
    change = 0.005 * seen.matrix * np.array([0.0, 1.0, 0.0, 0.0])[:, None]
    uncertain = replace(seen, errors=(MatrixError(Uncertainty("after.gain", 0.005, "1"), change),))
    loop = recorded_loop(LoopCertificateSettings(after=("after",), rate=RATE), uncertain, FILE)
    (error,) = loop.errors(FILE, (0.0, 0.0))
    np.testing.assert_allclose(error.change[:, 0, 0], 0.005 * response(None).matrix[:, 1, 0], rtol=1e-9)


def test_a_reading_that_the_controller_logs_with_its_command_counts_once(rng: np.random.Generator) -> None:
    """after - e is the probe's reading but for leakage z[p + 1] - z[p] of period p, which telescopes in the
    mean: of three signals chi2/dof came out near (2 + 1/20) / 3; its standard deviation is sqrt(2 / dof).
    """
    periods, right = 20, response(None)
    size = 0.02 * np.sqrt(np.mean(np.abs(right.matrix) ** 2, axis=0))[:, 0]
    draws = right.matrix[..., 0] + size * drawn(rng, (periods, len(FREQUENCY), 4))
    ends = 1e-3 * size[2] * drawn(rng, (periods + 1, len(FREQUENCY)))
    draws[..., 2] = (draws[..., 1] - 1) / LOOP.sensor + np.diff(ends, axis=0)
    mean = draws.mean(axis=0)
    rest = draws - mean
    covariance = np.einsum("plc,pld->lcd", rest, rest.conj()) / (periods * (periods - 1))
    log = replace(right, matrix=mean[..., None], covariance=covariance, covariance_dof=periods - 1.0)
    found = certificate(replace(asked(after=("after",)), estimate=()), log, FILE)
    assert abs(found.amount("chi2_reduced").value - 1) < 3 * np.sqrt(2 / (4 * len(FREQUENCY)))
    assert [f.message[:2] for f in found.findings if f.code == "computed"] == ["x "]


@pytest.mark.long
def test_margins_without_a_model_hold_the_truth() -> None:
    """50 draws at 0.5 % of noise.

    Lines of 5 Hz make a straight piece of L short enough, that of the lower gain lies below the band.
    """
    exact, held, n = truth(), Counter(), 50
    for seed in range(n):
        settings = CompareSettings(
            kind="certificate", name="plain", kind_settings=LoopCertificateSettings(zone="A")
        )
        found = certificate(settings, response(np.random.default_rng(seed), 0.005), None)
        for name in ("gain_margin_upper", "phase_margin"):
            low, high = found.amount(f"measured_{name}").ci95
            held[name] += low <= exact[name] <= high
    assert all(
        held[name] >= stats.binom.ppf(0.001, n, 0.95) for name in ("gain_margin_upper", "phase_margin")
    ), held


@pytest.mark.parametrize(
    ("limit", "verdict"),
    [
        (2.72, "undecided"),
        *(pytest.param(*case, marks=pytest.mark.long) for case in ((2.0, "accepted"), (3.5, "not accepted"))),
    ],
)
def test_the_verdict_follows_the_probability(limit: float, verdict: str) -> None:
    """The true decrement is 2.721, its standard error 0.7 %: probabilities of a normal estimate."""
    found = certificate(asked(log_decrement=limit), response(np.random.default_rng(2), 0.05), FILE)
    amount = found.amount("log_decrement_1")
    expected = stats.norm.cdf((amount.value - limit) / amount.std_error)
    assert found.amount("probability_log_decrement").value == pytest.approx(expected, abs=1e-9)
    assert found.verdict == verdict


@pytest.mark.long
def test_the_zone_s_probability_is_by_the_logarithm() -> None:
    found = certificate(asked(), response(np.random.default_rng(2), 0.3), FILE)
    peak = found.amount("sensitivity_peak")
    expected = stats.norm.cdf(np.log(3 / peak.value) / (peak.std_error / peak.value))
    assert found.amount("probability_zone").value == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("name", "zeta"), [("zeta_2", 0.03), ("zeta", 0.2)])
def test_decrements_of_a_fit(name: str, zeta: float) -> None:
    """2 pi z / sqrt(1 - z^2), its slope 2 pi / (1 - z^2)^1.5; probability of a normal estimate."""
    ratio = Parameter(name, zeta, "1", std_error=0.01, ci95=(zeta - 0.02, zeta + 0.02))
    sizes = {
        "band_hz": (1.0, 2.0),
        "lines": 1,
        "equations": 2,
        "dof": 1,
        "condition_number": 1.0,
        "correlation": np.eye(1),
    }
    fit = Fit("modes", "modal", "ml", gof=Goodness(1, 1), parameters=(ratio,), **sizes)
    settings = CompareSettings(
        kind="certificate", name="c", fit="modes", kind_settings=LoopCertificateSettings(log_decrement=0.1)
    )
    found = compare(settings, Evidence((fit,), (), ()))
    amount = found.amount(f"log_decrement{name.removeprefix('zeta')}")
    assert amount.value == pytest.approx(2 * np.pi * zeta / np.sqrt(1 - zeta**2))
    assert amount.std_error == pytest.approx(0.01 * 2 * np.pi / (1 - zeta**2) ** 1.5)
    expected = stats.norm.cdf((amount.value - 0.1) / amount.std_error)
    assert found.amount("probability_log_decrement").value == pytest.approx(expected)
    assert comparison_blocks(found, ())
    with pytest.raises(ConfigError, match="no damping ratio"):
        compare(settings, Evidence((replace(fit, parameters=()),), (), ()))
    with pytest.raises(ConfigError, match="'zone' changes nothing: the fit 'modes' is judged"):
        compare(replace(settings, kind_settings=LoopCertificateSettings(zone="A")), Evidence((fit,), (), ()))
    with pytest.raises(ConfigError, match="'before' changes nothing"):
        compare(replace(settings, before="x"), Evidence((fit,), (), ()))
    several = (replace(fit, test="a", band_hz=(1.0, 2.0)), replace(fit, test="a"), replace(fit, test="b"))
    names = [amount.name for amount in compare(settings, Evidence(several, (), ())).amounts[:3]]
    assert names == [f"{amount.name}_{end}" for end in ("a_band1", "a_band2", "b")]
    one = replace(settings, kind_settings=LoopCertificateSettings(log_decrement=0.1, test="b"))
    assert compare(one, Evidence(several, (), ())).amounts == found.amounts


def test_spectra_of_all_channels_give_the_same_certificate(rng: np.random.Generator) -> None:
    """Injection, command, current and reading side by side, of several quantities.

    The injection without noise.
    """
    plain = response(rng, 0.02)
    quantities = {"before": "voltage", "after": "voltage", "x": "displacement", "i": "current"}
    channels = [Channel("e", "voltage", "input", "e")] + [
        Channel(name, what, "output", name) for name, what in quantities.items()
    ]
    covariance = np.zeros((FREQUENCY.size, 1, 5, 5), complex)
    covariance[:, 0, 1:, 1:] = 4 * plain.covariance
    vectors = np.concatenate([np.full((FREQUENCY.size, 1), 2.0), 2 * plain.matrix[:, :, 0]], axis=1)[:, None]
    spectra = ChannelSpectra(FREQUENCY, vectors, covariance, tuple(channels), ("run",))
    again = response_per_injection(spectra)
    np.testing.assert_allclose(again.matrix, plain.matrix)
    np.testing.assert_allclose(again.covariance, plain.covariance)
    noisy = np.array(covariance)
    noisy[:, 0, 0, 0] = 0.01
    with_noise = response_per_injection(replace(spectra, covariance=noisy))
    # E|H dR|^2 / |R|^2 more.
    np.testing.assert_allclose(
        with_noise.covariance - plain.covariance,
        0.0025 * plain.matrix @ plain.matrix.conj().swapaxes(1, 2),
        atol=1e-12,
    )
    with pytest.raises(ConfigError, match=r"1 run\(s\) for 2 injection"):
        response_per_injection(
            replace(spectra, channels=(channels[0], replace(channels[1], role="input"), *channels[2:]))
        )


def coupled(
    rng: np.random.Generator | None, noise: float = 0.01, sums: bool = True
) -> tuple[FrequencyResponse, np.ndarray]:
    """Two coupled loops L, S = (I + L)^-1; both sides of both sums per excitation."""
    s = 2j * np.pi * FREQUENCY / 600
    loop = (
        np.array([[1.8, 0.5], [-0.4, 1.5]])[None]
        * ((1 + 0.9 * s) / (s**2 * (1 + 0.1 * s) - 0.3))[:, None, None]
    )
    true = np.linalg.inv(np.eye(2) + loop)
    matrix = np.concatenate([true - np.eye(2), true], axis=1) if sums else true
    size = matrix.shape[1] * 2
    covariance = np.broadcast_to(noise**2 * np.eye(size), (len(true), size, size)).astype(complex)
    if rng is not None:
        matrix = matrix + noise * drawn(rng, matrix.shape)
    names = ["bx", "by", "ax", "ay"] if sums else ["ax", "ay"]
    ports = tuple(Port(name, name, name) for name in names)
    inputs = tuple(Port(name, name, name) for name in ("ex", "ey"))
    return FrequencyResponse(FREQUENCY, matrix, ports, inputs, form="other", covariance=covariance), true


@pytest.mark.parametrize("sums", [True, False])
def test_coupled_loops_have_a_sensitivity_matrix(rng: np.random.Generator, sums: bool) -> None:
    """Intervals of |S_ii| and of the largest singular value over 197 lines against the matrix inverse."""
    noisy, true = coupled(rng, sums=sums)
    found = sensitivity_matrix(noisy, ("bx", "by") if sums else (), ("ax", "ay"))
    low, high = stats.binom.ppf([0.001, 0.999], FREQUENCY.size, 0.95)
    for number in range(2):
        size, error = found.loop(number).size, found.loop(number).error
        assert low <= np.sum(np.abs(size - np.abs(true[:, number, number])) <= found.quantile * error) <= high
    size, error = found.largest()
    assert (
        low <= np.sum(np.abs(size - np.linalg.norm(true, 2, axis=(1, 2))) <= found.quantile * error) <= high
    )
    # A loop cut alone while the other is closed: L_xx - L_xy (1 + L_yy)^-1 L_yx.
    loop = np.linalg.inv(found.values) - np.eye(2)
    alone = loop[:, 0, 0] - loop[:, 0, 1] * loop[:, 1, 0] / (1 + loop[:, 1, 1])
    np.testing.assert_allclose(found.loop(0).transfer[0], alone, rtol=1e-6, atol=1e-9)


def test_a_certificate_of_coupled_loops(rng: np.random.Generator) -> None:
    noisy, _ = coupled(rng)
    settings = CompareSettings(
        kind="certificate",
        name="both",
        kind_settings=LoopCertificateSettings(before=["bx", "by"], after=["ax", "ay"]),
    )
    found = certificate(settings, noisy, None)
    assert (
        found.amount("largest_singular_value").value
        >= max(found.amount("peak_ex").value, found.amount("peak_ey").value) - 0.05
    )
    assert [part.quantity for part in found.curves][:3] == [
        "sensitivity ex",
        "sensitivity ey",
        "largest singular value",
    ]
    with pytest.raises(ConfigError, match="describes one loop"):
        certificate(replace(asked(), kind_settings=settings.kind_settings), noisy, FILE)


def test_a_loop_that_cannot_be_the_recorded_one_is_said() -> None:
    """A file whose gain is half leaves the rotor unstable, and nothing is fitted."""
    found = certificate(
        replace(asked(), estimate=()), response(np.random.default_rng(1), 0.05), with_gain(FILE, 0.4)
    )
    assert {"unstable-loop", "model-mismatch"} <= {finding.code for finding in found.findings}
    assert "sensitivity_peak" not in [amount.name for amount in found.amounts]


def test_a_certificate_is_recorded_and_reported(rng: np.random.Generator) -> None:
    found = certificate(asked(), response(rng), FILE)
    assert record_of(json.loads(json.dumps(entry_of(found))), Comparison) == found
    figures = [block for block in comparison_blocks(found, ()) if isinstance(block, Figure)]
    assert len(figures) == 2 and "-1" in figures[1].caption


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"confidence": 0.3}, "between 50 and 100 %"),
        ({"log_decrement": -1}, "positive"),
        ({"rate": 0}, "positive"),
        ({"before": ["a", "b"], "after": ["c"]}, "2 points ahead of a sum and 1 behind"),
    ],
)
def test_impossible_settings_are_refused(own: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        asked(**own)


def test_what_does_not_fit_together_is_refused(rng: np.random.Generator) -> None:
    plain = response(rng)
    with pytest.raises(ConfigError, match="not those of the kind trend"):
        CompareSettings(kind="trend", fit="a", over=("b",), kind_settings=LoopCertificateSettings())
    with pytest.raises(ConfigError, match="no response 'z'"):
        certificate(asked(displacement="z"), plain, FILE)
    with pytest.raises(FitError, match="noise of the response is not known"):
        certificate(asked(), replace(plain, covariance=None), FILE)
    with pytest.raises(FitError, match="are the same signal"):
        certificate(asked(before=["after"], after=["after"]), plain, FILE)
    with pytest.raises(ConfigError, match="one test is needed"):
        compare(asked(), Evidence((), (plain, plain), ()))


def test_magnets_that_outgrow_all_numbers_are_refused() -> None:
    """exp(T sqrt(k / m)) = exp(2.8e10) of an interval T = 50 us is not a number."""
    with pytest.raises(FitError, match="the loop outgrows all numbers"):
        certificate(asked(), response(None, 1e-5), replace(FILE, negative_stiffness=2e28))


def test_a_pole_that_does_not_swing_has_no_logarithmic_decrement() -> None:
    """A mode that the errors of the unknowns move to where it only decays: its decrement is infinite."""
    found = loop_amounts(FILE.suspension(), None, np.array([-100 + 0j]), stable=False)
    assert found == {"f_n_1": 100 / (2 * np.pi), "pole_real_1": -100.0, "pole_imag_1": 0.0}

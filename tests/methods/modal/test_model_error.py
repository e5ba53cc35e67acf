"""Modes whose residual is not noise: intervals that survive another band, loss factors, few lines."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.model_error import ModelError, StatedRow
from labpipe.estimation.settings import FitSettings
from labpipe.methods.modal.likelihood import Refined
from labpipe.methods.modal.model_error import _find_apart, _rows, shape_record
from labpipe.methods.modal.settings import ModalSettings
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

POINTS = 4
# Two hertz apart, as by a hit of half a second.
FREQUENCY = np.arange(700.0, 3200.0, 2.0)
# Strong modes far away, the mode of the band, and a weaker one six tenths of a half-power width beside it.
MODES = (
    (1074.0, 0.034, 1.0),
    (1961.0, 0.04, 0.6),
    (2617.0, 0.02, 0.5),
    (2680.0, 0.02, 0.08),
    (3400.0, 0.02, 1.0),
)


def response(seed: int, *, hysteretic: bool = False, known: bool = False) -> FrequencyResponse:
    rng = np.random.default_rng(seed)
    h = np.zeros((FREQUENCY.size, POINTS, 1), np.complex128)
    for f_n, zeta, amount in MODES:
        shape = amount * (1 + 0.5 * rng.uniform(-1, 1, POINTS)) * f_n**2
        damping = 2j * zeta * f_n * (f_n if hysteretic else FREQUENCY)
        h[:, :, 0] += shape / (f_n**2 - FREQUENCY**2 + damping)[:, None]
    std = 0.01 * float(np.sqrt(np.mean(np.abs(h) ** 2)))
    noise = std * (rng.normal(size=h.shape) + 1j * rng.normal(size=h.shape)) / np.sqrt(2)
    outputs = tuple(Port(f"a{n}", f"a{n}", f"{n}") for n in range(1, POINTS + 1))
    covariance = diagonal_covariance(np.full(h.shape, std**2)) if known else None
    return FrequencyResponse(FREQUENCY, h + noise, outputs, (Port("f", "f", "1"),), covariance=covariance)


def fitted(seed: int, band: tuple[float, float], **more: object) -> Fit:
    modal = ModalSettings(poles=(2617.0,))
    (fit,) = identify(response(seed), FitSettings("modal", band=band, model_settings=modal, **more))
    return fit


@pytest.mark.long
def test_an_interval_survives_other_bands() -> None:
    """A hidden mode beside it, three bands: every interval holds the mode, and
    every pair of bands agrees.
    """
    stated = []
    for band in ((2485, 2725), (2450, 2750), (2200, 2900)):
        f_n = fitted(0, band).parameter("f_n_1")
        assert f_n.ci95 is not None and f_n.ci95[0] <= 2617.0 <= f_n.ci95[1], (band, f_n)
        assert f_n.interval.discrepancy > 0
        stated.append(f_n.ci95)
    assert max(low for low, _ in stated) < min(high for _, high in stated)


@pytest.mark.long
def test_loss_factors_have_an_interval_with_model_error() -> None:
    settings = FitSettings(
        "modal", band=(2300, 2900), damping="hysteretic", model_settings=ModalSettings(poles=(2617.0,))
    )
    (fit,) = identify(response(0, hysteretic=True, known=True), settings)
    eta = fit.parameter("eta_1")
    assert eta.interval.discrepancy > 0 and eta.reason and eta.ci95[0] <= eta.value <= eta.ci95[1]


@pytest.mark.long
def test_no_mode_is_left_without_an_interval() -> None:
    """Two poles by hand in a band with three modes, one of them at its edge."""
    modal = ModalSettings(poles=(1074.0, 1961.0))
    (fit,) = identify(response(1), FitSettings("modal", band=(1000, 2600), model_settings=modal))
    assert "model-mismatch" in [finding.code for finding in fit.findings]

    def stated(parameter: Parameter) -> bool:
        return parameter.ci95 is not None and parameter.ci95[0] <= parameter.value <= parameter.ci95[1]

    assert all(stated(parameter) for parameter in fit.parameters)


def test_a_value_without_an_interval_has_no_error_left() -> None:
    """Neither that of noise nor a wider one: an unstable mode of an unexplained residual had the latter."""
    wide = Parameter("zeta_1", -0.01, "1", std_error=1e-3, ci95=(-0.02, 0.0), std_error_inflated=2e-3)
    plain = wide.without_interval
    assert plain == Parameter("zeta_1", -0.01, "1") and plain.full_error is None


def test_a_modal_mass_has_at_least_the_error_of_its_own_frf() -> None:
    """The line of nine FRFs averages their noise to a third: .02 where that of the driving point, .06, is in
    the mass. The interval is that of both in squares, .02 and what is missing to .06, and .05 of model error.
    """
    mixture = SimpleNamespace(
        noise=np.array([[0.0004]]),
        shares={},
        second=None,
        stated_interval=lambda row: (0.0, -0.05 * 1.96, 0.05 * 1.96),
    )
    m = Parameter("m_1", 1.0, "kg", std_error=0.06, ci95=(0.88, 1.12))
    shared, alone, noisier = (
        ModelError(mixture, {"m_1": StatedRow(np.ones(1), alone=alone)}).state([m])[0]  # type: ignore[arg-type]
        for alone in (None, 0.04, 0.08)
    )
    assert shared.std_error == pytest.approx(0.02)
    # On the mode's own lines the noise of the FRF may be more than that of the fit of the whole band.
    for stated, error in ((alone, 0.06), (noisier, 0.08)):
        assert stated.std_error == pytest.approx(error)
        assert np.subtract(*stated.ci95[::-1]) ** 2 == pytest.approx(
            np.subtract(*shared.ci95[::-1]) ** 2 + 3.92**2 * (error**2 - 0.02**2), rel=2e-3
        )


def test_stiffness_and_damping_under_a_given_mass_follow_the_pole_alone() -> None:
    """k = M (2 pi f)^2 and c = 4 pi M zeta f, whatever the line's amplitude; where points differ as well."""
    f, zeta, mass = 50.0, 0.01, 2.0
    kept = np.array([np.log(f), np.log(zeta), 1.0, 0.5])
    base = SimpleNamespace(theta=kept, model=SimpleNamespace(kept=slice(None)))
    values = {
        "f_n_1": f,
        "zeta_1": zeta,
        "k_1": mass * (2 * np.pi * f) ** 2,
        "c_1": 4 * np.pi * mass * zeta * f,
    }
    rows = _rows(base, 1, values)  # type: ignore[arg-type]
    np.testing.assert_allclose(rows["k_1"].row[:2], [2, 0])
    np.testing.assert_allclose(rows["c_1"].row[:2], [1, 1])
    for name in ("k_1", "c_1"):
        assert not rows[name].alone and not np.any(rows[name].row[2:])
        assert rows[name].row @ kept + rows[name].offset == pytest.approx(np.log(values[name]))
    ends = {"f_n": tuple(np.log([49.0, 48.0, 51.0])), "zeta": tuple(np.log([0.01, 0.008, 0.02]))}
    apart = _find_apart(ends, 1, values)
    assert apart["k_1"] == pytest.approx(np.log(mass * (2 * np.pi * np.array([49.0, 48.0, 51.0])) ** 2))
    assert np.exp(apart["c_1"]) == pytest.approx(values["c_1"] * np.array([1.0, 0.8, 2.0]))
    assert _find_apart(ends, 1, {"eta_1": 0.021})["eta_1"] == pytest.approx(np.log([0.02, 0.016, 0.04]))
    assert set(_find_apart(ends, 1, {**values, "m_1": 3.0})) == {"f_n_1", "zeta_1"}


def test_modes_of_a_loss_factor_are_listed_at_their_natural_frequency() -> None:
    """k (1 + j eta) - m w^2 with eta = .3: f_n = sqrt(k / m) / 2 pi, where |pole| is (1 + eta^2)^(1/4) of it,
    and zeta of the same peak is eta / 2.
    """
    f_n, eta = 100.0, 0.3
    pole = 2j * np.pi * f_n * np.sqrt(1 + 1j * eta)
    one, none = np.ones((1, 1), complex), np.zeros((1, 2, 2))
    refined = Refined(
        np.array([pole]), one, one, np.eye(2), none, none, np.ones((1, 1)), 0.0, True, 1, hysteretic=True
    )
    terms, port = SimpleNamespace(lower=1, upper=1), [Port("x", "x", "1")]
    modes = shape_record(refined, terms, port, port, False, None, np.ones(1), ())
    assert modes.frequency == pytest.approx([f_n]) and modes.damping_ratio == pytest.approx([eta / 2])


def test_leakage_of_random_data_is_no_model_error() -> None:
    """Four records of a random force, filtered anew by the receptance of three modes: a mode above the band
    leaves a misfit, beside which stand a frequency, a damping ratio and a modal mass at 20 Hz, 1.6 lines
    wide. A Hann window lowers such a peak by half; by the whole band its residue is 14 % too large.
    """
    rate, n = 256.0, 2**16
    modes = ((20.0, 0.01, 2.0, (1.0, 0.8)), (52.0, 0.008, 1.5, (1.0, -0.6)), (84.0, 0.006, 1.0, (1.0, 0.5)))
    omega = 2 * np.pi * np.fft.rfftfreq(2 * n, 1 / rate)
    held, worst = 0, 0.0
    for seed in range(4):
        rng = np.random.default_rng([seed, 40])
        spectrum = np.fft.rfft(rng.normal(size=2 * n))
        motion = np.zeros((2, n))
        for f_n, zeta, mass, shape in modes:
            w_n = 2 * np.pi * f_n
            receptance = 1 / (mass * (w_n**2 - omega**2 + 2j * zeta * w_n * omega))
            # Of a record twice as long, so that the response rings on at the beginning.
            one = np.fft.irfft(-(omega**2) * receptance * spectrum, 2 * n)[n:]
            motion += np.outer(shape, one)
        motion += 0.003 * np.std(motion, axis=1, keepdims=True) * rng.normal(size=motion.shape)
        force = np.fft.irfft(spectrum, 2 * n)[n:]
        channels = (
            Channel("f", "force", "input", "1"),
            *(Channel(f"a{k}", "acceleration", "output", f"{k}") for k in (1, 2)),
        )
        record = Recording(channels, np.column_stack([force, *motion]), rate, "r")
        frf = FrfSettings("random", block=4.0, overlap=0.5, band=(10.0, 75.0))
        modal = FitSettings("modal", band=(10.0, 75.0), residuals=True)
        named = replace(modal, model_settings=ModalSettings(poles=(20.0, 52.0)))
        response = measure([record], frf)
        (fit,), (alone,) = identify(response, named), identify(response, modal)
        assert any(finding.code == "model-mismatch" for finding in fit.findings)
        # Where poles are not named the mode above explains most of the misfit.
        assert alone.gof.chi2_reduced < fit.gof.chi2_reduced / 2
        for name, truth in (("f_n_1", 20.0), ("zeta_1", 0.01), ("m_1", 2.0)):
            stated = fit.parameter(name)
            assert stated.ci95 is not None
            held += stated.ci95[0] <= truth <= stated.ci95[1]
            worst = max(worst, abs(stated.value / truth - 1))
    assert held >= 11 and worst < 0.01


@pytest.mark.parametrize("known", [True, pytest.param(False, marks=pytest.mark.long)])
@pytest.mark.parametrize(("gain", "named"), [(0.0, True), (0.1, False)])
def test_a_mode_just_beyond_the_band_is_no_mismatch_and_a_gain_curve_is(
    known: bool, gain: float, named: bool
) -> None:
    """Three modes in closed form; a band to 160.5 Hz ends 1.3 half-power widths below the one at 163 Hz. A
    gain curve in the middle of a band that ends far from it is no such mode.
    """
    rng, frequency = np.random.default_rng(4), np.arange(60.0, 280.0, 0.25)
    shapes = np.array([[1.0, 0.7, -0.4], [0.8, -0.5, 1.0], [-0.6, 1.0, 0.7]])
    h = np.zeros((frequency.size, 3, 1), np.complex128)
    for f_n, shape in zip((100.0, 163.0, 240.0), shapes, strict=True):
        h[:, :, 0] += shape / (f_n**2 - frequency**2 + 2j * 0.006 * f_n * frequency)[:, None]
    h *= (1 + gain * np.exp(-(((frequency - 97) / 4) ** 2)))[:, None, None]
    std = 0.01 * float(np.sqrt(np.mean(np.abs(h) ** 2)))
    noise = std * (rng.normal(size=h.shape) + 1j * rng.normal(size=h.shape)) / np.sqrt(2)
    outputs = tuple(Port(f"a{n}", f"a{n}", f"{n}") for n in range(1, 4))
    covariance = diagonal_covariance(np.full(h.shape, std**2)) if known else None
    measured = FrequencyResponse(frequency, h + noise, outputs, (Port("f", "f", "1"),), covariance=covariance)
    band = (65.0, 160.5 if named else 130.0)
    (fit,) = identify(measured, FitSettings("modal", band=band))
    assert any(finding.code == "model-mismatch" for finding in fit.findings) != named
    assert any("the mode at 163 Hz, beyond the band" in note for note in fit.notes) == named


def test_a_mode_that_its_band_does_not_tell_has_no_interval() -> None:
    """Whose logarithm is known to 400: the square of e^400 is no number, and no interval one can use."""
    low, high = -395.0, 405.0
    mixture = SimpleNamespace(
        stated_interval=lambda row: (5.0, low, high), noise=np.eye(1), shares={}, second=None, motion=None
    )
    error = ModelError(mixture, {"f_n_1": StatedRow(np.ones(1))})  # type: ignore[arg-type]
    (stated,) = error.state([Parameter("f_n_1", 150.0, "Hz", std_error=1.0, ci95=(148.0, 152.0))])
    assert stated.value == 150.0 and stated.ci95 is None

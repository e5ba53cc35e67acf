"""The model dynamic-stiffness as a fit: coefficients, given numbers and their uncertainty, baselines,
refusals, findings.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from labpipe.artefacts.identification_file import fit_entry, read_fit
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify
from labpipe.estimation.levels import with_level_findings
from labpipe.estimation.settings import FitSettings
from labpipe.methods.floating_bearing.findings import remedy
from labpipe.methods.floating_bearing.settings import DynamicStiffnessSettings
from labpipe.records.finding import Finding
from labpipe.records.fit_details import DynamicStiffness
from labpipe.records.identification import Fit, Identification
from labpipe.records.recording import Channel
from labpipe.records.spectra import ChannelSpectra, UncertainFactor
from labpipe.report.build import build
from labpipe.report.document import Figure, Table
from tests.methods.floating_bearing.floating_rig import (
    JOURNAL,
    SEAL,
    FloatingRig,
    kcm,
    less_inertia,
    pads,
    truth,
)

RIG = FloatingRig(kcm(**SEAL), conditions={"speed": "3000 rpm"})
GIVEN = {"stator_mass": "60 kg", "baseline_stiffness": "1.35 MN/m", "baseline_damping": "800 N.s/m"}
EVEN = replace(RIG, baseline=kcm([[1.35e6, 0], [0, 1.35e6]], [[800.0, 0], [0, 800.0]]))
TRUTH = tuple(truth(SEAL).items())
FIT = ("mass", "estimator", "compare", "input", "output", "band", "bands", "sliding", "eliminate")


def settings_of(fits: tuple[Fit, ...] = (), **keys: object) -> FitSettings:
    fit = {key: keys.pop(key) for key in FIT if key in keys}
    settings = FitSettings(
        "dynamic-stiffness", name="seal", model_settings=DynamicStiffnessSettings(**keys), **fit
    )
    return settings.kind.begin(settings, fits)


def fitted(spectra: ChannelSpectra, fits: tuple[Fit, ...] = (), **keys: object) -> Fit:
    (fit,) = identify(spectra, settings_of(fits, **keys))
    return fit


def drawn(rig: FloatingRig = EVEN, seed: int = 1) -> ChannelSpectra:
    return rig.draw(np.random.default_rng(seed))


def values(fit: Fit) -> np.ndarray:
    return np.array([p.value for p in fit.parameters if not p.derived])


@pytest.mark.parametrize("name", ["fx", "fy", "ax", "ay"])
def test_the_channel_whose_sign_is_wrong_is_named(name: str) -> None:
    """Forces and accelerations; a turned displacement leaves noise, and negative damping and mass."""
    spectra = drawn()
    turned = np.where([channel.name == name for channel in spectra.channels], -1.0, 1.0)
    covariance = spectra.covariance * turned * turned[:, None]
    fit = fitted(replace(spectra, vectors=spectra.vectors * turned, covariance=covariance), **GIVEN)
    said = [f.message for f in fit.findings if f.code == "unphysical"]
    assert said[0].startswith(f"channel {name} has the wrong sign: turned, it leaves 0.962 times the squares")


def test_no_sign_is_wrong_where_all_are_right_or_the_form_is_not() -> None:
    right = (
        fitted(drawn(), **GIVEN),
        fitted(drawn(replace(EVEN, bearing=pads, noise=0.003)), form="kc", **GIVEN),
    )
    assert right[1].gof.chi2_reduced > 1e3
    assert not [f for fit in right for f in fit.findings if f.code == "unphysical"]


@pytest.mark.parametrize("excitation", ["hadamard", "alternating", "zipper"])
def test_the_truth_lies_within_the_intervals(excitation: str) -> None:
    """Twelve coefficients of a water seal on a shaft that moves: none beyond four standard errors, their
    squares together chi-square.
    """
    fit = fitted(drawn(replace(EVEN, excitation=excitation)), **GIVEN)
    ratios = np.array(
        [
            (fit.parameter(name).value - value) / fit.parameter(name).std_error
            for name, value in truth(SEAL).items()
        ]
    )
    assert np.max(np.abs(ratios)) < 4 and 3.1 < np.sum(ratios**2) < 28.3
    assert fit.gof.chi2_p > 0.01 and fit.converged and [f.code for f in fit.findings] == ["shaft-moves"]
    assert fit.equations == 4 * 90 * (1 if excitation == "zipper" else 2)


def test_a_baseline_on_the_relative_motion_or_none_is_wrong_here() -> None:
    """What the balance is for: without the baseline k_xx is 1.35 MN/m too large and more.

    Chi-square does not see it.
    """
    without = fitted(drawn(), stator_mass="60 kg")
    assert without.parameter("k_xx").value - SEAL["k"][0][0] > 1.0e6


def test_forces_less_inertia_are_the_same_balance() -> None:
    """Derived channels with their covariance instead of a given mass: the same estimates, and the same
    uncertainty of the mass.
    """
    bare = replace(RIG, baseline=kcm([[0.0, 0.0]] * 2, [[0.0, 0.0]] * 2))
    direct = fitted(drawn(bare), stator_mass="60 kg +- 0.6 kg")
    effective = fitted(less_inertia(drawn(bare), 60.0, 0.6))
    assert values(effective) == pytest.approx(values(direct), rel=1e-6)
    for name in ("k_xx", "m_xx", "c_xy"):
        assert effective.parameter(name).full_error == pytest.approx(
            direct.parameter(name).full_error, rel=1e-4
        )
    with pytest.raises(ConfigError, match="without the stator's inertia already"):
        fitted(less_inertia(drawn(bare), 60.0, 0.6), stator_mass="60 kg")


@pytest.mark.parametrize(
    ("key", "text", "uncertainty", "moved"),
    [
        ("stator_mass", "60 kg +- 0.6 kg", 0.6, "60.06 kg"),
        ("baseline_stiffness", "1.35 MN/m +- 27 kN/m", 27e3, "1352.7 kN/m"),
        ("baseline_damping", "800 N.s/m +- 40 N.s/m", 40.0, "804 N.s/m"),
    ],
)
@pytest.mark.parametrize("estimator", ["ml", "ls"])
def test_the_uncertainty_of_a_given_number_is_what_a_fit_with_another_number_shows(
    key: str, text: str, uncertainty: float, moved: str, estimator: str
) -> None:
    """Refitted with the number a tenth of its uncertainty larger: ten times the change is the systematic part
    of every interval.
    """
    spectra = drawn()
    plain, other = (
        fitted(spectra, estimator=estimator, **{**GIVEN, key: number}) for number in (text, moved)
    )
    (shown,) = plain.detail(DynamicStiffness).uncertainties
    change = values(other) - values(plain)
    scale = np.sqrt(np.diag(plain.detail(DynamicStiffness).noise))
    assert shown.changes[0] / scale == pytest.approx(10 * change / scale, rel=0.05, abs=0.02)
    for number, p in enumerate(p for p in plain.parameters if not p.derived):
        assert p.full_error == pytest.approx(np.hypot(p.std_error, shown.changes[0, number]), rel=1e-9)
        assert p.ci95[1] - p.ci95[0] == pytest.approx(2 * 1.96 * p.full_error, rel=5e-3)


@pytest.mark.long
def test_chi_square_allows_given_numbers_their_uncertainty() -> None:
    """A mass 2 % too large is a mismatch if it is exact, and none if it is known to 2 %: chi-square is then
    the least of chi-square at other numbers plus their distance squared, here from the parabola through three
    fits.
    """
    spectra = drawn(replace(EVEN, noise=0.001))
    exact, uncertain = (
        fitted(spectra, **{**GIVEN, "stator_mass": text}) for text in ("61.2 kg", "61.2 kg +- 1.2 kg")
    )
    assert "model-mismatch" in [f.code for f in exact.findings] and "model-mismatch" not in [
        f.code for f in uncertain.findings
    ]
    steps = np.array([-1.3, -1.0, -0.7])
    squares = []
    for step in steps:
        moved = fitted(spectra, **{**GIVEN, "stator_mass": f"{61.2 + 1.2 * step} kg"})
        squares.append(moved.gof.chi2_reduced * moved.dof + step**2)
    second, first, constant = np.polyfit(steps, squares, 2)
    assert uncertain.gof.chi2_reduced * uncertain.dof == pytest.approx(
        constant - first**2 / (4 * second), rel=5e-3
    )


def test_a_measured_baseline_brings_its_noise_and_the_common_mass_cancels() -> None:
    """Dry and wet test with the same wrong mass: a baseline with K, C and M has the error too, with the other
    sign, and takes it back.
    """
    dry = fitted(drawn(RIG.dry()), motion="absolute", stator_mass="60 kg +- 0.6 kg")
    assert dry.parameter("k_yy").ci95[0] < 1.2e6 < dry.parameter("k_yy").ci95[1]
    assert dry.parameter("m_xx").full_error == pytest.approx(0.6, rel=0.01)
    dry = replace(dry, name="dry", test="dry")
    wet = fitted(drawn(RIG), (dry,), baseline="dry", stator_mass="60 kg +- 0.6 kg")
    sizes = {
        uncertainty.source: float(np.max(np.abs(uncertainty.changes[:, 8])))
        for uncertainty in wet.detail(DynamicStiffness).uncertainties
    }
    assert sizes["mass of the stator, 60 kg +- 0.6 kg"] < 1e-6 < sizes["noise of dry, test dry"]
    heavier = replace(fitted(drawn(RIG.dry()), motion="absolute", stator_mass="60.6 kg"), name="dry")
    assert values(fitted(drawn(RIG), (heavier,), baseline="dry", stator_mass="60.6 kg")) == pytest.approx(
        values(wet), rel=1e-6
    )
    # Another number for the mass is another error, and stays.
    other = fitted(drawn(RIG), (dry,), baseline="dry", stator_mass="61 kg +- 0.6 kg")
    assert other.parameter("m_xx").full_error > 0.8
    assert any("noise of dry" in note and "takes its error back" in note for note in wet.notes)


@pytest.mark.long
def test_a_mass_of_zero_may_be_uncertain() -> None:
    """Closed form: an error of the mass of 1 kg is one of m_xx on the absolute motion."""
    fit = fitted(drawn(RIG.dry()), motion="absolute", stator_mass="0 kg +- 1 kg")
    assert fit.parameter("m_xx").systematic == pytest.approx(1.0, rel=1e-6)


def test_a_baseline_that_is_not_its_form_brings_its_excess_too() -> None:
    """Hoses with a mass of 5 kg fitted as K and C: the uncertainty that they bring is that of their widened
    intervals.
    """
    heavy = replace(
        RIG,
        baseline=kcm([[1.5e6, 0.0], [0.0, 1.2e6]], [[900.0, 0.0], [0.0, 700.0]], [[5.0, 0.0], [0.0, 5.0]]),
    )
    dry = replace(fitted(drawn(heavy.dry()), motion="absolute", stator_mass="60 kg", form="kc"), name="dry")
    assert "model-mismatch" in [f.code for f in dry.findings]
    (uncertainty,) = settings_of((dry,), baseline="dry").model_settings.fitted_baseline.uncertainties
    errors = [p.std_error_inflated for p in dry.parameters]
    assert np.sqrt(np.sum(uncertainty.changes**2, axis=0)) == pytest.approx(errors, rel=1e-9)


def test_a_baseline_holds_in_its_band() -> None:
    """One line beyond it is not an extrapolation, two are."""
    lines = drawn(RIG).frequency
    keys = {"motion": "absolute", "stator_mass": "60 kg"}
    dry = replace(fitted(drawn(RIG.dry()), band=(lines[2], lines[-3]), **keys), name="dry")
    with pytest.raises(ConfigError, match="the baseline was fitted in") as error:
        fitted(drawn(RIG), (dry,), baseline="dry", stator_mass="60 kg")
    assert error.value.field == "baseline"
    band = (lines[2] - 0.4 * (lines[2] - lines[1]), lines[-3])
    assert fitted(drawn(RIG), (dry,), baseline="dry", stator_mass="60 kg", band=band).converged


def test_a_baseline_is_named_by_its_fit_or_its_test() -> None:
    dry = replace(fitted(drawn(RIG.dry()), motion="absolute", stator_mass="60 kg"), name="hoses", test="dry")
    by_fit, by_test = (
        fitted(drawn(RIG), (dry,), baseline=name, stator_mass="60 kg") for name in ("hoses", "dry")
    )
    assert values(by_fit).tolist() == values(by_test).tolist()
    # The test that the baseline was fitted on is not fitted against itself.
    assert identify(drawn(RIG.dry()), settings_of((dry,), baseline="dry", stator_mass="60 kg")) == ()
    with pytest.raises(ConfigError, match="no earlier fit 'wet'"):
        settings_of((dry,), baseline="wet")
    with pytest.raises(ConfigError, match="has 2 results"):
        settings_of((dry, replace(dry, test="dry again")), baseline="hoses")


def test_least_squares_is_that_of_the_literature() -> None:
    """Re H and Im H of every line regressed by numpy's polyfit on w^2 and w."""
    spectra = drawn()
    fit = fitted(spectra, estimator="ls", **GIVEN)
    w = 2 * np.pi * spectra.frequency
    z = spectra.vectors
    inertia = 60.0 - (1.35e6 + 800j * w[:, None, None]) / w[:, None, None] ** 2
    h = (z[..., :2] - inertia * z[..., 4:]).swapaxes(1, 2) @ np.linalg.inv(z[..., 2:4].swapaxes(1, 2))
    slope, level = np.polyfit(w**2, h[:, 0, 1].real, 1)
    assert (fit.parameter("k_xy").value, fit.parameter("m_xy").value) == pytest.approx(
        (level, -slope), rel=1e-9
    )
    assert fit.parameter("c_yy").value == pytest.approx(np.sum(w * h[:, 1, 1].imag) / np.sum(w**2), rel=1e-9)
    _, covariance = np.polyfit(w**2, h[:, 0, 1].real, 1, cov=True)
    assert fit.parameter("k_xy").std_error == pytest.approx(np.sqrt(covariance[1, 1]), rel=1e-6)
    assert fit.gof.chi2_reduced is None and any("as in the literature" in note for note in fit.notes)


def test_hum_on_one_line_is_named_and_nothing_else() -> None:
    """50 times the noise of the forces at 50 Hz, in every run alike: a multiple of the mains'. A wrong mass,
    which is off at every line, is none, nor are two such lines.
    """
    spectra = drawn()
    sizes = np.sqrt(np.einsum("lrcc->lrc", spectra.covariance).real)
    forces = np.array([channel.quantity == "force" for channel in spectra.channels])

    def hum(*frequencies: float) -> ChannelSpectra:
        lines = np.isclose(spectra.frequency[:, None], frequencies).any(axis=1)
        assert lines.sum() == len(frequencies)
        return replace(spectra, vectors=spectra.vectors + 50 * sizes * (lines[:, None, None] & forces))

    def mismatch(of: ChannelSpectra, **keys: str) -> Finding:
        (found,) = (one for one in fitted(of, **{**GIVEN, **keys}).findings if one.code == "model-mismatch")
        return found

    named = mismatch(hum(50.0))
    said = named.message
    assert named.line_hz == pytest.approx(50.0)
    assert "the line at 50 Hz alone makes it so, a multiple of the mains' 50 Hz" in said
    assert "Leave the line out, `exclude: [49.99-50.01 Hz]`" in said and "most likely" not in said
    heavy = mismatch(drawn(replace(EVEN, noise=0.001)), stator_mass="61.2 kg")
    for other in (mismatch(hum(50.0, 84.0)), heavy):
        assert "most likely" in other.message and "alone makes it so" not in other.message
        assert other.line_hz is None


def test_symmetries_tie_their_coefficients() -> None:
    seal = fitted(drawn(), symmetry="seal", **GIVEN)
    assert (
        seal.parameter("k_yx").value == -seal.parameter("k_xy").value
        and seal.parameter("c_yy").value == seal.parameter("c_xx").value
    )
    assert (
        seal.parameter("k_yx").ci95[0] == -seal.parameter("k_xy").ci95[1] and seal.parameter("k_yx").derived
    )
    assert seal.parameter("k_xy").std_error < 0.8 * fitted(drawn(), **GIVEN).parameter("k_xy").std_error
    direct = fitted(drawn(), symmetry="direct", **GIVEN)
    assert [p.name for p in direct.parameters if not p.derived] == [
        "k_xx",
        "k_yy",
        "c_xx",
        "c_yy",
        "m_xx",
        "m_yy",
    ]
    assert "model-mismatch" in [f.code for f in direct.findings]


def test_a_wrong_form_warns_and_says_why_it_is_uncertain() -> None:
    """K and C of a seal with added mass: intervals by what a course of any kind leaves of them, wider than
    with the excess counted as noise.
    """
    fit = fitted(drawn(), form="kc", **GIVEN)
    (finding,) = [f for f in fit.findings if f.code == "model-mismatch"]
    assert f"{np.sqrt(fit.gof.chi2_reduced):.3g} times" in finding.message and fit.gof.chi2_p < 1e-6
    k = fit.parameter("k_xx")
    assert k.std_error_inflated > np.sqrt(fit.gof.chi2_reduced) * k.std_error
    assert k.reason and k.reason in finding.message
    assert sum(k.discrepancy.shares.values()) == pytest.approx(1, abs=1e-5)


@pytest.mark.long
def test_gains_that_bend_are_inside_the_intervals() -> None:
    """Forces that read up to 1 % too much or too little over the band, at a noise of 0.2 %: every coefficient
    of the seal is held, and by noise alone it is not.
    """
    rig = replace(EVEN, noise=0.002)
    spectra = drawn(rig)
    x = (rig.frequency - 109) / 89
    bent = spectra.vectors.copy()
    bent[..., :2] *= (1 + 0.01 * np.stack([np.cos(2.2 * x + 1), np.sin(2.5 * x)], axis=-1))[:, None]
    fit = fitted(replace(spectra, vectors=bent), **GIVEN)
    held = {name: fit.parameter(name).ci95[0] < value < fit.parameter(name).ci95[1] for name, value in TRUTH}
    by_noise = [abs(fit.parameter(n).value - v) < 1.96 * fit.parameter(n).std_error for n, v in TRUTH]
    assert all(held.values()) and sum(by_noise) < 8
    assert "gain curve" in fit.parameter("k_xx").reason and fit.discrepancy.shares["gain curve"] > 0.5
    assert fitted(drawn(rig), **GIVEN).discrepancy is None


@pytest.mark.parametrize(("bearing", "chosen"), [(kcm(**SEAL), "kcm"), (pads, "pad")])
def test_compared_forms_are_chosen_by_bic(bearing, chosen: str) -> None:
    fit = fitted(drawn(replace(EVEN, bearing=bearing, noise=0.003)), compare=True, **GIVEN)
    best = fit.candidates[0]
    assert best.name == fit.detail(DynamicStiffness).form == chosen and best.chi2_p > 0.01
    assert best.bic == pytest.approx(best.chi2 + best.parameters * np.log(fit.equations))
    assert not {"no-model", "other-model", "model-mismatch", "collinear"} & {f.code for f in fit.findings}


@pytest.mark.long
def test_a_poor_form_that_is_asked_for_hears_of_a_better_one_and_of_none() -> None:
    spectra = drawn(replace(EVEN, bearing=pads, noise=0.003))
    codes = [f.code for f in fitted(spectra, compare=True, form="kc", **GIVEN).findings]
    assert "other-model" in codes and "no-model" not in codes
    fit = fitted(spectra, compare=True, forms=["kc", "kcm"], **GIVEN)
    assert "no-model" in [f.code for f in fit.findings] and "model-mismatch" in [f.code for f in fit.findings]


def test_bands_have_coefficients_of_their_own() -> None:
    """A bearing that steps from band to band: each has its own truth, and chi-square agrees."""

    def stepped(w: np.ndarray) -> np.ndarray:
        upper = (w > 2 * np.pi * 109)[:, None, None]
        return np.where(upper, 2 * kcm(SEAL["k"], SEAL["c"])(w), kcm(SEAL["k"], SEAL["c"])(w))

    fit = fitted(
        drawn(replace(EVEN, bearing=stepped)), form="bands", band_width="89 Hz", symmetry="seal", **GIVEN
    )
    for number in (1, 2):
        for name, value in (("k_xx", 5.0e6), ("k_xy", 2.4e6), ("c_xx", 4.2e4), ("c_xy", 8e3)):
            p = fit.parameter(f"{name}_{number}")
            assert abs(p.value - number * value) < 4 * p.std_error
    assert (
        fit.parameter("c_yy_2").derived
        and fit.gof.chi2_p > 0.01
        and fit.detail(DynamicStiffness).bands == pytest.approx((20.0, 109.0, 198.0))
    )


def test_relative_displacements_alone_are_refused_and_absolute_ones_are_not() -> None:
    spectra = drawn()
    short = replace(
        spectra,
        channels=spectra.channels[:4],
        vectors=spectra.vectors[..., :4],
        covariance=spectra.covariance[..., :4, :4],
    )
    with pytest.raises(ConfigError, match="displacements against the shaft, which moves too"):
        fitted(short, stator_mass="60 kg")
    with pytest.raises(ConfigError, match="the baseline acts with the stator's absolute motion"):
        fitted(short, baseline_stiffness="1 MN/m")
    stiff = replace(
        EVEN,
        rotor=kcm([[1e14, 0], [0, 1e14]], [[0.0, 0.0]] * 2),
        bearing=kcm([[0.0, 0.0]] * 2, [[0.0, 0.0]] * 2),
        noise=1e-4,
    )
    still = drawn(stiff)
    alone = replace(
        still,
        channels=still.channels[:4],
        vectors=still.vectors[..., :4],
        covariance=still.covariance[..., :4, :4],
    )
    found = fitted(alone, motion="absolute", stator_mass="60 kg", form="kc")
    assert found.parameter("k_xx").value == pytest.approx(1.35e6, rel=2e-3)


def test_inertia_that_nothing_takes_out_warns_where_the_shaft_moves() -> None:
    (finding,) = [f for f in fitted(drawn()).findings if f.code == "shaft-moves"]
    assert finding.level == "warning" and "mass and stiffness are wrong" in finding.message


def test_forces_and_probes_at_an_angle_are_turned_into_x_and_y() -> None:
    """Force at 45 and 135 deg, probes at 30 and 120 deg: the same noise-free motion, the same
    coefficients.
    """
    turn = {"f": np.radians([45.0, 135.0]), "d": np.radians([30.0, 120.0])}
    quiet = replace(EVEN, noise=1e-6).draw(np.random.default_rng(2))
    mixing = np.eye(6)
    channels = list(quiet.channels)
    for place, letter in ((0, "f"), (2, "d")):
        mixing[place : place + 2, place : place + 2] = [[np.cos(a), np.sin(a)] for a in turn[letter]]
        for n, angle in enumerate(turn[letter]):
            old = channels[place + n]
            channels[place + n] = Channel(
                old.name, old.quantity, old.role, f"{np.degrees(angle):g} deg", float(angle)
            )
    turned = replace(
        quiet,
        channels=tuple(channels),
        vectors=quiet.vectors @ mixing.T,
        covariance=mixing @ quiet.covariance @ mixing.T,
    )
    assert values(fitted(turned, **GIVEN)) == pytest.approx(values(fitted(quiet, **GIVEN)), rel=1e-9)


@pytest.mark.parametrize(
    ("keys", "error", "message"),
    [
        ({"estimator": "iv"}, ConfigError, "iv does not estimate"),
        ({"sliding": {"width": 20.0, "step": 5.0}}, ConfigError, "'sliding' is not for"),
        ({"eliminate": True}, ConfigError, "'eliminate' is not for"),
        ({"mass": [1.0, 2.0]}, ConfigError, "the stator has one mass"),
        ({"mass": 60.0, "stator_mass": "61 kg"}, ConfigError, "the mass of the stator is given twice"),
        ({"input": "q"}, ConfigError, "no force channel 'q'"),
        (
            {"output": "dx"},
            ConfigError,
            r"displacement channels dx \(x\) do not give the motion in x and in y",
        ),
        ({"band": (300.0, 400.0)}, FitError, "0 lines in the band"),
        (
            {"estimator": "ls", "compare": True},
            ConfigError,
            "'compare' is not for estimator ls; leave it out, or estimator: ml$",
        ),
        ({"estimator": "ls", "form": "pad"}, ConfigError, "least squares is for form kc or kcm"),
    ],
)
def test_what_does_not_fit_is_refused(keys: dict[str, object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        fitted(drawn(), **keys)


@pytest.mark.parametrize("estimator", ["ml", "ls"])
def test_a_line_at_rest_is_refused(estimator: str) -> None:
    """Z_b / w^2 of the baseline is not a number at 0 Hz."""
    spectra = drawn()
    at_rest = replace(spectra, frequency=np.append(0.0, spectra.frequency[1:]))
    with pytest.raises(FitError, match="nothing moves at 0 Hz"):
        fitted(at_rest, estimator=estimator, **GIVEN)


def test_one_run_is_not_enough_for_least_squares() -> None:
    with pytest.raises(FitError, match="two runs with independent forces at every line"):
        fitted(drawn(replace(EVEN, excitation="zipper")), estimator="ls", **GIVEN)
    twice = drawn()
    same = replace(twice, vectors=np.repeat(twice.vectors[:, :1], 2, axis=1))
    with pytest.raises(FitError, match="in one direction at a line"):
        fitted(same, estimator="ls", **GIVEN)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"baseline": "dry", "baseline_stiffness": "1 MN/m"}, "'baseline' is given twice"),
        ({"stator_mass": "-1 kg"}, "stator_mass must not be negative"),
        ({"rotor_mass": "0 kg"}, "rotor_mass must be positive"),
        ({"rotor_stiffness": 1e6}, "'rotor_stiffness' goes with a rotor's mass"),
        ({"viscosity": 0.03}, "'viscosity' goes with a clearance"),
        ({"viscosity": 0.03, "clearance": 1e-4, "length": 0.1}, "'viscosity' goes with a diameter"),
        ({"forms": ()}, "forms: is empty"),
        ({"band_width": "10 Hz"}, "'band_width' goes with form: bands"),
        ({"form": "bands", "band_width": "0 Hz"}, "band_width must be positive"),
        ({"forms": ["kc", "pads"]}, "'pads' cannot be compared"),
    ],
)
def test_settings_that_contradict_themselves_are_refused(keys: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        DynamicStiffnessSettings(**keys)


def test_bands_are_compared_as_any_other_form() -> None:
    keys = {"form": "bands", "band_width": "20 Hz", "band": (20.0, 60.0)}
    fit = fitted(drawn(), compare=True, forms=("kc",), **keys, **GIVEN)
    assert {candidate.name for candidate in fit.candidates} == {"bands", "kc"}


def test_the_mass_of_the_fit_has_its_uncertainty() -> None:
    """As `mass` or as `stator_mass`: the same fit."""
    keys = {name: number for name, number in GIVEN.items() if name != "stator_mass"}
    own, plain = (
        fitted(drawn(), stator_mass="60 kg +- 0.6 kg", **keys),
        fitted(drawn(), mass="60 kg +- 0.6 kg", **keys),
    )
    assert plain.parameters == own.parameters and plain.parameter("m_xx").full_error > 0.5


def test_forms_are_compared_where_that_is_asked_for() -> None:
    with pytest.raises(ConfigError, match="'forms' are those of `compare: true`"):
        fitted(drawn(), forms=("kc",), **GIVEN)


def test_two_forces_of_one_direction_are_not_added_unasked() -> None:
    spectra = drawn()
    extra = replace(spectra.channels[0], name="fx_raw")
    vectors = np.concatenate([spectra.vectors, spectra.vectors[..., :1]], axis=-1)
    covariance = np.zeros((*vectors.shape, 7), complex)
    covariance[..., :6, :6] = spectra.covariance
    more = replace(spectra, channels=(*spectra.channels, extra), vectors=vectors, covariance=covariance)
    with pytest.raises(ConfigError, match="'fx' and 'fx_raw' have one dof, x"):
        fitted(more, **GIVEN)
    assert values(fitted(more, input=["fx", "fy"], **GIVEN)) == pytest.approx(
        values(fitted(spectra, **GIVEN)), rel=1e-9
    )


def test_a_fit_for_each_of_several_bands() -> None:
    fits = identify(drawn(), settings_of(bands=[(20.0, 100.0), (100.0, 198.0)], **GIVEN))
    assert [fit.band_hz for fit in fits] == [(20.0, 100.0), (100.0, 198.0)]


def test_a_fit_survives_its_file() -> None:
    fit = fitted(
        drawn(replace(EVEN, bearing=kcm(**JOURNAL))), compare=True, rotor_mass="80 kg +- 1 kg", **GIVEN
    )
    entry = json.loads(json.dumps(fit_entry(fit)))
    assert fit_entry(read_fit(entry)) == entry


def test_the_report_shows_measured_model_and_baseline() -> None:
    """Numbers of the figure: dots are G m^-1 of each line, the dashed line K_b + jw C_b."""
    fit = fitted(drawn(), compare=True, **{**GIVEN, "stator_mass": "60 kg +- 0.6 kg"})
    blocks = [block for section in build(Identification((fit,))).sections for block in section.blocks]
    figures = {
        block.alternative.split(" of fit")[0]: block.graphic for block in blocks if isinstance(block, Figure)
    }
    panels = figures["Real and imaginary parts of the dynamic stiffness"].panels
    measured, model, baseline = panels[4].series
    assert [series.name for series in panels[4].series] == ["measured", "model", "baseline"] and len(
        panels
    ) == 8
    assert baseline.y == pytest.approx(1e-6 * 800 * 2 * np.pi * baseline.x)
    exact = 1e-6 * 4.2e4 * 2 * np.pi * measured.x
    assert np.mean((measured.low < exact) & (exact < measured.high)) == pytest.approx(0.95, abs=0.05)
    assert model.y == pytest.approx(1e-6 * fit.parameter("c_xx").value * 2 * np.pi * model.x, rel=1e-6)
    assert "Effective stiffness and damping" in figures
    tables = {block.caption: block for block in blocks if isinstance(block, Table)}
    assert any(caption.startswith("Uncertainty of seal") for caption in tables)
    choice = tables["Which form the data ask for"]
    assert choice.rows[0][0] == "kcm" and choice.rows[0][-1] == "0.0"


def test_the_budget_holds_every_number_that_counts() -> None:
    """Random and systematic part of every parameter.

    The whirl frequency ratio moves with the mass as a fit with another mass shows.
    """
    spectra, heavier = drawn(), "60.06 kg"
    fit = fitted(
        spectra, **{**GIVEN, "stator_mass": "60 kg +- 0.6 kg", "baseline_stiffness": "1.35 MN/m +- 2 %"}
    )
    moved = fitted(spectra, **{**GIVEN, "stator_mass": heavier})
    assert [source.unit for source in fit.budget.sources] == ["kg", "N/m"] and fit.budget.sources[
        0
    ].std_error == 0.6
    for parameter in fit.parameters:
        column = fit.budget.names.index(parameter.name)
        assert fit.budget.combined[column] == pytest.approx(parameter.full_error)
        assert parameter.systematic == pytest.approx(fit.budget.systematic[column])
        change = 10 * (moved.parameter(parameter.name).value - parameter.value)
        assert fit.budget.changes[0, column] == pytest.approx(
            change, rel=0.05, abs=0.03 * parameter.std_error
        )
    assert fitted(spectra, **GIVEN).budget is None


def test_lines_of_one_vector_are_drawn_in_pairs() -> None:
    shown = fitted(drawn(replace(EVEN, excitation="zipper")), **GIVEN).detail(DynamicStiffness)
    assert shown.paired and shown.frequency[0] == 21.0 and shown.frequency.size == 45
    exact = kcm(**SEAL)(2 * np.pi * shown.frequency)
    ratio = np.abs(shown.measured - exact) ** 2 / shown.variance
    assert np.mean(ratio) == pytest.approx(1, abs=0.3)


def test_motion_that_differs_from_period_to_period_is_no_noise_but_scatter_that_averages_out_is_noted() -> (
    None
):
    """Forces and accelerations follow a motion in the covariance: the balance holds for it.

    A covariance five times too large does not.
    """
    rng, still = np.random.default_rng(4), drawn()
    motion = rng.normal(size=(200, 2)) + 1j * rng.normal(size=(200, 2))
    w = 2 * np.pi * EVEN.frequency[:, None, None]
    h = kcm(**SEAL)(2 * np.pi * EVEN.frequency)
    inertia = (60.0 - (1.35e6 + 800j * w) / w**2) * np.eye(2)
    # [F; D; A] = [H d - M w^2 x + Z x; d; -w^2 x] balances for any d, with x = d.
    columns = np.concatenate(
        [h - w**2 * inertia, np.broadcast_to(np.eye(2), h.shape), -(w**2) * np.eye(2)], axis=1
    )
    scatter = 1e-6 * np.einsum("lij,kj->lki", columns, motion)
    extra = np.einsum("lki,lkj->lij", scatter, scatter.conj()) / 200
    moved = fitted(replace(still, covariance=still.covariance + extra[:, None]), **GIVEN)
    assert moved.gof.chi2_reduced == pytest.approx(fitted(still, **GIVEN).gof.chi2_reduced, rel=1e-3)
    loud = replace(still, covariance=5 * still.covariance)
    (finding,) = [f for f in fitted(loud, **GIVEN).findings if f.code == "scatter-not-noise"]
    assert finding.level == "note" and "0.44 times" in finding.message


def test_levels_are_held_against_each_other_without_what_they_have_in_common() -> None:
    """3 % more stiffness at the larger orbit, beside an uncertainty of 10 % in the baseline that both tests
    share.
    """
    hard = {**SEAL, "k": (1.03 * np.array(SEAL["k"])).tolist()}
    given = {**GIVEN, "baseline_stiffness": "1.35 MN/m +- 30 %"}
    names = {"low": SEAL, "same": SEAL, "high": hard}
    fits = {
        name: replace(fitted(drawn(replace(EVEN, bearing=kcm(**matrices)), seed), **given), test=name)
        for seed, (name, matrices) in enumerate(names.items())
    }
    conditions = {
        "low": {"amplitude": "5 um"},
        "same": {"amplitude": "10 um"},
        "high": {"amplitude": "20 um"},
    }
    assert fits["low"].parameter("k_xx").full_error > 0.06 * 5e6
    _, high = with_level_findings([fits["low"], fits["high"]], conditions)
    (finding,) = [f for f in high.findings if f.code == "amplitude"]
    assert "stiffness by +3" in finding.message or "stiffness by +2.9" in finding.message
    _, same = with_level_findings([fits["low"], fits["same"]], conditions)
    assert "amplitude" not in [f.code for f in same.findings]


def test_a_common_gain_error_of_the_probes_scales_all_coefficients() -> None:
    """Both probes 1 % wrong by one calibrator: H goes with 1 / D, so that every coefficient is off by 1 % of
    itself, with one sign.
    """
    spectra = drawn()
    slopes = [np.diag([0.0, 0, *row, 0, 0]) for row in ((-1.0, 0.0), (0.0, -1.0))]
    gains = tuple(
        UncertainFactor(name, 1.0, 0.01, "1", slope, source="calibrator")
        for name, slope in zip("xy", slopes, strict=True)
    )
    fit = fitted(replace(spectra, factors=gains), **GIVEN)
    (uncertainty,) = fit.detail(DynamicStiffness).uncertainties
    assert uncertainty.source == "calibrator" and np.abs(uncertainty.changes[0]) == pytest.approx(
        0.01 * np.abs(values(fit)), rel=1e-2, abs=1e-3
    )
    main = [0, 1, 2, 3, 4, 7, 8, 11]
    assert np.unique(np.sign(uncertainty.changes[0][main] * values(fit)[main])).size == 1
    # A scale of everything is not a fault of the form: chi-square stays.
    assert fit.gof.chi2_reduced == pytest.approx(fitted(spectra, **GIVEN).gof.chi2_reduced, rel=1e-3)


def test_forces_of_one_pattern_are_told_what_separates_the_directions() -> None:
    """One run with the force in x: x and y move in the proportion that H gives them, so that no column of H
    is known by itself.
    """
    both = replace(EVEN, excitation="alternating")
    whole = drawn(both)
    first = replace(
        whole, vectors=whole.vectors[:, :1], covariance=whole.covariance[:, :1], runs=whole.runs[:1]
    )
    (finding,) = [
        finding for finding in fitted(first, form="kcm", **GIVEN).findings if finding.code == "collinear"
    ]
    assert "let the forces act in two ways" in finding.message and "zipper" in finding.message
    assert "rotor-2dof-direct" not in finding.message and "FRF" not in finding.message
    assert "collinear" not in {finding.code for finding in fitted(whole, form="kcm", **GIVEN).findings}


@pytest.mark.parametrize(
    ("group", "said"),
    [
        (["k_xx", "m_xx"], "widen the band"),
        (["k_xy", "k_yy", "m_xy"], "widen the band"),
        (["k_xx", "k_xy"], "let the forces act in two ways"),
        (["c_yx", "c_yy", "tau"], "let the forces act in two ways"),
    ],
)
def test_the_remedy_follows_the_motions_of_a_group(group: list[str], said: str) -> None:
    """The second letter is the direction of the motion: terms of both are mixed by the forces, terms of one
    by the band.
    """
    assert remedy(group).startswith(said)

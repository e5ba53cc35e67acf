"""Uncertainty budgets of fits: sensitivities against refits with the number changed, combination, shares,
intervals.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import FitError
from labpipe.estimation.budget import with_contributions
from labpipe.estimation.draws import drawn_error, with_drawn_interval
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.project.judging import judge
from labpipe.project.rules import Rule
from labpipe.records.finding import Parameter
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.spectra import FreeDecay, FreeDecays
from labpipe.records.uncertain import Budget, ChannelUncertainty, MatrixError, Uncertain, Uncertainty
from labpipe.report.budget import budget_blocks
from labpipe.report.document import Table
from tests.uncertainty.conftest import a_fit

K, C, M = 1.35e5, 3.7, 0.79
BAND = np.arange(60.0, 72.0, 0.1)
GAIN_F = ChannelUncertainty("gain", Uncertainty("f.sensitivity", 0.005, "1", dof=20.0))
GAIN_X = ChannelUncertainty("gain", Uncertainty("x.sensitivity", 0.01, "1"))
DELAY_X = ChannelUncertainty("delay", Uncertainty("x.delay", 2e-6, "s"))


def a_response(rng, noise: float = 1e-3, output=(GAIN_X, DELAY_X), force=(GAIN_F,)) -> FrequencyResponse:
    """One mass on spring and damper, 0.1 % noise of the largest receptance on every line."""
    w = 2 * np.pi * BAND
    h = 1 / (K - M * w**2 + 1j * w * C)
    std = noise * np.max(np.abs(h))
    error = std * (rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)) / np.sqrt(2)
    matrix = (h + error)[:, None, None]
    ports = (Port("x", "x", "x", 0.0, tuple(output)),), (Port("f", "f", "x", 0.0, tuple(force)),)
    return FrequencyResponse(
        BAND, matrix, *ports, covariance=diagonal_covariance(np.full(matrix.shape, std**2))
    )


def changed(response: FrequencyResponse, effect: str, error: float) -> FrequencyResponse:
    """The response as it were without the error: X (1 - d) or X e^{jwd}."""
    factor = 1 - error if effect == "gain" else np.exp(2j * np.pi * response.frequency * error)[:, None, None]
    return dataclasses.replace(response, matrix=response.matrix * factor)


def settings(estimator: str, **more) -> FitSettings:
    return FitSettings("sdof", estimator=estimator, name="peak", **more)


@pytest.mark.parametrize("estimator", ["ml", "ls", "iv", "amplitude"])
@pytest.mark.parametrize("mass", ["estimate", "0.79 kg +- 1 %"])
def test_changes_are_those_of_refits(rng, estimator: str, mass: str) -> None:
    """Each source against central differences of whole refits, to 1 % of the combined uncertainty
    (Gauss-Newton's form).
    """
    response = a_response(rng)
    (fit,) = identify(response, settings(estimator, mass=mass))
    assert fit.budget is not None
    refits = {"x.sensitivity": ("gain", 0.01), "x.delay": ("delay", 2e-6)}
    for source, (effect, error) in refits.items():
        if source not in [one.source for one in fit.budget.sources]:
            assert estimator == "amplitude" and source == "x.delay"
            continue
        ends = [
            identify(changed(response, effect, sign * error), settings(estimator, mass=mass))[0]
            for sign in (1, -1)
        ]
        for name, combined in zip(fit.budget.names, fit.budget.combined, strict=True):
            expected = (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
            assert fit.budget.change_by(source, name) == pytest.approx(expected, abs=0.01 * combined)
    if mass != "estimate":
        ends = [identify(response, settings(estimator, mass=0.79 * (1 + 0.01 * sign)))[0] for sign in (1, -1)]
        for name, combined in zip(fit.budget.names, fit.budget.combined, strict=True):
            expected = (ends[0].parameter(name).value - ends[1].parameter(name).value) / 2
            assert fit.budget.change_by("mass 0.79 kg", name) == pytest.approx(expected, abs=0.01 * combined)


def test_near_resonance_the_mass_is_the_stiffness_s_uncertainty(rng) -> None:
    """Closed form: k = m w_n^2 with w_n from the peak, so k takes the mass's relative uncertainty and hardly
    any gain.

    C takes gains -1 and 1.
    """
    (fit,) = identify(a_response(rng), settings("ml", mass="0.79 kg +- 0.5 %"))
    budget = fit.budget
    assert budget is not None
    k, c = fit.parameter("k"), fit.parameter("c")
    assert budget.change_by("mass 0.79 kg", "k") / k.value == pytest.approx(0.005, rel=1e-3)
    assert abs(budget.change_by("x.sensitivity", "k")) / k.value < 0.01 * 2e-3
    assert budget.change_by("x.sensitivity", "c") / c.value == pytest.approx(0.01, rel=0.02)
    assert budget.change_by("f.sensitivity", "c") / c.value == pytest.approx(-0.005, rel=0.02)
    assert next(iter(budget.shares("k"))) == "mass 0.79 kg"
    assert sum(budget.shares("c").values()) == pytest.approx(1.0)


def test_parameters_hold_the_combined_uncertainty(rng) -> None:
    (fit,) = identify(a_response(rng), settings("ml"))
    budget = fit.budget
    assert budget is not None
    k = fit.parameter("k")
    place = budget.names.index("k")
    assert k.systematic == pytest.approx(budget.systematic[place])
    assert k.full_error == pytest.approx(np.hypot(k.std_error, k.systematic))
    assert k.ci95[1] - k.value == pytest.approx(1.96 * k.full_error, rel=0.1)
    # Without a known mass all coefficients go as force over displacement.
    assert k.systematic / k.value == pytest.approx(np.hypot(0.01, 0.005), rel=1e-2)


def test_a_frequency_that_uncertainties_take_away_is_refused() -> None:
    """A k of 1 mN/m changes its sign by 0.1 % of a standard uncertainty of m w^2, and has no f_n then."""
    w = 2 * np.pi * BAND
    matrix = (1 / (1e-3 - M * w**2 + 1j * w * C))[:, None, None]
    ports = (Port("x", "x", "x", 0.0, ()),), (Port("f", "f", "x", 0.0, ()),)
    std = 1e-9 * np.max(np.abs(matrix))
    response = FrequencyResponse(
        BAND, matrix, *ports, covariance=diagonal_covariance(np.full(matrix.shape, std**2))
    )
    with pytest.raises(FitError, match="within the stated uncertainties f_n can have no value"):
        identify(response, settings("ml", mass="0.79 kg +- 1 %"))


def test_common_sources_cancel_or_add(rng) -> None:
    """One calibrator of both sensors: force over displacement does not change with it."""
    both = ChannelUncertainty("gain", Uncertainty("calibrator", 0.01, "1"))
    (fit,) = identify(a_response(rng, output=(both,), force=(both,)), settings("ml"))
    assert fit.budget is None or np.max(np.abs(fit.budget.changes / [p.value for p in fit.parameters])) < 1e-9


def test_lines_of_noise_do_not_contradict_the_noise_of_a_force(rng) -> None:
    """Lines that show noise N alone, beyond 200 Hz, say nothing of a gain of them. Of the measured response N
    times the gain would be projected on N itself: 3 % times |N|^2 over its variance, 31 of 1030 lines.
    """
    frequency = np.arange(30.0, 1230.0, 1.0)
    w = 2 * np.pi * frequency
    true = 1 / (K - M * w**2 + 1j * w * C)
    std = 10 * np.abs(true[-1])
    error = std * (rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)) / np.sqrt(2)
    matrix = (true + error)[:, None, None]
    change = np.where(frequency[:, None, None] > 200, 0.03, 0.0) * matrix
    common = MatrixError(Uncertainty("noise of the force", 1.0, "1"), change, by_repeat=True)
    ports = (Port("x", "x", "x", 0.0),), (Port("f", "f", "x", 0.0),)
    noise = diagonal_covariance(np.full(matrix.shape, std**2))
    response = FrequencyResponse(frequency, matrix, *ports, covariance=noise, errors=(common,))
    (fit,) = identify(response, settings("ml", mass=M))
    assert {finding.code for finding in fit.findings} <= {"leakage"}


def test_no_uncertainties_no_budget(rng) -> None:
    (fit,) = identify(a_response(rng, output=(), force=()), settings("ml", mass="0.79 kg"))
    assert fit.budget is None
    assert fit.parameter("k").systematic is None


def test_effective_degrees_of_freedom_are_welch_and_satterthwaite_s() -> None:
    """GUM G.4.1 with u = 3 (nu 9), 4 (nu 16): u_c = 5, nu_eff = 625 / (81 / 9 + 256 / 16) = 25."""
    budget = Budget(("k",), np.array([3.0]), 9.0, (Uncertainty("s", 0.1, "1", dof=16.0),), np.array([[4.0]]))
    assert budget.combined == pytest.approx(5.0)
    assert budget.dof == pytest.approx(25.0)
    known = Budget(("k",), np.array([3.0]), None, (Uncertainty("s", 0.1, "1"),), np.array([[4.0]]))
    assert np.isinf(known.dof[0])


@pytest.mark.parametrize(("model", "cross"), [("rotor-2dof", "k_xy"), ("mdof", "k_x_y")])
def test_directions_of_forces_make_cross_terms_uncertain(rng, model: str, cross: str) -> None:
    """Two forces along x and y, one turned by half a degree: c_xy against refits with the direction
    changed.
    """
    w = 2 * np.pi * np.arange(20.0, 90.0, 0.5)
    stiffness, damping = np.array([[1e5, 1e4], [-1e4, 1.4e5]]), np.array([[60.0, 5.0], [4.0, 80.0]])
    z = stiffness - w[:, None, None] ** 2 * 0.9 * np.eye(2) + 1j * w[:, None, None] * damping
    h = np.linalg.inv(z)
    std = 1e-4 * np.max(np.abs(h))
    noisy = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    turned = ChannelUncertainty("direction", Uncertainty("fx.dof", np.radians(0.5), "rad"))

    def fitted(angle: float):
        outputs = (Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2))
        inputs = (Port("fx", "fx", "x", angle, (turned,)), Port("fy", "fy", "y", np.pi / 2))
        response = FrequencyResponse(
            w / (2 * np.pi), noisy, outputs, inputs, covariance=diagonal_covariance(np.full(h.shape, std**2))
        )
        return identify(response, FitSettings(model, mass=0.9, name="r"))[0]

    fit, (up, down) = fitted(0.0), [fitted(sign * np.radians(0.5)) for sign in (1, -1)]
    assert fit.budget is not None
    for name, combined in zip(fit.budget.names, fit.budget.combined, strict=True):
        expected = (up.parameter(name).value - down.parameter(name).value) / 2
        assert fit.budget.change_by("fx.dof", name) == pytest.approx(expected, abs=0.02 * combined)
    assert next(iter(fit.budget.shares(cross))) == "fx.dof"


def test_a_sensor_that_points_elsewhere_reads_the_motion_across(rng) -> None:
    """x at the angle d reads cos d x + sin d y; refits of such data.

    Isotropic rotors would not tell this from a turned force.
    """
    w = 2 * np.pi * np.arange(20.0, 90.0, 0.5)
    stiffness, damping, size = (
        np.array([[1e5, 1e4], [-1e4, 1.4e5]]),
        np.array([[60.0, 5.0], [4.0, 80.0]]),
        np.radians(0.5),
    )
    h = np.linalg.inv(stiffness - w[:, None, None] ** 2 * 0.9 * np.eye(2) + 1j * w[:, None, None] * damping)
    std = 1e-4 * np.max(np.abs(h))
    noisy = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    turned = ChannelUncertainty("direction", Uncertainty("x.dof", size, "rad"))

    def fitted(angle: float):
        outputs = (Port("x", "x", "x", 0.0, (turned,)), Port("y", "y", "y", np.pi / 2))
        inputs = (Port("fx", "fx", "x", 0.0), Port("fy", "fy", "y", np.pi / 2))
        matrix = noisy.copy()
        matrix[:, 0] = np.cos(angle) * noisy[:, 0] + np.sin(angle) * noisy[:, 1]
        response = FrequencyResponse(
            w / (2 * np.pi), matrix, outputs, inputs, covariance=diagonal_covariance(np.full(h.shape, std**2))
        )
        return identify(response, FitSettings("rotor-2dof", mass=0.9, name="r"))[0]

    # An angle that is written too large is a sensor that is turned back.
    fit, (up, down) = fitted(0.0), [fitted(-sign * size) for sign in (1, -1)]
    assert fit.budget is not None
    for name, combined in zip(fit.budget.names, fit.budget.combined, strict=True):
        expected = (up.parameter(name).value - down.parameter(name).value) / 2
        assert fit.budget.change_by("x.dof", name) == pytest.approx(expected, abs=0.02 * combined)


@pytest.mark.parametrize("away", [(-1.3, 1.1, 1.6, 0.2), (1.2, -0.8, -1.1, 0.9), (-0.5, 1.5, 0.4, 1.3)])
def test_directions_stated_to_four_degrees_contradict_no_sound_data(away: tuple[float, ...]) -> None:
    """Sensors and forces at angles d read and push along (cos d, sin d), exactly; *away* in standard
    uncertainties, whose squares, 0.5 % of H, are far above noise of .1 %: noise alone is left, by chi-square.
    """
    rng, w, size = np.random.default_rng(7), 2 * np.pi * np.arange(20.0, 90.0, 0.5), np.radians(4.0)
    stiffness, damping = np.array([[1e5, 1e4], [-1e4, 1.4e5]]), np.array([[60.0, 5.0], [4.0, 80.0]])
    h = np.linalg.inv(stiffness - w[:, None, None] ** 2 * 0.9 * np.eye(2) + 1j * w[:, None, None] * damping)
    true = np.array([0.0, np.pi / 2, 0.0, np.pi / 2]) - size * np.array(away)
    along = np.column_stack([np.cos(true), np.sin(true)])
    h = along[:2] @ h @ along[2:].T
    std = 1e-3 * np.max(np.abs(h))
    noisy = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    ports = [
        Port(name, name, name[-1], angle, (ChannelUncertainty("direction", Uncertainty(name, size, "rad")),))
        for name, angle in zip(("x", "y", "fx", "fy"), (0.0, np.pi / 2) * 2, strict=True)
    ]
    response = FrequencyResponse(
        w / (2 * np.pi),
        noisy,
        tuple(ports[:2]),
        tuple(ports[2:]),
        covariance=diagonal_covariance(np.full(h.shape, std**2)),
    )
    (fit,) = identify(response, FitSettings("rotor-2dof", mass=0.9, name="r"))
    assert {finding.code for finding in fit.findings} <= {"insignificant"}
    assert fit.gof.chi2_reduced == pytest.approx(1, abs=4 * np.sqrt(2 / fit.dof))


def test_a_single_sensor_says_that_it_does_not_know_what_it_reads_across(rng) -> None:
    turned = ChannelUncertainty("direction", Uncertainty("x.dof", np.radians(0.5), "rad"))

    def codes(angle: float) -> list[str]:
        response = a_response(rng, output=(turned,))
        response = dataclasses.replace(response, inputs=(Port("f", "f", "f", angle),))
        (fit,) = identify(response, FitSettings("rotor-2dof-direct", mass=M, name="r"))
        return [finding.code for finding in fit.findings]

    assert "number-uncertainty" in codes(np.pi / 4)
    # A force along x moves nothing along y.
    assert "number-uncertainty" not in codes(0.0)


@pytest.mark.parametrize(("mass", "draws"), [("0 kg +- 0.1 kg", 0), ("0.79 kg +- 60 %", 200)])
def test_a_mass_whose_uncertainty_reaches_zero_is_refused_in_these_words(rng, mass: str, draws: int) -> None:
    with pytest.raises(FitError, match=r"the uncertainty of the mass 0.* kg reaches zero"):
        identify(a_response(rng), settings("ml", mass=mass, monte_carlo=draws))


def test_a_mass_in_the_settings_keeps_its_uncertainty() -> None:
    given = settings("ml", mass="0.79 kg +- 1 % (k=2)")
    assert given.mass == 0.79
    assert dict(given.uncertainties)["mass"] == Uncertain(0.79, pytest.approx(0.00395))
    assert dataclasses.replace(given, estimator="ls").uncertainties == given.uncertainties


@pytest.mark.long
def test_monte_carlo_scatters_as_first_order_says(rng) -> None:
    """200 draws of noise, gains, delay and mass: scatter over the combined uncertainty within 4 standard
    deviations of a scatter.
    """
    (fit,) = identify(a_response(rng), settings("ml", mass="0.79 kg +- 0.5 %", monte_carlo=200))
    assert fit.budget is not None and fit.budget.drawn is not None
    np.testing.assert_allclose(fit.budget.drawn[:, 0] / fit.budget.combined, 1.0, atol=4 / np.sqrt(400))
    low, high = fit.parameter("k").ci95
    assert (low, high) == tuple(fit.budget.drawn[0, 1:])
    assert any("200 draws" in note for note in fit.notes)
    assert not [finding for finding in fit.findings if finding.code == "first-order"]


@pytest.mark.long
def test_a_large_uncertainty_is_beyond_first_order(rng) -> None:
    """c takes 1 / (1 - d) from the force sensor: with d of 30 % (one sigma) the scatter is far from linear,
    and it is said.
    """
    large = ChannelUncertainty("gain", Uncertainty("f.sensitivity", 0.3, "1"))
    (fit,) = identify(
        a_response(rng, output=(), force=(large,)), settings("ml", mass="0.79 kg", monte_carlo=200)
    )
    (finding,) = [finding for finding in fit.findings if finding.code == "first-order"]
    assert "c (" in finding.message and fit.budget is not None


def test_first_order_says_how_student_s_draws_scatter() -> None:
    """Scatter and excess kurtosis of a sum of noise 1 and a source of 2 by scipy's distributions."""
    for dof, shape, source in ((6, "normal", stats.t(6)), (None, "rectangular", stats.uniform(0, 12**0.5))):
        of_source = (Uncertainty("s", 1.0, "1", dof, shape),)
        (scatter,), (excess,) = Budget(
            ("k",), np.ones(1), None, of_source, np.full((1, 1), 2.0)
        ).scatter_of_draws()
        variance, kurtosis = source.stats("vk")
        assert scatter == pytest.approx(np.sqrt(1 + 4 * variance))
        assert excess == pytest.approx(kurtosis * (4 * variance) ** 2 / (1 + 4 * variance) ** 2)
    few = Budget(("k",), np.ones(1), None, (Uncertainty("s", 1.0, "1", 3),), np.full((1, 1), 2.0))
    assert np.isnan(few.scatter_of_draws()[0][0])


@pytest.mark.parametrize(("dof", "draws"), [(3.0, 200), (6.0, 400)])
def test_a_source_of_few_degrees_of_freedom_is_not_beyond_first_order(rng, dof: float, draws: int) -> None:
    """A gain of 1 % with 6 degrees of freedom scatters by sqrt(6 / 4) times it, to first order as well; of
    three degrees of freedom no scatter is compared.
    """
    few = ChannelUncertainty("gain", Uncertainty("f.sensitivity", 0.01, "1", dof=dof))
    response = a_response(rng, noise=1e-4, output=(), force=(few,))
    (fit,) = identify(response, settings("ml", mass="0.79 kg", monte_carlo=draws))
    assert not [finding for finding in fit.findings if finding.code == "first-order"]
    table = next(block for block in budget_blocks(fit) if isinstance(block, Table))
    ratio = next(row[-1] for row in table.rows if row[0] == "c")
    assert ratio == "none" if dof == 3.0 else float(ratio) == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("shape", ["normal", "rectangular", "triangular"])
def test_errors_are_drawn_by_their_distribution(rng, shape: str) -> None:
    """Standard deviation one, kurtosis 3, 9/5 and 12/5 (closed forms), within 5 standard deviations of 20,000
    draws.
    """
    draws = np.array([drawn_error(Uncertainty("s", 1.0, "1", None, shape), rng) for _ in range(20000)])
    assert np.std(draws) == pytest.approx(1.0, abs=0.03)
    expected = {"normal": 3.0, "rectangular": 1.8, "triangular": 2.4}[shape]
    assert np.mean(draws**4) / np.mean(draws**2) ** 2 == pytest.approx(expected, abs=0.2)
    if shape != "normal":
        assert np.max(np.abs(draws)) <= {"rectangular": 3**0.5, "triangular": 6**0.5}[shape]


def test_a_ring_down_s_stiffness_takes_the_uncertainty_of_its_mass() -> None:
    """k = m w_n^2: relative uncertainties of k and c are that of the mass and of the pole.

    F_n and zeta have none of it, and say so.
    """
    # One record in a hundred is called coloured by chance, and has no intervals then; this one is not.
    rng = np.random.default_rng(1)
    time = np.arange(4096) / 1024
    w, zeta = 2 * np.pi * 40, 0.01
    decay = np.exp(-zeta * w * time) * np.cos(w * np.sqrt(1 - zeta**2) * time) + 1e-3 * rng.standard_normal(
        time.size
    )
    decays = FreeDecays(1024.0, (Port("x", "x", "x"),), ("m",), (FreeDecay("r", 0.0, decay[:, None]),))
    (fit,) = identify(decays, FitSettings("decay", mass="2 kg +- 1 %", name="d"))
    assert fit.budget is not None
    k, f_n = fit.parameter("k"), fit.parameter("f_n_1")
    assert k.systematic == pytest.approx(0.01 * k.value)
    assert k.full_error == pytest.approx(np.hypot(0.01 * k.value, k.std_error))
    assert f_n.systematic == 0 and f_n.combined == f_n.std_error and f_n.std_error_inflated is None


def test_parameters_state_their_parts(rng) -> None:
    """combined, expanded = coverage factor times combined, and every source with contribution and share.

    Std_error stays that of noise.
    """
    (fit,) = identify(a_response(rng), settings("ml", mass="0.79 kg +- 0.5 %", coverage=0.99))
    k = fit.parameter("k")
    assert k.combined == pytest.approx(np.hypot(k.std_error, k.systematic))
    assert k.coverage_factor == pytest.approx(2.576, abs=0.02)
    assert k.expanded == pytest.approx(k.coverage_factor * k.combined)
    assert sum(part.share for part in k.budget) == pytest.approx(1.0)
    assert np.hypot.reduce([part.contribution for part in k.budget]) == pytest.approx(k.combined)
    assert k.budget[0].source == "mass 0.79 kg"


def test_the_report_and_rules_use_the_coverage_that_was_asked_for(rng) -> None:
    """99 %: k = 2.58 and the expanded uncertainty in the table are those of the parameter.

    A rule in per cent is compared with it.
    """
    (fit,) = identify(a_response(rng), settings("ml", mass="0.79 kg +- 0.5 %", coverage=0.99))
    table = next(block for block in budget_blocks(fit) if isinstance(block, Table))
    row = dict(zip(table.header, table.rows[0], strict=True))
    k = fit.parameter("k")
    assert (row["parameter"], row["k"]) == ("k", f"{k.coverage_factor:.2f}")
    relative = 100 * k.expanded / k.value
    assert float(row["relative"].split()[0]) == pytest.approx(relative, rel=0.02)
    for bound, holds in ((1.05 * relative, True), (0.95 * relative, False)):
        address = {
            "section": "accept",
            "address": "peak.k.expanded",
            "fit": "peak",
            "which": "",
            "item": "k.expanded",
        }
        rule = Rule(**address, kind="<=", bound=f"{bound} %", place="")
        (outcome,) = judge([rule], [fit], {})
        assert outcome.passed is holds


def test_draws_leave_the_model_error_in_the_interval() -> None:
    """Noise .3 and a gain .4 scatter by .5 about the model's own 9.5; with a model error of 1.2 about 10 the
    half-width is 1.96 x 1.3, the root of both squares. Without one the ends are those of the draws.
    """
    stated = Parameter("k", 10.0, "N/m", std_error=0.3, std_error_inflated=1.3, systematic=0.4, fitted=9.5)
    stated = dataclasses.replace(stated, ci95=(10 - 1.96 * 1.3, 10 + 1.96 * 1.3))
    drawn = (9.5 - 1.96 * 0.5, 9.5 + 1.96 * 0.5)
    assert with_drawn_interval(stated, *drawn).ci95 == pytest.approx(stated.ci95)
    sound = dataclasses.replace(stated, value=9.5, fitted=None, std_error_inflated=0.5)
    assert with_drawn_interval(sound, *drawn).ci95 == drawn


def test_draws_without_a_frequency_are_failed_refits() -> None:
    """Lines far above the natural frequency of 3.6 Hz tell k = 1000 N/m by one of its errors alone: in every
    sixth draw it is negative, and there is no f_n.
    """
    w = 2 * np.pi * np.linspace(90.0, 110.0, 15)
    h = (1 / (1e3 - 2.0 * w**2 + 5j * w))[:, None, None]
    gain = ChannelUncertainty("gain", Uncertainty("cell", 1e-4, "1"))
    force = Port("f", "f", "x", uncertainties=(gain,))
    variance = np.full(h.shape, 6e-5 * np.mean(np.abs(h) ** 2))
    response = FrequencyResponse(
        w / (2 * np.pi), h, (Port("y", "y", "x"),), (force,), covariance=diagonal_covariance(variance)
    )
    with pytest.raises(FitError, match="of 200 refits failed"):
        identify(response, FitSettings("sdof", mass=2.0, estimator="ls", name="p", monte_carlo=200))


def test_draws_take_a_contradicted_number_by_its_distance() -> None:
    """2.0 kg +- 0.1 % were stated of 2.02 kg: the draws scatter as the budget says, by ten times as much."""
    w = 2 * np.pi * np.linspace(90.0, 110.0, 15)
    h = (1 / (8.08e5 - 2.02 * w**2 + 14j * w))[:, None, None]
    ports = (Port("y", "y", "x"),), (Port("f", "f", "x"),)
    variance = np.full(h.shape, 1e-6 * np.mean(np.abs(h) ** 2))
    response = FrequencyResponse(w / (2 * np.pi), h, *ports, covariance=diagonal_covariance(variance))
    asked = FitSettings("sdof", mass=2.0, uncertainties=(("mass", Uncertain(2.0, 0.002)),), estimator="ls")
    plain, drawn = (
        identify(response, dataclasses.replace(asked, monte_carlo=draws))[0].parameter("k")
        for draws in (0, 200)
    )
    assert plain.systematic > 0.008 * plain.value
    assert np.ptp(drawn.ci95) == pytest.approx(np.ptp(plain.ci95), rel=0.15)


@pytest.mark.parametrize("dof", [3.0, 31.0, np.inf])
def test_the_coverage_that_is_asked_for_is_that_of_noise_alone_as_well(dof: float) -> None:
    """99 % by Student's t (scipy.stats) in place of half the 95 % interval; at 95 % nothing needs saying."""
    at_95, at_99 = stats.t.ppf([0.975, 0.995], dof)
    fit = a_fit("a", {"k": (1e5, 40.0)})
    k = dataclasses.replace(fit.parameters[0], ci95=(1e5 - 40.0 * at_95, 1e5 + 40.0 * at_95))
    fit = dataclasses.replace(fit, parameters=(k,))
    asked = with_contributions(fit, 0.99).parameter("k")
    assert asked.expanded == pytest.approx(40.0 * at_99, rel=1e-9) and asked.ci95 == k.ci95
    assert asked.coverage_factor == pytest.approx(at_99, rel=1e-9)
    assert with_contributions(fit, 0.95).parameter("k").expanded is None

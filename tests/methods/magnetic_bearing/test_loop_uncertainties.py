"""Uncertainties of channels, of the mass and of the support in comparisons of control loops, compared with
comparisons that are repeated.

Every change by a source is compared with the same comparison on data that are off by a thousandth of its
standard uncertainty to either side, by the factors X (1 - d), X e^{jwd}, X e^{jd} themselves, nothing of the
propagation used. The data themselves have no noise, though they state some, so that Gauss-Newton neglects
nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.measured import Measured
from labpipe.estimation.settings import Support
from labpipe.methods.magnetic_bearing.bearing import MagneticFile
from labpipe.methods.magnetic_bearing.certificate import certificate
from labpipe.methods.magnetic_bearing.comparisons import prediction
from labpipe.methods.magnetic_bearing.limits import LoopCertificateSettings
from labpipe.methods.magnetic_bearing.loop_fit import LoopFit, identifiability_findings, loop_fit
from labpipe.methods.magnetic_bearing.loop_problem import LoopObservation, View, receptance, with_unknowns
from labpipe.methods.magnetic_bearing.measured_margins import measured_margins
from labpipe.methods.magnetic_bearing.sensitivity import (
    loop_sensitivity,
    measured_sensitivity,
    peak_of,
    response_per_injection,
    sensitivity_matrix,
)
from labpipe.methods.magnetic_bearing.stability import sensitivity
from labpipe.project.judging import compare_number, comparison_outcome
from labpipe.project.rules import Rule
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Parameter
from labpipe.records.recording import Channel
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import ChannelSpectra, UncertainFactor
from labpipe.records.uncertain import ChannelUncertainty, MatrixError, Uncertain, Uncertainty
from labpipe.report.comparison import comparison_blocks
from labpipe.report.document import Figure, Table
from labpipe.uncertainty.compare import Evidence, compare
from labpipe.uncertainty.settings import CompareSettings, TheorySettings
from tests.methods.magnetic_bearing.certified import FILE, UNKNOWNS, response as of_signals
from tests.methods.magnetic_bearing.loop_cases import SUPPORT, bearing, measured
from tests.methods.magnetic_bearing.test_certificate import OWN

SIZES = {"gain": 0.002, "delay": 1e-6, "phase": 0.002}
GEOMETRY = bearing("hmb-geometry")
STEP = 1e-3
# The current has a kink over the delay where the command arrives as it is sampled, at 75 us.
LATER = with_unknowns(FILE, {"delay": 85e-6})


def uncertain(port: Port, *effects: str, source: str = "") -> Port:
    found = tuple(
        ChannelUncertainty(effect, Uncertainty(source or f"{port.label}.{effect}", SIZES[effect], "1"))
        for effect in effects
    )
    return replace(port, uncertainties=found)


def with_uncertainties(response: FrequencyResponse, *effects: str, source: str = "") -> FrequencyResponse:
    ports = {
        name: tuple(uncertain(port, *effects, source=source) for port in getattr(response, name))
        for name in ("outputs", "inputs")
    }
    return replace(response, **ports)


def thinned(response: FrequencyResponse, every: int) -> FrequencyResponse:
    lines = slice(None, None, every)
    return replace(
        response,
        frequency=response.frequency[lines],
        matrix=response.matrix[lines],
        covariance=response.covariance[lines],
    )


def off(response: FrequencyResponse, label: str, effect: str, error: float) -> FrequencyResponse:
    """The response whose channel *label* was corrected with a number that is too large by *error*."""
    omega = 2 * np.pi * response.frequency
    factor = {
        "gain": (1 - error) + 0 * omega,
        "delay": np.exp(1j * omega * error),
        "phase": np.exp(1j * error) + 0 * omega,
    }[effect]
    matrix = response.matrix.copy()
    for row, port in enumerate(response.outputs):
        if port.label == label:
            matrix[:, row] *= factor[:, None]
    for column, port in enumerate(response.inputs):
        if port.label == label:
            matrix[:, :, column] /= factor[:, None]
    return replace(response, matrix=matrix)


def slopes(of: Callable[[float], np.ndarray], size: float) -> np.ndarray:
    """Change by *size*, from a thousandth of it to either side."""
    return (of(STEP * size) - of(-STEP * size)) / (2 * STEP)


# ---- the measured sensitivity, without a model

FREQUENCY = np.arange(20.0, 400.0, 2.0)


def both_sides(noise: float = 1e-3) -> FrequencyResponse:
    true = sensitivity(bearing("hmb-magnetic").suspension(), 2 * np.pi * FREQUENCY)
    ports = tuple(Port(name, name, name) for name in ("before", "after"))
    covariance = np.broadcast_to(noise**2 * np.eye(2), (FREQUENCY.size, 2, 2)).astype(complex)
    matrix = np.stack([true - 1, true], axis=1)[:, :, None]
    return FrequencyResponse(
        FREQUENCY, matrix, ports, (Port("e", "e", "e"),), form="other", covariance=covariance
    )


@pytest.mark.parametrize("label", ["before", "after"])
@pytest.mark.parametrize("effect", list(SIZES))
def test_the_peak_and_its_frequency_follow_the_channels(label: str, effect: str) -> None:
    """Against the peak of responses whose channel is off."""
    plain = both_sides()

    def peak_at(error: float) -> np.ndarray:
        peak = peak_of(measured_sensitivity(off(plain, label, effect, error), "before", "after"))
        return np.array([peak.value, peak.frequency])

    one = measured_sensitivity(with_uncertainties(plain, effect), "before", "after")
    peak = peak_of(one)
    number = [error.uncertainty.source for error in one.errors].index(f"{label}.{effect}")
    expected = slopes(peak_at, SIZES[effect])
    found = [peak.changes[number], peak.frequency_changes[number]]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-9)


def assert_same(said: tuple[Parameter, ...], silent: tuple[Parameter, ...]) -> None:
    """Amounts with sources that change nothing, beside those without sources: the same to rounding."""
    for one, other in zip(said, silent, strict=True):
        assert one.name == other.name and one.value == pytest.approx(other.value, rel=1e-6)
        if other.std_error is not None:
            # Slopes over a hundredth of a standard error lose some digits.
            errors = [amount.combined or amount.std_error for amount in (one, other)]
            assert errors[0] == pytest.approx(errors[1], rel=1e-3), one.name
            assert one.std_error == pytest.approx(other.std_error, rel=1e-3), one.name


def test_what_both_sides_have_in_common_cancels() -> None:
    """One gain, delay or phase of both sides, and those of the recorded excitation, are not in the quotient:
    changes below 1e-12 of |S|.
    """
    plain = both_sides()
    common = with_uncertainties(plain, *SIZES, source="card")
    one = measured_sensitivity(common, "before", "after")
    assert [error.uncertainty.source for error in one.errors] == ["card"]
    assert np.max(np.abs(one.errors[0].change)) < 1e-12
    of_excitation = replace(plain, inputs=(uncertain(plain.inputs[0], *SIZES),))
    said, silent = (
        loop_sensitivity(CompareSettings(kind="sensitivity"), each, None) for each in (of_excitation, plain)
    )
    again = loop_sensitivity(CompareSettings(kind="sensitivity"), common, None)
    for found in (said, again):
        assert_same(found.amounts, silent.amounts)


def test_the_interval_of_the_peak_is_the_square_sum_of_noise_and_sources() -> None:
    """Random part that of the same response without uncertainties, systematic that of every source by itself;
    lines are as wide.
    """
    plain = both_sides()
    asked = CompareSettings(kind="sensitivity")
    whole = loop_sensitivity(asked, with_uncertainties(plain, *SIZES), bearing("hmb-magnetic"))
    bare = loop_sensitivity(asked, plain, bearing("hmb-magnetic"))
    singles = []
    for label in ("before", "after"):
        for effect in SIZES:
            outputs = tuple(
                uncertain(port, effect) if port.label == label else port for port in plain.outputs
            )
            singles.append(loop_sensitivity(asked, replace(plain, outputs=outputs), None))
    for name in ("peak", "peak_frequency"):
        found, noise = whole.amount(name), bare.amount(name)
        assert found.std_error == pytest.approx(noise.std_error) and found.value == pytest.approx(noise.value)
        parts = [one.amount(name).systematic or 0.0 for one in singles]
        assert found.systematic == pytest.approx(np.sqrt(np.sum(np.square(parts))))
        assert found.combined == pytest.approx(np.hypot(found.std_error, found.systematic))
        assert sum(part.share for part in found.budget) == pytest.approx(1)
        assert found.ci95 is not None and (found.ci95[1] - found.ci95[0]) / 2 == pytest.approx(found.expanded)
    peak, ratio = whole.amount("peak"), whole.amount("ratio")
    assert ratio.systematic / ratio.value == pytest.approx(peak.systematic / peak.value)
    assert peak.combined > 5 * peak.std_error
    curve, thin = whole.curves[0], bare.curves[0]
    top = int(np.argmax(curve.measured))
    assert curve.high[top] - curve.low[top] > 5 * (thin.high[top] - thin.low[top])


def test_margins_and_singular_values_follow_the_channels() -> None:
    """Of two coupled loops; both against the same computed on changed responses."""
    s = 2j * np.pi * FREQUENCY / 600
    loop = (
        np.array([[1.8, 0.5], [-0.4, 1.5]])[None]
        * ((1 + 0.9 * s) / (s**2 * (1 + 0.1 * s) - 0.3))[:, None, None]
    )
    true = np.linalg.inv(np.eye(2) + loop)
    covariance = np.broadcast_to(1e-6 * np.eye(8), (FREQUENCY.size, 8, 8)).astype(complex)
    outputs = tuple(Port(name, name, name) for name in ("bx", "by", "ax", "ay"))
    inputs = tuple(Port(name, name, name) for name in ("ex", "ey"))
    matrix = np.concatenate([true - np.eye(2), true], axis=1)
    plain = FrequencyResponse(FREQUENCY, matrix, outputs, inputs, form="other", covariance=covariance)

    def computed(response: FrequencyResponse) -> np.ndarray:
        found = sensitivity_matrix(response, ("bx", "by"), ("ax", "ay"))
        margins = measured_margins(
            FREQUENCY, found.loop(0).transfer, found.loop(0).transfer_changes, (np.inf, 1.96)
        )
        assert [one.name for one, _ in margins] == ["measured_phase_margin", "measured_delay_margin"]
        return np.array([found.largest()[0][90], *(one.value for one, _ in margins)])

    found = sensitivity_matrix(with_uncertainties(plain, *SIZES), ("bx", "by"), ("ax", "ay"))
    margins = measured_margins(
        FREQUENCY, found.loop(0).transfer, found.loop(0).transfer_changes, (np.inf, 1.96)
    )
    for number, error in enumerate(found.errors):
        label, _, effect = error.uncertainty.source.partition(".")
        told = [found.largest_changes()[number, 90], *(change[number] for _, change in margins)]
        expected = slopes(
            lambda d, label=label, effect=effect: computed(off(plain, label, effect, d)), SIZES[effect]
        )
        if label in ("ex", "ey"):
            assert np.max(np.abs(told)) < 1e-12
        else:
            np.testing.assert_allclose(told, expected, rtol=1e-4, atol=1e-9)


# ---- unknowns of a loop


def viewed(noise: float = 1e-3) -> View:
    view = measured(GEOMETRY, np.random.default_rng(3), noise=noise, support=(134.5e3, 3.68))
    return replace(
        view,
        response=replace(
            view.response, matrix=receptance(view, GEOMETRY, 2 * np.pi * view.response.frequency)
        ),
    )


NAMES = ("gap", "bandwidth")


def fitted(views: list[View], names: tuple[str, ...] = NAMES) -> LoopFit:
    return loop_fit([view.observation for view in views], names)


def values(views: list[View]) -> np.ndarray:
    return np.array(list(fitted(views).values().values()))


def change_by(fit: LoopFit, source: str) -> np.ndarray:
    assert fit.budget is not None
    return np.array([fit.budget.change_by(source, name) for name in NAMES])


@pytest.mark.long
def test_unknowns_of_a_prediction_follow_the_channels() -> None:
    plain = viewed()
    view = replace(plain, response=with_uncertainties(plain.response, *SIZES))
    fit = fitted([view])
    for label in ("y", "f"):
        for effect, size in SIZES.items():
            expected = slopes(
                lambda d, of=(label, effect): values([replace(view, response=off(view.response, *of, d))]),
                size,
            )
            np.testing.assert_allclose(change_by(fit, f"{label}.{effect}"), expected, rtol=1e-3)
    # One gain on both channels cancels.
    common = fitted(
        [replace(plain, response=with_uncertainties(plain.response, "gain", "delay", source="card"))]
    )
    assert_same(common.parameters, fitted([plain]).parameters)


@pytest.mark.long
def test_unknowns_of_a_prediction_follow_directions_mass_support_and_sums() -> None:
    view = viewed()
    angle, of_mass = 0.01, 0.005
    response = view.response
    turned = (
        ChannelUncertainty("direction", Uncertainty("f.dof", angle, "rad")),
        ChannelUncertainty("direction", Uncertainty("y.dof", angle, "rad")),
    )
    shape = response.matrix * (1 + 0.2j * np.sin(response.frequency))[:, None, None]
    sums = MatrixError(Uncertainty("arm", 1.0, "1"), 0.01 * shape)
    plain = view
    view = replace(
        view,
        response=replace(
            response,
            inputs=(replace(response.inputs[0], uncertainties=turned[:1]),),
            outputs=(replace(response.outputs[0], uncertainties=turned[1:]),),
            errors=(sums,),
        ),
        settings=replace(view.settings, uncertainties=(("mass", Uncertain(0.92, of_mass, source="scale")),)),
    )
    response = view.response
    fit = fitted([view])

    def at(error: float, label: str) -> np.ndarray:
        ports = {
            name: tuple(
                replace(port, angle=port.angle + error) if port.label == label else port
                for port in getattr(response, name)
            )
            for name in ("outputs", "inputs")
        }
        return values([replace(view, response=replace(response, **ports))])

    def on(support: Support) -> np.ndarray:
        return values([replace(view, settings=replace(view.settings, subtract=support))])

    expected = {
        "f.dof": slopes(lambda error: at(error, "f"), angle),
        "y.dof": slopes(lambda error: at(error, "y"), angle),
        "scale": slopes(
            lambda error: values([replace(view, settings=replace(view.settings, mass=0.92 + error))]), of_mass
        ),
        "arm": slopes(
            lambda d: values(
                [replace(view, response=replace(response, matrix=response.matrix + d * sums.change))]
            ),
            1.0,
        ),
        "stiffness of the support, 134.5 kN/m": slopes(
            lambda d: on(replace(SUPPORT, stiffness=Uncertain(134.5e3 + d, 100.0))), 100.0
        ),
        "damping of the support, 3.68 N.s/m": slopes(
            lambda d: on(replace(SUPPORT, damping=Uncertain(3.68 + d, 0.05))), 0.05
        ),
    }
    for source, change in expected.items():
        np.testing.assert_allclose(change_by(fit, source), change, rtol=1e-3, err_msg=source)
    # The support is fitted within its uncertainty: noise and support together leave what is known of the
    # unknowns.
    noise = fitted(
        [
            replace(
                plain, settings=replace(plain.settings, subtract=Support(Uncertain(134.5e3), Uncertain(3.68)))
            )
        ]
    )
    alone = fitted([plain])
    for one, other in zip(alone.parameters, noise.parameters, strict=True):
        assert one.std_error >= other.std_error and one.combined > one.std_error


def test_a_sensor_across_tells_what_a_turned_one_reads() -> None:
    """A probe along y whose direction is written d too large reads d of the motion along x, whatever the
    model says of that motion.
    """
    view = viewed()
    response = view.response
    across = replace(response.outputs[0], label="x", channel="x", dof="x", angle=0.0)
    turned = replace(
        response.outputs[0],
        uncertainties=(ChannelUncertainty("direction", Uncertainty("y.dof", 0.01, "rad")),),
    )
    settings, covariance = replace(view.settings, output=("y", "x")), response.covariance * np.eye(2)

    def case(matrix: np.ndarray, share: float, port: Port) -> View:
        both = np.concatenate([matrix, share * response.matrix], axis=1)
        return replace(
            view,
            response=replace(response, outputs=(port, across), matrix=both, covariance=covariance),
            settings=settings,
        )

    observation = case(response.matrix, 0.3, turned).observation
    (error,) = observation.errors(GEOMETRY, (134.5e3, 3.68))
    np.testing.assert_allclose(error.change[:, 0], 0.01 * 0.3 * response.matrix[:, 0], rtol=1e-12)
    assert not np.any(error.change[:, 1])
    expected = slopes(lambda d: values([case((1 + d) * response.matrix, 1.0, turned)]), 0.01)
    np.testing.assert_allclose(
        change_by(fitted([case(response.matrix, 1.0, turned)]), "y.dof"), expected, rtol=1e-3
    )


def test_tests_with_one_sensor_err_together() -> None:
    """Two tests with one force sensor: both are changed. With a sensor each, one test is off by itself."""
    first, other = viewed(), viewed(2e-3)

    def gauged(view: View, source: str) -> View:
        return replace(
            view,
            response=replace(
                view.response, inputs=(uncertain(view.response.inputs[0], "gain", source=source),)
            ),
        )

    both = [gauged(view, "cell") for view in (first, other)]
    expected = slopes(
        lambda d: values([replace(v, response=off(v.response, "f", "gain", d)) for v in both]), SIZES["gain"]
    )
    one = fitted(both)
    np.testing.assert_allclose(change_by(one, "cell"), expected, rtol=1e-3)
    each = [gauged(first, "cell 1"), gauged(other, "cell 2")]
    off_by_itself = slopes(
        lambda d: values([replace(each[0], response=off(each[0].response, "f", "gain", d)), each[1]]),
        SIZES["gain"],
    )
    np.testing.assert_allclose(change_by(fitted(each), "cell 1"), off_by_itself, rtol=1e-3)


def test_unknowns_of_a_sensitivity_follow_the_channels() -> None:
    plain = both_sides(1e-4)
    asked = CompareSettings(kind="sensitivity", theory=TheorySettings("hmb.yaml"), estimate=NAMES)

    def found(response: FrequencyResponse) -> np.ndarray:
        comparison = loop_sensitivity(asked, response, GEOMETRY)
        return np.array([comparison.amount(name).value for name in NAMES])

    plain = with_uncertainties(plain, *SIZES)
    whole = loop_sensitivity(asked, plain, GEOMETRY)
    _, budget = whole.budgets
    for label in ("before", "after"):
        for effect, size in SIZES.items():
            expected = slopes(lambda d, of=(label, effect): found(off(plain, *of, d)), size)
            told = np.array([budget.change_by(f"{label}.{effect}", name) for name in NAMES])
            sizes = np.array([whole.amount(name).combined for name in NAMES])
            np.testing.assert_allclose(told / sizes, expected / sizes, atol=2e-3, err_msg=f"{label}.{effect}")


@pytest.mark.long
@pytest.mark.parametrize("before", ["before", ""])
def test_what_a_certificate_says_follows_the_channels(before: str) -> None:
    """Unknowns, margins, modes and measured peak; with both sides of the sum, and per recorded excitation."""
    plain = of_signals(None, 1e-3, LATER)
    plain = with_uncertainties(thinned(plain, 8), "gain", "delay")
    own = {**OWN, "after": ["after"], **({"before": [before]} if before else {})}
    asked = CompareSettings(
        kind="certificate",
        theory=TheorySettings("b.yaml"),
        estimate=UNKNOWNS,
        kind_settings=LoopCertificateSettings(**own),
    )
    wanted = (*UNKNOWNS, "sensitivity_peak", "phase_margin", "log_decrement_1", "pole_real_1", "f_n_1")

    def found(response: FrequencyResponse) -> np.ndarray:
        comparison = certificate(asked, response, FILE)
        return np.array([comparison.amount(name).value for name in wanted])

    whole = certificate(asked, plain, FILE)
    changes = {name: budget for budget in whole.budgets for name in budget.names}
    sizes = np.array([whole.amount(name).combined for name in wanted])
    for label, effect in (
        [("before", "gain"), ("x", "delay")] if before else [("after", "delay"), ("e", "gain")]
    ):
        told = np.array([changes[name].change_by(f"{label}.{effect}", name) for name in wanted])
        expected = slopes(lambda d, of=(label, effect): found(off(plain, *of, d)), SIZES[effect])
        np.testing.assert_allclose(told / sizes, expected / sizes, atol=2e-3, err_msg=f"{label}.{effect}")
    limits = {"zone": "sensitivity_peak", "log_decrement": "log_decrement_1"}
    assert all(0 < whole.amount(f"probability_{name}").value <= 1 for name in limits)


@pytest.mark.long
def test_a_gain_of_all_signals_cancels_where_both_sides_of_the_sum_are_recorded() -> None:
    """Nor do gain and delay of the recorded excitation count; without *before* both do."""
    plain = thinned(of_signals(np.random.default_rng(2), 0.02, LATER), 4)
    asked = CompareSettings(
        kind="certificate",
        theory=TheorySettings("b.yaml"),
        estimate=UNKNOWNS,
        kind_settings=LoopCertificateSettings(before=["before"], after=["after"], **OWN),
    )
    common = replace(
        plain, outputs=tuple(uncertain(port, "gain", "delay", source="card") for port in plain.outputs)
    )
    excited = replace(plain, inputs=(uncertain(plain.inputs[0], *SIZES),))
    silent = certificate(asked, plain, FILE)
    for other in (common, excited):
        said = certificate(asked, other, FILE)
        assert_same(said.amounts, silent.amounts)
    alone = replace(asked, kind_settings=LoopCertificateSettings(after=["after"], **OWN))
    assert certificate(alone, excited, FILE).budgets


def test_chi_square_does_not_reject_what_uncertainties_explain() -> None:
    """Every number of the channels off by half a standard uncertainty.

    Without the uncertainties the loop is exposed.
    """
    view = measured(GEOMETRY, np.random.default_rng(8), noise=1e-3, support=(134.5e3, 3.68))
    response = view.response
    for label in ("y", "f"):
        for effect, size in SIZES.items():
            response = off(response, label, effect, 0.5 * size * (1 if label == "y" else -1))
    for names in ((), ("gap",)):
        plain = fitted([replace(view, response=response)], names)
        told = fitted([replace(view, response=with_uncertainties(response, *SIZES))], names)
        assert plain.chi2_p < 1e-6 < 0.01 < told.chi2_p
    # Another loop is none that these uncertainties explain.
    wrong = replace(
        view,
        response=with_uncertainties(response, *SIZES),
        file=with_unknowns(GEOMETRY, {"proportional": 1.3}),
    )
    assert fitted([wrong], ()).chi2_p < 1e-6


def test_bands_hold_what_given_numbers_leave() -> None:
    """A gain that is off by its uncertainty moves all bands.

    Intervals by noise alone would miss the prediction.
    """
    view = measured(GEOMETRY, np.random.default_rng(5), noise=2e-4, support=(134.5e3, 3.68))
    view = replace(view, settings=replace(view.settings, band=(1.0, 130.0)))
    asked = CompareSettings(kind="prediction", fit="sliding", theory=TheorySettings("b.yaml"))
    moved = off(view.response, "y", "gain", SIZES["gain"])

    def share(response: FrequencyResponse) -> float:
        one = replace(view, response=response, fits=identify(response, view.settings, judging=False))
        return prediction(asked, [one]).amount("share_k").value

    assert share(moved) < 0.6 < 0.9 <= share(with_uncertainties(moved, "gain"))


# ---- spectra of all channels, directions, first order, records


def spectra(response: FrequencyResponse, factors: tuple[UncertainFactor, ...]) -> ChannelSpectra:
    channels = tuple(
        Channel(
            name,
            "voltage",
            role,
            name,
            uncertainties=(
                ChannelUncertainty("gain", Uncertainty(f"{name}.gain", SIZES["gain"], "1", dof=7.0)),
            ),
        )
        for name, role in (("e", "input"), *((port.label, "output") for port in response.outputs))
    )
    vectors = np.concatenate([np.full((response.n_frequency, 1), 2.0), 2 * response.matrix[:, :, 0]], axis=1)[
        :, None
    ]
    covariance = np.zeros((response.n_frequency, 1, 5, 5), complex)
    covariance[:, 0, 1:, 1:] = 4 * response.covariance
    return ChannelSpectra(response.frequency, vectors, covariance, channels, ("run",), factors=factors)


def test_spectra_carry_the_uncertainties_of_channels_and_of_sums() -> None:
    """Factors of all channels' gains do what the same uncertainties do at the ports of the response.

    One in a sum moves its channel alone.
    """
    plain = thinned(of_signals(None, 1e-3, LATER), 8)
    gains = []
    for number, name in enumerate(["e", *(port.label for port in plain.outputs)]):
        derivative = np.zeros((5, 5), complex)
        derivative[number, number] = -1.0
        gains.append(
            UncertainFactor(f"{name}.gain", 0.0, SIZES["gain"], "1", derivative, source=f"{name}.gain")
        )
    arm = np.zeros((5, 5), complex)
    arm[3, 4] = 1.0
    made = response_per_injection(spectra(plain, (*gains, UncertainFactor("arm", 0.3, 0.01, "m", arm))))
    assert not any(port.uncertainties for port in (*made.outputs, *made.inputs))
    by_source = {error.uncertainty.source: error for error in made.errors}
    assert by_source["x.gain"].uncertainty.dof == 7.0
    expected = np.zeros(plain.matrix.shape, complex)
    expected[:, 2] = 0.01 * plain.matrix[:, 3]
    np.testing.assert_allclose(by_source["arm, 0.3 m"].change, expected)
    asked = CompareSettings(
        kind="certificate",
        theory=TheorySettings("b.yaml"),
        estimate=UNKNOWNS,
        kind_settings=LoopCertificateSettings(after=["after"], **OWN),
    )
    ours, theirs = (
        certificate(asked, replace(made, errors=made.errors[:-1]), FILE),
        certificate(asked, with_uncertainties(plain, "gain"), FILE),
    )
    for name in (*UNKNOWNS, "peak", "log_decrement_1"):
        assert ours.amount(name).systematic == pytest.approx(theirs.amount(name).systematic, rel=1e-6)


def test_a_direction_that_nothing_tells_is_said() -> None:
    plain = both_sides()
    uncertainty = ChannelUncertainty("direction", Uncertainty("before.dof", 0.01, "rad"))
    turned = replace(
        plain, outputs=(replace(plain.outputs[0], uncertainties=(uncertainty,)), plain.outputs[1])
    )
    asked = CompareSettings(kind="sensitivity", name="sensitivity")
    said, silent = (
        compare(asked, Evidence((), (one,), ())) for one in (turned, with_uncertainties(plain, "gain"))
    )
    (finding,) = [one for one in said.findings if one.code == "number-uncertainty"]
    assert "directions of before" in finding.message
    assert not [one for one in silent.findings if one.code == "number-uncertainty"]


def test_errors_that_first_order_does_not_tell_are_said() -> None:
    """Delay and gap of one response are known together far better than each.

    Two standard errors away the delay would be negative.
    """
    view = measured(GEOMETRY, np.random.default_rng(3), noise=0.08, support=(134.5e3, 3.68))
    both, one = fitted([view], ("gap", "delay")), fitted([view], ("gap",))
    assert [finding.code for finding in identifiability_findings(both)] == ["first-order"]
    assert not identifiability_findings(one)


def test_intervals_follow_the_course_of_the_response() -> None:
    """A response in proportion to 1 / bandwidth, a gain with an uncertainty: its interval is the reciprocal
    of a straight line's, in closed form.

    Estimate and error of x = 1000 Hz / bandwidth from H = x + noise over n lines: mean, s / root of 2 n by
    noise, x u by the gain.
    """
    n, noise, gain, gap = 40, 0.5, 0.05, 0.9
    port, force = (Port(name, name, name) for name in ("y", "f"))
    measured_x = Measured(
        omega=np.arange(1.0, n + 1),
        matrix=np.full((n, 1, 1), gap, complex),
        covariance=np.full((n, 1, 1), noise**2, complex),
        noise_dof=np.inf,
        noise_lines=1.0,
        outputs=(port,),
        inputs=(force,),
    )

    def predict(file: MagneticFile, _: tuple[float, float]) -> np.ndarray:
        return np.full((n, 1, 1), 1000.0 / file.loop.bandwidth, complex)

    error = MatrixError(Uncertainty("y.gain", gain, "1"), -gain * measured_x.matrix)
    fit = loop_fit(
        [LoopObservation(measured_x, predict, GEOMETRY, errors=lambda *_: (error,))], ("bandwidth",)
    )
    (found,) = fit.parameters
    u = np.hypot(noise / np.sqrt(2 * n), gap * gain)
    ends = 1000.0 / (gap + found.coverage_factor * u), 1000.0 / (gap - found.coverage_factor * u)
    assert found.value == pytest.approx(1000.0 / gap, rel=1e-6)
    assert found.combined == pytest.approx(1000.0 * u / gap**2, rel=1e-5)
    assert found.ci95 == pytest.approx(ends, rel=1e-3)
    # That of first order is even.
    assert ends[0] - (found.value - found.expanded) > 10 and ends[1] - (found.value + found.expanded) > 10


def test_an_unknown_at_the_edge_of_the_possible_is_held_there() -> None:
    """The response of a loop without delay, off by a gain: a negative delay would fit best, and none can
    be.
    """
    fast = with_unknowns(GEOMETRY, {"delay": 1e-9})
    view = measured(fast, np.random.default_rng(3), noise=1e-3, support=(134.5e3, 3.68))
    late = replace(view, response=off(view.response, "y", "delay", 2e-4), file=GEOMETRY)
    fit = fitted([late], ("delay",))
    assert fit.converged and fit.parameters[0].value == 0.0 and fit.parameters[0].at_bound
    assert [finding.code for finding in identifiability_findings(fit)] == ["at-bound", "first-order"]
    # Chi-square stays one, though no unknown can take what is left.
    told = fitted([replace(late, response=with_uncertainties(late.response, *SIZES))], ("delay",))
    assert 0 < told.chi2_reduced <= fit.chi2_reduced


@pytest.fixture(scope="module")
def certified() -> Comparison:
    asked = CompareSettings(
        kind="certificate",
        name="certificate",
        theory=TheorySettings("b.yaml"),
        estimate=UNKNOWNS,
        kind_settings=LoopCertificateSettings(after=["after"], before=["before"], **OWN),
    )
    return certificate(
        asked, with_uncertainties(thinned(of_signals(np.random.default_rng(1), 0.02, LATER), 4), "gain"), FILE
    )


def test_the_report_shows_the_shares_of_the_sources(certified: Comparison) -> None:
    blocks = comparison_blocks(certified, ())
    tables = [block for block in blocks if isinstance(block, Table) and block.header[0] == "source"]
    assert len(tables) == len(certified.budgets) == 3
    assert {"before.gain", "x.gain", "noise"} <= {row[0] for row in tables[0].rows} | {
        row[0] for row in tables[1].rows
    }
    assert (
        sum(isinstance(block, Figure) and "Shares of the sources" in block.caption for block in blocks) == 3
    )


def test_rules_ask_for_the_expanded_uncertainty(certified: Comparison) -> None:
    amount = certified.amount("sensitivity_peak")
    relative = 100 * amount.expanded / amount.value
    for attribute, wide, narrow in (("expanded", 1.01, 0.99), ("std_error", 1.01, 0.99)):
        for factor, passed in ((wide, True), (narrow, False)):
            bound = (
                f"{relative * factor:.6g} %" if attribute == "expanded" else f"{amount.combined * factor:.6g}"
            )
            item = f"sensitivity_peak.{attribute}"
            address = {
                "section": "accept",
                "address": f"certificate.{item}",
                "fit": "certificate",
                "which": "",
                "item": item,
            }
            rule = Rule(**address, kind="<=", bound=bound, place="here")
            assert comparison_outcome(rule, (certified,), compare_number).passed is passed

"""Loss factor: eta of k (1 + j eta) by sdof, mdof and modal against closed forms, from raw files and from
drawn FRFs.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import optimize

from labpipe.estimation.comparison import RelaxingMount
from labpipe.estimation.damping import HYSTERETIC, DampingLaw, Factor
from labpipe.estimation.fitting import identify
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import MODELS, FitSettings
from labpipe.records.response import FrequencyResponse, Port
from tests.estimation.conftest import DOFS, FORCES, MASS, STIFFNESS, with_noise

ETA = 0.04
# 3.1 kg on 240 kN/m: 44.3 Hz.
K, M = 240e3, 3.1
TRUTH = {"k": K, "eta": ETA, "f_n": np.sqrt(K / M) / (2 * np.pi)}


def one_mass(seed: int, noise: float = 2e-3) -> FrequencyResponse:
    frequency = np.arange(38.0, 51.0, 0.25)
    matrix = (1 / (K * (1 + 1j * ETA) - M * (2 * np.pi * frequency) ** 2))[:, None, None]
    return with_noise(
        frequency,
        matrix,
        (DOFS[0],),
        (FORCES[0],),
        noise * np.max(np.abs(matrix)),
        np.random.default_rng(seed),
    )


def structure(noise: float, seed: int) -> FrequencyResponse:
    """Knaapen's three masses with one loss factor, all of its H."""
    w = np.linspace(0.3, 2.2, 200)
    matrix = np.linalg.inv(STIFFNESS * (1 + 1j * ETA) - w[:, None, None] ** 2 * MASS)
    return with_noise(
        w / (2 * np.pi), matrix, DOFS, FORCES, noise * np.max(np.abs(matrix)), np.random.default_rng(seed)
    )


def test_a_recorded_multisine_gives_eta_within_its_interval(
    tmp_path: Path, labpipe: Callable[..., Any]
) -> None:
    # Exact steady state: the response of every line is the closed form times the force.
    rate, n, periods = 512.0, 2048, 6
    rng = np.random.default_rng(3)
    lines = np.arange(1, n // 2) * rate / n
    force = np.where((lines > 30) & (lines < 60), np.exp(2j * np.pi * rng.random(lines.size)), 0)
    h = 1 / (K * (1 + 1j * ETA) - M * (2 * np.pi * lines) ** 2)
    f, x = (
        np.tile(np.fft.irfft(np.concatenate([[0], line, [0]]), n) * n, periods) for line in (force, force * h)
    )
    x = x + 2e-3 * np.std(x) * rng.standard_normal(x.size)
    table = "\n".join(f"{a:.9g},{b:.9g}" for a, b in zip(f, x, strict=True))
    (tmp_path / "run.csv").write_text(f"f [N],x [m]\n{table}\n")
    (tmp_path / "rig.yaml").write_text(
        f"name: Rubber mount\nsample_rate: {rate:g} Hz\nmass: {M} kg\nchannels:\n"
        '  f: {column: "f [N]", quantity: force, unit: N, role: input, dof: x}\n'
        '  x: {column: "x [m]", quantity: displacement, unit: m, role: output, dof: x}\n'
    )
    (tmp_path / "p.yaml").write_text(
        f"rig: rig.yaml\nrecordings: run.csv\nfrf: {{excitation: periodic, period: {n / rate:g} s}}\n"
        "identify:\n  mount: {model: sdof, damping: hysteretic, band: 38-51 Hz}\n"
        "accept: {mount.eta: 0.04 +- 5 %}\n"
    )
    result = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert result.code == 0, result.err
    (fit,) = json.loads((tmp_path / "out/identification.json").read_text())["fits"]
    found = {parameter["name"]: parameter for parameter in fit["parameters"]}
    assert set(found) == {"k", "eta", "f_n"}
    for name, value in TRUTH.items():
        assert abs(found[name]["value"] - value) < 4 * found[name]["std_error"]
        assert found[name]["std_error"] < 1e-2 * value


def test_a_viscous_fit_of_a_loss_factor_is_told_the_law_of_its_damping() -> None:
    """FRFs drawn from the closed forms: viscous k and c where k (1 + j eta) is true, and both ways no law."""
    (fit,) = identify(one_mass(1, 2e-4), FitSettings("sdof", mass=M))
    (mismatch,) = (finding.message for finding in fit.findings if finding.code == "model-mismatch")
    assert (
        "; most likely hysteretic damping. " in mismatch and fit.parameter("k").reason == "hysteretic damping"
    )
    assert "as noise alone makes them, or wider by that law's values" in mismatch
    (other,) = (finding.message for finding in fit.findings if finding.code == "other-model")
    assert "'sdof, hysteretic damping' with 2 parameters" in other
    # Over a wide band the viscous stiffness is 1.2 % off: its interval holds that of the law, too.
    frequency = np.arange(10.0, 150.0, 0.5)
    h = (1 / (K * (1 + 0.16j) - M * (2 * np.pi * frequency) ** 2))[:, None, None]
    rng = np.random.default_rng(2)
    wide = with_noise(frequency, h, (DOFS[0],), (FORCES[0],), 2e-3 * np.max(np.abs(h)), rng)
    (fit,) = identify(wide, FitSettings("sdof", mass=M))
    w_n = np.sqrt(K / M)
    for name, value in {"k": K, "f_n": TRUTH["f_n"], "c": 0.16 * K / w_n, "zeta": 0.08}.items():
        low, high = fit.parameter(name).ci95
        assert low < value < high and high - low < 0.03 * value
    # A delay that is small beside the law leaves a residual of both, and is not taken for all of it.
    late = replace(wide, matrix=h * np.exp(-2j * np.pi * frequency * 10e-6)[:, None, None])
    (fit,) = identify(replace(late, covariance=wide.covariance / 100), FitSettings("sdof", mass=M))
    assert fit.parameter("k").reason == "hysteretic damping"
    assert not any(finding.code == "delay" for finding in fit.findings)
    # Stiffness over frequency is neither law: no other one is named.
    response = one_mass(1, 2e-4)
    stiffer = 1 + 0.5 * np.sqrt(1j * response.frequency / 44.3)
    h = 1 / (K * stiffer - M * (2 * np.pi * response.frequency) ** 2)
    for other in (replace(response, matrix=h[:, None, None]), one_mass(1, 0.02)):
        (fit,) = identify(other, FitSettings("sdof", mass=M))
        assert not any("hysteretic" in finding.message for finding in fit.findings) and not fit.candidates


@pytest.mark.long
def test_intervals_of_one_mass_are_the_scatter() -> None:
    fits = [identify(one_mass(seed), FitSettings("sdof", damping="hysteretic"))[0] for seed in range(60)]
    for name, value in (*TRUTH.items(), ("m", M)):
        pulls = [(fit.parameter(name).value - value) / fit.parameter(name).std_error for fit in fits]
        # Mean and variance of 60 normal numbers, four of their deviations.
        assert abs(np.mean(pulls)) < 4 / np.sqrt(60) and np.mean(np.square(pulls)) == pytest.approx(
            1, abs=4 * np.sqrt(2 / 60)
        )
    assert np.mean([fit.gof.chi2_reduced for fit in fits]) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("mass", [(1.0, 2.0, 3.0), "estimate"])
def test_a_structure_has_one_loss_factor_and_its_undamped_frequencies(mass: object) -> None:
    settings = FitSettings("mdof", mass=mass, symmetric=True, damping="hysteretic")
    (fit,) = identify(structure(1e-4, 5), settings)
    exact = np.sort(np.sqrt(np.linalg.eigvals(np.linalg.solve(MASS, STIFFNESS)).real)) / (2 * np.pi)
    for name, value in (("eta", ETA), ("k_1_1", 2.0), *((f"f_n_{r + 1}", f) for r, f in enumerate(exact))):
        parameter = fit.parameter(name)
        assert abs(parameter.value - value) < 4 * parameter.std_error and parameter.std_error < 1e-3 * value
    # Of one pole w sqrt(1 + j eta), zeta = sin(atan(eta) / 2).
    assert fit.parameter("zeta_2").value == pytest.approx(np.sin(np.arctan(ETA) / 2), rel=1e-3)
    assert not [parameter for parameter in fit.parameters if parameter.name.startswith("c_")]


def test_modes_have_the_loss_factor_and_the_modal_mass_of_the_structure() -> None:
    (fit,) = identify(structure(1e-4, 5), FitSettings("modal", damping="hysteretic"))
    assert not [parameter for parameter in fit.parameters if parameter.name.startswith(("zeta", "c_"))]
    exact = np.sort(np.sqrt(np.linalg.eigvals(np.linalg.solve(MASS, STIFFNESS)).real)) / (2 * np.pi)
    for r, f in enumerate(exact, start=1):
        for name, value in ((f"eta_{r}", ETA), (f"f_n_{r}", f)):
            parameter = fit.parameter(name)
            assert (
                abs(parameter.value - value) < 4 * parameter.std_error and parameter.std_error < 1e-2 * value
            )
    # H = sum phi phi^T / (m (w_r^2 (1 + j eta) - w^2)): at a driving point k / m is w_r^2.
    assert fit.parameter("k_1").value / fit.parameter("m_1").value == pytest.approx(
        (2 * np.pi * exact[0]) ** 2, rel=1e-3
    )
    shapes = np.linalg.eig(np.linalg.solve(MASS, STIFFNESS))[1].T
    masses = [np.min(s @ MASS @ s / s**2) for s in shapes]
    assert fit.parameter("m_1").value == pytest.approx(
        min(masses, key=lambda m: abs(m - fit.parameter("m_1").value)), rel=5e-3
    )


@pytest.mark.parametrize(("damper", "mass"), [(0.0, M), (20.0, M), (0.0, "estimate")])
def test_a_mount_that_relaxes_is_named_and_its_stiffness_at_resonance_held(damper: float, mass: Any) -> None:
    """Zener's solid, 70 kN/m at rest and 95 far above 30 Hz: Re K(w_n) = m w_n^2 by bisection."""
    frequency = np.arange(20.0, 60.0, 0.5)

    def stiffness(f: Any) -> Any:
        return 70e3 + 2j * np.pi * f * damper + 25e3 * (1j * f / 30) / (1 + 1j * f / 30)

    h = (1 / (stiffness(frequency) - 2.0 * (2 * np.pi * frequency) ** 2))[:, None, None]
    response = with_noise(
        frequency, h, (DOFS[0],), (FORCES[0],), 2e-3 * np.max(np.abs(h)), np.random.default_rng(5)
    )
    (fit,) = identify(response, FitSettings("sdof", mass=2.0 if mass == M else mass))
    (message,) = (finding.message for finding in fit.findings if finding.code == "model-mismatch")
    assert "most likely stiffness that rises with frequency, as of rubber: " in message
    assert message.endswith("Fit `sliding` bands, each with its own k and c")
    f_n = optimize.brentq(lambda f: stiffness(f).real - 2.0 * (2 * np.pi * f) ** 2, 20.0, 60.0)
    k, c = stiffness(f_n).real, stiffness(f_n).imag / (2 * np.pi * f_n)
    for name, value in {"k": k, "c": c, "f_n": f_n, "zeta": stiffness(f_n).imag / (2 * k)}.items():
        low, high = fit.parameter(name).ci95
        assert low < value < high, name
    assert fit.parameter("k").reason == "stiffness that rises with frequency"


@pytest.mark.parametrize(
    ("low", "high", "mass"), [(15.0, 60.0, 2.0), (15.0, 60.0, "estimate"), (28.0, 39.0, 2.0)]
)
def test_a_stiffness_of_a_power_of_frequency_is_held(low: float, high: float, mass: Any) -> None:
    """60 kN/m + 8 kN/m (j f / 1 Hz)^.35, closed form: no Zener solid, whose values are beside these."""
    frequency = np.arange(low, high, 0.25)

    def stiffness(f: Any) -> Any:
        return 60e3 + 8e3 * (1j * f) ** 0.35

    h = (1 / (stiffness(frequency) - 2.0 * (2 * np.pi * frequency) ** 2))[:, None, None]
    f_n = optimize.brentq(lambda f: stiffness(f).real - 2.0 * (2 * np.pi * f) ** 2, 20.0, 60.0)
    k, c = stiffness(f_n).real, stiffness(f_n).imag / (2 * np.pi * f_n)
    noise, rng = 2e-3 * np.max(np.abs(h)), np.random.default_rng(2)
    (fit,) = identify(
        with_noise(frequency, h, (DOFS[0],), (FORCES[0],), noise, rng), FitSettings("sdof", mass=mass)
    )
    for name, value in {"k": k, "c": c, "f_n": f_n, "zeta": stiffness(f_n).imag / (2 * k), "m": 2.0}.items():
        if name in {parameter.name for parameter in fit.parameters}:
            ends = fit.parameter(name).ci95
            assert ends[0] < value < ends[1], name


def test_a_small_loss_factor_is_no_delay() -> None:
    """eta = .05 in closed form: near the resonance a delay turns H as the loss factor does; over the band it
    does not, and is not named.
    """
    frequency = np.arange(28.0, 51.0, 0.25)
    h = (1 / (K * (1 + 0.05j) - M * (2 * np.pi * frequency) ** 2))[:, None, None]
    rng = np.random.default_rng(1)
    response = with_noise(frequency, h, (DOFS[0],), (FORCES[0],), 1e-3 * np.max(np.abs(h)), rng)
    (fit,) = identify(response, FitSettings("sdof", mass=M))
    assert fit.parameter("k").reason == "hysteretic damping"
    assert not any(finding.code == "delay" for finding in fit.findings)


def test_cross_terms_that_a_direct_model_is_without_are_named_and_held() -> None:
    """k_xy = -k_yx = 40 kN/m beside 900 and 1300, closed form, one force at 45 deg: the direct k_yy is 4 %
    off, 1/1490 of it by noise.
    """
    frequency, k = np.arange(15.0, 110.0), np.array([[9e5, 4e4], [-4e4, 1.3e6]])
    w = 2 * np.pi * frequency[:, None, None]
    z = k + 1j * w * np.diag([900.0, 1500.0]) - 8.0 * w**2 * np.eye(2)
    h = np.linalg.solve(z, np.full((2, 1), np.sqrt(0.5)))
    ports = [Port(name, name, name) for name in "xy"], (Port("f", "f", "", np.pi / 4),)
    rng = np.random.default_rng(3)
    response = with_noise(frequency, h, tuple(ports[0]), ports[1], 1e-3 * np.max(np.abs(h)), rng)
    (fit,) = identify(response, FitSettings("rotor-2dof-direct", mass=8.0))
    (message,) = (finding.message for finding in fit.findings if finding.code == "model-mismatch")
    assert "; most likely cross terms of x and y. " in message
    for name, value in {"k_xx": 9e5, "k_yy": 1.3e6, "c_xx": 900.0, "c_yy": 1500.0}.items():
        low, high = fit.parameter(name).ci95
        assert low < value < high, name


@pytest.mark.parametrize(("mass", "reference"), [(2.0, 0.0), (None, 0.0), (None, 200.0)])
def test_slopes_of_a_mount_that_relaxes_are_central_differences(mass: float | None, reference: float) -> None:
    model, omega = RelaxingMount(mass, reference), np.array([50.0, 200.0, 400.0])
    start = np.array([70e3, 20.0, 25e3, 0.005, 2.0])[: len(model.names)]
    jacobian = model.jacobian(start, omega)
    for number, step in enumerate(1e-5 * np.diag(start)):
        difference = model.receptance(start + step, omega) - model.receptance(start - step, omega)
        np.testing.assert_allclose(jacobian[number], difference / (2 * step[number]), rtol=1e-6, atol=1e-15)


def test_slopes_are_central_differences() -> None:
    settings = FitSettings(
        "mdof", mass=(1.0, 2.0, 3.0), symmetric=True, damping="hysteretic", fixed=(("k_1_3", 0.1),)
    )
    model = HYSTERETIC(MODELS["mdof"].model(Setup(DOFS, FORCES, settings)).fix("k_1_3", 0.1))
    start, omega = 1 + 0.1 * np.arange(len(model.names)), np.array([0.3, 1.1, 2.2])
    jacobian = model.jacobian(start, omega)
    for number in range(start.size):
        step = 1e-6 * np.eye(start.size)[number]
        difference = (model.receptance(start + step, omega) - model.receptance(start - step, omega)) / 2e-6
        np.testing.assert_allclose(jacobian[number], difference, rtol=1e-5, atol=1e-8)


def test_a_negative_loss_factor_is_unphysical() -> None:
    response = one_mass(1)
    (fit,) = identify(
        replace(response, matrix=response.matrix.conj()), FitSettings("sdof", damping="hysteretic")
    )
    assert "eta is negative" in next(
        finding.message for finding in fit.findings if finding.code == "unphysical"
    )


def test_a_law_of_another_package_is_one_line() -> None:
    # C = beta K of one mass: beta = c / k, told as well as these are.
    law = DampingLaw(
        "stiffness-only",
        (Factor("beta", "s", "stiffness", "damping", lambda stiffness, _: stiffness),),
        1,
        True,
    )
    model = law(MODELS["sdof"].model(Setup((DOFS[0],), (FORCES[0],), FitSettings("sdof"))))
    assert model.names == ("k", "m", "beta")
    values = dict(zip(model.names, model.from_linear(np.array([K, 300.0, M])), strict=True))
    assert values == {"k": K, "m": M, "beta": pytest.approx(300.0 / K)}
    np.testing.assert_allclose(model.whole(np.array([K, M, 1e-3])).damping, [[1e-3 * K]])

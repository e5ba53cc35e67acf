"""Model magnet: exact on clean spectra, held currents, sensors beside the magnets, uncertainties, false
minima, refusals, report.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg, optimize

from labpipe.artefacts.identification_file import fit_entry, read_fit
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.magnetic_bearing.balance import Between, MagnetModel
from labpipe.methods.magnetic_bearing.settings import MagnetSettings
from labpipe.project.rig_file import load_rig
from labpipe.records.identification import Fit, Identification
from labpipe.records.recording import Channel
from labpipe.records.spectra import ChannelSpectra, UncertainFactor
from labpipe.records.uncertain import Uncertain
from labpipe.report.build import build
from labpipe.report.document import Figure
from tests.methods.magnetic_bearing.levitated import COUPLED, Rotor

FIT = (
    "mass",
    "estimator",
    "input",
    "output",
    "band",
    "bands",
    "sliding",
    "eliminate",
    "compare",
    "uncertainties",
)


def fitted(spectra: ChannelSpectra, **keys: object) -> Fit:
    fit = {"mass": 4.0, **{key: keys.pop(key) for key in FIT if key in keys}}
    (found,) = identify(
        spectra, FitSettings("magnet", name="magnet", model_settings=MagnetSettings(**keys), **fit)
    )  # type: ignore[arg-type]
    return found


def values(fit: Fit) -> np.ndarray:
    return np.array([p.value for p in fit.parameters])


def test_clean_spectra_give_the_truth() -> None:
    fit = fitted(Rotor().spectra())
    assert [p.name for p in fit.parameters] == ["k_i", "k_s"]
    assert values(fit) == pytest.approx([80.0, -2e5], rel=1e-8)
    fit = fitted(COUPLED.spectra())
    assert [p.name for p in fit.parameters] == [
        f"k_{kind}_{a}{b}" for kind in "is" for a in "xy" for b in "xy"
    ]
    assert values(fit) == pytest.approx([*COUPLED.k_i.ravel(), *COUPLED.k_s.ravel()], rel=1e-7)


def test_direct_coupling_estimates_direct_terms_only() -> None:
    fit = fitted(
        replace(COUPLED, k_i=np.diag([80.0, 76.0]), k_s=np.diag([-2e5, -1.8e5])).spectra(), coupling="direct"
    )
    expected = {"k_i_xx": 80, "k_i_yy": 76, "k_s_xx": -2e5, "k_s_yy": -1.8e5}
    assert {p.name: p.value for p in fit.parameters} == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("bandwidth", [None, 1500.0, 200.0])
def test_a_held_output_is_part_of_the_model(bandwidth: float | None) -> None:
    """X / I at the samples by the matrix exponential of mass, magnet and amplifier under a held voltage, at 4
    kHz up to 1.5 kHz.
    """
    rate, mass, k_i, k_s, c = 4000.0, 4.0, 80.0, -2e5, 100.0
    slope = np.zeros((4, 4))
    slope[0, 1], slope[1, :3] = 1.0, [-k_s / mass, -c / mass, k_i / mass]
    corner = 2 * np.pi * (bandwidth or 1e7)
    slope[2, 2], slope[2, 3] = -corner, corner
    step = linalg.expm(slope / rate)
    frequency = np.arange(10.0, 1500.0, 20.0)
    z = np.exp(2j * np.pi * frequency / rate)[:, None]
    state = np.linalg.solve(
        z[..., None] * np.eye(3) - step[:3, :3], np.broadcast_to(step[:3, 3:], (frequency.size, 3, 1))
    )[..., 0]
    # Without an amplifier the current is the held voltage itself.
    current = state[:, 2] if bandwidth else np.ones_like(state[:, 2])
    vectors = np.stack([current, state[:, 0]], axis=1)[:, None]
    rotor = Rotor(frequency=frequency)
    noise = np.broadcast_to(np.diag([1e-8, 1e-16]).astype(complex), (frequency.size, 1, 2, 2))
    held = fitted(
        rotor.record(vectors, noise), hold="4 kHz", amplifier_bandwidth=bandwidth, passive_damping=True
    )
    assert values(held)[:2] == pytest.approx([k_i, k_s], rel=2e-4)
    # The difference quotient of the damping departs by (w T)^2 / 6 at the lines that tell it.
    assert values(held)[2] == pytest.approx(c, rel=2e-3)
    smooth = fitted(rotor.record(vectors, noise), passive_damping=True)
    # A held current taken for smooth costs -0.2 to -0.7 % of k_s.
    assert 0.002 < 1 - smooth.parameter("k_s").value / k_s < 0.007


def test_the_held_balance_is_the_smooth_one_at_high_rates() -> None:
    """B_held = B of the smooth current e^{-j w T / 2} late, to order (w T)^2."""
    model = MagnetModel(("k_i", "k_s"), (("k_i", 0, 0), ("k_s", 0, 0)), np.array([[4.0]]))
    omega, point = np.array([200.0, 900.0]), np.array([80.0, -2e5])
    held = replace(model, between=Between(1e6)).rows(point, omega)
    smooth = model.rows(point, omega) * np.stack([np.exp(-0.5j * omega * 1e-6), np.ones(2)], axis=1)[:, None]
    np.testing.assert_allclose(held, smooth, rtol=1e-6)


@pytest.mark.parametrize(
    ("late", "name"),
    [([1, 0, 0, 0], "ix"), pytest.param([0, 0, 1, 1], "every reading", marks=pytest.mark.long)],
)
def test_the_channel_that_is_late_is_named(late: list[int], name: str, rng: np.random.Generator) -> None:
    """0.2 ms of one channel of four, and of both readings; the values with it are those of the rotor."""
    spectra = COUPLED.spectra(rng)
    turned = np.exp(-1j * COUPLED.omega[:, None, None] * 2e-4 * np.array(late))
    fit = fitted(replace(spectra, vectors=spectra.vectors * turned))
    (said,) = [finding.message for finding in fit.findings if finding.code == "delay"]
    delay, error = re.search(r"is late by ([\d.]+) \+- ([\d.]+) us", said).groups()
    stiffness, of_stiffness = re.search(r"k_s_xx = (-[\d.]+) \+- ([\d.]+) kN/m", said).groups()
    assert said.startswith(name) and abs(float(delay) - 200) < 3 * float(error) < 10
    assert abs(float(stiffness) + 200) < 3 * float(of_stiffness) < 3


LONG = {"mass": 4.0, "inertia": 0.05, "magnets": (-0.1, 0.14), "sensors": (-0.13, 0.16)}


def long_rotor(position: bool = True) -> ChannelSpectra:
    """Two magnets and two sensors in one plane of a rigid rotor: centre and slope by their own equations of
    motion.
    """
    rotor = Rotor()
    magnets, sensors = (np.column_stack([np.ones(2), LONG[name]]) for name in ("magnets", "sensors"))
    k_i, k_s = np.diag([80.0, 60.0]), np.diag([-2e5, -1.5e5])
    w = rotor.omega[:, None, None]
    inertia = np.diag([LONG["mass"], LONG["inertia"]])
    motion = np.linalg.solve(
        magnets.T @ k_s @ magnets - w**2 * inertia, (magnets.T @ k_i).astype(complex)[None]
    )
    vectors = np.concatenate(
        [np.broadcast_to(0.1 * np.eye(2), motion.shape), sensors @ motion * 0.1], axis=1
    ).swapaxes(1, 2)
    places = {name: LONG[name] if position else (None, None) for name in ("magnets", "sensors")}
    channels = [
        Channel(f"i{e}", "current", "input", f"{e}x", position=places["magnets"][k])
        for k, e in enumerate("ab")
    ]
    channels += [
        Channel(e, "displacement", "output", f"{e}x", position=places["sensors"][k])
        for k, e in enumerate("ab")
    ]
    noise = np.broadcast_to(np.diag([1e-10, 1e-10, 1e-16, 1e-16]).astype(complex), (w.size, 2, 4, 4))
    return ChannelSpectra(rotor.frequency, vectors, noise, tuple(channels), ("a", "b"))


def test_sensors_beside_the_magnets_of_a_rigid_rotor() -> None:
    fit = fitted(long_rotor(), inertia="0.05 kg.m^2")
    expected = {"k_i_ax_ax": 80.0, "k_i_bx_bx": 60.0, "k_s_ax_ax": -2e5, "k_s_bx_bx": -1.5e5}
    assert {p.name: p.value for p in fit.parameters} == pytest.approx(expected, rel=1e-7)
    assert len(fitted(long_rotor(), inertia="0.05 kg.m^2", coupling="full").parameters) == 8


def test_positions_stand_in_the_rig_file(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        "sample_rate: 2 kHz\nchannels:\n  i: {quantity: current, role: input, dof: ax, position: 120 mm}\n"
    )
    assert load_rig(path).channels[0].channel.position == pytest.approx(0.12)


def test_all_is_in_proportion_to_the_mass() -> None:
    """k_i and k_s have its relative uncertainty, exactly."""
    fit = fitted(Rotor().spectra(np.random.default_rng(1)), uncertainties=(("mass", Uncertain(4.0, 0.02)),))
    for parameter in fit.parameters:
        assert parameter.systematic == pytest.approx(abs(parameter.value) * 0.02 / 4.0, rel=1e-4)
        assert parameter.combined == pytest.approx(
            np.hypot(parameter.std_error, parameter.systematic), rel=1e-6
        )


def test_a_gain_of_the_probe_is_one_of_k_i_alone() -> None:
    """K_s X - w^2 M X = K_i I: 1 % of X is 1 % of K_i and nothing of K_s."""
    spectra = Rotor().spectra()
    factor = UncertainFactor("gain of x", 1.0, 0.01, "1", np.diag([0.0, 1.0]).astype(complex))
    fit = fitted(replace(spectra, factors=(factor,)))
    assert fit.parameter("k_i").systematic == pytest.approx(0.8, rel=1e-4)
    assert (fit.parameter("k_s").systematic or 0.0) < 1.0


def test_a_stated_delay_explains_what_the_least_sum_of_both_squares_does() -> None:
    """Chi-square of few periods beside the minimum over the delay itself, fitted at each of its values."""
    spectra, error = COUPLED.spectra(np.random.default_rng(2), 8), 2e-5
    omega, vectors = 2 * np.pi * spectra.frequency[:, None, None], spectra.vectors.copy()
    vectors[..., 2:] *= np.exp(-1j * omega * error)
    late = UncertainFactor("delay", 0.0, error, "s", np.diag([0, 0, -1j, -1j]), power=1)
    stated = fitted(replace(spectra, vectors=vectors, factors=(late,)))
    dof = 4 * spectra.frequency.size * 2 - len(stated.parameters)

    def squares(deviation: float) -> float:
        early = vectors.copy()
        early[..., 2:] *= np.exp(1j * omega * deviation * error)
        return fitted(replace(spectra, vectors=early)).gof.chi2_reduced * dof + deviation**2

    least = optimize.minimize_scalar(squares, bounds=(0.0, 2.0), method="bounded").fun
    explained = squares(0.0) - stated.gof.chi2_reduced * dof
    assert explained == pytest.approx(squares(0.0) - least, rel=0.03)


def test_the_inertia_s_uncertainty_counts() -> None:
    """One per cent more of mass and of inertia together is one per cent of everything."""
    fit = fitted(long_rotor(), inertia="0.05 kg.m^2 +- 1 %", uncertainties=(("mass", Uncertain(4.0, 0.04)),))
    changes = fit.budget.changes.sum(axis=0)
    np.testing.assert_allclose(changes, 0.01 * values(fit), rtol=1e-3)


def test_noise_that_grows_with_frequency_does_not_win() -> None:
    """w^2 x of noise is 50 times the force at the top of the band: equal weights give k_i near 0, ml and its
    chi-square do not.
    """
    rotor = Rotor(frequency=np.arange(5.0, 1500.0, 5.0), noise_x=4e-8)
    fit = fitted(rotor.spectra(np.random.default_rng(3)))
    assert abs(fit.parameter("k_i").value - 80.0) < 4 * fit.parameter("k_i").std_error < 2.0
    assert fit.gof.chi2_p > 0.01
    assert "free of noise gives k_i" in " ".join(fit.notes)


def test_what_is_no_rigid_mass_is_said() -> None:
    """40 % too much motion at the top of the band, as by bending."""
    spectra = Rotor().spectra(np.random.default_rng(1))
    bent = spectra.vectors * np.stack([np.ones(60), np.linspace(1.0, 1.4, 60)], axis=1)[:, None]
    fit = fitted(replace(spectra, vectors=bent))
    assert "model-mismatch" in [finding.code for finding in fit.findings]
    assert fit.parameter("k_s").std_error_inflated > 2 * fit.parameter("k_s").std_error


def test_few_periods_are_said() -> None:
    fit = fitted(COUPLED.spectra(np.random.default_rng(1), periods=7))
    assert "few-averages" in [finding.code for finding in fit.findings]


def test_the_fit_is_recorded_and_reported() -> None:
    fit = fitted(COUPLED.spectra(np.random.default_rng(1)), uncertainties=(("mass", Uncertain(4.0, 0.02)),))
    again = read_fit(fit_entry(fit))
    assert values(again) == pytest.approx(values(fit))
    document = build(Identification((fit,), title="Magnets"))
    figures = [
        block for section in document.sections for block in section.blocks if isinstance(block, Figure)
    ]
    assert any("displacement per current" in figure.caption for figure in figures)
    plain = fitted(Rotor().spectra(np.random.default_rng(1)))
    assert any("{sum: {ix: " in note for note in plain.notes)


def test_a_force_as_a_channel_has_all_the_uncertainty_of_the_fit() -> None:
    """Mass +- 5 %: that of noise alone is far less."""
    fit = fitted(Rotor().spectra(np.random.default_rng(1)), uncertainties=(("mass", Uncertain(4.0, 0.2)),))
    (note,) = (note for note in fit.notes if "{sum: {ix: " in note)
    errors = [float(error) for error in re.findall(r"\+- (\S+) N", note)]
    assert errors == pytest.approx([p.combined for p in fit.parameters], rel=0.05)


def channel(name: str, quantity: str, role: str, dof: str) -> Channel:
    return Channel(name, quantity, role, dof)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"mass": "estimate"}, "the mass of the rotor must be known"),
        ({"estimator": "ls"}, "ls does not estimate model magnet"),
        ({"compare": True}, "'compare' is not for model magnet"),
        ({"input": ("iz",)}, "no current channel 'iz'"),
        ({"band": (5.0, 12.0)}, "2 lines in the band"),
        ({"mass": ((4.0, 0.0), (0.0, 4.0))}, "the mass has 2 axes, the currents 1"),
    ],
)
def test_what_does_not_fit_together_is_refused(keys: dict[str, object], message: str) -> None:
    with pytest.raises((ConfigError, FitError), match=message):
        fitted(Rotor().spectra(), **keys)


def test_channels_that_do_not_pair_are_named() -> None:
    spectra = Rotor().spectra()
    current, motion = spectra.channels
    for channels, message in (
        ((current, replace(motion, dof="y")), "the current ix of dof x has no displacement"),
        ((replace(current, quantity="force"), motion), "there is no current channel"),
    ):
        with pytest.raises(ConfigError, match=message):
            fitted(replace(spectra, channels=channels))
    with pytest.raises(ConfigError, match="place of channel 'ia' is not known"):
        fitted(long_rotor(position=False), inertia="0.05 kg.m^2")
    with pytest.raises(ConfigError, match="needs its moment of inertia"):
        fitted(long_rotor())


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"mass": 0.0}, "mass of the rotor is above zero, not 0 kg"),
        ({"mass": ((-4.0,),)}, "mass matrix is that of no rotor"),
        ({"mass": ((0.0,),)}, "mass matrix is that of no rotor"),
        ({"inertia": "0.05 kg.m^2"}, "'inertia' belongs to a rotor on two bearings"),
        ({"mass": ((4.0,),), "inertia": "0.05 kg.m^2"}, "'inertia' belongs to one mass of a rotor on two"),
        ({"centre": 0.1}, "'centre' belongs to a rotor on two bearings"),
        ({"hold": "20 Hz"}, "lines up to .* Hz are beyond half of `hold`"),
    ],
)
def test_a_rotor_that_cannot_be_is_refused(keys: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        fitted(Rotor().spectra(), **keys)


def test_a_mass_matrix_is_symmetric() -> None:
    with pytest.raises(ConfigError, match="mass matrix is that of no rotor"):
        fitted(COUPLED.spectra(), mass=((4.0, 1.0), (0.0, 4.0)))


def test_noise_free_channels_cannot_be_weighed() -> None:
    spectra = Rotor().spectra()
    with pytest.raises(FitError, match="noise of the channels is not known"):
        fitted(replace(spectra, covariance=np.zeros_like(spectra.covariance)))
    with pytest.raises(FitError, match="from 2 degrees of freedom only"):
        fitted(replace(spectra, covariance_dof=2.0))


@pytest.mark.parametrize("keys", [{"hold": 0.0}, {"amplifier_bandwidth": 2e3}, {"inertia": "-1 kg.m^2"}])
def test_impossible_settings_are_refused(keys: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        MagnetSettings(**keys)  # type: ignore[arg-type]

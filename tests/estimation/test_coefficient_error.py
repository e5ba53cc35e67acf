"""Model error of fits of several coefficients: against the same average with whole covariance matrices, and
by draws of faults whose truth is known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from labpipe.estimation.coefficient_error import (
    LARGER,
    LENGTHS,
    PRIOR,
    USUAL,
    CoefficientError,
    coefficient_error,
)
from labpipe.estimation.discrepancy import AMPLITUDES, SOUND, matern
from labpipe.estimation.fitting import identify
from labpipe.estimation.linear_models import sdof
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import FitSettings, Support
from labpipe.estimation.statistics import derive
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import ChannelUncertainty, Uncertain, Uncertainty
from tests.estimation.conftest import with_noise
from tests.estimation.noisy import measured

FREQUENCY = np.linspace(20.0, 60.0, 60)
W = 2 * np.pi * FREQUENCY[:, None, None]
MASS = np.diag([1.0, 0.9])
STIFFNESS = (2 * np.pi * 40) ** 2 * np.array([[0.8, 0.03], [0.02, 1.3]])
DAMPING = np.array([[8.0, 0.3], [-0.2, 10.0]])
TRUTH = {
    f"{name}_{row + 1}_{column + 1}": matrix[row, column]
    for name, matrix in (("k", STIFFNESS), ("c", DAMPING), ("m", MASS))
    for row in range(2)
    for column in range(2)
}


def receptance(stiffness: np.ndarray = STIFFNESS) -> np.ndarray:
    return np.linalg.inv(stiffness - W**2 * MASS + 1j * W * DAMPING)


def other_modes(h: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    for f_n in (12, 75, 90):
        v = rng.normal(size=2)
        h = h + 0.03 * np.outer(v, v) * size(h) * 40**2 / (
            f_n**2 - FREQUENCY[:, None, None] ** 2 + 0.04j * f_n * FREQUENCY[:, None, None]
        )
    return h


def gain_curve(h: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    x = (FREQUENCY - 40) / 20
    phase = rng.uniform(0, 6, (2, 2, 1))
    gain = 1 + 0.02 * np.cos(2.2 * x + phase[0]) + 0.015j * np.sin(2.8 * x + phase[1])
    return h * gain.T[:, :, None]


def size(h: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.abs(h) ** 2)))


def response(h: np.ndarray, rng: np.random.Generator, *, known: bool = True) -> FrequencyResponse:
    std = 0.003 * size(receptance())
    noise = std * (rng.normal(size=h.shape) + 1j * rng.normal(size=h.shape)) / np.sqrt(2)
    outputs = Port("1", "1", "1"), Port("2", "2", "2")
    inputs = Port("f1", "f1", "1"), Port("f2", "f2", "2")
    covariance = diagonal_covariance(np.full(h.shape, std**2)) if known else None
    return FrequencyResponse(FREQUENCY, h + noise, outputs, inputs, covariance=covariance)


@pytest.mark.parametrize("turned", [(), (1,), (0, 1)])
def test_a_sensor_upside_down_is_named_by_the_power_at_its_driving_point(turned: tuple[int, ...]) -> None:
    """Re(j w H_ii) of a damped structure is positive; of a response whose sign is turned it is negative."""
    rng = np.random.default_rng(3)
    signs = np.array([-1.0 if row in turned else 1.0 for row in range(2)])
    (fit,) = identify(response(signs[:, None] * receptance(), rng), FitSettings("mdof", mass=(1.0, 0.9)))
    said = " ".join(finding.message for finding in fit.findings if finding.code == "unphysical")
    if len(turned) == 1:
        assert "2/f2 at its driving point feeds power back" in said and "1/f1" not in said
    assert bool(said) == bool(turned)


def test_a_wrong_sign_is_not_called_a_wrong_mass_or_gain() -> None:
    """A block of 8 kg on 65 MN/m, its accelerometer upside down; mass and gain are known to 0.1 and 0.5 %."""
    frequency = np.arange(350.0, 651.0)
    w = 2 * np.pi * frequency
    exact = 1 / (65.4e6 - 8.0 * w**2 + 457j * w)
    gain = ChannelUncertainty("gain", Uncertainty("a.sensitivity", 0.005, "1"))
    output, force = Port("a", "a", "z", None, (gain,)), Port("f", "f", "z")
    rng = np.random.default_rng(3)
    for sign in (1.0, -1.0):
        turned = with_noise(frequency, sign * exact[:, None, None], (output,), (force,), 5e-12, rng)
        (fit,) = identify(turned, FitSettings("sdof", mass="8 kg +- 10 g"))
        codes = {finding.code for finding in fit.findings}
        assert not codes & {"mass", "stated-value"} and ("unphysical" in codes) == (sign < 0)


@pytest.mark.long
def test_average_is_that_of_whole_covariance_matrices() -> None:
    """One linearisation of one FRF, every course as a matrix (n_line, n_line), in parameters as they are."""
    rng = np.random.default_rng(4)
    w = 2 * np.pi * FREQUENCY
    exact = 1 / (6e4 - w**2 + 8j * w)
    std = 0.01 * np.sqrt(np.mean(np.abs(exact) ** 2))
    noise = std * (rng.normal(size=w.size) + 1j * rng.normal(size=w.size)) / np.sqrt(2)
    h = exact * (1 + 0.05 * np.cos(2 * (FREQUENCY - 40) / 20)) + noise
    ports = (Port("x", "x", "x"),), (Port("f", "f", "x"),)
    model = sdof(Setup(*ports, FitSettings("sdof")))
    data = measured(FrequencyResponse(FREQUENCY, h[:, None, None], *ports))
    start = np.array([{"k": 6e4, "c": 8.0, "m": 1.0}[name] for name in model.names])
    error = coefficient_error(data, model, start, np.full((w.size, 1), 1 / std, complex), 1.0)
    at = start
    for _ in range(3):
        expected = averaged_by_matrices(data, model, start, at, std)
        shift = np.max(np.abs(expected[0] - at) / expected[2])
        at = expected[0]
        if shift < 1:
            break
    deviation = np.sqrt(np.diag(expected[1]))
    # A course of 36 functions follows the shortest length to nine tenths.
    np.testing.assert_allclose((error.mean - expected[0]) / deviation, 0.0, atol=0.05)
    np.testing.assert_allclose(np.sqrt(np.diag(error.covariance)), deviation, rtol=0.05)


def averaged_by_matrices(data, model, start, at, std):
    f, h0 = FREQUENCY, model.receptance(start, data.omega)[:, 0, 0]
    r = data.matrix[:, 0, 0] - model.receptance(at, data.omega)[:, 0, 0]
    j = model.jacobian(at, data.omega)[:, :, 0, 0].T
    own = np.linalg.inv(
        2
        * (
            model.jacobian(start, data.omega)[:, :, 0, 0].conj()
            @ model.jacobian(start, data.omega)[:, :, 0, 0].T
        ).real
        / std**2
    )
    errors = np.sqrt(np.diag(own))
    prior = np.diag(1 / (PRIOR * np.abs(start) + 3 * errors) ** 2)
    stiffness = dict(zip(model.names, start, strict=True))["k"]
    shapes = {
        "a": np.ones(f.size),
        "m": h0,
        "z": h0**2 * np.sqrt(np.mean(np.abs(1 / h0) ** 2)),
        "U": h0**3 * stiffness**2,
    }
    courses = [(np.zeros((f.size, f.size)), 0.0, SOUND)]
    for kind, lengths in LENGTHS.items():
        for length in lengths:
            b = shapes[kind] / std
            unit = np.sqrt(f.size / np.sum(np.abs(b) ** 2))
            kappa = matern(f, f, length * (f[-1] - f[0]))
            usual = np.ones(21)
            if kind in USUAL:
                # Its mean over the band as large as the rest, which is without one.
                centre = np.eye(f.size) - 1 / f.size
                kappa = centre @ kappa @ centre
                kappa = (kappa + np.trace(kappa) / f.size) / (2 * np.trace(kappa) / f.size)
                usual = np.exp(-((unit * AMPLITUDES[1:] / USUAL[kind]) ** 2) / 2)
            k = unit**2 * b[:, None] * kappa * b.conj()
            share = (1 - SOUND) / 4 / len(lengths) * usual / np.sum(usual)
            courses += [(k, a, part) for a, part in zip(AMPLITUDES[1:], share, strict=True) if part > 0]
    logs, means, covariances = [], [], []
    for k, a, weight in courses:
        for s in LARGER:
            c = std**2 * (s**2 * np.eye(f.size) + a**2 * k)
            inverse = np.linalg.inv(c)
            normal = 2 * (j.conj().T @ inverse @ j).real + prior
            side = 2 * (j.conj().T @ inverse @ r).real + prior @ (start - at)
            cov = np.linalg.inv(normal)
            log = -np.linalg.slogdet(c)[1] - (r.conj() @ inverse @ r).real + side @ cov @ side / 2
            log -= (np.linalg.slogdet(normal)[1] + (start - at) @ prior @ (start - at)) / 2
            logs.append(log + np.log(weight * (SOUND if s == 1 else (1 - SOUND) / 12)))
            means.append(cov @ side)
            covariances.append(cov)
    weights = np.exp(np.array(logs) - special.logsumexp(logs))
    mean = weights @ np.array(means)
    total = np.einsum("s,spq->pq", weights, covariances)
    total = total + (np.array(means) - mean).T @ ((np.array(means) - mean) * weights[:, None])
    root = np.linalg.cholesky(own)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, total).T))
    grown = values + 1.25 * np.maximum(values - 1, 0)
    return at + mean, (root @ vectors * grown) @ (root @ vectors).T, errors


def counted(fault, n_draw: int, settings: FitSettings, *, known: bool = True) -> tuple[float, float]:
    """Share of coefficients with an interval, and of these that hold the truth."""
    stated, held = [], []
    for seed in range(n_draw):
        rng = np.random.default_rng(seed)
        (fit,) = identify(response(fault(receptance(), rng), rng, known=known), settings)
        for name, truth in TRUTH.items():
            interval = fit.parameter(name).ci95
            stated.append(interval is not None)
            held.append(interval is not None and interval[0] <= truth <= interval[1])
    return float(np.mean(stated)), float(np.mean(held))


def drift(_: np.ndarray, __: np.random.Generator) -> np.ndarray:
    """The stiffness moves evenly by 1 % to either side of its mean."""
    return np.mean([receptance(STIFFNESS * (1 + e)) for e in np.linspace(-0.01, 0.01, 9)], axis=0)


@pytest.mark.long
@pytest.mark.parametrize(("fault", "known"), [(other_modes, True), (gain_curve, False), (drift, True)])
def test_intervals_of_a_matrix_hold_in_spite_of_a_wrong_model(fault, known: bool) -> None:
    """Six matrices each, 72 coefficients: 95 % intervals hold 61 of them or more but once in a thousand."""
    stated, held = counted(fault, 6, FitSettings("mdof"), known=known)
    assert stated == 1.0 and held >= 61 / 72


def test_sound_matrices_keep_their_intervals() -> None:
    for seed in range(4):
        rng = np.random.default_rng(100 + seed)
        (fit,) = identify(response(receptance(), rng), FitSettings("mdof"))
        assert all(p.interval.discrepancy == 0 and not p.reason for p in fit.parameters)


def test_an_interval_does_not_end_at_its_value() -> None:
    """The average lies 5 of its errors away: the interval holds that of noise about the value as well."""
    error = CoefficientError(np.array([105.0]), np.array([[1.0]]), np.array([[0.25]]))
    (stated,) = error.state(
        (derive("k", "N/m", 100.0, 0.5, 1000),),
        lambda values, covariance: (derive("k", "N/m", values[0], covariance[0, 0] ** 0.5, 1000),),
    )
    low, high = stated.ci95
    assert stated.value == 100.0 and low == pytest.approx(100 - 1.96 * 0.5, abs=1e-3)
    assert high == pytest.approx(105 + 1.96, abs=0.01)


@pytest.mark.long
def test_causes_are_told_apart() -> None:
    rng = np.random.default_rng(0)
    causes = ((other_modes, "other modes"), (gain_curve, "gain curve"), (drift, "moved frequency"))
    for fault, cause in causes:
        (fit,) = identify(response(fault(receptance(), rng), rng), FitSettings("mdof"))
        assert next(iter(fit.discrepancy.shares)) == cause
        assert fit.parameter("k_1_1").reason == cause


@pytest.mark.parametrize(
    ("settings", "known"),
    [
        (FitSettings("rotor-2dof", mass=1.0), True),
        (FitSettings("mdof", damping="hysteretic"), False),
        (FitSettings("mdof", damping="proportional"), True),
        (
            FitSettings("sdof", input=("f1",), output=("1",), subtract=Support(stiffness=Uncertain(1e3))),
            False,
        ),
        (FitSettings("sdof", input=("f1",), output=("1",), mass=1.0, damping="hysteretic"), True),
    ],
)
def test_no_interval_is_withheld(settings: FitSettings, known: bool) -> None:
    rng = np.random.default_rng(3)
    faulty = response(gain_curve(receptance(), rng), rng, known=known)
    dofs = ("x", "y")
    turned = replace(
        faulty,
        outputs=tuple(
            Port(port.label, port.channel, dof) for port, dof in zip(faulty.outputs, dofs, strict=True)
        ),
        inputs=tuple(
            Port(port.label, port.channel, dof) for port, dof in zip(faulty.inputs, dofs, strict=True)
        ),
    )
    (fit,) = identify(turned, settings)
    assert "model-mismatch" in [finding.code for finding in fit.findings]
    for parameter in fit.parameters:
        assert parameter.ci95 is not None, parameter.name
        assert parameter.ci95[0] <= parameter.value <= parameter.ci95[1]
        if parameter.std_error == 0:  # The entry of a shape by which it is scaled.
            continue
        assert parameter.interval.discrepancy > 0 and parameter.reason

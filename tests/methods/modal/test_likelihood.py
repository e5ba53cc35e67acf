"""Refinement: estimates, standard errors and residual terms against a dense weighted least squares written
out here.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from labpipe.arrays import modal_assurance
from labpipe.estimation.fitting import identify
from labpipe.estimation.measured import measured_part
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.residual import line_scatter
from labpipe.estimation.settings import FitSettings
from labpipe.methods.modal.likelihood import FrfLines, Refined, ResidualTerms, refine, refine_lines, remaining
from labpipe.methods.modal.model_error import modal_parameters
from labpipe.methods.modal.poles import criterion, normal_equations, refine_with_terms, stabilisation
from labpipe.methods.modal.settings import ModalSettings
from labpipe.methods.modal.whole_covariance import ModalReceptance
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from tests.methods.modal.structures import DAMPING, FREQUENCIES, nine_modes


def lines_of(omega: np.ndarray, matrix: np.ndarray) -> FrfLines:
    """Accelerance with the same noise at all lines."""
    return FrfLines(omega, matrix, 2, np.ones(omega.size))


def small_case(n_input: int = 2) -> tuple[FrfLines, ResidualTerms, np.ndarray, np.ndarray]:
    """Three points, two modes of a part of the band, with start values near the truth."""
    structure = nine_modes(3, 1501)
    lines = (structure.frequency >= 85) & (structure.frequency <= 128)
    omega = 2 * np.pi * structure.frequency[lines]
    matrix = structure.noisy(0.02, 4)[lines][:, :, :n_input]
    poles = structure.poles[6:8] * 1.0002
    participation = structure.shapes[6:8][:, :n_input]
    return lines_of(omega, matrix), ResidualTerms(lines_of(omega, matrix), 1, 2), poles, participation


def dense_residual(parameters: np.ndarray, lines: FrfLines, refined: Refined) -> np.ndarray:
    """Residual over its noise: poles, free participation, shapes, residual factors of 1, s^2 and s^-2 as
    plain parameters.
    """
    n_line, n_output, n_input = lines.matrix.shape
    values = parameters[0::2] + 1j * parameters[1::2]
    k = refined.poles.size
    poles, rest = values[:k] * 1e3, values[k:]
    fixed = np.argmax(refined.participation == 1, axis=1)
    participation = np.ones((k, n_input), complex)
    for mode in range(k):
        free = [column for column in range(n_input) if column != fixed[mode]]
        participation[mode, free], rest = rest[: len(free)], rest[len(free) :]
    shapes, rest = rest[: n_output * k].reshape(n_output, k), rest[n_output * k :]
    factors = rest.reshape(3, n_output, n_input)
    s = 1j * lines.omega
    model = np.zeros((n_line, n_output, n_input), complex)
    for mode in range(k):
        residue = np.outer(shapes[:, mode], participation[mode])
        model += (
            residue / (s - poles[mode])[:, None, None]
            + residue.conj() / (s - poles[mode].conj())[:, None, None]
        )
    unit = s / (1j * lines.omega[-1])
    for factor, power in zip(factors, (-2, 0, 2), strict=True):
        model += factor * (unit**power)[:, None, None]
    error = (lines.matrix - model * (s**2)[:, None, None]) / np.sqrt(refined.noise / 2)
    return np.concatenate([error.real.ravel(), error.imag.ravel()])


def test_estimate_and_covariance_are_those_of_dense_least_squares() -> None:
    lines, terms, poles, participation = small_case()
    refined = refine(terms, poles, participation)
    assert refined.converged
    fixed = np.argmax(refined.participation == 1, axis=1)
    free = np.array([refined.participation[mode, 1 - fixed[mode]] for mode in range(2)])
    start = np.concatenate(
        [refined.poles / 1e3, free, refined.shapes.ravel(), np.zeros(3 * lines.matrix[0].size)]
    )
    start = np.stack([start.real, start.imag], -1).ravel()
    dense = least_squares(
        dense_residual, start, args=(lines, refined), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    covariance = np.linalg.inv(dense.jac.T @ dense.jac)
    error = np.sqrt(np.diag(refined.covariance))
    found = np.stack([refined.poles.real, refined.poles.imag], -1).ravel()
    np.testing.assert_allclose(found, 1e3 * dense.x[:4], atol=2e-2 * error[:4].min())
    np.testing.assert_allclose(
        refined.covariance[:4, :4], 1e6 * covariance[:4, :4], rtol=1e-3, atol=1e-3 * error[:4].min() ** 2
    )
    np.testing.assert_allclose(
        refined.covariance[4:, 4:], covariance[4:8, 4:8], rtol=1e-3, atol=1e-6 * covariance[4, 4]
    )
    shapes = dense.x[8 : 8 + 12].reshape(3, 4)
    np.testing.assert_allclose(
        np.stack([refined.shapes.real, refined.shapes.imag], -1).reshape(3, 4), shapes, rtol=1e-3, atol=1e-7
    )
    for output in range(3):
        block = slice(8 + 4 * output, 12 + 4 * output)
        size = np.sqrt(np.outer(np.diag(covariance[block, block]), np.diag(covariance[block, block])))
        np.testing.assert_allclose(
            refined.shape_covariance[output] / size, covariance[block, block] / size, atol=2e-3
        )
        scale = np.array([1e3, 1e3, 1e3, 1e3, 1, 1, 1, 1])
        crossed = covariance[block, :8] * scale
        size = np.sqrt(np.outer(np.diag(covariance[block, block]), np.diag(refined.covariance)))
        np.testing.assert_allclose(refined.crossed[output] / size, crossed / size, atol=2e-3)


def test_noise_of_every_element_is_found() -> None:
    structure = nine_modes(20)
    omega = 2 * np.pi * structure.frequency
    matrix = structure.noisy(0.01, 7)
    refined, _ = refine_with_terms(lines_of(omega, matrix), structure.poles, structure.shapes[:, [0, 7, 15]])
    expected = 1e-4 * np.mean(np.abs(structure.matrix) ** 2, axis=0)
    # The variance of 1,501 complex lines is known to 1 / sqrt(1501) = 2.6 %.
    assert np.max(np.abs(refined.noise / expected - 1)) < 5 / np.sqrt(1501)


def test_the_criterion_of_residual_terms_is_akaike_s() -> None:
    """-2 ln L + 2 n of complex noise of one variance at all lines of an FRF, but for a constant: 2 n_line
    ln of its sum of squares, and n real numbers, counted by the covariances and the factors of the terms.
    """
    lines, terms, poles, participation = small_case()
    values = []
    for some in (terms, ResidualTerms(lines, 2, 1)):
        refined = refine(some, poles, participation)
        squares = np.sum(np.abs(remaining(some, refined)) ** 2, axis=0)
        n_output, n_shape, _ = refined.shape_covariance.shape
        n_number = len(refined.covariance) + n_output * n_shape + 2 * squares.size * some.count
        values.append(2 * lines.omega.size * np.sum(np.log(squares)) + 2 * n_number)
        assert criterion(refined, some) == pytest.approx(values[-1], rel=1e-9)
    # The same modes and one term fewer in every FRF: less by two numbers each.
    fewer = ResidualTerms(lines, 1, 1)
    assert criterion(refined, some) - criterion(refined, fewer) == pytest.approx(4 * squares.size)


def test_residual_terms_are_taken_out_of_the_data() -> None:
    omega = 2 * np.pi * np.linspace(20, 40, 120)
    w = omega[:, None, None] / omega[-1]
    smooth = (w**2 * (2 - 1j) + 3j * w**-0 + 0.5 * w**4).astype(complex)
    terms = ResidualTerms(lines_of(omega, smooth), 1, 2)
    assert np.max(np.abs(terms.remainder)) < 1e-12 * np.max(np.abs(smooth))


@pytest.mark.parametrize("band", [(204, 220), (1, 1000), (1000, 1010)])
def test_residual_terms_leave_what_no_polynomial_can_follow(band: tuple[float, float]) -> None:
    """Twelve lines less eleven terms, omega^-6 times the polynomials of omega^2 up to degree 10: what is left
    is the part along v_l = omega_l^6 / prod (omega_l^2 - omega_k^2), the divided difference of order 11.
    """
    omega = 2 * np.pi * np.linspace(*band, 12)
    x = omega**2 / np.mean(omega**2)
    away = x**3 / np.prod(x[:, None] - x + np.eye(12), axis=1)
    away /= np.linalg.norm(away)
    data = np.random.default_rng(3).standard_normal(12)
    terms = ResidualTerms(FrfLines(omega, data[:, None, None] + 0j, 0, np.ones(12)), 3, 8)
    assert terms.remainder[:, 0, 0] == pytest.approx(away * (away @ data), abs=1e-10)


@pytest.mark.long
def test_draws_reach_the_bound() -> None:
    """Ten draws of 18 parameters, noise of 1 and 5 % in turn: three deviations of a share of 95 % are 4.9 %,
    of the rms .158. Standard errors 20 % too small are seen in 95 of 100.
    """
    structure = nine_modes(40)
    omega = 2 * np.pi * structure.frequency
    errors = []
    for seed in range(10):
        level = (0.01, 0.05)[seed % 2]
        matrix = structure.noisy(level, seed)
        modes = stabilisation(normal_equations(omega, matrix, 60), (omega[0], omega[-1]), 60).modes
        assert modes.values.size == 9, f"seed {seed}"
        refined, _ = refine_with_terms(lines_of(omega, matrix), modes.values, modes.participation)
        parameters = modal_parameters(refined, 10**6, None, (), None)
        truth = np.stack([FREQUENCIES, DAMPING], -1).ravel()
        errors.append([(p.value - t) / p.std_error for p, t in zip(parameters, truth, strict=True)])
        alike = np.diag(modal_assurance(refined.shapes.T, structure.shapes))
        assert alike.min() > (0.9999 if level == 0.01 else 0.999)
    scaled = np.array(errors)
    assert np.sqrt(np.mean(scaled**2)) < 1.158
    assert 0.901 < np.mean(np.abs(scaled) < 1.96) < 0.999


def as_response(frequency: np.ndarray, matrix: np.ndarray) -> FrequencyResponse:
    """Receptances (n_line, n_output, n_input) without a variance."""
    _, n_output, n_input = matrix.shape
    outputs = tuple(Port(f"y{n}", f"y{n}", f"{n}") for n in range(n_output))
    inputs = tuple(Port(f"f{n}", f"f{n}", f"drive{n}") for n in range(n_input))
    return FrequencyResponse(frequency, matrix, outputs, inputs)


@pytest.mark.parametrize("n_output", [1, 3])
def test_the_scatter_of_every_line_is_that_of_the_whole_jacobian(n_output: int) -> None:
    """The same as line_scatter of all parameters at once, where noise grows along the lines."""
    within = 1e-6
    lines, _, poles, participation = small_case()
    grows = 1 + np.linspace(0, 3, lines.omega.size)[:, None, None]
    smooth = lines.matrix
    rng = np.random.default_rng(3)
    noise = 0.02 * np.sqrt(np.mean(np.abs(smooth) ** 2)) * grows
    noisy = smooth + noise * (rng.normal(size=smooth.shape) + 1j * rng.normal(size=smooth.shape))
    lines = lines_of(lines.omega, noisy[:, :n_output])
    terms = ResidualTerms(lines, 1, 2)
    refined = refine(terms, poles, participation)
    scatter = refine_lines(terms, refined)
    s = 1j * lines.omega
    response = as_response(lines.omega / (2 * np.pi), lines.matrix / (s**2)[:, None, None])
    every = np.ones(lines.omega.size, bool)
    measured = measured_part(response, list(range(n_output)), [0, 1], every)
    model = ModalReceptance.of(terms, refined, measured)
    weights = (s**2)[:, None] / np.sqrt(refined.noise.ravel()) + 0j
    problem = OutputError(measured, model, weights)
    values = model.join(refined, measured)
    whole = line_scatter(problem.jacobian(values), problem.residual(values), lines.omega.size, alone=True)
    n, k = scatter.covariance.shape[0], 2 * poles.size
    std = np.sqrt(np.diag(whole.covariance))
    first = scatter.shape_covariance[0]
    np.testing.assert_allclose(np.sqrt(np.diag(scatter.covariance)) / std[:n], 1, atol=within)
    np.testing.assert_allclose(np.sqrt(np.diag(first)) / std[n : n + k], 1, atol=within)
    crossed = whole.covariance[n : n + k, :n] / np.outer(std[n : n + k], std[:n])
    np.testing.assert_allclose(scatter.crossed[0] / np.outer(std[n : n + k], std[:n]), crossed, atol=within)


@pytest.mark.long
@pytest.mark.parametrize(("n_output", "common"), [(1, False), (3, True)])
def test_noise_that_grows_with_the_response_is_in_the_errors_of_modes(n_output: int, common: bool) -> None:
    """Of 100 FRFs each without a variance, a gain of 1 % from line to line, in all points alike or not: f_n
    and zeta scatter by what their errors say, within three of the 7 % of a deviation of 100 draws (of even
    noise: 0.2 to 0.4 of it), and of intervals no fewer than 87 hold (95 less 3.5 deviations).
    """
    rng, frequency = np.random.default_rng(5), np.linspace(80.0, 120.0, 161)
    w, w_n, zeta = 2 * np.pi * frequency, 2 * np.pi * 100.0, 0.01
    h = np.array([1.0, 0.6, -0.8])[:n_output] / (w_n**2 - w**2 + 2j * zeta * w_n * w)[:, None]
    off, errors, holds = [], [], []
    for _ in range(100):
        gain = rng.normal(size=(w.size, n_output)) + 1j * rng.normal(size=(w.size, n_output))
        noisy = h * (1 + 0.01 * (gain[:, :1] if common else gain) / np.sqrt(2))
        (fit,) = identify(as_response(frequency, noisy[:, :, None]), FitSettings("modal"))
        if len(fit.parameters) != 2:
            continue  # the noise of a peak looks like a second mode
        found = [fit.parameter(name) for name in ("f_n_1", "zeta_1")]
        off.append([p.value - true for p, true in zip(found, (100.0, zeta), strict=True)])
        errors.append([p.std_error for p in found])
        holds.append([p.ci95[0] <= true <= p.ci95[1] for p, true in zip(found, (100.0, zeta), strict=True)])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0) / np.mean(np.square(off), axis=0))
    assert len(off) > 90 and np.all(np.abs(ratio - 1) < 0.21), ratio
    assert np.all(np.sum(holds, axis=0) >= 87), np.sum(holds, axis=0)


def test_the_last_digit_of_the_start_decides_nothing() -> None:
    """Of two poles that begin on one mode, one wanders off to a peak of the noise, step by step: both starts
    come to the same minimum, and none is left on its way.
    """
    rng, omega = np.random.default_rng(46), 2 * np.pi * np.linspace(60.0, 140.0, 161)
    frequency, damping = np.array([80.0, 115.0, 79.5, 80.5]), np.array([0.02, 0.03, 0.02, 0.02])
    poles = 2 * np.pi * frequency * (-damping + 1j * np.sqrt(1 - damping**2))
    away = 1j * omega[:, None] - poles[:2], 1j * omega[:, None] - poles[:2].conj()
    h = (-1j / away[0] + 1j / away[1]) @ np.array([1.0, 0.5])
    noise = rng.standard_normal(omega.size) + 1j * rng.standard_normal(omega.size)
    h = h + 0.05 * np.std(h) * noise / np.sqrt(2)
    lines = FrfLines(omega, h[:, None, None], 0, np.ones(omega.size))
    terms, start = ResidualTerms(lines, 1, 3), poles[[2, 3, 1]]
    ends = [refine(terms, at, np.ones((3, 1), complex)) for at in (start, start * (1 + 1e-10))]
    assert all(end.converged for end in ends)
    error = np.sqrt(np.diag(ends[0].covariance))
    off = np.abs(ends[0].poles - ends[1].poles)
    assert (
        np.all(off < 0.02 * np.hypot(error[0::2], error[1::2])) and abs(ends[0].poles[0]) > 2 * np.pi * 80.9
    )


@pytest.mark.long
def test_many_frfs_are_judged_like_few() -> None:
    """Twenty-four FRFs on 3,600 lines, whose Jacobian has more than 40 million entries: the known noise has
    the chi-square of its degrees of freedom, and two modes lie within four of their standard errors.
    """
    structure, level = nine_modes(8, 12_560), 0.02
    matrix, band = structure.noisy(level, 1), (85.0, 128.0)
    variance = level**2 * np.mean(np.abs(structure.matrix) ** 2, axis=0)
    ports = tuple(Port(f"p{n}", f"p{n}", f"p{n}") for n in range(8))
    response = FrequencyResponse(
        structure.frequency,
        matrix,
        ports,
        ports[:3],
        form="accelerance",
        covariance=diagonal_covariance(np.broadcast_to(variance, matrix.shape)),
    )
    settings = FitSettings("modal", band=band, model_settings=ModalSettings((2, 14)))
    (fit,) = identify(response, settings)
    assert fit.equations * (fit.equations - fit.dof) > 40e6
    assert fit.gof.chi2_reduced == pytest.approx(1, abs=4 * np.sqrt(2 / fit.dof))
    assert not fit.findings
    for number in (1, 2):
        pole = structure.poles[5 + number]
        for name, true in (("f_n", abs(pole) / (2 * np.pi)), ("zeta", -pole.real / abs(pole))):
            found = fit.parameter(f"{name}_{number}")
            assert abs(found.value - true) < 4 * found.std_error

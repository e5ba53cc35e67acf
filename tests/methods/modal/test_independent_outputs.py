"""The normal equations of the fit with the covariance of the FRF, output by output."""

import numpy as np
import pytest

from labpipe.estimation.descent import linearise_problem
from labpipe.estimation.measured import measured_part
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.weights import whitener
from labpipe.methods.modal import whole_covariance
from labpipe.methods.modal.likelihood import FrfLines, ResidualTerms, refine
from labpipe.records.response import FrequencyResponse, Port


@pytest.mark.parametrize(("independent", "real"), [(True, False), (True, True), (False, False)])
def test_outputs_of_independent_noise_are_linearised_one_by_one(
    monkeypatch: pytest.MonkeyPatch, independent: bool, real: bool
) -> None:
    """J^T J and J^T r are those of the whole Jacobian, and no block holds parameters of two outputs where
    their noise is independent: 2 poles, 2 entries of the participation, 2 shapes and 2 terms at 2 references.
    """
    rng = np.random.default_rng(5)
    lines, n_output, n_input = np.arange(20.0, 60.0, 0.5), 3, 2
    poles = 2 * np.pi * np.array([-0.4 + 30j, -0.6 + 47j])
    shapes, references = rng.normal(size=(n_output, 2)), rng.normal(size=(2, n_input))
    omega = 2 * np.pi * lines
    residues = np.einsum("om,mi->moi", -1j * shapes, references)
    frf = np.einsum("lm,moi->loi", 1 / (1j * omega[:, None] - poles), residues)
    frf = frf + 0.01 * (rng.normal(size=frf.shape) + 1j * rng.normal(size=frf.shape))
    inside = np.kron(np.eye(n_output), np.ones((n_input, n_input)))
    roots = rng.normal(size=(lines.size, 6, 6)) + 1j * rng.normal(size=(lines.size, 6, 6))
    covariance = 1e-4 * (roots @ roots.conj().swapaxes(1, 2) / 6 + np.eye(6))
    ports = [
        tuple(Port(f"{of}{n}", f"{of}{n}", f"{of}{n}") for n in range(k)) for of, k in (("x", 3), ("f", 2))
    ]
    covariance = covariance * inside if independent else covariance
    response = FrequencyResponse(lines, frf, *ports, covariance=covariance, name="plate")
    measured = measured_part(response, range(n_output), range(n_input), np.ones(lines.size, bool))
    terms = ResidualTerms(FrfLines(omega, measured.matrix, 0, np.ones(lines.size)), 1, 1)
    refined = refine(terms, poles, references.astype(complex), real=real)
    model = whole_covariance.ModalReceptance.of(terms, refined, measured, real=real)
    problem, values = OutputError(measured, model, whitener(measured)), model.join(refined, measured)
    sizes: list[int] = []
    plain = whole_covariance.linearise_blocks

    def watch(blocks, n_parameter: int):
        sizes.extend(jacobian.shape[1] for _, jacobian, _ in blocks())
        return plain(blocks, n_parameter)

    monkeypatch.setattr(whole_covariance, "linearise_blocks", watch)
    ours, whole = whole_covariance.ModalRows(problem, values).linearise(), linearise_problem(problem, values)
    own = 2 * 2 + (1 if real else 2) * (2 + 2) + 2 * n_input * 2
    assert set(sizes) == {own if independent else values.size}
    assert ours.chi2 == pytest.approx(whole.chi2, rel=1e-12)
    products = [(of.triangle * of.scale).T @ (of.triangle * of.scale) for of in (ours, whole)]
    np.testing.assert_allclose(*products, rtol=0, atol=1e-11 * np.max(products[1]))
    sides = [of.scale * (of.triangle.T @ of.projected) for of in (ours, whole)]
    np.testing.assert_allclose(*sides, rtol=0, atol=1e-11 * np.linalg.norm(whole.scale) * np.sqrt(whole.chi2))

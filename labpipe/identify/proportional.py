"""Proportional (Rayleigh) damping: C = alpha M + beta K with alpha [1/s] and beta [s] for all damping coefficients."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.identify.model import DynamicModel, Matrices, Term, no_matrices

# Least number of damping coefficients that alpha and beta replace.
FEWEST_DAMPING_TERMS = 3


@dataclass(frozen=True)
class ProportionalModel:
    """A model with damping alpha M + beta K; parameters: *free* (all but damping), then alpha, beta.

    *linear*: the model with independent damping coefficients, for the start. *expanded*: with terms beta k_j and alpha m_j;
    *by_stiffness*, *by_mass*: the free parameter of each of them, -1 for the constants. Equation (est-proportional).
    """

    free: DynamicModel
    linear: DynamicModel
    expanded: DynamicModel
    by_stiffness: tuple[int, ...]
    by_mass: tuple[int, ...]

    @property
    def name(self) -> str:
        return self.free.name

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.free.names, "alpha", "beta")

    @property
    def units(self) -> tuple[str, ...]:
        return (*self.free.units, "1/s", "s")

    @property
    def terms(self) -> tuple[Term, ...]:
        """The free terms; alpha and beta have no matrices of their own."""
        return self.free.terms

    def expanded_values(self, parameters: FloatArray) -> FloatArray:
        """(free, beta k_j, alpha m_j), (..., n_expanded) [N.s/m for damping], from *parameters* (..., n_parameter)."""
        free, alpha, beta = parameters[..., :-2], parameters[..., -2:-1], parameters[..., -1:]
        return np.concatenate([free, beta * _picked(free, self.by_stiffness), alpha * _picked(free, self.by_mass)], axis=-1)

    def from_linear(self, values: FloatArray) -> FloatArray:
        """The free parameters and the alpha, beta with alpha M + beta K closest to C, (n_parameter,) [parameter units]."""
        by_name = dict(zip(self.linear.names, values, strict=True))
        whole = self.linear.whole(values)
        columns = np.column_stack([whole.mass.reshape(-1), whole.stiffness.reshape(-1)])
        scale = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
        ratios = np.linalg.lstsq(columns / scale, whole.damping.reshape(-1), rcond=None)[0] / scale
        return np.array([*(by_name[name] for name in self.free.names), *ratios])

    def slopes(self, parameters: FloatArray) -> FloatArray:
        """d (expanded values) / d (parameters), (n_expanded, n_parameter) [unit ratios]."""
        free, alpha, beta = parameters[:-2], parameters[-2], parameters[-1]
        n_free, n_stiffness = free.size, len(self.by_stiffness)
        slopes = np.zeros((n_free + n_stiffness + len(self.by_mass), n_free + 2))
        slopes[:n_free, :n_free] = np.eye(n_free)
        for factor, column, offset, owners in (
            (beta, -1, n_free, self.by_stiffness),
            (alpha, -2, n_free + n_stiffness, self.by_mass),
        ):
            for row, number in enumerate(owners, offset):
                slopes[row, column] = free[number] if number >= 0 else 1.0
                if number >= 0:
                    slopes[row, number] = factor
        return slopes

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H(w) [m/N], (n_line, n_dof, n_input)."""
        return self.expanded.receptance(self.expanded_values(parameters), omega)

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp, (n_parameter, n_line, n_dof, n_input) [m/N per parameter unit]."""
        expanded = self.expanded.jacobian(self.expanded_values(parameters), omega)
        jacobian: ComplexArray = np.tensordot(self.slopes(parameters).T, expanded, 1)
        return jacobian

    def whole(self, parameters: FloatArray) -> Matrices:
        """K [N/m], C [N.s/m], M [kg] and B of *parameters* (..., n_parameter)."""
        return self.expanded.whole(self.expanded_values(parameters))


def proportional(model: DynamicModel) -> ProportionalModel:
    """*model* with its damping coefficients replaced by alpha M + beta K; ConfigError when it has fewer than three of them."""
    if sum(_acts(term.matrices.damping) for term in model.terms) < FEWEST_DAMPING_TERMS:
        raise ConfigError("proportional damping needs a model with several damping coefficients", hint="leave `damping` out")
    free = replace(model, terms=tuple(term for term in model.terms if not _acts(term.matrices.damping)))
    stiffness = [n for n, term in enumerate(free.terms) if _acts(term.matrices.stiffness)]
    mass = [n for n, term in enumerate(free.terms) if _acts(term.matrices.mass)]
    by_stiffness = (*stiffness, *([-1] if _acts(model.constant.stiffness) else []))
    by_mass = (*mass, *([-1] if _acts(model.constant.mass) else []))
    damping = [
        *(("beta", model.constant.stiffness if n < 0 else free.terms[n].matrices.stiffness, n) for n in by_stiffness),
        *(("alpha", model.constant.mass if n < 0 else free.terms[n].matrices.mass, n) for n in by_mass),
    ]
    empty = no_matrices(*model.constant.force.shape)
    products = tuple(
        Term(f"{factor}*{'given' if n < 0 else free.names[n]}", "N.s/m", replace(empty, damping=matrix)) for factor, matrix, n in damping
    )
    return ProportionalModel(free, model, replace(free, terms=(*free.terms, *products)), by_stiffness, by_mass)


def _acts(matrix: FloatArray) -> bool:
    return bool(np.any(matrix != 0))


def _picked(free: FloatArray, indices: tuple[int, ...]) -> FloatArray:
    ones = np.ones((*free.shape[:-1], 1))
    return np.concatenate([free, ones], axis=-1)[..., list(indices)]

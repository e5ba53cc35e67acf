"""Damping laws: factors common to a whole matrix in place of damping coefficients. Table: `DAMPINGS`.

proportional: C = alpha M + beta K (Rayleigh); hysteretic: the complex stiffness K (1 + j eta) with the loss
factor eta (Bishop and Johnson, The Mechanics of Vibration, ch. 9; Ewins, Modal Testing, sec. 2.4.2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.estimation.model import DynamicModel, Matrices, Term, constrain, no_matrices
from labpipe.estimation.settings import DAMPINGS, VISCOUS, FitSettings


@dataclass(frozen=True)
class Factor:
    """One number that multiplies a whole matrix: its *name* and *unit*.

    of: the matrix it multiplies, ``stiffness`` or ``mass``; into: the matrix that this adds to, ``damping``,
    or ``stiffness`` as its imaginary part. damping_of: from K [N/m] and M [kg], (n_dof, n_dof), the viscous
    damping [N.s/m] that dissipates as much as the factor 1 at the natural frequencies, for the start.
    """

    name: str
    unit: str
    of: str
    into: str
    damping_of: Callable[[FloatArray, FloatArray], FloatArray]

    def term(self, name: str, matrix: FloatArray, empty: Matrices) -> Term:
        """The term of the factor times one parameter whose own *matrix* `of` is (n_dof, n_dof) [1]."""
        if self.into == "stiffness":
            # The one complex matrix of a model; everything else of Matrices stays real.
            complex_matrix = replace(empty, stiffness=1j * matrix)  # type: ignore[arg-type]
            return Term(f"{self.name}*{name}", "N/m", complex_matrix)
        return Term(f"{self.name}*{name}", "N.s/m", replace(empty, damping=matrix))


@dataclass(frozen=True)
class DampingLaw:
    """Its *factors*; *fewest*: damping coefficients that a model must have; viscous: whether damping
    coefficients can be told from it.
    """

    name: str
    factors: tuple[Factor, ...]
    fewest: int
    viscous: bool

    def __call__(self, model: DynamicModel) -> FactorModel:
        """*model* with the factors for its damping coefficients; ConfigError for fewer than `fewest`."""
        if sum(_acts(term.matrices.damping) for term in model.terms) < self.fewest:
            needs = "several damping coefficients" if self.fewest > 1 else "a damping coefficient"
            what = f"{self.name} damping needs a model with {needs}"
            raise ConfigError(what, hint="leave `damping` out", field="damping")
        free = replace(model, terms=tuple(term for term in model.terms if not _acts(term.matrices.damping)))
        empty = no_matrices(*model.constant.force.shape)
        products: list[Term] = []
        owners: list[tuple[int, ...]] = []
        for factor in self.factors:
            acting = [n for n, term in enumerate(free.terms) if _acts(getattr(term.matrices, factor.of))]
            if _acts(getattr(model.constant, factor.of)):
                acting.append(-1)
            owners.append(tuple(acting))
            for n in acting:
                name, of = ("given", model.constant) if n < 0 else (free.names[n], free.terms[n].matrices)
                products.append(factor.term(name, getattr(of, factor.of), empty))
        return FactorModel(self, free, model, replace(free, terms=(*free.terms, *products)), tuple(owners))


@dataclass(frozen=True)
class FactorModel:
    """A model with damping by a *law*; parameters: *free* (all but damping), then the law's factors.

    *linear*: the model with independent damping coefficients, for the start. *expanded*: with a term factor *
    p_j for every parameter p_j that the factor multiplies; *owners*: these parameters by factor, -1 for the
    constants. Equations (est-proportional), (est-hysteretic).
    """

    law: DampingLaw
    free: DynamicModel
    linear: DynamicModel
    expanded: DynamicModel
    owners: tuple[tuple[int, ...], ...]

    @property
    def name(self) -> str:
        return self.free.name

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.free.names, *(factor.name for factor in self.law.factors))

    @property
    def units(self) -> tuple[str, ...]:
        return (*self.free.units, *(factor.unit for factor in self.law.factors))

    @property
    def terms(self) -> tuple[Term, ...]:
        """The free terms; the factors have no matrices of their own."""
        return self.free.terms

    def expanded_values(self, parameters: FloatArray) -> FloatArray:
        """The values of `expanded` (..., n_expanded) [N/m, N.s/m, kg] of *parameters* (..., n_parameter)."""
        n_free = len(self.free.terms)
        free, factors = parameters[..., :n_free], parameters[..., n_free:]
        with_one = np.concatenate([free, np.ones((*free.shape[:-1], 1))], axis=-1)
        products = [factors[..., [n]] * with_one[..., list(owners)] for n, owners in enumerate(self.owners)]
        return np.concatenate([free, *products], axis=-1)

    def from_linear(self, values: FloatArray) -> FloatArray:
        """The free parameters and the factors whose damping is closest to C, (n_parameter,) [their units]."""
        by_name = dict(zip(self.linear.names, values, strict=True))
        whole = self.linear.whole(values)
        columns = np.column_stack(
            [factor.damping_of(whole.stiffness, whole.mass).reshape(-1) for factor in self.law.factors]
        )
        scale = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
        ratios = np.linalg.lstsq(columns / scale, whole.damping.reshape(-1), rcond=None)[0] / scale
        return np.array([*(by_name[name] for name in self.free.names), *ratios])

    def slopes(self, parameters: FloatArray) -> FloatArray:
        """d (expanded values) / d (parameters), (n_expanded, n_parameter) [unit ratios]."""
        n_free = len(self.free.terms)
        free, slopes = parameters[:n_free], np.zeros((len(self.expanded.terms), parameters.size))
        slopes[:n_free, :n_free] = np.eye(n_free)
        row = n_free
        for column, owners in enumerate(self.owners, n_free):
            for number in owners:
                slopes[row, column] = free[number] if number >= 0 else 1.0
                if number >= 0:
                    slopes[row, number] = parameters[column]
                row += 1
        return slopes

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H(w) [m/N], (n_line, n_dof, n_input)."""
        return self.expanded.receptance(self.expanded_values(parameters), omega)

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp, (n_parameter, n_line, n_dof, n_input) [m/N per parameter unit]."""
        expanded = self.expanded.jacobian(self.expanded_values(parameters), omega)
        return np.tensordot(self.slopes(parameters).T, expanded, 1)

    def whole(self, parameters: FloatArray) -> Matrices:
        """K [N/m], C [N.s/m], M [kg] and B of *parameters* (..., n_parameter)."""
        return self.expanded.whole(self.expanded_values(parameters))


def damp(model: DynamicModel, settings: FitSettings) -> DynamicModel | FactorModel:
    """*model* with its `fixed`, `tied` and `damping` settings; ConfigError without what they name."""
    model = constrain(model, settings)
    if settings.damping == VISCOUS:
        return model
    law: DampingLaw = DAMPINGS.load(settings.damping)
    return law(model)


def _acts(matrix: FloatArray) -> bool:
    return bool(np.any(matrix != 0))


def _critical(stiffness: FloatArray, mass: FloatArray) -> FloatArray:
    """M sqrt(M^-1 K) [N.s/m]: with eta times it as damping, every mode has zeta = eta / 2; K if M is
    singular.
    """
    if np.linalg.matrix_rank(mass) < mass.shape[0]:
        return stiffness
    squares, shapes = np.linalg.eig(np.linalg.solve(mass, stiffness))
    return (mass @ shapes @ np.diag(np.sqrt(np.abs(squares))) @ np.linalg.inv(shapes)).real


PROPORTIONAL = DampingLaw(
    "proportional",
    (
        Factor("alpha", "1/s", "mass", "damping", lambda _, mass: mass),
        Factor("beta", "s", "stiffness", "damping", lambda stiffness, _: stiffness),
    ),
    fewest=3,
    viscous=True,
)
HYSTERETIC = DampingLaw(
    "hysteretic", (Factor("eta", "1", "stiffness", "stiffness", _critical),), fewest=1, viscous=False
)

"""Whether an excitation determines all coefficients, and if not, the smallest change that does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.planner.information import Noise, sensitivities
from labpipe.planner.model import PlannedModel

# Singular values below this share of the largest count as zero, columns scaled to unit length.
SINGULAR = 1e-9
# Shares of a coefficient in what is not determined below this count as none.
INVOLVED = 1e-6
# Distance of another line, as a share of the frequency, where no neighbour is known.
OTHER = 0.25


@dataclass(frozen=True)
class Excitation:
    """Force vectors (n_vector, n_dof) [N] at frequencies (n_vector,) [Hz]; vectors of one test or of several."""

    frequency: FloatArray
    forces: ComplexArray

    @classmethod
    def of_directions(cls, frequency: FloatArray, directions: ComplexArray) -> Excitation:
        """Each of *directions* (n_direction, n_dof) [1] on every *frequency* (n_line,) [Hz], in tests of their own."""
        return cls(np.repeat(frequency, len(directions)), np.tile(directions, (frequency.size, 1)))


@dataclass(frozen=True)
class Identifiability:
    """*rank* of what an excitation tells of *n_coefficient* coefficients; *undetermined*: names of those it does not determine.

    *remedies*: single changes each of which makes the rank full, the smallest first.
    """

    rank: int
    n_coefficient: int
    undetermined: tuple[str, ...]
    remedies: tuple[str, ...] = ()

    @property
    def full(self) -> bool:
        """Whether all coefficients are determined."""
        return self.rank == self.n_coefficient

    @property
    def words(self) -> str:
        """What is determined, in a sentence."""
        if self.full:
            return f"the excitation determines all {self.n_coefficient} coefficients"
        return f"the excitation determines {self.rank} of {self.n_coefficient} coefficients; not told apart: {', '.join(self.undetermined)}"

    @property
    def remedy(self) -> str:
        """The changes that help, in a sentence."""
        return (
            f"{' or '.join(self.remedies)} would determine all"
            if self.remedies
            else "no single change helps: another direction and more lines"
        )


def identifiability(model: PlannedModel, noise: Noise, excitation: Excitation) -> Identifiability:
    """Rank of what the excitation tells of the model's coefficients, in the expected state of the rig, with remedies tried out.

    Equation (plan-rank).
    """
    ranked = _ranked(model, noise, excitation)
    if ranked.full:
        return ranked
    remedies = tuple(words for words, changed, other in _changes(model, excitation) if _ranked(changed, noise, other).full)
    return Identifiability(ranked.rank, ranked.n_coefficient, ranked.undetermined, remedies)


def _ranked(model: PlannedModel, noise: Noise, excitation: Excitation) -> Identifiability:
    sensitivity = sensitivities(model, noise, 2 * np.pi * excitation.frequency)
    change = np.einsum("lnij,lj->lin", sensitivity, excitation.forces).reshape(-1, len(model.names))
    rows = np.concatenate([change.real, change.imag])
    length = np.linalg.norm(rows, axis=0)
    # A column of zeros stays one: scaling would hide a coefficient without any information.
    determined = length > SINGULAR * length.max()
    scaled = rows / np.where(determined, length, 1.0) * determined
    _, singular, right = np.linalg.svd(scaled, full_matrices=True)
    rank = int(np.count_nonzero(singular > SINGULAR * singular[0]))
    involved = np.any(np.abs(right[rank:]) > INVOLVED, axis=0)
    return Identifiability(rank, len(model.names), tuple(name for name, part in zip(model.names, involved, strict=True) if part))


def _changes(model: PlannedModel, excitation: Excitation) -> Iterator[tuple[str, PlannedModel, Excitation]]:
    """Single changes of model or test, in words: the smallest first."""
    if any(name.startswith("m") for name in model.names):
        yield "a known mass", model.with_known("m"), excitation
    lines = np.unique(excitation.frequency)
    another = lines[-1] + (lines[-1] - lines[-2]) if lines.size > 1 else lines[0] * (1 + OTHER)
    first = excitation.forces[:1]
    yield (
        "another line",
        model,
        Excitation(np.append(excitation.frequency, another), np.concatenate([excitation.forces, first])),
    )
    if model.n_dof == 2:
        across = np.stack([-excitation.forces[:, 1].conj(), excitation.forces[:, 0].conj()], axis=1)
        yield (
            "a second direction of force",
            model,
            Excitation(np.tile(excitation.frequency, 2), np.concatenate([excitation.forces, across])),
        )

"""One mode more than a fit has, where it explains better what looks like damping over amplitude: two close modes beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.decay.amplitude_law import FittedLaw
from labpipe.decay.likelihood import Decayed
from labpipe.decay.pieces import Piece

# Difference of the Bayesian information criterion beyond which the better model is chosen: strong evidence (Kass and Raftery 1995,
# J. Am. Stat. Assoc. 90, 3.2).
STRONG = 10.0
# Share of what the law leaves that the richer fit may leave to be named at all where it does not leave white noise either: a softening
# bearing, whose law is another one, is fitted by two modes to 60 %, a beam with two modes to 35 % (docs/pages/validation/measured.md).
LEFT = 0.5


@dataclass(frozen=True)
class MissingMode:
    """The fit with a mode more: *frequencies* [Hz] that take the place of *mode*, by how much its criterion is *better* [1].

    white: whether it leaves white noise; otherwise neither it nor the law explains the decay, and a law of another form may be as good.
    """

    mode: int
    frequencies: tuple[float, ...]
    better: float
    white: bool


def missing_mode(
    pieces: Sequence[Piece],
    fitted: Decayed,
    richer: Decayed,
    laws: dict[int, FittedLaw],
    strongest: dict[int, tuple[int, int]],
    *,
    white: bool,
) -> MissingMode | None:
    """What *richer*, with a mode more than *fitted*, explains better than the *laws* by their mode; None where it does not.

    *white*: whether it leaves white noise; otherwise it must leave less than the share LEFT of what the law leaves.

    N ln(S) + p ln(N) of both, S the squares left in the output in which the mode is strongest: a law has two parameters more than an
    exponential, a mode two more and two in every piece. Equation (decay-missing).
    """
    if not richer.converged or np.any(richer.poles.real >= 0):
        return None
    for mode, law in laws.items():
        output = strongest[mode][1]
        count = sum(piece.rows.shape[0] for piece in pieces)
        left = sum(_squares(solved.residual[:, output], fitted.variance[n, output]) for n, solved in enumerate(richer.pieces))
        better = count * float(np.log(law.squares / left)) - 2 * len(pieces) * float(np.log(count))
        if better > STRONG and (white or left < LEFT * law.squares):
            near = np.argsort(np.abs(richer.poles - fitted.poles[mode]))[:2]
            return MissingMode(mode, tuple(sorted(float(abs(richer.poles[n])) / (2 * np.pi) for n in near)), better, white)
    return None


def _squares(residual: FloatArray, variance: float) -> float:
    return float(np.sum(residual**2)) / float(variance)

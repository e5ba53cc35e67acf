"""Number of residual terms by the information criterion, grown one term at a time from the refined modes."""

from __future__ import annotations

from labpipe.arrays import ComplexArray
from labpipe.modal.likelihood import Refined, refine
from labpipe.modal.residual_terms import Lines, ResidualTerms

MOST_LOWER, MOST_UPPER = 3, 8
# Steps of a trial: the modes move little by one term more.
TRIAL_STEPS = 1


def refine_with_terms(lines: Lines, poles: ComplexArray, participation: ComplexArray) -> tuple[Refined, ResidualTerms]:
    """The refined modes and the residual terms of least AIC = 2 n_line sum ln(residual) + 2 parameters.

    *poles* (n_mode,) [rad/s], *participation* (n_mode, n_input) [1].
    """
    terms = ResidualTerms(lines, 1, 1)
    best = refine(lines, terms, poles, participation, TRIAL_STEPS)
    while True:
        trials = [
            (refine(lines, more, best.poles, best.participation, TRIAL_STEPS), more)
            for more in _larger(terms)
            if more.count + 2 * poles.size < lines.omega.size
        ]
        if not trials:
            break
        refined, more = min(trials, key=lambda trial: criterion(lines, *trial))
        if criterion(lines, refined, more) >= criterion(lines, best, terms):
            break
        best, terms = refined, more
    return refine(lines, terms, best.poles, best.participation), terms


def criterion(lines: Lines, refined: Refined, terms: ResidualTerms) -> float:
    """AIC [1]: a term has a complex factor in every FRF; a mode a pole, a shape, and a participation of which one entry is given.

    Equation (modal-aic).
    """
    _, n_output, n_input = lines.matrix.shape
    n_complex = lines.n_element * terms.count + refined.poles.size * (n_output + n_input)
    return refined.information + 4 * n_complex


def _larger(terms: ResidualTerms) -> list[ResidualTerms]:
    sizes = [(terms.lower + 1, terms.upper), (terms.lower, terms.upper + 1)]
    return [ResidualTerms(terms.lines, lower, upper) for lower, upper in sizes if lower <= MOST_LOWER and upper <= MOST_UPPER]

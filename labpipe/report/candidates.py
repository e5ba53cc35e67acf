"""Model selection: candidate models of a fit as a table."""

from __future__ import annotations

from labpipe.records.identification import Fit
from labpipe.report.document import Block, Paragraph, Table

EXPLAINED = (
    "AIC = chi² + 2 parameters: the least is the best supported; 10 above it a model has practically no support. p: chance of so large "
    "an improvement by the richer model that contains this one, if this one is right."
)
BY_BIC = (
    "BIC = chi² + parameters ln(equations): the least is the best supported, and 10 above it a form is very strongly spoken against. p: "
    "chance of so large a chi² if this form is right; below 1 % it is not, whatever its BIC."
)
HEADER = ("model", "parameters", "chi²", "dof", "AIC - best", "p")


def candidate_blocks(fit: Fit) -> tuple[Block, ...]:
    """Candidate models of the fit, the best first; nothing where there are none."""
    if not fit.candidates:
        return ()
    if fit.candidates[0].bic is not None:
        return _by_bic(fit)
    best = fit.candidates[0].aic
    rows = tuple(
        (
            candidate.name,
            str(candidate.parameters),
            f"{candidate.chi2:.1f}",
            str(candidate.dof),
            f"{candidate.aic - best:.1f}",
            "" if candidate.p_value is None else f"{candidate.p_value:.3g}",
        )
        for candidate in fit.candidates
    )
    return (Table(HEADER, rows, "Which structure the data ask for", (1, 2, 3, 4, 5)), Paragraph(EXPLAINED))


def _by_bic(fit: Fit) -> tuple[Block, ...]:
    """Candidates that are chosen by BIC, with their own chi-square test."""
    best = fit.candidates[0].bic or 0.0
    rows = tuple(
        (
            candidate.name,
            str(candidate.parameters),
            f"{candidate.chi2 / candidate.dof:.4g}",
            "" if candidate.chi2_p is None else f"{candidate.chi2_p:.2g}",
            "" if candidate.bic is None else f"{candidate.bic - best:.1f}",
        )
        for candidate in fit.candidates
    )
    header = ("form", "parameters", "chi² per dof", "p", "BIC - best")
    return (Table(header, rows, "Which form the data ask for", (1, 2, 3, 4)), Paragraph(BY_BIC))

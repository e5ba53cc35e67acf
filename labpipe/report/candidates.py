"""Model selection: candidate models of a fit as a table."""

from __future__ import annotations

from labpipe.records.identification import Fit
from labpipe.report.document import Block, Paragraph, Table

EXPLAINED = (
    "AIC = chi² + 2 parameters: the least is the best supported; 10 above it a model has practically no support. p: chance of so large "
    "an improvement by the richer model that contains this one, if this one is right."
)
HEADER = ("model", "parameters", "chi²", "dof", "AIC - best", "p")


def candidate_blocks(fit: Fit) -> tuple[Block, ...]:
    """Candidate models of the fit, the best first; nothing where there are none."""
    if not fit.candidates:
        return ()
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

"""Which form the data ask for: every candidate by BIC = chi-square + n ln N with its own chi-square test beside it.

BIC, for the parameters of a form within which a smaller one lies are not determined there: likelihood ratios are not chi-square then, and
AIC takes the larger form in a third of the cases. A form that BIC chooses may still fail its chi-square: then none is right.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.dynamic_stiffness.estimate import Estimate, GivenErrors, Noise, estimate
from labpipe.dynamic_stiffness.forms import FORMS, StiffnessModel
from labpipe.dynamic_stiffness.likelihood import Balance
from labpipe.errors import FitError
from labpipe.identify.diagnostics import MISMATCH_P
from labpipe.records.finding import Finding
from labpipe.records.identification import Candidate

# Difference in BIC beyond which the evidence is very strong (Kass and Raftery 1995, J. Am. Stat. Assoc. 90:773).
STRONG = 10.0


def compared(
    balance: Balance,
    symmetry: str,
    noise: Noise,
    forms: Sequence[str],
    known: Estimate | None = None,
    doubtful: GivenErrors | None = None,
) -> tuple[tuple[Candidate, ...], dict[str, Estimate]]:
    """Candidates in ascending BIC, and the estimates by form; forms that the lines cannot determine are left out. Equation (ds-bic)."""
    estimates: dict[str, Estimate] = {}
    for form in dict.fromkeys((*forms, *([known.model.form.name] if known else []))):
        try:
            fits = known is not None and form == known.model.form.name
            estimates[form] = (
                known if fits and known is not None else estimate(balance, StiffnessModel(FORMS[form], symmetry), noise, doubtful)
            )
        except FitError:
            continue
    ranked = sorted((_candidate(form, fitted, balance.n_equation) for form, fitted in estimates.items()), key=_bic)
    return tuple(ranked), estimates


def _bic(candidate: Candidate) -> float:
    assert candidate.bic is not None
    return candidate.bic


def _candidate(form: str, found: Estimate, n_equation: int) -> Candidate:
    n = found.values.size
    bic = found.squares + n * float(np.log(n_equation))
    return Candidate(form, n, found.squares, found.dof, found.squares + 2 * n, bic=bic, chi2_p=found.p_value)


def choice_findings(candidates: Sequence[Candidate], form: str, given: bool) -> tuple[Finding, ...]:
    """Warnings: no candidate passes its chi-square test; another form than the *given* one is better."""
    if not candidates:
        return ()
    findings = []
    if all(candidate.chi2_p is not None and candidate.chi2_p < MISMATCH_P for candidate in candidates):
        least = min(candidates, key=lambda candidate: candidate.chi2 / candidate.dof)
        names = ", ".join(candidate.name for candidate in candidates)
        message = (
            f"none of the compared forms ({names}) explains the data: the best, {least.name}, leaves {least.chi2 / least.dof:.3g} times "
            f"the squares that noise would (p = {least.chi2_p:.2g}). The bearing is not linear at this amplitude, a "
            "channel or the baseline is wrong, or its course over frequency is another one; look at the figure over frequency"
        )
        findings.append(Finding("no-model", message))
    best = candidates[0]
    this = next((candidate for candidate in candidates if candidate.name == form), None)
    if given and this is not None and _bic(this) - _bic(best) > STRONG:
        message = (
            f"another form is better supported by the data: '{best.name}' with {best.parameters} parameters has BIC {_bic(best):.4g}, "
            f"'{form}' with {this.parameters} parameters {_bic(this):.4g}"
        )
        findings.append(Finding("other-model", message))
    return tuple(findings)

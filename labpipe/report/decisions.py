"""How was decided on limits: probability, guard band, and the risks of every decision."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.display import plain_text, two_digits
from labpipe.records.identification import RuleDecision, RuleOutcome
from labpipe.report.document import Block, Table

# What rules without limits decide by, since ISO/IEC 17025, 7.8.6, asks for it to be stated.
SIMPLE_ACCEPTANCE = "without limits: simple acceptance, the value alone is compared"


def decision_blocks(outcomes: Sequence[RuleOutcome]) -> tuple[Block, ...]:
    """A table of the decisions on limits; nothing without any."""
    rows = tuple(_row(outcome.rule, outcome.decision) for outcome in outcomes if outcome.decision is not None)
    if not rows:
        return ()
    heads = ("rule", "outcome", "within the limits", "u", "passes", "risk here", "global risks")
    of_process = any(row[-1] for row in rows)
    shares = (
        ", and the shares of all that the stated process makes that are accepted falsely / rejected falsely"
        if of_process
        else ""
    )
    caption = (
        "Decisions on limits: the probability that they hold, the combined standard uncertainty u, the "
        "values that pass, the risk of this decision (of a false acceptance where it passes, else of a "
        f"false rejection){shares} (JCGM 106, ILAC-G8)"
    )
    if of_process:
        return (Table(heads, rows, caption),)
    return (Table(heads[:-1], tuple(row[:-1] for row in rows), caption),)


def _row(rule: str, decision: RuleDecision) -> tuple[str, ...]:
    least = ">= " if decision.least else ""
    return (
        rule,
        decision.outcome,
        least + percent(decision.probability),
        "" if decision.uncertainty is None else plain_text(decision.uncertainty, decision.unit, 2),
        _passes(decision),
        percent(decision.specific_risk),
        _global(decision),
    )


def percent(probability: float) -> str:
    """A probability [1] in per cent to two digits, from its nearer end: '99.943 %', '0.057 %'."""
    small = min(probability, 1.0 - probability)
    if small <= 0.0:
        return f"{100 * probability:.0f} %"
    text = two_digits(100 * small)
    if "e" in text:
        return "< 0.01 %" if probability < 0.5 else "> 99.99 %"
    decimals = len(text.partition(".")[2])
    return f"{100 * probability:.{decimals}f} %"


def _passes(decision: RuleDecision) -> str:
    low, high = decision.accept_low, decision.accept_high
    if low is None and high is None:
        return "" if decision.together > 1 else "nothing"
    texts = ["" if end is None else plain_text(end, decision.unit, 6) for end in (low, high)]
    return " to ".join(texts) if all(texts) else f">= {texts[0]}" if texts[0] else f"<= {texts[1]}"


def _global(decision: RuleDecision) -> str:
    if decision.global_false_acceptance is None or decision.global_false_rejection is None:
        return ""
    return f"{percent(decision.global_false_acceptance)} / {percent(decision.global_false_rejection)}"

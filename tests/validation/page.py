"""The manual's pages: prose of `words/`, tables of claims, and the comparison of two texts whose numbers may
differ in the last digit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from tests.validation.claims import KINDS, MEASURED, OF_OTHERS, Claim, Method

WORDS = Path(__file__).parent / "words"
PAGES = Path(__file__).parents[2] / "docs/pages/validation"
HEAD = ("quantity", "labpipe", "reference", "difference", "accepted", "against", "state")
MISS = ("quantity", "labpipe", "reference", "accepted", "against", "why")
GAP = ("not tested", "against", "why")
MARK = re.compile(r"^\[claims: (.+)\]$", re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?![\w.]*\w)")
STATES = ("holds", "fails", "not tested")


def cells(claim: Claim) -> tuple[str, ...]:
    """The cells of a row by `HEAD`."""
    assert claim.value is not None and claim.reference is not None
    digits = claim.decimals
    value, reference = (f"{number:.{digits}f}" for number in (claim.value, claim.reference))
    if claim.stated is not None:
        low, high = claim.stated
        value += f" ({low:.{digits}f} to {high:.{digits}f})" if low < high else " (no interval)"
    difference = f"{claim.value - claim.reference:+.{digits}f}"
    state = claim.state if claim.state == "holds" else f"**{claim.state}**"
    unit = "" if claim.unit == "1" else f" [{claim.unit}]"
    return (claim.quantity + unit, value, reference, difference, accepted(claim), against(claim), state)


def against(claim: Claim) -> str:
    return f"{claim.kind}: {claim.source}" if claim.source else claim.kind


def miss(claim: Claim) -> tuple[str, ...]:
    """The cells of a row that fails, by `MISS`."""
    quantity, value, reference, _, limits, source, _ = cells(claim)
    return (quantity, value, reference, limits, source, claim.why)


def accepted(claim: Claim) -> str:
    """Half width about the reference, or the range of the others."""
    digits, reference = claim.decimals, claim.reference
    assert reference is not None
    half = (claim.high - claim.low) / 2
    if abs(claim.low + half - reference) < 1e-9 * half:
        return f"± {half:.{digits}f}"
    return f"{claim.low:.{digits}f} to {claim.high:.{digits}f}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def method_page(method: Method, claims: dict[str, list[Claim]]) -> str:
    """The words with the table of every section at its mark.

    A check without a mark is an error of the page.
    """
    words = (WORDS / f"{method.name}.md").read_text(encoding="utf-8")
    marks = MARK.findall(words)
    assert marks == list(method.checks), (method.name, marks, list(method.checks))
    return MARK.sub(lambda found: section_table(claims[found.group(1)]), words)


def section_table(claims: Sequence[Claim]) -> str:
    if all(claim.state == "not tested" for claim in claims):
        return table(GAP, map(gap, claims))
    text = table(HEAD, map(cells, claims))
    reasons = [f"\n*Fails*: {cells(claim)[0]}: {claim.why}." for claim in claims if claim.state == "fails"]
    recorded = dict.fromkeys(claim.recorded for claim in claims if claim.recorded)
    return "\n".join([text, *reasons, *(f"\n*Recorded*: {words}" for words in recorded)])


def index_page(claims: dict[Method, list[Claim]]) -> str:
    """The first page: counts, misses, what is not tested, and all claims."""
    everything = [(method, claim) for method, of_method in claims.items() for claim in of_method]
    parts = {
        "counts": counts([claim for _, claim in everything]),
        "misses": rows([one for one in everything if one[1].state == "fails"], MISS, miss),
        "not tested": rows([one for one in everything if one[1].state == "not tested"], GAP, gap),
        "all": rows([one for one in everything if one[1].state != "not tested"], HEAD, cells),
    }
    words = (WORDS / "index.md").read_text(encoding="utf-8")
    return MARK.sub(lambda found: parts[found.group(1)], words)


def gap(claim: Claim) -> tuple[str, ...]:
    """The cells of what is not tested, by `GAP`."""
    return (claim.quantity, against(claim), claim.why)


def rows(
    claims: Sequence[tuple[Method, Claim]], head: Sequence[str], of: Callable[[Claim], tuple[str, ...]]
) -> str:
    return table(
        ("method", *head), ((f"[{method.title}]({method.name}.md)", *of(claim)) for method, claim in claims)
    )


def counts(claims: Sequence[Claim]) -> str:
    """Rows by kind and state, with the two sums that say how much of it nobody here made."""
    groups = {
        **{kind: (kind,) for kind in KINDS},
        "**all**": tuple(KINDS),
        "*of these by others*": OF_OTHERS,
        "*of these measured*": MEASURED,
    }
    lines = []
    for name, kinds in groups.items():
        states = [claim.state for claim in claims if claim.kind in kinds]
        lines.append(
            (name, *(str(states.count(state)) for state in STATES), str(len(states)), KINDS.get(name, ""))
        )  # type: ignore[call-overload]
    return table(("kind", *STATES, "rows", "what it is"), lines)


def same_text(made: str, committed: str) -> str:
    """Empty where both texts say the same, numbers to one unit of their last digit.

    Else the first line that differs.
    """
    ours, theirs = made.splitlines(), committed.splitlines()
    for number, (left, right) in enumerate(zip(ours, theirs, strict=False), start=1):
        if left != right and not same_line(left, right):
            return f"line {number}:\n  made      {left}\n  committed {right}"
    return "" if len(ours) == len(theirs) else f"{len(ours)} lines made, {len(theirs)} committed"


def same_line(left: str, right: str) -> bool:
    """The same words, and every number within 1.01 units of its last printed digit."""
    if NUMBER.sub("#", left) != NUMBER.sub("#", right):
        return False
    return all(
        close(one, other) for one, other in zip(NUMBER.findall(left), NUMBER.findall(right), strict=True)
    )


def close(one: str, other: str) -> bool:
    digits = len(one.partition(".")[2])
    return len(other.partition(".")[2]) == digits and abs(float(one) - float(other)) <= 1.01 * 10.0**-digits

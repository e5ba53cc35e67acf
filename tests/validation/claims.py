"""A claim: one number that labpipe computes, compared with a reference that somebody else stands for, with
what is accepted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

Kind = Literal[
    "closed form",
    "known truth",
    "independent calculation",
    "printed calculation",
    "printed measurement",
    "peer program",
    "measured public data",
]
State = Literal["holds", "fails", "not tested"]

KINDS: dict[Kind, str] = {
    "closed form": "a formula of a textbook, or its quadrature, evaluated in the row itself",
    "known truth": "recordings of a virtual rig, whose coefficients are known: what many draws of its noise "
    "show of the intervals",
    "independent calculation": "a second program or a series of operations, written for this purpose and "
    "sharing nothing with labpipe",
    "printed calculation": "figures that others computed and printed: in tables, appendices, textbooks, "
    "reports of manufacturers",
    "printed measurement": "figures that others measured and printed, or evaluated from readings that they "
    "print",
    "peer program": "what another program makes of the same input",
    "measured public data": "recordings that others made, run from their raw files; beside them stands what "
    "the authors say of them",
}
# Kinds whose figures nobody here made, and of these the ones that rest on an instrument.
MEASURED: tuple[Kind, ...] = ("printed measurement", "measured public data")
OF_OTHERS: tuple[Kind, ...] = (*MEASURED, "printed calculation", "peer program")


@dataclass(frozen=True)
class Claim:
    """A row of the manual. The value is accepted from *low* to *high*, or, where its 95 % interval is
    *stated* (not a number: there is none), if that holds the reference; *why* is needed where it fails,
    *recorded* says how what cannot be computed everywhere was recorded.
    """

    quantity: str
    value: float | None
    reference: float | None
    unit: str
    low: float
    high: float
    kind: Kind
    source: str
    why: str = ""
    recorded: str = ""
    stated: tuple[float, float] | None = None

    @property
    def state(self) -> State:
        if self.value is None:
            return "not tested"
        if self.stated is not None:
            assert self.reference is not None
            return "holds" if self.stated[0] <= self.reference <= self.stated[1] else "fails"
        return "holds" if self.low <= self.value <= self.high else "fails"

    @property
    def decimals(self) -> int:
        """Digits after the point of all of the row's numbers: the half width of what is accepted has two
        figures.
        """
        width = (self.high - self.low) / 2
        return max(0, 1 - math.floor(math.log10(width))) if width > 0 else 0


def within(
    quantity: str,
    value: float,
    reference: float,
    tolerance: float,
    unit: str,
    kind: Kind,
    source: str,
    why: str = "",
    *,
    relative: bool = False,
    recorded: str = "",
) -> Claim:
    """Accepted within *tolerance* of the reference, in its unit or (*relative*) as a share of it."""
    half = tolerance * abs(reference) if relative else tolerance
    return Claim(
        quantity,
        float(value),
        reference,
        unit,
        reference - half,
        reference + half,
        kind,
        source,
        why,
        recorded,
    )


def among(
    quantity: str,
    value: float,
    reference: float,
    others: Sequence[float],
    unit: str,
    kind: Kind,
    source: str,
    why: str = "",
    recorded: str = "",
) -> Claim:
    """Accepted between the smallest and the largest of what the authors and the others say."""
    low, high = min(reference, *others), max(reference, *others)
    return Claim(quantity, float(value), reference, unit, low, high, kind, source, why, recorded)


def untested(quantity: str, kind: Kind, source: str, why: str) -> Claim:
    """What should be compared with this source and is not, with the reason."""
    return Claim(quantity, None, None, "", 0.0, 0.0, kind, source, why)


def worst(claims: Sequence[Claim], quantity: str) -> Claim:
    """Of many figures of one table the one farthest from its reference in tolerances, so that a table is one
    row.
    """

    def distance(claim: Claim) -> float:
        assert claim.value is not None and claim.reference is not None
        # Rounding of the processor does not choose: of equals it is the first.
        return round(abs(claim.value - claim.reference) / ((claim.high - claim.low) / 2), 2)

    found = max(claims, key=distance)
    return replace(found, quantity=f"{quantity}; worst of {len(claims)}: {found.quantity}")


Check = Callable[[], list[Claim]]


@dataclass(frozen=True, eq=False)
class Method:
    """A page: *name* of the file, its title, the checks by section of the page, and those that are computed
    among the long tests.
    """

    name: str
    title: str
    checks: dict[str, Check]
    long: tuple[str, ...] = ()

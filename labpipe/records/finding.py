"""A finding: something the user must know about the measurement or the fit, in a code and in words."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

NOTE, WARNING = "note", "warning"


@dataclass(frozen=True)
class Finding:
    """*code* for programs (clipped, gap, collinear, ...), *message* for people. Findings travel downstream with the results.

    *level*: a warning limits how far a number can be trusted; a note only says what was done (lines masked, a hit left out).
    """

    code: str
    message: str
    level: str = WARNING

    def __post_init__(self) -> None:
        if self.level not in (NOTE, WARNING):
            raise ValueError(f"a finding is a note or a warning, not '{self.level}'")


def note(code: str, message: str) -> Finding:
    """A finding that only informs."""
    return Finding(code, message, NOTE)


def of_level(level: str, findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings of one level, in their order."""
    return tuple(finding for finding in findings if finding.level == level)

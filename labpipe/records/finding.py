"""A finding: something the user must know about the measurement or the fit, in a code and in words."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """*code* for programs (clipped, gap, collinear, ...), *message* for people. Findings travel downstream with the results."""

    code: str
    message: str

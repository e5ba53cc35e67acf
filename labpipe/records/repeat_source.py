"""What changes between repeats of a test and is not seen within one: drift between days, remounting."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RepeatSource:
    """A standard uncertainty of one *parameter* of every fit, relative to its value.

    per: condition; tests of one value of it have one error in common. Empty: every test has its own. dof: degrees of freedom behind the
    size, None where it is known.
    """

    name: str
    parameter: str
    relative: float
    per: str = ""
    dof: float | None = None

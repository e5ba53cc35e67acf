"""Fits of an FRF that was measured in a closed loop: what the loop explains is not laid to mass, signs or band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from labpipe.identify.corrections import is_direct
from labpipe.records.finding import WARNING, Finding, note
from labpipe.records.identification import Fit, Parameter

# Findings that name a cause, where a biased FRF alone makes them appear.
OF_ANOTHER_CAUSE = ("mass", "unphysical")


def with_feedback(fit: Fit, measured: Sequence[Finding]) -> Fit:
    """The fit with the warning `feedback` of the FRF it is of, which takes the place of wrong causes."""
    loops = [finding for finding in measured if finding.code == "feedback" and finding.level == WARNING]
    if not loops:
        return fit
    others = [finding for finding in fit.findings if finding.code not in OF_ANOTHER_CAUSE]
    biased = Finding(
        "feedback",
        "the force is fed back from the response, so all values of this fit are biased towards minus the inverse of the controller, by an "
        "amount that cannot be known, whatever their intervals say. Neither mass nor signs can be judged. Record what is injected, with "
        "role: reference, and name it: `frf: {reference: ...}`",
    )
    return replace(fit, findings=(biased, *others))


def is_of_closed_loop(measured: Sequence[Finding]) -> bool:
    """Whether an FRF was measured in a loop that is known to be closed."""
    return any(finding.code == "closed-loop" for finding in measured)


def held_findings(parameters: Sequence[Parameter]) -> list[Finding]:
    """A note on negative stiffness in a closed loop: that of a magnetic bearing without its controller."""
    negative = [p.name for p in parameters if is_stiffness(p) and p.value < 0 and p.significant]
    if not negative:
        return []
    return [note("closed-loop", f"{', '.join(negative)} is negative: without its controller the rotor would not stay, the loop holds it")]


def is_stiffness(parameter: Parameter) -> bool:
    """Whether a parameter is a direct stiffness."""
    return is_direct(parameter.name) and parameter.name.startswith("k")

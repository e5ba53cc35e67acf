"""What a wear identification must say about itself, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.records.finding import Finding
from labpipe.wear.misfit import Misfit
from labpipe.wear.profile import Interval
from labpipe.wear.search import Minimum
from labpipe.wear.settings import ANGLE, DEPTH, WearSettings

# Further minima count while their chi-square lies less than this above the least: the 99 % quantile for two parameters.
RIVAL = 9.21
AT_BOUND = 1e-4
PROBABLY_HEALTHY, PROBABLY_WORN = 0.5, 0.05
DISPLAY = {"m": (1e6, "um"), "rad": (180 / np.pi, "deg"), "Pa": (1e-5, "bar")}


def bounds_reached(misfit: Misfit, best: Minimum) -> tuple[str, ...]:
    """The parameters that lie at their bound."""
    model = misfit.model
    margin = AT_BOUND * (model.high - model.low)
    at = (best.parameters <= model.low + margin) | (best.parameters >= model.high - margin)
    return tuple(name for name, hit in zip(model.names, at, strict=True) if hit)


def bound_findings(names: Sequence[str]) -> list[Finding]:
    """Parameters at their bound: what that means for each."""
    found = []
    for name in names:
        reason = {
            DEPTH: "there is no wear to be seen, or more than is looked for (depth_limit)",
            ANGLE: "the wear lies farther from the bottom than is looked for (angle_limit), or the angle is not identifiable",
        }.get(name, "the response wants more of it than what is known beforehand allows; the model may lack something else")
        found.append(Finding("at-bound", f"{name} lies at its bound: {reason}. No standard error is given for it"))
    return found


def rival_findings(found: Sequence[Minimum], misfit: Misfit) -> list[Finding]:
    """Other minima that the response does not rule out."""
    best = found[0]
    rivals = [one for one in found[1:] if one.converged and one.chi2 - best.chi2 < RIVAL]
    if not rivals or DEPTH not in misfit.model.names:
        return []
    places = "; ".join(f"{_place(misfit, one)} (chi-square {one.chi2 - best.chi2:+.2g})" for one in rivals)
    message = (
        f"the misfit has further minima that the response does not rule out: {places}. Use more lines, all terms, or the complex "
        "objective; what is known of the bearing may decide between them"
    )
    return [Finding("multi-modal", message)]


def _place(misfit: Misfit, one: Minimum) -> str:
    values = misfit.model.values(one.parameters)
    return f"{values[DEPTH] * 1e6:.3g} um at {np.degrees(values[ANGLE]):.3g} deg"


def angle_findings(identifiable: bool) -> list[Finding]:
    """Whether the angle means anything."""
    if identifiable:
        return []
    message = "angle not identifiable: every angle in the range explains the response as well, as it is with shallow wear"
    return [Finding("not-identifiable", message)]


def is_identifiable(interval: Interval) -> bool:
    """Whether a profile interval leaves anything of the range out."""
    return not (interval.open_low and interval.open_high)


def healthy_findings(probability: float, mismatch: bool) -> list[Finding]:
    """The verdict on wear or no wear where it is not plainly wear; *mismatch*: the residual exceeds the noise."""
    if probability < PROBABLY_WORN:
        return []
    odds = f"the probability of no wear is {probability:.3g} (even odds before, any wear of the range alike)"
    if mismatch:
        message = f"the bearing may be healthy: {odds}, if only the model were right, which chi-square denies"
        return [Finding("perhaps-healthy", message)]
    if probability >= PROBABLY_HEALTHY:
        return [Finding("healthy", f"the bearing is probably healthy: {odds}")]
    return [Finding("perhaps-healthy", f"the bearing may be healthy: {odds}")]


def search_note(found: Sequence[Minimum], settings: WearSettings) -> str:
    """How the minimum was found."""
    total = sum(one.starts for one in found)
    best = found[0]
    cells = f"{2 * settings.cells_around} x {2 * settings.cells_across}"
    return (
        f"{best.starts} of {total} starts lead to this minimum, {len(found)} minima in all; refined on oil films of {cells} cells "
        f"around tables of {settings.cells_around} x {settings.cells_across}."
    )

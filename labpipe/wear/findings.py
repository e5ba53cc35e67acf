"""Findings of a wear identification: bounds, further minima, identifiability, healthy bearing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.bearings.journal_mesh import FilmMesh
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
    """Names of the parameters at a bound."""
    model = misfit.model
    margin = AT_BOUND * (model.high - model.low)
    at = (best.parameters <= model.low + margin) | (best.parameters >= model.high - margin)
    return tuple(name for name, hit in zip(model.names, at, strict=True) if hit)


def bound_findings(names: Sequence[str]) -> list[Finding]:
    """One finding per parameter at its bound."""
    findings = []
    for name in names:
        reason = {
            DEPTH: "no wear is visible, or it is deeper than depth_limit",
            ANGLE: "the wear is farther from the bottom than angle_limit, or the angle is not identifiable",
        }.get(name, "the best fit lies outside the prior range; the model may lack another effect")
        findings.append(Finding("at-bound", f"{name} lies at its bound: {reason}. No standard error is given for it"))
    return findings


def rival_findings(minima: Sequence[Minimum], misfit: Misfit) -> list[Finding]:
    """Further minima within RIVAL of the lowest chi-square."""
    best = minima[0]
    rivals = [minimum for minimum in minima[1:] if minimum.converged and minimum.chi2 - best.chi2 < RIVAL]
    if not rivals or DEPTH not in misfit.model.names:
        return []
    places = "; ".join(f"{_place(misfit, minimum)} (chi-square {minimum.chi2 - best.chi2:+.2g})" for minimum in rivals)
    message = (
        f"the misfit has further minima of nearly the same chi-square: {places}. Use more lines, all terms, or the complex "
        "objective; prior knowledge of the bearing may select one"
    )
    return [Finding("multi-modal", message)]


def _place(misfit: Misfit, minimum: Minimum) -> str:
    values = misfit.model.values(minimum.parameters)
    return f"{values[DEPTH] * 1e6:.3g} um at {np.degrees(values[ANGLE]):.3g} deg"


def angle_findings(identifiable: bool) -> list[Finding]:
    """A finding where the angle is not identifiable."""
    if identifiable:
        return []
    message = "angle not identifiable: every angle in the range fits equally well, as is usual with shallow wear"
    return [Finding("not-identifiable", message)]


def is_identifiable(interval: Interval) -> bool:
    """False if the profile interval covers the whole range."""
    return not (interval.open_low and interval.open_high)


def healthy_findings(probability: float, mismatch: bool) -> list[Finding]:
    """A finding where a healthy bearing is not ruled out; *mismatch*: the residual exceeds the noise."""
    if probability < PROBABLY_WORN:
        return []
    odds = f"the probability of no wear is {probability:.3g} (prior: even odds, wear uniform over the range)"
    if mismatch:
        message = f"the bearing may be healthy: {odds}, given a right model, which chi-square rejects"
        return [Finding("perhaps-healthy", message)]
    if probability >= PROBABLY_HEALTHY:
        return [Finding("healthy", f"the bearing is probably healthy: {odds}")]
    return [Finding("perhaps-healthy", f"the bearing may be healthy: {odds}")]


def search_note(minima: Sequence[Minimum], settings: WearSettings, mesh: FilmMesh) -> str:
    """Starts, minima and meshes of the search, as a note; *mesh*: of the films that refine a minimum."""
    total = sum(minimum.starts for minimum in minima)
    best = minima[0]
    cells = f"{mesh.around} x {mesh.across}"
    return (
        f"{best.starts} of {total} starts lead to this minimum, {len(minima)} minima in all; refined on oil films of {cells} cells "
        f"around tables of {settings.cells_around} x {settings.cells_across}."
    )

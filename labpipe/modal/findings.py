"""Findings and notes of a modal identification."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.identify.diagnostics import MISMATCH_P
from labpipe.modal.likelihood import Refined
from labpipe.modal.missing import Completed
from labpipe.modal.residual_terms import Lines
from labpipe.modal.whole_covariance import ModalEstimate
from labpipe.records.finding import Finding
from labpipe.records.identification import Parameter

# Lines in the half-power width below which a window is as wide as the mode.
LEAST_LINES = 2.0
# Standard errors beyond which a mass counts as negative.
SURE = 3.0


def mismatch(estimate: ModalEstimate) -> float | None:
    """sqrt(chi-square per degree of freedom) where it is significantly above 1, else None."""
    if estimate.chi2_reduced is None or estimate.chi2_p is None or estimate.chi2_p >= MISMATCH_P:
        return None
    return float(np.sqrt(estimate.chi2_reduced))


def unexplained(estimate: ModalEstimate, p_noise: float) -> bool:
    """Whether the residual is no noise where the noise is not known: nothing then says how wide an interval would be."""
    return estimate.chi2_reduced is None and p_noise < MISMATCH_P


def modal_findings(estimate: ModalEstimate, p_noise: float) -> tuple[Finding, ...]:
    """Warnings: no convergence, negative damping, a residual beyond the measured noise or alike on neighbouring lines."""
    warnings = []
    if not estimate.refined.converged:
        message = f"the refinement of the modes did not converge in {estimate.refined.steps} steps; its numbers are not a result"
        warnings.append(Finding("no-convergence", message))
    unstable = estimate.refined.poles[estimate.refined.poles.real >= 0]
    if unstable.size:
        where = ", ".join(f"{abs(pole) / (2 * np.pi):.4g} Hz" for pole in unstable)
        warnings.append(
            Finding("unphysical", f"the mode at {where} has a negative damping ratio: it is noise, or energy enters the structure")
        )
    factor = mismatch(estimate)
    if factor is not None:
        message = (
            f"the residual is {factor:.3g} times what the measured noise explains (chi-square per degree of freedom "
            f"{estimate.chi2_reduced:.3g}, p = {estimate.chi2_p:.2g}): a mode is missing, or the structure is not linear. The "
            f"intervals that are printed are {factor:.3g} times those of noise alone, since the excess counts as noise. Name the missing "
            "mode in `poles`, or narrow the band."
        )
        warnings.append(Finding("model-mismatch", message))
    elif unexplained(estimate, p_noise):
        message = (
            f"the residual is not noise: it is alike on neighbouring lines (p = {p_noise:.2g}). A mode is missing, the structure is not "
            "linear, or its modes differ from point to point (a sensor that loads it). So no interval is given. Name the missing mode in "
            "`poles`, or narrow the band."
        )
        warnings.append(Finding("model-mismatch", message))
    return tuple(warnings)


def width_findings(refined: Refined, lines: Lines, *, window_known: bool) -> tuple[Finding, ...]:
    """A warning for modes hardly wider than a line unless noise or window of the FRFs is known.

    Half-power width -2 Re lambda over the distance of the lines [1].
    """
    width = -2 * refined.poles.real / float(np.mean(np.diff(lines.omega)))
    narrow = [] if window_known else [mode for mode in np.argsort(np.abs(refined.poles)) if width[mode] < LEAST_LINES]
    if not narrow:
        return ()
    places = ", ".join(f"{abs(refined.poles[mode]) / (2 * np.pi):.6g} Hz ({width[mode]:.2g})" for mode in narrow)
    message = (
        f"half-power widths of {LEAST_LINES:g} lines or less: {places}. The window of the analyser, and how much leaked, decide such a "
        "peak: its damping, and whether a second mode seems to stand beside it. No standard error shows that. Say `window:` in the entry "
        "under frfs:, or measure with finer lines"
    )
    return (Finding("leakage", message),)


def mass_findings(parameters: Sequence[Parameter]) -> tuple[Finding, ...]:
    """A warning for every modal mass that is negative by more than its doubt: at a driving point no structure has one."""
    negative = [
        parameter
        for parameter in parameters
        if parameter.name.startswith("m_") and parameter.std_error is not None and parameter.value < -SURE * parameter.std_error
    ]
    modes = [mode.name.removeprefix("m_") for mode in negative]
    if not modes:
        return ()
    named = f"mode {modes[0]} has" if len(modes) == 1 else f"modes {', '.join(modes)} have"
    message = (
        f"{named} a negative mass at the driving point: force and response are not at one place and in one direction, a sign is wrong, or "
        "the pole stands for a part of its neighbours"
    )
    return (Finding("unphysical", message),)


def modal_notes(estimate: ModalEstimate, whole: Completed, n_reference: int, forces_move: bool) -> tuple[str, ...]:
    """What a reader must know: where the noise comes from, residual terms, a single reference, moved forces."""
    terms = whole.terms
    notes = [f"modal: residual terms of every FRF: {terms.lower} for modes below the band, {terms.upper} for modes above it, by AIC."]
    if estimate.unused:
        notes.append(f"modal: the measured covariance is not used: {estimate.unused}.")
    if estimate.chi2_reduced is None:
        notes.append(
            "modal: the size of the noise comes from the residual of every FRF, its course along the lines from a measured covariance "
            "(without one it is the same at all lines); the chi-square test of the model is not possible."
        )
    if whole.added:
        notes.append(f"modal: {whole.added} mode(s) were added that the diagram did not show, since the residual was not noise.")
    if n_reference == 1:
        notes.append("modal: with one reference a mode with a node there is not seen, and modes of the same frequency are one.")
    if forces_move:
        notes.append("modal: the forces are the points of the shapes, the responses the references (reciprocity is assumed).")
    return tuple(notes)

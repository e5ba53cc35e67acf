"""Findings and notes of a fit of free decays."""

from __future__ import annotations

import numpy as np

from labpipe.distributions import normal_tail
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.ring_down.amplitude_law import FittedLaw, MissingMode
from labpipe.methods.ring_down.likelihood import Decayed
from labpipe.methods.ring_down.residual_test import Judged
from labpipe.records.finding import Finding

# Mean square of a residual at the end over that at the beginning from which it goes on.
GOES_ON = 0.5


def depends_on_amplitude(law: FittedLaw) -> bool:
    """Whether a slope of the law differs significantly from zero, and the law is no worse than its noise
    allows to tell.
    """
    errors = np.sqrt(np.diag(law.covariance))
    slopes = np.array([law.law.zeta_slope, law.law.frequency_slope])
    ratios = np.divide(np.abs(slopes), errors[1:3], out=np.zeros(2), where=errors[1:3] > 0)
    return law.converged and 4 * normal_tail(float(np.max(ratios))) < MISMATCH_P


def decay_findings(
    fitted: Decayed,
    tested: Judged,
    laws: dict[int, FittedLaw],
    amplitudes: dict[int, float],
    missing: MissingMode | None,
) -> tuple[Finding, ...]:
    """Warnings: no convergence, growing oscillations, damping over amplitude (*laws* and first *amplitudes*
    by mode), other residuals.

    *missing*: the mode that explains the residual better than a law.
    """
    warnings = []
    if not fitted.converged:
        message = (
            f"the fit of the decay did not converge in {fitted.steps} steps; its numbers are not a result"
        )
        warnings.append(Finding("no-convergence", message))
    lasting = _lasting(fitted)
    if lasting:
        where = ", ".join(f"{frequency:.4g} Hz" for frequency in lasting)
        what = (
            f"the damping ratio at {where} cannot be told from zero at 95 %: hum, an excitation that "
            "goes on, or too short a decay"
        )
        warnings.append(Finding("insignificant", what))
    growing = fitted.poles[fitted.poles.real >= 0]
    if growing.size:
        where = ", ".join(f"{abs(pole) / (2 * np.pi):.4g} Hz" for pole in growing)
        warnings.append(
            Finding(
                "unphysical",
                f"the oscillation at {where} does not decay: energy enters the structure, "
                "or it is an excitation",
            )
        )
    beats = missing.mode if missing is not None else None
    warnings.extend(
        _over_amplitude(mode, law, amplitudes[mode], missing if mode == beats else None)
        for mode, law in laws.items()
    )
    gaining = [mode for mode, law in laws.items() if law.law.zeta_rest < -2 * np.sqrt(law.covariance[0, 0])]
    warnings.extend(_gaining(mode, laws[mode].law.zeta_rest) for mode in gaining)
    if missing is not None and missing.white:
        warnings.append(_beating(missing, fitted.poles.size))
    explained = laws and all(law.law.p_value >= MISMATCH_P for law in laws.values())
    if not explained and min(tested.white, tested.amplitude) < MISMATCH_P:
        p_value = min(tested.white, tested.amplitude)
        # What rings down with the decay is of the model, what does not is of something else.
        goes_on = tested.ending > GOES_ON
        cause = (
            "it goes on to the end: a force that does not stop, such as wind or hum, dry friction, or "
            "coloured noise"
            if goes_on
            else "another mode or hum, forced motion at the start, or coloured noise"
        )
        message = (
            f"what the fit leaves is not white noise (p = {p_value:.2g}), most of it near "
            f"{tested.strongest:.4g} Hz: {cause}. "
            "Intervals hold what the stretches of the decay scatter by. Raise `modes`, name a `band` "
            "around the mode, or begin later (`frf: {decay: {start: ...}}`)."
        )
        warnings.append(Finding("model-mismatch", message))
    return tuple(warnings)


def _lasting(fitted: Decayed) -> list[float]:
    """Frequencies [Hz] of the modes that decay, but by less than two standard errors of their decay."""
    errors = np.sqrt(np.diag(fitted.covariance)[0::2])
    lasting = (fitted.poles.real < 0) & (-fitted.poles.real < 2 * errors)
    return [float(abs(pole) / (2 * np.pi)) for pole in fitted.poles[lasting]]


def _over_amplitude(mode: int, fitted: FittedLaw, first: float, missing: MissingMode | None) -> Finding:
    law = fitted.law
    change = 100 * law.frequency_slope * first / law.omega
    message = (
        f"mode {mode + 1}: damping or frequency depend on the amplitude, so zeta_{mode + 1} is a mean over "
        "this decay, whose interval holds what its stretches scatter by. Damping ratio "
        f"{law.zeta_rest:.4g} at rest, "
        f"{law.zeta_rest + law.zeta_slope * first:.4g} at the largest amplitude (zeta_rest_{mode + 1}, "
        f"zeta_slope_{mode + 1}); the frequency differs by {change:.2g} % there. Compare decays of one "
        "amplitude."
    )
    if missing is not None:
        where = " and ".join(f"{frequency:.5g}" for frequency in missing.frequencies)
        message += (
            f" Two modes in its place, at {where} Hz, explain more of the decay than this law (difference of "
            f"BIC {missing.better:.3g}), but not all: they may beat. Try one more in `modes`."
        )
    return Finding("amplitude-dependent", message)


def _beating(missing: MissingMode, n_mode: int) -> Finding:
    first, second = missing.frequencies
    message = (
        f"mode {missing.mode + 1} looks as if its damping or frequency depended on the amplitude, but two "
        f"modes in its place, at {first:.5g} and {second:.5g} Hz, explain the decay better (difference of "
        f"BIC {missing.better:.3g}): they beat. Set `modes: {n_mode + 1}`."
    )
    return Finding("missing-mode", message)


def _gaining(mode: int, zeta_rest: float) -> Finding:
    message = (
        f"mode {mode + 1}: the law over the amplitude has a damping ratio of {zeta_rest:.4g} at rest "
        f"(zeta_rest_{mode + 1}), and a structure at rest gains no energy. The amplitude is not what it "
        "depends on: two close modes that beat look like this. Raise `modes`."
    )
    return Finding("unphysical", message)

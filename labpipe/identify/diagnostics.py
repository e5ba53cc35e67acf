"""Diagnostics of a fit: warnings with a code, the cause and a remedy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.identify.corrections import is_direct
from labpipe.identify.loops import held_findings, is_stiffness
from labpipe.identify.statistics import Estimate, condition_number
from labpipe.records.finding import Finding
from labpipe.records.identification import Goodness, Parameter
from labpipe.records.response import FrequencyResponse

# Condition numbers of a column-scaled design above 30 are strong collinearity (Belsley, Kuh and Welsch 1980, section 3.2);
# there more than half of a parameter's variance comes from the weak direction.
COLLINEAR_CONDITION = 30.0
VARIANCE_PROPORTION = 0.5
# Amplification of an FRF error in the coefficients below which their signs are reliable.
HARMFUL_GROWTH = 30.0
# Estimates from products of columns lose the square of the condition number in rounding (1e-16 x 1e4^2 leaves eight digits, 1e6^2 four,
# and the lost ones differ from processor to processor): larger numbers are written as a power of ten.
ROUGH = 1e4
MISMATCH_P = 0.01
# Parameters of a transfer FRF's mode that are zero for the simplest structure: that they are says nothing against the model.
OPTIONAL = ("modal_constant_quadrature", "residual_re", "residual_im")
FEW_DOF = 5
EQUATIONS_PER_PARAMETER = 3
LOW_COHERENCE = 0.9
LOW_GOF = 0.5
LOW_SNR = 10.0


# From the names of parameters that the data cannot tell apart to what would.
Remedy = Callable[[Sequence[str]], str]


def remedy(group: Sequence[str]) -> str:
    """Remedy that separates the parameters of a collinear group fitted to a frequency response."""
    if any(name.split("_")[-1] in ("xy", "yx") for name in group):
        return "measure a second, independent force direction, or fit the model rotor-2dof-direct"
    if "m" in group:
        return "give the mass if it is known, or widen the band to both sides of the resonance"
    return "widen the band, measure a second, independent force direction, or fit a model with fewer parameters"


def estimate_findings(
    estimate: Estimate, names: Sequence[str], n_line: int, units: Sequence[str] = (), cure: Remedy = remedy
) -> list[Finding]:
    """Warnings on the estimate: convergence, collinearity with its *cure*, few lines. Its residual is judged in `mismatch`."""
    warnings: list[Finding] = []
    if not estimate.converged:
        message = f"the estimator did not converge in {estimate.iterations} iterations; its numbers are not a result"
        warnings.append(Finding("no-convergence", message))
    warnings.extend(_collinear(estimate, names, units, cure))
    n_equation = estimate.dof + len(names)
    if estimate.dof < FEW_DOF or n_equation < EQUATIONS_PER_PARAMETER * len(names):
        message = f"{n_line} lines give {n_equation} equations for {len(names)} parameters; widen the band or measure with finer spacing"
        warnings.append(Finding("few-lines", message))
    return warnings


def _collinear(estimate: Estimate, names: Sequence[str], units: Sequence[str], cure: Remedy) -> list[Finding]:
    """Parameters that are not separately identifiable, by Belsley's variance proportions of the weak directions.

    Correlated columns alone are harmless: stiffness and mass of a resonance have similar columns but small errors. The warning requires
    an error of the FRF to be amplified in the parameters.
    """
    condition = condition_number(estimate.scaled_design)
    if condition < COLLINEAR_CONDITION:
        return []
    groups = collinear_groups(estimate.scaled_design, names)
    group = [name for members in groups for name in members] or list(names)
    growth = _growth(estimate, names, units, group) if units else None
    if growth is not None and growth < HARMFUL_GROWTH:
        return []
    amplified = (
        f" A systematic error of 1 % in what was measured can become {_rough(growth)} % in them, which no standard error shows."
        if growth
        else ""
    )
    message = (
        f"the excitation does not tell these parameters apart: {', '.join(group)} (condition number {_rough(condition)}, limit "
        f"{COLLINEAR_CONDITION:g}).{amplified} Their values and signs are unreliable, however good the fit. Remedy: {cure(group)}."
    )
    return [Finding("collinear", message)]


def _rough(number: float) -> str:
    """Three digits, or the nearest power of ten where rounding decides on the digits."""
    return f"{number:.3g}" if number < ROUGH or math.isinf(number) else f"about 1e{math.log10(number):.0f}"


def _growth(estimate: Estimate, names: Sequence[str], units: Sequence[str], group: Sequence[str]) -> float | None:
    """The largest amplification in the group, relative to the largest coefficient of its unit; None where it is unknown."""
    if estimate.amplification is None:
        return None
    largest = {unit: max(abs(v) for v, u in zip(estimate.values, units, strict=True) if u == unit) for unit in units}
    return max(
        float(amplification / largest[unit]) if largest[unit] > 0 else float("inf")
        for name, unit, amplification in zip(names, units, estimate.amplification, strict=True)
        if name in group
    )


def collinear_groups(scaled_design: FloatArray, names: Sequence[str]) -> list[list[str]]:
    """Parameters with most of their variance in weak directions, as one group; *scaled_design* (n_parameter, n_parameter) [1].

    Variance proportion of direction j in parameter i: (v_ij^2 / s_j^2) / sum_j (v_ij^2 / s_j^2).
    """
    _, singular, vectors = np.linalg.svd(scaled_design, full_matrices=False)
    floor = singular[0] * np.finfo(float).eps
    parts = (vectors / np.maximum(singular, floor)[:, None]) ** 2
    weak = singular[0] > COLLINEAR_CONDITION * singular
    involved = np.sum(parts[weak], axis=0) > VARIANCE_PROPORTION * np.sum(parts, axis=0)
    return [[name for name, inside in zip(names, involved, strict=True) if inside]] if np.any(involved) else []


def goodness_findings(gof: Goodness) -> list[Finding]:
    """A warning where the fit explains little of the response, or less than its mean does."""
    value = gof.r2_adjusted
    if value < 0:
        message = f"G.o.F {value:.3g} is negative: a constant would follow the data better than this fit. Its numbers are not a result"
        return [Finding("negative-gof", f"{message}; check the band, the ports, the signs of the channels and the model")]
    if value < LOW_GOF:
        message = (
            f"G.o.F {value:.3g}: the fit explains less than half of how the data vary over the band; the rest is noise, or not this model"
        )
        return [Finding("low-gof", message)]
    return []


def excess_findings(estimate: Estimate, biased: str = "") -> list[Finding]:
    """A finding where the residual exceeds the measured noise, for models whose intervals are not from a covariance alone.

    *biased*: name of an estimator that is so itself.
    """
    reduced, p_value = estimate.gof.chi2_reduced, estimate.gof.chi2_p
    if reduced is None or p_value is None or p_value >= MISMATCH_P:
        return []
    factor = np.sqrt(reduced)
    cause = f"the model is incomplete, or {biased} is biased; compare with ml" if biased else "the model is incomplete"
    message = (
        f"the residual is {factor:.3g} times what the measured noise explains (chi-square per degree of freedom {reduced:.3g}, "
        f"p = {p_value:.2g}): {cause}. Multiply the standard errors by {factor:.3g} at least, or narrow the band."
    )
    return [Finding("model-mismatch", message)]


def parameter_findings(parameters: Sequence[Parameter], *, driving: bool = True, held: bool = False) -> list[Finding]:
    """Warnings on the reported parameters: insignificant ones, and values impossible for a passive support.

    *driving*: False for the response at another point than the force's, whose coefficients have either sign. *held*: by a closed loop, in
    which negative stiffness floats.
    """
    warnings: list[Finding] = []
    weak = [p.name for p in parameters if p.significant is False and not p.derived and p.name not in OPTIONAL]
    if weak:
        message = f"{', '.join(weak)} cannot be told from zero at 95 %; a fit without them (`eliminate: true`) is as good"
        warnings.append(Finding("insignificant", message))
    judged = [p for p in parameters if driving and is_direct(p.name) and not (held and is_stiffness(p))]
    negative = [p.name for p in judged if p.value < 0 and p.significant]
    if negative:
        warnings.append(Finding("unphysical", f"{', '.join(negative)} is negative; check the mass, the sign of the channels and the band"))
    return [*warnings, *(held_findings(parameters) if held else ()), *_modal_findings(parameters)]


def _modal_findings(parameters: Sequence[Parameter]) -> list[Finding]:
    """Warnings on damping ratios impossible for a passive oscillator, and on models without oscillating modes."""
    ratios = [p for p in parameters if p.name == "zeta" or p.name.startswith("zeta_")]
    over = [
        Finding("unphysical", f"{p.name} = {p.value:.3g} is above 1: this fit has no resonance, f_n has no meaning")
        for p in ratios
        if p.value > 1
    ]
    unstable = [p.name for p in ratios if p.value < 0 and p.std_error is not None and p.value < -2 * p.std_error]
    if unstable:
        over.append(Finding("unphysical", f"{', '.join(unstable)} is negative: the identified system is unstable"))
    return over


def quality_findings(response: FrequencyResponse, rows: list[int], columns: list[int], lines: BoolArray) -> list[Finding]:
    """A warning where much of a response on the fit's *lines*, a mask (n_frequency,), is noise, by its power over all of them.

    The fit weighs lines by their noise, so single lines of low coherence, beside a resonance or at an antiresonance, do no harm.
    """
    power = np.abs(response.matrix[lines][:, rows][:, :, columns]) ** 2
    if response.multiple_coherence is not None:
        share = _noise_share(np.sum(power, axis=2), response.multiple_coherence[lines][:, rows])
    elif response.coherence is not None:
        share = _noise_share(power, response.coherence[lines][:, rows][:, :, columns])
    elif response.variance is not None:
        variance = response.variance[lines][:, rows][:, :, columns]
        if np.sum(variance) * LOW_SNR**2 <= np.sum(power):
            return []
        return [_low_coherence(f"the FRF is less than {LOW_SNR:g} times its standard deviation, in power over the band")]
    else:
        return []
    if share <= 1 - LOW_COHERENCE:
        return []
    return [_low_coherence(f"{100 * share:.0f} % of a response's power in the band is not explained by the forces (coherence)")]


def _noise_share(explained: FloatArray, coherence: FloatArray) -> float:
    """Largest share of a response's power that is noise; power due to the forces and *coherence* (n_line, n_output[, n_input]).

    Forces count as equally strong at all lines: explained / coherence is the whole power.
    """
    whole = np.divide(explained, coherence, out=np.zeros_like(explained), where=coherence > 0)
    total = np.sum(whole, axis=0)
    shares = np.divide(np.sum(whole - explained, axis=0), total, out=np.ones_like(total), where=total > 0)
    return float(np.max(shares))


def _low_coherence(what: str) -> Finding:
    return Finding("low-coherence", f"{what}; raise the force, average longer, or leave these lines out with `exclude`")


def covariance_findings(response: FrequencyResponse) -> list[Finding]:
    """A warning where the noise of the FRF is not known: nothing then tells a right model from a wrong one that follows the curve."""
    if response.covariance is not None:
        return []
    message = (
        "the FRF has no covariance (imported without it, or of a single average), so chi-square could not be checked: a high G.o.F alone "
        "does not show that the model is right, only the structure of the residual does. Give the variance of the FRF, or measure several "
        "averages"
    )
    return [Finding("no-covariance", message)]


def judged_findings(judged: bool) -> list[Finding]:
    """A warning where nothing could tell whether a residual is noise."""
    if judged:
        return []
    message = (
        "whether the residual is noise could not be judged: the noise is not known, and for the structure of the residual the lines are "
        "too few, or the output error has no minimum here. The intervals hold only if the model is right"
    )
    return [Finding("not-judged", message)]

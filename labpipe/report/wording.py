"""Numbers and units as a test engineer writes them."""

from __future__ import annotations

import math
from collections.abc import Iterable

from labpipe.display import unit_label, write_values
from labpipe.distributions import student_tail
from labpipe.quantities import display_unit
from labpipe.records.comparison import StudyThreshold
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.text import parameter_cells

STARS = ((0.001, "***"), (0.01, "**"), (0.05, "*"))
STARS_EXPLAINED = (
    "Significance of the difference from zero: *** p < 0.001, ** p < 0.01, * p < 0.05, n.s. not significant "
    "(the value does not differ significantly from zero). Derived values are computed from the estimated "
    "ones."
)
VIF_EXPLAINED = "VIF: variance inflation, 1 when no other parameter resembles this one."
# Variance inflation from which regression texts speak of collinearity (Marquardt 1970), and the correlation
# of two that gives it.
LARGE_VIF, CLOSE = 10.0, 0.95
# Standard errors that differ by less than this share are one.
ALIKE = 1e-6


def unit_text(si_unit: str) -> str:
    """The unit shown for values given in *si_unit*."""
    return legible(display_unit(si_unit))


def legible(unit: str) -> str:
    """A unit as it is printed; a plain number has none."""
    return unit_label(unit).replace("N.s/m", "N s/m")


def title(name: str, unit: str) -> str:
    """A name with its unit, if any, as the head of a column."""
    return f"{name} [{legible(unit)}]" if legible(unit) else name


def round_to_error(value: float, std_error: float | None) -> str:
    """A value to the place that its standard error supports."""
    return write_values(value, std_error)[0]


# Coefficients by the first part of their names and their unit, in words.
MEANINGS = {
    ("k", "N/m"): "stiffness",
    ("c", "N.s/m"): "damping",
    ("m", "kg"): "mass",
    ("f", "Hz"): "natural frequency",
    ("zeta", "1"): "damping ratio",
    ("eta", "1"): "loss factor",
}


def meaning(parameter: Parameter) -> str:
    """A coefficient in words; '' for one that is none of them, such as a force per current `k_i`."""
    return MEANINGS.get((parameter.name.partition("_")[0], parameter.unit), "")


def parameter_row(parameter: Parameter, dof: int) -> tuple[str, ...]:
    """Name, value, unit, standard error, 95 % interval, t-ratio, significance, variance inflation factor."""
    name, value, error, interval, unit, _ = parameter_cells(parameter)
    return (
        name,
        value,
        legible(unit),
        error or "none",
        interval or "none",
        "" if parameter.t_ratio is None or parameter.derived else f"{parameter.t_ratio:.4g}",
        significance(parameter, dof),
        "" if parameter.vif is None else f"{parameter.vif:.3g}",
    )


def significance(parameter: Parameter, dof: int) -> str:
    """Stars by the two-sided p-value of the t-ratio; 'derived' for derived values."""
    if parameter.derived:
        return "derived"
    if parameter.at_bound:
        return "at bound"
    if parameter.t_ratio is None:
        return ""
    p_value = 2 * student_tail(abs(parameter.t_ratio), dof)
    return next((stars for limit, stars in STARS if p_value < limit), "n.s.")


def fit_title(fit: Fit) -> str:
    """The fit's name with the diagonal term it is of, and its test."""
    name = f"{fit.name} of {fit.term}" if fit.term else fit.name
    return f"{name}, test {fit.test}" if fit.test else name


def band_text(fit: Fit) -> str:
    return f"{fit.band_hz[0]:g}–{fit.band_hz[1]:g} Hz"


def threshold_text(threshold: StudyThreshold, share: float) -> str:
    """The noise level at which a fit's success ends, as a sentence."""
    within = f"within {100 * threshold.limit:g} % of the truth in {100 * share:g} % of the repeats"
    what = f"{threshold.fit}: {within}"
    if threshold.noise is None:
        return f"{what}: no such noise level in the range searched"
    return f"{what} up to a noise of {100 * threshold.noise:.3g} %"


def entangled_text(fit: Fit) -> list[str]:
    """Sentences on parameters that the data hardly tell apart."""
    sentences = []
    large = [(p.name, p.vif) for p in fit.parameters if p.vif is not None and p.vif >= LARGE_VIF]
    if large:
        listed = ", ".join(f"{name} ({vif:.3g} times)" for name, vif in large)
        what = "the variance is many times what it would be by itself"
        sentences.append(f"Large variance inflation (VIF): {what} for {listed}.")
    names = [parameter.name for parameter in fit.estimated]
    n = min(len(names), fit.correlation.shape[0])
    pairs = [(names[i], names[j], float(fit.correlation[i, j])) for j in range(n) for i in range(j)]
    close = [f"{first} and {second} ({value:+.4f})" for first, second, value in pairs if abs(value) >= CLOSE]
    if close:
        sentences.append(
            f"The correlation of the estimates is near-singular: {', '.join(close)} are known together far "
            "better than each by itself, and an error of one is made good by the other."
        )
    return sentences


def _repeats_part(parameter: Parameter) -> float:
    return 0.0 if parameter.interval is None else parameter.interval.repeats


def _beyond_noise(parameter: Parameter) -> float:
    """The standard error by noise and what the residual shows beside it, without what given numbers and the
    scatter of repeats add.
    """
    others = math.hypot(parameter.systematic or 0.0, _repeats_part(parameter))
    return math.sqrt(max((parameter.std_error_inflated or 0.0) ** 2 - others**2, 0.0))


def interval_text(fit: Fit) -> str:
    """Sentences on intervals that are wider than those of noise, or missing, and why; empty for none."""
    mismatch = any(finding.code == "model-mismatch" for finding in fit.findings)
    if mismatch and fit.converged and all(p.ci95 is None for p in fit.parameters):
        return (
            " The residual is not noise and nothing explains it: no standard errors and intervals are "
            "given (model-mismatch above)."
        )
    widened = [(p, p.std_error) for p in fit.parameters if p.std_error_inflated is not None and p.std_error]
    repeated = _times((p.name, math.hypot(noise, _repeats_part(p)) / noise) for p, noise in widened)
    held = "The intervals hold the scatter between repeats; they are wider than those of noise alone:"
    between = f" {held} {repeated}." if repeated else ""
    wider = _times((p.name, _beyond_noise(p) / noise) for p, noise in widened)
    # Small given numbers of a floating bearing stay with its noise.
    if not wider or (not mismatch and any(detail.given_in_noise for detail in fit.details)):
        return between
    reasons = "; ".join(dict.fromkeys(p.reason for p, _ in widened if p.reason))
    why = f"; the model error is most likely {reasons}" if reasons else ""
    return (
        f"{between} The residual is not noise (model-mismatch above{why}): errors and intervals are wider "
        f"than those of noise alone: {wider}."
    )


def _times(factors: Iterable[tuple[str, float]]) -> str:
    return ", ".join(f"{name} {factor:.3g} times" for name, factor in factors if factor > 1 + ALIKE)

"""Diagnostics of a fit: warnings with a code, the cause and a remedy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.display import chance_text
from labpipe.errors import FitError
from labpipe.estimation.derived import is_direct, modes
from labpipe.estimation.estimators import Estimator
from labpipe.estimation.likelihood import maximum_likelihood
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import DynamicModel, Matrices, Setup, entry_term, fixed_matrices
from labpipe.estimation.statistics import Estimate, condition_number
from labpipe.estimation.transfer_mode import transfer_of
from labpipe.estimation.weights import has_noise
from labpipe.records.finding import WARNING, Finding, Parameter, note
from labpipe.records.identification import Fit, Goodness
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.joint import is_joint
from labpipe.spectra.period_average import is_unsettled

# Least ratio of a motion's singular value to the largest one of noise alone.
STANDS_OUT = 1.5


def independent_motions(measured: Measured) -> tuple[FloatArray, int]:
    """Singular values (n_output,) [1] of the FRF in units of its noise, and how many are above the noise.

    The matrix has outputs as columns, lines and forces as rows. Circular noise of variance 1 has singular
    values up to sqrt(n_row) + sqrt(n_column) (Geman 1980). Only the variance of each output is used: a common
    factor of the outputs is a motion, whatever its noise. Equation (est-motions).
    """
    n_line, n_output, n_input = measured.matrix.shape
    assert measured.covariance is not None
    variance = np.einsum("lii->li", measured.covariance).real.reshape(n_line, n_output, n_input)
    noise = np.sqrt(np.mean(variance, axis=(0, 2)))
    rows = (measured.matrix / noise[None, :, None]).transpose(0, 2, 1).reshape(-1, n_output)
    values = np.linalg.svd(rows, compute_uv=False)
    limit = np.sqrt(rows.shape[0]) + np.sqrt(rows.shape[1])
    return values, int(np.sum(values > STANDS_OUT * limit))


def motion_notes(measured: Measured) -> tuple[str, ...]:
    """A note where fewer independent motions than outputs are above the noise."""
    if len(measured.outputs) < 2 or not has_noise(measured) or not np.all(measured.variance):
        return ()
    values, count = independent_motions(measured)
    if count >= values.size:
        return ()
    listed = ", ".join(f"{value:.3g}" for value in values)
    moving = "one independent motion" if count == 1 else f"{count} independent motions"
    of_noise = f"singular values of the FRF in units of its noise {listed}"
    return (f"The {values.size} responses hold {moving}: {of_noise}.",)


# The mean of the cosine of a driving point's mobility, by its square, below which its sign is wrong.
FED_BACK = -0.5

# Share of the excess chi-square that another reading of the channels explains where the rig file is wrong.
BY_READING = 0.9
# Bound of each descent: a wrong reading may have no minimum.
MOST_READING_STEPS = 40
QUANTITIES = ("displacement", "velocity", "acceleration")
OSCILLATOR = DynamicModel(
    "oscillator",
    tuple(
        entry_term(name, kind, [(0, 0)], (1, 1))
        for name, kind in (("k", "stiffness"), ("c", "damping"), ("m", "mass"))
    ),
    fixed_matrices(np.zeros((1, 1)), np.ones((1, 1))),
)

# Findings that name a cause, where an FRF that a closed loop biases makes them appear.
OF_ANOTHER_CAUSE = ("mass", "stated-value", "unphysical")


def with_feedback(fit: Fit, measured: Sequence[Finding]) -> Fit:
    """The fit with the warning `feedback` of the FRF it is of, which takes the place of wrong causes."""
    if not any(finding.code == "feedback" and finding.level == WARNING for finding in measured):
        return fit
    others = [finding for finding in fit.findings if finding.code not in OF_ANOTHER_CAUSE]
    biased = Finding(
        "feedback",
        "the force is fed back from the response, so all values of this fit are biased towards minus the "
        "inverse of the controller, by an amount that cannot be known, whatever their intervals say. Neither "
        "mass nor signs can be judged. Record what is injected, with role: reference, and name it: `frf: "
        "{reference: ...}`",
    )
    return replace(fit, findings=(biased, *others))


# Findings of a recording that make every number of it wrong by an amount that no residual shows.
LOST_SAMPLES = ("clipped", "gap", "jump")


def with_cautions(fit: Fit, measured: Sequence[Finding]) -> Fit:
    """The fit with what the findings of its FRF say of it: `feedback`, cut or missing samples, and a warning
    where what is injected into a closed loop hardly exceeds its noise and the residual is more than noise.
    """
    fit = with_feedback(fit, measured)
    if any(finding.code == "wrong-quantity" for finding in fit.findings):
        # What follows from it is not said beside it.
        kept = tuple(finding for finding in fit.findings if finding.code not in OF_ANOTHER_CAUSE)
        fit = replace(fit, findings=kept)
    lost = [finding for finding in measured if finding.code in LOST_SAMPLES and finding not in fit.findings]
    fit = replace(fit, findings=(*fit.findings, *lost))
    weak = is_of_closed_loop(measured) and any(finding.code == "low-snr" for finding in measured)
    if not weak or not any(finding.code == "model-mismatch" for finding in fit.findings):
        return fit
    what = (
        "what is injected hardly moves the loop beyond its noise, and the residual is not noise: the values "
        "are in part those of a ratio of noise to noise. Raise what is injected, or record longer"
    )
    return replace(fit, findings=(Finding("weak-injection", what), *fit.findings))


def is_of_closed_loop(measured: Sequence[Finding]) -> bool:
    """Whether an FRF was measured in a loop that is known to be closed."""
    return any(finding.code == "closed-loop" for finding in measured)


def held_findings(parameters: Sequence[Parameter]) -> list[Finding]:
    """A note on negative stiffness in a closed loop: that of a magnetic bearing without its controller."""
    negative = [p.name for p in parameters if is_stiffness(p) and p.value < 0 and p.significant]
    what = "is negative: without its controller the rotor would not stay, the loop holds it"
    return [note("closed-loop", f"{', '.join(negative)} {what}")] if negative else []


def is_stiffness(parameter: Parameter) -> bool:
    """Whether a parameter is a direct stiffness."""
    return is_direct(parameter.name) and parameter.name.startswith("k")


# Condition numbers of a column-scaled design above 30 are strong collinearity, where a weak direction makes
# more than half of a parameter's variance (Belsley, Kuh and Welsch 1980, section 3.2).
COLLINEAR_CONDITION = 30.0
VARIANCE_PROPORTION = 0.5
# Amplification of an FRF error in the coefficients below which their signs are reliable.
HARMFUL_GROWTH = 30.0
# Products of columns lose the square of the condition number in rounding, from processor to processor
# otherwise: larger numbers are written as a power of ten.
ROUGH = 1e4
MISMATCH_P = 0.01
# Parameters of a transfer FRF's mode that are zero for the simplest structure.
OPTIONAL = ("modal_constant_quadrature", "residual_re", "residual_im")
FEW_DOF = 5
EQUATIONS_PER_PARAMETER = 3
LOW_COHERENCE = 0.9
LOW_GOF = 0.5
LOW_SNR = 10.0


# From the names of parameters to what would tell them apart.
Remedy = Callable[[Sequence[str]], str]


def remedy(group: Sequence[str]) -> str:
    """Remedy that separates the parameters of a collinear group fitted to a frequency response."""
    if any(name.split("_")[-1] in ("xy", "yx") for name in group):
        return "measure a second, independent force direction, or fit the model rotor-2dof-direct"
    if "m" in group:
        return "give the mass if it is known, or widen the band to both sides of the resonance"
    return (
        "widen the band, measure a second, independent force direction, or fit a model with fewer parameters"
    )


def estimate_findings(
    estimate: Estimate, names: Sequence[str], n_line: int, units: Sequence[str] = (), cure: Remedy = remedy
) -> list[Finding]:
    """Warnings on the estimate: convergence, collinearity with its *cure*, few lines. Its residual is judged
    in `mismatch`.
    """
    warnings: list[Finding] = []
    if not estimate.converged:
        what = f"the estimator did not converge in {estimate.iterations} iterations"
        warnings.append(Finding("no-convergence", f"{what}; its numbers are not a result"))
    warnings.extend(_collinear(estimate, names, units, cure))
    n_equation = estimate.dof + len(names)
    if not estimate.dof:
        message = (
            f"{n_equation} real equations determine {', '.join(names)} exactly: intervals are by the noise "
            "alone, and nothing is left to test the model by; measure at further frequencies for that"
        )
        warnings.append(note("few-lines", message))
    elif estimate.dof < FEW_DOF or n_equation < EQUATIONS_PER_PARAMETER * len(names):
        message = (
            f"{n_line} lines give {n_equation} equations for {len(names)} parameters; widen the band "
            "or measure with finer spacing"
        )
        warnings.append(Finding("few-lines", message))
    return warnings


def _collinear(estimate: Estimate, names: Sequence[str], units: Sequence[str], cure: Remedy) -> list[Finding]:
    """By Belsley's variance proportions of weak directions. Correlated columns alone are harmless, as of
    stiffness and mass of a resonance: the warning requires an error of the FRF to be amplified.
    """
    condition = condition_number(estimate.scaled_design)
    if condition < COLLINEAR_CONDITION:
        return []
    group = collinear_group(estimate.scaled_design, names) or list(names)
    growth = _growth(estimate, names, units, group) if units else None
    if growth is not None and growth < HARMFUL_GROWTH:
        return []
    amplified = ""
    if growth:
        amplified = (
            f" A systematic error of 1 % in what was measured can become {_rough(growth)} % in them, which "
            "no standard error shows."
        )
    message = (
        f"the excitation does not tell these parameters apart: {', '.join(group)} (condition number "
        f"{_rough(condition)}, limit {COLLINEAR_CONDITION:g}).{amplified} Their values and signs are "
        f"unreliable, however good the fit. Remedy: {cure(group)}."
    )
    return [Finding("collinear", message)]


def _rough(number: float) -> str:
    """Three digits, or the nearest power of ten where rounding decides on the digits."""
    return f"{number:.3g}" if number < ROUGH or math.isinf(number) else f"about 1e{math.log10(number):.0f}"


def _growth(
    estimate: Estimate, names: Sequence[str], units: Sequence[str], group: Sequence[str]
) -> float | None:
    if estimate.amplification is None:
        return None
    sizes = list(zip(units, np.abs(estimate.values), strict=True))
    largest = {unit: max(size for u, size in sizes if u == unit) for unit in units}
    return max(
        float(amplification / largest[unit]) if largest[unit] > 0 else float("inf")
        for name, unit, amplification in zip(names, units, estimate.amplification, strict=True)
        if name in group
    )


def collinear_group(scaled_design: FloatArray, names: Sequence[str]) -> list[str]:
    """Parameters with most of their variance in weak directions of *scaled_design* (n_parameter, n_parameter)
    [1]. Variance proportion of direction j in parameter i: (v_ij^2 / s_j^2) / sum_j (v_ij^2 / s_j^2).
    """
    _, singular, vectors = np.linalg.svd(scaled_design, full_matrices=False)
    floor = singular[0] * np.finfo(float).eps
    parts = (vectors / np.maximum(singular, floor)[:, None]) ** 2
    weak = singular[0] > COLLINEAR_CONDITION * singular
    involved = np.sum(parts[weak], axis=0) > VARIANCE_PROPORTION * np.sum(parts, axis=0)
    return [name for name, inside in zip(names, involved, strict=True) if inside]


def goodness_findings(gof: Goodness) -> list[Finding]:
    """A warning where the fit explains little of the response, or less than its mean does."""
    value = gof.r2_adjusted
    if value >= LOW_GOF:
        return []
    if value < 0:
        message = (
            f"G.o.F {value:.3g} is negative: a constant would follow the data better than this fit. Its "
            "numbers are not a result; check the band, the ports, the signs of the channels and the model"
        )
        return [Finding("negative-gof", message)]
    share = "the fit explains less than half of how the data vary over the band"
    return [Finding("low-gof", f"G.o.F {value:.3g}: {share}; the rest is noise, or not this model")]


def excess_findings(estimate: Estimate, biased: str) -> list[Finding]:
    """A finding where the residual exceeds the measured noise; *biased*: name of an estimator that is so."""
    reduced, p_value = estimate.gof.chi2_reduced, estimate.gof.chi2_p
    factor = excess(reduced, p_value)
    if factor is None:
        return []
    cause = "the model is incomplete" + (f", or {biased} is biased; compare with ml" if biased else "")
    cure = f"Multiply the standard errors by {factor:.3g} at least, or narrow the band."
    what = excess_text(reduced, p_value)
    return [Finding("model-mismatch", f"{what}: {cause}. {cure}")]


def excess(reduced: float | None, p_value: float | None) -> float | None:
    """sqrt(chi-square per degree of freedom) [1] where it is significantly above 1, else None. Equation
    (est-excess).
    """
    if reduced is None or p_value is None or p_value >= MISMATCH_P:
        return None
    return float(np.sqrt(reduced))


def excess_text(reduced: float | None, p_value: float | None) -> str:
    """A residual beyond the measured noise, by chi-square per degree of freedom [1] and its p-value."""
    assert reduced is not None
    return (
        f"the residual is {np.sqrt(reduced):.3g} times what the measured noise explains (chi-square per "
        f"degree of freedom {reduced:.3g}, {chance_text(p_value)})"
    )


def parameter_findings(parameters: Sequence[Parameter], *, driving: bool, held: bool) -> list[Finding]:
    """Warnings on the reported parameters: insignificant ones, and values impossible for a passive support.

    *driving*: False for the response at another point than the force's, whose coefficients have either sign.
    *held*: by a closed loop, in which negative stiffness floats.
    """
    warnings: list[Finding] = []
    weak = [p.name for p in parameters if p.significant is False and not p.derived and p.name not in OPTIONAL]
    if weak:
        message = (
            f"{', '.join(weak)} cannot be told from zero at 95 %; a fit without them (`eliminate: "
            "true`) is as good"
        )
        warnings.append(Finding("insignificant", message))
    judged = [p for p in parameters if driving and is_direct(p.name) and not (held and is_stiffness(p))]
    negative = [p.name for p in (*judged, *(p for p in parameters if p.name == "eta")) if p.is_negative]
    if negative:
        what = f"{', '.join(negative)} is negative; check the mass, the sign of the channels and the band"
        warnings.append(Finding("unphysical", what))
    return [*warnings, *(held_findings(parameters) if held else ()), *_modal_findings(parameters)]


def sign_findings(measured: Measured) -> list[Finding]:
    """Driving points at which the structure would feed power back: Re(j w H) < 0 where the mobility j w H is
    large, as of a sensor that is mounted upside down.
    """
    turned = []
    for o, output in enumerate(measured.outputs):
        for i, force in enumerate(measured.inputs):
            mobility = 1j * measured.omega * measured.matrix[:, o, i]
            share = np.sum(mobility.real * np.abs(mobility)) / max(np.sum(np.abs(mobility) ** 2), 1e-300)
            if (output.dof, output.angle) == (force.dof, force.angle) and share < FED_BACK:
                turned.append(f"{output.label}/{force.label}")
    what = f"{', '.join(turned)} at its driving point feeds power back, which no structure does"
    cure = (
        "a sign is wrong; `invert: true` for one of the two channels in the rig file, or an acceleration is "
        "stated as a displacement, which has the other sign, or the other way round"
    )
    return [Finding("unphysical", f"{what}: {cure}")] if turned else []


def reading_findings(measured: Measured, setup: Setup, estimate: Estimate) -> dict[str, Finding]:
    """What the channels of a driving point must be taken for to make its FRF an oscillator of k, c, m > 0
    with its resonance in the band, and the finding: force and response in each other's place, or another
    derivative in time as the response. None where an *estimate* of positive values explains half of the
    FRF, of unknown noise, nor without most of the excess. Equation (est-reading).
    """
    order, settings = measured.derivatives, setup.settings
    is_sound = estimate.converged and estimate.gof.r2_adjusted >= LOW_GOF and np.all(estimate.values >= 0)
    other = setup.closed_loop or transfer_of(setup) or settings.kind.of_base or settings.sliding is not None
    if is_sound or other or measured.matrix.shape[1:] != (1, 1) or not has_noise(measured):
        return {}
    if not (np.all(measured.omega) and np.all(measured.matrix)):
        # 0 Hz, or nothing measured, has no inverse.
        return {}
    force, response = measured.inputs[0].channel, measured.outputs[0].channel
    h, jw = measured.matrix, 1j * measured.omega[:, None, None]
    readings = {
        f"that {response} is {name}, not {QUANTITIES[order]}": h * jw ** (order - n)
        for n, name in enumerate(QUANTITIES)
        if n != order
    }
    swapped = f"that {force} and {response} are in each other's place"
    readings[swapped] = 1 / (h * jw ** (2 * order))
    (before, _), *others = (_as_oscillator(measured, reading) for reading in (h, *readings.values()))
    (after, values), cause = min(zip(others, readings, strict=True), key=lambda entry: entry[0][0])
    if values is None or after - 1 > (1 - BY_READING) * (before - 1):
        return {}
    f_n = float(np.sqrt(values[0] / values[2])) / (2 * np.pi)
    zeta = values[1] / (2 * np.sqrt(values[0] * values[2]))
    antiresonance = ", or the band holds an antiresonance" if order == 1 and cause == swapped else ""
    message = (
        f"the FRF suggests {cause}{antiresonance}: read so, it is that of an oscillator with f_n = {f_n:.4g} "
        f"Hz and zeta = {zeta:.3g}, and chi-square per degree of freedom is {after:.3g} instead of "
        f"{before:.3g}. Look at `column`, `quantity` and unit of these channels in the rig file; this fit is "
        "no result"
    )
    return {cause: Finding("wrong-quantity", message)}


def _as_oscillator(measured: Measured, receptance: ComplexArray) -> tuple[float, FloatArray | None]:
    """Chi-square per degree of freedom [1] of a reading (n_line, 1, 1) [m/N] of the FRF as an oscillator, and
    its k, c, m; without these where they are not positive with the resonance between the lines.
    """
    assert measured.variance is not None
    size = np.abs(receptance / measured.matrix) ** 2
    covariance = measured.variance[:, :, None] * size + 0j
    read = replace(measured, matrix=receptance, covariance=covariance, leakage=None)
    try:
        fit = maximum_likelihood(read, OSCILLATOR, most_steps=MOST_READING_STEPS)
    except (FitError, np.linalg.LinAlgError):
        return np.inf, None
    k, _, m = fit.values
    omega, reduced = measured.omega, fit.gof.chi2_reduced
    assert reduced is not None
    is_sound = fit.converged and np.all(fit.values > 0) and omega[0] ** 2 <= k / m <= omega[-1] ** 2
    return reduced, fit.values if is_sound else None


def _modal_findings(parameters: Sequence[Parameter]) -> list[Finding]:
    ratios = [p for p in parameters if p.name == "zeta" or p.name.startswith("zeta_")]
    damped = "is above 1: this fit has no resonance, f_n has no meaning"
    text = [f"{p.name} = {p.value:.3g} {damped}" for p in ratios if p.value > 1]
    unstable = ", ".join(p.name for p in ratios if p.is_negative)
    if unstable:
        text.append(f"{unstable} is negative: the identified system is unstable")
    return [Finding("unphysical", what) for what in text]


def quality_findings(
    response: FrequencyResponse, rows: list[int], columns: list[int], lines: BoolArray
) -> list[Finding]:
    """A warning where much of a response on the fit's *lines*, a mask (n_frequency,), is noise, by its power
    over all of them: single ones of low coherence do no harm. None for motion that has not died away.
    """
    if is_unsettled(response.findings):
        return []
    power = np.abs(response.matrix[lines][:, rows][:, :, columns]) ** 2
    share = 0.0
    what = ""
    if response.multiple_coherence is not None:
        share = _noise_share(np.sum(power, axis=2), response.multiple_coherence[lines][:, rows])
    elif response.coherence is not None:
        share = _noise_share(power, response.coherence[lines][:, rows][:, :, columns])
    elif response.variance is not None:
        variance = response.variance[lines][:, rows][:, :, columns]
        if np.sum(variance) * LOW_SNR**2 > np.sum(power):
            what = f"the FRF is less than {LOW_SNR:g} times its standard deviation, in power over the band"
    if share > 1 - LOW_COHERENCE:
        noisy = f"{100 * share:.0f} % of a response's power in the band"
        what = f"{noisy} is not explained by the forces (coherence)"
    remedy = "raise the force, average longer, or leave these lines out with `exclude`"
    return [Finding("low-coherence", f"{what}; {remedy}")] if what else []


def _noise_share(explained: FloatArray, coherence: FloatArray) -> float:
    """Largest share of a response's power that is noise, by the power *explained* and *coherence* (n_line,
    n_output[, n_input]) of forces as strong at all lines.
    """
    whole = np.divide(explained, coherence, out=np.zeros_like(explained), where=coherence > 0)
    total = np.sum(whole, axis=0)
    shares = np.divide(np.sum(whole - explained, axis=0), total, out=np.ones_like(total), where=total > 0)
    return float(np.max(shares))


def covariance_findings(response: FrequencyResponse) -> list[Finding]:
    """A warning where the noise of the FRF is not known."""
    if response.stored_covariance is not None:
        return []
    message = (
        "the FRF has no covariance (imported without it, or of a single average), so chi-square could not be "
        "checked: a high G.o.F alone does not show that the model is right, only the structure of the "
        "residual does. Give the variance of the FRF, or its coherence and number of `averages`, or measure "
        "several averages"
    )
    return [Finding("no-covariance", message)]


def mode_findings(parameters: Sequence[Parameter], band: tuple[float, float], setup: Setup) -> list[Finding]:
    """Warnings on the one mode of sdof or base in its *band* [Hz]: negative mass at a driving point, negative
    damping, resonance beside it. With a given mass the band may lie beside the resonance; what a closed loop
    holds need have none.
    """
    if not setup.settings.kind.one_mode or not setup.settings.frees_mass:
        return []
    by_name = {parameter.name: parameter for parameter in parameters}
    beside = [] if setup.closed_loop else _modes_beside(by_name, band)
    text = "; ".join((*_negative(by_name, driving=not transfer_of(setup)), *beside))
    what = f"{text}; its numbers are not those of a mode of the structure"
    return [Finding("unphysical", what)] if text else []


def narrow_findings(parameters: Sequence[Parameter], spacing: float) -> list[Finding]:
    """A warning for a mode narrower than the *spacing* [Hz] of the lines: no line shows its peak."""
    by_name = {parameter.name: parameter for parameter in parameters}
    if "f_n" not in by_name or "zeta" not in by_name:
        return []
    f_n, of_damping = by_name["f_n"].value, by_name["zeta"]
    zeta = of_damping.value
    # A damping that cannot be told from none is said to be insignificant.
    is_positive = of_damping.ci95 is None or of_damping.ci95[0] > 0
    if not is_positive or not 0 < 2 * zeta * f_n < spacing:
        return []
    message = (
        f"the mode at {f_n:.5g} Hz is {2 * zeta * f_n:.2g} Hz wide (half power), less than the "
        f"{spacing:.2g} Hz from line to line: no line shows its peak, and it may be a dip of the force, or "
        "hum. Measure with finer lines, or look at the figure"
    )
    return [Finding("leakage", message)]


def _negative(by_name: dict[str, Parameter], *, driving: bool) -> list[str]:
    text = []
    mass, zeta = by_name.get("m"), by_name.get("zeta")
    if driving and mass is not None and mass.value < 0:
        text.append(
            f"m = {mass.value:.3g} kg is negative, which no driving point has: check the signs of the "
            "channels, whether force and response are at one point (`dof`), and the band"
        )
    if zeta is not None and zeta.value < 0:
        text.append(f"zeta = {zeta.value:.3g} is negative: the fitted mode would grow by itself")
    return text


def _modes_beside(by_name: dict[str, Parameter], band: tuple[float, float]) -> list[str]:
    f_n, k, m = (by_name.get(name) for name in ("f_n", "k", "m"))
    if f_n is None and k is not None and m is not None and k.value * m.value <= 0:
        signs = f"k = {k.value:.3g} N/m and m = {m.value:.3g} kg have different signs"
        return [f"{signs}: there is no resonance"]
    if f_n is None or band[0] <= f_n.value <= band[1]:
        return []
    outside = f"f_n = {f_n.value:.4g} Hz lies outside the band {band[0]:g}-{band[1]:g} Hz"
    return [f"{outside}: the lines show no resonance"]


# leakage: blocks of random data too short for the damping that a fit found, and the length that would do.

# Lines in the half-power width of a mode below which its damping is biased by more than its standard error,
# and by which the leakage in the model (ml of an H1) decides on it.
ENOUGH_LINES, FEWEST_LINES = 10.0, 1.5
# Lines in the half-power width times degree of local polynomials below which a bias counts that no model has.
LINES_BY_DEGREE = 30.0
# Bias [%] of the damping by one line in the half-power width, its fall with their number (Hann: 4 % at 2,
# 0.5 % at 8), and by how much too wide a mode of less than a line may look.
BIAS, FALL, TOO_WIDE = 14.0, 1.6, 1.25


def leakage_findings(measured: Measured, whole: Matrices, estimator: Estimator) -> list[Finding]:
    """A warning where the block times the half-power width 2 zeta f_n [lines] of the most lightly damped mode
    in the band is small; *whole*: K, C and M of the fitted model.
    """
    blocks = measured.blocks
    narrowest = None if blocks is None else _narrowest(measured, whole)
    # In a closed loop the force rings as the response does: what leaks are the poles of the loop, not those
    # of the fitted model.
    if blocks is None or narrowest is None or is_joint(blocks):
        return []
    return short_block_findings(measured, *narrowest, estimator.models_leakage)


def short_block_findings(
    measured: Measured, frequency: float, width: float, models_leakage: bool
) -> list[Finding]:
    """The same of a mode at a *frequency* [Hz] with its half-power *width* [Hz], by an estimator that models
    the leakage or not; none without blocks.
    """
    blocks = measured.blocks
    if blocks is None or blocks.after_hit:
        return []
    lines, modelled = blocks.length * width, models_leakage and measured.leakage is not None
    enough = FEWEST_LINES if modelled else ENOUGH_LINES
    if blocks.degree:
        enough = 2 * FEWEST_LINES if modelled else LINES_BY_DEGREE / blocks.degree
    if lines >= enough or (blocks.bursts and (modelled or blocks.dies_away(lines))):
        return []
    needed = f"blocks of at least {round_up((TOO_WIDE if lines < 1 else 1.0) * enough / width):g} s"
    which = (
        f"the mode at {frequency:.4g} Hz is {width:.2g} Hz wide (half power), {lines:.2g} lines of "
        f"blocks of {blocks.length:.3g} s"
    )
    other = ""
    if blocks.degree:
        what = f"local polynomials of degree {blocks.degree} do not follow its peak"
        other = ", or a higher `degree`"
    elif modelled:
        what = "its damping comes from the window's leakage more than from the measurement"
    else:
        bias = f"{BIAS * lines**-FALL:.1g}"
        what = f"its damping comes out up to {bias} % too large, which no standard error shows"
        if measured.leakage is not None:
            other = ", or the estimator ml, which takes the leakage into the model"
    return [Finding("leakage", f"{which}: {what}; use {needed}{other}")]


def _narrowest(measured: Measured, whole: Matrices) -> tuple[float, float] | None:
    if np.linalg.matrix_rank(whole.mass) < whole.mass.shape[0]:
        return None
    modal = modes(Matrices(whole.stiffness[None], whole.damping[None], whole.mass[None], whole.force[None]))
    if modal is None:
        return None
    frequency: FloatArray = modal.frequency[0]
    width = 2 * modal.damping[0] * frequency
    band = measured.omega[[0, -1]] / (2 * np.pi)
    inside = (frequency >= band[0]) & (frequency <= band[1]) & (width > 0)
    if not np.any(inside):
        return None
    chosen = int(np.argmin(np.where(inside, width, np.inf)))
    return float(frequency[chosen]), float(width[chosen])


def round_up(length: float) -> float:
    """The length [s] with two digits, not below it."""
    digit = 10.0 ** (np.floor(np.log10(length)) - 1)
    return float(np.ceil(length / digit * (1 - 1e-9)) * digit)

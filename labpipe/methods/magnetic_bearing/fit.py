"""Models magnet (force per current and stiffness of magnetic bearings from a levitated rotor of known mass)
and block (an amplifier, a sensor or a whole chain as gain, delay and low-pass).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import number
from labpipe.errors import ConfigError, FitError, SettingError
from labpipe.estimation.budget import with_sources
from labpipe.estimation.derived import reported_fit
from labpipe.estimation.descent import Minimum, SquareSum, minimise
from labpipe.estimation.diagnostics import MISMATCH_P, estimate_findings, goodness_findings
from labpipe.estimation.measured import Measured, matrix_errors, measured_part, select_ports
from labpipe.estimation.regression import triangle_of
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate, determination, inflation_factors
from labpipe.estimation.weights import has_noise, weight_uncertainty
from labpipe.methods.floating_bearing.findings import BalanceError, BalanceMisfit, balance_error, few_averages
from labpipe.methods.floating_bearing.values import add_budget, balance_fit, plain_values
from labpipe.methods.magnetic_bearing import balance, likelihood
from labpipe.methods.magnetic_bearing.settings import AUTO, ORDERS, BlockSettings, MagnetSettings
from labpipe.records.finding import Finding, Parameter
from labpipe.records.fit_details import RobustPlant, systematic
from labpipe.records.identification import Candidate, Fit, FittedCurve, Goodness
from labpipe.records.recording import Channel
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import ESTIMATE, Uncertainties
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import Uncertain, Uncertainty, uncertainty_of
from labpipe.spectra.bands import lines_in

# Corner frequencies of an overbound that are tried, per decade and beyond the lines [decades].
PER_DECADE, BEYOND = 12, 1.5


def robust_plant(
    best: likelihood.MagnetEstimate, curve: FittedCurve, dof: float, confidence: float
) -> RobustPlant:
    """The band of radius |G^ - G_nominal| + r, r of the measured scatter, which holds the true plant at all
    lines with *confidence*. *dof* nu: complex ones behind the variance.
    """
    assert curve.variance is not None
    radius = np.abs(curve.measured - curve.fitted) + np.sqrt(curve.variance) * scatter_radius(
        dof, curve.variance.size, confidence
    )
    # An element that the model lacks has no size of its own.
    weight = radius / np.linalg.norm(curve.fitted, 2, axis=(1, 2))[:, None, None]
    a, b, c, d = state_space(best.model, best.values)
    bounds = [[overbound(curve.frequency, element) for element in row] for row in weight.transpose(1, 2, 0)]
    return RobustPlant(
        frequency=curve.frequency,
        nominal=curve.fitted,
        radius=radius,
        weight=weight,
        a=a,
        b=b,
        c=c,
        d=d,
        overbound=np.array(bounds),
        confidence=confidence,
        unit="m/A",
        outputs=curve.outputs,
        inputs=curve.inputs,
    )


def scatter_radius(dof: float, count: int, confidence: float) -> float:
    """sqrt of the quantile of |e|^2 / var of *count* independent complex values together [1]; closed form of
    F with 2 and 2 nu. Equation (mag-radius).
    """
    beyond = -np.expm1(np.log(confidence) / count)
    return float(np.sqrt(-np.log(beyond) if not np.isfinite(dof) else dof * np.expm1(-np.log(beyond) / dof)))


def state_space(
    model: balance.MagnetModel, values: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A (2 n, 2 n), B (2 n, n), C (n, 2 n), D (n, n) [SI] of displacements and velocities under currents."""
    matrices, n = model.matrices(values), len(model.mass)
    a, b, c = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, n)), np.zeros((n, 2 * n))
    a[:n, n:], c[:, :n] = np.eye(n), np.eye(n)
    a[n:] = np.linalg.solve(model.mass, np.hstack([-matrices["k_s"], -matrices["c"]]))
    b[n:] = np.linalg.solve(model.mass, matrices["k_i"])
    return a, b, c, np.zeros((n, n))


def overbound(frequency: FloatArray, weight: FloatArray) -> tuple[float, float, float]:
    """k [1], zero and pole [Hz] of the weight of first order with the least mean logarithm that is nowhere
    below *weight* (n_line,) [1]. Equation (mag-overbound).
    """
    low, high = np.log10(frequency[0]) - BEYOND, np.log10(frequency[-1]) + BEYOND
    corners = np.logspace(low, high, int(PER_DECADE * (high - low)) + 1)
    shapes = np.log(np.abs(1 + 1j * frequency / corners[:, None]))
    ratio = shapes[:, None] - shapes[None]
    gain = np.max(np.log(weight) - ratio, axis=2)
    zero, pole = np.unravel_index(int(np.argmin(gain + np.mean(ratio, axis=2))), gain.shape)
    return float(np.exp(gain[zero, pole])), float(corners[zero]), float(corners[pole])


# Condition number of the currents of all runs beyond which a line does not tell X per I.
ONE_DIRECTION = 1e3


def remedy(_group: Sequence[str]) -> str:
    """What separates parameters that the lines cannot tell apart."""
    return (
        "the rotor moves and is driven in one way only: excite the axes one after the other or by "
        "independent signals, widen the band so "
        "that K_s and w^2 M differ in their course, or estimate fewer terms, `coupling: direct`"
    )


def magnet_error(rotor: balance.LevitationBalance, best: likelihood.MagnetEstimate) -> BalanceError:
    """The covariance of noise and, where the rotor is not rigid on its magnets, of what that leaves."""
    model, omega, n = best.model, rotor.omega, rotor.n_axis
    rows, state = model.rows(best.values, omega), likelihood.MagnetLikelihood(rotor, model).at(best.values)
    axes = state.smoothed @ rotor.to_axes.T
    inertia = omega[:, None, None] ** 2 * (axes[..., n:] @ rotor.mass.T)
    misfit = BalanceMisfit(
        names=model.names,
        values=best.values,
        omega=omega,
        white=state.white,
        whiten=state.whiten,
        added=lambda at: np.einsum("lac,lrc->lra", rows - model.rows(at, omega), axes),
        slopes=lambda at: -np.einsum("plac,lrc->plra", model.slopes(at, omega), axes),
        motion=axes[..., n:],
        size=np.sqrt(np.mean(np.abs(inertia) ** 2, axis=(0, 1))),
        gains=np.einsum("lac,lrc->clra", rows, axes),
        larger=rotor.noise.inflation,
    )
    cause = (
        "the rotor is not a rigid mass in the band (bending, a moving housing), another force acts, the mass "
        "is wrong, or the magnet is not linear at this amplitude"
    )
    cure = "Narrow the band; where the current was sampled without a filter behind a held output, give `hold`"
    return balance_error(best.covariance, best.reduced, best.p_value, misfit, cause, cure)


def sign_findings(model: balance.MagnetModel, parameters: Sequence[Parameter]) -> tuple[Finding, ...]:
    """A warning where a magnet's force per current along its own axis is negative beyond its uncertainty."""
    pairs = zip(model.places, parameters, strict=False)
    direct = [parameter for (kind, row, column), parameter in pairs if kind == "k_i" and row == column]
    negative = [parameter.name for parameter in direct if parameter.is_negative]
    if not negative:
        return ()
    what = f"{', '.join(negative)} is negative: the sign of a current or of a reading is wrong"
    return (Finding("unphysical", f"{what}; `invert: true` for one of the two in the rig file"),)


def fit_notes(
    rotor: balance.LevitationBalance,
    best: likelihood.MagnetEstimate,
    parameters: Sequence[Parameter],
    uncertainties: Uncertainties,
) -> tuple[str, ...]:
    """Sign, size and use of what was estimated, and what least squares without noise would give."""
    n = rotor.n_axis
    size = 1e6 * np.sqrt(np.mean(np.sum(np.abs(rotor.axes[..., n:]) ** 2, axis=0) / 2))
    notes = [
        "magnet: M x'' = K_i i - K_s x. K_s is a stiffness: negative where the bias field pulls the rotor "
        "away from the centre (the `negative_stiffness` of a bearing file is -k_s). It holds for motions of "
        f"this size: r.m.s. {size:.3g} um."
    ]
    if n == 1 and best.converged:
        terms = ", ".join(
            f"{channel.name}: {sign * p.value:.6g} {p.unit} +- {p.full_error:.2g} {p.unit}"
            for channel, sign, p in zip(_channels(rotor), (1, -1), parameters, strict=False)
        )
        notes.append(
            f"magnet: force from current and displacement as a channel of the rig file: {{sum: {{{terms}}}, "
            "quantity: force}."
        )
    plain = zip(
        best.model.names, likelihood.unweighted_values(rotor, best.model), best.model.units, strict=True
    )
    listed = ", ".join(
        f"{name} {number(float(value))} {unit}" for name, value, unit in plain if not name.startswith("c")
    )
    notes.append(
        f"magnet: least squares that takes currents and displacements for free of noise gives {listed}; it "
        "is not to be used."
    )
    if "mass" not in dict(uncertainties):
        notes.append(
            "magnet: the mass counts as exact, and all results are in proportion to it: give its uncertainty "
            "(4 kg +- 5 g)."
        )
    return tuple(notes)


def _channels(rotor: balance.LevitationBalance) -> list[Channel]:
    """Of every current, then of every displacement, the channel or the first of those that give it."""
    return [rotor.spectra.channels[int(np.flatnonzero(row)[0])] for row in rotor.to_axes]


def draw(rotor: balance.LevitationBalance, best: likelihood.MagnetEstimate) -> FittedCurve | None:
    """Displacement per current, X I^-1 of the runs, against the model; none where a line has too few runs."""
    axes, n = rotor.axes, rotor.n_axis
    currents, motions = (part.swapaxes(-1, -2) for part in (axes[..., :n], axes[..., n:]))
    if axes.shape[1] < n or np.any(np.linalg.cond(currents) > ONE_DIRECTION):
        return None
    inverse = np.linalg.pinv(currents)
    measured = motions @ inverse
    rows = best.model.rows(best.values, rotor.omega)
    fitted = -np.linalg.solve(rows[:, :, n:], rows[:, :, :n])
    channels = _channels(rotor)
    return FittedCurve(
        rotor.omega / (2 * np.pi),
        measured,
        fitted,
        variance=_variance(rotor, measured, inverse),
        outputs=tuple(channel.dof for channel in channels[n:]),
        inputs=tuple(channel.name for channel in channels[:n]),
        form="displacement per current",
    )


def _variance(rotor: balance.LevitationBalance, measured: ComplexArray, inverse: ComplexArray) -> FloatArray:
    """E|d(X I^-1)|^2 (n_line, n, n) [(m/A)^2]: [-G, 1] C_z [-G, 1]^H of each run by its part in I^-1."""
    n = rotor.n_axis
    covariance = rotor.to_axes @ rotor.covariance @ rotor.to_axes.T
    rows = np.concatenate([-measured, np.broadcast_to(np.eye(n), measured.shape)], axis=2)
    noise = np.einsum("lkc,lrcd,lkd->lrk", rows, covariance, rows.conj()).real
    return np.einsum("lrk,lrm->lkm", noise, np.abs(inverse) ** 2)


def magnet_fits(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    """One fit, or one per band. ConfigError for settings unlike the channels, FitError for too few lines."""
    if settings.mass == ESTIMATE:
        what = "the mass of the rotor must be known: all else is in proportion to it"
        raise SettingError("mass", what, "mass: 4 kg +- 5 g, in the rig file or in the fit")
    return tuple(_fit(spectra, settings, band) for band in settings.bands or (settings.band,))


def _fit(spectra: ChannelSpectra, settings: FitSettings, band: tuple[float, float] | None) -> Fit:
    magnets: MagnetSettings = settings.model_settings
    mass: FloatArray | float = settings.mass if isinstance(settings.mass, float) else np.array(settings.mass)
    if np.ndim(mass) == 1:
        mass = np.diag(mass)
    rotor = balance.levitation_of(spectra, band, (settings.input, settings.output), mass, magnets)
    if magnets.hold is not None and rotor.omega[-1] > np.pi * magnets.hold:
        what = f"lines up to {rotor.omega[-1] / (2 * np.pi):g} Hz are beyond half of `hold`"
        raise SettingError("hold", what, "hold is the rate of the recording")
    between = None if magnets.hold is None else balance.Between(magnets.hold, magnets.amplifier_bandwidth)
    coupling, damping = magnets.coupling, magnets.passive_damping
    model = balance.magnet_model(rotor.labels, rotor.bearing, rotor.mass, coupling, damping, between)
    best = likelihood.magnet_estimate(rotor, model, _uncertainties_of_mass(rotor, settings, mass))
    error = magnet_error(rotor, best)
    whole = error.covariance + systematic(best.uncertainties, best.values.size)
    vifs, covariances = inflation_factors(best.design), (best.covariance, whole)
    valued = plain_values(model.names, model.units, best.values, covariances, best.dof, vifs)
    parameters, budget = add_budget(valued, best.uncertainties, best.dof)
    band = band or (float(rotor.omega[0] / (2 * np.pi)), float(rotor.omega[-1] / (2 * np.pi)))
    gof, shown = _goodness(rotor, model, best), error.name_reason(parameters)
    fit = balance_fit(settings, best, gof, best.amplification, shown, band, rotor.omega.size, remedy)
    findings = (
        *fit.findings,
        *error.finding,
        *likelihood.late_findings(rotor, best),
        *sign_findings(model, fit.parameters),
        *few_averages(rotor.noise),
        *spectra.findings,
    )
    curve = draw(rotor, best)
    dof, confidence = spectra.covariance_dof, magnets.band_confidence
    return replace(
        fit,
        findings=findings,
        notes=fit_notes(rotor, best, parameters, settings.uncertainties),
        curve=curve,
        details=() if curve is None else (robust_plant(best, curve, dof, confidence),),
        budget=budget if best.converged else None,
        discrepancy=error.discrepancy,
    )


def _uncertainties_of_mass(
    rotor: balance.LevitationBalance, settings: FitSettings, mass: FloatArray | float
) -> list[tuple[Uncertainty, FloatArray]]:
    """Uncertainties of mass and inertia with their change (n, n) [kg] by one standard deviation."""
    magnets: MagnetSettings = settings.model_settings
    of_mass, inertia = dict(settings.uncertainties).get("mass"), magnets.inertia
    given: list[tuple[Uncertainty, FloatArray]] = []

    def add(name: str, number: Uncertain, unit: str, larger: float, with_larger: MagnetSettings) -> None:
        source = f"{name}, {number.value:g} {unit} +- {number.std_error:g} {unit}"
        matrix = balance.mass_matrix(rotor.currents, rotor.planes, larger, with_larger)
        given.append((uncertainty_of(number, source, unit), matrix - rotor.mass))

    if not isinstance(mass, float):
        return given
    if of_mass is not None and of_mass.std_error > 0:
        add("mass of the rotor", of_mass, "kg", mass + of_mass.std_error, magnets)
    if inertia is not None and inertia.std_error > 0:
        larger = Uncertain(inertia.value + inertia.std_error)
        add("moment of inertia", inertia, "kg.m^2", mass, replace(magnets, inertia=larger))
    return given


def _goodness(
    rotor: balance.LevitationBalance, model: balance.MagnetModel, best: likelihood.MagnetEstimate
) -> Goodness:
    axes, n = rotor.axes, rotor.n_axis
    inertia = rotor.omega[:, None, None] ** 2 * (axes[..., n:] @ rotor.mass.T)
    residual = (model.rows(best.values, rotor.omega)[:, None] @ axes[..., None])[..., 0]
    r2, adjusted = determination(inertia, residual, len(model.names))
    return Goodness(r2, adjusted, best.reduced, best.p_value)


# Corner frequencies of starts over the highest line, and the damping ratio of theirs.
CORNERS, DAMPING = (0.5, 3.0), 0.7
# Logarithm beyond which a parameter has run off.
FARTHEST = 40.0
STEP = 1e-6
LEAST_LINES = 4


@dataclass(frozen=True)
class Block:
    """K e^{-j w tau} times low-passes: values (n,) are ln |K|, tau times the highest line, ln f, ln zeta."""

    order: int
    sign: float
    highest: float

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of every parameter, as they are reported."""
        real = (("corner_frequency", "Hz"),) if self.order in (1, 3) else ()
        pair = (("f_n", "Hz"), ("zeta", "1")) if self.order >= 2 else ()
        return (("gain", "1"), ("delay", "s"), *real, *pair)

    def response(self, values: FloatArray, omega: FloatArray) -> ComplexArray:
        """G (n_line,) [1] of values (n,) [1] at omega (n_line,) [rad/s]. Equation (mag-block)."""
        s = 1j * omega
        total = self.sign * np.exp(np.clip(values[0], -FARTHEST, FARTHEST) - s * values[1] / self.highest)
        rest = list(np.exp(np.clip(values[2:], -FARTHEST, FARTHEST)))
        if self.order in (1, 3):
            total = total / (1 + s / (2 * np.pi * rest.pop(0)))
        if self.order >= 2:
            natural = 2 * np.pi * rest[0]
            total = total / (1 + 2 * rest[1] * s / natural + (s / natural) ** 2)
        return total

    def report(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Parameters (n,) [their units] and their slopes (n,) over the values."""
        shown = np.exp(values)
        shown[0] *= self.sign
        slopes = shown.copy()
        shown[1], slopes[1] = values[1] / self.highest, 1 / self.highest
        return shown, slopes


class _BlockProblem(SquareSum):
    def __init__(self, measured: Measured, block: Block) -> None:
        assert measured.covariance is not None
        self.block, self.omega, self.matrix = block, measured.omega, measured.matrix[:, 0, 0]
        self.weight = np.sqrt(2 / measured.covariance[:, 0, 0].real)

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.weight * self.matrix))

    def residual(self, parameters: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            return self.whiten(self.matrix - self.block.response(parameters, self.omega))

    def whiten(self, change: ComplexArray) -> FloatArray:
        """A *change* of the response (n_line,) [1] over its noise, real above imaginary parts (2 n_line,)."""
        left = self.weight * change
        return np.concatenate([left.real, left.imag])

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        steps = STEP * np.eye(parameters.size)
        pairs = [(self.residual(parameters + step), self.residual(parameters - step)) for step in steps]
        return np.column_stack([(ahead - behind) / (2 * STEP) for ahead, behind in pairs])


def block_fits(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    """One fit, or one per band. ConfigError for several ports, FitError for few lines or without noise."""
    rows, columns = select_ports(response, settings.input, settings.output)
    if len(rows) != 1 or len(columns) != 1:
        what = f"a block has one input and one output, not {len(columns)} and {len(rows)}"
        raise ConfigError(what, hint="name them: input, output")
    block_settings: BlockSettings = settings.model_settings
    auto, fits = block_settings.order == AUTO, []
    for band in settings.bands or (settings.band,):
        lines = np.ones(response.frequency.size, bool) if band is None else lines_in(response.frequency, band)
        measured = measured_part(replace(response, form="receptance"), rows, columns, lines)
        if measured.covariance is None or not has_noise(measured):
            raise FitError("the noise of the response is not known", hint="average several periods or blocks")
        silent = measured.omega[measured.covariance[:, 0, 0].real <= 0]
        if silent.size:
            hint = "leave it out (`exclude`), or average several periods or blocks"
            raise FitError(f"the line at {silent[0] / (2 * np.pi):g} Hz has no noise", hint=hint)
        if measured.omega.size < LEAST_LINES:
            hint = f"{LEAST_LINES} or more: widen `band`"
            raise FitError(f"{measured.omega.size} lines in the band", hint=hint)
        orders = ORDERS[1:] if auto else [block_settings.order]
        minima = filter(None, (_most_likely(measured, int(order)) for order in orders))
        pairs = [(_candidate(measured, *minimum), minimum) for minimum in minima]
        if not pairs:
            raise FitError("no block can be determined by these lines", hint="widen the band")
        pairs.sort(key=lambda pair: pair[0].bic or 0.0)
        fit = _report(measured, response, settings, *pairs[0])
        fits.append(replace(fit, candidates=tuple(candidate for candidate, _ in pairs)) if auto else fit)
    return tuple(fits)


def _most_likely(measured: Measured, order: int) -> tuple[_BlockProblem, Minimum] | None:
    response, omega = measured.matrix[:, 0, 0], measured.omega
    highest, level = float(omega[-1]), float(np.log(np.abs(response[0])))
    # A delay turns the phase of the lowest line as well: the sign by the phase there, and by its course.
    slope, at_rest = np.polyfit(omega, np.unwrap(np.angle(response)), 1)
    begun = ((float(np.sign(response[0].real)) or 1.0, 0.0), (float(np.copysign(1, np.cos(at_rest))), -slope))
    ends = []
    for sign, delay in begun:
        problem = _BlockProblem(measured, Block(order, sign, highest))
        for share in CORNERS if order else (1.0,):
            corner = np.log(share * highest / (2 * np.pi))
            shape = [[], [corner], [corner, np.log(DAMPING)], [corner, corner, np.log(DAMPING)]][order]
            end = minimise(problem, np.array([level, delay * highest, *shape]))
            if end.converged and np.linalg.cond(problem.jacobian(end.values)) < 1 / STEP:
                ends.append((problem, end))
    return min(ends, key=lambda pair: pair[0].chi2(pair[1].values), default=None)


def _candidate(measured: Measured, problem: _BlockProblem, minimum: Minimum) -> Candidate:
    n = minimum.values.size
    dof = measured.n_equation - n
    uncertainty = weight_uncertainty(measured, dof)
    squares = problem.chi2(minimum.values) / uncertainty.excess
    bic = squares + n * float(np.log(measured.n_equation))
    chi2_p = uncertainty.p_value(squares / dof, dof)
    return Candidate(f"order {problem.block.order}", n, squares, dof, squares + 2 * n, bic=bic, chi2_p=chi2_p)


def _report(
    measured: Measured,
    response: FrequencyResponse,
    settings: FitSettings,
    best: Candidate,
    end: tuple[_BlockProblem, Minimum],
) -> Fit:
    problem, minimum = end
    jacobian = problem.jacobian(minimum.values)
    inflation = weight_uncertainty(measured, best.dof).inflation
    assert best.chi2_p is not None
    factor = float(np.sqrt(best.chi2 / best.dof)) if best.chi2_p < MISMATCH_P else 1.0
    design = triangle_of(jacobian)
    values, slopes = problem.block.report(minimum.values)
    fitted = problem.block.response(minimum.values, measured.omega)[:, None, None]
    r2, adjusted = determination(measured.matrix, measured.matrix - fitted, values.size)
    gof = Goodness(r2, adjusted, best.chi2 / best.dof, best.chi2_p)
    names, units = zip(*problem.block.names, strict=True)
    inner = inflation * np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    covariance, vifs = np.outer(slopes, slopes) * inner, inflation_factors(design)
    covariances = covariance, factor**2 * covariance
    valued = plain_values(names, units, values, covariances, best.dof, vifs)
    as_estimate = Estimate(
        values=values,
        covariance=covariance,
        scaled_design=design,
        gof=gof,
        dof=best.dof,
        converged=True,
        iterations=minimum.steps,
    )
    excess = (
        f"the residual is {factor:.3g} times the noise: the block has zeros or a higher order, or the "
        "loop biases its FRF; `frf: {reference: r}` where the loop is closed"
    )
    frequency = measured.omega / (2 * np.pi)
    assert measured.covariance is not None
    band = (float(frequency[0]), float(frequency[-1]))
    fit = reported_fit(settings, as_estimate, tuple(v.parameter for v in valued), band, frequency.size)
    outputs, inputs = measured.outputs, measured.inputs
    # By one step of the fit, its weights as they were.
    step = -slopes[:, None] * np.linalg.pinv(jacobian)
    sources = [(of.uncertainty, step @ problem.whiten(of.change[:, 0, 0])) for of in matrix_errors(measured)]
    return replace(
        with_sources(fit, sources),
        notes=(
            *fit.notes,
            f"block: the gain is that of {outputs[0].label} per {inputs[0].label}, in their SI units.",
        ),
        findings=(
            *estimate_findings(as_estimate, names, frequency.size),
            *goodness_findings(gof),
            *([Finding("model-mismatch", excess)] if factor > 1 else []),
            *response.findings,
        ),
        curve=FittedCurve(
            frequency,
            measured.matrix,
            fitted,
            variance=measured.covariance[:, :1, :1].real,
            outputs=tuple(port.label for port in outputs),
            inputs=tuple(port.label for port in inputs),
            form=response.form,
        ),
    )

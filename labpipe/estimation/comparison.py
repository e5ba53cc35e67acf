"""Comparison of model structures: the model of a fit against simpler and richer ones on the same lines."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import amount_text
from labpipe.distributions import chi2_tail
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.damping import HYSTERETIC, FactorModel, damp
from labpipe.estimation.descent import Linearisation, SquareSum, linearise_problem, minimise
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.estimation.likelihood import maximum_likelihood, maximum_likelihood_from
from labpipe.estimation.measured import Measured
from labpipe.estimation.mismatch import RELAXES
from labpipe.estimation.model import DynamicModel, Setup
from labpipe.estimation.settings import VISCOUS, FitSettings
from labpipe.estimation.statistics import Estimate, restate, stack
from labpipe.estimation.weights import has_noise, weight_uncertainty, whiten_values, whitener
from labpipe.records.finding import NORMAL, Finding, Parameter
from labpipe.records.identification import Candidate
from labpipe.records.settings import ESTIMATE
from labpipe.records.uncertain import Budget

PASSES = 8
# The descent ends where a full step would lower chi-square by a small part of its expectation per equation:
# differences in AIC count from 10, and a surplus mode creeps long through noise.
NEAR = 0.02
# Bound of the descent: surplus modes may have no minimum.
MOST_STEPS = 150


@dataclass(frozen=True)
class RationalFit(SquareSum):
    """Elements of H as B_e(s) / A(s) with one common denominator: A of degree 2 n for n modes, B_e of degree
    2 n - 2.

    Receptances of n modes have this form. Polynomials are sums over the basis phi_0 ... phi_2n, orthogonal on
    the lines, phi_k of degree k in s = j w; A has 1 at phi_2n. *whitener* (n_line, n_element, n_element)
    [N/m]. Parameters: 2 n of A, then 2 n - 1 of every element. Equation (est-rational).
    """

    measured: Measured
    whitener: ComplexArray
    modes: int

    @cached_property
    def unit(self) -> float:
        """The largest |H| [m/N]."""
        return float(np.max(np.abs(self.measured.matrix)))

    @cached_property
    def elements(self) -> ComplexArray:
        """Elements of H, (n_line, n_element), relative to the largest [1]."""
        return self.measured.matrix.reshape(self.measured.omega.size, -1) / self.unit

    @cached_property
    def basis(self) -> ComplexArray:
        """phi_0 ... phi_2n on the lines, (n_line, 2 n + 1) [1]: the even ones real, the odd ones imaginary,
        as powers of j w are. Powers themselves are so alike that normal equations would lose all digits.
        """
        w = self.measured.omega / np.max(self.measured.omega)
        even = np.linalg.qr(np.vander(w**2, self.modes + 1, increasing=True))[0]
        odd = np.linalg.qr(w[:, None] * np.vander(w**2, self.modes, increasing=True))[0]
        basis = np.empty((w.size, 2 * self.modes + 1), np.complex128)
        basis[:, 0::2], basis[:, 1::2] = even, 1j * odd
        return basis * np.sqrt(w.size)

    @property
    def n_parameter(self) -> int:
        return 2 * self.modes + (2 * self.modes - 1) * self.elements.shape[1]

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self._whiten(self.elements)))

    def lowest_chi2(self) -> float | None:
        """Chi-square [1] at the minimum; None without convergence in MOST_STEPS."""
        minimum = minimise(self, self.start(), near=NEAR, most_steps=MOST_STEPS, linearise=self.linearise)
        return self.chi2(minimum.values) if minimum.converged else None

    def residual(self, parameters: FloatArray) -> FloatArray:
        """Whitened residual (n_equation,) [1] at *parameters* (n_parameter,)."""
        return self._whiten(self.elements - self._fit(parameters)[1])

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """d residual / d p = -(d B_e - H_e d A) / A, (n_equation, n_parameter) [1]."""
        denominator, fitted = self._fit(parameters)
        return -self._whiten(self._columns(fitted, 1 / denominator)).T

    def linearise(self, parameters: FloatArray) -> Linearisation:
        """The linearisation at *parameters* (n_parameter,) [1] from the normal equations; by QR where
        rounding leaves them not positive definite.
        """
        denominator, fitted = self._fit(parameters)
        residual = self.elements - fitted
        normal, right_side = self._normal_equations(fitted, 1 / denominator, residual)
        scale = np.sqrt(np.diag(normal))
        try:
            triangle = np.linalg.cholesky(normal / (scale[:, None] * scale)).T
        except np.linalg.LinAlgError:
            return linearise_problem(self, parameters)
        projected = -np.linalg.solve(triangle.T, right_side / scale)
        return Linearisation(triangle, projected, scale, self.chi2(parameters), 2 * residual.size)

    def start(self) -> FloatArray:
        """Start values (n_parameter,) [1] by the equation error weighted with 1 / A of the last pass, the
        best of all passes (Sanathanan and Koerner 1963).
        """
        weight: ComplexArray = np.ones(self.measured.omega.size, np.complex128)
        best: FloatArray = np.zeros(self.n_parameter)
        lowest = float("inf")
        for _ in range(PASSES):
            highest = self.elements * (self.basis[:, -1] * weight)[:, None]
            normal, right_side = self._normal_equations(self.elements, weight, highest)
            scale = np.sqrt(np.diag(normal))
            normal = normal / (scale[:, None] * scale)
            values = np.linalg.lstsq(normal, right_side / scale, rcond=None)[0] / scale
            denominator = self._denominator(values)
            if np.any(denominator == 0):
                break
            weight = 1 / denominator
            if (chi2 := self.chi2(values)) < lowest:
                best, lowest = values, chi2
        return best

    def _denominator(self, parameters: FloatArray) -> ComplexArray:
        n = 2 * self.modes
        return self.basis[:, :n] @ parameters[:n] + self.basis[:, n]

    def _fit(self, parameters: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        n = 2 * self.modes
        denominator = self._denominator(parameters)
        numerators = self.basis[:, : n - 1] @ parameters[n:].reshape(-1, n - 1).T
        return denominator, numerators / denominator[:, None]

    def _columns(self, elements: ComplexArray, weight: ComplexArray) -> ComplexArray:
        """Columns of B_e - H_e (a_0 phi_0 + a_1 phi_1 + ...) times the weight, (n_parameter, n_line,
        n_element).
        """
        powers, n = (self.basis * weight[:, None]).T, 2 * self.modes
        columns = np.zeros((self.n_parameter, *elements.shape), np.complex128)
        columns[:n] = -elements * powers[:n, :, None]
        for e in range(elements.shape[1]):
            columns[n + e * (n - 1) : n + (e + 1) * (n - 1), :, e] = powers[: n - 1]
        return columns

    @cached_property
    def _precision(self) -> ComplexArray:
        """C^-1 of the relative elements per line, (n_line, n_element, n_element) [1]."""
        return 2 * self.unit**2 * np.matmul(self.whitener.conj().swapaxes(1, 2), self.whitener)

    @cached_property
    def _products(self) -> ComplexArray:
        basis = self.basis[:, :-1].T
        return basis.conj()[:, None] * basis[None]

    def _normal_equations(
        self, elements: ComplexArray, weight: ComplexArray, right_side: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """J^T J (n_parameter, n_parameter) and J^T r (n_parameter,) [1] of J = `_columns` and r =
        *right_side*, whitened: every column is a basis function times a vector, so sums over lines are few
        small products.
        """
        n, n_element = 2 * self.modes, elements.shape[1]
        precision = self._precision * (np.abs(weight) ** 2)[:, None, None]
        by_element = np.einsum("le,lef->lf", elements.conj(), precision)
        normal = np.empty((self.n_parameter, self.n_parameter))
        normal[:n, :n] = self._sums(n, n, np.einsum("lf,lf->l", by_element, elements)[:, None])[:, :, 0]
        crossed = -self._sums(n, n - 1, by_element).transpose(0, 2, 1).reshape(n, -1)
        normal[:n, n:], normal[n:, :n] = crossed, crossed.T
        numerators = self._sums(n - 1, n - 1, precision.reshape(-1, n_element**2)).reshape(
            n - 1, n - 1, n_element, n_element
        )
        normal[n:, n:] = numerators.transpose(2, 0, 3, 1).reshape(normal[n:, n:].shape)
        weighted = np.einsum("lef,lf->le", self._precision, right_side) * weight.conj()[:, None]
        basis = self.basis[:, :n].conj()
        along = np.einsum("le,le->l", elements.conj(), weighted)
        numerator = (basis[:, : n - 1].T @ weighted).real.T.ravel()
        return normal, np.concatenate([-(basis.T @ along).real, numerator])

    def _sums(self, rows: int, columns: int, values: ComplexArray) -> FloatArray:
        """Real part of the sum over lines of conj(phi_a) phi_b *values* (n_line, n), for a < *rows*, b <
        *columns*: (rows, columns, n).
        """
        products = self._products[:rows, :columns].reshape(rows * columns, -1)
        return (products.real @ values.real - products.imag @ values.imag).reshape(rows, columns, -1)

    def _whiten(self, values: ComplexArray) -> FloatArray:
        return whiten_values(self.whitener, self.unit * values[..., None])


# Difference in AIC beyond which a model has no support (Burnham and Anderson 2002, sec. 2.6).
NO_SUPPORT = 10.0
# Share of chi-square that hysteretic damping leaves at most where it is the cause and others are smaller.
LITTLE = 0.05
# Bound of each descent of a variant: a structure that contradicts the data may have no minimum.
MOST_COMPARED_STEPS = 40


@dataclass(frozen=True)
class _Variant:
    name: str
    settings: FitSettings
    inside: tuple[str, ...] = ()


# Settings that make another model, where the first says so.
_Change = tuple[object, dict[str, Any]]


def candidates(
    measured: Measured, setup: Setup, ml_estimate: Estimate | None = None
) -> tuple[tuple[Candidate, ...], tuple[str, ...]]:
    """Every variant fitted by ml, in ascending order of AIC = chi-square + 2 parameters, and a note that
    names those without a minimum; nothing for an unknown noise.

    *ml_estimate*: that of the fit itself, where it is by ml. Every descent is bounded. Without `compare` only
    independent damping coefficients beside a damping law, and beside them hysteretic damping, where it alone
    leaves noise, or LITTLE of chi-square. p_value: probability of an equal or larger decrease of chi-square
    to the richest variant that contains this one, if this one is true (likelihood ratio, chi-square with as
    many degrees of freedom as additional parameters). Equation (est-aic).
    """
    if not has_noise(measured):
        return (), ()
    whole = setup.settings.compare
    variants = variants_of(setup.settings) if whole else _damping_variants(setup.settings)
    results: dict[str, Candidate | None] = {}
    for variant in variants:
        try:
            of_variant = replace(setup, settings=variant.settings)
            model = damp(variant.settings.kind.model(of_variant), variant.settings)
        except ConfigError:
            # It does not suit these ports.
            continue
        is_this = ml_estimate is not None and variant.name.startswith(THIS)
        estimate = ml_estimate if is_this else _estimate(measured, model)
        results[variant.name] = None
        if estimate is not None and estimate.converged:
            size, dof = estimate.values.size, estimate.dof
            results[variant.name] = _candidate(variant.name, measured, estimate.squares, size, dof)
    if whole:
        results.update(_orders(measured, len(setup.outputs)))
    fitted = {name: candidate for name, candidate in results.items() if candidate is not None}
    inside = {of.name: [fitted[name] for name in of.inside if name in fitted] for of in variants}
    tested = [_test(candidate, inside.get(name, [])) for name, candidate in fitted.items()]
    tested.sort(key=lambda candidate: candidate.aic)
    only_as_cause = tested and not whole and setup.settings.damping == VISCOUS
    is_noise = bool(tested) and chi2_tail(tested[0].chi2, tested[0].dof) >= MISMATCH_P
    if only_as_cause and not is_noise and tested[0].chi2 > LITTLE * tested[-1].chi2:
        return (), ()
    left_out = "; ".join(name for name in results if name not in fitted)
    what = f"Compared models left out, their descents found no minimum: {left_out}."
    return tuple(tested), (what,) if left_out else ()


def comparison_findings(ranking: tuple[Candidate, ...]) -> tuple[Finding, ...]:
    """A warning where another model than the fit's (its name begins with THIS) is much better supported."""
    this_model = next((candidate for candidate in ranking if candidate.name.startswith(THIS)), None)
    if this_model is None or this_model.aic - ranking[0].aic < NO_SUPPORT:
        return ()
    best = ranking[0]
    message = (
        f"another model is better supported by the data: '{best.name}' with {best.parameters} parameters has "
        f"AIC {best.aic:.4g}, this one with {this_model.parameters} parameters {this_model.aic:.4g}"
    )
    return (Finding("other-model", message),)


THIS = "this model"


def _orders(measured: Measured, n_output: int) -> dict[str, Candidate | None]:
    """Rational fits with one mode less than dofs, as many, and one more: does the model lack modes?"""
    weights = whitener(measured)
    fits = [RationalFit(measured, weights, modes) for modes in range(max(n_output - 1, 1), n_output + 2)]
    orders = {}
    for fit in fits:
        dof = measured.n_equation - fit.n_parameter
        if dof > 0:
            name = f"{fit.modes} mode{'s' if fit.modes > 1 else ''}, any structure"
            orders[name] = _candidate(name, measured, fit.lowest_chi2(), fit.n_parameter, dof)
    return orders


def variants_of(settings: FitSettings) -> list[_Variant]:
    """The fit itself by ml over one band, then richer and simpler models."""
    plain = replace(settings, estimator="ml", weight="none", eliminate=False, sliding=None, bands=())
    richer = _richer(plain)
    this = _Variant(f"{THIS}: {_description(plain)}", plain, tuple(variant.name for variant in richer))
    return [this, *richer, *_simpler(plain)]


def _damping_variants(settings: FitSettings) -> list[_Variant]:
    """The fit itself and, beside a damping law, independent coefficients, beside these hysteretic damping."""
    plain = replace(settings, weight="none", sliding=None)
    law = HYSTERETIC.name if settings.damping == VISCOUS else VISCOUS
    others = [_Variant(_description(other), other) for other in _changes(plain, [(True, {"damping": law})])]
    inside = tuple(other.name for other in others if law == VISCOUS)
    return [_Variant(f"{THIS}: {_description(plain)}", plain, inside), *others]


def _richer(settings: FitSettings) -> list[_Variant]:
    kind = settings.kind
    changes: list[_Change] = [
        (kind.richer, {"model": kind.richer}),
        (settings.symmetric, {"symmetric": False}),
        (settings.damping != VISCOUS, {"damping": VISCOUS}),
        (kind.frees_mass and settings.mass != ESTIMATE, {"mass": ESTIMATE, "scale_mass": False}),
    ]
    return [_Variant(_description(other), other) for other in _changes(settings, changes)]


def _simpler(settings: FitSettings) -> list[_Variant]:
    this = f"{THIS}: {_description(settings)}"
    kind = settings.kind
    full_mass = settings.mass == ESTIMATE and not settings.lumped_mass
    changes: list[_Change] = [
        (kind.simpler, {"model": kind.simpler}),
        ("symmetric" in kind.keys and not settings.symmetric, {"symmetric": True}),
        ("damping" in kind.keys and settings.damping == VISCOUS, {"damping": "proportional"}),
        ("lumped_mass" in kind.keys and full_mass, {"lumped_mass": True}),
    ]
    return [_Variant(_description(other), other, (this,)) for other in _changes(settings, changes)]


def _changes(settings: FitSettings, changes: Sequence[_Change]) -> Iterator[FitSettings]:
    for applies, change in changes:
        if applies:
            with contextlib.suppress(ConfigError):
                yield replace(settings, **change)


def _description(settings: FitSettings) -> str:
    parts = [settings.model]
    if "symmetric" in settings.kind.keys:
        parts.append("symmetric" if settings.symmetric else "general")
    if settings.damping != VISCOUS:
        parts.append(f"{settings.damping} damping")
    if settings.mass == ESTIMATE:
        parts.append("lumped mass estimated" if settings.lumped_mass else "mass estimated")
    if settings.residuals:
        parts.append("residual term")
    return ", ".join(parts)


def _estimate(measured: Measured, model: DynamicModel | FactorModel) -> Estimate | None:
    try:
        return maximum_likelihood(measured, model, most_steps=MOST_COMPARED_STEPS)
    except FitError:
        return None


def _candidate(
    name: str, measured: Measured, squares: float | None, n_parameter: int, dof: int
) -> Candidate | None:
    if squares is None:
        return None
    # Differences between models follow the covariance of parameters, not the residual's expectation.
    chi2 = squares / weight_uncertainty(measured, dof).inflation
    return Candidate(name, n_parameter, chi2, dof, chi2 + 2 * n_parameter)


def _test(candidate: Candidate, richer: list[Candidate]) -> Candidate:
    if not richer:
        return candidate
    richest = max(richer, key=lambda other: other.parameters)
    gained, added = candidate.chi2 - richest.chi2, richest.parameters - candidate.parameters
    return replace(candidate, p_value=chi2_tail(gained, added)) if added > 0 else candidate


# Relaxation times, or powers, that a search begins from, times to the band's ends and as far beyond as this
# factor.
N_COURSE, BEYOND = 13, 3.0
# Steps of w = sqrt(Re K(w) / m) from the band's middle, which come to rest at the resonance.
RESONANCE_STEPS = 60


@dataclass(frozen=True)
class RelaxingMount:
    """H(w) = 1 / (k + j w c + k_r g - w^2 m): a mass on a mount whose stiffness rises with frequency, beside
    a damper. g = s / (1 + s), s = j w tau, of Zener's solid (Nashif, Jones and Henderson, Vibration Damping,
    1985, ch. 2); with a *reference* w_0 [rad/s] (j w / w_0)^alpha (Bagley and Torvik 1983, AIAA Journal
    21:741). Parameters: k [N/m], c [N.s/m], k_r [N/m], tau [s] or alpha [1], m [kg] where *mass* is None.
    Equation (est-relaxing).
    """

    mass: float | None
    reference: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        return ("k", "c", "k_r", "alpha" if self.reference else "tau", "m")[: 4 + (self.mass is None)]

    @property
    def units(self) -> tuple[str, ...]:
        return ("N/m", "N.s/m", "N/m", "1" if self.reference else "s", "kg")[: len(self.names)]

    def mass_of(self, parameters: FloatArray) -> float:
        """The mass [kg], given or among *parameters* (n_parameter,) [parameter units]."""
        return float(parameters[4]) if self.mass is None else self.mass

    def course(self, at: float, omega: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """g of tau [s] or alpha [1] and its slope over that, each (n_line,) [1]."""
        if self.reference:
            turned = 1j * omega / self.reference
            # Of leakage lines beside the band are asked for as well, down to 0 Hz.
            return turned**at, turned**at * np.log(np.where(omega > 0, turned, 1.0))
        s = 1j * omega * at
        return s / (1 + s), 1j * omega / (1 + s) ** 2

    def stiffness(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """K(w) [N/m], (n_line,)."""
        k, c, rise, at = parameters[:4]
        return np.asarray(k + 1j * omega * c + rise * self.course(at, omega)[0])

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H(w) [m/N], (n_line, 1, 1)."""
        z = self.stiffness(parameters, omega) - self.mass_of(parameters) * omega**2
        return (1 / z)[:, None, None]

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp, (n_parameter, n_line, 1, 1) [m/N per parameter unit]."""
        turned, (course, slope) = 1j * omega, self.course(parameters[3], omega)
        slopes = [np.ones_like(turned), turned, course, parameters[2] * slope, turned**2]
        square = self.receptance(parameters, omega)[:, 0, 0] ** 2
        return (-square * np.array(slopes[: len(self.names)]))[:, :, None, None]

    def start(self, measured: Measured) -> FloatArray:
        """The parameters (n_parameter,) [parameter units] of least squares of 1 / H by the best course."""
        omega, h = measured.omega, measured.matrix[:, 0, 0]
        assert measured.variance is not None
        deviation = np.sqrt(measured.variance[:, 0])
        weights = np.abs(h) ** 2 / deviation
        side = h.conj() / deviation + (self.mass or 0.0) * weights * omega**2
        times = 1 / np.geomspace(omega[0] / BEYOND, BEYOND * omega[-1], N_COURSE)
        tried = []
        for at in np.linspace(0, 1, N_COURSE + 2)[1:-1] if self.reference else times:
            columns = np.array([np.ones_like(side), 1j * omega, self.course(at, omega)[0], (1j * omega) ** 2])
            rows, whole = stack(weights * columns[: len(self.names) - 1]), stack(side)
            values, squares, *_ = np.linalg.lstsq(rows.T, whole)
            tried.append((float(np.sum(squares)), [*values[:3], at, *values[3:]]))
        return np.array(min(tried)[1])

    def at_resonance(self, parameters: FloatArray, omega: float) -> FloatArray:
        """Stiffness k [N/m], damping c [N.s/m], f_n [Hz] and zeta [1] where Re K(w) = m w^2, and the mass
        [kg], (5,); *omega* [rad/s] is near.
        """
        mass, w = self.mass_of(parameters), np.array([omega])
        for _ in range(RESONANCE_STEPS):
            w = np.sqrt(np.abs(self.stiffness(parameters, w).real) / mass)
        k = complex(self.stiffness(parameters, w)[0])
        return np.array([k.real, k.imag / w[0], w[0] / (2 * np.pi), k.imag / (2 * k.real), mass])

    def words(self, parameters: FloatArray, ends: FloatArray) -> str:
        """What the mount of *parameters* (n_parameter,) [parameter units] is between *ends* (2,) [rad/s]."""
        pairs = zip(ends / (2 * np.pi), self.stiffness(parameters, ends).real, strict=True)
        said = ", ".join(f"{amount_text(k, None, 'N/m')} at {f:.3g} Hz" for f, k in pairs)
        return f"stiffness that rises with frequency, as of rubber: {said} {RELAXES}"


@dataclass(frozen=True)
class OtherLaw:
    """A law of damping or stiffness that explains the residual of a viscous fit: what it is in *words*, its
    *values* with standard errors (2,) [SI] by name, and its chi-square with two for each parameter.
    """

    words: str
    values: dict[str, FloatArray]
    aic: float


def relaxing_mounts(measured: Measured, mass: float | None, chi2: float) -> Iterator[OtherLaw]:
    """Mounts that relax, with their values at resonance, which leave noise, or LITTLE of the *chi2* per
    degree of freedom of the viscous fit.
    """
    omega = measured.omega
    if measured.variance is None or not np.all(measured.variance > 0) or not omega[0] > 0:
        return
    middle = float(np.sqrt(omega[0] * omega[-1]))
    for model in (RelaxingMount(mass), RelaxingMount(mass, middle)):
        with contextlib.suppress(FitError, np.linalg.LinAlgError):
            estimate = maximum_likelihood_from(measured, model, model.start(measured), "")
            values, left, chance = estimate.values, estimate.gof.chi2_reduced, estimate.gof.chi2_p
            sound = values[2:] if model.reference else values[[0, 2, 3]]
            if not (estimate.converged and np.all(sound > 0)) or left is None or chance is None:
                continue
            if chance < MISMATCH_P and left > LITTLE * chi2:
                continue
            steps = np.linalg.cholesky(estimate.covariance * max(left, 1.0)).T
            ends = [[model.at_resonance(values + sign * s, middle) for s in steps] for sign in (1, -1)]
            errors = np.linalg.norm(np.subtract(ends[0], ends[1]), axis=0) / 2
            pairs = np.column_stack([model.at_resonance(values, middle), errors])
            by_name = dict(zip(("k", "c", "f_n", "zeta", "m"), pairs, strict=True))
            yield OtherLaw(
                model.words(values, omega[[0, -1]]), by_name, left * estimate.dof + 2 * values.size
            )


def hold_values(
    parameters: Iterable[Parameter], laws: Iterable[OtherLaw], budget: Budget | None
) -> tuple[Parameter, ...]:
    """The parameters with intervals that hold the values under other *laws* as well, with their errors and
    those of the numbers in the *budget*.
    """
    held = {p.name: p for p in parameters}
    stated = {} if budget is None else dict(zip(budget.names, budget.systematic, strict=True))
    for name, (value, error) in (entry for law in laws for entry in law.values.items()):
        p = held.get(name)
        if p is not None and p.ci95 is not None and p.interval is not None:
            half = NORMAL * float(np.hypot(error, stated.get(name, 0.0)))
            low, high = min(p.ci95[0], float(value) - half), max(p.ci95[1], float(value) + half)
            held_error = (high - low) / (2 * NORMAL)
            excess = float(np.sqrt(max(held_error**2 - p.interval.noise**2, 0.0)))
            parts = replace(p.interval, discrepancy=excess)
            held[name] = restate(p, p.value, held_error, (low, high), interval=parts)
    return tuple(held.values())

"""Maximum-likelihood refinement of poles and participation, with shapes and residual terms eliminated.

H(s) = s^p (sum over modes of psi l^T / (s - lambda) + conj. + sum over terms of C rho(s)), p = 0, 1, 2 for
receptance, mobility and accelerance. Given lambda and l everything else is linear, separately for each
output, and is eliminated; the Gram matrix of u = a + b, v = j (a - b) with a = s^p / (s - lambda), b = s^p /
(s - conj lambda), of their derivatives and of the residual terms, and its products with the data are all that
an iteration needs of the lines.

With a loss factor of each mode, w_r^2 (1 + j eta) - w^2 = s^2 - lambda^2: in place of the conjugate pair
stands psi l^T (1 / (s - lambda) - 1 / (s + lambda)), so u = a - b, v = j u with b = s^p / (s + lambda).

Real modes (damping in proportion to mass and stiffness) have imaginary psi and real l: R = psi l^T then is
psi_real l^T / (2 j w_d).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.distributions import chi2_tail
from labpipe.estimation.leakage import Leakage
from labpipe.estimation.residual import jackknife_residual

# a and b of every pole, and their derivatives.
PoleFunctions = tuple[tuple[ComplexArray, ComplexArray], tuple[ComplexArray, ComplexArray]]


@dataclass(frozen=True)
class FrfLines:
    """FRFs on the lines: omega (n_line,) [rad/s], matrix (n_line, n_output, n_input) [unit of the FRF],
    *power* p of s of their form.

    weight (n_line,) [1]: reciprocal of the noise along the lines, the same for every element; all sums over
    lines are weighted with it. hysteretic: whether modes are damped by a loss factor, else viscously.
    leakage: of random data, where it is known. shared: variance of a sum over the lines over that of
    independent ones [1]. adds_terms: whether more residual terms than one for modes below and one for
    modes above are tried. beside (n,) [rad/s]: poles of modes just beyond the band, whose residues every
    element has for itself. correlation (n,) [1]: that of `whiteness`.
    """

    omega: FloatArray
    matrix: ComplexArray
    power: int
    weight: FloatArray
    hysteretic: bool = False
    leakage: Leakage | None = None
    shared: float = 1.0
    adds_terms: bool = True
    beside: tuple[complex, ...] = ()
    correlation: tuple[complex, ...] = ()

    @property
    def s(self) -> ComplexArray:
        """j omega (n_line,) [rad/s]."""
        return 1j * self.omega

    def functions(self, poles: ComplexArray) -> PoleFunctions:
        """`pole_functions` of *poles* (n_mode,) [rad/s] as the lines show them: with what leaks."""
        return leaking_functions(self.omega, poles, self.leakage, self.hysteretic)

    @property
    def spacing(self) -> float:
        """Distance of neighbouring lines [rad/s], whatever a band or a mask leaves out between others."""
        return float(np.median(np.diff(self.omega)))


@dataclass(frozen=True)
class ResidualTerms:
    """Smooth terms and the FRFs that they are taken out of, both times the weight of the *lines*:

    *lower* terms s^-2, s^-4 ... (modes below the band) and *upper* terms 1, s^2, s^4 ... (above), times
    s^power; 1 / (s - lambda) of the poles *beside* the band and its slope, for what these are off by.

    Orthonormal one after the other, each the one before times omega^2 or omega^-2 (Arnoldi; Brubeck,
    Nakatsukasa and Trefethen 2021): as powers they are so alike in a narrow band that rounding chooses among
    them. Equation (modal-terms).
    """

    lines: FrfLines
    lower: int
    upper: int

    @property
    def count(self) -> int:
        return self.lower + self.upper + 2 * len(self.lines.beside)

    @cached_property
    def basis(self) -> ComplexArray:
        """Orthonormal columns (n_line, n_term) [1]."""
        omega, square = self.lines.omega, self.lines.omega**2
        middle, half = (square[-1] + square[0]) / 2, max((square[-1] - square[0]) / 2, np.finfo(float).tiny)
        column = (1j * omega / omega[-1]) ** self.lines.power * self.lines.weight
        basis = column[:, None] / np.linalg.norm(column)
        # Each the one before times a factor, or what stands for itself.
        following = [(square - middle) / half] * (self.upper - 1) + [square[0] / square] * self.lower
        alone: list[ComplexArray] = []
        if self.lines.beside:
            (of_poles, _), (slopes, _) = self.lines.functions(np.array(self.lines.beside))
            alone = list((column[:, None] * np.hstack([of_poles, slopes])).T)
        for number, factor in enumerate([*following, *alone]):
            column = factor * basis[:, -1] if number < len(following) else factor
            for _ in range(2):
                column = column - basis @ (basis.conj().T @ column)
            basis = np.column_stack([basis, column / np.linalg.norm(column)])
        return basis

    def remove_from(self, values: ComplexArray) -> ComplexArray:
        """*values* (n_line, n) [any unit] less what the terms can make of them with complex factors."""
        return values - self.basis @ (self.basis.conj().T @ values)

    @cached_property
    def remainder(self) -> ComplexArray:
        """The data (n_line, n_output, n_input) [unit of the FRF] without the terms."""
        weighted = self.lines.matrix * self.lines.weight[:, None, None]
        return self.remove_from(weighted.reshape(weighted.shape[0], -1)).reshape(weighted.shape)

    @cached_property
    def size(self) -> FloatArray:
        """Sum over the lines of |remainder|^2, (n_output, n_input) [square of the FRF's unit]."""
        return np.sum(np.abs(self.remainder) ** 2, axis=0)


MOST_STEPS = 200
# A step below this part of every standard error ends the descent.
NEGLIGIBLE = 1e-3
# Part of a standard error within which a point counts as the minimum where rounding lets no step lower the
# misfit.
NEAR = 0.1
# Relative size of eigenvalues of scaled normal matrices that rounding leaves of zero.
ROUNDING = 1e-13
MOST_HALVINGS = 12


@dataclass(frozen=True)
class Refined:
    """Modes with covariance: *poles* (n_mode,) [rad/s], *participation* (n_mode, n_input) with largest entry
    1, *shapes* (n_output, n_mode) such that psi l^T is the residue.

    covariance (n, n) of the parameters: Re and Im of the poles in turn, then those of the participation other
    than the largest entry. shape_covariance (n_output, 2 n_mode, 2 n_mode) of Re and Im of psi in turn;
    crossed (n_output, 2 n_mode, n) of both. noise (n_output, n_input): variance E|n|^2 of an element.
    information: 2 n_line times the sum of ln(residual) over the elements. Equation (modal-likelihood).
    """

    poles: ComplexArray
    participation: ComplexArray
    shapes: ComplexArray
    covariance: FloatArray
    shape_covariance: FloatArray
    crossed: FloatArray
    noise: FloatArray
    information: float
    converged: bool
    steps: int
    hysteretic: bool = False

    def place(self, mode: int, reference: int) -> int | None:
        """Place of the real part of an entry of the participation among the parameters.

        None for the fixed one.
        """
        rows, columns = _free(self.participation)
        match = np.flatnonzero((rows == mode) & (columns == reference))
        return 2 * self.poles.size + 2 * int(match[0]) if match.size else None


@dataclass(frozen=True)
class _GramSums:
    """Gram matrix (f, f) of the pole functions and their derivatives and its products (f, n_output, n_input)
    with the data, both after elimination of the residual terms; *size* (n_output, n_input): sum of squares of
    the data after it.
    """

    gram: FloatArray
    products: FloatArray
    size: FloatArray


def refine(
    terms: ResidualTerms,
    poles: ComplexArray,
    participation: ComplexArray,
    most_steps: int = MOST_STEPS,
    *,
    real: bool = False,
) -> Refined:
    """Gauss-Newton from *poles* (n_mode,) [rad/s] and *participation* (n_mode, n_input) [1]; *real*: real
    modes.

    The noise of every element, the same at all lines, is estimated from its residual after each step.
    Equation (modal-model).
    """
    rows, largest = np.arange(participation.shape[0]), np.argmax(np.abs(participation), axis=1)
    scaled = participation / participation[rows, largest][:, None]
    # Exactly 1, which a complex quotient need not be: entries of 1 are not estimated.
    scaled[rows, largest] = 1.0
    start = np.asarray(scaled)
    state = _State.at(terms, poles, start.real + 0j if real else start, real)
    for steps in range(1, most_steps + 1):
        step, std_errors = state.step()
        if np.all(np.abs(step) <= NEGLIGIBLE * std_errors):
            return state.result(True, steps)
        moved = _move(state, step)
        if moved is None:
            return state.result(bool(np.all(np.abs(step) <= NEAR * std_errors)), steps)
        state = moved.with_noise()
    return state.result(False, most_steps)


def _move(state: _State, step: FloatArray) -> _State | None:
    before = state.chi2
    for halving in range(MOST_HALVINGS):
        other = state.after(step / 2**halving)
        if other is not None and other.chi2 < before:
            return other
    return None


@dataclass(frozen=True)
class _State:
    terms: ResidualTerms
    sums: _GramSums
    poles: ComplexArray
    participation: ComplexArray
    variance: FloatArray
    real: bool = False

    @property
    def n_mode(self) -> int:
        return int(self.poles.size)

    @classmethod
    def at(cls, terms: ResidualTerms, poles: ComplexArray, participation: ComplexArray, real: bool) -> _State:
        even, sums = np.ones(terms.lines.matrix.shape[1:]), _sums(terms, poles)
        return cls(terms, sums, poles, participation, even, real).with_noise().with_noise()

    @classmethod
    def of(cls, terms: ResidualTerms, refined: Refined, real: bool) -> _State:
        state = cls.at(terms, refined.poles, refined.participation, real)
        return replace(state, variance=refined.noise)

    def with_noise(self) -> _State:
        # Complex lines less the complex parameters that an element has for itself.
        n_per_element = self.terms.count + self.n_mode / self.participation.shape[1] / (2 if self.real else 1)
        dof = max(self.terms.lines.omega.size - n_per_element, 1.0)
        return replace(self, variance=self._rss(self._shapes()[0]) / dof)

    def after(self, step: FloatArray) -> _State | None:
        poles = self.poles + step[0 : 2 * self.n_mode : 2] + 1j * step[1 : 2 * self.n_mode : 2]
        if np.any(poles.real >= 0) or np.any(poles.imag <= 0):
            return None
        participation = self.participation.copy()
        change = step[2 * self.n_mode :]
        rows, columns = _free(self.participation)
        participation[rows, columns] += change[0::2] + 1j * change[1::2]
        return replace(self, sums=_sums(self.terms, poles), poles=poles, participation=participation)

    def _shapes(self) -> tuple[ComplexArray, FloatArray]:
        """Shapes (n_output, n_mode) of least misfit, imaginary of real modes, and the inverse of their normal
        matrices (n_output, 2 n_mode, 2 n_mode).
        """
        k, chosen = 2 * self.n_mode, slice(1, None, 2) if self.real else slice(None)
        columns = _shape_columns(self.participation)[:, :, chosen]
        single = columns.swapaxes(1, 2) @ self.sums.gram[:k, :k] @ columns
        normal = np.tensordot(1 / self.variance, single, 1)
        right_side = np.sum((self.sums.products[:k] / self.variance).transpose(2, 1, 0) @ columns, axis=0)
        scale = np.sqrt(np.einsum("omm->om", normal))
        scales = scale[:, :, None] * scale[:, None, :]
        try:
            inverse = np.linalg.inv(normal / scales)
        except np.linalg.LinAlgError:
            inverse = np.linalg.pinv(normal / scales, rcond=ROUNDING, hermitian=True)
        whole, values = np.zeros((normal.shape[0], k, k)), np.zeros((normal.shape[0], k))
        whole[:, chosen, chosen] = inverse / scales
        values[:, chosen] = np.einsum("omn,on->om", whole[:, chosen, chosen], right_side)
        return values[:, 0::2] + 1j * values[:, 1::2], whole

    def _rss(self, psi: ComplexArray) -> FloatArray:
        coefficients, sums = _coefficients(self.participation, psi), self.sums
        k = coefficients.shape[-1]
        fitted = np.einsum("oif,foi->oi", coefficients, sums.products[:k])
        square = np.sum(coefficients * (coefficients @ sums.gram[:k, :k]), axis=-1)
        return np.maximum(sums.size - 2 * fitted + square, 1e-15 * sums.size)

    @property
    def chi2(self) -> float:
        return float(np.sum(self._rss(self._shapes()[0]) / self.variance))

    def step(self) -> tuple[FloatArray, FloatArray]:
        normal, gradient, *_ = self._schur()
        inverse = pseudo_inverse(normal)
        return inverse @ gradient, np.sqrt(np.diag(inverse) / 2)

    def _schur(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, ComplexArray]:
        """Normal matrix (n, n) and gradient (n,) with the shapes eliminated, A^-1 and A^-1 B of the outputs,
        and the shapes.
        """
        psi, inverse = self._shapes()
        of_shapes = _shape_columns(self.participation)
        weight = 1 / self.variance[:, :, None, None]
        by_theta = self.theta_columns(psi)
        gram, k, n = self.sums.gram, 2 * self.n_mode, by_theta.shape[-1]
        weighted = weight * np.matmul(gram, by_theta)
        d = by_theta.reshape(-1, n).T @ weighted.reshape(-1, n)
        b = np.sum(np.matmul(of_shapes.swapaxes(1, 2), weighted[:, :, :k]), axis=1)
        residual = self.sums.products.transpose(1, 2, 0) - _coefficients(self.participation, psi) @ gram[:k]
        gradient = by_theta.reshape(-1, n).T @ (weight[..., 0] * residual).ravel()
        eliminated = inverse @ b
        return d - b.reshape(-1, n).T @ eliminated.reshape(-1, n), gradient, inverse, eliminated, psi

    def theta_columns(self, psi: ComplexArray) -> FloatArray:
        """Coefficients of all functions per parameter, (n_output, n_input, 4 n_mode, n)."""
        n_mode, n_input = self.participation.shape
        rows, columns = _free(self.participation)
        values = np.zeros((psi.shape[0], n_input, 4 * n_mode, 2 * n_mode + 2 * len(rows)))
        residue = psi[:, None, :] * self.participation.T[None]
        for mode in range(n_mode):
            # d / d Re lambda has the residue R on the squared denominators, d / d Im lambda has j R.
            at = 2 * n_mode + 2 * mode
            values[:, :, at : at + 2, 2 * mode : 2 * mode + 2] = _turn(residue[:, :, mode])
        for number, (mode, column) in enumerate(zip(rows, columns, strict=True)):
            at = 2 * n_mode + 2 * number
            values[:, column, 2 * mode : 2 * mode + 2, at : at + 2] = _turn(psi[:, mode])
        if self.real:
            # The participation is real as well.
            values[..., 2 * n_mode + 1 :: 2] = 0.0
        return values

    def result(self, converged: bool, steps: int) -> Refined:
        normal, _, inverse, eliminated, psi = self._schur()
        covariance = pseudo_inverse(normal) / 2
        crossed = -eliminated @ covariance
        shape_covariance = inverse / 2 - np.einsum("omn,opn->omp", crossed, eliminated)
        lines = self.terms.lines
        information = 2 * lines.omega.size * float(np.sum(np.log(self._rss(psi))))
        modes = self.poles, self.participation, psi, covariance, shape_covariance, crossed
        return Refined(*modes, self.variance, information, converged, steps, lines.hysteretic)


def refine_one_step(terms: ResidualTerms, refined: Refined, *, real: bool) -> Refined:
    """The refined modes one step of Gauss-Newton on, for the FRFs of *terms*; *real*: as in refine."""
    state = _State.of(terms, refined, real)
    return (state.after(state.step()[0]) or state).result(True, 1)


def remaining(terms: ResidualTerms, refined: Refined) -> ComplexArray:
    """What the modes and the terms leave of the FRFs, (n_line, n_output, n_input) [unit of the FRF]."""
    pairs = terms.remove_from(_functions(terms.lines, refined.poles))[:, : 2 * refined.poles.size]
    coefficients = _coefficients(refined.participation, refined.shapes)
    return terms.remainder - np.einsum("lf,oif->loi", pairs, coefficients)


LAGS = 8
# Lines whose residuals give the noise of the one in their middle.
AROUND = 31


def whiteness(residual: ComplexArray, correlation: tuple[complex, ...]) -> float:
    """Probability [1] of so much likeness of neighbouring lines in noise: the least p-value of the elements,
    times their number. *correlation* (n,) [1]: of the noise with the next lines, which a window gives it.

    residual (n_line, n_output, n_input): r_d = sum e_k+d conj(e_k) / sum |e|^2 of circular white noise has
    the variance 1 / n_line, so that 2 n_line sum |r_d|^2 over d = 1 ... 8 is chi-square with 16 degrees of
    freedom (portmanteau test of Box and Pierce 1970, complex form). Equation (modal-whiteness).
    """
    n_line = residual.shape[0]
    flat = _even(residual.reshape(n_line, -1))
    power = np.sum(np.abs(flat) ** 2, axis=0)
    lags = range(1, min(LAGS, n_line - 1) + 1)
    expected = [*correlation, *([0.0] * LAGS)]
    likeness = [np.sum(flat[d:] * flat[:-d].conj(), axis=0) / power - expected[d - 1] for d in lags]
    statistic = 2 * n_line / shared_power(correlation) * np.sum(np.abs(likeness) ** 2, axis=0)
    least = chi2_tail(float(np.max(statistic)), 2 * len(lags))
    return min(1.0, least * statistic.size)


def shared_power(correlation: tuple[complex, ...]) -> float:
    """1 + 2 sum |rho_d|^2 [1] of noise that lines share, *correlation* rho_d (n,) [1]."""
    return 1.0 + 2 * sum(abs(value) ** 2 for value in correlation)


def _even(flat: ComplexArray) -> ComplexArray:
    kernel = np.ones(min(AROUND, flat.shape[0]))
    counts = np.convolve(np.ones(flat.shape[0]), kernel, mode="same")
    sums = [np.convolve(column, kernel, mode="same") for column in (np.abs(flat) ** 2).T]
    around = np.stack(sums, axis=1) / counts[:, None]
    return flat / np.sqrt(np.maximum(around, np.finfo(float).tiny))


def refine_lines(terms: ResidualTerms, refined: Refined, *, real: bool = False) -> Refined:
    """The refined modes with covariances from the scatter of every line by itself, as line_scatter gives it
    for all parameters at once, with terms and shapes eliminated output by output.

    S_o: slopes by poles and participation without the shapes, r_o: residual; shares of a line in the former x
    = (N - sum_o S_o^T (I - H_o)^-1 S_o)^-1 sum_o S_o^T (I - H_o)^-1 r_o. *real*: as in refine.
    """
    lines, n_line = terms.lines, terms.lines.omega.size
    state = _State.of(terms, refined, real)
    normal, _, inverse, eliminated, psi = state._schur()
    functions, residual = terms.remove_from(_functions(lines, refined.poles)), remaining(terms, refined)
    of_psi, by_theta = _shape_columns(refined.participation), state.theta_columns(psi)
    by_terms = np.sum(np.abs(terms.basis) ** 2, axis=1)[:, None, None]

    def columns_of_output(output: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Columns by shapes, by poles and participation; these and the residual over 1 - H_o."""
        root = np.sqrt(refined.noise[output])
        of_shape, slopes, rest = (
            np.concatenate([columns.real, columns.imag], axis=1)
            for columns in (
                (functions[:, : 2 * psi.shape[1]] @ (of_psi / root[:, None, None])).swapaxes(0, 1),
                (functions @ (by_theta[output] / root[:, None, None])).swapaxes(0, 1),
                (residual[:, output] / root)[:, :, None],
            )
        )
        slopes = slopes - of_shape @ eliminated[output]
        taken = of_shape @ inverse[output] @ of_shape.swapaxes(1, 2) + by_terms * np.eye(rest.shape[1])
        return of_shape, slopes, jackknife_residual(taken, np.concatenate([slopes, rest], axis=2))

    products = np.zeros((n_line, normal.shape[0], normal.shape[0] + 1))
    for output in range(len(psi)):
        _, slopes, scatter = columns_of_output(output)
        products += slopes.swapaxes(1, 2) @ scatter
    # Real modes have no slopes by imaginary parts.
    whole = normal + np.diag(np.where(np.diag(normal) > 0, 0.0, 1.0))
    shares = np.linalg.solve(whole - products[:, :, :-1], products[:, :, -1:])
    of_outputs = []
    for output in range(len(psi)):
        of_shape, _, scatter = columns_of_output(output)
        rest = scatter[:, :, -1:] + scatter[:, :, :-1] @ shares
        of_outputs.append(
            (of_shape.swapaxes(1, 2) @ rest)[:, :, 0] @ inverse[output]
            - shares[:, :, 0] @ eliminated[output].T
        )
    root = np.sqrt(lines.shared)
    of_poles, of_shapes = root * shares[:, :, 0], root * np.array(of_outputs)
    return replace(
        refined,
        covariance=of_poles.T @ of_poles,
        crossed=of_shapes.swapaxes(1, 2) @ of_poles,
        shape_covariance=of_shapes.swapaxes(1, 2) @ of_shapes,
    )


def pseudo_inverse(normal: FloatArray) -> FloatArray:
    """The inverse of a normal matrix (n, n) [any unit] without the directions that rounding alone determines
    (two modes on one place).
    """
    diagonal = np.diag(normal)
    scale = np.sqrt(np.maximum(diagonal, ROUNDING * np.max(diagonal)))
    values, vectors = np.linalg.eigh(normal / (scale[:, None] * scale))
    keep = values > ROUNDING * values[-1]
    return (vectors[:, keep] / values[keep]) @ vectors[:, keep].T / (scale[:, None] * scale)


def _free(participation: ComplexArray) -> tuple[IntArray, IntArray]:
    """All but the 1 of each row."""
    rows, columns = np.nonzero(participation != 1)
    return rows, columns


def _functions(lines: FrfLines, poles: ComplexArray) -> ComplexArray:
    pairs = lines.functions(poles)
    columns = [np.stack([a + b, 1j * (a - b)], axis=-1).reshape(lines.omega.size, -1) for a, b in pairs]
    return np.hstack(columns) * (lines.s**lines.power * lines.weight)[:, None]


def pole_functions(s: ComplexArray, poles: ComplexArray, hysteretic: bool) -> PoleFunctions:
    """a, b (n_line, n_mode) [s] with H = sum over modes of R a + conj(R) b, and the same of dH / d lambda
    [s^2]; *s* (n_line,) [rad/s].

    b = 1 / (s - conj lambda); hysteretic modes have a = 1 / (s - lambda) - 1 / (s + lambda) and no b.
    """
    a = 1 / (s[:, None] - poles)
    if hysteretic:
        other, none = 1 / (s[:, None] + poles), np.zeros_like(a)
        return (a - other, none), (a**2 + other**2, none)
    b = 1 / (s[:, None] - poles.conj())
    return (a, b), (a**2, b**2)


def leaking_functions(
    omega: FloatArray, poles: ComplexArray, leakage: Leakage | None, hysteretic: bool
) -> PoleFunctions:
    """`pole_functions` on the lines omega (n_line,) [rad/s] with the *leakage* of random data."""
    if leakage is None:
        return pole_functions(1j * omega, poles, hysteretic)
    every = pole_functions(1j * leakage.grid[0], poles, hysteretic)
    (a, b), slopes = (tuple(leakage.average(part[:, :, None])[..., 0] for part in pair) for pair in every)
    return (a, b), (slopes[0], slopes[1])


def _sums(terms: ResidualTerms, poles: ComplexArray) -> _GramSums:
    lines = terms.lines
    functions = terms.remove_from(_functions(lines, poles))
    gram = (functions.conj().T @ functions).real
    flat = terms.remainder.reshape(lines.omega.size, -1)
    products = (functions.conj().T @ flat).real.reshape(-1, *lines.matrix.shape[1:])
    return _GramSums(gram, products, terms.size)


def _shape_columns(participation: ComplexArray) -> FloatArray:
    """Coefficients of (u, v) of every mode per Re and Im of psi, (n_input, 2 n_mode, 2 n_mode): R = psi l."""
    n_mode, n_input = participation.shape
    columns = np.zeros((n_input, 2 * n_mode, 2 * n_mode))
    for mode, factors in enumerate(participation):
        columns[:, 2 * mode : 2 * mode + 2, 2 * mode : 2 * mode + 2] = _turn(factors)
    return columns


def _turn(factor: ComplexArray) -> FloatArray:
    """Products with complex factors (...,) as real matrices (..., 2, 2)."""
    matrices = np.empty((*factor.shape, 2, 2))
    matrices[..., 0, 0] = matrices[..., 1, 1] = factor.real
    matrices[..., 1, 0] = factor.imag
    matrices[..., 0, 1] = -factor.imag
    return matrices


def _coefficients(participation: ComplexArray, psi: ComplexArray) -> FloatArray:
    """Of u, v of every mode: real and imaginary part of the residues in turn."""
    residue = psi[:, None, :] * participation.T[None]
    return np.stack([residue.real, residue.imag], axis=-1).reshape(*residue.shape[:2], -1)

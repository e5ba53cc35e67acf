"""What a fit of several coefficients states where its residual is not noise: intervals that include the model
error.

vec H = h(p) + D z + n on the lines of all FRFs: n the noise, as large as measured or larger, and D z a smooth
course of discrepancy: a in every FRF by itself (other modes), m of every response and force (gain), z of
every element of the dynamic stiffness (its law, drift), U of a stiffness that moves meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy import linalg, special

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.estimation.damping import FactorModel
from labpipe.estimation.discrepancy import AMPLITUDES, CALIBRATION, SOUND, WHITE, matern
from labpipe.estimation.leakage import SmearedModel
from labpipe.estimation.measured import Measured
from labpipe.estimation.mode_model import MOVED
from labpipe.estimation.model import DynamicModel, ReceptanceModel, compliance
from labpipe.estimation.model_error import reason_of, shares_by_cause, with_model_error
from labpipe.estimation.weights import Weights, white_columns
from labpipe.records.finding import NORMAL, Discrepancy, Parameter

# Lines below which a course cannot be told from the coefficients.
FEWEST_LINES = 4
# Numbers of all courses of one type, and functions of one course; frequencies that these are made at.
MOST_NUMBERS, MOST_FUNCTIONS, MOST_NODES = 288, 72, 100
# Lengths over the width of the band. Those that so few functions do not follow to this share are left out.
LENGTHS: Mapping[str, FloatArray] = {
    "a": np.geomspace(1 / 16, 2.0, 4),
    "m": np.array([0.25, 0.5, 1.0, 2.0]),
    "z": np.geomspace(1 / 16, 1.0, 4),
    MOVED[-2]: np.array([np.inf]),
}
FOLLOWED = 0.9
# Usual relative size [1] of a gain curve, and of an error of the dynamic stiffness over the direct ones: an
# r.m.s. beyond it is less likely. The size of a long course is told by that prior alone.
USUAL: Mapping[str, float] = {"m": 0.05, "z": 0.3}
# By what the noise may be larger than measured [1]; the first is that of a sound measurement.
LARGER = np.concatenate([[1.0], np.geomspace(1.1, 30.0, 12)])
# Weak prior around the fit, as a share of the largest coefficient of its kind, which stops run-away.
PRIOR = 0.5
# Linearisations, and the shift in standard errors of noise beyond which there is another.
LINEARISATIONS, FAR = 4, 1.0

# A course's patterns by its type: (n_line, n_output, n_input, n_pattern) [m/N] of FRFs, or whitened.
Patterns = Mapping[str, ComplexArray]


@dataclass(frozen=True)
class CoefficientError:
    """Mean (n,) and covariance (n, n) [parameter units] of the coefficients with noise and model error, and
    of *noise* alone; *shares* [1] of the evidence by type; growth: of the widest interval over noise's [1].
    """

    mean: FloatArray
    covariance: FloatArray
    noise: FloatArray
    shares: Mapping[str, float] = field(default_factory=dict)
    growth: float = 1.0

    @property
    def discrepancy(self) -> Discrepancy:
        """What explains the residual, by shares of the evidence."""
        return Discrepancy(shares_by_cause(self.shares))

    @property
    def reason(self) -> str:
        """The causes that the evidence names, in words."""
        return reason_of(self.discrepancy.shares)

    def state(
        self,
        parameters: tuple[Parameter, ...],
        reported: Callable[[FloatArray, FloatArray], tuple[Parameter, ...]],
    ) -> tuple[Parameter, ...]:
        """The parameters with intervals that include the model error; std_error is that of noise alone.
        *reported*: all parameters of a fit from values (n,) and covariance (n, n) [parameter units].
        """
        wide, noise = (
            {p.name: p for p in reported(self.mean, covariance)}
            for covariance in (self.covariance, self.noise)
        )
        return tuple(
            self._statement(p, wide[p.name], noise[p.name].std_error) if p.name in wide else p
            for p in parameters
        )

    def _statement(self, parameter: Parameter, wide: Parameter, noise: float | None) -> Parameter:
        # What has no uncertainty, such as a given coefficient, stays as it is.
        if not wide.std_error or not noise or wide.ci95 is None:
            return parameter
        # The value stays that of the fit, which others can repeat; the interval holds it and its noise.
        reach = NORMAL * noise
        low = min(wide.ci95[0], parameter.value - reach)
        high = max(wide.ci95[1], parameter.value + reach)
        full = max(wide.std_error * (high - low) / (wide.ci95[1] - wide.ci95[0]), noise)
        why = {"reason": self.reason, "discrepancy": self.discrepancy}
        return with_model_error(parameter, parameter.value, full, (low, high), noise, **why)


class Misfit(Protocol):
    """A fit whose residual is not noise, as courses are compared with it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""

    @property
    def values(self) -> FloatArray:
        """At the minimum, (n,) [parameter units]."""

    @property
    def omega(self) -> FloatArray:
        """Of the lines, (n_line,) [rad/s]."""

    def linearise(self, at: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Whitened residual (n_line, n_equation) [1] and what takes it away, (n_line, n_equation, n), at *at*
        (n,) [parameter units].
        """

    def patterns(self) -> Patterns:
        """Whitened b (n_line, n_equation, n_pattern) [1] of every type of a course."""


@dataclass(frozen=True)
class _Responses:
    """The misfit of a model of FRFs: whitened by *weights* [N/m], the variance *larger* [1] times."""

    measured: Measured
    model: ReceptanceModel
    values: FloatArray
    weights: Weights
    larger: float

    @property
    def names(self) -> tuple[str, ...]:
        return self.model.names  # type: ignore[attr-defined]

    @property
    def omega(self) -> FloatArray:
        return self.measured.omega

    def linearise(self, at: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        residual = self.measured.matrix - self.model.receptance(at, self.omega)
        jacobian = self.model.jacobian(at, self.omega).transpose(1, 2, 3, 0)
        return self._white(residual[..., None])[..., 0], self._white(jacobian)

    def _white(self, columns: ComplexArray) -> ComplexArray:
        return white_columns(self.weights, slice(None), columns) / np.sqrt(self.larger)

    def patterns(self) -> Patterns:
        parts = _patterns(self.model, self.values, self.measured)
        return {kind: self._white(part) for kind, part in parts.items()}


def coefficient_error(
    measured: Measured, model: ReceptanceModel, values: FloatArray, weights: Weights, larger: float
) -> CoefficientError | None:
    """The model error of coefficients at the minimum *values* (n,) [parameter units] of a *model* of FRFs.

    *weights* [N/m] of the noise, whose variance counts *larger* [1] times. None for too few lines, or where
    the sums have no solution. Equation (unc-coefficients).
    """
    return averaged_error(_Responses(measured, model, values, weights, larger))


def averaged_error(misfit: Misfit) -> CoefficientError | None:
    """The average over all courses; None for too few lines, or without solution."""
    if misfit.omega.size < FEWEST_LINES:
        return None
    try:
        scene = _Scene(misfit)
        mean = misfit.values
        for _ in range(LINEARISATIONS):
            error = scene.average(mean)
            shift = float(np.max(np.abs(error.mean - mean) / scene.errors))
            mean = scene.limit(error.mean)
            if shift < FAR:
                break
        return error
    except (FitError, np.linalg.LinAlgError, FloatingPointError):
        return None


@dataclass
class _Scene:
    misfit: Misfit

    def __post_init__(self) -> None:
        self.values = self.misfit.values
        residual, jacobian = self.misfit.linearise(self.values)
        self.n_equation = residual.size
        self.scale = np.sqrt(np.sum(np.abs(jacobian) ** 2, axis=(0, 1)))
        if not np.all(np.isfinite(self.scale)) or not np.all(self.scale > 0):
            raise FitError("a coefficient changes nothing")
        scaled = jacobian / self.scale
        self.errors = np.sqrt(np.diag(np.linalg.inv(2 * _real_product(scaled, scaled)))) / self.scale
        kinds = [name[:1] for name in self.misfit.names]
        sizes = list(zip(kinds, np.abs(self.values), strict=True))
        largest = {kind: max(size for k, size in sizes if k == kind) for kind in kinds}
        self.reach = PRIOR * np.array([largest[kind] for kind in kinds]) + 3 * self.errors
        self.courses = list(self._courses())

    def limit(self, mean: FloatArray) -> FloatArray:
        return self.values + np.clip(mean - self.values, -self.reach, self.reach)

    def _courses(self) -> Iterator[_ErrorCourse]:
        for kind, white in self.misfit.patterns().items():
            power = float(np.sum(np.abs(white) ** 2))
            if not power > 0 or not np.isfinite(power):
                continue
            unit = float(np.sqrt(self.n_equation / power))
            relative = unit * AMPLITUDES[1:] / USUAL.get(kind, np.inf)
            prior = special.log_softmax(-0.5 * relative**2) + np.log(1 - SOUND)
            tried = [self._functions(kind, length, white.shape[2]) for length in LENGTHS[kind]]
            kept = [functions for functions in tried if functions is not None]
            for functions in kept:
                yield _ErrorCourse.of(kind, prior - np.log(len(LENGTHS) * len(kept)), unit * white, functions)

    def _functions(self, kind: str, length: float, n_pattern: int) -> FloatArray | None:
        f = self.misfit.omega / (2 * np.pi)
        if not np.isfinite(length):
            return np.ones((f.size, 1))
        length = length * float(f[-1] - f[0])
        nodes = f if f.size <= MOST_NODES else np.linspace(f[0], f[-1], MOST_NODES)
        values, vectors = np.linalg.eigh(matern(nodes, nodes, length))
        n = int(np.clip(MOST_NUMBERS // n_pattern, 3, min(MOST_FUNCTIONS, nodes.size)))
        values, vectors = values[-n:], vectors[:, -n:]
        if np.sum(values) < FOLLOWED * nodes.size:
            return None
        kept = values > 1e-10 * values[-1]
        functions = matern(f, nodes, length) @ (vectors[:, kept] / np.sqrt(values[kept]))
        return functions if kind not in USUAL else _as_large_as_it_varies(functions)

    def average(self, at: FloatArray) -> CoefficientError:
        """The average over all courses, linearised at *at* (n,) [parameter units]."""
        residual, jacobian = self.misfit.linearise(at)
        jacobian = jacobian / self.scale
        away = (self.values - at) * self.scale
        prior = np.diag(1 / (self.reach * self.scale) ** 2)
        plain = _Sums(
            2 * _real_product(jacobian, jacobian),
            2 * _real_product(jacobian, residual[..., None])[:, 0],
            float(np.sum(np.abs(residual) ** 2)),
            residual.size,
        )
        parts = [_evidence(plain, None, prior, away, np.zeros(1))]
        # Of no course the type is that of noise where it is larger.
        names, logs = ["none", *[WHITE] * (LARGER.size - 1)], [np.full(1, np.log(SOUND))]
        columns = np.concatenate([jacobian, residual[..., None]], axis=2)
        for course in self.courses:
            parts.append(_evidence(plain, course, prior, away, AMPLITUDES[1:], course.rotate(columns)))
            names += [course.kind] * parts[-1][0].size
            logs.append(course.prior)
        evidences, shifts, spreads = zip(*parts, strict=True)
        weight = np.concatenate(
            [(log + log_prior[:, None]).ravel() for log, log_prior in zip(evidences, logs, strict=True)]
        )
        weight = np.exp(weight - special.logsumexp(weight))
        keep = weight > 1e-12
        means, covariances = np.concatenate(shifts)[keep], np.concatenate(spreads)[keep]
        weight, labels = weight[keep] / np.sum(weight[keep]), np.array(names)[keep]
        mean = weight @ means
        between = (means - mean).T @ ((means - mean) * weight[:, None])
        total = np.einsum("s,spq->pq", weight, covariances) + between
        noise = np.linalg.inv(plain.normal)
        unit = np.outer(self.scale, self.scale)
        # The total and (1.5^2 - 1) of what it exceeds the noise by.
        root = np.linalg.cholesky(noise)
        inverse = np.linalg.inv(root)
        values, vectors = np.linalg.eigh(inverse @ total @ inverse.T)
        grown = values + (CALIBRATION**2 - 1) * np.maximum(values - 1, 0.0)
        turned = root @ vectors
        covariance = (turned * grown) @ turned.T / unit
        shares = {str(label): float(np.sum(weight[labels == label])) for label in dict.fromkeys(labels)}
        growth = float(np.max(np.sqrt(np.diag(covariance * unit) / np.diag(noise))))
        return CoefficientError(at + mean / self.scale, covariance, noise / unit, shares, growth)


def _as_large_as_it_varies(functions: FloatArray) -> FloatArray:
    """Courses (n_line, n) [1] of mean square 1 whose mean over the band, which coefficients follow and no
    residual shows, is as large as their variation about it.
    """
    varying = functions - functions.mean(axis=0)
    power = float(np.mean(np.sum(varying**2, axis=1)))
    mean = np.full((len(functions), 1), np.sqrt(power))
    return np.hstack([mean, varying]) / np.sqrt(2 * power)


def _patterns(model: ReceptanceModel, values: FloatArray, measured: Measured) -> Patterns:
    """b of every type: 1 for every FRF, its row and its column of H, Z^-1 E_ab H for every a, b, motion."""
    n_line, n_output, n_input = measured.matrix.shape
    h = model.receptance(values, measured.omega)
    power = np.mean(np.abs(measured.matrix) ** 2, axis=0)
    # A mode is as large in an FRF as its response and its force make it: a product of both.
    size = np.sqrt(np.outer(np.sum(power, axis=1), np.sum(power, axis=0)) / np.sum(power))
    alone = np.zeros((n_line, n_output, n_input, n_output * n_input), np.complex128)
    gains = np.zeros((n_line, n_output, n_input, n_output + n_input), np.complex128)
    for o in range(n_output):
        gains[:, o, :, o] = h[:, o]
        for i in range(n_input):
            alone[:, o, i, o * n_input + i] = size[o, i]
            gains[:, o, i, n_output + i] = h[:, o, i]
    if n_output * n_input == 1:
        gains = gains[..., :1]
    patterns = {"a": alone, "m": gains}
    mechanics = _mechanics(model, values, measured.omega)
    if mechanics is not None and mechanics[0].shape[1] == n_output:
        inverse, stiffness = mechanics
        n = inverse.shape[1]
        # Every element as large as the direct stiffness that goes with its motion.
        stiff = np.sqrt(np.mean(np.abs(np.einsum("laa->la", np.linalg.inv(inverse))) ** 2, axis=0))
        laws = np.einsum("loa,lbi,a,b->loiab", inverse, h, np.sqrt(stiff), np.sqrt(stiff))
        patterns["z"] = laws.reshape(n_line, n_output, n_input, n * n)
        patterns[MOVED[-2]] = _move(inverse, stiffness, h)
    elif n_output * n_input == 1:
        patterns["z"] = (h**2)[..., None]
    return patterns


def _move(inverse: ComplexArray, stiffness: FloatArray, h: ComplexArray) -> ComplexArray:
    """Z^-1 K Z^-1 K H, what a stiffness leaves that moves about its mean: the whole and each direct one,
    (n_line, n_output, n_input, n_pattern) [m/N].
    """
    moving = [stiffness]
    if len(stiffness) > 1:
        moving += [np.diag(row) for row in np.diag(np.diag(stiffness))]
    parts = [inverse @ matrix @ inverse @ matrix @ h for matrix in moving]
    # Each as large as the others.
    sizes = [np.sqrt(np.mean(np.abs(part) ** 2)) for part in parts]
    return np.stack([part / size for part, size in zip(parts, sizes, strict=True) if size > 0], axis=-1)


def _mechanics(
    model: ReceptanceModel, values: FloatArray, omega: FloatArray
) -> tuple[ComplexArray, FloatArray] | None:
    """Z^-1 (n_line, n_dof, n_dof) [m/N] and K (n_dof, n_dof) [N/m] of a model that has them."""
    if isinstance(model, SmearedModel):
        model = model.model
    if isinstance(model, FactorModel):
        values, model = model.expanded_values(values), model.expanded
    if not isinstance(model, DynamicModel):
        return None
    return compliance(model, values, omega), model.whole(values).stiffness


@dataclass(frozen=True)
class _Sums:
    """J^H J (n, n), J^H r (n,), each twice its real part, r^H r, and the number of complex equations."""

    normal: FloatArray
    projected: FloatArray
    square: float
    n_equation: int


@dataclass(frozen=True)
class _ErrorCourse:
    """A course of one type, ln of its prior (n_amplitude,) [1], with eigenvalues (n_number,) and eigenvectors
    (n_number, n_number) [1] of D^H D; patterns (n_line, n_element, n_pattern), functions (n_line,
    n_function).
    """

    kind: str
    prior: FloatArray
    patterns: ComplexArray
    functions: FloatArray
    eigenvalues: FloatArray
    vectors: ComplexArray

    @classmethod
    def of(cls, kind: str, prior: FloatArray, patterns: ComplexArray, functions: FloatArray) -> _ErrorCourse:
        """D^H D is the sum over lines of (patterns by patterns) times (functions by functions)."""
        n_line, _, n_pattern = patterns.shape
        n = functions.shape[1]
        pairs = (patterns.conj().swapaxes(1, 2) @ patterns).reshape(n_line, -1)
        products = (functions[:, :, None] * functions[:, None, :]).reshape(n_line, -1)
        whole = (pairs.T @ products).reshape(n_pattern, n_pattern, n, n).transpose(0, 2, 1, 3)
        square = whole.reshape(n_pattern * n, -1)
        values, vectors = linalg.eigh(square, driver="evd", check_finite=False, overwrite_a=True)
        return cls(kind, prior, patterns, functions, np.maximum(values, 0.0), vectors)

    def rotate(self, columns: ComplexArray) -> ComplexArray:
        """D^H *columns* (n_line, n_element, n) along the eigenvectors, (n_number, n)."""
        n_line, _, n_pattern = self.patterns.shape
        n = self.functions.shape[1]
        right = (self.patterns.conj().swapaxes(1, 2) @ columns).reshape(n_line, -1)
        sides = (self.functions.T @ right).reshape(n, n_pattern, -1).swapaxes(0, 1)
        return self.vectors.conj().T @ sides.reshape(n_pattern * n, -1)


def _evidence(
    plain: _Sums,
    course: _ErrorCourse | None,
    prior: FloatArray,
    away: FloatArray,
    amplitudes: FloatArray,
    turned: ComplexArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """ln of evidence and prior (n_amplitude, n_larger) [1], shifts (n_component, n) and covariances
    (n_component, n, n), amplitudes first, of noise s^2 (I + a^2 D D^H / s^2).
    """
    a, s = (part.ravel() for part in np.meshgrid(amplitudes, LARGER, indexing="ij"))
    n = prior.shape[0]
    normal, projected = np.tile(plain.normal, (a.size, 1, 1)), np.tile(plain.projected, (a.size, 1))
    square, volume = np.full(a.size, plain.square), 2 * plain.n_equation * np.log(s)
    if course is not None and turned is not None:
        slopes, along = turned[:, :-1], turned[:, -1]
        damped = a[:, None] ** 2 / (s[:, None] ** 2 + a[:, None] ** 2 * course.eigenvalues)
        outer = (slopes.conj()[:, :, None] * slopes[:, None, :]).real.reshape(-1, n * n)
        normal = normal - 2 * (damped @ outer).reshape(-1, n, n)
        projected = projected - 2 * damped @ (slopes.conj() * along[:, None]).real
        square = square - damped @ np.abs(along) ** 2
        volume = volume + np.sum(np.log1p(a[:, None] ** 2 * course.eigenvalues / s[:, None] ** 2), axis=1)
    f = normal / s[:, None, None] ** 2 + prior
    g = projected / s[:, None] ** 2 + prior @ away
    inverse = np.linalg.inv(f)
    inverse = (inverse + inverse.swapaxes(1, 2)) / 2
    move = np.einsum("apq,aq->ap", inverse, g)
    sign, log_det = np.linalg.slogdet(f)
    log = -volume - square / s**2 - 0.5 * away @ prior @ away + 0.5 * np.sum(g * move, axis=1) - 0.5 * log_det
    usable = (sign > 0) & np.isfinite(log) & np.all(np.einsum("app->ap", inverse) > 0, axis=1)
    log = np.where(usable, log, -np.inf) + np.log(np.where(s == 1, SOUND, (1 - SOUND) / (LARGER.size - 1)))
    return log.reshape(amplitudes.size, LARGER.size), move, inverse


def _real_product(first: ComplexArray, second: ComplexArray) -> FloatArray:
    left, right = (part.reshape(-1, part.shape[-1]) for part in (first, second))
    return (left.conj().T @ right).real

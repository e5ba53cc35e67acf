"""A transfer function by zeros, poles and gain, of s or of z; from polynomials, from filters, and from objects of other packages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError

# Size below which the leading coefficients of a polynomial are rounding, against its largest.
ROUNDING = 1e-14
# Inverse of a zero, in units of the matrices, below which it lies at infinity.
INFINITE = 1e-10


@dataclass(frozen=True)
class Transfer:
    """G = gain * prod(v - zeros) / prod(v - poles), v = s [rad/s], or with a sampling *rate* [Hz] v = z = e^{s / rate} [1]."""

    zeros: tuple[complex, ...] = ()
    poles: tuple[complex, ...] = ()
    gain: float = 1.0
    rate: float | None = None

    def response(self, omega: FloatArray) -> ComplexArray:
        """G at *omega* [rad/s], (n_line,) [1]; infinite at a pole."""
        s: ComplexArray = 1j * np.asarray(omega)
        v = s if self.rate is None else np.exp(s / self.rate)
        total = np.full(v.shape, self.gain, np.complex128)
        # Factor by factor: the product of all zeros alone may exceed what numbers hold.
        with np.errstate(divide="ignore", invalid="ignore"):
            for number in range(max(len(self.zeros), len(self.poles))):
                total = total * (v - self.zeros[number]) if number < len(self.zeros) else total
                total = total / (v - self.poles[number]) if number < len(self.poles) else total
        return total

    @property
    def at_rest(self) -> float:
        """G(0) [1]; infinite for an integrator."""
        value = complex(self.response(np.zeros(1))[0])
        return value.real if np.isfinite(value) else float("inf")

    def times(self, other: Transfer) -> Transfer:
        """Both in series; they must be of one variable."""
        return Transfer(self.zeros + other.zeros, self.poles + other.poles, self.gain * other.gain, self.rate)


def of_polynomials(numerator: ArrayLike, denominator: ArrayLike, rate: float | None = None) -> Transfer:
    """From coefficients in descending powers of s or z; ConfigError for a denominator that is zero."""
    above, below = _trimmed(numerator), _trimmed(denominator)
    if not below.size:
        raise ConfigError("denominator: is zero", hint="coefficients in descending powers, for example [1, 20, 100]", field="denominator")
    if not above.size:
        return Transfer((), (), 0.0, rate)
    return Transfer(_roots(above), _roots(below), float(above[0] / below[0]), rate)


def _trimmed(coefficients: ArrayLike) -> FloatArray:
    """Without leading zeros and what rounding has left of them."""
    values = np.atleast_1d(np.asarray(coefficients, float))
    large = np.flatnonzero(np.abs(values) > ROUNDING * np.max(np.abs(values), initial=0.0))
    return values[large[0] :] if large.size else np.empty(0)


def _roots(coefficients: FloatArray) -> tuple[complex, ...]:
    return tuple(complex(root) for root in np.roots(coefficients))


def lead_lag(zero: float, pole: float) -> Transfer:
    """(1 + s / w_z) / (1 + s / w_p) of corner frequencies [Hz]."""
    ahead, behind = 2 * np.pi * zero, 2 * np.pi * pole
    return Transfer((-ahead,), (-behind,), behind / ahead)


def low_pass(frequency: float, order: int, damping: float) -> Transfer:
    """1 / (1 + s / w), or w^2 / (s^2 + 2 d w s + w^2) for order 2; *frequency* [Hz]."""
    omega = 2 * np.pi * frequency
    if order == 1:
        return Transfer((), (-omega,), omega)
    return Transfer((), _pair(omega, damping), omega**2)


def notch(frequency: float, depth: float, width: float) -> Transfer:
    """(s^2 + 2 d w s + w^2) / (s^2 + 2 D w s + w^2), d = depth D: |G| = *depth* at *frequency* [Hz], *width* 2 D of it at -3 dB."""
    omega = 2 * np.pi * frequency
    return Transfer(_pair(omega, depth * width / 2), _pair(omega, width / 2), 1.0)


def pid(proportional: float, integral: float, derivative: float, time: float) -> Transfer:
    """k_p + k_i / s + k_d s / (1 + s T_d) of k_p [1], k_i [1/s], k_d [s], T_d [s]."""
    above = np.array([proportional * time + derivative, proportional + integral * time, integral])
    below = np.array([time, 1.0, 0.0])
    # Without an integral, zero and pole at s = 0 are left out together.
    return of_polynomials(above[:2], below[:2]) if integral == 0 else of_polynomials(above, below)


def _pair(omega: float, damping: float) -> tuple[complex, complex]:
    """Roots of s^2 + 2 d w s + w^2."""
    root = np.sqrt(complex(damping**2 - 1))
    return complex(omega * (-damping + root)), complex(omega * (-damping - root))


def matrix_of(system: Any) -> list[list[Transfer]]:
    """Elements [output][input] of a system of another package, known by its attributes: num and den, zeros, poles and gain, or A, B, C, D.

    Takes what python-control and scipy.signal call TransferFunction, StateSpace and ZerosPolesGain. ConfigError for other objects, and for
    a discrete system whose sampling time is not known.
    """
    rate = _rate_of(getattr(system, "dt", None))
    if all(hasattr(system, name) for name in ("num", "den")):
        above, below = _nested(system.num), _nested(system.den)
        return [[of_polynomials(n, d, rate) for n, d in zip(*pair, strict=True)] for pair in zip(above, below, strict=True)]
    if all(hasattr(system, name) for name in "ABCD"):
        a, b, c, d = (np.atleast_2d(np.asarray(getattr(system, name), float)) for name in "ABCD")
        return _of_states(a, b, c, d, rate)
    if all(hasattr(system, name) for name in ("zeros", "poles", "gain")) and not callable(system.zeros):
        zeros, poles = (tuple(complex(root) for root in np.atleast_1d(getattr(system, name))) for name in ("zeros", "poles"))
        return [[Transfer(zeros, poles, float(system.gain), rate)]]
    raise ConfigError(f"a {type(system).__name__} is no transfer function", hint="num and den, zeros, poles and gain, or A, B, C and D")


def _rate_of(interval: Any) -> float | None:
    """Sampling rate [Hz] of a sampling time [s]; None and 0 are of continuous systems."""
    if interval is None or (not isinstance(interval, bool) and interval == 0):
        return None
    if isinstance(interval, bool):
        raise ConfigError("a discrete transfer function has no sampling time", hint="give dt in seconds")
    return 1 / float(interval)


def _nested(polynomials: Any) -> list[list[ArrayLike]]:
    """Coefficients [output][input]; a single polynomial as one element."""
    single = np.ndim(polynomials[0]) == 0
    return [[polynomials]] if single else [list(row) for row in polynomials]


def _of_states(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, rate: float | None) -> list[list[Transfer]]:
    columns = range(d.shape[1])
    return [[_element(a, b[:, [column]], c[[row]], d[[row]][:, [column]], rate) for column in columns] for row in range(d.shape[0])]


def _element(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, rate: float | None) -> Transfer:
    """Zeros by the pencil [[A - z I, B], [C, D]], poles of A, and the gain by the value at a point away from both."""
    n = len(a)
    poles = np.linalg.eigvals(a) if n else np.empty(0)
    shift = np.zeros((n + 1, n + 1))
    shift[:n, :n] = np.eye(n)
    above, below = linalg.eigvals(np.block([[a, b], [c, d]]), shift, homogeneous_eigvals=True)
    finite = np.abs(below) > INFINITE * np.abs(above)
    zeros = above[finite] / below[finite]
    point = 1 + 2 * float(np.max(np.abs(np.concatenate([poles, zeros])), initial=0.0))
    value = float((c @ np.linalg.solve(point * np.eye(n) - a, b) + d)[0, 0]) if n else float(d[0, 0])
    gain = float(np.real(value * np.prod(point - poles) / np.prod(point - zeros)))
    return Transfer(tuple(map(complex, zeros)), tuple(map(complex, poles)), gain, rate) if value else Transfer(gain=0.0, rate=rate)

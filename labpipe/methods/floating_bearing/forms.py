"""Forms of a dynamic stiffness over frequency: H(w) = sum_k g_k(w; theta) M_k with real matrices M_k and few
shape parameters theta.

All are linear in the matrices; theta is what the functions g_k know beside the frequency: a relaxation time,
the natural frequency of a pad. Positive shape parameters are fitted as their logarithms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import SettingError

STIFFNESS, DAMPING, MASS = "N/m", "N.s/m", "kg"
KC = (("k", STIFFNESS), ("c", DAMPING))
KCM = (*KC, ("m", MASS))
PAD = (("k_p", STIFFNESS), ("c_p", DAMPING))
# Most bands of a form with coefficients of their own in each.
MOST_BANDS = 24

Course = Callable[[FloatArray, FloatArray], ComplexArray]


@dataclass(frozen=True)
class ShapeParameter:
    """A parameter of the course over frequency; *logarithmic*: fitted as ln(factor * value), value in
    *unit*.
    """

    name: str
    unit: str
    factor: float = 1.0
    logarithmic: bool = True

    def show(self, inner: float) -> float:
        """The value in its unit of the fitted number."""
        return float(np.exp(inner)) / self.factor if self.logarithmic else float(inner)

    def slope(self, inner: float) -> float:
        """d shown / d inner."""
        return self.show(inner) if self.logarithmic else 1.0


@dataclass(frozen=True)
class Form:
    """One form: *matrices* (letter, unit) of the M_k, *shape* parameters theta, and what is needed of the
    g_k. basis(theta, omega): (n_matrix, n_line) of theta (n_shape,), omega (n_line,) [rad/s]; slopes(theta,
    omega): (n_shape, n_matrix, n_line); starts(omega): theta to begin with, (n_start, n_shape). *bands*:
    edges [Hz] of a form that has coefficients of its own in each.
    """

    name: str
    matrices: tuple[tuple[str, str], ...]
    basis: Course
    shape: tuple[ShapeParameter, ...] = ()
    slopes: Course = lambda _theta, omega: np.empty((0, 0, omega.size), np.complex128)
    starts: Callable[[FloatArray], FloatArray] = lambda _omega: np.empty((1, 0))
    bands: tuple[float, ...] = field(default=())


def _kc(_theta: FloatArray, omega: FloatArray) -> ComplexArray:
    return np.stack([np.ones_like(omega), 1j * omega])


def _kcm(_theta: FloatArray, omega: FloatArray) -> ComplexArray:
    return np.stack([np.ones_like(omega), 1j * omega, -(omega**2)])


def _relaxation(theta: FloatArray, omega: FloatArray) -> ComplexArray:
    s = 1j * omega * np.exp(theta[0])
    return np.stack([np.ones_like(omega), 1j * omega, s / (1 + s)])


def _relaxation_slopes(theta: FloatArray, omega: FloatArray) -> ComplexArray:
    s = 1j * omega * np.exp(theta[0])
    zero = np.zeros_like(s)
    return np.stack([zero, zero, s / (1 + s) ** 2])[None]


def _reduced_response(theta: FloatArray, omega: FloatArray) -> tuple[ComplexArray, ComplexArray, float]:
    """1 / (1 + 2 zeta s / w_0 + s^2 / w_0^2), s / w_0 and 2 zeta of theta = (ln w_0, ln zeta)."""
    s, damping = 1j * omega / np.exp(theta[0]), 2 * np.exp(theta[1])
    return 1 / (1 + damping * s + s**2), s, damping


def _pad(theta: FloatArray, omega: FloatArray) -> ComplexArray:
    s = 1j * omega
    reduced = _reduced_response(theta, omega)[0]
    return np.stack([np.ones_like(s), s, reduced, s * reduced])


def _pad_slopes(theta: FloatArray, omega: FloatArray) -> ComplexArray:
    reduced, turned, damping = _reduced_response(theta, omega)
    changes = reduced**2 * (damping * turned + 2 * turned**2), -(reduced**2) * damping * turned
    s, zero = 1j * omega, np.zeros_like(omega, np.complex128)
    return np.stack([np.stack([zero, zero, change, s * change]) for change in changes])


def _rational(theta: FloatArray, omega: FloatArray) -> ComplexArray:
    return np.concatenate([_pad(theta, omega), -(omega[None] ** 2)])


def _rational_slopes(theta: FloatArray, omega: FloatArray) -> ComplexArray:
    return np.concatenate([_pad_slopes(theta, omega), np.zeros((2, 1, omega.size))], axis=1)


def _fractional(theta: FloatArray, omega: FloatArray) -> ComplexArray:
    return np.stack([np.ones_like(omega), (1j * omega / (2 * np.pi)) ** theta[0]])


def _fractional_slopes(theta: FloatArray, omega: FloatArray) -> ComplexArray:
    s = 1j * omega / (2 * np.pi)
    return np.stack([np.zeros_like(s), s ** theta[0] * np.log(s)])[None]


def _times(omega: FloatArray) -> FloatArray:
    return np.log(1 / np.geomspace(omega[0] / 2, 2 * omega[-1], 9))[:, None]


def _oscillators(omega: FloatArray) -> FloatArray:
    frequencies, dampings = np.geomspace(omega[0] / 1.5, 3 * omega[-1], 9), [0.05, 0.2, 0.5, 1.0, 2.5]
    return np.log(np.stack(np.meshgrid(frequencies, dampings), axis=-1)).reshape(-1, 2)


def _powers(_omega: FloatArray) -> FloatArray:
    return np.array([0.2, 0.4, 0.6, 0.8, 0.95, 1.2, 1.6])[:, None]


TIME = ShapeParameter("tau_r", "s")
OSCILLATOR = (ShapeParameter("f_p", "Hz", 2 * np.pi), ShapeParameter("zeta_p", "1"))
FORMS = {
    "kc": Form("kc", KC, _kc),
    "kcm": Form("kcm", KCM, _kcm),
    "relaxation": Form(
        "relaxation", (*KC, ("k_r", STIFFNESS)), _relaxation, (TIME,), _relaxation_slopes, _times
    ),
    "pad": Form("pad", (*KC, *PAD), _pad, OSCILLATOR, _pad_slopes, _oscillators),
    "rational": Form(
        "rational", (*KC, *PAD, ("m", MASS)), _rational, OSCILLATOR, _rational_slopes, _oscillators
    ),
    "fractional": Form(
        "fractional",
        (("k", STIFFNESS), ("k_f", STIFFNESS)),
        _fractional,
        (ShapeParameter("alpha", "1", logarithmic=False),),
        _fractional_slopes,
        _powers,
    ),
}
BANDS = "bands"
NAMES = (*FORMS, BANDS)


def banded_form(edges: FloatArray) -> Form:
    """K and C with values of their own in every band between neighbouring *edges* (n_band + 1,) [Hz]."""
    numbers = range(1, edges.size)
    if len(numbers) > MOST_BANDS:
        hint = f"{MOST_BANDS} at most: widen `band_width`"
        raise SettingError("band_width", f"{len(numbers)} bands are too many", hint)

    def basis(_theta: FloatArray, omega: FloatArray) -> ComplexArray:
        place = np.clip(np.searchsorted(2 * np.pi * edges, omega, side="right") - 1, 0, edges.size - 2)
        inside = (place == np.arange(edges.size - 1)[:, None]).astype(float)
        return np.concatenate([inside, 1j * omega * inside])

    matrices = (*((f"k{n}", STIFFNESS) for n in numbers), *((f"c{n}", DAMPING) for n in numbers))
    return Form(BANDS, matrices, basis, bands=tuple(float(edge) for edge in edges))


_UNIT = np.eye(4).reshape(4, 2, 2)
# How the elements of every matrix depend on each other: (suffix, what one unit of it puts into the matrix), x
# to y with the rotation.
SYMMETRIES: dict[str, tuple[tuple[str, FloatArray], ...]] = {
    "none": (("xx", _UNIT[0]), ("xy", _UNIT[1]), ("yx", _UNIT[2]), ("yy", _UNIT[3])),
    "seal": (("xx", _UNIT[0] + _UNIT[3]), ("xy", _UNIT[1] - _UNIT[2])),
    "direct": (("xx", _UNIT[0]), ("yy", _UNIT[3])),
    "isotropic": (("xx", _UNIT[0] + _UNIT[3]),),
}
_ELEMENTS = {name: np.stack([matrix for _, matrix in elements]) for name, elements in SYMMETRIES.items()}


@dataclass(frozen=True)
class StiffnessModel:
    """A form with a symmetry. Parameters: the elements of every matrix, matrix by matrix, then the shape
    parameters as they are fitted.
    """

    form: Form
    symmetry: str

    @property
    def elements(self) -> FloatArray:
        """(n_element, 2, 2) [1]: the place of every element of a matrix."""
        return _ELEMENTS[self.symmetry]

    @property
    def names(self) -> tuple[str, ...]:
        suffixes = [suffix for suffix, _ in SYMMETRIES[self.symmetry]]
        linear = [_element_name(letter, suffix) for letter, _ in self.form.matrices for suffix in suffixes]
        return (*linear, *(parameter.name for parameter in self.form.shape))

    @property
    def units(self) -> tuple[str, ...]:
        linear = [unit for _, unit in self.form.matrices for _ in self.elements]
        return (*linear, *(parameter.unit for parameter in self.form.shape))

    @property
    def n_shape(self) -> int:
        return len(self.form.shape)

    @property
    def n_linear(self) -> int:
        return len(self.form.matrices) * len(self.elements)

    def matrices(self, values: FloatArray) -> FloatArray:
        """The M_k (n_matrix, 2, 2) [N/m, N.s/m, kg] of values (n_parameter,)."""
        of_matrices = values[: self.n_linear].reshape(len(self.form.matrices), -1)
        return (of_matrices @ self.elements.reshape(-1, 4)).reshape(-1, 2, 2)

    def stiffness(self, values: FloatArray, omega: FloatArray) -> ComplexArray:
        """H(w) [N/m], (n_line, 2, 2), of values (n_parameter,) at omega (n_line,) [rad/s].

        Equation (ds-form).
        """
        basis = self.form.basis(values[self.n_linear :], omega)
        return (basis.T @ self.matrices(values).reshape(-1, 4)).reshape(-1, 2, 2)

    def jacobian(self, values: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp [N/m per parameter unit], (n_parameter, n_line, 2, 2)."""
        theta, elements = values[self.n_linear :], self.elements
        basis = self.form.basis(theta, omega)
        linear = (basis[:, None, :, None, None] * elements[None, :, None]).reshape(
            self.n_linear, omega.size, 2, 2
        )
        if not self.n_shape:
            return linear
        slopes = self.form.slopes(theta, omega)
        shaped = np.tensordot(slopes.transpose(0, 2, 1), self.matrices(values), 1)
        return np.concatenate([linear, shaped])


def _element_name(letter: str, suffix: str) -> str:
    plain = letter.rstrip("0123456789")
    return f"{plain}_{suffix}_{letter.removeprefix(plain)}".rstrip("_")

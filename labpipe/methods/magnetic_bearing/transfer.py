"""Transfer functions by zeros, poles and gain, and the blocks of a controller as a bearing file has them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.quantities import UnitError
from labpipe.records.settings import Settings, choice, integer, quantity, setting

# Size of a zero over that of the largest pole beyond which its coefficient is rounding.
FAR = 1e12
# Markov parameter over the largest, in units of the poles, that is rounding; accuracy of a conversion.
VANISHED, SAME = 1e-10, 1e-6


@dataclass(frozen=True)
class Transfer:
    """G = gain prod(v - zeros) / prod(v - poles), v = s [rad/s], or with *rate* [Hz] z = e^{s / rate} [1]."""

    zeros: tuple[complex, ...] = ()
    poles: tuple[complex, ...] = ()
    gain: float = 1.0
    rate: float | None = None

    def response(self, omega: FloatArray) -> ComplexArray:
        """G at *omega* [rad/s], (n_line,) [1]; infinite at a pole."""
        s = 1j * np.asarray(omega)
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
        """Both in series."""
        return Transfer(self.zeros + other.zeros, self.poles + other.poles, self.gain * other.gain, self.rate)


def transfer_of_polynomials(
    numerator: ArrayLike, denominator: ArrayLike, rate: float | None = None
) -> Transfer:
    """From coefficients in descending powers of s or z; ConfigError for a denominator that is zero."""
    above, below = (
        np.trim_zeros(np.atleast_1d(np.asarray(power, float)), "f") for power in (numerator, denominator)
    )
    if not below.size:
        hint = "coefficients in descending powers, for example [1, 20, 100]"
        raise SettingError("denominator", "denominator: is zero", hint)
    poles = np.roots(below)
    above = _drop_rounding(above, float(np.max(np.abs(poles), initial=0.0)))
    if not above.size:
        return Transfer((), (), 0.0, rate)
    zeros = tuple(map(complex, np.roots(above)))
    return Transfer(zeros, tuple(map(complex, poles)), float(above[0] / below[0]), rate)


def _drop_rounding(coefficients: FloatArray, largest: float) -> FloatArray:
    """Without leading coefficients, left by rounding, that make zeros far beyond the *largest* pole."""
    while coefficients.size > 1 and abs(coefficients[1]) > FAR * largest * abs(coefficients[0]) > 0:
        coefficients = coefficients[1:]
    return coefficients


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
    """(s^2 + 2 d w s + w^2) / (s^2 + 2 D w s + w^2), d = depth D; *frequency* [Hz], *width* 2 D at -3 dB."""
    omega = 2 * np.pi * frequency
    return Transfer(_pair(omega, depth * width / 2), _pair(omega, width / 2), 1.0)


def pid(proportional: float, integral: float, derivative: float, time: float) -> Transfer:
    """k_p + k_i / s + k_d s / (1 + s T_d) of k_p [1], k_i [1/s], k_d [s], T_d [s]."""
    above = np.array([proportional * time + derivative, proportional + integral * time, integral])
    below = np.array([time, 1.0, 0.0])
    # Without an integral, zero and pole at s = 0 are left out together.
    return (
        transfer_of_polynomials(above[:2], below[:2])
        if integral == 0
        else transfer_of_polynomials(above, below)
    )


def _pair(omega: float, damping: float) -> tuple[complex, complex]:
    root = np.sqrt(complex(damping**2 - 1))
    return complex(omega * (-damping + root)), complex(omega * (-damping - root))


def matrix_of(system: Any) -> list[list[Transfer]]:
    """Elements [output][input] of a system of another package, known by its attributes: num and den, zeros,
    poles and gain, or A, B, C, D.

    Takes what python-control and scipy.signal call TransferFunction, StateSpace and ZerosPolesGain.
    ConfigError for other objects, and for a discrete system whose sampling time is not known.
    """
    rate = _rate_of(getattr(system, "dt", None))
    if all(hasattr(system, name) for name in ("num", "den")):
        single = np.isscalar(system.num[0])
        above, below = ([[part]] if single else part for part in (system.num, system.den))
        pairs = zip(above, below, strict=True)
        return [[transfer_of_polynomials(n, d, rate) for n, d in zip(*pair, strict=True)] for pair in pairs]
    if all(hasattr(system, name) for name in "ABCD"):
        a, b, c, d = (np.atleast_2d(np.asarray(getattr(system, name), float)) for name in "ABCD")
        rows, columns = (range(n) for n in d.shape)
        return [[_element(a, b[:, [j]], c[[i]], d[[i]][:, [j]], rate) for j in columns] for i in rows]
    if all(hasattr(system, name) for name in ("zeros", "poles", "gain")) and not callable(system.zeros):
        zeros, poles = (
            tuple(map(complex, np.atleast_1d(getattr(system, name)))) for name in ("zeros", "poles")
        )
        return [[Transfer(zeros, poles, float(system.gain), rate)]]
    hint = "num and den, zeros, poles and gain, or A, B, C and D"
    raise ConfigError(f"a {type(system).__name__} is not a transfer function", hint=hint)


def _rate_of(interval: Any) -> float | None:
    if isinstance(interval, bool):
        raise ConfigError("a discrete transfer function has no sampling time", hint="give dt in seconds")
    return 1 / float(interval) if interval else None


def _element(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, rate: float | None) -> Transfer:
    """Zeros by the pencil [[A - z I, B], [C, D]], poles of A, and the gain by the first Markov parameter D, C
    B, C A B, ... that is none. As many zeros are infinite as parameters vanish before it; ConfigError where
    rounding does not let the others be told.
    """
    n, alone = len(a), Transfer(gain=float(d[0, 0]), rate=rate)
    if not n:
        return alone
    balanced, turn = linalg.matrix_balance(a)
    inward, outward = np.linalg.solve(turn, b), c @ turn
    poles = np.linalg.eigvals(balanced)
    unit, size = float(np.max(np.abs(poles))) or 1.0, float(np.linalg.norm(inward) * np.linalg.norm(outward))
    if size == 0:
        return alone
    scaled, inward = balanced / unit, inward / np.linalg.norm(inward)
    outward, through = outward / np.linalg.norm(outward), d * unit / size
    powers = (outward @ np.linalg.matrix_power(scaled, k) @ inward for k in range(n))
    markov = [float(value[0, 0]) for value in (through, *powers)]
    if not np.any(markov[1:]):
        # The states that the input moves are none that the output sees.
        return alone
    first = next(k for k, value in enumerate(markov) if abs(value) > VANISHED * max(map(abs, markov)))
    shift = np.diag([*np.ones(n), 0.0])
    pencil = np.block([[scaled, inward], [outward, through]])
    above, below = linalg.eigvals(pencil, shift, homogeneous_eigvals=True)
    length = np.maximum(np.hypot(np.abs(above), np.abs(below)), np.finfo(float).tiny)
    nearest = np.argsort(-np.abs(below) / length)[: n - first]
    zeros = unit * above[nearest] / below[nearest]
    gain = markov[first] * size * unit ** (first - 1)
    for share in (0.01, 0.3, 3.0):
        point = share * unit * (0.3 + 1j)
        exact = complex((c @ np.linalg.solve(point * np.eye(n) - a, b) + d)[0, 0])
        if abs(gain * np.prod(point - zeros) / np.prod(point - poles) - exact) > SAME * abs(exact):
            hint = "give zeros, poles and gain, or filters"
            raise ConfigError("the zeros of a state space cannot be told from rounding", hint=hint)
    return Transfer(tuple(map(complex, zeros)), tuple(map(complex, poles)), gain, rate)


# Relative distance at which two roots are conjugate.
CONJUGATE = 1e-6


@dataclass(frozen=True)
class BlockForm:
    """Entries that a block of the form *needs* and those it *takes* beside, and its transfer function."""

    needs: tuple[str, ...]
    takes: tuple[str, ...]
    transfer: Callable[..., Transfer]


def _checked_roots(
    zeros: tuple[complex, ...], poles: tuple[complex, ...], gain: float, rate: float | None
) -> Transfer:
    for name, given in (("zeros", zeros), ("poles", poles)):
        roots = np.array(given, np.complex128)
        for root in roots:
            same, others = (
                np.sum(np.abs(roots - other) <= CONJUGATE * abs(root)) for other in (root, root.conjugate())
            )
            if same != others:
                hint = f"write {root.real:g} +- {abs(root.imag):g}j for the pair"
                raise SettingError(name, f"{name}: {root:g} stands without its conjugate", hint)
    return Transfer(zeros, poles, gain, rate)


FORMS: dict[str, BlockForm] = {
    "roots": BlockForm((), ("zeros", "poles", "gain", "rate"), _checked_roots),
    "polynomial": BlockForm(("numerator", "denominator"), ("rate",), transfer_of_polynomials),
    "pid": BlockForm((), ("proportional", "integral", "derivative", "derivative_time"), pid),
    "lead-lag": BlockForm(("zero", "pole"), (), lead_lag),
    "low-pass": BlockForm(("frequency",), ("order", "damping"), low_pass),
    "notch": BlockForm(("frequency",), ("depth", "width"), notch),
    "gain": BlockForm((), ("gain",), lambda gain: Transfer(gain=gain)),
}


@dataclass(frozen=True, kw_only=True)
class ControllerBlock(Settings):
    """One block of a controller in series with the others."""

    form: str = choice("what the block is given by", tuple(FORMS))
    zeros: tuple[complex, ...] = setting(
        "roots", "roots: of the numerator, [rad/s]; with a rate of z, [1]", default=()
    )
    poles: tuple[complex, ...] = setting(
        "roots", "roots: of the denominator, [rad/s]; with a rate of z, [1]", default=()
    )
    gain: float = quantity("roots: factor before (s - zeros) / (s - poles); gain: the gain", "1", 1.0)
    numerator: tuple[float, ...] = setting(
        "values", "polynomial: coefficients in descending powers of s, or z", "1", ()
    )
    denominator: tuple[float, ...] = setting(
        "values", "polynomial: coefficients in descending powers of s, or z", "1", ()
    )
    rate: float | None = quantity(
        "roots, polynomial: sampling rate, which makes them functions of z", "Hz", None
    )
    proportional: float = quantity("pid: proportional gain", "1", 0.0)
    integral: float = quantity("pid: gain of the integral", "1/s", 0.0)
    derivative: float = quantity("pid: gain of the derivative", "s", 0.0)
    derivative_time: float = quantity("pid: time constant of the differentiator", "s", 0.0)
    zero: float | None = quantity("lead-lag: corner frequency of the numerator", "Hz", None)
    pole: float | None = quantity("lead-lag: corner frequency of the denominator", "Hz", None)
    frequency: float | None = quantity("low-pass: corner; notch: centre", "Hz", None)
    order: int = integer("low-pass: 1 or 2", 1)
    damping: float = quantity("low-pass of order 2: damping ratio", "1", 2**-0.5)
    depth: float = quantity("notch: gain at the centre", "1", 0.0)
    width: float = quantity("notch: width at -3 dB over the centre frequency", "1", 0.2)

    def __post_init__(self) -> None:
        form = FORMS[self.form]
        for name, declared in self.__dataclass_fields__.items():
            given = name in self.written
            if name in form.needs and not given:
                hint = declared.metadata["setting"].help
                raise ConfigError(f"{name}: is missing for the form {self.form}", hint=hint)
            if given and name not in (*form.needs, *form.takes, "form"):
                hint = f"{self.form} takes {', '.join((*form.needs, *form.takes))}"
                raise SettingError(name, f"{name}: is not for the form {self.form}", hint)
        self.require_positive("zero", "pole", "frequency", "rate", "width")
        self.require_not_negative("depth", "damping", "derivative_time")
        if self.order not in (1, 2):
            hint = "two blocks for more"
            raise SettingError("order", f"order: a low-pass has order 1 or 2, not {self.order}", hint)
        if self.order == 1 and "damping" in self.written:
            what = "damping: is for a low-pass of order 2"
            raise SettingError("damping", what, "order: 2, or leave it out")
        _ = self.transfer

    @property
    def transfer(self) -> Transfer:
        """G(s), or G(z) with a rate."""
        form = FORMS[self.form]
        return form.transfer(*(getattr(self, name) for name in (*form.needs, *form.takes)))

    @classmethod
    def entries_from(cls, value: Any) -> Any:
        """Blocks as they are, or from a one-input one-output system of python-control or scipy.signal."""
        if isinstance(value, (str, Sequence)):
            return value
        try:
            elements = matrix_of(value)
        except ConfigError as error:
            raise UnitError(error.what, error.hint) from None
        if len(elements) != 1 or len(elements[0]) != 1:
            hint = "labpipe.methods.magnetic_bearing.transfer.blocks_of_matrix takes a matrix"
            raise UnitError("a controller of one direction has one input and one output", hint)
        return (block_of(elements[0][0]),)


def block_of(transfer: Transfer) -> ControllerBlock:
    """The transfer function as a block of zeros and poles."""
    return ControllerBlock(
        form="roots", zeros=transfer.zeros, poles=transfer.poles, gain=transfer.gain, rate=transfer.rate
    )


def blocks_of_matrix(system: Any) -> dict[str, tuple[ControllerBlock, ...]]:
    """Elements xx, xy, yx and yy of a two-input two-output system; ConfigError for others."""
    elements = matrix_of(system)
    if len(elements) != 2 or any(len(row) != 2 for row in elements):
        raise ConfigError("a controller of two directions has two inputs and two outputs")
    return {
        f"{o}{i}": (block_of(element),)
        for o, row in zip("xy", elements, strict=True)
        for i, element in zip("xy", row, strict=True)
    }


@dataclass(frozen=True, kw_only=True)
class CrossControl(Settings):
    """Elements of a controller matrix beside that of x by x: *xy* is output x by input y."""

    xy: tuple[ControllerBlock, ...] = setting(
        "entries", "output x by input y", section=ControllerBlock, default=()
    )
    yx: tuple[ControllerBlock, ...] = setting(
        "entries", "output y by input x", section=ControllerBlock, default=()
    )
    yy: tuple[ControllerBlock, ...] = setting(
        "entries", "output y by input y; default: as x by x", section=ControllerBlock, default=()
    )


def rate_of(blocks: Iterable[ControllerBlock]) -> float | None:
    """The sampling rate [Hz] of the discrete blocks, None without one; ConfigError for two rates."""
    rates = sorted({block.rate for block in blocks if block.rate is not None})
    if len(rates) > 1:
        what = f"controller: blocks at {rates[0]:g} Hz and {rates[1]:g} Hz cannot be in one loop"
        raise SettingError("controller", what)
    return rates[0] if rates else None


@lru_cache(maxsize=64)
def connect_series(blocks: tuple[ControllerBlock, ...]) -> tuple[Transfer, Transfer]:
    """All blocks in series: those of s, and those of z, which are 1 where there are none."""
    continuous, discrete = Transfer(), Transfer(rate=rate_of(blocks))
    for part in (block.transfer for block in blocks):
        if part.rate is None:
            continuous = continuous.times(part)
        else:
            discrete = discrete.times(part)
    return continuous, discrete

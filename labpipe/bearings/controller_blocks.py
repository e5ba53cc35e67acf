"""Blocks of a controller in series as a bearing file has them. FORMS by name: the entries that a block needs, and its transfer function."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe.bearings.transfer import Transfer, lead_lag, low_pass, matrix_of, notch, of_polynomials, pid
from labpipe.errors import ConfigError
from labpipe.quantities import UnitError
from labpipe.records.settings import Settings, setting

# Relative distance at which two roots are conjugate.
CONJUGATE = 1e-6


@dataclass(frozen=True)
class Form:
    """Entries that a block of the form *needs* and those that it *takes* beside them, and its transfer function."""

    needs: tuple[str, ...]
    takes: tuple[str, ...]
    transfer: Callable[[Any], Transfer]


def _checked_roots(block: ControllerBlock) -> Transfer:
    for name in ("zeros", "poles"):
        roots = np.array(getattr(block, name), np.complex128)
        lonely = [root for root in roots if np.min(np.abs(roots - root.conjugate())) > CONJUGATE * max(abs(root), 1e-300)]
        if lonely:
            root = lonely[0]
            hint = f"write {root.real:g} +- {abs(root.imag):g}j for the pair"
            raise ConfigError(f"{name}: {root:g} stands without its conjugate", hint=hint, field=name)
    return Transfer(block.zeros, block.poles, block.gain, block.rate)


FORMS: dict[str, Form] = {
    "roots": Form((), ("zeros", "poles", "gain", "rate"), _checked_roots),
    "polynomial": Form(
        ("numerator", "denominator"), ("rate",), lambda block: of_polynomials(block.numerator, block.denominator, block.rate)
    ),
    "pid": Form(
        (),
        ("proportional", "integral", "derivative", "derivative_time"),
        lambda block: pid(block.proportional, block.integral, block.derivative, block.derivative_time),
    ),
    "lead-lag": Form(("zero", "pole"), (), lambda block: lead_lag(block.zero, block.pole)),
    "low-pass": Form(("frequency",), ("order", "damping"), lambda block: low_pass(block.frequency, block.order, block.damping)),
    "notch": Form(("frequency",), ("depth", "width"), lambda block: notch(block.frequency, block.depth, block.width)),
    "gain": Form((), ("gain",), lambda block: Transfer(gain=block.gain)),
}


@dataclass(frozen=True, kw_only=True)
class ControllerBlock(Settings):
    """One block of a controller in series with the others; which entries it has depends on its form."""

    form: str = setting("choice", "what the block is given by", choices=tuple(FORMS))
    zeros: tuple[complex, ...] = setting("roots", "roots: of the numerator, [rad/s]; with a rate of z, [1]", default=())
    poles: tuple[complex, ...] = setting("roots", "roots: of the denominator, [rad/s]; with a rate of z, [1]", default=())
    gain: float = setting("value", "roots: factor before (s - zeros) / (s - poles); gain: the gain", unit="1", default=1.0)
    numerator: tuple[float, ...] = setting("values", "polynomial: coefficients in descending powers of s, or z", unit="1", default=())
    denominator: tuple[float, ...] = setting("values", "polynomial: coefficients in descending powers of s, or z", unit="1", default=())
    rate: float | None = setting("value", "roots, polynomial: sampling rate, which makes them functions of z", unit="Hz", default=None)
    proportional: float = setting("value", "pid: proportional gain", unit="1", default=0.0)
    integral: float = setting("value", "pid: gain of the integral", unit="1/s", default=0.0)
    derivative: float = setting("value", "pid: gain of the derivative", unit="s", default=0.0)
    derivative_time: float = setting("value", "pid: time constant of the differentiator", unit="s", default=0.0)
    zero: float | None = setting("value", "lead-lag: corner frequency of the numerator", unit="Hz", default=None)
    pole: float | None = setting("value", "lead-lag: corner frequency of the denominator", unit="Hz", default=None)
    frequency: float | None = setting("value", "low-pass: corner; notch: centre", unit="Hz", default=None)
    order: int = setting("integer", "low-pass: 1 or 2", default=1)
    damping: float = setting("value", "low-pass of order 2: damping ratio", unit="1", default=2**-0.5)
    depth: float = setting("value", "notch: gain at the centre", unit="1", default=0.0)
    width: float = setting("value", "notch: width at -3 dB over the centre frequency", unit="1", default=0.2)

    def __post_init__(self) -> None:
        form = FORMS[self.form]
        for name, declared in self.__dataclass_fields__.items():
            given = getattr(self, name) != declared.default
            if name in form.needs and not given:
                raise ConfigError(f"{name}: is missing for the form {self.form}", hint=declared.metadata["setting"].help)
            if given and name not in (*form.needs, *form.takes, "form"):
                hint = f"{self.form} takes {', '.join((*form.needs, *form.takes))}"
                raise ConfigError(f"{name}: is not for the form {self.form}", hint=hint, field=name)
        for name in ("zero", "pole", "frequency", "rate", "width"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"{name}: must be above zero, not {value:g}", field=name)
        for name in ("depth", "damping", "derivative_time"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name}: must not be negative", field=name)
        if self.order not in (1, 2):
            raise ConfigError(f"order: a low-pass has order 1 or 2, not {self.order}", hint="two blocks for more", field="order")
        _ = self.transfer

    @property
    def transfer(self) -> Transfer:
        """G(s), or G(z) with a rate."""
        return FORMS[self.form].transfer(self)

    @classmethod
    def entries_from(cls, value: Any) -> Any:
        """Blocks as they are, or from a system with one input and one output of python-control or scipy.signal."""
        if isinstance(value, (str, Sequence)):
            return value
        try:
            elements = matrix_of(value)
        except ConfigError as error:
            raise UnitError(error.what, error.hint) from None
        if len(elements) != 1 or len(elements[0]) != 1:
            hint = "labpipe.bearings.controller_blocks.blocks_of_matrix takes a matrix"
            raise UnitError("a controller of one direction has one input and one output", hint)
        return (block_of(elements[0][0]),)


def block_of(transfer: Transfer) -> ControllerBlock:
    """The transfer function as a block of zeros and poles."""
    return ControllerBlock(form="roots", zeros=transfer.zeros, poles=transfer.poles, gain=transfer.gain, rate=transfer.rate)


def blocks_of_matrix(system: Any) -> dict[str, tuple[ControllerBlock, ...]]:
    """Elements xx, xy, yx and yy of a system of python-control or scipy.signal with two inputs and two outputs; ConfigError for others."""
    elements = matrix_of(system)
    if len(elements) != 2 or any(len(row) != 2 for row in elements):
        raise ConfigError("a controller of two directions has two inputs and two outputs")
    return {f"{o}{i}": (block_of(elements[row][column]),) for row, o in enumerate("xy") for column, i in enumerate("xy")}


@dataclass(frozen=True, kw_only=True)
class CrossControl(Settings):
    """Elements of a controller matrix beside that of x by x: *xy* is output x by input y."""

    xy: tuple[ControllerBlock, ...] = setting("entries", "output x by input y", section=ControllerBlock, default=())
    yx: tuple[ControllerBlock, ...] = setting("entries", "output y by input x", section=ControllerBlock, default=())
    yy: tuple[ControllerBlock, ...] = setting("entries", "output y by input y; default: as x by x", section=ControllerBlock, default=())


def rate_of(blocks: Iterable[ControllerBlock]) -> float | None:
    """The sampling rate [Hz] of the discrete blocks, None without one; ConfigError for two rates."""
    rates = sorted({block.rate for block in blocks if block.rate is not None})
    if len(rates) > 1:
        raise ConfigError(f"controller: blocks at {rates[0]:g} Hz and {rates[1]:g} Hz cannot be in one loop", field="controller")
    return rates[0] if rates else None


def in_series(blocks: Iterable[ControllerBlock]) -> tuple[Transfer, Transfer]:
    """All blocks in series: those of s, and those of z, which are 1 where there are none."""
    parts = [block.transfer for block in blocks]
    continuous, discrete = Transfer(), Transfer(rate=next((part.rate for part in parts if part.rate is not None), None))
    for part in parts:
        if part.rate is None:
            continuous = continuous.times(part)
        else:
            discrete = discrete.times(part)
    return continuous, discrete

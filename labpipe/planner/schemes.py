"""How a spectrum is put on the shakers: one after the other, or both at once. SCHEMES by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray

ONE_BY_ONE, TOGETHER, INTERLEAVED = "one by one", "together", "interleaved"
# Lines with less than this share of a test's power are left out.
LEFT_OUT = 1e-5


@dataclass(frozen=True)
class Multisines:
    """The forces of one test: amplitudes *forces* (n_line, n_shaker) [N] of all shakers at *lines* (n_line,) [multiples of the spacing].

    name: of the test, the shakers that run in it. groups (n_line,) [1]: lines of one number keep the phase between the shakers.
    """

    name: str
    lines: IntArray
    forces: ComplexArray
    groups: IntArray

    def turned(self, phases: FloatArray) -> Multisines:
        """With phases (n_line, n_shaker) [rad] added."""
        return replace(self, forces=self.forces * np.exp(1j * phases))

    def scaled(self, factors: FloatArray | float) -> Multisines:
        """With forces times factors (n_shaker,) [1]."""
        return replace(self, forces=self.forces * factors)


Scheme = Callable[[IntArray, FloatArray, tuple[str, ...]], tuple[Multisines, ...]]


def one_by_one(lines: IntArray, power: FloatArray, names: tuple[str, ...]) -> tuple[Multisines, ...]:
    """A test for every shaker: mean squares *power* (n_line, n_shaker) [N^2] at lines (n_line,) [multiples]; *names* of the shakers."""
    tests = []
    for number, name in enumerate(names):
        kept = power[:, number] > LEFT_OUT * power[:, number].sum()
        if np.any(kept):
            alone = np.zeros((np.count_nonzero(kept), len(names)), complex)
            alone[:, number] = np.sqrt(2 * power[kept, number])
            tests.append(Multisines(name, lines[kept], alone, np.arange(len(alone))))
    return tuple(tests)


def together(lines: IntArray, power: FloatArray, names: tuple[str, ...]) -> tuple[Multisines, ...]:
    """One test of two shakers at once, with opposite signs on neighbouring lines; arguments as of one_by_one, power (n_line, 2) [N^2].

    Two vectors on ONE line would add up to a single one, which tells four numbers; on neighbouring lines, of equal size and opposite sign,
    they tell what the powers of both shakers do: h h^H + g g^H is diagonal for h = (a, b), g = (a, -b). Equation (plan-together).
    """
    paired, used = _pairs(lines, power)
    forces = np.repeat(np.sqrt(paired), 2, axis=0).astype(complex)
    forces[1::2, 1] *= -1
    return (_kept("+".join(names), used, forces, np.repeat(np.arange(len(paired)), 2)),)


def interleaved(lines: IntArray, power: FloatArray, names: tuple[str, ...]) -> tuple[Multisines, ...]:
    """One test of two shakers at once, each on every other line; arguments as of one_by_one, power (n_line, 2) [N^2]."""
    paired, used = _pairs(lines, power)
    forces = np.zeros((used.size, 2), complex)
    forces[::2, 0], forces[1::2, 1] = np.sqrt(2 * paired).T
    return (_kept("+".join(names), used, forces, np.arange(used.size)),)


def _pairs(lines: IntArray, power: FloatArray) -> tuple[FloatArray, IntArray]:
    """Power (n_pair, 2) [N^2] of pairs of lines, and the lines of all pairs; a last line without a partner gives its power to its pair."""
    first = np.arange(0, lines.size - 1, 2)
    return np.asarray(np.add.reduceat(power, first, axis=0)), lines[: 2 * first.size]


def _kept(name: str, lines: IntArray, forces: ComplexArray, groups: IntArray) -> Multisines:
    """Without lines of negligible force."""
    size = np.sum(np.abs(forces) ** 2, axis=1)
    kept = size > LEFT_OUT * size.sum()
    return Multisines(name, lines[kept], forces[kept], groups[kept])


SCHEMES: dict[str, Scheme] = {ONE_BY_ONE: one_by_one, TOGETHER: together, INTERLEAVED: interleaved}

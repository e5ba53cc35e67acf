"""Reading sums of channels: "f_x - m_s * a_x", "30 kg +- 0.1 kg * a_x", "cos(45 deg) * x_1". Signs between
channels stand between blanks. A factor is a number, with unit and uncertainty or without, a name of
`constants:`, or the cosine or sine of an angle; the units must give that of the sum.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from labpipe.project.marked_yaml import Marked
from labpipe.project.settings_reader import Faults, join, shorten_number
from labpipe.quantities import QUANTITIES, Dimension, UnitError, name_of_dimension, parse_unit
from labpipe.records.recording import Number, SumTerm
from labpipe.records.uncertain import Uncertain, parse_uncertain, split_uncertainty
from labpipe.registry import nearest

_SIGN = re.compile(r"(?:^|\s)([+-])(?:\s+|$)")
_LEADING = re.compile(r"^([+-])\s*(?=\D)")
_NUMBER = re.compile(r"^[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\s*(.*)$")
_TURN = re.compile(r"^([+-]?)\s*(cos|sin)\s*\((.*)\)$")


@dataclass(frozen=True)
class TermFactor:
    """A factor of a term, the number with uncertainty behind it, and the factor's derivative by that."""

    value: float
    dimension: Dimension
    number: Number | None = None
    derivative: float = 1.0


def read_constants(node: Marked | None, channels: Collection[str], faults: Faults) -> dict[str, TermFactor]:
    """The entries of ``constants:``; faults for no value with a unit, and for names of *channels*."""
    constants: dict[str, TermFactor] = {}
    if node is None:
        return constants
    for name, entry in faults.mapping(node, "constants").items():
        if name in channels:
            faults.add(entry, join("constants", name), "is a channel already", "give it another name")
        with faults.of_unit(entry, join("constants", name)):
            constants[name] = parse_factor(shorten_number(entry).text, name)
    return constants


def parse_factor(text: str, name: str) -> TermFactor:
    """ "30 kg +- 0.1 kg", "0.7071" or "cos(45 deg)"; *name*: of its uncertainty. UnitError for others."""
    turn = _TURN.match(text.strip())
    if turn is not None:
        return _turn(turn[1], turn[2], turn[3], name)
    match = _NUMBER.match(split_uncertainty(text)[0])
    if match is None:
        raise UnitError(f"'{text}' is not a value with its unit", "for example 30 kg +- 0.1 kg")
    dimension = parse_unit(match[1] or "1").dimension
    unit = name_of_dimension(dimension)
    # A minus is that of the term: of -30 kg the error makes 30 kg larger, as of 30 kg by the same scale.
    sign = -1.0 if text.strip().startswith("-") else 1.0
    uncertain = parse_uncertain(text.strip().removeprefix("-"), unit)
    return TermFactor(sign * uncertain.value, dimension, _number(name, uncertain, unit), sign)


def _number(name: str, number: Uncertain, unit: str) -> Number | None:
    size = number.std_error
    return Number(name, number.value, size, unit, number.source) if size > 0 else None


def _turn(sign: str, function: str, angle_text: str, name: str) -> TermFactor:
    angle = parse_uncertain(angle_text.strip(), "rad")
    size = -1.0 if sign == "-" else 1.0
    cosine, sine = math.cos(angle.value), math.sin(angle.value)
    value, slope = (cosine, -sine) if function == "cos" else (sine, cosine)
    number = _number(name, angle, "rad")
    return TermFactor(size * value, parse_unit("1").dimension, number, size * slope)


@dataclass(frozen=True)
class SumReader:
    """Reads sums: *quantities* of all channels by name, the rig's *constants*."""

    quantities: Mapping[str, str]
    constants: Mapping[str, TermFactor]

    def terms(self, text: str, name: str) -> tuple[SumTerm, ...]:
        """The terms of the sum of channel *name*; UnitError for what cannot be read or has another unit."""
        return tuple(self._term(sign, part, name) for sign, part in _parts(text))

    def _term(self, sign: float, text: str, name: str) -> SumTerm:
        factors: list[TermFactor] = []
        members: list[str] = []
        for piece in (part.strip() for part in text.split("*")):
            if piece in self.quantities:
                members.append(piece)
            elif piece in self.constants:
                factors.append(self.constants[piece])
            else:
                factors.append(self._literal(piece, text, name))
        if len(members) != 1:
            what = "no channel" if not members else f"{len(members)} channels"
            hint = "a term is one channel times numbers, for example -30 kg * a_x"
            raise UnitError(f"'{text}' holds {what}", hint)
        self._check_unit(factors, members[0], text, name)
        value = sign * math.prod(factor.value for factor in factors)
        numbers: dict[Number, float] = {}
        for place, factor in enumerate(factors):
            if factor.number is not None:
                others = math.prod(other.value for at, other in enumerate(factors) if at != place)
                numbers[factor.number] = numbers.get(factor.number, 0.0) + sign * others * factor.derivative
        return SumTerm(members[0], value, tuple(numbers), tuple(numbers.values()))

    def _literal(self, piece: str, term: str, name: str) -> TermFactor:
        if not _NUMBER.match(piece) and not _TURN.match(piece):
            hint = nearest(piece, [*self.quantities, *self.constants])
            if re.search(r"[+-]", piece):
                hint = "plus and minus between channels need blanks around them: f_x - m_s * a_x"
            raise UnitError(f"'{piece}' is neither a channel nor one of the constants", hint)
        within = f"{split_uncertainty(piece)[0]} in {name}"
        return parse_factor(piece, within if piece != term else name)

    def _check_unit(self, factors: list[TermFactor], member: str, text: str, name: str) -> None:
        quantity = self.quantities[name]
        unit = QUANTITIES[quantity].si_unit
        wanted = parse_unit(unit).dimension
        of_member = parse_unit(QUANTITIES[self.quantities[member]].si_unit).dimension
        total = of_member
        for factor in factors:
            total = _combine(total, factor.dimension, 1)
        if any(abs(power) > 1e-9 for power in _combine(total, wanted, -1)):
            what = f"'{text}' is in {name_of_dimension(total)}, {unit} is needed for a {quantity}"
            needed = name_of_dimension(_combine(wanted, of_member, -1))
            needed = "a pure number" if needed == "1" else f"in {needed}"
            raise UnitError(what, f"the factor of {member} is {needed}")


def _combine(first: Dimension, second: Dimension, sign: int) -> Dimension:
    m, kg, s, a, k, rad = (exponent + sign * other for exponent, other in zip(first, second, strict=True))
    return m, kg, s, a, k, rad


def _parts(text: str) -> list[tuple[float, str]]:
    text = text.strip()
    if not text:
        raise UnitError("a sum of channels is missing", "for example f_x - m_s * a_x")
    first, *others = map(str.strip, _SIGN.split(_LEADING.sub(r"\1 ", text)))
    signs, terms = ["+", *others[::2]], [first, *others[1::2]]
    pairs = [(-1.0 if sign == "-" else 1.0, term) for sign, term in zip(signs, terms, strict=True)]
    pairs = pairs if first else pairs[1:]
    if not all(term for _, term in pairs):
        raise UnitError(f"'{text}' lacks a term", "for example f_x - m_s * a_x")
    return pairs


def expand(
    sums: Mapping[str, tuple[SumTerm, ...]], name: str, above: tuple[str, ...] = ()
) -> tuple[SumTerm, ...]:
    """The sum of channel *name* in recorded channels. UnitError for one that holds itself."""
    if name in above:
        ring = " of ".join((*above[above.index(name) :], name))
        raise UnitError(f"the sum contains itself: {ring}", "write it in recorded channels")
    terms: dict[str, SumTerm] = {}
    for term in sums[name]:
        is_sum = term.channel in sums
        inner = expand(sums, term.channel, (*above, name)) if is_sum else (SumTerm(term.channel, 1.0),)
        for part in inner:
            # A term of a sum that is itself a member: d(ab) = a db + b da
            scaled = part.times(term.factor)
            derivatives = tuple(part.factor * derivative for derivative in term.derivatives)
            by_derivatives = SumTerm(part.channel, 0.0, term.numbers, derivatives)
            whole = replace(_add(scaled, by_derivatives), factor=scaled.factor)
            terms[part.channel] = _add(terms[part.channel], whole) if part.channel in terms else whole
    return tuple(terms.values())


def _add(first: SumTerm, second: SumTerm) -> SumTerm:
    numbers = dict(zip(first.numbers, first.derivatives, strict=True))
    for number, derivative in zip(second.numbers, second.derivatives, strict=True):
        numbers[number] = numbers.get(number, 0.0) + derivative
    return SumTerm(first.channel, first.factor + second.factor, tuple(numbers), tuple(numbers.values()))

"""Values with their uncertainty and unit as people read them (JCGM 100:2008, 7.2.6): THE home of every number
that is shown.

The uncertainty has two significant digits, the value is rounded to the same place, both share a prefix and a
power of ten. What programs read (JSON, CSV) stays in SI at full precision.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from labpipe.quantities import PREFIXED, display_unit, to_display

# Significant digits of a number without an uncertainty, and the most that a value has with one.
PLAIN_DIGITS, MOST_DIGITS = 6, 12
NOT_DETERMINED = "not determined"
# Sizes in the usual unit for which it stays; beyond them another prefix is chosen.
USUAL = (0.1, 1e4)
# Sizes that are written without a power of ten.
WITHOUT_POWER = (1e-4, 1e6)
# Smallest p-value that is written: rounding of the sums behind it is as large.
LEAST_CHANCE = 1e-15
# Units of one dimension, the smallest first.
LADDERS = {
    **PREFIXED,
    "m": ("nm", "um", "mm", "m"),
    "s": ("us", "ms", "s"),
    "kg": ("g", "kg", "t"),
    "Pa": ("Pa", "kPa", "MPa", "GPa"),
    "Pa.s": ("mPa.s", "Pa.s"),
}


def shown_unit(si_unit: str, *sizes: float | None) -> str:
    """The unit for amounts of these *sizes* [SI]: of value and uncertainty; the largest decides."""
    usual = display_unit(si_unit)
    largest = max((abs(size) for size in sizes if size is not None and math.isfinite(size)), default=0.0)
    units = LADDERS.get(si_unit, ())
    if not units or largest == 0.0 or USUAL[0] <= to_display(largest, usual) < USUAL[1]:
        return usual
    return next((unit for unit in reversed(units) if to_display(largest, unit) >= 1.0), units[0])


def unit_label(unit: str) -> str:
    """The unit behind a number; a plain number has none."""
    return "" if unit == "1" else unit


def chance_text(p_value: float | None) -> str:
    """A p-value, or that it is smaller than any that is written."""
    if p_value is None:
        return "p unknown"
    return f"p < {LEAST_CHANCE:g}" if p_value < LEAST_CHANCE else f"p = {p_value:.2g}"


def probability_text(probability: float) -> str:
    """A probability in per cent, never all or nothing."""
    if probability > 0.999:
        return "over 99.9 %"
    return "under 0.1 %" if probability < 0.001 else f"{100 * probability:.3g} %"


def difference_in(amount: float, unit: str) -> float:
    """A difference [SI], such as an uncertainty, in a unit that may have an offset."""
    return to_display(amount, unit) - to_display(0.0, unit)


@dataclass(frozen=True)
class _Place:
    """The last decimal of the numbers in front of a common power of ten."""

    decimals: int
    power: int

    def text(self, number: float, decimals: int | None = None) -> str:
        return self.mantissa(number, decimals) + (
            f"e{self.power}" if self.power and math.isfinite(number) else ""
        )

    def mantissa(self, number: float, decimals: int | None = None) -> str:
        if not math.isfinite(number):
            return NOT_DETERMINED
        decimals = self.decimals if decimals is None else decimals
        # Dividing by a power that is exact keeps the digits of the decimal number; zero is added since -0.0
        # is not a result.
        scaled = number / 10.0**self.power if self.power >= 0 else number * 10.0**-self.power
        return f"{round(scaled, decimals) + 0.0:.{max(decimals, 0)}f}"


def _exponent(number: float) -> int:
    """The power of ten of the first of two significant digits: 0.0996 is 0.10, so -1."""
    return int(f"{abs(number):.1e}".partition("e")[2])


def _place(error: float, *numbers: float) -> _Place:
    size = max(abs(number) for number in (error, *numbers) if math.isfinite(number))
    power = 0 if WITHOUT_POWER[0] <= size < WITHOUT_POWER[1] else math.floor(math.log10(size))
    return _Place(1 - _exponent(error) + power, power)


def write_values(value: float, error: float | None, *others: float) -> tuple[str, ...]:
    """Value, uncertainty and *others* on the scale of the value (ends of an interval), all to the
    uncertainty's second digit.

    Without an uncertainty, or with none above zero, numbers have six significant digits and the uncertainty
    is '' or '0'; what is not finite is 'not determined'. A value that is known beyond twelve digits has
    twelve, and its uncertainty a power of its own.
    """
    if error is None or error == 0.0 or not math.isfinite(error):
        uncertainty = "" if error is None else "0" if error == 0.0 else NOT_DETERMINED
        return (number(value), uncertainty, *(number(other) for other in others))
    place = _place(error, value, *others)
    digits = (
        1
        + place.decimals
        - place.power
        + (math.floor(math.log10(abs(value))) if value and math.isfinite(value) else 0)
    )
    if digits > MOST_DIGITS:
        return (
            number(value, MOST_DIGITS),
            _place(error).text(abs(error)),
            *(number(other, MOST_DIGITS) for other in others),
        )
    return (place.text(value), place.text(abs(error)), *(place.text(other) for other in others))


def two_digits(error: float, beside: float = 0.0) -> str:
    """An uncertainty by itself, with the power of ten of the value *beside* which it stands."""
    if error == 0.0 or not math.isfinite(error):
        return write_values(0.0, error)[1]
    return _place(error, beside).text(abs(error))


def number(value: float, digits: int = PLAIN_DIGITS) -> str:
    """A number without an uncertainty."""
    return f"{value:.{digits}g}" if math.isfinite(value) else NOT_DETERMINED


def per_cent(share: float) -> str:
    """A share [1] by its two leading digits, as people read it: '0.013 %', and '130 %' for 1.34."""
    return f"{float(f'{100 * share:.2g}'):g} %"


def count_text(amount: int, what: str) -> str:
    """So many of *what*: '1 hit', '2 hits'."""
    return f"{amount} {what}{'s' if amount != 1 else ''}"


def with_error(value: float, error: float | None, unit: str = "", sign: str = "±") -> str:
    """One text, value and uncertainty in *unit*: '134.4981 ± 0.0087 kN/m', '(1.234 ± 0.011)e-7'."""
    value_text, error_text = write_values(value, error)
    if error_text and "e" in error_text and error_text.partition("e")[2] == value_text.partition("e")[2]:
        mantissa, _, power = value_text.partition("e")
        joined = f"({mantissa} {sign} {error_text.partition('e')[0]})e{power}"
    else:
        joined = f"{value_text} {sign} {error_text}" if error_text else value_text
    return f"{joined} {unit_label(unit)}".rstrip()


def change_text(value: float, error: float, unit: str) -> str:
    """A change with its sign: '+3.00 +- 0.28 %'."""
    text = with_error(value, error, unit, "+-")
    return text if value < 0 else f"+{text}"


def amount_text(value: float, error: float | None, si_unit: str, sign: str = "±") -> str:
    """One text for a value and its uncertainty in SI, with the unit that suits both."""
    unit = shown_unit(si_unit, value, error)
    return with_error(
        to_display(value, unit), None if error is None else difference_in(error, unit), unit, sign
    )


# A number with its power of ten as this module writes it, and a power of a unit or a symbol.
_POWER_OF_TEN = re.compile(r"((?<![\w.])\d(?:\.\d+)?|\))e([+-]?\d{1,3})(?!\w|\.\d)")
_POWER = re.compile(r"(?<=[A-Za-z)])\^(-?\d)(?![\w.])")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def as_printed(text: str) -> str:
    """A text with its powers and ± as a hand writes them: '(1.234 ± 0.011) × 10⁻⁷ m/s²' for '(1.234 +-
    0.011)e-07 m/s^2'.

    For people: programs read the text as it was.
    """
    raised = _POWER_OF_TEN.sub(lambda m: f"{m[1]} × 10{str(int(m[2])).translate(_RAISED)}", text)
    return _POWER.sub(lambda m: m[1].translate(_RAISED), raised).replace(" +- ", " ± ")


def plain_text(value: float, si_unit: str, digits: int = 5) -> str:
    """A value in SI of which no uncertainty is known, with the unit that suits it: '45.9 kN/m', '16', '876.17
    kPa'.
    """
    unit = shown_unit(si_unit, value)
    return f"{number(to_display(value, unit), digits)} {unit_label(unit)}".rstrip()


def significant(value: float, digits: int) -> str:
    """A number with so many significant digits, zeros at its end among them: 459000 is '4.590e+05', 22.8 is
    '22.80'.
    """
    return f"{value:#.{digits}g}".removesuffix(".") if value and math.isfinite(value) else number(value)

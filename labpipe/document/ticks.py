"""Round numbers along an axis, as the script of a page sets them too."""

from __future__ import annotations

import math

from labpipe.report.chart import Axis, Ticks

# Steps between numbers, as parts of a power of ten; along many degrees they are parts of a turn.
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
TURNS, MANY_DEGREES = (15.0, 30.0, 45.0, 90.0, 180.0, 360.0), 60.0
# Fewer numbers than this hardly tell a scale: the next smaller step has more.
LEAST = 3
# A logarithmic axis of fewer decades than the first has numbers in equal steps, of fewer than the second numbers within its decades.
LEAST_DECADES, FEW_DECADES = 0.7, 2.2
WITHIN = (1, 2, 5)
# What rounding may add to an end of an axis, as part of a step.
ROUNDING = 1e-9
MOST_DECIMALS = 15
# Numbers from here on, and below the other, are written with an exponent.
LARGE, SMALL = 1e6, 1e-4


def ticks_of(axis: Axis, limits: tuple[float, float], most: int) -> Ticks:
    """(place, text) of about *most* numbers between the *limits* of an axis [its unit], or the names that its places have."""
    low, high = min(limits), max(limits)
    if axis.ticks:
        return tuple(tick for tick in axis.ticks if low <= tick[0] <= high)
    return _logarithmic(axis, low, high, most) if axis.logarithmic else _linear(axis, low, high, most)


def _linear(axis: Axis, low: float, high: float, most: int) -> Ticks:
    """Numbers in equal steps, all with as many decimals as the step has."""
    rough = (high - low) / max(most, 2)
    if not (rough > 0 and math.isfinite(rough)):
        return ((low, plain(low)),)
    values, step = [], rough
    for step in _steps(axis, rough, high - low):
        first, last = math.ceil(low / step - ROUNDING), math.floor(high / step + ROUNDING)
        values = [number * step for number in range(first, last + 1)]
        if len(values) >= LEAST:
            break
    texts = [plain(value) for value in values]
    if len(set(texts)) == len(texts) and any("e" in text for text in texts):
        return tuple(zip(values, texts, strict=True))
    decimals = next((digits for digits in range(MOST_DECIMALS) if abs(round(step, digits) - step) < ROUNDING * step), MOST_DECIMALS)
    return tuple((value, _minus(f"{value + 0.0:.{decimals}f}")) for value in values)


def _steps(axis: Axis, rough: float, length: float) -> list[float]:
    """The smallest round step that is no smaller than *rough*, and three below it; *length*: of the axis. All in its unit."""
    decade = 10.0 ** math.floor(math.log10(rough))
    steps = [part * decade / 10 for part in STEPS[:-1]] + [part * decade for part in STEPS]
    if axis.unit == "deg" and MANY_DEGREES < length < LEAST * TURNS[-1]:
        steps = list(TURNS)
    first = next((n for n, step in enumerate(steps) if step >= 0.999 * rough), len(steps) - 1)
    return steps[max(0, first - 3) : first + 1][::-1]


def _logarithmic(axis: Axis, low: float, high: float, most: int) -> Ticks:
    decades = math.log10(high / low)
    if decades < LEAST_DECADES:
        return _linear(axis, low, high, most)
    parts = WITHIN if decades < FEW_DECADES else WITHIN[:1]
    every = max(1, math.ceil(decades / max(most, 2)))
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    values = [part * 10.0**power for power in powers if power % every == 0 for part in parts]
    return tuple((value, plain(value)) for value in values if 0.9999 * low <= value <= 1.0001 * high)


def plain(value: float) -> str:
    """A number of an axis with the digits that it has, a true minus before it, and an exponent where it is very large or small."""
    size = abs(value)
    if size and (size >= LARGE or size < SMALL):
        mantissa, exponent = f"{value:.4e}".split("e")
        text = f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"
    else:
        text = f"{value + 0.0:.10g}"
    return _minus(text)


def _minus(text: str) -> str:
    return text.replace("-", "\N{MINUS SIGN}")

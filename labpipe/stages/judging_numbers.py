"""Numbers held against a rule, and how they are shown: in the unit in which the rule is written."""

from __future__ import annotations

import operator
from collections.abc import Callable

from labpipe.config.rules import Rule
from labpipe.display import amount_text, with_error
from labpipe.errors import ConfigError
from labpipe.quantities import UnitError, in_unit, parse_value, written_unit
from labpipe.records.parameter import Parameter
from labpipe.records.uncertain import parse_uncertain, split_doubt

# (value [SI], whether it meets the rule, the value in the rule's unit)
Compared = tuple[float | str | None, bool, str]
# (rule, value, unit) -> the same of a number
CompareNumber = Callable[[Rule, float | None, str], tuple[float | None, bool, str]]
_COMPARE = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}


def compare_number(rule: Rule, value: float | None, unit: str) -> tuple[float | None, bool, str]:
    """Whether a number [*unit*, SI] meets the rule, and the number in the unit of the rule; one that could not be given meets none."""
    try:
        text = "" if value is None else found_text(rule, value, unit)
        if rule.kind == "+-":
            wanted = parse_uncertain(rule.bound, unit)
            return value, value is not None and abs(value - wanted.value) <= wanted.std_error, text
        bound = parse_value(rule.bound, unit)
    except UnitError as error:
        raise ConfigError(f"{rule.section}.{rule.address}: {error.what}", where=rule.place, hint=error.hint) from None
    if rule.kind == "=":
        return value, value is not None and value == bound, text
    return value, value is not None and bool(_COMPARE[rule.kind](value, bound)), text


def found_text(rule: Rule, value: float, unit: str) -> str:
    """The value [*unit*, SI] in the unit of the rule, or where that has none (0) in the usual one; UnitError for a wrong one."""
    written = written_unit(split_doubt(rule.bound)[0])
    return with_error(in_unit(value, unit, written), None, written) if written else amount_text(value, None, unit)


def compare_covers(rule: Rule, ci95: tuple[float, float] | None, unit: str) -> Compared:
    """Whether a 95 % interval [*unit*, SI] covers the value of the rule; the interval as text, in SI and in the unit of the rule."""
    try:
        wanted = parse_value(rule.bound, unit)
        if ci95 is None:
            return "no interval", False, "no interval"
        low, high = ci95
        ends = " to ".join(found_text(rule, end, unit) for end in (low, high))
    except UnitError as error:
        raise ConfigError(f"{rule.section}.{rule.address}: {error.what}", where=rule.place, hint=error.hint) from None
    return f"{low:.6g} to {high:.6g}", low <= wanted <= high, ends


def compare_expanded(rule: Rule, parameter: Parameter) -> Compared:
    """The expanded uncertainty, half the 95 % interval where noise alone is known; relative to the value where the rule is in per cent."""
    if parameter.ci95 is None:
        return None, False, ""
    half = (parameter.ci95[1] - parameter.ci95[0]) / 2 if parameter.expanded is None else parameter.expanded
    if rule.bound.endswith("%"):
        return compare_number(rule, half / abs(parameter.value) if parameter.value else None, "1")
    return compare_number(rule, half, parameter.unit)

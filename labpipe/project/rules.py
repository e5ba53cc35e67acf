"""The rules of ``accept:`` and ``expect:``, read from "fit.parameter: rule", or from limits."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

from labpipe.errors import ConfigError
from labpipe.project.marked_yaml import Marked, text_of
from labpipe.project.settings_reader import Faults, join, list_entries
from labpipe.quantities import locate_units, parse_unit, parse_value, written_unit
from labpipe.records.identification import RuleDecision, RuleOutcome
from labpipe.records.uncertain import qualities_of, split_uncertainty
from labpipe.registry import nearest
from labpipe.uncertainty.decisions import OUTCOMES, PASS

_COMPARISON = re.compile(r"^\s*(>=|<=|>|<)\s*(.+?)\s*$")
_ADDRESS = re.compile(r"^(?P<fit>[^.\[\]]+)(?:\[(?P<which>[^\]]*)\])?\.(?P<item>.+)$")

# How is decided where a rule gives limits: by the value alone, with a guard band at each limit, or by the
# probability that the limits hold.
SIMPLE, GUARDED, RISK = "simple", "guarded", "risk"
DECISIONS = (SIMPLE, GUARDED, RISK)
# The risk of a guard band or a decision where a rule names none.
USUAL_RISK = 0.05
DECISION_KEYS = {
    "limits": "[least, most] that the value may be, null where a side is open",
    "min": "the least that the value may be, in place of limits",
    "max": "the most that the value may be, in place of limits",
    "together": "addresses with their limits, of which all must hold, in place of limits",
    "rule": "simple, guarded or risk",
    "risk": "chance that a value at the edge of what passes is beyond the limit",
    "guard": "guard band of each limit over the expanded uncertainty, in place of risk",
    "process": "mean +- standard deviation of what is made, for the global risks",
    "outcomes": "outcomes with which the rule holds",
}


@dataclass(frozen=True, kw_only=True)
class Decision:
    """How is decided on limits. *low*, *high*: as written, empty where that side is open; *rule*: one of
    DECISIONS; *risk* [1]; *guard*: the guard band of each limit over the expanded uncertainty [1], None where
    it follows from the risk; *process*: mean and standard deviation of what is made, as written; *outcomes*:
    those with which the rule holds.
    """

    low: str = ""
    high: str = ""
    rule: str = SIMPLE
    risk: float = USUAL_RISK
    guard: float | None = None
    process: str = ""
    outcomes: tuple[str, ...] = (PASS,)

    @property
    def limits_text(self) -> str:
        if self.low and self.high:
            return f"{self.low} to {self.high}"
        return f">= {self.low}" if self.low else f"<= {self.high}"

    @property
    def manner_text(self) -> str:
        """Everything of the decision but the limits, as people write it."""
        by = f"guard band {self.guard:g} U" if self.guard is not None else f"risk {100 * self.risk:g} %"
        parts = [self.rule if self.rule == SIMPLE else f"{self.rule}, {by}"]
        parts += [f"process {self.process}"] if self.process else []
        parts += [f"holds by {' or '.join(self.outcomes)}"] if self.outcomes != (PASS,) else []
        return ", ".join(parts)


@dataclass(frozen=True, kw_only=True)
class Rule:
    """``fit[which].item`` must satisfy *kind*: a comparison (>=, <=, >, <), '+-' (value and tolerance), '='
    (a word or flag), or 'limits' with a *decision*; or the rules *together* must. *which*: a test's name or
    the centre of a sliding band ("72.5 Hz"). *bound*: the text behind the comparison, in the unit of what it
    is compared with; *place*: where the rule stands.
    """

    section: str
    address: str
    fit: str
    which: str
    item: str
    kind: str
    bound: str
    place: str
    decision: Decision | None = None
    together: tuple[Rule, ...] = ()

    def fault(self, what: str, hint: str = "") -> ConfigError:
        """What is wrong with the rule, at its place."""
        return ConfigError(f"{self.section}.{self.address}: {what}", self.place, hint)

    def faults_of_units(self) -> AbstractContextManager[None]:
        """A UnitError of the block becomes a fault of the rule."""
        return locate_units(self.place, before=f"{self.section}.{self.address}: ")

    def outcome(
        self, value: float | str | None, passed: bool, shown: str = "", decision: RuleDecision | None = None
    ) -> RuleOutcome:
        """What came of the rule, by the value [SI] that it was compared with."""
        return RuleOutcome(self.section, self.text, value, passed, shown, decision)

    def outcome_of_all(self, compared: Sequence[tuple[Any, ...]]) -> RuleOutcome:
        """What came of a rule that all numbers must meet: by the first that does not, else by the first."""
        return self.outcome(*next((pair for pair in compared if not pair[1]), compared[0]))

    @property
    def text(self) -> str:
        if self.decision is not None:
            within = " and ".join(rule.bound for rule in self.together) or self.bound
            return f"{self.address}: {within} ({self.decision.manner_text})"
        return f"{self.address} {self.bound if self.kind in ('+-', '=') else f'{self.kind} {self.bound}'}"


# The address of rules on the warnings of every fit.
EVERY_WARNING = "warnings"
# What is compared with a word.
WORDS = (EVERY_WARNING, "significant", "verdict")
# Begin rules on a warning: it must not occur; it is taken where it occurs.
NOT, ALSO = "not ", "also "


def read_rules(
    section: str,
    node: Marked | None,
    faults: Faults,
    fits: tuple[str, ...],
    verdicts: Mapping[str, tuple[str, ...]],
) -> tuple[Rule, ...]:
    """The rules of one section; faults for unreadable ones and for fits that the pipeline does not have.
    *verdicts* that are possible, by the name of what has them; of others any word is taken.
    """
    if node is None:
        return ()
    rules: list[Rule] = []
    for address, entry in faults.mapping(node, section).items():
        key = f"{section}.{address}"
        if address == EVERY_WARNING:
            # Which warnings refuse a result, of every fit.
            texts = _rule_texts(entry, key, faults, address, ())
            addresses = filter(None, (_ADDRESS.match(f"{fit}.{EVERY_WARNING}") for fit in fits))
            rules.extend(_rule(section, at[0], entry, at, text) for at in addresses for text in texts)
        elif isinstance(entry.content, dict) and any(name in DECISION_KEYS for name in entry.content):
            if "together" in entry.content:
                rules.extend(_joint_rule(section, address, entry, faults, fits))
            elif match := _match(address, entry, key, faults, fits):
                rules.extend(_decide(section, address, entry, match, faults))
        elif match := _match(address, entry, key, faults, fits):
            texts = _rule_texts(entry, key, faults, match["item"], verdicts.get(match["fit"], ()))
            rules.extend(_rule(section, address, entry, match, text) for text in texts)
    return tuple(rules)


def _match(
    address: str, entry: Marked, key: str, faults: Faults, fits: tuple[str, ...]
) -> re.Match[str] | None:
    match = _ADDRESS.match(address)
    if match is None:
        faults.add(entry, key, "is not an address", "write fit.parameter, for example direct.k")
    elif match["fit"] not in fits:
        faults.add(entry, key, f"there is no fit '{match['fit']}'", f"known: {', '.join(fits)}")
    else:
        return match
    return None


# Rules that give limits: {limits: [134 kN/m, 135 kN/m], rule: guarded, risk: 5 %}.


def _decide(
    section: str, address: str, entry: Marked, match: re.Match[str], faults: Faults
) -> tuple[Rule, ...]:
    key = f"{section}.{address}"
    decision = _read_decision(entry, key, faults)
    if match["item"].rpartition(".")[2] in (*WORDS, "covers"):
        hint = "name a parameter, for example direct.k"
        faults.add(entry, key, "is a word, and limits need a number", hint)
        return ()
    if decision is None:
        return ()
    bare = _rule(section, address, entry, match, decision.limits_text)
    return (replace(bare, kind="limits", bound=decision.limits_text, decision=decision),)


def _joint_rule(
    section: str, address: str, entry: Marked, faults: Faults, fits: tuple[str, ...]
) -> tuple[Rule, ...]:
    key = f"{section}.{address}"
    before = len(faults)
    for name in ("limits", "min", "max", "guard", "process"):
        if name in entry.content:
            faults.add_at(entry.content, key, name, "belongs to one number", "leave it out")
    shared = {name: node for name, node in entry.content.items() if name in ("rule", "risk", "outcomes")}
    members: list[Rule] = []
    for member, limits in faults.mapping(entry.content["together"], join(key, "together")).items():
        match = _match(member, limits, join(key, "together", member), faults, fits)
        if match is not None:
            with_limits = Marked({**shared, "limits": limits}, limits.where, limits.key_where)
            decided = _decide(section, member, with_limits, match, faults)
            members += [replace(rule, bound=f"{member} {rule.bound}") for rule in decided]
    faults.unknown_keys(entry, key, DECISION_KEYS)
    if not members and len(faults) == before:
        faults.add(entry, join(key, "together"), "two addresses with their limits are needed")
    if len(faults) > before:
        return ()
    decision = replace(members[0].decision or Decision(), low="", high="")
    if decision.rule == GUARDED:
        faults.add_at(entry.content, key, "rule", "guard bands hold for one limit", "write risk")
        return ()
    rule = replace(members[0], address=address, fit="", which="", item="", bound="", place=entry.place)
    return (replace(rule, kind="together", decision=decision, together=tuple(members)),)


def _read_decision(entry: Marked, key: str, faults: Faults) -> Decision | None:
    before = len(faults)
    faults.unknown_keys(entry, key, DECISION_KEYS)
    nodes = entry.content
    rule = text_of(nodes, "rule", SIMPLE)
    if rule not in DECISIONS:
        faults.add_at(nodes, key, "rule", f"unknown rule '{rule}'", nearest(rule, DECISIONS))
    if "guard" in nodes and ("risk" in nodes or rule != GUARDED):
        what = "a guard band takes the place of the risk" if "risk" in nodes else "only 'guarded' has one"
        faults.add_at(nodes, key, "guard", what, "rule: guarded with guard or with risk")
    if "risk" in nodes and rule == SIMPLE:
        faults.add_at(nodes, key, "risk", "simple acceptance has none", "rule: guarded or rule: risk")
    low, high = _read_limits(entry, key, faults)
    risk = _read_number(nodes.get("risk"), join(key, "risk"), faults, (0.0, 0.5))
    guard = _read_number(nodes.get("guard"), join(key, "guard"), faults, (-10.0, 10.0))
    process = text_of(nodes, "process")
    if "process" in nodes and "+-" not in process.replace("±", "+-"):
        hint = "mean and standard deviation: 134.5 kN/m +- 0.2 kN/m"
        faults.add_at(nodes, key, "process", f"'{process}' has no spread", hint)
    outcomes = _read_outcomes(nodes.get("outcomes"), join(key, "outcomes"), faults)
    if len(faults) > before:
        return None
    return Decision(
        low=low,
        high=high,
        rule=rule,
        risk=USUAL_RISK if risk is None else risk,
        guard=guard,
        process=process,
        outcomes=outcomes,
    )


def _read_limits(entry: Marked, key: str, faults: Faults) -> tuple[str, str]:
    nodes = entry.content
    if "limits" in nodes and ("min" in nodes or "max" in nodes):
        faults.add_at(nodes, key, "limits", "limits are given twice", "leave min and max out")
    pair = [nodes.get("min"), nodes.get("max")]
    if "limits" in nodes:
        listed = nodes["limits"].content
        if not isinstance(listed, list) or len(listed) != 2:
            hint = "[134 kN/m, 135 kN/m], or [134 kN/m, null] for an open side"
            faults.add_at(nodes, key, "limits", "two limits are needed", hint)
            return "", ""
        pair = listed
    texts = ["" if node is None or node.content is None else node.text.strip() for node in pair]
    if texts == ["", ""]:
        faults.add(entry, key, "has no limit", "limits: [134 kN/m, 135 kN/m], or one of min and max")
        return "", ""
    amounts = []
    for text, node in zip(texts, pair, strict=True):
        with faults.of_unit(node or entry, join(key, "limits")):
            amounts += [_amount(text)] if text else []
    if len(amounts) == 2 and amounts[0][1] == amounts[1][1] and not amounts[0][0] < amounts[1][0]:
        faults.add(nodes.get("limits", entry), join(key, "limits"), "the lower limit comes first")
    return texts[0], texts[1]


def _amount(text: str) -> tuple[float, Any]:
    written = written_unit(text) or "1"
    unit = parse_unit(written)
    return parse_value(text, written) * unit.factor + unit.offset, unit.dimension


def _read_number(node: Marked | None, key: str, faults: Faults, within: tuple[float, float]) -> float | None:
    if node is None:
        return None
    with faults.of_unit(node, key):
        value = parse_value(node.text, "1")
        if not within[0] < value < within[1]:
            faults.add(node, key, f"must lie between {within[0]:g} and {within[1]:g}")
        return value
    return None


def _read_outcomes(node: Marked | None, key: str, faults: Faults) -> tuple[str, ...]:
    if node is None:
        return (PASS,)
    texts = [entry.text for entry in list_entries(node)]
    for text in texts:
        if text not in OUTCOMES:
            faults.add(node, key, f"unknown outcome '{text}'", nearest(text, OUTCOMES))
    if not texts:
        faults.add(node, key, "an outcome is missing", f"of {', '.join(OUTCOMES)}")
    return tuple(outcome for outcome in OUTCOMES if outcome in texts)


def _rule_texts(entry: Marked, key: str, faults: Faults, item: str, verdicts: tuple[str, ...]) -> list[str]:
    what = item.rpartition(".")[2]
    nodes = list_entries(entry)
    if not nodes or any(isinstance(node.content, (dict, list)) or not node.text.strip() for node in nodes):
        hint = "write for example '>= 0.95', '45.2 kN/m +- 1 %' or 'collinear'"
        faults.add(entry, key, "a rule is missing", hint)
        return []
    texts = [node.text.strip() for node in nodes]
    for text in texts if what in WORDS else ():
        code = text.removeprefix(NOT).removeprefix(ALSO).strip()
        if _COMPARISON.match(text):
            faults.add(entry, key, f"'{what}' is compared with a word, not a number", "write the word alone")
        elif what == "significant" and text not in ("true", "false"):
            faults.add(entry, key, f"'{text}' is neither true nor false")
        elif (
            what == EVERY_WARNING
            and code not in _warnings()
            and (hint := nearest(code, _warnings())).startswith("did you mean")
        ):
            faults.add(entry, key, f"unknown warning '{code}'", hint)
        elif what == "verdict" and verdicts and text not in verdicts:
            faults.add(entry, key, f"unknown verdict '{text}'", nearest(text, verdicts))
    for text in texts:
        if qualities := qualities_of(split_uncertainty(text)[1])[1]:
            what = f"'{', '.join(qualities)}' is of an uncertainty, and a rule states a half width"
            faults.add(entry, key, what, "write for example '45.2 kN/m +- 1 %', or use limits")
    return texts


@cache
def _warnings() -> tuple[str, ...]:
    lines = files("labpipe.records").joinpath("warnings.yaml").read_text("utf-8").splitlines()
    return ("none", *(line.partition(":")[0] for line in lines if not line.startswith("#")))


def _rule(section: str, address: str, entry: Marked, match: re.Match[str], text: str) -> Rule:
    comparison = _COMPARISON.match(text)
    plain = ("+-" if "+-" in text or "±" in text else "="), text
    kind, bound = (comparison[1], comparison[2]) if comparison else plain
    return Rule(
        section=section,
        address=address,
        fit=match["fit"],
        which=match["which"] or "",
        item=match["item"],
        kind=kind,
        bound=bound,
        place=entry.place,
    )

"""The rules of ``accept:`` and ``expect:``: what a result must meet, read from "fit.parameter: rule"."""

from __future__ import annotations

import re
from dataclasses import dataclass

from labpipe.project.marked_yaml import Marked
from labpipe.project.settings_reader import Faults
from labpipe.quantities import UnitError

_COMPARISON = re.compile(r"^\s*(>=|<=|>|<)\s*(.+?)\s*$")
_ADDRESS = re.compile(r"^(?P<fit>[^.\[\]]+)(?:\[(?P<which>[^\]]*)\])?\.(?P<item>.+)$")


@dataclass(frozen=True, kw_only=True)
class Rule:
    """``fit[which].item`` must satisfy *kind*: a comparison (>=, <=, >, <), '+-' (value and tolerance), or
    '=' (a word or flag).

    *which* selects among fits of one name: a test's name or the centre of a sliding band ("72.5 Hz"). *bound*
    is the text behind the comparison, read in the unit of what it is compared with; *place* is where the rule
    stands.
    """

    section: str
    address: str
    fit: str
    which: str
    item: str
    kind: str
    bound: str
    place: str

    @property
    def text(self) -> str:
        """The rule as people read it."""
        return f"{self.address} {self.bound if self.kind in ('+-', '=') else f'{self.kind} {self.bound}'}"


def read_rules(section: str, node: Marked | None, faults: Faults, fits: tuple[str, ...]) -> tuple[Rule, ...]:
    """The rules of one section; faults for unreadable ones and for fits that the pipeline does not have."""
    if node is None:
        return ()
    rules: list[Rule] = []
    for address, entry in faults.mapping(node, section).items():
        match = _ADDRESS.match(address)
        if match is None:
            faults.add(
                entry,
                f"{section}.{address}",
                "is not an address",
                "write fit.parameter, for example direct.k",
            )
        elif match["fit"] not in fits:
            faults.add(
                entry,
                f"{section}.{address}",
                f"there is no fit '{match['fit']}'",
                f"known: {', '.join(fits)}",
            )
        else:
            rules.extend(
                _rule(section, address, entry, match, text)
                for text in _rule_texts(entry, f"{section}.{address}", faults)
            )
    return tuple(rules)


def _rule_texts(entry: Marked, key: str, faults: Faults) -> list[str]:
    """The texts of an entry: one, or a list of which all must hold."""
    nodes = entry.content if isinstance(entry.content, list) else [entry]
    try:
        return [_checked_text(node) for node in nodes]
    except UnitError as error:
        faults.add_unit(entry, key, error)
        return []


def _checked_text(node: Marked) -> str:
    if isinstance(node.content, (dict, list)) or not node.text.strip():
        raise UnitError("a rule is missing", "write for example '>= 0.95', '45.2 kN/m +- 1 %' or 'collinear'")
    return node.text.strip()


def _rule(section: str, address: str, entry: Marked, match: re.Match[str], text: str) -> Rule:
    comparison = _COMPARISON.match(text)
    if comparison:
        kind, bound = comparison[1], comparison[2]
    else:
        kind, bound = ("+-" if "+-" in text or "±" in text else "="), text
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

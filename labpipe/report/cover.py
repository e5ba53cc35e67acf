"""What the cover of a report says beside its title and verdict."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.records.identification import Identification
from labpipe.sections import section

DATES = ("date", "recorded", "day")
MOST_CONDITIONS = 6


def cover_facts(identifications: Sequence[Identification]) -> tuple[tuple[str, str], ...]:
    """(what, which): rig, dates of the recordings where their conditions give them, conditions, sources, version; no clock."""
    rigs = dict.fromkeys(str(one.rig["name"]) for one in identifications if one.rig.get("name"))
    of_sections = [section(name).call("cover", record, default={}) for one in identifications for name, record in one.sections.items()]
    rigs |= dict.fromkeys(facts["rig"] for facts in of_sections if "rig" in facts)
    tests = [response for one in identifications for response in one.responses]
    dates = sorted({str(value) for test in tests for key, value in test.conditions.items() if key.lower() in DATES})
    conditions: dict[str, list[str]] = {}
    for test in tests:
        for key, value in test.conditions.items():
            if key.lower() not in DATES:
                conditions.setdefault(key, []).append(str(value))
    sources = {source["sha256"] for one in identifications for source in one.sources}
    facts = {
        "rig": ", ".join(rigs),
        "recorded": " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "",
        "tests": f"{len(tests)} measured, from {len(sources)} source file(s)" if tests else "",
        **{key: which for facts in of_sections for key, which in facts.items() if key != "rig"},
        **{key: _listed(values) for key, values in list(conditions.items())[:MOST_CONDITIONS]},
        "pipeline": ", ".join(dict.fromkeys(one.pipeline for one in identifications if one.pipeline)),
        "computed by": ", ".join(dict.fromkeys(f"labpipe {one.version}" for one in identifications)),
    }
    return tuple((what, which) for what, which in facts.items() if which)


def _listed(values: Sequence[str]) -> str:
    distinct = list(dict.fromkeys(values))
    return ", ".join(distinct[:8]) + (f" and {len(distinct) - 8} more" if len(distinct) > 8 else "")

"""Entries of the cover of a report beside title and verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from labpipe.records.identification import Identification
from labpipe.sections import section

DATES = ("date", "recorded", "day")
MOST_CONDITIONS = 6


def cover_facts(identifications: Sequence[Identification]) -> tuple[tuple[str, str], ...]:
    """(what, which): rig, dates of the recordings where their conditions give them, conditions, sources,
    version; no clock.
    """
    rigs = dict.fromkeys(str(result.rig["name"]) for result in identifications if result.rig.get("name"))
    of_sections = [facts for result in identifications for facts in section_facts(result)]
    rigs |= dict.fromkeys(facts["rig"] for facts in of_sections if "rig" in facts)
    tests = [conditions for result in identifications for _, conditions in result.measured_tests]
    dates = sorted({str(value) for test in tests for key, value in test.items() if key.lower() in DATES})
    conditions: dict[str, list[str]] = {}
    for test in tests:
        for key, value in test.items():
            if key.lower() not in DATES:
                conditions.setdefault(key, []).append(str(value))
    sources = {source["sha256"] for result in identifications for source in result.sources}
    facts = {
        "rig": ", ".join(rigs),
        "recorded": " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "",
        "tests": f"{len(tests)} measured, from {len(sources)} source file(s)" if tests else "",
        **{key: which for facts in of_sections for key, which in facts.items() if key != "rig"},
        **{key: _listed(values) for key, values in list(conditions.items())[:MOST_CONDITIONS]},
        "pipeline": ", ".join(
            dict.fromkeys(result.pipeline for result in identifications if result.pipeline)
        ),
        "computed by": ", ".join(dict.fromkeys(f"labpipe {result.version}" for result in identifications)),
    }
    return tuple((what, which) for what, which in facts.items() if which)


def section_facts(identification: Identification) -> list[Mapping[str, str]]:
    """Cover entries of the sections of a result."""
    facts = (section(name).cover(record) for name, record in identification.sections.items())
    return [entry for entry in facts if entry]


def _listed(values: Sequence[str]) -> str:
    distinct = list(dict.fromkeys(values))
    return ", ".join(distinct[:8]) + (f" and {len(distinct) - 8} more" if len(distinct) > 8 else "")

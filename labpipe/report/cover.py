"""What the cover of a report says beside its title and verdict."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.records.identification import Identification

DATES = ("date", "recorded", "day")
MOST_CONDITIONS = 6


def cover_facts(identifications: Sequence[Identification]) -> tuple[tuple[str, str], ...]:
    """(what, which): rig, dates of the recordings where their conditions give them, conditions, sources, version; no clock."""
    rigs = dict.fromkeys(str(result.rig["name"]) for result in identifications if result.rig.get("name"))
    run_ups = [result.run_ups for result in identifications if result.run_ups is not None]
    rigs |= dict.fromkeys(result.rotor for result in run_ups)
    tests = [response for result in identifications for response in result.responses]
    dates = sorted({str(value) for test in tests for key, value in test.conditions.items() if key.lower() in DATES})
    conditions: dict[str, list[str]] = {}
    for test in tests:
        for key, value in test.conditions.items():
            if key.lower() not in DATES:
                conditions.setdefault(key, []).append(str(value))
    sources = {source["sha256"] for result in identifications for source in result.sources}
    facts = {
        "rig": ", ".join(rigs),
        "recorded": " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else "",
        "tests": f"{len(tests)} measured, from {len(sources)} source file(s)" if tests else "",
        "run-ups": ", ".join(f"{run.name} ({run.load:.3g} N, {run.role})" for result in run_ups for run in result.runs),
        **{key: _listed(values) for key, values in list(conditions.items())[:MOST_CONDITIONS]},
        "pipeline": ", ".join(dict.fromkeys(result.pipeline for result in identifications if result.pipeline)),
        "computed by": ", ".join(dict.fromkeys(f"labpipe {result.version}" for result in identifications)),
    }
    return tuple((what, which) for what, which in facts.items() if which)


def _listed(values: Sequence[str]) -> str:
    distinct = list(dict.fromkeys(values))
    return ", ".join(distinct[:8]) + (f" and {len(distinct) - 8} more" if len(distinct) > 8 else "")

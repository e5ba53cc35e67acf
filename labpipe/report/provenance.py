"""The last sections of a report: rig and conditions, and where the numbers come from."""

from __future__ import annotations

import json

from labpipe.records.identification import Identification
from labpipe.report.cover import section_facts
from labpipe.report.document import Block, Code, Paragraph, Section, Table

# Parts of the settings that the numbers depend on.
SHOWN_SETTINGS = ("frf", "identify", "calibrate", "run_ups")


def provenance_sections(identification: Identification) -> tuple[Section, ...]:
    """Rig and conditions; sources with their checksums, settings, and how to repeat it all."""
    return (Section("Rig and conditions", _rig(identification)), Section("Provenance", _provenance(identification)))


def rig_blocks(identification: Identification) -> tuple[Block, ...]:
    """The rig in words and its channels as a table; nothing without a rig."""
    rig = identification.rig
    blocks: list[Block] = []
    if rig:
        mass = f" Moving mass {rig['mass']:g} kg." if rig.get("mass") is not None else ""
        blocks.append(Paragraph(f"{rig.get('name') or 'Rig'}. {rig.get('description', '')}{mass}"))
        rows = tuple(
            (
                entry["channel"]["name"],
                entry["column"],
                entry["channel"]["quantity"],
                entry["channel"]["role"],
                entry["channel"]["dof"],
                entry["unit"],
                f"{entry['scale']:.6g}",
            )
            for entry in rig.get("channels", [])
        )
        header = ("channel", "column", "quantity", "role", "dof", "recorded unit", "SI per recorded unit")
        blocks.append(Table(header, rows, "Channels", (6,)))
    return tuple(blocks)


def _rig(identification: Identification) -> tuple[Block, ...]:
    blocks = list(rig_blocks(identification))
    conditions = {name: entry for name, entry in identification.measured_tests if entry}
    stated = tuple((test or "test", key, str(value)) for test, entry in conditions.items() for key, value in entry.items())
    if stated:
        blocks.append(Table(("test", "condition", "value"), stated, "Test conditions"))
    for facts in section_facts(identification) if not blocks else ():
        blocks.append(Paragraph("; ".join(f"{what}: {which}" for what, which in facts.items()) + "."))
    return tuple(blocks) or (Paragraph("The FRFs were given as they are; no rig file was named."),)


def _provenance(identification: Identification) -> tuple[Block, ...]:
    rows = tuple((source["path"], source["sha256"]) for source in identification.sources)
    repeat = f"To repeat: labpipe {identification.version}, `labpipe run {identification.pipeline} -o DIR` over files with these checksums."
    settings = {key: value for key, value in identification.settings.items() if key in SHOWN_SETTINGS}
    return (
        Table(("source file", "SHA-256"), rows, "Source files"),
        Paragraph(repeat),
        Paragraph("Settings in SI units (Hz, s, m, N, rad):"),
        Code(json.dumps(settings, indent=1)),
    )

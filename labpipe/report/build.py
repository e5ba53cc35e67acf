"""From an identification to the document that people read: verdict first, doubt beside every number, provenance last."""

from __future__ import annotations

from collections.abc import Callable

from labpipe.records.identification import Identification
from labpipe.report.cover import cover_facts
from labpipe.report.document import Document, Section
from labpipe.report.fits import fit_sections
from labpipe.report.measurement import measurement_sections
from labpipe.report.provenance import provenance_sections
from labpipe.report.rotor_figure import rotor_sections
from labpipe.report.verdict import verdict_sections
from labpipe.sections import section


def section_parts(identification: Identification) -> tuple[Section, ...]:
    """The parts of all sections of the pipeline beside its fits, in the order in which they were run."""
    return tuple(part for name, record in identification.sections.items() for part in section(name).call("report", record, identification))


# The parts of a report in their order; each gives its sections, or none where the result has nothing of its kind.
PARTS: tuple[Callable[[Identification], tuple[Section, ...]], ...] = (
    verdict_sections,
    section_parts,
    fit_sections,
    measurement_sections,
    rotor_sections,
    provenance_sections,
)


def build(identification: Identification) -> Document:
    """The report of an identification; a pure function of the result."""
    sections = tuple(section for part in PARTS for section in part(identification))
    subtitle = f"Identification report, labpipe {identification.version}"
    return Document(identification.title, subtitle, sections, cover_facts([identification]))

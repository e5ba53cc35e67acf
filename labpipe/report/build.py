"""From an identification to the document that people read: verdict first, doubt beside every number, provenance last."""

from __future__ import annotations

from collections.abc import Callable

from labpipe.records.identification import Identification
from labpipe.report.comparison import comparison_sections
from labpipe.report.cover import cover_facts
from labpipe.report.document import Document, Section
from labpipe.report.fits import fit_sections
from labpipe.report.measurement import measurement_sections
from labpipe.report.provenance import provenance_sections
from labpipe.report.rotor_figure import rotor_sections
from labpipe.report.run_up import run_up_sections
from labpipe.report.study import study_sections
from labpipe.report.unbalance import unbalance_sections
from labpipe.report.verdict import verdict_sections

# The parts of a report in their order; each gives its sections, or none where the result has nothing of its kind.
PARTS: tuple[Callable[[Identification], tuple[Section, ...]], ...] = (
    verdict_sections,
    comparison_sections,
    unbalance_sections,
    run_up_sections,
    study_sections,
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

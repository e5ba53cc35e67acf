"""From an identification to the document that people read: verdict first, doubt beside every number, provenance last."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from labpipe.errors import ConfigError
from labpipe.records.identification import Identification
from labpipe.registry import nearest
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


Part = Callable[[Identification], tuple[Section, ...]]
# The parts of a report in their order; each gives its sections, or none where the result has nothing of its kind.
PARTS: tuple[Part, ...] = (
    verdict_sections,
    section_parts,
    fit_sections,
    measurement_sections,
    rotor_sections,
    provenance_sections,
)


# The parts that hold pages of single tests.
OF_TESTS = (fit_sections, measurement_sections)


def build(identification: Identification, test: str = "") -> Document:
    """The report of an identification; a pure function of the result. *test*: only the pages of that test.

    Pages of tests that a matrix sums up are left out and drawn test by test on demand; fits of other tests, such as a baseline, stay.
    ConfigError for an unknown test.
    """
    if test:
        return _document(_of_test(identification, test), OF_TESTS, f"{identification.title}: {test}")
    parts = tuple(WITH_MATRIX.get(part, part) for part in PARTS) if _in_matrix(identification) else PARTS
    return _document(identification, parts, identification.title)


def _fits_outside(identification: Identification) -> tuple[Section, ...]:
    """The fits of tests that are at no point of a matrix."""
    inside = {test for matrix in identification.sections["matrix"] for point in matrix.points for test in point.tests}
    fits = tuple(fit for fit in identification.fits if fit.test not in inside)
    return fit_sections(replace(identification, fits=fits)) if fits else ()


# What stands in a report instead of these parts where a matrix of tests sums them up.
WITH_MATRIX: dict[Part, Part] = {fit_sections: _fits_outside, measurement_sections: lambda _identification: ()}


def _document(identification: Identification, parts: tuple[Part, ...], title: str) -> Document:
    sections = tuple(section for part in parts for section in part(identification))
    subtitle = f"Identification report, labpipe {identification.version}"
    return Document(title, subtitle, sections, cover_facts([identification]))


def _in_matrix(identification: Identification) -> bool:
    """Whether a matrix of tests sums the fits up."""
    return bool(identification.sections.get("matrix"))


def _of_test(identification: Identification, test: str) -> Identification:
    """The part of a result that belongs to one test."""
    names = [*identification.test_conditions, *(fit.test for fit in identification.fits)]
    if test not in names:
        raise ConfigError(f"the result has no test '{test}'", hint=nearest(test, names))
    fits = tuple(fit for fit in identification.fits if fit.test == test)
    responses = tuple(response for response in identification.responses if response.name == test)
    return replace(
        identification,
        fits=fits,
        responses=responses,
        spectra=tuple(spectrum for spectrum in identification.spectra if spectrum.name == test),
    )

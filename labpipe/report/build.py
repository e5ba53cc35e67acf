"""From an identification to the document that people read: verdict first, uncertainty beside every number,
provenance last.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from itertools import chain
from typing import Any

from labpipe.display import amount_text, count_text, per_cent
from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings
from labpipe.records.finding import NOTE, WARNING, Finding
from labpipe.records.identification import RIGS_BEFORE, Identification, of_points
from labpipe.records.sections import section
from labpipe.registry import Registry, few, nearest
from labpipe.report.cover import all_hold, cover_facts, result_blocks, rule_blocks, section_facts
from labpipe.report.document import Block, Document, Figure, Paragraph, Section, Table
from labpipe.report.fits import fit_sections
from labpipe.report.measurement import measurement_sections
from labpipe.report.wording import fit_title
from labpipe.spectra.settings import FrfSettings

# Name of a model or of a pipeline's section -> the function from an identification to what its results add to
# the report together.
REPORT_PARTS = Registry("report part")

MOST_NOTES = 12
# Characters of all notes of one kind that are still read.
LONGEST_NOTES = 1200
# Codes of findings with which a result must not be used.
SERIOUS = (
    "collinear", "no-convergence", "unphysical", "model-mismatch", "negative-gof", "mass", "drift",
    "wrong-quantity", "unstable-loop", "feedback",
)  # fmt: skip


def verdict_sections(identification: Identification) -> tuple[Section, ...]:
    """Verdict with the numbers that were asked for, warnings and, where there are any, notes."""
    notes, verdict = _notes(identification), _verdict(identification)
    # The numbers stand below what is said of them, above the rules.
    place = 1 + max(n for n, block in enumerate(verdict) if isinstance(block, Paragraph))
    return (
        Section("Verdict", (*verdict[:place], *result_blocks(identification), *verdict[place:])),
        Section("Warnings", _warnings(identification)),
        *([Section("Notes", notes)] if notes else []),
    )


def _verdict(identification: Identification) -> tuple[Block, ...]:
    rows = tuple((failed.name, failed.message) for failed in identification.failed)
    if not rows:
        return _judgement(identification)
    what = "test(s), fit(s) or comparison(s) could not be evaluated. What follows is the rest."
    return (
        Paragraph(f"INCOMPLETE: {len(rows)} {what}", "failed"),
        Table(("name", "why"), rows, "What could not be evaluated"),
        *_judgement(identification),
    )


def _judgement(identification: Identification) -> tuple[Block, ...]:
    outcomes = identification.outcomes
    kinds = len(_by_code(identification, WARNING))
    limit = "of warning below: what limits how far the numbers can be trusted."
    uncertainty = f"{count_text(kinds, 'kind')} {limit}" if kinds else "No warnings."
    serious = _signature_warnings(identification)
    if not outcomes:
        text = f"No acceptance rules were given, so nothing is accepted or refused. {uncertainty}"
        return (Paragraph(text, "note"), *serious)
    failed = sum(not outcome.passed for outcome in outcomes)
    if failed:
        lead = Paragraph(f"NOT ACCEPTED: {failed} of {len(outcomes)} rules fail. {uncertainty}", "failed")
    elif identification.failed:
        # What was not evaluated is not accepted.
        text = f"NOT DECIDED: {all_hold(outcomes)} for what could be evaluated. {uncertainty}"
        lead = Paragraph(text, "warning")
    else:
        missing = _unchecked_sentence(identification)
        text = f"ACCEPTED: {all_hold(outcomes)}. {uncertainty}{missing}"
        lead = Paragraph(text, "note" if missing else "passed")
    # Fits whose rules could only look at the goodness of fit, since no noise is known that chi-square could
    # compare with
    unchecked = "; ".join(_fits_with("no-covariance", identification))
    what = "By G.o.F alone, chi-square could not be checked (no covariance)"
    return (
        lead,
        *((Paragraph(f"{what}: {unchecked}.", "warning"),) if unchecked else ()),
        *serious,
        *rule_blocks(outcomes),
    )


def _unchecked_sentence(identification: Identification) -> str:
    """What no rule looked at, as a sentence; empty where everything was checked, which alone makes a box
    green.
    """
    unchecked = [] if identification.outcomes else ["no accept or expect rule was given"]
    fits = [fit for fit in identification.fits if not of_points(fit.model)]
    without = [fit for fit in fits if fit.gof.chi2_reduced is None]
    reasons = {False: "the noise is not known", True: "there are as many equations as parameters"}
    for exact, reason in reasons.items():
        if named := [fit_title(fit) for fit in without if (fit.noise_dof is not None) is exact]:
            unchecked.append(f"chi-square, since {reason} ({_listing(named)})")
    unjudged = _fits_with("not-judged", identification)
    if unjudged:
        unchecked.append(f"whether the residual is noise ({_listing(unjudged)})")
    return f" Not checked: {'; '.join(unchecked)}." if unchecked else ""


def _listing(origins: Iterable[str], mark: str = ", ") -> str:
    return few(list(dict.fromkeys(origins)), MOST_NOTES, mark)


def _signature_warnings(identification: Identification) -> tuple[Block, ...]:
    """Fits and comparisons that must not be used, named beside the verdict: a rule can pass for the wrong
    reason.
    """
    serious: dict[str, list[str]] = {}
    for origin, finding in _list_findings(identification):
        if finding.code in SERIOUS:
            serious.setdefault(origin, []).append(finding.code)
    if not serious:
        return ()
    named = (f"{origin} ({', '.join(dict.fromkeys(codes))})" for origin, codes in serious.items())
    return (Paragraph(f"Read the warnings before using: {_listing(named, '; ')}.", "warning"),)


def _fits_with(code: str, identification: Identification) -> list[str]:
    return [fit_title(fit) for fit in identification.fits for finding in fit.findings if finding.code == code]


def _list_findings(identification: Identification) -> list[tuple[str, Finding]]:
    of_sections = (section(name).findings(record) for name, record in identification.sections.items())
    of_fits = ((fit_title(fit), finding) for fit in identification.fits for finding in fit.findings)
    return [*of_fits, *chain.from_iterable(of_sections)]


def _by_code(identification: Identification, level: str) -> dict[str, list[tuple[str, Finding]]]:
    measured = [
        (response.name or "measurement", finding)
        for response in identification.responses
        for finding in response.findings
    ]
    codes: dict[str, list[tuple[str, Finding]]] = {}
    for origin, finding in (*measured, *_list_findings(identification)):
        if finding.level == level:
            codes.setdefault(finding.code, []).append((origin, finding))
    return codes


def _warnings(identification: Identification) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for code, entries in _by_code(identification, WARNING).items():
        origin, finding = entries[0]
        more = f" ({len(entries)} times in all; this is the first)" if len(entries) > 1 else ""
        blocks.append(Paragraph(f"{code}: {origin}{more}: {finding.message}", "warning"))
    if not blocks:
        what = " No rule for collinear excitation, coherence, significance, residuals or clipping was broken."
        # Of lines through points there are none of these.
        ruled = identification.responses or not all(of_points(fit.model) for fit in identification.fits)
        missing = _unchecked_sentence(identification)
        blocks.append(Paragraph(f"None.{what if ruled else ''}{missing}", "note" if missing else "passed"))
    return tuple(blocks)


def _notes(identification: Identification) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for code, entries in _by_code(identification, NOTE).items():
        notes = list(dict.fromkeys(f"{origin}: {finding.message}" for origin, finding in entries))
        text = "; ".join(notes)
        if len(notes) > 1 and (len(notes) > MOST_NOTES or len(text) > LONGEST_NOTES):
            text = f"{notes[0]} ({len(notes)} such notes in all; this is the first)"
        blocks.append(Paragraph(f"{code}: {text}.", "note"))
    return tuple(blocks)


# Parts of the settings that the numbers depend on.
SETTINGS = "Settings in SI units (Hz, s, m, N, rad)"
SHOWN_SETTINGS = ("frf", "identify", "calibrate", "run_ups")


def provenance_sections(identification: Identification) -> tuple[Section, ...]:
    """Rig and conditions; sources with their checksums, settings, and how to repeat it all."""
    blocks = list(rig_blocks(identification))
    conditions = {name: entry for name, entry in identification.measured_tests if entry}
    stated = tuple(
        (test or "test", key, str(value))
        for test, entry in conditions.items()
        for key, value in entry.items()
    )
    if stated:
        blocks.append(Table(("test", "condition", "value"), stated, "Test conditions"))
    for facts in section_facts(identification) if not blocks else ():
        blocks.append(Paragraph("; ".join(f"{what}: {which}" for what, which in facts.items()) + "."))
    unnamed = "No rig file was named."
    if identification.responses:
        unnamed = f"The FRFs were given as they are; {unnamed.lower()}"
    return (
        Section("Rig and conditions", tuple(blocks) or (Paragraph(unnamed),)),
        Section("Provenance", _provenance(identification)),
    )


def rig_blocks(identification: Identification) -> tuple[Block, ...]:
    """The rig in words and its channels as a table; nothing without a rig."""
    rig = identification.rig
    if not rig:
        return ()
    mass = f" Moving mass {rig['mass']:g} kg." if rig.get("mass") is not None else ""
    rows = tuple(
        (
            entry["channel"]["name"],
            entry["column"],
            *(entry["channel"][key] for key in ("quantity", "role", "dof")),
            entry["unit"],
            f"{entry['scale']:.6g}",
            "; ".join(_uncertainty_text(each) for each in entry["channel"].get("uncertainties", [])),
        )
        for entry in rig.get("channels", [])
    )
    header = ("channel", "column", "quantity", "role", "dof", "recorded unit", "SI per recorded unit")
    stated = any(row[-1] for row in rows)
    table = (
        Table((*header, "standard uncertainty (source)"), rows, "Channels", (6,))
        if stated
        else Table(header, tuple(row[:-1] for row in rows), "Channels", (6,))
    )
    before = rig.get(RIGS_BEFORE, 0)
    what = f"This is the rig of the last tests; earlier ones rest on {count_text(before, 'other rig file')}."
    return (
        Paragraph(f"{rig.get('name') or 'Rig'}. {rig.get('description', '')}{mass}"),
        *([Paragraph(what, "warning")] if before else []),
        table,
    )


def _uncertainty_text(entry: Mapping[str, Any]) -> str:
    """An uncertainty of a channel in words, as 'gain 0.5 % (sensor 7)'."""
    of, effect = entry["uncertainty"], entry["effect"].replace("_", " ")
    size = per_cent(of["std_error"]) if of["unit"] == "1" else amount_text(of["std_error"], None, of["unit"])
    return f"{effect} {size} ({of['source']})"


def _provenance(identification: Identification) -> tuple[Block, ...]:
    rows = tuple((source["path"], source["sha256"]) for source in identification.sources)
    repeat = (
        f"To repeat: labpipe {identification.version}, `labpipe run {identification.pipeline} -o DIR` "
        "over files with these checksums, with the settings that identification.json states."
    )
    settings = {key: value for key, value in identification.settings.items() if key in SHOWN_SETTINGS}
    return (
        Table(("source file", "SHA-256"), rows, "Source files"),
        Paragraph(repeat),
        *([Table(("setting", "value"), stated, SETTINGS)] if (stated := _stated_settings(settings)) else []),
    )


def _stated_settings(settings: Any, key: str = "") -> tuple[tuple[str, str], ...]:
    if isinstance(settings, Mapping):
        kept = {name: entry for name, entry in settings.items() if entry not in DEFAULTS.get(str(name), ())}
        paths = [(f"{key}.{name}" if key else str(name), entry) for name, entry in kept.items()]
        return tuple(row for path, entry in paths for row in _stated_settings(entry, path))
    if isinstance(settings, list) and settings and isinstance(settings[0], Mapping):
        # What all of several fits share stands once.
        several = len(settings) > 1
        shared = {k: v for k, v in settings[0].items() if several and all(e.get(k) == v for e in settings)}
        paths = [(f"{key}.*", shared)] if shared else []
        for number, entry in enumerate(settings, 1):
            differing = {k: v for k, v in entry.items() if k not in shared}
            paths.append((f"{key}.{entry.get('name', number)}", {**differing, "name": None}))
        return tuple(row for path, entry in paths for row in _stated_settings(entry, path))
    # A number of zero is a setting; it equals False.
    if settings is False or settings in (None, "", []):
        return ()
    parts = settings if isinstance(settings, list) else [settings]
    return ((key, ", ".join(part if isinstance(part, str) else json.dumps(part) for part in parts)),)


def _defaults() -> dict[str, list[Any]]:
    """Settings of responses and fits where a file says nothing, as JSON holds them, by their names."""
    defaults: dict[str, list[Any]] = {}
    for field in (*fields(FrfSettings), *fields(FitSettings)):
        if field.default is not MISSING:
            default: Any = field.default
            whole = asdict(default) if is_dataclass(default) and not isinstance(default, type) else default
            defaults.setdefault(field.name, []).append(json.loads(json.dumps(whole, default=str)))
    return defaults


DEFAULTS = _defaults()


def section_parts(identification: Identification) -> tuple[Section, ...]:
    """The parts of all sections of the pipeline beside its fits, in the order in which they were run."""
    return tuple(
        part
        for name, record in identification.sections.items()
        for part in section(name).report(record, identification)
    )


Part = Callable[[Identification], tuple[Section, ...]]


def added_sections(identification: Identification) -> tuple[Section, ...]:
    """Sections that models, or sections of the pipeline, add for all their results together."""
    there = {fit.model for fit in identification.fits} | set(identification.sections)
    parts = dict.fromkeys(REPORT_PARTS.load(name) for name in REPORT_PARTS.names() if name in there)
    return tuple(section for part in parts for section in part(identification))


# The parts of a report in their order; each gives its sections, or none where the result has nothing of its
# kind.
PARTS: tuple[Part, ...] = (
    verdict_sections,
    section_parts,
    fit_sections,
    measurement_sections,
    added_sections,
    provenance_sections,
)
# The parts that hold pages of single tests.
OF_TESTS = (fit_sections, measurement_sections)


def build(identification: Identification, test: str = "") -> Document:
    """The report of an identification; a pure function of the result. *test*: only the pages of that test.

    Pages of tests that a matrix sums up are left out and drawn test by test on demand; fits of other tests,
    such as a baseline, stay. ConfigError for an unknown test.
    """
    if test:
        return _document(_of_test(identification, test), OF_TESTS, f"{identification.title}: {test}")
    in_matrix = bool(identification.sections.get("matrix"))
    parts = tuple(WITH_MATRIX.get(part, part) for part in PARTS) if in_matrix else PARTS
    return _document(identification, parts, identification.title)


def _fits_outside(identification: Identification) -> tuple[Section, ...]:
    points = (point for matrix in identification.sections["matrix"] for point in matrix.points)
    inside = {test for point in points for test in point.tests}
    fits = tuple(fit for fit in identification.fits if fit.test not in inside)
    return fit_sections(replace(identification, fits=fits)) if fits else ()


# What stands in a report instead of these parts where a matrix of tests sums them up.
WITH_MATRIX: dict[Part, Part] = {
    fit_sections: _fits_outside,
    measurement_sections: lambda _identification: (),
}


def _document(identification: Identification, parts: tuple[Part, ...], title: str) -> Document:
    sections = _each_figure_once([section for part in parts for section in part(identification)])
    subtitle = f"Identification report, labpipe {identification.version}"
    return Document(title, subtitle, sections, cover_facts([identification]))


def _each_figure_once(sections: Sequence[Section]) -> tuple[Section, ...]:
    """The sections without the figures that the first of them has already, by their captions."""
    first, *others = sections
    shown = {block.caption for block in first.blocks if isinstance(block, Figure)}

    def fresh(block: Block) -> bool:
        return not (isinstance(block, Figure) and block.caption in shown)

    return (first, *(Section(other.heading, tuple(filter(fresh, other.blocks))) for other in others))


def _of_test(identification: Identification, test: str) -> Identification:
    names = dict.fromkeys((*identification.test_conditions, *(fit.test for fit in identification.fits)))
    if test not in names:
        hint = nearest(test, filter(None, names)) if any(names) else "its only test has no name"
        raise ConfigError(f"the result has no test '{test}'", hint=hint)
    return replace(
        identification,
        fits=tuple(fit for fit in identification.fits if fit.test == test),
        responses=tuple(response for response in identification.responses if response.name == test),
        spectra=tuple(spectrum for spectrum in identification.spectra if spectrum.name == test),
    )

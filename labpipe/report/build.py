"""From an identification to the document that people read: verdict first, doubt beside every number, provenance last."""

from __future__ import annotations

import json
from collections.abc import Sequence

from labpipe.quantities import display_unit
from labpipe.records.finding import NOTE, WARNING, Finding, of_level
from labpipe.records.identification import Fit, Identification, RuleOutcome
from labpipe.report import figures
from labpipe.report.candidates import candidate_blocks
from labpipe.report.cover import cover_facts
from labpipe.report.document import Block, Code, Document, Paragraph, Section, Table
from labpipe.report.matrix_figure import MOST_TOGETHER, matrix_figure
from labpipe.report.rotor_drawing import rotor_figures
from labpipe.report.spectral_figures import spectral_blocks
from labpipe.report.wear_figures import wear_figures
from labpipe.report.wording import STARS_EXPLAINED, band_text, fit_title, inflated_text, parameter_row, unit_text
from labpipe.sections import section

PARAMETER_HEADER = ("parameter", "value", "unit", "std. error", "95 % interval", "t-ratio", "significance", "VIF")
NUMERIC = (1, 3, 4, 5, 7)
MOST_NOTES = 12


def build(identification: Identification) -> Document:
    """The report of an identification; a pure function of the result."""
    series = _series(identification.fits)
    sections = (
        Section("Verdict", _verdict(identification)),
        Section("Warnings", _warnings(identification)),
        *([Section("Notes", notes)] if (notes := _notes(identification)) else []),
        *(part for name, record in identification.sections.items() for part in section(name).call("report", record, identification)),
        *(Section(f"Result: {_series_title(fits)}", _result(fits)) for fits in series),
        *([Section("Measurement", _measurement(identification))] if identification.responses else []),
        *([Section("Rotor", tuple(rotors))] if (rotors := rotor_figures(identification.settings)) else []),
        Section("Rig and conditions", _rig(identification)),
        Section("Provenance", _provenance(identification)),
    )
    subtitle = f"Identification report, labpipe {identification.version}"
    return Document(identification.title, subtitle, sections, cover_facts([identification]))


def _series(fits: Sequence[Fit]) -> list[list[Fit]]:
    """Fits that belong together: the bands of a sliding fit, the lines of one calibration."""
    groups: dict[tuple[str, str, str], list[Fit]] = {}
    for fit in fits:
        groups.setdefault((fit.name, fit.term, "" if fit.model == "straight-line" else fit.test), []).append(fit)
    return list(groups.values())


def _series_title(fits: list[Fit]) -> str:
    """A calibration's lines stand under one heading, whatever group they belong to."""
    return fits[0].name if fits[0].model == "straight-line" else fit_title(fits[0])


def _verdict(identification: Identification) -> tuple[Block, ...]:
    if identification.failed:
        return (*_failed(identification), *_judged(identification))
    return _judged(identification)


def _failed(identification: Identification) -> tuple[Block, ...]:
    """What is missing, and why: it stands before all that was found."""
    rows = tuple((failed.name, failed.message) for failed in identification.failed)
    lead = Paragraph(f"INCOMPLETE: {len(rows)} test(s) or comparison(s) could not be evaluated. What follows is the rest.", "failed")
    return (lead, Table(("test", "why"), rows, "What could not be evaluated"))


def _judged(identification: Identification) -> tuple[Block, ...]:
    outcomes = identification.outcomes
    codes = _all_findings(identification, WARNING)
    doubt = f" {len(codes)} kind(s) of warning below limit how far the numbers can be trusted." if codes else " No warnings."
    if not outcomes:
        lead = Paragraph(f"No acceptance rules were given, so nothing is accepted or refused.{doubt}", "note")
        return (lead, *_not_to_be_signed(identification))
    failed = sum(not outcome.passed for outcome in outcomes)
    if failed:
        lead = Paragraph(f"NOT ACCEPTED: {failed} of {len(outcomes)} rules fail.{doubt}", "failed")
    else:
        lead = Paragraph(f"ACCEPTED: all {len(outcomes)} rules hold.{doubt}", "passed")
    rows = tuple((outcome.section, outcome.rule, _found(outcome), "holds" if outcome.passed else "FAILS") for outcome in outcomes)
    return (lead, *_not_to_be_signed(identification), Table(("section", "rule", "found (SI)", "outcome"), rows, "Rules of the pipeline"))


SERIOUS = ("collinear", "no-convergence", "unphysical", "model-mismatch", "unstable-loop")


def _not_to_be_signed(identification: Identification) -> tuple[Block, ...]:
    """Fits and comparisons that must not be used as they stand, named beside the verdict: a rule can hold for the wrong reason."""
    named = {fit_title(fit): [f.code for f in fit.findings if f.code in SERIOUS] for fit in identification.fits}
    for origin, finding in section_findings(identification):
        named.setdefault(origin, []).extend([finding.code] if finding.code in SERIOUS else [])
    counted = [f"{title} ({', '.join(dict.fromkeys(codes))})" for title, codes in named.items() if codes]
    if not counted:
        return ()
    return (Paragraph(f"Read the warnings before using: {'; '.join(counted)}.", "warning"),)


def _found(outcome: RuleOutcome) -> str:
    return "none" if outcome.value is None else outcome.value if isinstance(outcome.value, str) else f"{outcome.value:.6g}"


def _all_findings(identification: Identification, level: str) -> dict[str, list[tuple[str, Finding]]]:
    """Every finding of a level by its code, with where it comes from."""
    found: dict[str, list[tuple[str, Finding]]] = {}
    for response in identification.responses:
        for finding in of_level(level, response.findings):
            found.setdefault(finding.code, []).append((response.name or "measurement", finding))
    for fit in identification.fits:
        for finding in of_level(level, fit.findings):
            found.setdefault(finding.code, []).append((fit_title(fit), finding))
    for origin, finding in section_findings(identification):
        if finding.level == level:
            found.setdefault(finding.code, []).append((origin, finding))
    return found


def section_findings(identification: Identification) -> list[tuple[str, Finding]]:
    """Every finding of the sections beside the fits, with where it comes from."""
    return [pair for name, record in identification.sections.items() for pair in section(name).call("findings", record)]


def _warnings(identification: Identification) -> tuple[Block, ...]:
    """Each kind of warning once in full, with the number of fits that carry it."""
    none = "None. No rule for collinear excitation, coherence, significance, residuals or clipping was broken."
    blocks: list[Block] = []
    for code, entries in _all_findings(identification, WARNING).items():
        origin, finding = entries[0]
        more = f" ({len(entries)} times in all; this is the first)" if len(entries) > 1 else ""
        blocks.append(Paragraph(f"{code}: {origin}{more}: {finding.message}", "warning"))
    return tuple(blocks) or (Paragraph(none, "passed"),)


def _notes(identification: Identification) -> tuple[Block, ...]:
    """Each kind of note in one box, every note in full up to a number: they tell what was done, test by test."""
    blocks: list[Block] = []
    for code, entries in _all_findings(identification, NOTE).items():
        told = list(dict.fromkeys(f"{origin}: {finding.message}" for origin, finding in entries))
        more = [f"and {len(told) - MOST_NOTES} more"] if len(told) > MOST_NOTES else []
        blocks.append(Paragraph(f"{code}: {'; '.join([*told[:MOST_NOTES], *more])}.", "note"))
    return tuple(blocks)


def _result(fits: list[Fit]) -> tuple[Block, ...]:
    if fits[0].model == "straight-line":
        return _calibration(fits)
    return _sliding(fits) if len(fits) > 1 else _single(fits[0])


def _single(fit: Fit) -> tuple[Block, ...]:
    rows = tuple(parameter_row(parameter, fit.dof) for parameter in fit.parameters)
    blocks: list[Block] = [
        Paragraph(_described(fit)),
        Table(PARAMETER_HEADER, rows, f"Parameters of {fit_title(fit)}", NUMERIC),
        Paragraph(STARS_EXPLAINED),
        *(Paragraph(note, "note") for note in fit.notes),
        *candidate_blocks(fit),
    ]
    if fit.curve is not None:
        many = len(fit.curve.outputs) * len(fit.curve.inputs) > MOST_TOGETHER
        blocks.append(matrix_figure(fit, fit.curve) if many else figures.fitted_curve_figure(fit, fit.curve))
    blocks.extend(wear_figures(fit))
    if fit.correlation.shape[0] > 1:
        blocks.append(figures.correlation_figure(fit))
    return tuple(blocks)


def _described(fit: Fit) -> str:
    """Model, estimator, band, degrees of freedom and goodness in one paragraph."""
    chi2 = ""
    if fit.gof.chi2_reduced is not None:
        p_value = "" if fit.gof.chi2_p is None else f" (p = {fit.gof.chi2_p:.3g})"
        chi2 = f" The weighted residual has chi² per degree of freedom {fit.gof.chi2_reduced:.3f}{p_value}; 1 is expected."
    end = f"converged after {fit.iterations} iterations" if fit.iterations else "solved directly"
    if not fit.converged:
        end = "NOT converged"
    return (
        f"Model {fit.model}, estimator {fit.estimator}, band {band_text(fit)}: {fit.lines} frequency lines, {fit.equations} real "
        f"equations, {fit.dof} degrees of freedom, {end}. G.o.F (adjusted R²) {fit.gof.r2_adjusted:.5f}.{chi2} "
        f"Condition number {fit.condition_number:.3g}.{inflated_text(fit)}"
    )


def _sliding(fits: list[Fit]) -> tuple[Block, ...]:
    """Coefficients over frequency as figures, and as a table."""
    names = [p.name for p in fits[0].parameters if p.unit in ("N/m", "N.s/m") and not p.derived]
    header = ("band", "centre [Hz]", "G.o.F", *(f"{name} [{_unit(fits[0], name)}]" for name in names), "warnings")
    rows = tuple(
        (
            band_text(fit),
            f"{fit.centre_hz:g}",
            f"{fit.gof.r2_adjusted:.4f}",
            *(_with_error(fit, name) for name in names),
            ", ".join(finding.code for finding in of_level(WARNING, fit.findings)),
        )
        for fit in fits
    )
    first = f"{len(fits)} bands from {fits[0].band_hz[0]:g} to {fits[-1].band_hz[1]:g} Hz; model {fits[0].model}, {fits[0].estimator}. "
    meaning = "Each value belongs to the centre of its band; ± is one standard error, n.s. marks values that cannot be told from zero."
    table = Table(header, rows, f"Bands of {fit_title(fits[0])}", tuple(range(1, 3 + len(names))))
    return (Paragraph(first + meaning), *figures.sliding_figures(fits), table)


def _unit(fit: Fit, name: str) -> str:
    return unit_text(fit.parameter(name).unit)


def _with_error(fit: Fit, name: str) -> str:
    parameter = fit.parameter(name)
    _, value, _, error, _, _, significance, _ = parameter_row(parameter, fit.dof, display_unit(parameter.unit))
    mark = " n.s." if significance == "n.s." else ""
    return f"{value} ± {error}{mark}"


def _calibration(fits: list[Fit]) -> tuple[Block, ...]:
    """Straight lines: slope, intercept and linear range of each; inflation factors say nothing here."""
    rows = tuple((fit.test or fit.name, *parameter_row(parameter, fit.dof)[:-1]) for fit in fits for parameter in fit.parameters)
    table = Table(("line", *PARAMETER_HEADER[:-1]), rows, f"Straight lines of {fits[0].name}", tuple(n + 1 for n in NUMERIC[:-1]))
    goodness = tuple((fit.test or fit.name, f"{fit.gof.r2:.5f}", str(fit.lines), "; ".join(fit.notes)) for fit in fits)
    quality = Table(("line", "R²", "points", "remarks"), goodness, "Goodness of the lines", (1, 2))
    drawing = [figures.line_figure(fits)] if len(fits) > 1 else []
    return (table, Paragraph(STARS_EXPLAINED), quality, *drawing)


def _measurement(identification: Identification) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for response in identification.responses:
        size = f"{len(response.outputs)} x {len(response.inputs)} (responses x forces), {response.n_frequency} lines"
        averages = f"{response.averages:.4g} effective averages"
        blocks.append(Paragraph(f"{response.name or 'Measurement'}: {response.form}, {size}, {averages}."))
        blocks.append(figures.response_figure(response))
        blocks.extend(spectral_blocks(response))
    return tuple(blocks)


def _rig(identification: Identification) -> tuple[Block, ...]:
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
    conditions = {response.name: response.conditions for response in identification.responses if response.conditions}
    rows = tuple((test or "test", key, str(value)) for test, entry in conditions.items() for key, value in entry.items())
    if rows:
        blocks.append(Table(("test", "condition", "value"), rows, "Test conditions"))
    if not blocks and "run_ups" in identification.sections:
        runs = identification.sections["run_ups"]
        return (Paragraph(f"Run-ups of {runs.rotor}, {runs.bearing}; each run's conditions above."),)
    return tuple(blocks) or (Paragraph("The FRFs were given as they are; no rig file was named."),)


def _provenance(identification: Identification) -> tuple[Block, ...]:
    rows = tuple((source["path"], source["sha256"]) for source in identification.sources)
    repeat = f"To repeat: labpipe {identification.version}, `labpipe run {identification.pipeline} -o DIR` over files with these checksums."
    settings = {key: value for key, value in identification.settings.items() if key in ("frf", "identify", "calibrate", "run_ups")}
    return (
        Table(("source file", "SHA-256"), rows, "Source files"),
        Paragraph(repeat),
        Paragraph("Settings in SI units (Hz, s, m, N, rad):"),
        Code(json.dumps(settings, indent=1)),
    )

"""The sections of fits: every single fit in full, the bands of a sliding fit, lines of a calibration, model
selection.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from labpipe.display import difference_in, with_error
from labpipe.quantities import readable_unit, to_display
from labpipe.records.finding import WARNING, of_level
from labpipe.records.fit_details import DETAILS
from labpipe.records.identification import Fit, Identification, of_points
from labpipe.report import figures, wording
from labpipe.report.budget import NOT_STATED, budget_blocks
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.figures import MOST_TOGETHER, matrix_figures

EXPLAINED = (
    "AIC = chi² + 2 parameters: the least is the best supported; 10 above it a model has practically no "
    "support. p: chance of so large "
    "an improvement by the richer model that contains this one, if this one is right."
)
BY_BIC = (
    "BIC = chi² + parameters ln(equations): the least is the best supported, and 10 above it a form is very "
    "strongly spoken against. p: "
    "chance of so large a chi² if this form is right; below 1 % it is not, whatever its BIC."
)


def candidate_blocks(fit: Fit) -> tuple[Block, ...]:
    """Candidate models of the fit, the best first; nothing where there are none."""
    if not fit.candidates:
        return ()
    if fit.candidates[0].bic is not None:
        return _by_bic(fit, fit.candidates[0].bic)
    best = fit.candidates[0].aic
    rows = tuple(
        (
            candidate.name,
            str(candidate.parameters),
            f"{candidate.chi2:.1f}",
            str(candidate.dof),
            f"{candidate.aic - best:.1f}",
            "" if candidate.p_value is None else f"{candidate.p_value:.3g}",
        )
        for candidate in fit.candidates
    )
    header = ("model", "parameters", "chi²", "dof", "AIC - best", "p")
    return (Table(header, rows, "Which structure the data ask for", (1, 2, 3, 4, 5)), Paragraph(EXPLAINED))


def _by_bic(fit: Fit, best: float) -> tuple[Block, ...]:
    rows = tuple(
        (
            candidate.name,
            str(candidate.parameters),
            f"{candidate.chi2 / candidate.dof:.4g}",
            "" if candidate.chi2_p is None else f"{candidate.chi2_p:.2g}",
            "" if candidate.bic is None else f"{candidate.bic - best:.1f}",
        )
        for candidate in fit.candidates
    )
    header = ("form", "parameters", "chi² per dof", "p", "BIC - best")
    return (Table(header, rows, "Which form the data ask for", (1, 2, 3, 4)), Paragraph(BY_BIC))


PARAMETER_HEADER = (
    "parameter", "value", "unit", "std. error", "95 % interval", "t-ratio", "significance", "VIF",
)  # fmt: skip
NUMERIC = (1, 3, 4, 5, 7)
# Estimates whose correlation a sentence says, and pairs that it names. That of more is a figure, and so is
# that of more than the pairs tell where two of them are hardly told apart.
FEW_ESTIMATES, MOST_PAIRS, ENTANGLED = 10, 6, 0.9
_STARS = Paragraph(wording.STARS_EXPLAINED)
_EXPLANATION = Paragraph(f"{wording.STARS_EXPLAINED} {wording.VIF_EXPLAINED}")
SAID_BEFORE = Paragraph("Notes and sources of error that stand with a fit before hold here as well.", "note")


def fit_sections(identification: Identification) -> tuple[Section, ...]:
    """One section for every fit; the bands of a sliding fit and the lines of a calibration share theirs.

    What holds of several fits in the same words stands with the first of them.
    """
    sections: list[Section] = []
    stated: list[object] = []
    groups: dict[tuple[str, str, str], list[Fit]] = {}
    for fit in identification.fits:
        groups.setdefault((fit.name, fit.term, "" if of_points(fit.model) else fit.test), []).append(fit)
    for fits in groups.values():
        title, blocks = _result(fits)
        general = [block for block in blocks if _is_general(block)]
        again = [block for block in general if _wording(block) in stated]
        stated += map(_wording, general)
        pointer = (SAID_BEFORE,) if any(block not in (_STARS, _EXPLANATION) for block in again) else ()
        fresh = tuple(block for block in blocks if not (_is_general(block) and block in again))
        sections.append(Section(f"Result: {title}", (*fresh[:2], *pointer, *fresh[2:])))
    return tuple(sections)


def _is_general(block: Block) -> bool:
    """Whether a block may hold of several fits: signs, notes, and tables that say the same."""
    return (
        isinstance(block, Table)
        or block in (_STARS, _EXPLANATION)
        or (isinstance(block, Paragraph) and block.kind == "note")
    )


def _wording(block: Block) -> object:
    """What a block says: sources that are not stated say the same of every channel."""
    if isinstance(block, Table) and block.header == NOT_STATED:
        return block.caption, tuple(row[1:] for row in block.rows)
    return block


def fit_figures(fit: Fit) -> list[Figure]:
    """Measured and fitted FRF, the repeats that values are means of, correlation of the estimates."""
    shown: list[Figure] = []
    if fit.curve is not None:
        many = len(fit.curve.outputs) * len(fit.curve.inputs) > MOST_TOGETHER
        shown += matrix_figures(fit, fit.curve) if many else [figures.fitted_curve_figure(fit, fit.curve)]
        if fit.curve.before is not None:
            shown.append(figures.tuning_figure(fit, fit.curve))
    repeated = [p for p in fit.estimated if p.repeats is not None]
    if repeated:
        shown.append(figures.repeats_figure(fit, repeated))
    if _is_mapped(fit) and any(p.std_error is not None for p in fit.parameters):
        shown.append(figures.correlation_figure(fit))
    return shown


def _result(fits: list[Fit]) -> tuple[str, tuple[Block, ...]]:
    if of_points(fits[0].model):
        return fits[0].name, _calibration(fits)
    return wording.fit_title(fits[0]), _sliding(fits) if len(fits) > 1 else single_fit_blocks(fits[0])


def single_fit_blocks(fit: Fit) -> tuple[Block, ...]:
    """The section of a fit that stands by itself: parameters, budget, what to know of them, figures."""
    rows = tuple(wording.parameter_row(parameter, fit.error_dof) for parameter in fit.parameters)
    return (
        Paragraph(_description(fit)),
        Table(PARAMETER_HEADER, rows, f"Parameters of {wording.fit_title(fit)}", NUMERIC),
        _EXPLANATION,
        *budget_blocks(fit),
        *_correlation_of_few(fit),
        *(Paragraph(sentence, "note") for sentence in wording.entangled_text(fit)),
        *(Paragraph(note, "note") for note in fit.notes),
        *candidate_blocks(fit),
        *blocks_of_details(fit),
        *fit_figures(fit),
    )


def blocks_of_details(fit: Fit) -> list[Block]:
    """What the model of a fit shows beside its parameters, such as a decay."""
    return [block for detail in fit.details for block in DETAILS.load(detail.key).blocks(fit, detail)]


def _is_mapped(fit: Fit) -> bool:
    n = fit.correlation.shape[0]
    entangled = np.any(np.abs(np.triu(fit.correlation, 1)) > ENTANGLED)
    return n > FEW_ESTIMATES or bool(n * (n - 1) / 2 > MOST_PAIRS and entangled)


def _correlation_of_few(fit: Fit) -> tuple[Block, ...]:
    n = fit.correlation.shape[0]
    if n < 2 or _is_mapped(fit) or all(parameter.std_error is None for parameter in fit.parameters):
        return ()
    names = [parameter.name for parameter in fit.estimated]
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    pairs.sort(key=lambda pair: -abs(fit.correlation[pair]))
    text = ", ".join(f"{names[i]} and {names[j]}: {fit.correlation[i, j]:.3g}" for i, j in pairs[:MOST_PAIRS])
    rest = "" if len(pairs) <= MOST_PAIRS else "; of all others it is smaller"
    return (Paragraph(f"Correlation between the estimates of {text}{rest}."),)


def _description(fit: Fit) -> str:
    lines = "samples or lines" if any(detail.in_time for detail in fit.details) else "frequency lines"
    chi2 = ""
    if fit.gof.chi2_reduced is not None:
        p_value = "" if fit.gof.chi2_p is None else f" (p = {fit.gof.chi2_p:.3g})"
        chi2 = (
            f" The weighted residual has chi² per degree of freedom {fit.gof.chi2_reduced:.3f}{p_value}; "
            "1 is expected."
        )
    end = f"converged after {fit.iterations} iterations" if fit.iterations else "solved directly"
    if not fit.converged:
        end = "NOT converged"
    goodness = f"G.o.F (adjusted R²) {fit.gof.r2_adjusted:.5f}."
    if fit.noise_dof is not None:
        goodness = "Exactly determined: intervals are by the noise alone, and nothing tests the model."
    return (
        f"Model {fit.model}, estimator {fit.estimator}, band {wording.band_text(fit)}: {fit.lines} {lines}, "
        f"{fit.equations} real equations, {fit.dof} degrees of freedom, {end}. {goodness}{chi2} "
        f"Condition number {fit.condition_number:.3g}."
        f"{wording.interval_text(fit)}"
    )


def _sliding(fits: list[Fit]) -> tuple[Block, ...]:
    units = {
        name: readable_unit(unit, (p.value for p in figures.per_band(fits, name) if p is not None))
        for name, unit in figures.sliding_units(fits).items()
    }
    titles = (wording.title(name, unit) for name, unit in units.items())
    header = ("band", "centre [Hz]", "G.o.F", *titles, "warnings")
    rows = tuple(_band_row(fit, units) for fit in fits)
    meaning = (
        f"{len(fits)} bands from {fits[0].band_hz[0]:g} to {fits[-1].band_hz[1]:g} Hz; model "
        f"{fits[0].model}, {fits[0].estimator}. Each value belongs to the centre of its band; ± is one "
        "standard uncertainty, n.s.: not significantly different from zero."
    )
    table = Table(header, rows, f"Bands of {wording.fit_title(fits[0])}", tuple(range(1, 3 + len(units))))
    return (Paragraph(meaning), *figures.sliding_figures(fits), table)


def _band_row(fit: Fit, units: Mapping[str, str]) -> tuple[str, ...]:
    return (
        wording.band_text(fit),
        f"{fit.centre_hz:g}",
        f"{fit.gof.r2_adjusted:.4f}",
        *(_with_error(fit, name, unit) for name, unit in units.items()),
        ", ".join(finding.code for finding in of_level(WARNING, fit.findings)),
    )


def _with_error(fit: Fit, name: str, unit: str) -> str:
    (parameter,) = figures.per_band([fit], name)
    if parameter is None:
        return "eliminated"
    error = None if parameter.full_error is None else difference_in(parameter.full_error, unit)
    mark = " n.s." if wording.significance(parameter, fit.error_dof) == "n.s." else ""
    return f"{with_error(to_display(parameter.value, unit), error)}{mark}"


def _calibration(fits: list[Fit]) -> tuple[Block, ...]:
    rows = tuple(
        (fit.test or fit.name, *wording.parameter_row(parameter, fit.error_dof)[:-1])
        for fit in fits
        for parameter in fit.parameters
    )
    header, numeric = ("line", *PARAMETER_HEADER[:-1]), tuple(n + 1 for n in NUMERIC[:-1])
    table = Table(header, rows, f"Slopes of {fits[0].name}", numeric)
    goodness = tuple(
        (fit.test or fit.name, f"{fit.gof.r2:.5f}", str(fit.lines), "; ".join(fit.notes)) for fit in fits
    )
    quality = Table(("line", "R²", "points", "remarks"), goodness, "Goodness of the lines", (1, 2))
    slopes = [figures.line_figure(fits)] if len(fits) > 1 else []
    return (table, _STARS, quality, *slopes)

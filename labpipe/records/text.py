"""Records as text: one line for a list, a table for a console, a table for a notebook.

And their views for other libraries.
"""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from labpipe.display import amount_text, difference_in, shown_unit, unit_label, write_values
from labpipe.quantities import to_display
from labpipe.records.finding import WARNING, Parameter, of_level
from labpipe.registry import Registry

if TYPE_CHECKING:
    from labpipe.records.identification import Fit, Identification
    from labpipe.records.recording import Recording
    from labpipe.records.response import FrequencyResponse

# Largest number of parameters in one line.
MOST_NAMED = 4
HEADER = ("parameter", "value", "std. error", "95 % interval", "unit", "")


def fit_line(fit: Fit) -> str:
    """Name, model, estimator, band, goodness, warnings and the first parameters with their standard
    errors.
    """
    title = " ".join(
        part
        for part in (
            fit.name or "fit",
            f"[{fit.test}]" if fit.test else "",
            f"of {fit.term}" if fit.term else "",
        )
        if part
    )
    band = f"{fit.band_hz[0]:g}-{fit.band_hz[1]:g} Hz"
    named = [
        f"{p.name} = {amount_text(p.value, p.full_error, p.unit, '+-')}" for p in fit.parameters[:MOST_NAMED]
    ]
    more = [f"{len(fit.parameters) - MOST_NAMED} more"] if len(fit.parameters) > MOST_NAMED else []
    codes = list(dict.fromkeys(finding.code for finding in of_level(WARNING, fit.findings)))
    warnings = f"; warnings: {', '.join(codes)}" if codes else ""
    return (
        f"<Fit {title}: {fit.model}, {fit.estimator}, {band}, {fit.goodness_text}; "
        f"{', '.join([*named, *more])}{warnings}>"
    )


def fit_text(fit: Fit) -> str:
    """Statistics, parameters with their uncertainty, correlations and findings, as a console shows them."""
    rows = [parameter_cells(parameter) for parameter in fit.parameters]
    widths = [max(len(row[n]) for row in [HEADER, *rows]) for n in range(len(HEADER))]
    table = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [HEADER, *rows]
    ]
    chi2 = "" if fit.gof.chi2_reduced is None else f", chi2/dof {fit.gof.chi2_reduced:.3f}"
    head = [
        f"{fit.name or 'fit'}{f' [{fit.test}]' if fit.test else ''}: {fit.model}, estimator {fit.estimator}",
        f"band {fit.band_hz[0]:g}-{fit.band_hz[1]:g} Hz, {fit.lines} lines, {fit.equations} equations, "
        f"{fit.dof} degrees of freedom",
        f"{fit.goodness_text}{chi2}, condition number "
        f"{fit.condition_number:.3g}{'' if fit.converged else ', NOT CONVERGED'}",
        "",
    ]
    findings = [f"{finding.level} {finding.code}: {finding.message}" for finding in fit.findings]
    return "\n".join([*head, *table, *_correlation_lines(fit), *findings])


def _correlation_lines(fit: Fit) -> list[str]:
    names = [parameter.name for parameter in fit.estimated]
    n = min(len(names), fit.correlation.shape[0])
    pairs = [(float(fit.correlation[i, j]), names[i], names[j]) for i in range(n) for j in range(i)]
    large = sorted((pair for pair in pairs if abs(pair[0]) > 0.5), key=lambda pair: -abs(pair[0]))
    return [f"correlation of {second} and {first}: {value:+.2f}" for value, first, second in large]


def fit_html(fit: Fit) -> str:
    """The parameters as a table of a notebook."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in HEADER)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in parameter_cells(p))}</tr>"
        for p in fit.parameters
    )
    notes = "".join(
        f"<p>{escape(f'{finding.level} {finding.code}: {finding.message}')}</p>" for finding in fit.findings
    )
    return f"<p>{escape(fit_line(fit)[1:-1])}</p><table><tr>{head}</tr>{body}</table>{notes}"


def parameter_cells(parameter: Parameter, unit: str = "") -> tuple[str, ...]:
    """Name, value, standard error, interval, unit and limits, in *unit*, by default that which suits the
    value.
    """
    unit = unit or shown_unit(parameter.unit, parameter.value, parameter.full_error)
    limits = "at bound" if parameter.at_bound else "not significant" if parameter.significant is False else ""
    error = None if parameter.full_error is None else difference_in(parameter.full_error, unit)
    ends = () if parameter.ci95 is None else tuple(to_display(end, unit) for end in parameter.ci95)
    value, uncertainty, *interval = write_values(to_display(parameter.value, unit), error, *ends)
    return (parameter.name, value, uncertainty, " to ".join(interval), unit_label(unit), limits)


def response_line(response: FrequencyResponse) -> str:
    """Form, size, band and uncertainty of a response."""
    size = f"{len(response.outputs)} x {len(response.inputs)}"
    band = (
        f"{response.n_frequency} lines {response.frequency[0]:g}-{response.frequency[-1]:g} Hz"
        if response.n_frequency
        else "no lines"
    )
    uncertainty = "with covariance" if response.variance is not None else "without covariance"
    return (
        f"<FrequencyResponse {response.name or 'response'}: {response.form}, {size} (outputs x inputs), "
        f"{band}, {uncertainty}>"
    )


def recording_line(recording: Recording) -> str:
    """Channels, rate and length of a recording."""
    channels = ", ".join(f"{channel.name} [{channel.unit}]" for channel in recording.channels)
    seconds = recording.n_sample / recording.sample_rate
    return (
        f"<Recording {recording.name or 'recording'}: {channels}; {recording.sample_rate:g} Hz, "
        f"{seconds:.6g} s>"
    )


def identification_line(identification: Identification) -> str:
    """Title, number of fits, other sections and the verdict."""
    sections = f", {', '.join(identification.sections)}" if identification.sections else ""
    rules = (
        "no rules"
        if not identification.outcomes
        else "accepted"
        if identification.accepted
        else "NOT ACCEPTED"
    )
    verdict = "INCOMPLETE" if identification.failed else rules
    return f"<Identification {identification.title}: {len(identification.fits)} fits{sections}; {verdict}>"


# Views of a record for other libraries, loaded on first use. VIEWS by name.

VIEWS = Registry("view")

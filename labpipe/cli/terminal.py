"""Results as short tables on the terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence

import click

from labpipe.cli.output import echo, for_terminal, message_line
from labpipe.records.finding import NOTE, WARNING, Finding, Parameter, of_level
from labpipe.records.identification import DatasetIndex, Failed, Fit, Identification
from labpipe.records.sections import section
from labpipe.records.text import parameter_cells

Say = Callable[[str], None]
MAX_BANDS = 8
MAX_NOTES = 8
# Numerous parameters such as mode shapes are only in identification.json and the report.
IN_REPORT_ONLY = ("shape_", "participation_")


def echo_result(identification: Identification, quiet: bool, folder: str = "", *files: str) -> int:
    """What an identification gives, the *files* written to a *folder*, and failed tests; the exit code of the
    command.
    """
    echo_identification(identification, quiet)
    if files and not quiet:
        echo(f"written: {folder}/{', '.join(files)}")
    echo_failed(identification.failed)
    return 2 if identification.failed else 0 if identification.accepted else 1


def echo_failed(failed: Sequence[Failed]) -> None:
    """List the failed tests on standard error, at the end."""
    for failure in failed:
        echo(message_line(f"error: {failure.name}: {failure.message}"), err=True)
    if failed:
        cure = "correct the fault and run the same command again"
        echo(f"{len(failed)} failed, the rest is finished; {cure}", err=True)


def echo_identification(identification: Identification, quiet: bool) -> None:
    """Findings of the measurement, fits, and outcomes of rules; *quiet*: warnings and rules that fail alone.

    Long sliding series are shortened, the report is complete.
    """
    say: Say = (lambda _line: None) if quiet else echo
    if identification.dataset is not None:
        _echo_dataset(identification.dataset, say)
    _echo_findings([response.findings for response in identification.responses], "tests", say)
    for name in dict.fromkeys(fit.name for fit in identification.fits):
        fits = [fit for fit in identification.fits if fit.name == name]
        displayed = fits if len(fits) <= MAX_BANDS else [*fits[: MAX_BANDS // 2], *fits[-MAX_BANDS // 2 :]]
        for number, fit in enumerate(displayed):
            if len(displayed) < len(fits) and number == MAX_BANDS // 2:
                say(f"  ... {len(fits) - len(displayed)} more fits of '{name}' in identification.json ...")
            _echo_fit(fit, say)
        _echo_findings([fit.findings for fit in fits], "fits", say)
    for name, record in identification.sections.items():
        for line in section(name).terminal(record):
            say(line)
        _echo_findings([tuple(finding for _, finding in section(name).findings(record))], name, say)
    for outcome in identification.outcomes:
        mark = _colour("passed", "green") if outcome.passed else _colour("FAILED", "red")
        tell = say if outcome.passed else echo
        tell(f"  {outcome.section}: {outcome.rule}: {mark} (found {outcome.found})")


def _echo_dataset(index: DatasetIndex, say: Say) -> None:
    fits = ", ".join(f"{count} of {name}" for name, count in index.fits.items())
    failed = f", {index.failed} failed" if index.failed else ""
    refused = f", {index.not_accepted} not accepted" if index.not_accepted else ""
    say(
        f"{index.tests} tests evaluated{failed}{refused}; fits: {fits or 'none'}; {index.rows} rows in "
        "dataset/"
    )
    for counted in index.of_level(WARNING):
        echo(f"  {_colour('warning', 'yellow')} {counted.message}")
    for counted in index.of_level(NOTE)[:MAX_NOTES]:
        say(f"  {_colour('note', 'cyan')} {counted.message}")


def _echo_fit(fit: Fit, say: Say) -> None:
    test = f" [{fit.test}]" if fit.test else ""
    term = f" of {fit.term}" if fit.term else ""
    band = f" {fit.band_hz[0]:g}-{fit.band_hz[1]:g} Hz" if fit.band_hz[1] > fit.band_hz[0] else ""
    chi2 = "" if fit.gof.chi2_reduced is None else f", chi2/dof {fit.gof.chi2_reduced:.2f}"
    say(f"{fit.name}{term}{test}: {fit.model}, {fit.estimator}{band}, {fit.goodness_text}{chi2}")
    for parameter in fit.parameters:
        if not parameter.name.startswith(IN_REPORT_ONLY):
            say(f"  {_parameter_line(parameter)}")
    if fit.candidates:
        best = fit.candidates[0]
        quality = f"{best.parameters} parameters, chi2/dof {best.chi2 / best.dof:.2f}"
        criterion = "AIC" if best.bic is None else "BIC"
        say(f"  best of {len(fit.candidates)} models by {criterion}: {best.name} ({quality})")


def _parameter_line(parameter: Parameter) -> str:
    name, value, error, _, unit, _ = map(for_terminal, parameter_cells(parameter))
    mark = "" if parameter.significant is not False or parameter.derived else " *"
    if parameter.full_error is None:
        return f"{name:<14}{value:>12} {unit}".rstrip()
    what = "combined uncertainty" if parameter.systematic else "standard error"
    sign = for_terminal(" +- ")
    return f"{name:<14}{value:>12}{sign}{error:<9} {unit:<6} ({what}){mark}"


def _echo_findings(carriers: list[tuple[Finding, ...]], what: str, say: Say) -> None:
    by_code: dict[str, dict[int, str]] = {}
    for number, findings in enumerate(carriers):
        for finding in of_level(WARNING, findings):
            by_code.setdefault(finding.code, {}).setdefault(number, finding.message)
    for code, messages in by_code.items():
        times = "" if len(carriers) == 1 else f" (in {len(messages)} of {len(carriers)} {what}; the first:)"
        echo(f"  {_colour('warning', 'yellow')} {code}{times}: {for_terminal(next(iter(messages.values())))}")
    notes = list(dict.fromkeys(finding for findings in carriers for finding in of_level(NOTE, findings)))
    for finding in notes[:MAX_NOTES]:
        say(f"  {_colour('note', 'cyan')} {finding.code}: {for_terminal(finding.message)}")
    if len(notes) > MAX_NOTES:
        say(f"  ... {len(notes) - MAX_NOTES} more notes in the report ...")


def _colour(text: str, colour: str) -> str:
    plain = os.environ.get("NO_COLOR") or not sys.stdout.isatty()
    return text if plain else click.style(text, fg=colour)

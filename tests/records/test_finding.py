"""Notes and warnings: told apart by files, terminal, report, rules and tables.

Only warnings weigh on the verdict.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.cli.stages import echo_measured
from labpipe.cli.terminal import echo_identification
from labpipe.document.render import html_report
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.project.exports import parameter_table
from labpipe.project.judging import judge
from labpipe.project.rules import Rule
from labpipe.records.finding import NOTE, WARNING, Finding, note, of_level
from labpipe.records.identification import Identification
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

MASKED = note("masked", "lines of the shaft speed are left out: 49.6-50.4 Hz")
CLIPPED = Finding("clipped", "channel y clips at 3 samples")


@pytest.fixture
def response(rng: np.random.Generator) -> FrequencyResponse:
    frequency = np.arange(30.0, 100.0)
    w = 2 * np.pi * frequency
    clean = (1 / (134.5e3 - 0.79 * w**2 + 3.7j * w))[:, None, None]
    noise = 1e-7 * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)) / np.sqrt(2)
    ports = (Port("y", "y", "y"),), (Port("f", "f", "y"),)
    return FrequencyResponse(
        frequency,
        clean + noise,
        *ports,
        covariance=diagonal_covariance(np.full(clean.shape, 1e-14)),
        findings=(MASKED,),
    )


def identification(response: FrequencyResponse, *of_fit: Finding) -> Identification:
    (fit,) = identify(response, FitSettings("sdof", mass=0.79, name="pedestal"))
    return Identification((replace(fit, findings=of_fit),), "Pedestal", responses=(response,))


def test_a_finding_is_a_note_or_a_warning() -> None:
    assert CLIPPED.level == WARNING and MASKED.level == NOTE
    assert of_level(NOTE, [MASKED, CLIPPED, MASKED]) == (MASKED, MASKED) and of_level(WARNING, [MASKED]) == ()
    with pytest.raises(ValueError, match="a note or a warning, not 'error'"):
        Finding("clipped", "", "error")


def test_the_level_survives_files(response: FrequencyResponse, tmp_path: Path) -> None:
    both = replace(response, findings=(MASKED, CLIPPED))
    write_response(tmp_path / "a.frf.parquet", both, Header("frf", {}, inputs=()))
    assert read_response(tmp_path / "a.frf.parquet").findings == (MASKED, CLIPPED)
    write_identification(tmp_path / "identification.json", identification(both, MASKED, CLIPPED))
    again = read_identification(tmp_path / "identification.json")
    assert set(again.responses[0].findings) == set(again.fits[0].findings) == {MASKED, CLIPPED}
    assert set(parameter_table(tmp_path / "identification.json")["warnings"]) == {"clipped"}


@pytest.mark.parametrize(("word", "passed"), [("none", True), ("masked", False), ("not masked", True)])
def test_rules_on_warnings_do_not_see_notes(response: FrequencyResponse, word: str, passed: bool) -> None:
    fits = identification(response, MASKED).fits
    rule = Rule(
        section="accept",
        address="pedestal.warnings",
        fit="pedestal",
        which="",
        item="warnings",
        kind="=",
        bound=word,
        place="p.yaml:3",
    )
    assert [outcome.passed for outcome in judge([rule], fits, {})] == [passed]


def test_the_report_counts_warnings_and_shows_notes_apart(response: FrequencyResponse) -> None:
    text = html_report(identification(response)).decode()
    assert "No warnings." in text and re.search(
        r"Notes</h2>.*masked: measurement: lines of the shaft speed", text, re.DOTALL
    )
    text = html_report(identification(response, CLIPPED)).decode()
    warnings, notes = text.index("Warnings</h2>"), text.index("Notes</h2>")
    assert "1 kind of warning" in text and warnings < text.index("clipped:") < notes < text.index("masked:")
    assert "Notes</h2>" not in html_report(identification(replace(response, findings=()), CLIPPED)).decode()


def test_the_terminal_names_the_level(
    response: FrequencyResponse, capsys: pytest.CaptureFixture[str]
) -> None:
    echo_identification(identification(response, CLIPPED), quiet=False)
    out = capsys.readouterr().out
    assert (
        "note masked: lines of" in out and "warning clipped: channel y" in out and "warning masked" not in out
    )
    echo_measured(replace(response, findings=(MASKED, CLIPPED)), quiet=True)
    assert capsys.readouterr().out == "  warning clipped: channel y clips at 3 samples\n"

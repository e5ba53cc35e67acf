"""Short tables on the terminal: counts of datasets, kinds of findings, numbers of fits, time that is left."""

from __future__ import annotations

import errno
import warnings

import click
import numpy as np
import pytest

from labpipe.cli.main import INTERRUPTED, MOST_FAULTS, group, run_command
from labpipe.cli.many import Progress
from labpipe.cli.terminal import echo_identification
from labpipe.errors import ConfigError, ConfigErrors
from labpipe.records.finding import NOTE, Finding, Parameter
from labpipe.records.identification import (
    Candidate,
    CountedFinding,
    DatasetIndex,
    Fit,
    Goodness,
    Identification,
    RuleOutcome,
)


def a_fit(number: int = 0, findings: tuple[Finding, ...] = (), **entries: object) -> Fit:
    return Fit(
        "axial",
        "sdof",
        "ml",
        band_hz=(10.0 + number, 40.0),
        lines=9,
        equations=18,
        dof=16,
        gof=Goodness(0.99, 0.98, 1.234),
        parameters=(Parameter("k", 18.3e3, "N/m", std_error=20.0),),
        condition_number=1.0,
        correlation=np.eye(1),
        findings=findings,
        **entries,
    )


def lines_of(result: Identification, capsys: pytest.CaptureFixture[str]) -> list[str]:
    echo_identification(result, quiet=False)
    return capsys.readouterr().out.splitlines()


def test_a_dataset_is_counted_with_each_kind_of_finding_once(capsys: pytest.CaptureFixture[str]) -> None:
    findings = (
        CountedFinding(Finding("drift", "k fell"), "t1", 3),
        *(CountedFinding(Finding(f"n{n}", "so it is", NOTE), "t2", 1) for n in range(9)),
    )
    index = DatasetIndex(
        tests=12, failed=2, not_accepted=3, rows=96, fits={"a": 12, "b": 11}, findings=findings
    )
    shown = lines_of(Identification((), dataset=index), capsys)
    counts = "12 tests evaluated, 2 failed, 3 not accepted; fits: 12 of a, 11 of b; 96 rows in dataset/"
    warning = "  warning drift: t1 (3 tests in all; this is the first): k fell"
    assert shown == [counts, warning, *(f"  note n{n}: t2: so it is" for n in range(8))]


def test_fits_of_a_long_series_are_its_ends(capsys: pytest.CaptureFixture[str]) -> None:
    """The first four and the last four of twelve."""
    shown = lines_of(Identification(tuple(a_fit(number) for number in range(12))), capsys)
    heads = [line for line in shown if line.startswith("axial")]
    assert heads == [
        f"axial: sdof, ml {10 + n}-40 Hz, G.o.F 0.9800, chi2/dof 1.23" for n in (0, 1, 2, 3, 8, 9, 10, 11)
    ]
    assert shown[8] == "  ... 4 more fits of 'axial' in identification.json ..."
    assert shown[1].split() == ["k", "18.300", "±", "0.020", "kN/m", "(standard", "error)"]


def test_a_warning_of_several_fits_stands_once_and_notes_are_cut(capsys: pytest.CaptureFixture[str]) -> None:
    notes = tuple(Finding(f"n{n}", "so it is", NOTE) for n in range(10))
    fits = (a_fit(0), a_fit(1, (Finding("drift", "k fell"), *notes)), a_fit(2, (Finding("drift", "k rose"),)))
    shown = lines_of(Identification(fits), capsys)[6:]
    assert shown[0] == "  warning drift (in 2 of 3 fits; the first:): k fell"
    assert shown[1:] == [f"  note n{n}: so it is" for n in range(8)] + [
        "  ... 2 more notes in the report ..."
    ]


def test_the_best_of_several_models_is_named_with_its_criterion(capsys: pytest.CaptureFixture[str]) -> None:
    models = Candidate("free", 3, 440.0, 400, 446.0, bic=458.0), Candidate("clamped", 2, 900.0, 401, 904.0)
    assert lines_of(Identification((a_fit(candidates=models),)), capsys)[-1] == (
        "  best of 2 models by BIC: free (3 parameters, chi2/dof 1.10)"
    )


def test_the_time_that_is_left_is_that_of_the_tests_before(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """3 of 12 tests in 30 s: the others take 90 s; a terminal has it on one line from a while on."""
    clock = [100.0]
    monkeypatch.setattr("labpipe.cli.many.time.monotonic", lambda: clock[0])
    by_line, on_one = Progress(True), Progress(False)
    clock[0] = 130.0
    by_line(3, 12, "t3")
    assert capsys.readouterr().err == "test 3 of 12  t3, 1 min 30 s left\n"
    on_one(3, 12, "t3")
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    on_one(3, 12, "t3")
    clock[0] = 220.0
    on_one(12, 12, "t12")
    shown = capsys.readouterr().err.split("\r\x1b[K")
    assert shown == ["", "3 of 12 tests, 1 min 30 s left", "12 of 12 tests in 2 min 0 s\n"]


FAULTS = ConfigErrors([ConfigError(f"fault {n}", "p.yaml:1:1") for n in range(MOST_FAULTS + 3)])


@pytest.mark.parametrize(
    ("error", "lines"),
    [
        (
            FAULTS,
            [f"error: p.yaml:1:1: fault {n}" for n in range(MOST_FAULTS)]
            + ["error: and 3 more faults of this kind"],
        ),
        (OSError(errno.ENOSPC, "", "out/x"), ["error: out/x: no space left on device"]),
        (OSError(errno.ENOSPC, ""), ["error: output: no space left on device"]),
        (
            MemoryError(),
            [
                "error: there is not enough memory for this; check lengths, rates and block sizes, or use "
                "fewer processes"
            ],
        ),
        (KeyboardInterrupt(), [f"error: {INTERRUPTED}"]),
        (click.UsageError("no such option."), ["error: no such option; see 'labpipe --help'"]),
    ],
)
def test_what_ends_a_command_is_said_in_its_lines(
    error: BaseException,
    lines: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def ended(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(group, "main", ended)
    monkeypatch.setattr("warnings.showwarning", None)
    assert run_command([]) == 2
    assert capsys.readouterr().err.splitlines() == lines


@pytest.mark.parametrize(
    ("category", "line"),
    [
        (FutureWarning, "note: 'a' is called 'b' now"),
        (RuntimeWarning, "warning: 'a' is called 'b' now (RuntimeWarning)"),
    ],
)
def test_a_warning_of_a_library_is_one_line(
    category: type[Warning], line: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def warned(*_: object, **__: object) -> int:
        warnings.showwarning("'a' is called 'b' now", category, "x.py", 7)
        return 1

    monkeypatch.setattr(group, "main", warned)
    monkeypatch.setattr("warnings.showwarning", None)
    assert run_command([]) == 1 and capsys.readouterr().err == f"{line}\n"


def test_quiet_leaves_warnings_and_rules_that_fail(capsys: pytest.CaptureFixture[str]) -> None:
    """As the help of -q says."""
    findings = (Finding("drift", "k fell"), Finding("n", "so it is", NOTE))
    rules = tuple(RuleOutcome("accept", f"axial.k >= {n}", 1.0, n < 1) for n in range(2))
    echo_identification(Identification((a_fit(0, findings),), outcomes=rules), quiet=True)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "  warning drift: k fell" and lines[1].startswith("  accept: axial.k >= 1: FAILED")
    assert len(lines) == 2

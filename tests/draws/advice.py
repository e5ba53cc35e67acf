"""Is the first thing that a warning advises the thing that cures it?

python -m tests.draws.advice [FAULT ...]

A fault is put into the raw file of a virtual test of one mode, the test is run from its YAML files, the first
advice of the finding, or of the refusal, is followed as it is printed, and the test is run again: is the
warning gone, and does the 95 % interval, half as wide again, hold the truth? docs/pages/how-to/advice.md has
the table.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import labpipe
from labpipe.errors import LabpipeError
from labpipe.records.finding import WARNING, Finding
from tests.draws.faults import FAULTS, Fault, Outcome, Run

WIDER = 1.5


def tried(test: Run, folder: Path) -> Outcome:
    """What a test says: codes and messages of all findings, or of its refusal, and values with intervals."""
    try:
        result = labpipe.run(test.written(folder), folder / "out")
    except LabpipeError as error:
        return Outcome({"error": f"{error.what}; {error.hint or ''}"}, {})
    findings: list[Finding] = [f for one in (*result.responses, *result.spectra) for f in one.findings]
    findings += [finding for fit in result.fits for finding in fit.findings]
    # A warning hides a note of the same code.
    findings.sort(key=lambda finding: finding.level == WARNING)
    said = {finding.code: finding.message for finding in findings}
    warned = frozenset(finding.code for finding in findings if finding.level == WARNING)
    values = {parameter.name: parameter for fit in result.fits for parameter in fit.parameters}
    return Outcome(said, values, warned)


def judged(fault: Fault) -> dict[str, Any]:
    """A row: what was said, whether the advice took the warning away, and whether the value is right."""
    with tempfile.TemporaryDirectory() as scratch:
        spoilt = tried(fault.spoilt, Path(scratch) / "spoilt")
        said = spoilt.said.get(fault.code, "")
        row = {"fault": fault.name, "code": fault.code, "said": bool(said), "gone": False, "right": False}
        if not said:
            return {**row, "note": f"said: {', '.join(spoilt.said) or 'nothing'}"}
        cured = tried(fault.cured(fault.spoilt, said), Path(scratch) / "cured")
        off = [name for name, truth in fault.truth.items() if not cured.holds(name, truth, WIDER)]
        left = cured.warned if fault.code in spoilt.warned else cured.said
        gone = fault.code not in left and "error" not in cured.said
        note = "" if gone else cured.said.get("error", cured.said.get(fault.code, ""))[:160]
        return {**row, "gone": gone, "right": not off, "note": note or ", ".join(off), "message": said}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.draws.advice", description=__doc__)
    parser.add_argument("faults", nargs="*", metavar="FAULT", help="parts of their names; all without any")
    asked = parser.parse_args()
    chosen = [
        fault for fault in FAULTS if not asked.faults or any(part in fault.name for part in asked.faults)
    ]
    rows = []
    for fault in chosen:
        rows.append(judged(fault))
        row = rows[-1]
        print(
            f"| {row['fault']} | *{row['code']}* | {fault.advice} | {'yes' if row['gone'] else '**no**'} | "
            f"{'yes' if row['right'] else '**no**'} | {row.get('note', '')} |",
            flush=True,
        )
    cured = sum(row["gone"] and row["right"] for row in rows)
    print(f"{cured} of {len(rows)} cured by the first advice")


if __name__ == "__main__":
    main()

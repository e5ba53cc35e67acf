"""Entries under `frfs:` that describe their files, from the pipeline to the result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

HEAD = "title: Described\nfrfs: {entry}\nidentify:\n"
FIT = "  support: {model: sdof, estimator: ls, input: y, output: y, band: 10-40 Hz, mass: 2 kg}\n"
ACCEPT = "accept: {support.k: 80 kN/m +- 0.0001 %, support.c: 40 N.s/m +- 0.0001 %}\nreport: {formats: []}\n"
FREQUENCY = np.arange(8.0, 50.0, 0.25)
OMEGA = 2 * np.pi * FREQUENCY
RECEPTANCE = 1 / (80e3 - 2.0 * OMEGA**2 + 40j * OMEGA)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One table of g/N in dB and degrees under a header of two lines; four points, one for each file."""
    accelerance = -(OMEGA**2) * RECEPTANCE / 9.80665
    table = np.column_stack(
        [FREQUENCY, 20 * np.log10(np.abs(accelerance)), np.rad2deg(np.angle(accelerance))]
    )
    np.savetxt(tmp_path / "h.txt", table, header="Beam, point 3\nunit: g/N", comments="")
    for output in "xy":
        for reference in "xy":
            element = RECEPTANCE * (1.0 if output == reference else 0.1)
            np.savetxt(
                tmp_path / f"p_{output}_{reference}.txt",
                np.column_stack([FREQUENCY, element.real, element.imag]),
            )
    monkeypatch.chdir(tmp_path)
    return tmp_path


TABLE = (
    "{file: h.txt, columns: {frequency: 1, amplitude_db: 2, phase_deg: 3}, unit: g/N, output: y, input: y}"
)
POINTS = (
    "{each: 'p_*.txt', pattern: 'p_{output}_{input}', columns: {frequency: 1, re: 2, im: 3}, form: "
    "receptance}"
)


@pytest.mark.parametrize("entry", [TABLE, POINTS])
def test_a_described_file_is_identified_as_it_was_made(lab: Path, labpipe, entry: str) -> None:
    """Closed form: the coefficients from which the FRF was made."""
    (lab / "p.yaml").write_text(HEAD.replace("{entry}", entry) + FIT + ACCEPT)
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 0, ended
    assert labpipe("identify", "-c", "p.yaml", "-o", "again").code == 0


def test_another_unit_of_one_test_among_several_reaches_the_result(lab: Path, labpipe) -> None:
    """By hand: g/N read as m/s^2/N makes the motion 9.80665 times smaller and k as much larger."""
    text = (
        "title: t\ntests:\n"
        + f"  - {{name: a, frfs: {TABLE}}}\n  - {{name: b, frfs: {TABLE}}}\nidentify:\n"
        + FIT.replace(", mass: 2 kg", "")
    )
    rules = (
        "accept: {'support[a].k': 80 kN/m +- 0.001 %, 'support[b].k': 80 kN/m +- 0.001 %}\nreport: "
        "{formats: []}\n"
    )
    (lab / "p.yaml").write_text(text + rules)
    assert labpipe("run", "p.yaml", "-o", "out").code == 0
    (lab / "p.yaml").write_text(
        (text + rules).replace("unit: g/N", "unit: m/s^2/N", 1).replace("80 kN/m", "784.532 kN/m", 1)
    )
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 0, ended


def test_the_window_behind_a_table_is_taken_out(lab: Path, labpipe) -> None:
    """H(j w + 1/tau) under a window of 0.7 s, which adds 2 m / tau = 5.714 N.s/m of damping: c comes out
    without it.
    """
    rate = 1j * OMEGA + 1 / 0.7
    element = 1 / (80e3 + 2.0 * rate**2 + 40 * rate)
    np.savetxt(lab / "w.txt", np.column_stack([FREQUENCY, element.real, element.imag]))
    table = (
        TABLE.replace("amplitude_db: 2, phase_deg: 3", "re: 2, im: 3")
        .replace("unit: g/N", "form: receptance")
        .replace("h.txt", "w.txt")
    )
    entry = table.replace("input: y", "input: y, windowed: {exponential: 0.7 s}")
    (lab / "p.yaml").write_text(HEAD.replace("{entry}", entry) + FIT + ACCEPT.replace("0.0001 %", "0.01 %"))
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 0, ended
    (lab / "p.yaml").write_text(
        HEAD.replace("{entry}", table) + FIT + "accept: {support.c: 45.714 N.s/m +- 0.2 %}\nreport: "
        "{formats: []}\n"
    )
    assert labpipe("run", "p.yaml", "-o", "out").code == 0


@pytest.mark.parametrize(
    ("entry", "fault"),
    [
        (
            TABLE.replace("unit: g/N", "unit: g/m"),
            "p.yaml:2:77: frfs.unit: 'g/m' is not a unit of an FRF; m/N, m/(N.s), m/(N.s^2) or multiples are",
        ),
        (
            TABLE.replace("phase_deg", "phase_dg"),
            "frfs.columns.phase_dg: unknown key; did you mean 'phase_deg'?",
        ),
        (TABLE.replace("h.txt", "g.txt"), "p.yaml:2:8: frfs.file: no such file 'g.txt'"),
        (
            TABLE.replace(", input: y", ""),
            "p.yaml:2:1: frfs.input: is missing; name the dof, or its place in the files' names by pattern",
        ),
        (
            TABLE.replace("output: y", "output: [x, y]"),
            "frfs.output: one dof is needed; several are the rows or columns of a matrix",
        ),
        (
            POINTS.replace("'p_{output}", "'q_{output}"),
            "frfs.pattern: does not match 'p_x_x'; for example 'H_{output}_{input}'",
        ),
        (POINTS.replace("{input}", "{way}"), "frfs.pattern: holds more than {output} and {input}"),
        (
            POINTS.replace("p_{output}_{input}", "p_{output}_{}").replace("form", "input: f, form"),
            "x/f lies in p_x_x.txt and in p_x_y.txt",
        ),
        (
            TABLE.replace("h.txt", "h.mat"),
            "h.mat: holds variables, no columns; write 'variables' in place of 'columns'",
        ),
    ],
)
def test_faults_of_entries(lab: Path, labpipe, entry: str, fault: str) -> None:
    (lab / "h.mat").write_bytes(b"MATLAB 5.0")
    (lab / "p.yaml").write_text(HEAD.replace("{entry}", entry) + FIT)
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 2 and fault in ended.err and "Traceback" not in ended.err, ended
    assert not (lab / "out").exists()


def test_universal_files_that_leave_their_form_open(lab: Path, labpipe) -> None:
    """Closed form: records of data types 0 per 12 with the numbers of a receptance, one point for each file,
    are what the entry says; a table needs its columns beside the form.
    """
    head = "    -1\n    58\nFrequency Response H1(Desl,Force)\n" + 4 * "NONE\n"
    head += "    4         0    0         0 NONE               1   0 NONE               1   0\n"
    head += f"         5{FREQUENCY.size:10d}         1  8.00000E+00  2.50000E-01  0.00000E+00\n"
    for kind, label in ((18, "NONE"), (0, "Volts"), (12, "NONE"), (0, "NONE")):
        head += f"{kind:10d}    0    0    0 {label:<21}{'V' if label == 'Volts' else 'NONE'}\n"
    for point, share in (("y", 1.0), ("z", 0.5)):
        values = "".join(f"{h.real:13.5e}{h.imag:13.5e}\n" for h in share * RECEPTANCE)
        (lab / f"{point}.uff").write_text(head + values + "    -1\n")
    entry = "{each: '[yz].uff', pattern: '{output}', input: y, form: receptance}"
    rules = ACCEPT.replace("0.0001 %", "0.01 %")
    (lab / "p.yaml").write_text(HEAD.replace("{entry}", entry) + FIT + rules)
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 0, ended
    (lab / "p.yaml").write_text(HEAD.replace("{entry}", "{file: h.txt, form: receptance}") + FIT)
    assert "neither 'columns' nor 'variables'" in labpipe("run", "p.yaml", "-o", "o").err


def test_a_file_that_is_no_frf_says_what_was_tried(lab: Path, labpipe) -> None:
    from scipy.io import savemat

    savemat("h.mat", {"f": FREQUENCY, "H": RECEPTANCE})
    savemat("t.mat", {"x": RECEPTANCE.real, "fs": 100.0})
    for name, said in (
        ("h.mat", "variables {frequency: f, complex: H} look like an FRF"),
        ("t.mat", "a frequency and complex numbers, or amplitude and phase, were not found"),
        ("p_x_x.txt", "columns {frequency: 1, re: 2, im: 3} look like an FRF"),
    ):
        (lab / "p.yaml").write_text(HEAD.replace("{entry}", name) + FIT)
        ended = labpipe("run", "p.yaml", "-o", "out")
        assert ended.code == 2 and said in ended.err, ended

"""One test whose recordings lie in many files: hits one per file at moving points, channels in files of their
own.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

RATE, N = 1024, 2048
POLE = -2 * np.pi * 0.8 + 2j * np.pi * 60.0
RIG = """name: R
time: "t [s]"
channels:
  f: {quantity: force, dof: x}
  y: {quantity: displacement, dof: y}
"""
HITS = """title: Roving hammer
rig: rig.yaml
recordings: {each: "hit_*.csv", pattern: "hit_{input}_{}"}
frf: {excitation: impact, block: 2 s, band: 40-80 Hz, windowed: {exponential: 0.3 s}}
identify: {m: {model: modal, band: 50-70 Hz, modal: {poles: [60 Hz]}}}
report: {formats: [html]}
"""
JOINED = """title: Two loggers
rig: rig.yaml
recordings: {join: [force.txt, motion.txt]}
frf: {excitation: impact, block: 1.9 s, band: 40-80 Hz}
identify: {s: {model: sdof, estimator: ls, input: f, output: y, band: 55-65 Hz}}
accept: {s.f_n: 60.0053 Hz +- 0.01 %, s.zeta: 0.013333 +- 0.2 %}
report: {formats: []}
"""


def hit(gain: float, second: float = 0.0, decay: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Force and response of a mode of 60 Hz, sampled exactly; a second push makes a double hit."""
    z = np.exp(POLE / RATE)
    force = np.zeros(N)
    for start, peak in ((30, 1.0), (90, second)):
        force[start : start + 8] += peak * np.sin(np.pi * (np.arange(8) + 0.5) / 8)
    window = np.exp(-np.arange(N) / RATE / decay)
    response = gain * signal.lfilter([0, z.imag], [1, -2 * z.real, abs(z) ** 2], force)
    return force * window, response * window


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "rig.yaml").write_text(RIG)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(path: Path, *columns: np.ndarray, header: str, digits: str = "%.9g", delimiter: str = ",") -> None:
    np.savetxt(path, np.column_stack(columns), header=header, comments="", fmt=digits, delimiter=delimiter)


def test_a_roving_hammer_with_one_hit_for_each_file(lab: Path, labpipe) -> None:
    """Closed form: pole and shape 1 : 0.7 : -0.5. The double hit of one file is left out and named."""
    rng = np.random.default_rng(4)
    for point, gain in (("1", 1.0), ("2", 0.7), ("3", -0.5)):
        for number in range(3):
            force, response = hit(gain, 0.5 if (point, number) == ("2", 1) else 0.0, 0.3)
            noise = 1e-5 * rng.normal(size=(2, N))
            write(
                lab / f"hit_{point}_{number}.csv",
                np.arange(N) / RATE,
                force + noise[0],
                response + noise[1],
                header="t [s],f,y",
            )
    (lab / "p.yaml").write_text(HITS)
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 0 and "hit 5 ('hit_2_1', 0.000 s) is left out: double hit" in ended.out, ended
    result = json.loads((lab / "out/identification.json").read_text())
    values = {parameter["name"]: parameter["value"] for parameter in result["fits"][0]["parameters"]}
    assert values["f_n_1"] == pytest.approx(abs(POLE) / 2 / np.pi, rel=1e-4) and values[
        "zeta_1"
    ] == pytest.approx(0.8 / 60, rel=0.01)
    assert "hit_2_1.csv" in (lab / "out/report.html").read_text() and len(result["sources"]) == 9


def test_channels_in_files_of_their_own_are_joined_on_their_times(lab: Path, labpipe) -> None:
    """The force from the start on with six digits, the motion ten samples later and five less.

    The same mode is found.
    """
    force, response = hit(1.0)
    times = np.arange(N) / RATE
    write(lab / "force.txt", times, force, header="t f", digits="%.6g", delimiter="  ")
    write(lab / "motion.txt", times[10:-5], response[10:-5], header="t y", delimiter=" ")
    (lab / "rig.yaml").write_text(RIG.replace('"t [s]"', "t"))
    (lab / "p.yaml").write_text(JOINED)
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 0, ended
    assert (
        "note cut: force.txt: 10 samples at its start and 5 at its end are cut, where another file has none"
    ) in ended.out
    result = json.loads((lab / "out/identification.json").read_text())
    assert [source["path"] for source in result["sources"]] == ["force.txt", "motion.txt"]


def test_another_way_of_joining_reaches_the_result(lab: Path, labpipe) -> None:
    test_channels_in_files_of_their_own_are_joined_on_their_times(lab, labpipe)
    (lab / "p.yaml").write_text(
        JOINED.replace("motion.txt]", "motion.txt], by: sample").replace("accept: ", "# accept: ")
    )
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 0 and "note cut: force.txt: 0 samples at its start and 15 at its end" in ended.out, (
        ended
    )


def test_a_time_that_one_file_lacks_is_said(lab: Path, labpipe) -> None:
    force, response = hit(1.0)
    write(lab / "force.txt", np.arange(N) / RATE, force, header="t [s],f")
    write(lab / "motion.txt", response, response, header="y,z")
    (lab / "p.yaml").write_text(JOINED.replace("motion.txt]", "motion.txt], by: time"))
    ended = labpipe("run", "p.yaml", "-o", "out")
    assert ended.code == 2 and ended.err.startswith(
        "error: motion.txt: has no time column 't [s]'; by: sample joins row by row"
    ), ended
    (lab / "p.yaml").write_text(JOINED)
    assert labpipe("run", "p.yaml", "-o", "out").code == 0


def test_a_calibrated_recording_is_not_joined(lab: Path, labpipe) -> None:
    """The files behind it were left out without a word."""
    header = "t [s],f,y"
    write(lab / "a.csv", np.arange(8) / RATE, np.arange(8.0) ** 2, np.ones(8) * 2, header=header)
    assert labpipe("ingest", "a.csv", "-r", "rig.yaml", "-o", "rec").code == 0
    (lab / "p.yaml").write_text(JOINED.replace("force.txt, motion.txt", "rec/a.recording.parquet, a.csv"))
    done = labpipe("run", "p.yaml", "-o", "out")
    assert done.code == 2 and "a.recording.parquet: is calibrated already, and is not joined" in done.err

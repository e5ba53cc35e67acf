"""labpipe orders on run-ups whose orbit, speed and phase are known in closed form."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from labpipe.methods.run_ups.run_up_csv import read_run_up_csv

RIG = """name: Run-up rig
sample_rate: 2 kHz
channels:
  x: {column: "x [um]", quantity: displacement, unit: um, role: output, dof: x}
  y: {column: "y [um]", quantity: displacement, unit: um, role: output, dof: y}
  n: {column: "tacho [V]", quantity: tacho, unit: V, role: reference}
"""
FORWARD, BACKWARD = 30.0 * np.exp(0.4j), 10.0 * np.exp(-1.1j)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A run-up from 20 to 40 Hz in 20 s with a constant elliptic orbit, um.

    A pulse at every whole revolution, whose flanks are several samples long: their times are known to less.
    """
    t = np.arange(40_000) / 2000
    revolutions = 20 * t + 0.5 * t**2
    turn = np.exp(2j * np.pi * revolutions)
    x, y = np.real((FORWARD + BACKWARD) * turn), np.real((-1j * FORWARD + 1j * BACKWARD) * turn)
    noise = np.random.default_rng(1).normal(size=(2, t.size)) * 0.5
    pulse = np.clip(2.5 + 5 * np.sin(2 * np.pi * revolutions), 0.0, 5.0)
    table = np.column_stack([x + noise[0], y + noise[1], pulse])
    np.savetxt(
        tmp_path / "run.csv", table, delimiter=",", header="x [um],y [um],tacho [V]", comments="", fmt="%.6g"
    )
    (tmp_path / "rig.yaml").write_text(RIG, encoding="utf-8")
    return tmp_path


def rows(folder: Path) -> list[dict[str, float]]:
    text = (folder / "orders.csv").read_text("utf-8").splitlines()
    return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(text)]


@pytest.mark.usefixtures("undrawn")
def test_a_run_up_by_its_tacho(project: Path, labpipe) -> None:
    out = project / "out"
    ended = labpipe("orders", project / "run.csv", "-r", project / "rig.yaml", "--tacho", "n", "-o", out)
    assert ended.code == 0 and "segments of 20 revolutions" in ended.out, ended
    found = rows(out)
    assert found[0]["speed_hz"] < 22 and found[-1]["speed_hz"] > 38
    # The rig has one tacho: it need not be named. Of two it must be.
    ended = labpipe("orders", project / "run.csv", "-r", project / "rig.yaml", "-o", project / "unnamed")
    assert ended.code == 0 and rows(project / "unnamed") == found
    two = (
        project / "rig.yaml"
    ).read_text() + "  m: {column: tacho, quantity: tacho, unit: V, role: reference}\n"
    (project / "two.yaml").write_text(two)
    ended = labpipe("orders", project / "run.csv", "-r", project / "two.yaml", "-o", project / "none")
    assert ended.code == 2 and "--tacho n or m, or --speed '50 Hz'" in ended.err, ended
    # E|dX|^2 = 4 s^2 / n; with s = 0.5 um and about 1300 samples a stretch 0.028 um; f and b have 1 / sqrt 2
    # of it.
    for name, truth in (("f", FORWARD), ("b", BACKWARD)):
        sizes = np.array([row[f"{name}:amplitude"] for row in found]) * 1e6
        assert np.mean(sizes) == pytest.approx(abs(truth), abs=0.05)
        assert np.mean([row[f"{name}:std"] for row in found]) * 1e6 == pytest.approx(0.02, rel=0.5)
        # The pulse's flank is found between samples: a few degrees at most.
        phases = [np.exp(1j * np.radians(row[f"{name}:phase_deg"])) for row in found]
        assert abs(np.degrees(np.angle(np.mean(phases) / truth))) < 5


def test_orbits_of_exchanged_probes_are_backward(project: Path, labpipe) -> None:
    """The circles of 30 and 10 um: forward is the larger one, until the probes are exchanged. Probes that are
    called f and b keep their columns.
    """
    common = ("orders", project / "run.csv", "-o", project / "out", "-r")
    labpipe(*common, project / "rig.yaml")
    assert " rpm, backward" not in (project / "out/orbits.svg").read_text("utf-8")
    exchanged = RIG.replace("dof: x", "dof: z").replace("dof: y", "dof: x").replace("dof: z", "dof: y")
    exchanged = exchanged.replace("  x: ", "  f: ").replace("  y: ", "  b: ")
    (project / "exchanged.yaml").write_text(exchanged, encoding="utf-8")
    labpipe(*common, project / "exchanged.yaml")
    assert (project / "out/orbits.svg").read_text("utf-8").count(" rpm, backward") == 8
    titles = (project / "out/orders.csv").read_text("utf-8").splitlines()[0].split(",")
    assert len(set(titles)) == len(titles)
    for row in rows(project / "out"):
        assert row["circle:f:amplitude"] == pytest.approx(10e-6, abs=1e-6)
        assert row["circle:b:amplitude"] == pytest.approx(30e-6, abs=1e-6)
        assert row["f:amplitude"] == pytest.approx(1e-6 * abs(FORWARD + BACKWARD), abs=1e-6)


@pytest.mark.usefixtures("undrawn")
def test_pulses_that_are_missing_are_said_and_counted(project: Path, labpipe) -> None:
    """The orbit in closed form, of a tacho that loses three pulses and doubles one."""
    table = np.loadtxt(project / "run.csv", delimiter=",", skiprows=1)
    t = np.arange(40_000) / 2000
    turned = 20 * t + 0.5 * t**2 + 0.25
    lost = np.isin(np.floor(turned), (150, 301, 302))
    table[lost, 2] = 0.0
    table[np.abs(turned - 421) < 0.04, 2] = 5.0
    header = "x [um],y [um],tacho [V]"
    np.savetxt(project / "lost.csv", table, delimiter=",", header=header, comments="", fmt="%.6g")
    out = project / "out"
    ended = labpipe("orders", project / "lost.csv", "-r", project / "rig.yaml", "-o", out)
    assert ended.code == 0, ended
    told = r"warning tacho-pulses: the tacho 'n' of 'lost': 3 of 59\d pulses are missing, 1 are too many"
    assert re.search(told, ended.out)
    sizes = np.array([row["f:amplitude"] for row in rows(out)]) * 1e6
    # Within eight standard errors of .02 um; a stretch with a pulse lost was 1 um off.
    np.testing.assert_allclose(sizes, abs(FORWARD), atol=0.16)


@pytest.mark.usefixtures("undrawn")
def test_a_constant_speed_without_tacho(project: Path, labpipe) -> None:
    t = np.arange(20_000) / 2000
    x = 12 * np.cos(2 * np.pi * 50 * t + 0.3)
    table = np.column_stack([x, 0.1 * x, 0 * x + np.arange(t.size) % 7])
    np.savetxt(
        project / "run.csv", table, delimiter=",", header="x [um],y [um],tacho [V]", comments="", fmt="%.8g"
    )
    ended = labpipe(
        "orders",
        project / "run.csv",
        "-r",
        project / "rig.yaml",
        "--speed",
        "3000 rpm",
        "-o",
        project / "out",
    )
    assert ended.code == 0, ended
    found = rows(project / "out")
    assert [row["x:amplitude"] * 1e6 for row in found] == pytest.approx([12.0] * len(found), rel=1e-6)
    assert found[0]["x:phase_deg"] == pytest.approx(np.degrees(0.3), abs=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--tacho", "n", "--speed", "50 Hz"), "one of 'speed' and 'tacho' is needed"),
        (("--tacho", "m"), "'m'"),
        (("--speed", "50 N"), "--speed: 'N' has the wrong dimension"),
        (("--tacho", "n", "--order", "-1"), "--order must be positive"),
        (("--tacho", "n", "--order", "nan"), "--order must be positive"),
        (("--speed", "1.5 kHz"), "order 1 of recording 'run' reaches 1500 Hz, beyond half its sample rate"),
        (("--tacho", "n", "--revolutions", "5000"), "shorter than 5000 revolutions"),
        (("--tacho", "n", "--order", "2", "--speed-range", "50-60 Hz"), "a run-up is of order 1, not 2"),
        (("--tacho", "n", "--load", "3 N"), "--load belongs to --save-run-up"),
        (("--tacho", "n", "--unbalance", "x=3 g.mm"), "--unbalance belongs to a table or a judgement"),
        (("--tacho", "n", "--gap", "1 mm", "--limit", "-5 %"), "--gap and --limit must be positive"),
        (
            ("--tacho", "n", "--pulses", "2", "--baseline", "b.csv", "--unbalance", "x=3 g.mm"),
            "--pulses: of several pulses a revolution none marks the angle",
        ),
        (("--tacho", "n", "--limit", "30 %"), "--limit belongs to --gap"),
        (
            ("--tacho", "n", "--slow-roll", "1-2 Hz", "--unbalance", "x=3 g.mm", "--unbalance", "y=3 g.mm"),
            "sensitivity is to one stated unbalance",
        ),
        (("--tacho", "n", "--slow-roll", "1-2 Hz", "--unbalance", "x=0 g.mm"), "unbalance above zero"),
        (
            ("--tacho", "n", "--save-run-up", "t.csv", "--load", "3 N", "--unbalance", "x=3 g.mm"),
            "--save-run-up: the plane of the responses has no name",
        ),
    ],
)
def test_what_cannot_be_tracked_is_said(
    project: Path, labpipe, arguments: tuple[str, ...], message: str
) -> None:
    ended = labpipe(
        "orders", project / "run.csv", "-r", project / "rig.yaml", "-o", project / "out", *arguments
    )
    assert ended.code == 2 and message in ended.err, ended
    assert not (project / "out").exists()


def test_a_raw_file_needs_its_rig(project: Path, labpipe) -> None:
    ended = labpipe("orders", project / "run.csv", "--tacho", "n", "-o", project / "out")
    assert ended.code == 2 and "a raw file needs its rig file" in ended.err


@pytest.mark.long
def test_the_axes_say_the_unit_of_what_was_measured(project: Path, labpipe) -> None:
    text = RIG.replace("quantity: displacement, unit: um", "quantity: acceleration, unit: m/s^2").replace(
        "[um]", "[m/s^2]"
    )
    (project / "rig.yaml").write_text(text, encoding="utf-8")
    run = project / "run.csv"
    run.write_text(run.read_text("utf-8").replace("[um]", "[m/s^2]"), encoding="utf-8")
    assert (
        labpipe(
            "orders", project / "run.csv", "-r", project / "rig.yaml", "--tacho", "n", "-o", project / "out"
        ).code
        == 0
    )
    drawn = (project / "out/orders.svg").read_text("utf-8")
    assert "amplitude [m/s^2]" in drawn and "[um]" not in drawn
    assert "<svg" in (project / "out/orbits.svg").read_text("utf-8")


ACCELERATIONS = (
    ("quantity: displacement, unit: um", "quantity: acceleration, unit: m/s^2"),
    ("[um]", "[m/s^2]"),
    ("dof: ", "dof: disc."),
)


def test_planes_are_files_of_their_own(project: Path, labpipe) -> None:
    """A plane's name stays within the folder."""
    given = ("orders", project / "run.csv", "-r", project / "rig.yaml", "--tacho", "n", "-o", project / "out")
    (project / "rig.yaml").write_text(RIG.replace("dof: ", "dof: a/b."), encoding="utf-8")
    ended = labpipe(*given)
    assert ended.code == 0 and "orbits-a-b.svg" in ended.out, ended
    assert all(path.is_file() for path in (project / "out").iterdir())


@pytest.mark.usefixtures("undrawn")
def test_a_probe_that_reads_nothing_is_named(project: Path, labpipe) -> None:
    """Its zeros had the phase of rounding in a table, and a judgement passed it over."""
    rig, run = project / "rig.yaml", project / "run.csv"
    rig.write_text(RIG.replace("dof: ", "dof: disc."), encoding="utf-8")
    numbers = np.loadtxt(run, delimiter=",", skiprows=1) * [1, 0, 1]
    np.savetxt(run, numbers, delimiter=",", header="x [um],y [um],tacho [V]", comments="", fmt="%.6g")
    given = ("orders", run, "-r", rig, "--tacho", "n", "-o", project / "out")
    table = ("--save-run-up", project / "t.csv", "--load", "3 N", "--unbalance", "disc=5 g.mm")
    for asked in (table, ("--speed-range", "25-30 Hz")):
        ended = labpipe(*given, *asked)
        assert ended.code == 2 and "probe 'y' of " in ended.err and "does not move at " in ended.err, ended
        assert "RuntimeWarning" not in ended.err and not (project / "t.csv").exists()


@pytest.mark.usefixtures("undrawn")
def test_accelerations_are_no_run_up_and_have_their_own_unit(project: Path, labpipe) -> None:
    """A centreline in the unit of what was measured; no table, which holds displacements."""
    text = RIG
    for old, new in ACCELERATIONS:
        text = text.replace(old, new)
    (project / "rig.yaml").write_text(text, encoding="utf-8")
    run = project / "run.csv"
    run.write_text(run.read_text("utf-8").replace("[um]", "[m/s^2]"), encoding="utf-8")
    given = ("orders", run, "-r", project / "rig.yaml", "--tacho", "n", "-o", project / "out")
    ended = labpipe(*given, "--centreline")
    assert ended.code == 0 and " m/s^2 at " in ended.out.split("centreline moved by")[1], ended
    table = ("--save-run-up", project / "t.csv", "--load", "3 N", "--unbalance", "disc=5 g.mm")
    ended = labpipe(*given, *table)
    assert ended.code == 2 and "channel 'x' of recording 'run' reads acceleration" in ended.err, ended


@pytest.mark.usefixtures("undrawn")
def test_a_baseline_of_the_same_name_leaves_the_run_s_recording(project: Path, labpipe) -> None:
    """What a table leaves out is said; a baseline of other channels is refused."""
    rig = project / "rig.yaml"
    text = RIG.replace("dof: ", "dof: disc.").replace("unit: um", "unit: um, uncertainty: {gain: 1 %}")
    rig.write_text(text, encoding="utf-8")
    before = project / "before/run.csv"
    before.parent.mkdir()
    numbers = np.loadtxt(project / "run.csv", delimiter=",", skiprows=1, max_rows=8000)
    for path, table in ((project / "run.csv", numbers), (before, numbers * [0.5, 0.5, 1])):
        header = "x [um],y [um],tacho [V]"
        np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.6g")
    short = ("--tacho", "n", "--revolutions", "5")
    given = ("orders", project / "run.csv", "-r", rig, *short, "-o", project / "out")
    change = ("--unbalance", "disc=5 g.mm", "--load", "3 N", "--save-run-up", project / "t.csv")
    whole = (*given[:-1], project / "whole", *change[:-1], project / "whole.csv")
    ended = labpipe(*given, "--baseline", before, *change)
    assert ended.code == 0 and "speeds, without the uncertainties of x.gain, y.gain" in ended.out, ended
    # The baseline moves half as much: what was added moves the other half.
    found = {name: read_run_up_csv(project / name) for name in ("t.csv", "whole.csv") if labpipe(*whole)}
    np.testing.assert_allclose(2 * found["t.csv"].response, found["whole.csv"].response, rtol=1e-4)
    names = {path.name for path in (project / "out").glob("*.parquet")}
    assert names == {"run.recording.parquet", "run-baseline.recording.parquet"}
    rig.write_text(text.replace("  x:", "  z:").replace("disc.x", "disc.z"), encoding="utf-8")
    other = labpipe("ingest", before, "-r", rig, "-o", project / "other")
    assert other.code == 0, other
    rig.write_text(text, encoding="utf-8")
    (stored,) = (project / "other").glob("*.parquet")
    ended = labpipe(*given, "--baseline", stored, *change)
    assert ended.code == 2 and "made with another `rig:` than there is now (channels)" in ended.err, ended

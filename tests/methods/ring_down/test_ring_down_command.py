"""Free decays on the command line: the shipped pipeline, stage by stage, several ways to write it, and what
is refused where.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import labpipe as library
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.measured_files import read_decays
from labpipe.report.cover import cover_facts

RIG = """name: Struck
sample_rate: 512 Hz
channels:
  y: {column: "y [um]", quantity: displacement, unit: um, role: output, dof: y}
"""
PIPELINE = """title: Ring-down
rig: rig.yaml
recordings: ring.csv
frf: {excitation: decay}
identify:
  ring: {model: decay, modes: 1, mass: 2 kg}
report: {formats: []}
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """40 Hz, zeta 0.01, 100 um, offset 5 um, 0.5 um of noise; pinned seed."""
    t = np.arange(1024) / 512
    w = 2 * np.pi * 40
    y = (
        100 * np.exp(-0.01 * w * t) * np.cos(w * np.sqrt(1 - 1e-4) * t)
        + 5
        + 0.5 * np.random.default_rng(1).standard_normal(t.size)
    )
    (tmp_path / "ring.csv").write_text("y [um]\n" + "".join(f"{value:.5f}\n" for value in y))
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "pipeline.yaml").write_text(PIPELINE)
    return tmp_path


@pytest.mark.long
def test_the_shipped_pipeline_meets_its_truth(root: Path, tmp_path: Path, labpipe) -> None:
    ended = labpipe("run", root / "pipelines/ring-down.yaml", "-o", tmp_path / "out")
    assert ended.code == 0 and "FAILED" not in ended.out
    assert (
        re.search(r"log_decrement_1 +0\.0314", ended.out)
        and "warning amplitude-dependent: mode 1" in ended.out
    )
    html = (tmp_path / "out/report.html").read_text()
    assert "Free decay of fit ring" in html and "Mode 1 of fit joint" in html


def test_stage_by_stage_gives_the_same_as_all_at_once(lab: Path, labpipe) -> None:
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "whole").code == 0
    ended = labpipe("frf", "-c", lab / "pipeline.yaml", "-o", lab / "parts")
    assert (
        ended.code == 0
        and "1 free decay(s) of y at 512 Hz" in ended.out
        and (lab / "parts/frf.decay.parquet").exists()
    )
    assert library.read(lab / "parts/frf.decay.parquet").decays[0].samples.shape[0] == 1024 - 13
    assert labpipe("identify", "-c", lab / "pipeline.yaml", "-o", lab / "parts").code == 0
    assert (
        labpipe(
            "identify", "-c", lab / "pipeline.yaml", "-o", lab / "named", lab / "parts/frf.decay.parquet"
        ).code
        == 0
    )
    fits = [
        json.loads((lab / folder / "identification.json").read_text())["fits"]
        for folder in ("whole", "parts", "named")
    ]
    assert fits[0] == fits[1] == fits[2]
    names = [parameter["name"] for parameter in fits[0][0]["parameters"]]
    assert (
        names == ["f_n_1", "zeta_1", "log_decrement_1", "k", "c"]
        and fits[0][0]["remarks"][0]["code"] == "free-decay"
    )
    for parameter, true in zip(
        fits[0][0]["parameters"], (40, 0.01, 0.0628350, 126330.9, 10.0531), strict=True
    ):
        assert abs(parameter["value"] - true) < 4 * parameter["std_error"]


def test_the_settings_of_the_model_may_stand_in_their_section(lab: Path, labpipe) -> None:
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "flat").code == 0
    (lab / "pipeline.yaml").write_text(PIPELINE.replace("modes: 1", "decay: {modes: 1}"))
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "section").code == 0
    flat, section = (
        json.loads((lab / folder / "identification.json").read_text()) for folder in ("flat", "section")
    )
    assert flat == section


def test_a_second_run_finds_everything_fresh_and_another_start_does_not(lab: Path, labpipe) -> None:
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out").code == 0
    file, result = lab / "out/frf.decay.parquet", lab / "out/identification.json"
    before = file.stat().st_mtime_ns, result.stat().st_mtime_ns
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out").code == 0
    assert (file.stat().st_mtime_ns, result.stat().st_mtime_ns) == before
    labpipe("run", lab / "pipeline.yaml", "-o", lab / "out", "--set", "frf.decay.start=0.5 s")
    message = json.loads(result.read_text())["fits"][0]["remarks"][0]["message"]
    assert "0.5 s to 2 s" in message


def test_decays_are_compared_over_their_conditions(lab: Path, labpipe) -> None:
    """One decay under three preloads, each time a row shorter; cover and provenance name the conditions."""
    rows = (lab / "ring.csv").read_text().splitlines()
    for n, name in enumerate(("again", "anew"), 1):
        (lab / f"{name}.csv").write_text("\n".join(rows[:-n]) + "\n")
    tests = "tests:\n" + "".join(
        f"  - {{name: {name}, recordings: {file}, conditions: {{preload: {force} N}}}}\n"
        for name, file, force in (
            ("low", "ring.csv", 100),
            ("mid", "again.csv", 150),
            ("high", "anew.csv", 200),
        )
    )
    trend = (
        "compare:\n  trend: {kind: trend, fit: ring, parameter: k, over: preload, law: power}\nreport: "
        "{formats: [md]}\n"
    )
    (lab / "pipeline.yaml").write_text(
        PIPELINE.replace("recordings: ring.csv\n", tests).replace("report: {formats: []}\n", trend)
    )
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out")
    assert ended.code == 0, ended.err
    result = json.loads((lab / "out/identification.json").read_text())
    assert len(result["fits"]) == 3 and result["comparisons"][0]["name"] == "trend"
    facts = dict(cover_facts([read_identification(lab / "out/identification.json")]))
    assert facts["tests"] == "3 measured, from 3 source files" and facts["preload"] == "100 N, 150 N, 200 N"
    assert "| mid | preload | 150 N |" in (lab / "out/report.md").read_text()


@pytest.mark.parametrize(
    ("old", "new", "place", "message"),
    [
        (
            "model: decay, modes: 1,",
            "model: sdof,",
            "6:10",
            "identify.ring.model: model sdof needs an FRF, free decays have none",
        ),
        (
            "excitation: decay",
            "excitation: random, block: 1 s",
            "6:10",
            "identify.ring.model: model decay needs free decays, not an FRF",
        ),
        ("modes: 1", "modes: 0", "6:24", "modes' is 0"),
        ("modes: 1", "mode: 1", "6:24", "identify.ring.decay.mode: unknown key; did you mean 'modes'?"),
        (
            "excitation: decay",
            "excitation: decay, band: 1-9 Hz",
            "4:26",
            "'band' is not for decay excitation",
        ),
        ("excitation: decay", "excitation: decay, decay: {stat: 1 s}", "4:34", "frf.decay.stat: unknown key"),
    ],
)
def test_what_is_wrong_is_named_at_its_place(
    lab: Path, labpipe, old: str, new: str, place: str, message: str
) -> None:
    (lab / "pipeline.yaml").write_text(PIPELINE.replace(old, new))
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out")
    assert ended.code == 2 and message in ended.err and f"pipeline.yaml:{place}" in ended.err, ended.err
    assert not (lab / "out").exists()


def test_a_recording_without_a_decay_is_named(lab: Path, labpipe) -> None:
    (lab / "ring.csv").write_text("y [um]\n" + "1.0\n" * 600)
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out")
    assert (
        ended.code == 2
        and "ring.csv: recording 'ring' does not move" in ended.err
        and "Traceback" not in ended.err
    )


def test_a_mode_too_many_is_refused(lab: Path, labpipe) -> None:
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out", "--set", "identify.ring.modes=2")
    assert (
        ended.code == 2 and "identify.ring: what would be a mode at" in ended.err and "is noise" in ended.err
    )


def test_decays_are_inspected_and_exported(lab: Path, labpipe) -> None:
    """Every sample of every decay, in SI units, with the time that it has in its recording.

    Other formats are refused in words.
    """
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out").code == 0
    (kept,) = (lab / "out").rglob("*.decay.parquet")
    shown = labpipe("inspect", kept, "-o", lab / "card.html")
    assert (
        shown.code == 0
        and "free decays" in shown.out
        and "512 Hz, 1 decay(s) of" in shown.out
        and "y [m] output y" in shown.out
    )
    assert (lab / "card.html").stat().st_size > 0
    decays = read_decays(kept)
    for suffix, read in (("csv", pd.read_csv), ("parquet", pd.read_parquet)):
        assert labpipe("export", kept, "--to", suffix, "-o", lab / f"d.{suffix}").code == 0
        table = read(lab / f"d.{suffix}")
        assert list(table.columns) == ["decay", "recording", "t [s]", "y [m]"] and set(
            table["recording"]
        ) == {"ring"}
        np.testing.assert_allclose(table["y [m]"], decays.decays[0].samples[:, 0])
        np.testing.assert_allclose(table["t [s]"], decays.decays[0].start + np.arange(len(table)) / 512)
    for other in ("uff", "mat"):
        ended = labpipe("export", kept, "--to", other, "-o", lab / f"d.{other}")
        assert (
            ended.code == 2
            and "free decays cannot be written as" in ended.err
            and not (lab / f"d.{other}").exists()
        )

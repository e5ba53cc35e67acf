"""Spectra of all channels from the command line: made, kept fresh, looked at, exported, reported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import labpipe
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.measured_files import read_spectra
from labpipe.cli.main import run_command
from labpipe.records.spectra import ChannelSpectra

ROOT = Path(__file__).parents[2]
RIG = """name: Floating stator
sample_rate: 1 kHz
constants: {m_s: 60 kg +- 0.3 kg}
channels:
  f_x: {column: "f_x [mN]", quantity: force, unit: mN, dof: x}
  f_y: {column: "f_y [mN]", quantity: force, unit: mN, dof: y}
  d_x: {column: "d_x [nm]", quantity: displacement, unit: nm, dof: x}
  d_y: {column: "d_y [nm]", quantity: displacement, unit: nm, dof: y}
  a_x: {column: "a_x [mm/s^2]", quantity: acceleration, unit: mm/s^2, dof: x, role: output}
  a_y: {column: "a_y [mm/s^2]", quantity: acceleration, unit: mm/s^2, dof: y, role: output}
  e_x: {quantity: force, derived: f_x - m_s * a_x, dof: x}
  e_y: {quantity: force, derived: f_y - m_s * a_y, dof: y}
"""
PIPELINE = """title: Seal
rig: rig.yaml
tests:
  - {name: seal, recordings: [seal-plus.parquet, seal-minus.parquet], conditions: {speed: 2000 rpm}}
frf: {excitation: periodic, period: 1 s, skip: 0, band: 10-100 Hz, result: spectra}
report: {formats: [html]}
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("floating")
    rig, runs = str(ROOT / "configs/virtual-floating.yaml"), ("--run", "seal-plus", "--run", "seal-minus")
    assert run_command(["simulate", rig, "-o", str(folder), *runs, "--set", "periods=4"]) == 0
    (folder / "rig.yaml").write_text(RIG)
    (folder / "p.yaml").write_text(PIPELINE)
    assert run_command(["run", str(folder / "p.yaml"), "-o", str(folder / "out")]) == 0
    return folder


def same(one: ChannelSpectra, other: ChannelSpectra) -> bool:
    arrays = all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("frequency", "vectors", "covariance")
    )
    plain = all(
        getattr(one, name) == getattr(other, name)
        for name in ("channels", "runs", "covariance_dof", "findings", "conditions", "name")
    )
    factors = all(
        np.array_equal(a.derivative, b.derivative) and a.name == b.name
        for a, b in zip(one.factors, other.factors, strict=True)
    )
    return arrays and plain and factors


def test_spectra_are_those_of_the_recordings(lab: Path) -> None:
    """The file holds what the functions give for the calibrated recordings, and the factor with its
    uncertainty.
    """
    stored = labpipe.read(lab / "out/seal.spectra.parquet")
    recordings = [
        labpipe.read(lab / f"seal-{end}.parquet", rig=lab / "rig.yaml") for end in ("plus", "minus")
    ]
    settings = labpipe.FrfSettings("periodic", period="1 s", skip=0, band="10-100 Hz", result="spectra")
    made = labpipe.channel_spectra(recordings, settings, name="seal", conditions={"speed": "2000 rpm"})
    assert same(stored, made) and [factor.name for factor in made.factors] == ["m_s"]


def test_pulses_of_a_tacho_are_not_clipped(lab: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    """Their ends are flat by design, with flanks between them; the same numbers as a voltage are cut off."""
    table = pd.read_parquet(lab / "seal-plus.parquet")
    table["n [V]"] = np.clip(6 * np.sin(2 * np.pi * 20 * np.arange(len(table)) / 1000), -4, 4)
    table.to_parquet(lab / "pulses.parquet")
    (lab / "n.yaml").write_text(RIG + '  n: {column: "n [V]", quantity: tacho, unit: V}\n')
    shown = labpipe("ingest", lab / "pulses.parquet", "-r", lab / "n.yaml", "-o", lab / "ingested")
    assert shown.code == 0 and "clipped" not in shown.out + shown.err
    (lab / "v.yaml").write_text((lab / "n.yaml").read_text().replace("quantity: tacho", "quantity: voltage"))
    flat = labpipe("ingest", lab / "pulses.parquet", "-r", lab / "v.yaml", "-o", lab / "flat")
    assert "warning clipped: channel n" in flat.out


def test_the_file_is_made_again_only_where_something_changed(lab: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    path = lab / "out/seal.spectra.parquet"
    before = path.stat().st_ino
    assert labpipe("frf", "-c", lab / "p.yaml", "-o", lab / "out").code == 0 and path.stat().st_ino == before
    shown = labpipe("frf", "-c", lab / "p.yaml", "-o", lab / "other", "--set", "frf.smooth=3")
    assert "seal: spectra of f_x, f_y, d_x, d_y, a_x, a_y, e_x, e_y; 2 runs, 91 lines, 10-100 Hz" in shown.out
    assert read_spectra(lab / "other/seal.spectra.parquet").covariance_dof < read_spectra(path).covariance_dof


def test_it_can_be_looked_at_and_exported(lab: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    shown = labpipe("inspect", lab / "out/seal.spectra.parquet", "-o", lab / "card.html")
    assert shown.code == 0 and "runs seal-plus, seal-minus" in shown.out and "e_x" in shown.out
    assert "Half axes of the orbits" in (lab / "card.html").read_text()
    assert labpipe("export", lab / "out/seal.spectra.parquet", "--to", "csv", "-o", lab / "s.csv").code == 0
    table, stored = pd.read_csv(lab / "s.csv"), read_spectra(lab / "out/seal.spectra.parquet")
    rows = table[table["run"] == "seal-minus"]
    np.testing.assert_allclose(
        rows["d_x:re [m]"] + 1j * rows["d_x:im [m]"], stored.vectors[:, 1, 2], rtol=1e-12
    )
    np.testing.assert_allclose(rows["d_x:std [m]"] ** 2, stored.covariance[:, 1, 2, 2].real, rtol=1e-9)
    refused = labpipe("export", lab / "out/seal.spectra.parquet", "--to", "mat", "-o", lab / "s.mat")
    assert refused.code == 2 and "known: csv, parquet" in refused.err


def test_a_project_of_such_recordings_is_proposed(lab: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    """Once rate, period and mass are decided it runs: of the 60 kg stator on 4 MN/m, k_xx is that of film and
    hoses together.
    """
    made = labpipe("init", lab / "my", lab / "seal-plus.parquet", lab / "seal-minus.parquet")
    assert made.code == 0
    rig, pipeline = (lab / "my" / name for name in ("rig.yaml", "pipeline.yaml"))
    rig.write_text(rig.read_text().replace("sample_rate: DECIDE", "sample_rate: 1 kHz"))
    text = pipeline.read_text()
    assert "result: spectra" in text and text.count("DECIDE") == 2
    pipeline.write_text(
        text.replace("period: DECIDE", "period: 1 s\n  band: 10-100 Hz").replace(
            "stator_mass: DECIDE", "stator_mass: 60 kg"
        )
    )
    assert labpipe("run", pipeline, "-o", lab / "my/out", "--set", "report.formats=[]").code == 0
    (fit,) = read_identification(lab / "my/out/identification.json").fits
    assert fit.parameter("k_xy").value == pytest.approx(11.3e6, rel=0.05)


def test_the_report_shows_amplitudes_noise_and_orbits(lab: Path) -> None:
    page = (lab / "out/report.html").read_text()
    assert (
        "Amplitudes and noise of the channels of seal" in page
        and ("Half axes of the orbits of d_x and d_y of seal") in page
    )
    result = read_identification(lab / "out/identification.json")
    (spectra,) = result.spectra
    stored = read_spectra(lab / "out/seal.spectra.parquet")
    np.testing.assert_allclose(spectra.vectors, stored.vectors, rtol=1e-12)
    assert result.measured_tests == [("seal", {"speed": "2000 rpm"})]


def test_a_model_of_responses_is_refused_beside_spectra(lab: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    (lab / "q.yaml").write_text(PIPELINE + "identify:\n  a: {model: rotor-2dof, mass: 60 kg}\n")
    refused = labpipe("run", lab / "q.yaml", "-o", lab / "refused")
    assert refused.code == 2 and "q.yaml:8:" in refused.err and "identify.a.model" in refused.err

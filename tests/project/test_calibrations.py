"""Sensitivities from certificates: in a rig, in the budget, expired, of another sensor, over frequency."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from labpipe.artefacts.identification_file import read_identification
from labpipe.cli.main import run_command
from labpipe.errors import ConfigErrors, DataError
from labpipe.project.exports import write_dcc
from labpipe.project.rig_file import load_rig
from labpipe.raw_files.certificate import read_certificate
from labpipe.records.rig import Rig
from tests.hostile.certificates import CERTIFICATE

ROOT = Path(__file__).parents[2]
OVER = "quantity: vib_amplitude, over: vib_frequency, at: 80 Hz, phase: vib_phase"


def rig(tmp_path: Path, *references: str, more: str = "") -> Rig:
    """A rig whose channels have these certificates, as they are written behind `certificate:`."""
    (tmp_path / "c.xml").write_text(CERTIFICATE, encoding="utf-8")
    lines = [
        f"  x{n}: {{quantity: displacement, unit: V, sensitivity: {{certificate: {reference}}}{more}}}\n"
        for n, reference in enumerate(references)
    ]
    path = tmp_path / "rig.yaml"
    path.write_text(f"sample_rate: 1 kHz\nchannels:\n{''.join(lines)}", encoding="utf-8")
    return load_rig(path)


def test_a_sensitivity_by_its_certificate(tmp_path: Path) -> None:
    """8.004 kV/m with U = 0.032 kV/m, k = 2."""
    both = rig(
        tmp_path, "c.xml, quantity: s80, date: 2026-11-03", f"c.xml, {OVER}, date: 2026-11-03"
    ).channels
    assert both[0].scale == pytest.approx(1 / 8004.0, rel=1e-12)
    (gain,) = both[0].channel.uncertainties
    assert (gain.effect, gain.uncertainty.source) == ("gain", "certificate 2026-0417")
    assert gain.uncertainty.std_error == pytest.approx(0.016 / 8.004, rel=1e-12)
    # The same certificate is the same source; over frequency the largest relative uncertainty counts.
    larger, phase = both[1].channel.uncertainties
    assert larger.uncertainty.source == gain.uncertainty.source
    assert larger.uncertainty.std_error == pytest.approx(0.0304 / 7.6, rel=1e-12)
    assert (phase.effect, phase.uncertainty.std_error) == ("phase", pytest.approx(math.radians(0.5)))
    rows = both[1].channel.response
    assert [row[0] for row in rows] == [20.0, 80.0, 500.0]
    assert [row[1] for row in rows] == pytest.approx([8.1 / 8.004, 1.0, 7.6 / 8.004])
    assert [row[2] for row in rows] == pytest.approx([0.0, math.radians(-1), math.radians(-6)])


@pytest.mark.parametrize(
    ("reference", "what"),
    [
        ("c.xml, quantity: s80, date: 2027-02-01", "has expired: it was valid until 2027-01-31"),
        ("c.xml, quantity: s80, date: 3.11.2026", "'3.11.2026' is not a day"),
        ("c.xml, quantity: s80, date: 2026-11-03, serial: SN 9", "is not of serial number 'SN 9'"),
        ("c.xml, quantity: s80, date: 2026-11-03, number: D-9", "is the certificate '2026-0417', not 'D-9'"),
        ("c.xml, quantity: vib_frequency, date: 2026-11-03", "states no uncertainty of 'vib_frequency'"),
        ("c.xml, quantity: vib_phase, date: 2026-11-03", "states a sensitivity of zero"),
        ("c.xml, quantity: vib_amplitude, date: 2026-11-03", "has 3 values, no single one"),
        ("c.xml, quantity: s81, date: 2026-11-03", "has no quantity 's81'; did you mean 's80'?"),
        ("d.xml, quantity: s80", "'d.xml': no such file"),
        ("c.xml, quantity: s80, date: 2026-11-03, sha256: abc", "is not the file of that SHA-256"),
        (f"c.xml, {OVER.replace('80 Hz', '81 Hz')}, date: 2026-11-03", "one of 20 Hz, 80 Hz, 500 Hz"),
        ("c.xml, quantity: s80, at: 80 Hz, date: 2026-11-03", "belong to a sensitivity over frequency"),
        ("c.xml", "channels.x0.sensitivity.quantity: is missing"),
        ("c.xml, quantity: s80, dat: 2026-11-03", "channels.x0.sensitivity.dat: unknown key"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path: Path, reference: str, what: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        rig(tmp_path, reference)
    (fault,) = caught.value.faults
    assert what in str(fault) and "rig.yaml:3:" in str(fault) and "\n" not in str(fault)


def test_a_certificate_of_another_unit(tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text(
        "certificate,quantity,value,unit,uncertainty,coverage_factor\nD-7,sensitivity,10,mV/N,1 %,2\n"
    )
    with pytest.raises(ConfigErrors, match="does not lead from the channel's unit to m"):
        rig(tmp_path, "f.csv, quantity: sensitivity")


def test_a_response_beside_one_of_the_certificate(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match="the certificate states it"):
        rig(tmp_path, f"c.xml, {OVER}, date: 2026-11-03", more=", response: r.csv")


def test_the_certificate_in_the_budget_and_the_result_as_a_certificate(tmp_path: Path) -> None:
    """8 V/mm with U = 1 %, k = 2: half a per cent of the damping under the certificate's name; the result
    as a certificate states k with the half width of its interval, and is read as one.
    """
    (tmp_path / "f.csv").write_text(
        "certificate,quantity,value,unit,uncertainty,coverage_factor\nD-7,probe,8,V/mm,1 %,2\n"
    )
    rig_text = (ROOT / "configs/hmb-pedestal.yaml").read_text(encoding="utf-8")
    certified = rig_text.replace("8 V/mm", "{certificate: f.csv, quantity: probe}")
    assert certified != rig_text
    (tmp_path / "rig.yaml").write_text(certified, encoding="utf-8")
    pipeline = tmp_path / "p.yaml"
    recording = ROOT / "sample_data/hmb/pedestal.csv"
    pipeline.write_text(
        f"title: T\nrig: rig.yaml\nrecordings: {recording}\nconditions: {{date: 2026-11-03 10:15}}\n"
        "frf: {excitation: periodic, period: 2 s, skip: 3, band: 1-100 Hz}\n"
        "identify: {p: {model: sdof, estimator: ml, input: f, output: y, band: 60-70 Hz}}\n"
        "accept: {p.c: {limits: [null, 3.73 N.s/m], rule: guarded}}\nreport: {formats: [md]}\n"
    )
    out = tmp_path / "out"
    assert run_command(["run", str(pipeline), "-o", str(out), "-q"]) == 1
    result = out / "identification.json"
    k, c = (read_identification(result).fits[0].parameter(name) for name in "kc")
    by_source = {part.source: part.contribution for part in c.budget}
    assert by_source["certificate D-7"] == pytest.approx(0.005 * c.value, rel=1e-3)
    for name in ("a.xml", "b.xml"):
        write_dcc(result, tmp_path / name)
    assert (tmp_path / "a.xml").read_bytes() == (tmp_path / "b.xml").read_bytes()
    stated = read_certificate(tmp_path / "a.xml")
    assert stated.quantity("k").values == (k.value,) and stated.quantity("fit1_k").unit == "N.m^-1"
    assert k.full_error is not None and stated.quantity("k").std_errors == pytest.approx((k.full_error,))
    assert "<dcc:conformity>conditionalPass</dcc:conformity>" in (tmp_path / "a.xml").read_text()
    assert "<dcc:endPerformanceDate>2026-11-03</" in (tmp_path / "a.xml").read_text()


def test_what_is_no_result_is_no_certificate(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be written as a certificate"):
        write_dcc(tmp_path / "x.frf.parquet", tmp_path / "a.xml")


TABLE = """certificate,serial,quantity,value,unit,uncertainty,coverage_factor
D-7,SN 1,of a,8,V/mm,1 %,2
D-7,SN 2,of b,4,V/mm,1 %,2
"""


def test_a_serial_number_is_that_of_the_quantity(tmp_path: Path) -> None:
    """A table states it in every row: of a certificate of two probes the other one's number was taken."""
    (tmp_path / "t.csv").write_text(TABLE)
    own = rig(tmp_path, "t.csv, number: D-7, quantity: of b, serial: SN 2").channels[0]
    assert own.scale == pytest.approx(1 / 4000)
    with pytest.raises(ConfigErrors, match="is not of serial number 'SN 1' in 'of b'; it names: SN 2"):
        rig(tmp_path, "t.csv, number: D-7, quantity: of b, serial: SN 1")

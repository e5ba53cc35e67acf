"""Calibration certificates: XML after the published schema of the DCC, tables, and what is refused in
words.
"""

from __future__ import annotations

import datetime
import hashlib
from pathlib import Path

import pytest

from labpipe.quantities import UnitError, parse_unit
from labpipe.raw_files.certificate import dsi_unit, read_certificate, unit_text
from tests.hostile.certificates import CERTIFICATE, judged

TABLE = """# plain certificates
certificate,serial,quantity,value,unit,uncertainty,coverage_factor,valid_until,frequency_hz
D-7,SN 1,sensitivity,8.004,V/mm,0.4 %,2,2027-01-31,
D-8,SN 2,over f,10,mV/N,0.1,2,2027-01-31,20
D-8,SN 2,over f,11,mV/N,0.1,2,2026-12-31,80
"""


def written(tmp_path: Path, content: str, name: str = "c.xml") -> Path:
    path = tmp_path / name
    path.write_text(content, encoding="utf-8")
    return path


def test_a_certificate_states_number_serials_validity_and_quantities(tmp_path: Path) -> None:
    certificate = read_certificate(written(tmp_path, CERTIFICATE))
    assert (certificate.number, certificate.serials) == ("2026-0417", ("SN 1234",))
    assert certificate.valid_until == datetime.date(2027, 1, 31)
    for name in ("s80", "vib_sensitivity", "Sensitivity"):
        assert certificate.quantity(name).values == (8.004,)
    stated = certificate.quantity("vib_amplitude")
    assert (stated.values, stated.std_errors) == ((8.1, 8.004, 7.6), (0.016, 0.016, 0.0304))
    assert certificate.quantity("vib_frequency", stated.table).values == (20.0, 80.0, 500.0)
    assert certificate.quantity("vib_phase").std_errors == (0.5, 0.5, 0.5)


@pytest.mark.parametrize(
    ("uncertainty", "error"),
    [
        (
            "<si:expandedUnc><si:uncertainty>0.04</si:uncertainty><si:coverageFactor>2</si:coverageFactor>"
            "<si:coverageProbability>0.95</si:coverageProbability></si:expandedUnc>",
            0.02,
        ),
        (
            "<si:coverageInterval><si:standardUnc>0.03</si:standardUnc><si:intervalMin>7.9</si:intervalMin>"
            "<si:intervalMax>8.1</si:intervalMax></si:coverageInterval>",
            0.03,
        ),
        (
            "<si:measurementUncertaintyUnivariate><si:standardMU><si:valueStandardMU>0.05</si:valueStandardMU>"
            "</si:standardMU></si:measurementUncertaintyUnivariate>",
            0.05,
        ),
        ("", None),
    ],
)
def test_ways_to_state_an_uncertainty(tmp_path: Path, uncertainty: str, error: float | None) -> None:
    start, end = CERTIFICATE.index("<si:measurementUnc"), CERTIFICATE.index("</si:real>")
    path = written(tmp_path, CERTIFICATE[:start] + uncertainty + CERTIFICATE[end:])
    stated = read_certificate(path).quantity("s80").std_errors
    assert stated == (None if error is None else (error,))


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        (r"\milli\volt\per\metre\second\tothe{2}", "mV.m^-1.s^2"),
        (r"\kilogram\metre\tothe{2}\second\tothe{-3}\ampere\tothe{-1}", "kg.m^2.s^-3.A^-1"),
        (r"\pico\coulomb\per\newton", "pC.N^-1"),
        (r"\volt\per\metre\per\second\tothe{-2}", None),
        (r"\metre\per", None),
        (r"\milli\milli\metre", None),
        (r"\furlong", None),
        (r"\metre oops", None),
    ],
)
def test_units_of_d_si(text: str, unit: str | None) -> None:
    if unit is None:
        with pytest.raises(UnitError):
            unit_text(text)
    else:
        assert unit_text(text) == unit
        parse_unit(unit)


@pytest.mark.parametrize("unit", ["N/m", "N.s/m", "m/(N.s^2)", "rad", "1", "kg", "Hz", "N.s^2/m"])
def test_units_come_back_from_d_si(unit: str) -> None:
    assert parse_unit(unit_text(dsi_unit(unit))) == parse_unit(unit)
    assert dsi_unit(unit).startswith("\\")


def replaced(old: str, new: str) -> str:
    assert old in CERTIFICATE
    return CERTIFICATE.replace(old, new)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("", "is not a readable XML"),
        (CERTIFICATE[:900], "is not a readable XML"),
        ("<a/>", "is not a Digital Calibration Certificate"),
        (replaced('schemaVersion="3.3.0"', 'schemaVersion="2.4.0"'), "is of schema '2.4.0'"),
        (replaced("<dcc:items>", "<!-- gone --><dcc:items>").replace("dcc:items>", "dcc:item>"), "'item'"),
        (replaced("2026-0417", ""), "'uniqueIdentifier' is empty"),
        (replaced("2026-01-31</dcc:end", "2026-13-31</dcc:end"), "which is not a day"),
        (replaced("2026-01-31</dcc:end", "2025-01-31</dcc:end"), "its calibration ends before it begins"),
        (replaced("<si:value>8.004", "<si:value>8,004"), "has '8,004', which is not a number"),
        (replaced("<si:value>8.004", "<si:value>nan"), "which is not a number"),
        (replaced("<si:coverageFactor>2", "<si:coverageFactor>0"), "coverage factor is not above zero"),
        (replaced("2026-0417<", "2026-0417<a/><"), "is empty"),
        (replaced(">8.1 8.004 7.6<", ">8.1 8.004<"), "3 entries stand beside 2 values"),
        (
            '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>',
            "declares a document type",
        ),
        ("<a>" * 300 + "</a>" * 300, "is nested too deeply"),
    ],
)
def test_what_is_no_certificate_is_refused_in_one_line(tmp_path: Path, content: str, what: str) -> None:
    with pytest.raises(UnitError) as caught:
        read_certificate(written(tmp_path, content))
    assert what in caught.value.what and "\n" not in caught.value.what


def test_a_quantity_that_is_not_there_or_twice(tmp_path: Path) -> None:
    certificate = read_certificate(written(tmp_path, replaced("vib_phase", "vib_amplitude")))
    with pytest.raises(UnitError, match="2 quantities 'vib_amplitude'"):
        certificate.quantity("vib_amplitude")
    with pytest.raises(UnitError) as caught:
        certificate.quantity("vib_amplitud")
    assert "did you mean 'vib_amplitude'?" in caught.value.hint


def test_a_certificate_that_the_laboratory_withdrew(tmp_path: Path) -> None:
    statement = "<dcc:statement><dcc:valid>false</dcc:valid></dcc:statement>"
    path = written(tmp_path, replaced("<dcc:statements>", f"<dcc:statements>{statement}"))
    assert "not valid" in read_certificate(path).refused


@pytest.mark.parametrize(
    ("period", "until"), [("P1Y", (2027, 1, 31)), ("P18M", (2027, 7, 31)), ("P1M", (2026, 2, 28))]
)
def test_a_validity_stated_as_a_period(tmp_path: Path, period: str, until: tuple[int, int, int]) -> None:
    old = "<dcc:date>2027-01-31</dcc:date>"
    path = written(tmp_path, replaced(old, f"<dcc:period>{period}</dcc:period>"))
    assert read_certificate(path).valid_until == datetime.date(*until)


def test_the_digest_of_a_certificate_pins_every_byte(tmp_path: Path) -> None:
    path = written(tmp_path, CERTIFICATE)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert read_certificate(path, sha256=digest.upper()).number == "2026-0417"
    path.write_text(replaced("8.004<", "8.005<"), encoding="utf-8")
    with pytest.raises(UnitError, match="is not the file of that SHA-256"):
        read_certificate(path, sha256=digest)


def test_a_table_of_certificates(tmp_path: Path) -> None:
    path = written(tmp_path, TABLE, "c.csv")
    plain = read_certificate(path, "D-7")
    assert plain.serials == ("SN 1",) and plain.valid_until == datetime.date(2027, 1, 31)
    assert plain.quantity("sensitivity").std_errors == pytest.approx((0.016008,))
    over = read_certificate(path, "D-8")
    assert over.valid_until == datetime.date(2026, 12, 31)
    assert over.quantity("frequency_hz", over.quantity("over f").table).values == (20.0, 80.0)
    assert over.quantity("over f").std_errors == (0.05, 0.05)


def test_a_table_with_a_phase_over_frequency(tmp_path: Path) -> None:
    """Degrees, with expanded uncertainties of k = 2 where a column states them."""
    head = TABLE.splitlines()[1] + ",phase_deg"
    rows = [f"D-9,SN 3,over f,1{n},mV/N,0.2,2,2027-01-31,{20 * n},-{n}.5" for n in (1, 2)]
    plain = read_certificate(written(tmp_path, "\n".join([head, *rows]), "p.csv"))
    assert plain.quantity("phase_deg").values == (-1.5, -2.5) and plain.quantity("phase_deg").unit == "deg"
    assert plain.quantity("phase_deg").std_errors is None
    lines = [f"{head},phase_uncertainty_deg", *(f"{row},0.{n}" for n, row in enumerate(rows, 6))]
    stated = read_certificate(written(tmp_path, "\n".join(lines), "s.csv"))
    assert stated.quantity("phase_deg").std_errors == pytest.approx((0.3, 0.35))
    assert stated.quantity("phase_deg").table == stated.quantity("over f").table


@pytest.mark.parametrize(
    ("content", "number", "what"),
    [
        (TABLE, "", "holds 2 certificates"),
        (TABLE, "D-9", "holds no certificate 'D-9'"),
        (TABLE.replace("coverage_factor", "k"), "D-7", "has no column 'coverage_factor'"),
        (TABLE.replace("serial", "serial,serial"), "D-7", "repeated column"),
        (TABLE.replace("2027-01-31,\n", "31.1.2027,\n"), "D-7", "is not a day"),
        (TABLE.replace("V/mm,0.4 %", "V/mm,-0.4 %"), "D-7", "is negative"),
        (TABLE.replace("11,mV/N", "11,V/N"), "D-8", "has several units"),
        (TABLE.replace(",20\n", ",\n"), "D-8", "'frequency_hz' has '', which is not a number"),
        (TABLE + "D-7,SN 1\n", "D-7", "more or fewer cells"),
        ("", "", "has no column 'certificate'"),
    ],
)
def test_tables_that_are_refused(tmp_path: Path, content: str, number: str, what: str) -> None:
    with pytest.raises(UnitError) as caught:
        read_certificate(written(tmp_path, content, "c.csv"), number)
    assert what in caught.value.what


@pytest.mark.long
def test_damaged_certificates_are_refused_or_state_the_same_numbers() -> None:
    refused, same, others = judged(300, seed=41)
    assert others == [] and refused > 50 and same > 50


def test_a_phase_that_begins_later_and_one_of_negative_uncertainty_are_refused(tmp_path: Path) -> None:
    head = TABLE.splitlines()[1] + ",phase_deg,phase_uncertainty_deg"
    rows = [f"D-9,SN 3,over f,1{n},mV/N,0.2,2,2027-01-31,{20 * n}" for n in (1, 2)]
    for cells, what in ((",,0.3", "'phase_deg' has ''"), (",-1.5,-0.3", "is negative")):
        content = "\n".join([head, rows[0] + cells, rows[1] + ",-2.5,0.3"])
        with pytest.raises(UnitError, match=what):
            read_certificate(written(tmp_path, content, "p.csv"))


def test_a_list_has_one_unit_for_all_numbers_or_one_for_each(tmp_path: Path) -> None:
    """As D-SI allows; they were read as one product, hertz times hertz."""
    each = CERTIFICATE.replace("<si:unitXMLList>\\hertz<", "<si:unitXMLList>\\hertz \\hertz \\hertz<")
    assert read_certificate(written(tmp_path, each)).quantity("vib_frequency").unit == "Hz"
    mixed = each.replace("\\hertz \\hertz <", "\\hertz \\kilo\\hertz <").replace(
        "\\hertz<", "\\kilo\\hertz<", 1
    )
    with pytest.raises(UnitError, match="a list of numbers has several units"):
        read_certificate(written(tmp_path, mixed))

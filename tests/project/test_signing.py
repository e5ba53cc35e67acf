"""Signatures: several signers, revoked, expired, foreign, altered, stamped; what a second program says of
them.
"""

from __future__ import annotations

import datetime
import glob
import shutil
import subprocess
import zipfile
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyhanko")

from labpipe.cli.main import run_command
from labpipe.errors import ConfigError, DataError
from labpipe.project import signing
from labpipe.project.signing import Key, Signature, Trust, sign, signatures, signed_files
from tests.hostile.signatures import MEMBERS, Signed, packed, report
from tests.project.signing_people import DAY, NOW, SECRET, Authority, authority


@pytest.fixture
def people(tmp_path: Path) -> Authority:
    return authority(tmp_path)


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    path = tmp_path / "evidence[1].zip"
    path.write_bytes(packed(MEMBERS))
    return path


@pytest.fixture
def pdf(tmp_path: Path) -> Path:
    path = tmp_path / "report.pdf"
    path.write_bytes(report())
    return path


def key(people: Authority, name: str, **options: datetime.datetime) -> Key:
    return Key(file=people.person(name, **options), secret=SECRET)


def listed(path: Path, trust: Trust) -> list[Signature]:
    return [signature for file in signed_files(path) for signature in signatures(file, trust)]


@pytest.mark.long
def test_several_people_sign_an_archive(people: Authority, archive: Path) -> None:
    before = archive.read_bytes()
    sign(archive, key(people, "Ann"), "measured", "all channels seen")
    target = sign(archive, key(people, "Bob"), "approved")
    assert target.name == "evidence[1].zip.approved.p7s" and archive.read_bytes() == before
    approved, measured = listed(archive, Trust((people.pem,)))
    assert (measured.signer, measured.role, measured.reason) == ("Ann", "measured", "all channels seen")
    assert (approved.signer, approved.role, approved.faults) == ("Bob", "approved", ())
    assert measured.faults == () and not measured.stamped
    assert measured.time.startswith(f"{NOW:%Y-%m-%dT}")
    with pytest.raises(ConfigError, match="was signed as 'approved' already"):
        sign(archive, key(people, "Cy"), "approved")


def test_several_people_sign_a_report(people: Authority, pdf: Path) -> None:
    before = pdf.read_bytes()
    target = sign(pdf, key(people, "Ann"), "measured", "day 1")
    sign(target, key(people, "Bob"), "approved")
    assert target.name == "report.signed.pdf" and pdf.read_bytes() == before
    assert target.read_bytes().startswith(before)
    signed = listed(target, Trust((people.pem,)))
    assert [(one.signer, one.role, one.reason, one.faults) for one in signed] == [
        ("Ann", "measured", "day 1", ()),
        ("Bob", "approved", "", ()),
    ]
    with pytest.raises(ConfigError, match="was signed as 'approved' already"):
        sign(target, key(people, "Bob"), "approved")
    with pytest.raises(ConfigError, match="is there already"):
        sign(pdf, key(people, "Bob"), "checked")


@pytest.mark.parametrize("kind", ["archive", "pdf"])
def test_nobody_vouches_for_a_stranger(
    people: Authority, kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    path = sign(request.getfixturevalue(kind), key(people, "Eve"), "approved")
    foreign = authority(tmp_path, "foreign")
    ((signature),) = listed(path, Trust((foreign.pem,)))
    assert "no certificate of --trust vouches for Eve" in signature.faults[0]
    ((signature),) = listed(path, Trust())
    assert "nothing vouches for Eve" in signature.faults[0]


@pytest.mark.parametrize("kind", ["archive", "pdf"])
def test_a_revoked_certificate(people: Authority, kind: str, request: pytest.FixtureRequest) -> None:
    bob = key(people, "Bob")
    path = sign(request.getfixturevalue(kind), bob, "approved")
    assert bob.file is not None
    ((signature),) = listed(path, Trust((people.pem,), (people.revoked(bob.file),)))
    assert signature.faults == ("the certificate of Bob was revoked",)
    ((signature),) = listed(path, Trust((people.pem,), (people.revoked(),)))
    assert signature.faults == ()


@pytest.mark.parametrize("kind", ["archive", "pdf"])
def test_an_expired_certificate(
    people: Authority, kind: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = request.getfixturevalue(kind)
    expired = key(people, "Old", begin=NOW - 10 * DAY, end=NOW - DAY)
    with pytest.raises(ConfigError, match="the certificate of Old is valid from"):
        sign(path, expired, "checked")
    # As somebody who signs by another program does.
    monkeypatch.setattr(signing, "_check_valid", lambda certificate, where: None)
    path = sign(path, expired, "checked")
    ((signature),) = listed(path, Trust((people.pem,)))
    assert "the certificate of Old has expired, and no time stamp proves" in signature.faults[0]


@pytest.mark.parametrize("kind", ["archive", "pdf"])
def test_a_time_stamp_proves_the_time(
    people: Authority, kind: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that stamped two days ago, when the certificate was valid; it expired yesterday."""
    from pyhanko.sign import signers, timestamps

    server = people.person("clock", NOW - 9 * DAY, stamps=True)
    clock = signers.SimpleSigner.load_pkcs12(str(server), passphrase=SECRET.encode())
    moment = (NOW - 2 * DAY).replace(microsecond=0)
    stamper = timestamps.DummyTimeStamper(
        clock.signing_cert, clock.signing_key, clock.cert_registry, fixed_dt=moment
    )
    monkeypatch.setattr(timestamps, "HTTPTimeStamper", lambda url: stamper)
    monkeypatch.setattr(signing, "_check_valid", lambda certificate, where: None)
    old = key(people, "Old", begin=NOW - 10 * DAY, end=NOW - DAY)
    path = sign(request.getfixturevalue(kind), old, "checked", timestamp="stamps.example")
    ((signature),) = listed(path, Trust((people.pem,)))
    assert signature.faults == () and signature.stamped
    assert signature.time == f"{moment:%Y-%m-%dT%H:%M:%SZ}" and "time stamp" in signature.text


def test_a_changed_file_of_an_archive_is_named(people: Authority, archive: Path) -> None:
    """The attacker made the digests of the metadata anew."""
    sign(archive, key(people, "Ann"), "measured")
    names = list(MEMBERS)
    changed = {**MEMBERS, names[0]: MEMBERS[names[0]].replace(b"1.25", b"1.26"), "new": b""}
    del changed[names[1]]
    archive.write_bytes(packed(changed))
    ((signature),) = listed(archive, Trust((people.pem,)))
    assert f"{names[0]}: is not the file that was signed" in signature.faults
    assert f"{names[1]}: was signed, and is gone" in signature.faults
    assert "new: was added" in signature.faults
    archive.unlink()
    ((signature),) = [one for file in [*archive.parent.glob("*.p7s")] for one in signatures(file, Trust())]
    assert "which it signs, is not there" in signature.faults[0]


@pytest.mark.parametrize("kept", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_damaged_file_of_an_archive_is_named(people: Authority, archive: Path, kept: int) -> None:
    """Bytes of one member are turned over: as they are, and compressed, which then cannot be unpacked."""
    with zipfile.ZipFile(archive, "w", kept) as packing:
        for name in ("a.csv", "b.csv"):
            packing.writestr(name, 500 * "1.25\n")
    sign(archive, key(people, "Ann"), "measured")
    content = bytearray(archive.read_bytes())
    start = content.index(b"a.csv") + len("a.csv")
    content[start : start + 12] = bytes(byte ^ 0xFF for byte in content[start : start + 12])
    archive.write_bytes(content)
    ((signature),) = listed(archive, Trust((people.pem,)))
    assert signature.faults == ("a.csv: is not the file that was signed",)


def test_one_changed_byte_is_noticed(tmp_path: Path) -> None:
    signed = Signed(tmp_path)
    rng = np.random.default_rng(41)
    assert all(signed.noticed(rng, number % 3) for number in range(60))


def test_a_report_behind_the_last_signature(people: Authority, pdf: Path) -> None:
    target = sign(pdf, key(people, "Ann"), "measured")
    target.write_bytes(target.read_bytes() + b"% more\n")
    ((signature),) = listed(target, Trust((people.pem,)))
    assert signature.faults == ("something was added behind the last signature",)


@pytest.mark.parametrize("content", [b"", b"%PDF-1.7\nnothing", b"\x30\x82"])
def test_what_carries_no_signature_is_refused(tmp_path: Path, content: bytes, people: Authority) -> None:
    for name in ("a.signed.pdf", "a.zip.measured.p7s"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=r"cannot be read|not a readable signature"):
            list(signatures(tmp_path / name, Trust()))
    (tmp_path / "b.pdf").write_bytes(content)
    with pytest.raises(DataError):
        sign(tmp_path / "b.pdf", key(people, "Ann"), "measured")
    assert not (tmp_path / "b.signed.pdf").exists()


def test_keys_and_certificates_that_cannot_be_used(
    people: Authority, archive: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ann = people.person("Ann")
    with pytest.raises(ConfigError, match="or its password is another"):
        sign(archive, Key(file=ann, secret="other"), "measured")
    # The library's log, with a traceback, would stand above the message.
    assert not caplog.records
    with pytest.raises(ConfigError, match="no such file"):
        sign(archive, Key(file=tmp_path / "none.p12"), "measured")
    with pytest.raises(DataError, match="no such file"):
        sign(tmp_path / "none.zip", Key(file=ann), "measured")
    sign(archive, Key(file=ann, secret=SECRET), "measured")
    for trust in (Trust((ann,)), Trust((people.pem,), (ann,))):
        with pytest.raises(ConfigError, match=r"is not a certificate|is not a list"):
            listed(archive, trust)
    assert [file.name for file in tmp_path.glob("*.p7s")] == ["evidence[1].zip.measured.p7s"]


def test_a_missing_extra_is_said(monkeypatch: pytest.MonkeyPatch, archive: Path, people: Authority) -> None:
    ann = key(people, "Ann")
    monkeypatch.setitem(__import__("sys").modules, "pyhanko.sign.signers", None)
    with pytest.raises(ConfigError) as caught:
        sign(archive, ann, "measured")
    assert "labpipe[sign]" in str(caught.value)


def test_the_commands(
    people: Authority, pdf: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ann = str(people.person("Ann"))
    monkeypatch.setenv("LABPIPE_SIGN_PASSWORD", SECRET)
    assert run_command(["sign", str(pdf), "--key", ann, "--as", "checked", "--reason", "seen"]) == 0
    target, trust = str(pdf.with_name("report.signed.pdf")), ["--trust", str(people.pem)]
    assert capsys.readouterr().out == f"written: {target}, checked\n"
    assert run_command(["verify", target, *trust]) == 0
    assert "checked by Ann, stated time" in capsys.readouterr().out
    assert run_command(["verify", target, *trust, "--signed", "checked", "--signed", "approved"]) == 1
    assert "FAILED" in (said := capsys.readouterr().out) and "nobody has signed it as 'approved'" in said
    assert run_command(["verify", target]) == 1
    assert run_command(["verify", str(pdf), *trust]) == 1
    assert "carries no signature" in capsys.readouterr().out
    assert run_command(["verify", f"{target}x.pdf"]) == 2
    assert run_command(["sign", str(pdf)]) == 2
    assert run_command(["sign", str(pdf), "--pkcs11", "lib.so"]) == 2
    monkeypatch.delenv("LABPIPE_SIGN_PASSWORD")
    assert run_command(["sign", str(pdf), "--key", ann]) == 2
    assert "LABPIPE_SIGN_PASSWORD" in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("pdfsig") is None, reason="pdfsig of poppler is not installed")
def test_pdfsig_accepts_a_signed_report(people: Authority, pdf: Path) -> None:
    target = sign(pdf, key(people, "Ann"), "measured")
    sign(target, key(people, "Bob"), "approved")
    ended = subprocess.run(["pdfsig", "-nocert", str(target)], capture_output=True, text=True, check=False)
    assert ended.stdout.count("Signature is Valid.") == 2 and "Total document signed" in ended.stdout


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_openssl_accepts_a_detached_signature(people: Authority, archive: Path) -> None:
    target = sign(archive, key(people, "Ann"), "measured")
    command = ["openssl", "cms", "-verify", "-inform", "DER", "-binary", "-purpose", "any"]
    command += ["-in", str(target), "-content", str(archive), "-CAfile", str(people.pem), "-out", "/dev/null"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


SOFT_TOKEN = next(iter(glob.glob("/usr/lib/softhsm/libsofthsm2.so")), "")


@pytest.mark.skipif(
    not SOFT_TOKEN or find_spec("pkcs11") is None, reason="SoftHSM or python-pkcs11 is not installed"
)
def test_a_key_on_a_token(
    people: Authority, archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A token in software (SoftHSM) stands for a card: the key does not leave it."""
    from cryptography.hazmat.primitives.serialization import Encoding, pkcs12

    (tmp_path / "tokens").mkdir()
    (tmp_path / "softhsm2.conf").write_text(f"directories.tokendir = {tmp_path}/tokens\n")
    monkeypatch.setenv("SOFTHSM2_CONF", str(tmp_path / "softhsm2.conf"))
    init = ["softhsm2-util", "--init-token", "--free", "--label", "card", "--pin", "1234", "--so-pin", "5678"]
    subprocess.run(init, check=True, capture_output=True)
    private, certificate, _ = pkcs12.load_key_and_certificates(
        people.person("Cy", stamps=True).read_bytes(), SECRET.encode()
    )
    assert private is not None and certificate is not None
    import pkcs11
    from cryptography.hazmat.primitives.serialization import NoEncryption, PrivateFormat
    from pkcs11.util.rsa import decode_rsa_private_key
    from pkcs11.util.x509 import decode_x509_certificate

    encoded = private.private_bytes(Encoding.DER, PrivateFormat.TraditionalOpenSSL, NoEncryption())
    with pkcs11.lib(SOFT_TOKEN).get_token(token_label="card").open(rw=True, user_pin="1234") as session:
        label = {pkcs11.Attribute.LABEL: "cy", pkcs11.Attribute.ID: b"1", pkcs11.Attribute.TOKEN: True}
        session.create_object({**decode_rsa_private_key(encoded), **label, pkcs11.Attribute.SIGN: True})
        session.create_object({**decode_x509_certificate(certificate.public_bytes(Encoding.DER)), **label})
    token = Key(module=SOFT_TOKEN, token="card", label="cy", secret="1234")
    path = sign(archive, token, "approved")
    ((signature),) = listed(path, Trust((people.pem,)))
    assert (signature.signer, signature.faults) == ("Cy", ())
    for wrong in (
        replace(token, secret="0000"),
        replace(token, token="none"),
        replace(token, module="no.so"),
    ):
        with pytest.raises(ConfigError, match="cannot be opened"):
            sign(archive, wrong, "checked")
    with pytest.raises(ConfigError, match="no certificate 'bob'"):
        sign(archive, replace(token, label="bob"), "checked")

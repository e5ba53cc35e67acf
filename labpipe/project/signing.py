"""Signatures of people: reports as PDF by PAdES, other files by a detached CMS signature (CAdES),
FILE.ROLE.p7s. It is beside what it signs, never in an artefact: a signed report is a PDF of its own.
pyHanko, of the extra `sign`, signs and verifies; nothing is fetched from a network but time stamps of a
server that is named.
"""

from __future__ import annotations

import asyncio
import datetime
import glob
import hashlib
import io
import json
import logging
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from labpipe.artefacts.header import code_digest
from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.writing import output_file
from labpipe.errors import ConfigError, DataError, shorten
from labpipe.project.archive import DAMAGE
from labpipe.project.report import drawn_from, stamped_source

ROLES = ("measured", "checked", "approved")
SIGNED_PDF, DETACHED = ".signed.pdf", ".p7s"
# Content hints of CMS (RFC 2634, 2.9): what is signed, in words that are signed along.
HINTS = "1.2.840.113549.1.9.16.2.4"
# Uses of a key with which people sign.
USAGES = {"non_repudiation", "digital_signature"}


def _library(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        what = f"signatures need {name.partition('.')[0]}, which is not installed"
        raise ConfigError(what, hint="pip install 'labpipe[sign]'") from None


@dataclass(frozen=True, kw_only=True)
class Key:
    """The key of a person: a PKCS#12 *file*, or the *token* of a PKCS#11 *module* with the *label* of its
    certificate; *secret*: password or PIN.
    """

    file: Path | None = None
    module: str = ""
    token: str = ""
    label: str = ""
    secret: str = ""


@contextmanager
def _signer(key: Key) -> Iterator[Any]:
    signers = _library("pyhanko.sign.signers")
    if key.file is not None:
        if not key.file.is_file():
            raise ConfigError("no such file", key.file, "name your key as PKCS#12 (.p12, .pfx)")
        # By its content: by its name the library prints a traceback of its own.
        content, signer = key.file.read_bytes(), None
        with suppress(ValueError, TypeError):
            signer = signers.SimpleSigner.load_pkcs12_data(content, (), key.secret.encode())
        if signer is None or signer.signing_cert is None:
            raise ConfigError("is not a PKCS#12 file, or its password is another", key.file)
        _check_valid(signer.signing_cert, str(key.file))
        yield signer
        return
    hardware, config = _library("pyhanko.sign.pkcs11"), _library("pyhanko.config.pkcs11")
    errors = _library("pkcs11.exceptions")
    try:
        criteria = config.TokenCriteria(label=key.token)
        session = hardware.open_pkcs11_session(key.module, token_criteria=criteria, user_pin=key.secret)
    except (errors.PKCS11Error, RuntimeError, OSError) as error:
        what = str(error) or type(error).__name__
        raise ConfigError(f"the token '{key.token}' cannot be opened ({what})", key.module) from None
    with session:
        signer = hardware.PKCS11Signer(session, cert_label=key.label, key_label=key.label)
        try:
            certificate = signer.signing_cert
        except Exception as error:
            raise ConfigError(f"no certificate '{key.label}' ({error})", key.token) from None
        _check_valid(certificate, key.token)
        yield signer


def _check_valid(certificate: Any, where: str) -> None:
    now = datetime.datetime.now(datetime.UTC)
    begin, end = certificate.not_valid_before, certificate.not_valid_after
    if not begin <= now <= end:
        days = f"from {begin:%Y-%m-%d} to {end:%Y-%m-%d}"
        raise ConfigError(f"the certificate of {person(certificate)} is valid {days} only", where)


def person(certificate: Any) -> str:
    """Whose certificate it is, in words."""
    names = certificate.subject.native
    return shorten(str(names.get("common_name") or certificate.subject.human_friendly))


def sign(path: Path, key: Key, role: str, reason: str = "", timestamp: str = "") -> Path:
    """Sign a file as somebody who *measured*, *checked* or *approved*; the file that holds the signature. A
    PDF is signed by PAdES, first into NAME.signed.pdf beside it, further ones into that; any other file has
    the signature FILE.ROLE.p7s. *timestamp*: URL of a time-stamp server (RFC 3161). ConfigError for a key
    that cannot be used or a role that has signed; DataError for no file to sign.
    """
    if not path.is_file():
        raise DataError("no such file", path, "sign a report (.pdf) or an archive (.zip, .eln)")
    timestamper = _library("pyhanko.sign.timestamps").HTTPTimeStamper(timestamp) if timestamp else None
    with _signer(key) as signer:
        try:
            if path.suffix.lower() == ".pdf":
                return _sign_pdf(path, signer, role, reason, timestamper)
            return _sign_detached(path, signer, role, reason, timestamper)
        except (OSError, _library("pyhanko.sign.timestamps").TimestampRequestError) as error:
            raise DataError(f"could not be signed ({error})", path) from None


def _sign_pdf(path: Path, signer: Any, role: str, reason: str, timestamper: Any) -> Path:
    signers, fields = _library("pyhanko.sign.signers"), _library("pyhanko.sign.fields")
    writer = _library("pyhanko.pdf_utils.incremental_writer")
    target = path if path.name.endswith(SIGNED_PDF) else path.with_name(f"{path.stem}{SIGNED_PDF}")
    if target != path and target.exists():
        raise ConfigError("is there already", target, f"sign {target.name} itself")
    meta = signers.PdfSignatureMetadata(
        field_name=role,
        reason=f"{role}: {reason}" if reason else role,
        name=person(signer.signing_cert),
        md_algorithm="sha256",
        subfilter=fields.SigSeedSubFilter.PADES,
        signer_key_usage=set(),
    )
    try:
        document = writer.IncrementalPdfFileWriter(io.BytesIO(path.read_bytes()))
        if any(role == name for name, *_ in fields.enumerate_sig_fields(document)):
            raise ConfigError(f"was signed as '{role}' already", path)
        signed = signers.PdfSigner(meta, signer, timestamper=timestamper).sign_pdf(document)
    except _library("pyhanko.pdf_utils.misc").PdfError as error:
        raise DataError(f"is not a PDF that can be signed ({error})", path) from None
    with output_file(target) as temporary:
        temporary.write_bytes(signed.getvalue())
    return target


def _sign_detached(path: Path, signer: Any, role: str, reason: str, timestamper: Any) -> Path:
    target = path.with_name(f"{path.name}.{role}{DETACHED}")
    if target.exists():
        raise ConfigError(f"was signed as '{role}' already", target)
    content = path.read_bytes()
    words = {"file": path.name, "role": role, "reason": reason, "members": members_of(path)}
    now = datetime.datetime.now(datetime.UTC)
    settings = _library("pyhanko.sign.signers.pdf_cms").PdfCMSSignedAttributes(signing_time=now)
    plain = signer._signed_attr_provider_spec(settings, timestamper, use_cades=False, is_pdf_sig=False)
    signer.signed_attr_prov_spec = _with_hints(plain, json.dumps(words, sort_keys=True))
    signs = signer.async_sign_general_data(content, "sha256", detached=True, timestamper=timestamper)
    signature = asyncio.run(signs)
    with output_file(target) as temporary:
        temporary.write_bytes(signature.dump())
    return target


def members_of(path: Path) -> dict[str, str]:
    """The SHA-256 of the files in an archive by their names, to name a change, empty of one that cannot be
    read; none of other files.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {name: _member_digest(archive, name) for name in archive.namelist()}
    except DAMAGE:
        return {}


def _member_digest(archive: zipfile.ZipFile, name: str) -> str:
    try:
        return hashlib.sha256(archive.read(name)).hexdigest()
    except DAMAGE:
        return ""


def _with_hints(plain: Any, text: str) -> Any:
    core: Any = _library("asn1crypto.core")
    cms = _library("asn1crypto.cms")
    attributes: Any = _library("pyhanko.sign.attributes")

    class ContentHints(core.Sequence):  # type: ignore[misc]
        _fields = [("description", core.UTF8String), ("content_type", core.ObjectIdentifier)]  # noqa: RUF012

    class Hints(attributes.CMSAttributeProvider):  # type: ignore[misc]
        async def get_attribute(self, dry_run: bool = False) -> Any:  # noqa: ARG002 (as the library calls it)
            hints = ContentHints({"description": text, "content_type": "1.2.840.113549.1.7.1"})
            return cms.CMSAttribute({"type": HINTS, "values": [core.Any(hints)]})

    class WithHints(attributes.SignedAttributeProviderSpec):  # type: ignore[misc]
        def signed_attr_providers(self, data_digest: bytes, digest_algorithm: str) -> Iterator[Any]:
            yield from plain.signed_attr_providers(data_digest, digest_algorithm)
            yield Hints()

    return WithHints()


@dataclass(frozen=True)
class Trust:
    """Certificates that vouch for signers, and lists of revoked ones, as files in PEM or DER."""

    roots: tuple[Path, ...] = ()
    revoked: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Signature:
    """A signature as it was found: of which *file*, by *signer* as *role*, for a *reason*, at the *time* that
    is stated, or proven by a time stamp (*stamped*). faults: what does not hold.
    """

    file: Path
    signer: str
    role: str = ""
    reason: str = ""
    time: str = ""
    stamped: bool = False
    faults: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        what = f"{self.role} by {self.signer}" if self.role else f"signed by {self.signer}"
        when = f", {'time stamp' if self.stamped else 'stated time'} {self.time}" if self.time else ""
        return what + when + (f": {self.reason}" if self.reason else "")


def signed_files(path: Path) -> list[Path]:
    """The signed PDFs and detached signatures of a file or below a folder, in order."""
    if path.is_dir():
        return sorted(file for end in (SIGNED_PDF, DETACHED) for file in path.rglob(f"*{end}"))
    if path.suffix.lower() in (".pdf", DETACHED):
        return [path]
    return sorted(path.parent.glob(f"{glob.escape(path.name)}.*{DETACHED}"))


def signatures(path: Path, trust: Trust) -> Iterator[Signature]:
    """Every signature of a file. DataError for an unreadable one, ConfigError for one in *trust*."""
    for library in ("pyhanko", "pyhanko_certvalidator"):
        # What it says of a certificate that nobody vouches for is a fault here, and no trace of an error.
        logging.getLogger(library).setLevel(logging.CRITICAL + 1)
    if path.suffix.lower() == ".pdf":
        yield from _in_pdf(path, trust)
    else:
        yield _detach(path, trust)


def _context(trust: Trust, moment: datetime.datetime | None = None) -> Any:
    keys, crl = _library("pyhanko.keys"), _library("asn1crypto.crl")
    roots: list[Any] = []
    for file in trust.roots:
        try:
            roots += list(keys.load_certs_from_pemder([str(file)]))
            [root.subject.native for root in roots]  # A damaged one shows when it is read.
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise ConfigError(f"is not a certificate ({shorten(str(error))})", file) from None
    lists, pem = [], _library("asn1crypto.pem")
    for file in trust.revoked:
        try:
            content = file.read_bytes()
            content = pem.unarmor(content)[2] if pem.detect(content) else content
            lists.append(crl.CertificateList.load(content))
            lists[-1].native  # noqa: B018 (a damaged one shows when it is read)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise ConfigError(
                f"is not a list of revoked certificates ({shorten(str(error))})", file
            ) from None
    return _library("pyhanko_certvalidator").ValidationContext(
        trust_roots=roots,
        moment=moment,
        allow_fetching=False,
        crls=lists,
        revocation_mode="require" if lists else "soft-fail",
        retroactive_revinfo=True,
    )


def _status(validate: Callable[..., Any], trust: Trust) -> Any:
    constraints = _library("pyhanko.sign.validation.settings").KeyUsageConstraints
    usage = constraints(key_usage=USAGES, match_all_key_usages=False)
    moment = None
    for _ in range(2):
        status = validate(_context(trust, moment), _context(trust), key_usage_settings=usage)
        moment = _time_of_stamp(status)
        if moment is None:
            break
    return status


def _in_pdf(path: Path, trust: Trust) -> Iterator[Signature]:
    validation = _library("pyhanko.sign.validation")
    reader = _library("pyhanko.pdf_utils.reader")
    content = path.read_bytes()
    try:
        embedded = list(reader.PdfFileReader(io.BytesIO(content), strict=False).embedded_signatures)
        validate = validation.validate_pdf_signature
        states = [(signature, _status(partial(validate, signature), trust)) for signature in embedded]
    except ConfigError:
        raise
    except Exception as error:  # A damaged PDF raises whatever its place happens to be read as.
        raise DataError(f"its signatures cannot be read ({shorten(str(error))})", path) from None
    whole = _library("pyhanko.sign.validation.status").SignatureCoverageLevel.ENTIRE_FILE
    for number, (signature, status) in enumerate(states, 1):
        faults = _faults(status, trust)
        if not faults and number == len(states) and status.coverage != whole:
            faults = ("something was added behind the last signature",)
        if not faults and (status.modification_level is None or not status.bottom_line):
            faults = ("was changed after it was signed",)
        reason = str(signature.sig_object.get("/Reason", ""))
        yield _statement(path, status, signature.field_name, reason.partition(": ")[2], faults)


def _statement(path: Path, status: Any, role: str, reason: str, faults: tuple[str, ...]) -> Signature:
    stamp = _time_of_stamp(status)
    time = stamp or status.signer_reported_dt
    return Signature(
        file=path,
        signer=person(status.signing_cert),
        role=shorten(role),
        reason=shorten(reason),
        time="" if time is None else time.astimezone(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        stamped=stamp is not None,
        faults=faults,
    )


def _time_of_stamp(status: Any) -> datetime.datetime | None:
    stamp = status.timestamp_validity
    return stamp.timestamp if stamp is not None and stamp.trusted else None


def _faults(status: Any, trust: Trust) -> tuple[str, ...]:
    name = person(status.signing_cert)
    if not status.intact:
        return ("is not what was signed: a byte of it was changed",)
    if not status.valid:
        return (f"the signature is not by the key of {name}",)
    if status.revoked:
        return (f"the certificate of {name} was revoked",)
    if status.trusted:
        return ()
    if not trust.roots:
        return (f"nothing vouches for {name}: name the certificate that issued theirs by --trust",)
    why = str(getattr(status.trust_problem_indic, "name", status.trust_problem_indic) or "unknown issuer")
    if "EXPIRED" in why or "OUT_OF_BOUNDS" in why:
        return (f"the certificate of {name} has expired, and no time stamp proves that it was signed before",)
    if "REVOKED" in why:
        return (f"the certificate of {name} was revoked",)
    return (f"no certificate of --trust vouches for {name} ({why.lower().replace('_', ' ')})",)


def drawn_from_another(path: Path) -> str:
    """What is wrong with a signed report: that it was drawn from another result than the one beside it. Empty
    where it was drawn from that, by the build that made it or by this one, or there is none.
    """
    result = path.with_name(NAME)
    if not result.is_file():
        return ""
    builds = (read_identification(result).code, code_digest())
    drawn = stamped_source(path.read_bytes()) in [drawn_from(result, code) for code in builds]
    return "" if drawn else f"was not drawn from the {NAME} beside it, which is not what was signed"


def _detach(path: Path, trust: Trust) -> Signature:
    cms, validation = _library("asn1crypto.cms"), _library("pyhanko.sign.validation")
    signed = path.with_name(path.name.removesuffix(DETACHED).rpartition(".")[0])
    try:
        data = cms.ContentInfo.load(path.read_bytes(), strict=True)["content"]
        words = _words(data["signer_infos"][0])
        content = signed.read_bytes() if signed.is_file() else None
        validate = partial(validation.async_validate_detached_cms, content or b"", data)
        status = _status(lambda *contexts, **more: asyncio.run(validate(*contexts, **more)), trust)
    except ConfigError:
        raise
    except Exception as error:  # Damaged DER raises whatever it happens to be read as.
        raise DataError(f"is not a readable signature ({shorten(str(error))})", path) from None
    faults = _faults(status, trust)
    if content is None:
        faults = (f"'{signed.name}', which it signs, is not there",)
    elif not status.intact:
        members = words.get("members", {})
        now = members_of(signed)
        changed = [name for name in members if name in now and now[name] != members[name]]
        kinds = (
            (changed, "is not the file that was signed"),
            ([name for name in members if name not in now], "was signed, and is gone"),
            ([name for name in now if name not in members], "was added"),
        )
        faults = tuple(f"{shorten(name)}: {what}" for names, what in kinds for name in names) or faults
    return _statement(signed, status, str(words.get("role", "")), str(words.get("reason", "")), faults)


def _words(signer_info: Any) -> dict[str, Any]:
    for attribute in signer_info["signed_attrs"]:
        if attribute["type"].dotted == HINTS:
            text = attribute["values"][0].parse(_library("asn1crypto.core").Sequence)[0].native
            words = json.loads(text)
            return words if isinstance(words, dict) else {}
    return {}

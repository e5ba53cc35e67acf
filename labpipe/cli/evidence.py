"""labpipe archive and verify: a result as evidence."""

from __future__ import annotations

import datetime
import os
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import click

from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.mirrored import everything, read_results
from labpipe.artefacts.writing import is_remote, output_folder, show
from labpipe.cli import options
from labpipe.cli.many import manner
from labpipe.cli.output import echo, message_line
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.project.archive import (
    RESULTS,
    changed_settings,
    check_output,
    contents,
    is_archive,
    pack,
    unpack,
)
from labpipe.project.one_test import change_day
from labpipe.project.pipeline_file import Pipeline, load_pipeline
from labpipe.project.run import run
from labpipe.project.run_record import begin as begin_record, faults_of_record, head, record_of_runs, runs_of
from labpipe.project.signing import (
    DETACHED,
    ROLES,
    Key,
    Trust,
    drawn_from_another,
    sign as signed,
    signatures,
    signed_files,
)
from labpipe.project.verification import differences, pipeline_folder, verify_artefacts


@click.command()
@click.argument("results", type=options.PATH)
@options.path("-o", "--output", required=True, help="File to write: .zip, or .eln for notebooks.")
@options.path(
    "-c",
    "--config",
    "pipeline_path",
    metavar="PIPELINE",
    help="The pipeline that made the results; by default a file of its name in or above them.",
)
@click.option(
    "--digests-only",
    is_flag=True,
    help="Of recordings, raw and calibrated, keep the digests and not the recordings.",
)
@click.option(
    "--date",
    "date",
    metavar="DATE",
    help="Day of publication, e.g. 2026-11-03; by default that of the result (UTC).",
)
@options.quiet
def archive(
    results: Path, output: Path, pipeline_path: Path | None, digests_only: bool, date: str | None, quiet: bool
) -> None:
    """Pack RESULTS with all they were made from into one file, an RO-Crate 1.1: pipeline, rig, recordings,
    result, report, digests.

    The same results give the same bytes. `labpipe verify FILE` checks every digest in it, runs the pipeline
    again and compares.

    \b
    labpipe run pipeline.yaml -o out/
    labpipe archive out/ -o evidence.zip
    labpipe verify evidence.zip
    """
    check_output(output)
    day = _day(date)
    folder = results.parent if results.name == NAME else results
    if not (folder / NAME).is_file():
        raise DataError(f"holds no {NAME}", folder, "results appear with `labpipe run PIPELINE -o FOLDER`")
    result = read_identification(folder / NAME)
    if result.dataset is not None and not result.inputs:
        what = "is of a watch, whose recordings came one by one: no pipeline gives it again"
        hint = "run `labpipe run` over them, `each: FOLDER/*`, and archive its results"
        raise DataError(what, folder / NAME, hint)
    if pipeline_path is None:
        home = pipeline_folder(folder)
        if home is None:
            what = f"no pipeline '{result.pipeline}' is in or above the results"
            raise ConfigError(what, folder, "name it with -c PIPELINE")
        pipeline_path = home / result.pipeline
    pipeline = load_pipeline(pipeline_path)
    with tempfile.TemporaryDirectory() as scratch:
        packed = contents(folder, pipeline, Path(scratch), digests_only=digests_only)
        pack(packed, output, day or change_day(folder / NAME))
    if quiet:
        return
    kept = [member for member in packed.members if member.kept]
    others = len(packed.members) - len(kept)
    echo(f"written: {output}, {len(kept)} files" + (f"; of {others} more the digests" if others else ""))
    for path in packed.left_out:
        echo(f"left out: {path}, which does not belong to this result")


def _day(text: str | None) -> str:
    if text is None:
        return ""
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError:
        raise ConfigError(f"--date: '{text}' is not a day", hint="write it as 2026-11-03") from None


@click.command()
@click.argument("folder", type=options.PATH)
@click.option(
    "--begin", is_flag=True, help="Begin the record: from now on every run below FOLDER adds a line."
)
@click.option("--inputs", is_flag=True, help="The files that each run was made from, with their digests.")
def runs(folder: Path, begin: bool, inputs: bool) -> None:
    """Show the record of runs of FOLDER: who, when, which pipeline, which outcome.

    A record is begun once, and `labpipe run` with results in or below FOLDER adds to it. Every line holds the
    digest of the line before: `labpipe verify FOLDER` says where one was changed or removed.

    \b
    labpipe runs results/ --begin
    labpipe run pipeline.yaml -o results/monday
    labpipe runs results/
    """
    if begin:
        echo(f"begun: {begin_record(folder)}")
        return
    record = record_of_runs(folder)
    if record is None:
        raise DataError("has no record of runs", folder, "begin one by --begin")
    for line in runs_of(record):
        what = " ".join(filter(None, (line.pipeline, f"-> {line.result}" if line.result else "")))
        who = f"{line.number} {line.time} {line.who}, labpipe {line.version}"
        echo(message_line(f"{who}: {what} {line.outcome}"))
        for reference in line.inputs if inputs else ():
            echo(message_line(f"    {reference['sha256']} {reference['path']}"))
    echo(f"last line: {head(record)}")


@click.command()
@click.argument("folder", type=options.PLACE)
@options.path(
    "-c",
    "--config",
    "pipeline_path",
    metavar="PIPELINE",
    help="The pipeline that made the results: its raw files are compared as well.",
)
@click.option(
    "--again", is_flag=True, help="Run the pipeline again, aside, and compare every artefact byte for byte."
)
@options.path("--trust", multiple=True, help="Certificate (PEM, DER) that vouches for signers (repeatable).")
@options.path(
    "--crl", multiple=True, help="List of revoked certificates (repeatable); without it none is looked for."
)
@click.option(
    "--signed",
    type=click.Choice(ROLES),
    multiple=True,
    help="Somebody must have signed as this (repeatable).",
)
@options.jobs
@options.usual
def verify(
    folder: Path,
    pipeline_path: Path | None,
    again: bool,
    trust: tuple[Path, ...],
    crl: tuple[Path, ...],
    signed: tuple[str, ...],
    jobs: int,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> int:
    """Verify the artefacts below FOLDER: each against the digest of its content, and the files that it was
    made from.

    FOLDER may be s3://bucket/prefix, or an archive of `labpipe archive`: every file in it is compared with
    its digest as well, and with recordings in it the pipeline is run again and its artefacts compared byte
    for byte. Exit code 0 when all holds, 1 when something does not, 2 when nothing could be verified.
    Results of earlier versions carry no digest, which is said and is no fault.

    \b
    labpipe verify out/
    labpipe verify out/ -c pipeline.yaml --again
    labpipe verify evidence.zip --trust laboratory-ca.pem --signed approved
    labpipe verify out/report.signed.pdf --trust laboratory-ca.pem
    """
    is_file = folder.suffix.lower() in (".pdf", DETACHED) and not folder.is_dir()
    if is_file:
        options.refuse_given(("pipeline_path", "again"), "a folder or an archive")
    if not again and not is_archive(folder):
        options.refuse_given(("jobs", "overrides"), "a second run: add --again")
    if not trust:
        options.refuse_given(("crl",), "certificates that somebody vouches for: add --trust FILE")
    if is_remote(folder) and (is_file or is_archive(folder) or signed):
        what = "is elsewhere; archives and signatures are verified here only"
        raise DataError(what, show(folder), "copy it here")
    unsigned = 0 if is_remote(folder) else _verify_signatures(folder, Trust(trust, crl), signed, quiet)
    if is_file:
        return 1 if unsigned else 0
    how = Manners(again, jobs, overrides, quiet, verbose)
    if is_archive(folder):
        code = _verify_archive(folder, pipeline_path, how)
        return 1 if unsigned else code
    if again and pipeline_path is None:
        raise ConfigError("--again: needs the pipeline", hint="name it with -c PIPELINE")
    with read_results(folder, everything) as here:
        code = _verify_folder(here, show(folder), pipeline_path, how)
        if pipeline_path is not None and not again and (here / NAME).is_file():
            with suppress(LabpipeError):
                result, pipeline = read_identification(here / NAME), load_pipeline(pipeline_path)
                if stale := changed_settings(result, pipeline, folder):
                    echo(message_line(f"{pipeline_path}: {stale}; `labpipe run` makes it again"))
        broken = 0 if is_remote(folder) else _verify_record(here, quiet)
    return 1 if unsigned or broken else code


def _verify_record(folder: Path, quiet: bool) -> int:
    record = record_of_runs(folder)
    if record is None:
        return 0
    faults = faults_of_record(record)
    for fault in faults:
        echo(message_line(f"FAILED {record}: {fault}"))
    if not quiet:
        count = len(runs_of(record))
        echo(f"{count} lines of the record of runs: {len(faults)} faults; last line {head(record)}")
    return len(faults)


def _verify_signatures(path: Path, trust: Trust, needed: tuple[str, ...], quiet: bool) -> int:
    if path.suffix.lower() in (".pdf", DETACHED) and not path.is_file():
        raise DataError("no such file", path, "name a file that `labpipe sign` wrote")
    faults: list[str] = []
    there: set[str] = set()
    for file in signed_files(path):
        listed = list(signatures(file, trust))
        for signature in listed:
            faults += [f"{signature.file}: {signature.text}: {fault}" for fault in signature.faults]
            if not signature.faults:
                there.add(signature.role)
            if not (signature.faults or quiet):
                echo(message_line(f"signed {signature.file}: {signature.text}"))
        other = drawn_from_another(file) if file.suffix.lower() == ".pdf" else ""
        faults += [f"{file}: {other}"] if listed and other else []
        faults += [] if listed else [f"{file}: carries no signature"]
    faults += [f"{path}: nobody has signed it as '{role}'" for role in needed if role not in there]
    for fault in faults:
        echo(message_line(f"FAILED {fault}"))
    return len(faults)


@dataclass(frozen=True)
class Manners:
    """The options of the command."""

    again: bool
    jobs: int
    overrides: tuple[str, ...]
    quiet: bool
    verbose: bool


def _verify_folder(here: Path, name: str, pipeline_path: Path | None, how: Manners) -> int:
    artefacts = list(verify_artefacts(here, None if pipeline_path is None else pipeline_path.parent))
    for artefact in artefacts:
        place = f"{name}/{artefact.path.relative_to(here).as_posix()}"
        for fault in artefact.faults:
            echo(f"FAILED {place}: {fault}")
        for remark in artefact.remarks:
            if how.verbose or remark == "carries no digest":
                echo(f"note   {place}: {remark}")
    faults = sum(bool(artefact.faults) for artefact in artefacts)
    if how.again and pipeline_path is not None:
        others = _rerun_differences(here, load_pipeline(pipeline_path, how.overrides), how.jobs)
        for line in others:
            echo(f"FAILED {line}".replace(str(here), name))
        faults += len(others)
    if not how.quiet:
        undigested = sum("carries no digest" in artefact.remarks for artefact in artefacts)
        inputs = sum(artefact.inputs for artefact in artefacts)
        missing = sum(len(artefact.remarks) for artefact in artefacts) - undigested
        echo(
            f"{len(artefacts)} artefacts: {faults} do not hold; {undigested} without a digest; "
            f"of the files that they name {inputs} are the same, {missing} are not there"
        )
    return 1 if faults else 0


def _verify_archive(path: Path, pipeline_path: Path | None, how: Manners) -> int:
    with tempfile.TemporaryDirectory(prefix="labpipe-archive-", ignore_cleanup_errors=True) as scratch:
        archive = unpack(path, Path(scratch))
        for name, fault in archive.faults:
            echo(message_line(f"FAILED {path}: {name}: {fault}"))
        if not how.quiet:
            echo(f"{archive.files} files: {len(archive.faults)} do not hold")
        if archive.faults:
            return 1
        try:
            hindrance = "" if how.again else archive.hindrance()
            named = pipeline_path or archive.pipeline
            how = replace(how, again=not hindrance)
            code = _verify_folder(archive.results, f"{path}: {RESULTS}", named, how)
        except LabpipeError as error:
            # What the metadata list is there and holds, and is no result with its pipeline for all that.
            for line in str(error).replace(f"{scratch}/", f"{path}: ").splitlines():
                echo(message_line(f"FAILED {line}"))
            return 1
        if not how.quiet:
            again = "run again: " + ("other bytes" if code else "the same bytes")
            echo(f"not run again: {hindrance}" if hindrance else again)
        return code


def _rerun_differences(folder: Path, pipeline: Pipeline, jobs: int) -> list[str]:
    with tempfile.TemporaryDirectory() as scratch:
        with output_folder(Path(scratch) / "out") as output:
            run(pipeline, output, manner(True, False, jobs, None))
        return differences(folder, Path(scratch) / "out")


# The password of a key, where nobody is there to type it.
SECRET = "LABPIPE_SIGN_PASSWORD"


@click.command()
@click.argument("file", type=options.PATH)
@options.path("--key", help="Your key and certificate as PKCS#12 (.p12, .pfx).")
@click.option(
    "--pkcs11", default="", metavar="LIBRARY", help="Library of a token or card, in place of --key."
)
@click.option("--token", default="", metavar="NAME", help="Label of the token.")
@click.option("--label", default="", metavar="NAME", help="Label of key and certificate on the token.")
@click.option(
    "--as", "role", type=click.Choice(ROLES), default=ROLES[0], show_default=True, help="What you did."
)
@click.option("--reason", default="", metavar="TEXT", help="What you vouch for, in words.")
@click.option(
    "--timestamp", default="", metavar="URL", help="Time-stamp server (RFC 3161) that proves the time."
)
@options.quiet
def sign(
    file: Path,
    key: Path | None,
    pkcs11: str,
    token: str,
    label: str,
    role: str,
    reason: str,
    timestamp: str,
    quiet: bool,
) -> None:
    """Sign FILE, a report as PDF or an archive, with your own certificate (X.509).

    A PDF is signed by PAdES in NAME.signed.pdf, and so on for further signers; any other file has a detached
    signature FILE.ROLE.p7s (CMS). The password is asked for, or taken from LABPIPE_SIGN_PASSWORD. Needs the
    extra: pip install 'labpipe[sign]'.

    \b
    labpipe sign out/report.pdf --key me.p12 --as measured
    labpipe sign evidence.zip --key me.p12 --as approved --reason "released"
    labpipe verify evidence.zip --trust laboratory-ca.pem
    """
    if (key is None) == (not pkcs11):
        raise ConfigError("sign: needs --key or --pkcs11, one of them", hint="labpipe sign FILE --key me.p12")
    if pkcs11 and not (token and label):
        raise ConfigError("--pkcs11: needs --token and --label as well")
    if key is not None:
        options.refuse_given(("token", "label"), "a token: name its library, --pkcs11 LIBRARY, not --key")
    secret = os.environ.get(SECRET)
    if secret is None:
        if not sys.stdin.isatty():
            raise ConfigError(f"the password is missing: nobody can be asked for it, and {SECRET} is not set")
        secret = click.prompt("Password", hide_input=True, err=True)
    used = Key(file=key, module=pkcs11, token=token, label=label, secret=secret)
    target = signed(file, used, role, reason, timestamp)
    if not quiet:
        echo(f"written: {target}, {role}")

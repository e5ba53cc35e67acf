"""labpipe sign: the signature of a person under a report or an archive."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.errors import ConfigError
from labpipe.project.signing import ROLES, Key
from labpipe.project.signing import sign as signed

# The password of a key, where nobody is there to type it.
SECRET = "LABPIPE_SIGN_PASSWORD"


@click.command()
@click.argument("file", type=options.PATH)
@click.option(
    "--key", type=options.PATH, metavar="FILE", help="Your key and certificate as PKCS#12 (.p12, .pfx)."
)
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
    secret = os.environ.get(SECRET)
    if secret is None:
        if not sys.stdin.isatty():
            raise ConfigError(f"the password is not known: nobody to ask, and no {SECRET} is set")
        secret = click.prompt("Password", hide_input=True, err=True)
    target = signed(
        file, Key(file=key, module=pkcs11, token=token, label=label, secret=secret), role, reason, timestamp
    )
    if not quiet:
        echo(f"written: {target}, {role}")

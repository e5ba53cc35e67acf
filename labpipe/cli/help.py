"""labpipe doctor and schema: what is installed, and what files may hold."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import platform
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import click

from labpipe.artefacts.header import version_text
from labpipe.artefacts.writing import output_file
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.project.schema import SCHEMAS

# Packages of one feature each, by the distribution's name: the module, and the feature with its installation.
OPTIONAL = {
    "openpyxl": ("openpyxl", "recordings in .xlsx: pip install 'labpipe[excel]'"),
    "asammdf": ("asammdf", "recordings in .mf4: pip install 'labpipe[mdf]'"),
    "distributed": ("distributed", "labpipe run --cluster: pip install 'labpipe[cluster]'"),
    "pyHanko": ("pyhanko", "signatures: pip install 'labpipe[sign]'"),
    "rich": ("rich", "the display of labpipe live: pip install 'labpipe[live]'"),
    "cryptography": ("cryptography", "signatures: pip install 'labpipe[sign]'"),
    "python-pkcs11": ("pkcs11", "signatures by tokens and cards: pip install 'labpipe[sign]'"),
    "scikit-learn": ("sklearn", "metamodels of journal coefficients: pip install 'labpipe[metamodels]'"),
}
MODULES = {"PyYAML": "yaml", "fpdf2": "fpdf", "npTDMS": "nptdms"}


@dataclass(frozen=True)
class Check:
    """One line of the report; *fault*: what is wrong, empty for none; *needed*: labpipe does not work without
    it.
    """

    what: str
    state: str
    fault: str = ""
    needed: bool = True


@click.command()
def doctor() -> int:
    """Show versions, threads, optional packages and faults of this installation.

    Exit code 2 when something required is missing.
    """
    checks = [*_machine(), *_packages(), _temporary_folder()]
    width = max(len(check.what) for check in checks)
    for check in checks:
        echo(f"{check.what:<{width}}  {check.state}" + (f"  <- {check.fault}" if check.fault else ""))
    broken = [check for check in checks if check.fault and check.needed]
    echo("all is well" if not broken else f"{len(broken)} fault(s) to correct")
    return 2 if broken else 0


def _machine() -> list[Check]:
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    threads = ", ".join(f"{name}={os.environ[name]}" for name in names if name in os.environ)
    encoding = sys.stdout.encoding or "unknown"
    unable = "" if "utf" in encoding.lower() else "set PYTHONIOENCODING=utf-8 for units such as µm"
    return [
        Check("labpipe", version_text()),
        Check("Python", f"{platform.python_version()} ({platform.system()} {platform.machine()})"),
        Check("processors", str(os.cpu_count())),
        Check("threads of linear algebra", threads),
        Check("terminal", encoding, unable, needed=False),
    ]


def _packages() -> list[Check]:
    try:
        requirements = importlib.metadata.requires("labpipe") or []
    except importlib.metadata.PackageNotFoundError:
        return [Check("installation", "labpipe runs from its source tree", "pip install . in the checkout")]
    required = [re.match(r"[\w.-]+", text) for text in requirements if "extra ==" not in text]
    names = [match[0] for match in required if match is not None]
    needed = [_package(name, MODULES.get(name, name), "", True) for name in names]
    return [*needed, *(_package(name, module, hint, False) for name, (module, hint) in OPTIONAL.items())]


def _package(name: str, module: str, hint: str, needed: bool) -> Check:
    try:
        importlib.import_module(module)
    except Exception as error:
        # A package built for another numpy, say, fails in its own way.
        return Check(name, "not installed", hint or f"pip install {name} ({error})", needed)
    return Check(name, importlib.metadata.version(name))


def _temporary_folder() -> Check:
    try:
        with tempfile.TemporaryFile() as stream:
            stream.write(b"labpipe")
    except OSError as error:
        return Check("temporary folder", tempfile.gettempdir(), os.strerror(error.errno or 0).lower())
    return Check("temporary folder", tempfile.gettempdir())


@click.command()
@click.argument("kind", type=click.Choice(list(SCHEMAS)), default="pipeline")
@options.path("-o", "--output", help="File to write; default: standard output.")
def schema(kind: str, output: Path | None) -> None:
    """Print the JSON schema of a pipeline, rig, bearing or plan file.

    Editors with support for YAML schemas complete and check a file that begins with the line
    `# yaml-language-server: $schema=pipeline.schema.json`.
    """
    text = json.dumps(SCHEMAS.load(kind)(), indent=2) + "\n"
    if output is None:
        echo(text, nl=False)
        return
    with output_file(output) as target:
        target.write_text(text, encoding="utf-8")

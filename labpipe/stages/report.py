"""report: identification -> a document people read and sign."""

from __future__ import annotations

from pathlib import Path

from labpipe.artefacts.writing import output_file
from labpipe.errors import ConfigError
from labpipe.records.identification import Identification
from labpipe.report.render import RENDERERS

SUFFIX_FORMATS = {".html": "html", ".htm": "html", ".md": "md", ".pdf": "pdf"}


def format_of(path: Path) -> str:
    """The report format that a file name asks for; ConfigError for an unknown ending."""
    suffix = path.suffix.lower()
    if path.exists() and not path.is_file():
        return "html"
    if suffix not in SUFFIX_FORMATS:
        raise ConfigError(f"no report format for the ending '{suffix}'", where=str(path), hint=f"known: {', '.join(SUFFIX_FORMATS)}")
    return SUFFIX_FORMATS[suffix]


def write_report(identification: Identification, path: Path, report_format: str = "") -> None:
    """Write the report of an identification; the format follows from the file's ending."""
    content: bytes = RENDERERS.load(report_format or format_of(path))(identification)
    with output_file(path) as target:
        target.write_bytes(content)

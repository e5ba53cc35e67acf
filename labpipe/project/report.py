"""report: identification, or several of them -> a document people read and sign, and its figures as files."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from labpipe.artefacts.header import code_digest
from labpipe.artefacts.identification_file import NAME
from labpipe.artefacts.json_file import DIGEST
from labpipe.artefacts.writing import OutputFolder, output_file, output_folder
from labpipe.errors import ConfigError, DataError
from labpipe.project.one_test import read_one_of_many
from labpipe.records.identification import Identification

# How a format writes what its readers pass over; a format of another package has no stamp and is always
# drawn.
COMMENTS = {"html": (b"<!-- ", b" -->\n"), "md": (b"<!-- ", b" -->\n"), "pdf": (b"% ", b"\n")}
LONGEST = 200
_RESULT = re.compile(rb'^"' + DIGEST.encode() + rb'": "([0-9a-f]{64})"', re.MULTILINE)
_STAMP = re.compile(rb"labpipe drew this from ([0-9a-f]{64}), content ([0-9a-f]{64})")


def drawn_from(result: Path, code: str = "") -> str:
    """The digest of a result and of the *code* that draws, by default this build's; '' where it has none."""
    with result.open("rb") as stream:
        match = _RESULT.search(stream.read(4096))
    return hashlib.sha256(match[1] + (code or code_digest()).encode()).hexdigest() if match else ""


def stamp(content: bytes, source: str, report_format: str) -> bytes:
    """A report with its last line; as it is without a *source*, or in a format without comments."""
    if not source or report_format not in COMMENTS:
        return content
    begin, end = COMMENTS[report_format]
    content = content if content.endswith(b"\n") else content + b"\n"
    digest = hashlib.sha256(content).hexdigest()
    return content + begin + f"labpipe drew this from {source}, content {digest}".encode() + end


def stamped_source(content: bytes) -> str:
    """What a report was drawn from as its last line says, also where signatures follow; empty without one."""
    match = _STAMP.search(content)
    return match[1].decode() if match else ""


def is_drawn(path: Path, source: str) -> bool:
    """Whether a report was drawn from this source and is whole: neither edited nor damaged since."""
    if not source or not path.is_file():
        return False
    content = path.read_bytes()
    matches = list(_STAMP.finditer(content, max(len(content) - LONGEST, 0)))
    if not matches or matches[-1][1].decode() != source:
        return False
    start = content.rfind(b"\n", 0, matches[-1].start()) + 1
    line = content[start : matches[-1].start()], content[matches[-1].end() :]
    digest = hashlib.sha256(content[:start]).hexdigest()
    return line in COMMENTS.values() and digest == matches[-1][2].decode()


SUFFIX_FORMATS = {".html": "html", ".htm": "html", ".md": "md", ".pdf": "pdf"}


def format_of(path: Path) -> str:
    """The report format that a file name asks for; ConfigError for an unknown ending."""
    suffix = path.suffix.lower()
    if path.exists() and not path.is_file():
        return "html"
    if suffix not in SUFFIX_FORMATS:
        hint = f"known: {', '.join(SUFFIX_FORMATS)}"
        raise ConfigError(f"no report format for the ending '{suffix}'", path, hint)
    return SUFFIX_FORMATS[suffix]


def write_report(identification: Identification, path: Path, figures: Path | None, result: Path) -> None:
    """Write the report of an identification; the format follows from the ending. *figures*: a folder for them
    as files. *result*: its file, which the report names, so that it can be signed and archived beside it.
    """
    name = format_of(path)
    files = {} if figures is None else _figures_of(identification, result.parent)
    content = stamp(_draw(identification, result.parent, name), drawn_from(result), name)
    _write(content, path, files, figures)


def write_test_report(
    identification: Identification, test: str, path: Path, figures: Path | None, results: Path
) -> None:
    """Write the pages of one test. ConfigError for an unknown test. *results*: the result's folder."""
    from labpipe.report.build import build

    if identification.dataset is not None:
        identification = read_one_of_many(identification, results, test)
    write_document(build(identification, test), path, figures)


def write_document(document: Any, path: Path, figures: Path | None = None) -> None:
    """Write a document in the format that the ending asks for; *figures*: a folder for them as files."""
    from labpipe.document.charts import figure_files

    content = renderer_of("DOCUMENTS", format_of(path))(document)
    _write(content, path, {} if figures is None else figure_files(document), figures)


def outdate_reports(folder: OutputFolder, formats: Sequence[str]) -> None:
    """Reports of an earlier result go where a new one is about to take its place, whatever their format; what
    was edited or signed since stays until it is drawn anew.
    """
    if not (folder.staging / NAME).exists():
        return
    for name in {*formats, *COMMENTS}:
        path = folder.target / f"report.{name}"
        if name in formats or (path.is_file() and is_drawn(path, stamped_source(path.read_bytes()))):
            folder.outdate(path.name)


def write_reports(
    identification: Identification, target: Path, formats: Sequence[str], tell: Callable[[str], None]
) -> None:
    """Draw the reports of a result into its folder but those drawn from this very result, and whole."""
    source = drawn_from(target / NAME)
    stale = [name for name in formats if not is_drawn(target / f"report.{name}", source)]
    if not stale:
        return
    with output_folder(target) as folder:
        for name in stale:
            tell(f"report    report.{name}")
            content = stamp(_draw(identification, target, name), source, name)
            folder.write_path(f"report.{name}").write_bytes(content)


def _draw(identification: Identification, folder: Path, report_format: str) -> bytes:
    if identification.dataset is None:
        return renderer_of("RENDERERS", report_format)(identification)
    return renderer_of("DOCUMENTS", report_format)(_summary(identification, folder))


def _summary(identification: Identification, folder: Path) -> Any:
    """The document of many tests; what draws and what reads tables takes its time to load."""
    from labpipe.artefacts.dataset_file import read_many_tests
    from labpipe.report.many_tests import many_tests_document

    return many_tests_document(identification, read_many_tests(folder))


def renderer_of(table: str, report_format: str) -> Callable[[Any], bytes]:
    """A renderer of a format; what draws takes its time to load."""
    from labpipe.document import render

    renderer: Callable[[Any], bytes] = getattr(render, table).load(report_format)
    return renderer


def write_campaign(
    results: Sequence[tuple[str, Identification]], path: Path, figures: Path | None = None
) -> None:
    """Write the report of many results (name, identification): trends, control limits, differences."""
    from labpipe.report.campaign import campaign_document

    write_document(campaign_document(results), path, figures)


def _figures_of(identification: Identification, folder: Path) -> dict[str, bytes]:
    from labpipe.document.charts import figure_files
    from labpipe.report.build import build

    whole = identification.dataset is None
    return figure_files(build(identification) if whole else _summary(identification, folder))


def _figures_before(folder: Path) -> Iterator[str]:
    from labpipe.document.charts import PROLOGUE

    for path in folder.glob("figure-[0-9][0-9]*.svg"):
        if path.read_bytes().startswith(PROLOGUE.encode()):
            yield from (path.with_suffix(ending).name for ending in (".svg", ".png", ".csv"))


def _write(content: bytes, path: Path, files: dict[str, bytes], figures: Path | None) -> None:
    if figures is not None and figures.exists() and not figures.is_dir():
        raise DataError("is a file, a folder is needed", figures)
    with ExitStack() as outputs:
        outputs.enter_context(output_file(path)).write_bytes(content)
        if figures is not None:
            folder = outputs.enter_context(output_folder(figures))
            for name in _figures_before(figures):
                folder.outdate(name)
            for name, part in files.items():
                folder.write_path(name).write_bytes(part)

"""The project's own papers say what is there: versions, schemas, commands."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from labpipe import __version__
from labpipe.artefacts import dataset_file, header, identification_file, identification_file as fits_file

ROOT = Path(__file__).parent.parent.parent


def text_of(name: str) -> str:
    return (ROOT / name).read_text("utf-8")


def test_the_newest_entry_of_the_changes_is_this_version() -> None:
    found = re.search(r"^## (\S+)", text_of("CHANGELOG.md"), re.MULTILINE)
    assert found is not None and found[1] == __version__


def test_the_citation_is_of_this_version_and_names_no_person() -> None:
    """Keys that the Citation File Format 1.2.0 requires.

    An entity has a name, a person family and given names.
    """
    citation = yaml.safe_load(text_of("CITATION.cff"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert (citation["cff-version"], citation["version"]) == ("1.2.0", __version__)
    assert all(set(author) == {"name"} for author in citation["authors"])


def test_the_page_on_versions_names_every_schema() -> None:
    page = text_of("docs/pages/versions.md")
    schemas = {*identification_file.READ_SCHEMAS, dataset_file.SCHEMA, fits_file.SCHEMA}
    assert set(re.findall(r"`(labpipe/[a-z]+/\d+)`", page)) == schemas
    assert f"header {header.SCHEMA} |" in page


def test_contributors_are_told_what_ci_runs() -> None:
    """Every tool that `.ci/run` calls stands in CONTRIBUTING.md, and the files it points to are there."""
    paper, ci = text_of("CONTRIBUTING.md"), text_of(".ci/run")
    tools = set(re.findall(r'"\$bin/([\w-]+)"', ci)) - {"pip", "python", "labpipe"}
    assert tools and all(tool in paper for tool in tools)
    assert all((ROOT / link).is_file() for link in re.findall(r"\]\(([^)]+)\)", paper))
    packages = {path.parent.name for path in (ROOT / "labpipe").glob("*/__init__.py")}
    assert packages - set(re.findall(r"[a-z_]+", paper)) == set()


def test_the_glossary_names_findings_and_comparisons_that_there_are() -> None:
    from labpipe.uncertainty.settings import COMPARISONS

    page = text_of("docs/pages/glossary.md")
    codes = set(yaml.safe_load(text_of("labpipe/records/warnings.yaml")))
    assert set(re.findall(r"finding `([\w-]+)`", page)) <= codes
    assert set(re.findall(r"comparison `([\w-]+)`", page)) <= set(COMPARISONS)

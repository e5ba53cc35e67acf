"""The documentation is built whole, with its figures: a caption or a page that changed cannot break it
unseen; its pages are linked, can be searched and fetch nothing.
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from labpipe.artefacts.identification_file import read_identification
from labpipe.document.render import html_report

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))

import build  # noqa: E402 (modules of docs, which is not a package)
import reference  # noqa: E402

LARGEST_REPORT = 3_000_000
pytestmark = pytest.mark.long

# Opens the search and puts words into its field.
TYPE = """(() => {
  document.querySelector("#__search").checked || document.querySelector("label[for=__search]").click();
  const field = document.querySelector("[data-md-component=search-query]");
  field.focus();
  field.value = "%s";
  field.dispatchEvent(new Event("keyup", { bubbles: true }));
})()"""


@pytest.fixture(scope="module")
def site() -> Path:
    """The site as `python docs/build.py` builds it."""
    built = subprocess.run(
        [sys.executable, "docs/build.py"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=600
    )
    assert built.returncode == 0, built.stdout[-2000:] + built.stderr[-2000:]
    return DOCS / "site"


def test_every_figure_is_drawn_and_no_report_is_too_large_for_a_letter(site: Path) -> None:
    asked = {
        figure
        for page in (DOCS / "pages").rglob("*.md")
        for figure in re.findall(r"^\{\{ figure .+ \}\}$", page.read_text(), re.M)
    }
    assert len(list((site / "figures").glob("*.svg"))) >= len(asked) > 20
    for result in sorted((ROOT / "out/docs/runs").glob("*/identification.json")):
        assert len(html_report(read_identification(result))) < LARGEST_REPORT, result.parent.name


def test_all_pages_are_built_and_linked(site: Path) -> None:
    """mkdocs --strict ends with an error at a link or heading that is not there, and at a page that no menu
    names.
    """
    built = {path.relative_to(site).with_suffix("").as_posix() for path in site.rglob("*.html")} - {"404"}
    written = {
        path.relative_to(DOCS / "pages").with_suffix("").as_posix() for path in (DOCS / "pages").rglob("*.md")
    }
    packages = {path.parent.name for path in (ROOT / "labpipe").glob("*/__init__.py")}
    python = {f"reference/python/{name}" for name in packages | {"index", "scripts", "labpipe"}}
    papers = {page.removesuffix(".md") for page in build.PAPERS}
    assert built == written | python | papers | {f"reference/{name}" for name in reference.reference_pages()}


def test_the_search_of_a_page_opened_as_a_file_finds_and_fetches_nothing(site: Path) -> None:
    """Typed into a headless browser: a page and the entry of a function, found in the index that lies beside
    the pages.
    """
    spec = importlib.util.spec_from_file_location(
        "labpipe_browser", Path(__file__).parents[1] / "browser/browser.py"
    )
    assert spec is not None and spec.loader is not None
    driver = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(driver)
    path = driver.binary()
    if path is None or os.name != "posix":
        pytest.skip("no browser found on the path")
    browser = driver.Browser(path)
    try:
        page = browser.open(site / "index.html")
        for words, there in {
            "crest factor": "recordings.html",
            "adjusted_forces_as_instruments": "spectra.html",
        }.items():
            page.run(TYPE % words)
            found = "[...document.querySelectorAll('.md-search-result__item a')].map((link) => link.href)"
            page.until(lambda there=there, found=found: any(there in link for link in page.run(found)))
        asked = {event["request"]["url"] for event in page.said("Network.requestWillBeSent")}
        assert not [address for address in asked if not address.startswith(("file:", "data:"))]
        assert not page.said("Runtime.exceptionThrown")
    finally:
        browser.close()


def test_the_pages_fetch_nothing_from_elsewhere(site: Path) -> None:
    fetching = re.compile(
        r"<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)=[\"']?((?:https?:)?//[^\"'> ]+)"
    )
    for path in site.rglob("*.html"):
        assert not fetching.findall(path.read_text(encoding="utf-8")), path
    for path in site.rglob("*.css"):
        assert not re.findall(
            r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", path.read_text(encoding="utf-8")
        ), path

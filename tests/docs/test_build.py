"""The documentation is built whole, with its figures: a caption or a page that changed cannot break it
unseen.
"""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from labpipe.artefacts.identification_file import read_identification
from labpipe.document.render import html_report

ROOT = Path(__file__).parents[2]
LARGEST_REPORT = 3_000_000


class _Fetched(HTMLParser):
    """What a page fetches: sources of scripts, images and style sheets."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        wanted = {"script": "src", "img": "src", "link": "href"}.get(tag)
        self.addresses.extend(value for name, value in attrs if name == wanted and value)


@pytest.mark.long
def test_the_site_is_built_with_every_figure_and_fetches_nothing() -> None:
    built = subprocess.run(
        [sys.executable, "docs/build.py"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=600
    )
    assert built.returncode == 0, built.stdout[-2000:] + built.stderr[-2000:]
    site = ROOT / "docs/site"
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 50
    asked = {
        figure
        for page in (ROOT / "docs/pages").rglob("*.md")
        for figure in re.findall(r"^\{\{ figure .+ \}\}$", page.read_text(), re.M)
    }
    assert len(list((site / "figures").glob("*.svg"))) >= len(asked) > 20
    for page in pages:
        fetched = _Fetched()
        fetched.feed(page.read_text(encoding="utf-8"))
        assert not [
            address for address in fetched.addresses if address.startswith(("http:", "https:", "//"))
        ], page
    # The reports of the same results can be mailed and open at once.
    for result in sorted((ROOT / "out/docs/runs").glob("*/identification.json")):
        assert len(html_report(read_identification(result))) < LARGEST_REPORT, result.parent.name

"""What is not tested, from `gaps.yaml`."""

from __future__ import annotations

from pathlib import Path

import yaml

from tests.validation.claims import Claim, untested

FILE = Path(__file__).parent / "gaps.yaml"


def gaps(page: str) -> list[Claim]:
    """The gaps of a page of the manual."""
    entries = yaml.safe_load(FILE.read_text(encoding="utf-8"))[page]
    return [untested(entry["what"], entry["kind"], entry["source"], entry["why"]) for entry in entries]

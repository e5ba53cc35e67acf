"""Pipelines and rig files that the page on measurements by others shows: run from there, so that what is
shown is what was run.
"""

from __future__ import annotations

import re

from tests.validation.page import WORDS

TEXT = (WORDS / "measured.md").read_text(encoding="utf-8")
BLOCKS: list[str] = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)
# A rig file names itself in a comment of its first line.
RIGS: dict[str, str] = {
    re.search(r"# (\S+\.yaml)", block.splitlines()[0]).group(1): block  # type: ignore[union-attr]
    for block in re.findall(r"```text\n(.*?)```", TEXT, re.DOTALL)
}

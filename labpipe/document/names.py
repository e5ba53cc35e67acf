"""Captions as names of files."""

from __future__ import annotations

import re

MOST_LETTERS = 48


def short_name(caption: str) -> str:
    """A caption as part of a file's name: its first words in small letters."""
    plain = re.sub(r"[^a-z0-9]+", "-", caption.lower()).strip("-")
    return plain[:MOST_LETTERS].rpartition("-")[0] if len(plain) > MOST_LETTERS else plain

"""The files that pages and drawings are made of: style and script."""

from __future__ import annotations

from functools import cache
from importlib.resources import files


@cache
def page_part(name: str) -> str:
    """A file of the page: its style, that of its drawings, or a part of its script."""
    return files("labpipe.document").joinpath("page", name).read_text(encoding="utf-8")

"""The modules of labpipe and their syntax trees, which several tests look through: all are parsed once."""

from __future__ import annotations

import ast
import functools
import gc
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "labpipe"
MODULES = tuple(sorted(PACKAGE.rglob("*.py")))


# Parsed when the first test asks, not when tests are collected.
@functools.cache
def _trees() -> dict[Path, ast.Module]:
    # Nearly a million nodes: searches for garbage among them would take three times as long as to make them.
    gc.disable()
    try:
        return {path: ast.parse(path.read_text(encoding="utf-8")) for path in MODULES}
    finally:
        gc.freeze()
        gc.enable()


def tree_of(path: Path) -> ast.Module:
    """The syntax tree of a module."""
    return _trees()[path]


@functools.cache
def nodes(tree: ast.Module) -> tuple[ast.AST, ...]:
    """All nodes of a tree."""
    return tuple(ast.walk(tree))

"""The Python reference holds every public name of labpipe, with its signature, and shapes and units where
arrays come and go.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import pytest

import tests.test_docstrings as rules
from tests.source import MODULES, PACKAGE, tree_of

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))

import api  # noqa: E402 (a module of docs, which is not a package)
import maths  # noqa: E402


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    folder = ROOT / "docs/pages"
    texts = {
        path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8") for path in folder.rglob("*.md")
    }
    return api.api_pages(api.modules(tree_of), maths.labels_of(texts))


@pytest.fixture(scope="module")
def entries(pages: dict[str, str]) -> dict[str, str]:
    """Dotted name -> what its entry says, without tags."""
    parts = [
        re.split(r"^#+ .* \{: #([\w.]+).*\}$", text, flags=re.MULTILINE)
        for page, text in pages.items()
        if "scripts" not in page
    ]
    return {
        name: unescape(re.sub(r"<[^>]+>", " ", text))
        for part in parts
        for name, text in zip(part[1::2], part[2::2], strict=True)
    }


def public_names() -> Iterator[str]:
    """Modules, functions, classes, their methods and values with names in the source, found without the
    generator.
    """
    for path in MODULES:
        parts = path.relative_to(ROOT).with_suffix("").parts
        if any(part.startswith("_") and part != "__init__" for part in parts):
            continue
        module = ".".join(part for part in parts if part != "__init__")
        yield module
        for node in tree_of(path).body:
            for name in defined(node):
                yield f"{module}.{name}"


def defined(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, (ast.Assign, ast.AnnAssign)):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        yield from (target.id for target in targets if isinstance(target, ast.Name) and target.id[0] != "_")
    elif isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name[0] != "_":
        yield node.name
        methods = (
            (one for one in node.body if isinstance(one, ast.FunctionDef))
            if isinstance(node, ast.ClassDef)
            else ()
        )
        yield from (f"{node.name}.{one.name}" for one in methods if one.name[0] != "_")


def test_every_public_name_has_an_entry(entries: dict[str, str]) -> None:
    names = set(public_names())
    assert len(names) > 3000
    assert names == set(entries)


def test_entries_of_functions_and_records_of_arrays_state_shapes_and_units(entries: dict[str, str]) -> None:
    checked = 0
    for module in rules.covered_modules():
        prefix = "labpipe." + module.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        for member in rules.public_members(tree_of(PACKAGE / module), prefix):
            text = " ".join(entries[member.place.replace(":", ".")].split())
            assert rules.SHAPE.search(text) and (rules.UNIT.search(text) or not member.numeric), member.place
            checked += 1
    assert checked > 500


def test_an_entry_shows_the_signature_with_marks_and_defaults() -> None:
    source = (
        "# How many.\nCOUNT = 3\n\ndef f(a, /, b: int = 2, *rest: str, c=None, **more) -> int:\n"
        '    """Sums *a*.\n\n    Example::\n\n        f(1)\n\n        f(2)\n    """\n\n'
        "class C(Base):\n    x: float = setting('value', 'mass', unit='kg', default=1.0)\n    _y: int = 0\n\n"
        "    @property\n    def p(self) -> int:\n        ...\n\n    @classmethod\n    def m(cls, *, k: int) "
        "-> C:\n        ...\n"
    )
    module = api.module_of("labpipe/estimation/example.py", source)
    signatures = {
        one.path.removeprefix("labpipe.estimation.example."): one.signature
        for name in module.names
        for one in name.all
    }
    assert signatures == {
        "COUNT": "COUNT = 3",
        "f": "f(a, /, b: int = 2, *rest: str, c=None, **more) -> int",
        "C": "class C(Base)\n    x: float = 1.0  # mass [kg]",
        "C.p": "p: int",
        "C.m": "m(*, k: int) -> C",
    }
    page = api.Entries({}).module(module)
    assert "How many." in page
    assert "<p>Sums <em>a</em>.</p><p>Example:</p><pre><code>f(1)&#10;&#10;f(2)</code></pre>" in page


def test_the_overview_names_every_package_and_what_it_is(pages: dict[str, str]) -> None:
    overview = pages["reference/python/index.md"]
    packages = {path.parent.name for path in (ROOT / "labpipe").glob("*/__init__.py")}
    rows = re.findall(r"^\| \d+ \| \[`labpipe\.(\w+)`\]\(\w+\.md[^|]*\| (.+) \|$", overview, re.MULTILINE)
    assert packages <= {name for name, words in rows if words.strip()}


def test_names_for_scripts_are_those_of_the_package_itself(pages: dict[str, str]) -> None:
    import labpipe

    shown = re.findall(r"^## labpipe\.(\w+) ", pages["reference/python/scripts.md"], re.MULTILINE)
    assert shown == [name for name in labpipe.__all__ if not name.startswith("_")]

"""The theory manual: its equations and the functions that compute them name each other, and its formulas can
be drawn.

A directive `{{ equation LABEL | NAME, ... }}` above a formula says what computes it; the docstring of NAME
says `Equation (LABEL)`.
"""

from __future__ import annotations

import ast
import importlib
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.source import MODULES, tree_of

ROOT = Path(__file__).parents[2]
PAGES = {
    path.stem: path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs/pages/theory").glob("*.md"))
}
DIRECTIVE = re.compile(r"^\{\{ equation (.+?) \| (.+?) \}\}\n(.*)$", re.MULTILINE)
LABEL = r"[a-z]+(?:-[a-z0-9]+)+"
CITATION = re.compile(rf"\bEquations?\s+(\({LABEL}\)(?:(?:,|\s+and)\s+\({LABEL}\))*)")
# Pages without methods of their own.
WITHOUT_SOURCES = {"index", "nomenclature"}
# What reports say in words is computed elsewhere.
WITHOUT_EQUATIONS = {"labpipe.report"}


def directives() -> list[tuple[str, str, list[str], str]]:
    """(page, label, names, the line below) of all directives."""
    found = [(page, entry) for page, text in PAGES.items() for entry in DIRECTIVE.findall(text)]
    return [
        (page, label, [name.strip() for name in names.split(",")], below)
        for page, (label, names, below) in found
    ]


def documented(tree: ast.AST, above: str) -> Iterator[tuple[str, str]]:
    """(dotted name, docstring) of every class and function of a module."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            name = f"{above}.{node.name}"
            yield name, ast.get_docstring(node) or ""
            yield from documented(node, name)


def cited() -> set[tuple[str, str]]:
    """(label, dotted name) of all equations that docstrings name."""
    pairs = set()
    for path in MODULES:
        text = path.read_text(encoding="utf-8")
        if CITATION.search(text):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            for name, docstring in documented(tree_of(path), module):
                pairs |= {
                    (label, name) for run in CITATION.findall(docstring) for label in re.findall(LABEL, run)
                }
    return pairs


def test_every_directive_stands_above_a_formula_and_has_a_plain_label() -> None:
    assert len(directives()) == sum(text.count("{{") for text in PAGES.values())
    assert [entry for entry in directives() if entry[3] != "$$" or not re.fullmatch(LABEL, entry[1])] == []


def test_labels_are_unique_and_begin_as_on_no_other_page() -> None:
    counts = Counter(label for _, label, _, _ in directives())
    assert [label for label, count in counts.items() if count > 1] == []
    pages = {(label.partition("-")[0], page) for page, label, _, _ in directives()}
    starts = Counter(start for start, _ in pages)
    assert [start for start, count in starts.items() if count > 1] == []


def test_equations_and_docstrings_name_each_other() -> None:
    """Both ways: a function of the manual that does not name its equation, and a label in a docstring that
    the manual has not.
    """
    manual = {(label, name) for _, label, names, _ in directives() for name in names}
    assert manual - cited() == set()
    assert cited() - manual == set()
    assert not [name for _, name in manual if any(part.startswith("_") for part in name.split("."))]


def test_the_names_of_equations_can_be_imported() -> None:
    for name in sorted({name for _, _, names, _ in directives() for name in names}):
        parts = name.split(".")
        depth = max(n for n in range(1, len(parts)) if ROOT.joinpath(*parts[:n]).with_suffix(".py").exists())
        thing = importlib.import_module(".".join(parts[:depth]))
        for part in parts[depth:]:
            thing = getattr(thing, part)
        assert thing.__doc__, name


def test_every_numerical_package_has_equations() -> None:
    """The packages that import no files and no screens, as the rule of imports lists them."""
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    numerical = next(
        set(rule["source_modules"])
        for rule in rules
        if rule["type"] == "forbidden" and "labpipe.spectra" in rule["source_modules"]
    )
    with_equations = {".".join(name.split(".")[:2]) for _, _, names, _ in directives() for name in names}
    assert numerical - with_equations == WITHOUT_EQUATIONS
    assert len(directives()) > 300


@pytest.mark.parametrize("page", PAGES)
def test_formulas_can_be_drawn(page: str) -> None:
    """As the site draws them, which stops at a command that MathML has not."""
    pytest.importorskip("math_core")
    sys.path.insert(0, str(ROOT / "docs"))
    import maths

    tokens = [token for _, block in maths.paragraphs(PAGES[page]) for token in maths.TOKEN.finditer(block)]
    assert not [token[0] for token in tokens if token["wrong"]]
    for token in tokens:
        if token["block"] or token["within"]:
            assert "\n" not in (token["within"] or "")
            assert maths.mathml(
                token["block"] or token["within"], display=token["block"] is not None
            ).startswith("<math")


def test_the_overview_links_to_every_chapter_and_chapters_name_their_sources() -> None:
    linked = set(re.findall(r"\]\(([a-z-]+)\.md\)", PAGES["index"]))
    assert linked == PAGES.keys() - {"index"}
    assert [page for page, text in PAGES.items() if "\n## Sources\n" not in text] == sorted(WITHOUT_SOURCES)


def test_the_names_of_the_nomenclature_are_read_or_written() -> None:
    """The words in the last column stand in the source; numbers and dofs within a name belong to the fit."""
    source = "\n".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "labpipe").rglob("*.py")))
    words = set(re.findall(r"[A-Za-z_]\w*", source))
    rows = [line.split("|") for line in PAGES["nomenclature"].splitlines() if line.startswith("|")]
    names = {
        name
        for row in rows
        if len(row) == 6
        for quoted in re.findall(r"`([^`]+)`", row[4])
        for name in re.findall(r"[a-z]\w+", quoted)
    }
    assert names
    assert [
        name
        for name in sorted(names)
        if re.sub(r"(_[a-z]{1,2}|_\d+)+$", "", name) not in words and name not in words
    ] == []

"""Public functions and records of arrays state shapes, as (n_line, n_channel), and units, as [N/m], in their
docstrings.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import labpipe
from tests.source import tree_of

ROOT = Path(labpipe.__file__).parent

NUMERIC = {"FloatArray", "ComplexArray", "NDArray"}
ARRAYS = {*NUMERIC, "IntArray", "BoolArray"}
# One axis: 3, n, z, n_line, 2 n, n_input + n_output, n_output or 1.
AXIS = r"(?:\d+ )?(?:\d+|[nmkz]|n_\w+|\.\.\.)(?: (?:or|[-+*/]) (?:\d+|n|n_\w+))*"
SHAPE = re.compile(rf"\({AXIS},(?: {AXIS}(?:, {AXIS})*,?)?\)|\(\.\.\.\)|\b(?:same|any) shape\b")
# [N/m], [m, rad], [1], [-]; neither a list as [f, b] nor a matrix as [[1, 1], [-j, j]].
ITEM = r"[^\[\],;]*\b(?:kg|m|s|N|Pa|rad|deg|rpm|Hz|V|A|Wb|T|J|SI|\w*units?)\b[^\[\],;]*"
UNIT = re.compile(rf"\[(?:{ITEM}(?:, {ITEM})*|1|-|lines|samples?[^\[\]]*)\]")


@dataclass(frozen=True)
class Documented:
    """A public function, method or record with arrays: its place, its docstring, and whether any array holds
    real or complex numbers.
    """

    place: str
    text: str
    numeric: bool

    @property
    def gaps(self) -> list[str]:
        text = " ".join(self.text.split())
        unit = [] if UNIT.search(text) or not self.numeric else ["unit"]
        return ([] if SHAPE.search(text) else ["shape"]) + unit


def array_names(annotations: list[ast.expr | None]) -> set[str]:
    return {
        node.id for a in annotations if a is not None for node in ast.walk(a) if isinstance(node, ast.Name)
    } & ARRAYS


def annotations_of(node: ast.FunctionDef) -> list[ast.expr | None]:
    arguments = node.args
    return [
        node.returns,
        *(a.annotation for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)),
    ]


def documented(place: str, node: ast.FunctionDef | ast.ClassDef, names: set[str]) -> Iterator[Documented]:
    if names:
        yield Documented(f"{place}:{node.name}", ast.get_docstring(node) or "", bool(names & NUMERIC))


def public_members(tree: ast.Module, module: str) -> Iterator[Documented]:
    """Public functions; public classes with array fields; their public methods and properties."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield from documented(module, node, array_names(annotations_of(node)))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            fields = [statement.annotation for statement in node.body if isinstance(statement, ast.AnnAssign)]
            yield from documented(module, node, array_names(fields))
            for method in node.body:
                if isinstance(method, ast.FunctionDef) and not method.name.startswith("_"):
                    yield from documented(
                        f"{module}:{node.name}", method, array_names(annotations_of(method))
                    )


def covered_modules() -> list[str]:
    return sorted(path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.py"))


def members_of(source: str) -> dict[str, list[str]]:
    return {member.place: member.gaps for member in public_members(ast.parse(source), "m")}


def test_docstrings_state_shapes_and_units() -> None:
    members = [
        member for module in covered_modules() for member in public_members(tree_of(ROOT / module), module)
    ]
    assert len(members) > 1000
    assert {member.place: member.gaps for member in members if member.gaps} == {}


def test_missing_docstring_lacks_both() -> None:
    assert members_of("def f(x: FloatArray) -> float: ...") == {"m:f": ["shape", "unit"]}


def test_shape_without_unit_and_unit_without_shape() -> None:
    source = (
        'def f(x: FloatArray):\n    """Of (n_line,)."""\ndef g() -> ComplexArray:\n    """Stiffness [N/m]."""'
    )
    assert members_of(source) == {"m:f": ["unit"], "m:g": ["shape"]}


@pytest.mark.parametrize(
    "shape",
    [
        "(n,)",
        "(n_line, n_channel)",
        "(2 n,)",
        "(n, 2, 2)",
        "(n_line, n_output or 1, n)",
        "(..., n, n)",
        "the same shape",
    ],
)
def test_shapes_count(shape: str) -> None:
    assert members_of(f'def f(x: FloatArray):\n    """Of {shape} [m]."""') == {"m:f": []}


@pytest.mark.parametrize("text", ["(not, so)", "(n)", "f(x, y)", "(1993)", "(x, y)"])
def test_other_brackets_are_no_shapes(text: str) -> None:
    assert members_of(f'def f(x: FloatArray):\n    """Of {text} [m]."""') == {"m:f": ["shape"]}


@pytest.mark.parametrize("text", ["[f, b]", "[[1, 1], [-j, j]]", "[u; y]", "[x, y]", "[output, input]"])
def test_lists_and_matrices_are_no_units(text: str) -> None:
    assert members_of(f'def f(x: FloatArray):\n    """Of (n,), {text}."""') == {"m:f": ["unit"]}


@pytest.mark.parametrize(
    "unit", ["[N/m]", "[m, rad]", "[1]", "[-]", "[SI]", "[unit^2/Hz]", "[any unit]", "[(N/m)^2]", "[1/s^n]"]
)
def test_units_count(unit: str) -> None:
    assert members_of(f'def f(x: FloatArray):\n    """Of (n,) {unit}."""') == {"m:f": []}


def test_choice_of_lines_needs_no_unit() -> None:
    assert members_of('def f(x: BoolArray) -> IntArray:\n    """Of (n,)."""') == {"m:f": []}


def test_private_functions_and_functions_without_arrays_are_passed_over() -> None:
    assert (
        members_of(
            "def _f(x: FloatArray): ...\ndef g(x: float): ...\nclass _C:\n    def h(self) -> FloatArray: ..."
        )
        == {}
    )


def test_records_and_properties_count() -> None:
    source = "class C:\n    x: FloatArray\n    n: int\n    @property\n    def y(self) -> FloatArray: ..."
    assert set(members_of(source)) == {"m:C", "m:C:y"}

"""The tests, tested: one change of the code at a time, which a test must notice.

python -m tests.mutants.run [--count N] [--seed S] [--modules labpipe/stages/judging.py ...]

A mutant is made in a copy of the checkout; the tests of its package run on it, then, when all of them pass, the whole short suite with
--whole. Prints every survivor with its place; a survivor is a missing test, or a change without effect.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PACKAGES = (
    "artefacts",
    "stages",
    "signals",
    "spectra",
    "identify",
    "decay",
    "modal",
    "dynamic_stiffness",
    "bearings",
    "rotors",
    "campaign",
)
SECONDS = 300
# Tests beside those of a module's own package.
ALSO = {
    "artefacts": ("tests/cli/test_verify.py", "tests/unit/pipeline/test_freshness.py"),
    "stages": ("tests/unit/pipeline/test_run.py", "tests/cli/test_commands.py"),
    "signals": ("tests/unit/stages", "tests/cli/test_broken_inputs.py"),
}
_COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.In: ast.NotIn}
_COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr}


def changes(tree: ast.Module) -> Iterator[tuple[ast.AST, str]]:
    """Nodes that can be changed, with what is done to them."""
    constants = {id(child) for node in ast.walk(tree) if isinstance(node, (ast.JoinedStr, ast.AnnAssign)) for child in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare) and type(node.ops[0]) in _COMPARED:
            yield node, "comparison"
        elif isinstance(node, ast.BinOp) and type(node.op) in _COMPUTED:
            yield node, "operator"
        elif isinstance(node, ast.BoolOp):
            yield node, "and/or"
        elif isinstance(node, (ast.If, ast.IfExp)):
            yield node, "condition"
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float) and id(node) not in constants:
            yield node, "number"
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub)):
            yield node, "sign"


def change(node: ast.AST, what: str) -> None:
    """Change a node in place."""
    if what == "comparison":
        node.ops[0] = _COMPARED[type(node.ops[0])]()  # type: ignore[attr-defined]
    elif what == "operator":
        node.op = _COMPUTED[type(node.op)]()  # type: ignore[attr-defined]
    elif what == "and/or":
        node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()  # type: ignore[attr-defined]
    elif what == "condition":
        node.test = ast.UnaryOp(ast.Not(), node.test)  # type: ignore[attr-defined]
    elif what == "number":
        node.value = node.value + 1 if node.value in (0, 1) else node.value * 2  # type: ignore[attr-defined]
    else:
        node.op = ast.UAdd() if isinstance(node.op, ast.USub) else ast.Not()  # type: ignore[attr-defined]
        if isinstance(node.op, ast.Not):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)  # type: ignore[attr-defined]


def mutant(source: str, rng: random.Random) -> tuple[str, str] | None:
    """The source with one change, and its place in words; None for a module without anything to change."""
    tree = ast.parse(source)
    places = list(changes(tree))
    if not places:
        return None
    node, what = rng.choice(places)
    before = ast.unparse(node).splitlines()[0]
    change(node, what)
    ast.fix_missing_locations(tree)
    line = getattr(node, "lineno", 0)
    return ast.unparse(tree), f"{line}: {what}: {before[:80]} -> {ast.unparse(node).splitlines()[0][:80]}"


def tests_of(module: str) -> list[str]:
    """The tests that look at a module most closely."""
    package, stem = Path(module).parent.name, Path(module).stem
    named = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob(f"test_{stem}*.py"))
    users = [
        path.relative_to(ROOT).as_posix()
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if f"labpipe.{package}.{stem}" in path.read_text("utf-8")
    ]
    folder = f"tests/unit/{package}"
    return list(dict.fromkeys([*named, *users, *([folder] if (ROOT / folder).is_dir() else []), *ALSO.get(package, ())]))


def noticed(copy: Path, tests: Sequence[str]) -> bool:
    """Whether a test fails, or takes so long that somebody would look."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:randomly", *tests]
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        return subprocess.run(command, cwd=copy, env=environment, capture_output=True, timeout=SECONDS, check=False).returncode != 0
    except subprocess.TimeoutExpired:
        return True


def main() -> int:
    """Make mutants and print those that nobody notices."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--modules", nargs="*", default=[])
    parser.add_argument("--whole", action="store_true")
    arguments = parser.parse_args()
    modules = arguments.modules or [
        path.relative_to(ROOT).as_posix() for package in PACKAGES for path in sorted((ROOT / "labpipe" / package).glob("*.py"))
    ]
    rng, survivors, count = random.Random(arguments.seed), 0, 0
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / "labpipe-mutant"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", "*.egg-info", "__pycache__", ".mypy_cache", ".ruff_cache"))
        while count < arguments.count:
            module = rng.choice(modules)
            source = (ROOT / module).read_text("utf-8")
            made = mutant(source, rng)
            if made is None:
                continue
            count += 1
            (copy / module).write_text(made[0], "utf-8")
            caught = noticed(copy, tests_of(module)) or (arguments.whole and noticed(copy, ["tests"]))
            (copy / module).write_text(source, "utf-8")
            if not caught:
                survivors += 1
                print(f"survivor {module}:{made[1]}", flush=True)
    print(f"{count - survivors} of {count} mutants are noticed")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())

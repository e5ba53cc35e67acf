"""The tests, tested: one change of the code at a time, which a test must notice.

python -m tests.mutants.run [--count N] [--seed S] [--modules labpipe/project/rules.py ...]

A mutant is made in a copy of the checkout; the tests that are named after its module run on it first, then
those of its folder that import it, others that import it, and all of its folder, up to the first that fails,
in a process that has the libraries from its parent: a few seconds each. With --whole the short suite
follows where all of them pass; with --quick those tests of the selection of `python -m tests.quick` that
reach the module run on every mutant as well, and it is counted too how many they notice. Prints every mutant
with its outcome; a survivor is a missing test, or a change without effect. The same seed makes the same
mutants of the same code; --skip goes on where a run was interrupted.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import importlib
import os
import random
import select
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tests.quick import recorded, selected

ROOT = Path(__file__).parent.parent.parent
# For the tests of a mutant, and for one of them alone: longer, it hangs.
SECONDS, ONE_TEST_SECONDS = 300.0, 60.0
SURVIVES, HANGS, LATE = "survives", "hangs", "not within its time"
# What the tests import; a mutant's process has it from its parent. Nothing of labpipe.
HEAVY = (
    "numpy", "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.stats", "scipy.fft", "scipy.special",
    "scipy.interpolate", "pandas",
    "pyarrow.parquet", "pyarrow.csv", "h5py", "yaml", "click", "matplotlib.figure", "nptdms", "fpdf",
)  # fmt: skip
_COMPARED = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
}
_COMPUTED = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
}


def changes(tree: ast.Module) -> Iterator[tuple[ast.AST, str]]:
    """Nodes that can be changed, with what is done to them."""
    constants = {
        id(child)
        for node in ast.walk(tree)
        if isinstance(node, (ast.JoinedStr, ast.AnnAssign))
        for child in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare) and type(node.ops[0]) in _COMPARED:
            yield node, "comparison"
        elif isinstance(node, ast.BinOp) and type(node.op) in _COMPUTED:
            yield node, "operator"
        elif isinstance(node, ast.BoolOp):
            yield node, "and/or"
        elif isinstance(node, (ast.If, ast.IfExp)):
            yield node, "condition"
        elif (
            isinstance(node, ast.Constant) and type(node.value) in (int, float) and id(node) not in constants
        ):
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


def imported(source: str) -> set[str]:
    """What a source imports: `a` and `a.b` for `from a import b`."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.update((node.module, *(f"{node.module}.{alias.name}" for alias in node.names)))
    return names


def tests_of(module: str) -> Iterator[list[str]]:
    """The files of tests that look at a module, the closest first: of its folder those that are named after
    it or import it, others that do, then all of its folder; no ratios of speed, which chance moves.
    """
    relative, dotted = Path(module).relative_to("labpipe"), module.removesuffix(".py").replace("/", ".")
    # What is drawn is tested with what is said.
    folder = f"tests/{relative.parent.as_posix().replace('document', 'report')}/".replace("/./", "/")
    every = {
        path.relative_to(ROOT).as_posix(): path
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if path.parent.name != "benchmarks"
    }
    own = [name for name in every if Path(name).parent == Path(folder)]
    users = [name for name, path in every.items() if dotted in imported(path.read_text("utf-8"))]
    stages = (
        [name for name in own if Path(name).stem == f"test_{relative.stem}"],
        [name for name in own if Path(name).stem.startswith(f"test_{relative.stem}")],
        [name for name in own if name in users],
        users,
        own,
    )
    done: set[str] = set()
    for stage in stages:
        if fresh := [name for name in stage if name not in done]:
            done.update(fresh)
            yield fresh


def noticed(copy: Path, tests: Sequence[str], seconds: float = SECONDS) -> str:
    """What a process of its own says of the tests on the copy: the first that failed, HANGS, LATE, or nothing
    where all passed.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        os._exit(_tested(copy, tests, writing))
    os.close(writing)
    said, began, end = b"", time.monotonic(), time.monotonic() + seconds
    with os.fdopen(reading, "rb") as starts:
        while time.monotonic() < end:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return (said.rpartition(b" ")[2].decode() or "no test runs") if status else ""
            # The child writes when a test begins, and the name of one that fails.
            if select.select([starts], [], [], 0.05)[0] and (new := os.read(starts.fileno(), 1 << 16)):
                said, began = said + new, time.monotonic()
            if time.monotonic() - began > ONE_TEST_SECONDS:
                break
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return HANGS if time.monotonic() - began > ONE_TEST_SECONDS else LATE


class _Said:
    """A plug-in of pytest that writes a blank when a test begins, and the file of one that fails."""

    def __init__(self, pipe: int) -> None:
        self.pipe = pipe

    def pytest_runtest_logstart(self) -> None:
        os.write(self.pipe, b" ")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            os.write(self.pipe, report.nodeid.partition("[")[0].encode())

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            os.write(self.pipe, report.nodeid.encode())


def _tested(copy: Path, tests: Sequence[str], pipe: int) -> int:
    """In the child: 0 when all tests pass. What the copy does not change is imported already, or compiled."""
    os.nice(10)
    os.chdir(copy)
    sys.path.insert(0, str(copy))
    os.environ["PYTHONPATH"] = str(copy)
    sys.dont_write_bytecode = True
    for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
        del sys.modules[name]
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    try:
        code = pytest.main(["-q", "-x", "-n", "0", "-p", "no:faulthandler", *tests], [_Said(pipe)])
        return 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else int(code)  # All of them are long ones.
    except BaseException:
        return 1


def outcome_of(copy: Path, module: str, seconds: float, whole: bool) -> str:
    """The first test that notices the change of a module of the copy, HANGS, LATE where *seconds* end before
    the tests, or SURVIVES.
    """
    end = time.monotonic() + seconds
    for tests in (*tests_of(module), *([["tests"]] if whole else [])):
        if said := noticed(copy, tests, end - time.monotonic()):
            return said
    return SURVIVES


def reaching(copy: Path) -> dict[str, list[str]]:
    """The tests of the selection that reach each module, the fastest first: those that pass on the code as it
    is, since a copy is not installed.
    """
    os.chdir(copy)
    tests: dict[str, list[str]] = {}
    for test in sorted(recorded(["-n", "0", *selected()]).values(), key=lambda test: test.seconds):
        for module in {line.partition(":")[0] for line in test.lines}:
            tests.setdefault(f"labpipe/{module}", []).append(test.name)
    return tests


def copied(folder: Path) -> Path:
    """A copy of the checkout, compiled, so that a mutant costs one module's compilation."""
    copy = folder / "labpipe-mutant"
    shutil.copytree(
        ROOT,
        copy,
        ignore=shutil.ignore_patterns(".git", "*.egg-info", "__pycache__", ".mypy_cache", ".ruff_cache"),
    )
    compileall.compile_dir(copy, quiet=2)
    for name in HEAVY:
        importlib.import_module(name)
    return copy


def main() -> int:
    """Make mutants and print those that nobody notices."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--skip", type=int, default=0, help="mutants of the seed that were made before")
    parser.add_argument("--modules", nargs="*", default=[])
    parser.add_argument(
        "--seconds",
        type=float,
        default=SECONDS,
        help="for each mutant: tests that take longer are told apart",
    )
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    modules = arguments.modules or [
        path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "labpipe").rglob("*.py"))
    ]
    outcomes: Counter[str] = Counter()
    by_quick = 0
    short: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory() as name:
        copy = copied(Path(name))
        if arguments.quick:
            short = reaching(copy)
        for number, (module, source, place) in enumerate(
            mutants(modules, random.Random(arguments.seed), arguments.count)
        ):
            if number < arguments.skip:
                continue
            path, stamp = copy / module, (copy / module).stat()
            original = path.read_text("utf-8")
            path.write_text(source, "utf-8")
            began = time.monotonic()
            outcome = outcome_of(copy, module, arguments.seconds, arguments.whole)
            first = noticed(copy, short[module], arguments.seconds) if module in short else ""
            if first and first != LATE:
                by_quick += 1
                outcome = first if outcome in (SURVIVES, LATE) else outcome
            path.write_text(original, "utf-8")
            os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
            outcomes[outcome] += 1
            took = f"({time.monotonic() - began:.0f} s)"
            quick = f"; of the selection {first or 'none'}" if arguments.quick else ""
            print(f"{number} {module}:{place}\n    {outcome}{quick} {took}", flush=True)
        tests = sorted(outcome for outcome in outcomes if outcome.startswith("tests/"))
        uncertain = noticed(copy, tests, 20 * SECONDS) if tests else ""
    missed = outcomes[SURVIVES] + outcomes[LATE]
    print(
        f"{outcomes.total() - missed} of {outcomes.total()} mutants are noticed, {outcomes[HANGS]} since "
        "they hang"
    )
    if arguments.quick:
        print(f"{by_quick} of {outcomes.total() - missed} are noticed by the selection")
    print(f"{outcomes[SURVIVES]} survive; {outcomes[LATE]} were not noticed within their time")
    if uncertain:
        print(f"{uncertain} fails on the code as it is: what it noticed does not count")
    return 1 if missed or uncertain else 0


def mutants(modules: Sequence[str], rng: random.Random, number: int) -> Iterator[tuple[str, str, str]]:
    """Module, changed source and place of *number* mutants: the same for the same seed and modules."""
    made = 0
    while made < number:
        module = rng.choice(modules)
        mutant_made = mutant((ROOT / module).read_text("utf-8"), rng)
        if mutant_made is not None:
            made += 1
            yield module, *mutant_made


if __name__ == "__main__":
    sys.exit(main())

"""What DESIGN says of sizes and imports: modules, functions, classes, rings, heavy imports.

Read from the source, nothing is run.
"""

from __future__ import annotations

import ast
import functools
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.source import MODULES, PACKAGE, nodes, tree_of

LONGEST_MODULE, MEDIAN_MODULE = 600, range(150, 301)
MOST_LAYERS = 12
LONGEST_BODY, USUAL_BODY, MEDIAN_BODY = 60, 30, 10
# The one protocol that every linear model of a response fulfils.
MANY_METHODS = {"DynamicModel": 11}
HOMELESS = {"utils", "helpers", "common", "core", "base", "misc", "tools"}
# A name of one word in this form says what was done, not what is done or what comes out.
PARTICIPLE = re.compile(
    r"_?([a-z]+ed|alone|apart|bent|brought|built|chosen|done|drawn|found|given|grown|held|hidden|kept|known|left"
    r"|made|meant|said|seen|sent|shown|spent|swept|taken|together|told|written)"
)
NOUNS_IN_ED = {"feed", "need", "seed", "speed"}
HEAVY = {"numpy", "scipy", "pandas", "pyarrow", "matplotlib", "yaml", "fpdf", "h5py", "nptdms"}


def name_of(path: Path) -> str:
    """The dotted name of a module."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path): path for path in MODULES}


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    return (node for node in nodes(tree) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)))


def body_length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its head and its docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def length(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def test_modules_are_short() -> None:
    lengths = sorted((length(path), name_of(path)) for path in MODULES)
    assert [pair for pair in lengths if pair[0] > LONGEST_MODULE] == []
    assert lengths[len(lengths) // 2][0] in MEDIAN_MODULE


def test_function_bodies_are_short() -> None:
    bodies = sorted(
        (body_length(function), name_of(path), function.name)
        for path in MODULES
        for function in functions(tree_of(path))
    )
    assert [body for body in bodies if body[0] > LONGEST_BODY] == []
    assert bodies[int(0.9 * len(bodies))][0] <= USUAL_BODY
    assert bodies[len(bodies) // 2][0] <= MEDIAN_BODY


def test_classes_have_few_methods() -> None:
    """Ten public ones at most, properties left out."""
    for path in MODULES:
        for owner in (node for node in nodes(tree_of(path)) if isinstance(node, ast.ClassDef)):
            methods = [node for node in owner.body if isinstance(node, ast.FunctionDef)]
            own = [one.name for one in methods if not one.name.startswith("_") and not one.decorator_list]
            assert len(own) <= MANY_METHODS.get(owner.name, 10), (name_of(path), owner.name, own)


def test_no_two_classes_have_one_name() -> None:
    names = Counter(
        node.name for path in MODULES for node in nodes(tree_of(path)) if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_functions_that_compute_are_verbs_or_nouns() -> None:
    """Properties and answers of yes or no may say in which state something is."""
    named = [
        f"{name_of(path)}.{function.name}"
        for path in MODULES
        for function in functions(tree_of(path))
        if PARTICIPLE.fullmatch(function.name)
        and function.name.strip("_") not in NOUNS_IN_ED
        and not any("property" in ast.unparse(decorator) for decorator in function.decorator_list)
        and not (function.returns and ast.unparse(function.returns) == "bool")
    ]
    assert named == []


def test_every_module_has_a_home_and_says_what_it_is() -> None:
    """The first line of a module does."""
    assert not [name for name, path in NAMES.items() if path.stem in HOMELESS]
    assert not [
        name
        for name, path in NAMES.items()
        if path.stem != "__init__" and not ast.get_docstring(tree_of(path))
    ]


def imported(tree: ast.AST) -> Iterator[str]:
    """Modules of labpipe that are imported when a module is, function bodies left out."""
    for node in at_import(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "labpipe":
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "labpipe")


def at_import(tree: ast.AST) -> Iterator[ast.AST]:
    """The statements that run at import: not those in functions, nor those for type checkers only."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            continue
        yield node
        yield from at_import(node)


@functools.cache
def imports() -> dict[str, set[str]]:
    """Module -> the modules of labpipe that it imports."""
    return {
        name: {one for one in imported(tree_of(path)) if one in NAMES and one != name}
        for name, path in NAMES.items()
    }


def ring(graph: dict[str, set[str]]) -> list[str]:
    """A ring of imports, or nothing: depth first, a name that is met again on its own way closes one."""
    clear: set[str] = set()

    def visit(name: str, way: list[str]) -> list[str]:
        if name in way:
            return [*way[way.index(name) :], name]
        if name in clear:
            return []
        for other in sorted(graph.get(name, ())):
            found = visit(other, [*way, name])
            if found:
                return found
        clear.add(name)
        return []

    return next((found for name in sorted(graph) if (found := visit(name, []))), [])


def test_a_ring_is_seen() -> None:
    assert ring({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert ring({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_no_ring_of_imports() -> None:
    assert ring(imports()) == []


def named_in_strings(tree: ast.Module) -> Iterator[str]:
    """Modules of labpipe that strings name as "module:attribute"."""
    for node in nodes(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and (name := node.value.partition(":")[0]) in NAMES
        ):
            yield name


def test_the_core_imports_no_method() -> None:
    """Neither by an import, in functions too, nor by a string.

    Labpipe itself lists its public names, which it loads when they are used.
    """
    for name, path in NAMES.items():
        if name != "labpipe" and not name.startswith("labpipe.methods"):
            inside = {node.module or "" for node in nodes(tree_of(path)) if isinstance(node, ast.ImportFrom)}
            named = {*imports()[name], *inside, *named_in_strings(tree_of(path))}
            assert not [one for one in named if one.startswith("labpipe.methods.")], name


def test_packages_lie_in_few_layers() -> None:
    """The longest chain of packages of which each imports the next; methods count as one."""
    graph: dict[str, set[str]] = {}
    for name, used in imports().items():
        package = ".".join(name.split(".")[:2])
        graph.setdefault(package, set()).update(".".join(one.split(".")[:2]) for one in used)
    packages = {name for name in graph if NAMES[name].stem == "__init__" and name != "labpipe"}
    graph = {name: {one for one in graph[name] if one in packages and one != name} for name in packages}
    assert ring(graph) == []

    @functools.cache
    def height(name: str) -> int:
        return 1 + max(map(height, graph[name]), default=0)

    assert max(map(height, graph)) <= MOST_LAYERS


def test_the_command_s_table_loads_nothing_heavy() -> None:
    """What `labpipe --help` imports, followed module by module: click and the standard library."""
    waiting, seen = ["labpipe.cli.main"], set()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        parts = name.split(".")
        waiting.extend(".".join(parts[:n]) for n in range(1, len(parts)))
        waiting.extend(imports()[name])
    for name in seen:
        outside = {
            alias.split(".")[0]
            for node in at_import(tree_of(NAMES[name]))
            if isinstance(node, (ast.Import, ast.ImportFrom))
            for alias in (
                [node.module or ""] if isinstance(node, ast.ImportFrom) else [one.name for one in node.names]
            )
        }
        assert not outside & HEAVY, (name, outside & HEAVY)


def method_names() -> set[str]:
    """The names of all models and estimators: of fits, and of spectra."""
    from labpipe.estimation.settings import ESTIMATORS, MODELS
    from labpipe.records.identification import PLANE, STRAIGHT_LINE
    from labpipe.spectra.random import ESTIMATORS as OF_SPECTRA

    return {*MODELS, *ESTIMATORS, *OF_SPECTRA, STRAIGHT_LINE, PLANE}


def strings(node: ast.AST) -> set[str]:
    """The strings of an expression that is one, or a display of them."""
    parts = (
        node.elts
        if isinstance(node, (ast.Tuple, ast.List, ast.Set))
        else node.keys
        if isinstance(node, ast.Dict)
        else [node]
    )
    return {
        str(part.value) for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str)
    }


@functools.cache
def constants_with_names() -> frozenset[str]:
    """Constants of modules that are the name of a model or an estimator, or several of them."""
    named = set()
    for node in (node for path in MODULES for node in tree_of(path).body if isinstance(node, ast.Assign)):
        target, value = node.targets[0], node.value
        several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
        for name, one in zip(target.elts, value.elts, strict=True) if several else [(target, value)]:
            held = set() if isinstance(one, ast.Dict) else strings(one)
            if isinstance(name, ast.Name) and held and held <= method_names():
                named.add(name.id)
    return frozenset(named)


def compared_names(tree: ast.Module) -> Iterator[str]:
    """Every comparison with the name of a model or an estimator, as a string or by a constant."""
    for node in nodes(tree):
        compared = isinstance(node, ast.Compare)
        for side in (
            [node.left, *node.comparators]
            if compared
            else [node.value]
            if isinstance(node, ast.MatchValue)
            else []
        ):
            names = strings(side) & method_names()
            names |= {
                part.id for part in ast.walk(side) if isinstance(part, ast.Name)
            } & constants_with_names()
            names |= {
                part.attr for part in ast.walk(side) if isinstance(part, ast.Attribute)
            } & constants_with_names()
            yield from (f"{getattr(node, 'lineno', 0)}: {name}" for name in sorted(names))


# Where a name may be compared: in the modules that define what bears it.
DEFINES = ("labpipe.spectra.", "labpipe.records.identification")


def test_properties_are_asked_for_and_no_names() -> None:
    """A model or estimator of a plug-in has the properties of one of ours, and never its name."""
    compared = {
        name: list(compared_names(tree_of(path)))
        for name, path in NAMES.items()
        if not name.startswith(DEFINES)
    }
    assert not {name: found for name, found in compared.items() if found}


@pytest.mark.parametrize(
    "line",
    [
        'a == "sdof"',
        'a.estimator != "ml"',
        'a in ("x", "iv")',
        'b not in {"mdof": 1}',
        "a == STRAIGHT_LINE",
        "a != m.STRAIGHT_LINE",
    ],
)
def test_a_comparison_with_a_name_is_seen(line: str) -> None:
    assert list(compared_names(ast.parse(line)))


@pytest.mark.parametrize("selection", ["quick.txt", "slow.txt"])
def test_the_short_answers_name_tests_that_exist(selection: str) -> None:
    """A name that is none tests nothing."""
    root = Path(__file__).parent
    gone, text = [], ""
    for line in (root / selection).read_text().splitlines():
        if not line.startswith(" "):
            text = (root.parent / line).read_text()
        elif f"def {line.strip().partition('[')[0].rpartition('::')[2]}(" not in text:
            gone.append(line)
    assert not gone

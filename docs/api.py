"""The Python reference: every public name of labpipe with its signature and docstring, a page per package,
read from the source.

Read with `ast` and not by mkdocstrings: nothing is imported, and all pages are made in less time than it
takes to load that. Docstrings of labpipe are plain paragraphs; what is indented in them is code.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from maths import CITATION, linked, way

ROOT = Path(__file__).parent.parent
FOLDER = "reference/python"
WIDE = 100
# The search shows prose before entries with the same words: a word of a title counts a thousand times as much
# as one of a text.
HEAD = "---\nsearch:\n  boost: 0.001\n---\n\n"
# Calls that make a field of a dataclass: their defaults are within.
FIELDS = ("setting", "field")


@dataclass(frozen=True)
class Name:
    """A public name: a function, class, method or constant, with what its source says of it."""

    path: str
    kind: str
    signature: str
    text: str
    members: tuple[Name, ...] = ()

    @property
    def all(self) -> Iterator[Name]:
        """The name and its members."""
        yield self
        for member in self.members:
            yield from member.all


@dataclass(frozen=True)
class Module:
    """A module: its dotted name, docstring and public names, and where its source is."""

    path: str
    text: str
    names: tuple[Name, ...]
    place: str = field(default="")

    @property
    def package(self) -> str:
        """The package of labpipe that it belongs to; labpipe for modules of none."""
        parts = self.path.split(".")
        folder = (ROOT / "labpipe" / parts[1]).is_dir() if len(parts) > 1 else False
        return parts[1] if folder else "labpipe"


def parsed(path: Path) -> ast.Module:
    """The syntax tree of a module."""
    return ast.parse(path.read_text(encoding="utf-8"))


def modules(tree_of: Callable[[Path], ast.Module] = parsed) -> list[Module]:
    """All public modules of labpipe, in the order of their names; *tree_of* gives the tree of a file."""
    files = sorted((ROOT / "labpipe").rglob("*.py"))
    found = (
        path.relative_to(ROOT) for path in files if not path.stem.startswith("_") or path.stem == "__init__"
    )
    return [
        module_of(path.as_posix(), (ROOT / path).read_text(encoding="utf-8"), tree_of(ROOT / path))
        for path in found
    ]


def module_of(place: str, source: str, tree: ast.Module | None = None) -> Module:
    """The public names of a source file, of which *tree* is the syntax tree."""
    path = place.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    tree = tree or ast.parse(source)
    return Module(
        path, ast.get_docstring(tree) or "", tuple(names_in(tree.body, path, source.splitlines())), place
    )


def names_in(body: list[ast.stmt], owner: str, lines: list[str]) -> Iterator[Name]:
    """The public names that these statements define."""
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and public(node.name):
            yield function_of(node, owner)
        elif isinstance(node, ast.ClassDef) and public(node.name):
            yield class_of(node, owner, lines)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            yield from constants_of(node, owner, lines)


def public(name: str) -> bool:
    return not name.startswith("_")


def function_of(node: ast.FunctionDef | ast.AsyncFunctionDef, owner: str, of_class: bool = False) -> Name:
    decorators = [ast.unparse(one) for one in node.decorator_list]
    if any(one.endswith("property") for one in decorators):
        signature = f"{node.name}: {ast.unparse(node.returns)}" if node.returns else node.name
        return Name(f"{owner}.{node.name}", "property", signature, ast.get_docstring(node) or "")
    arguments = _split(node.args)
    if of_class and arguments[:1] in (["self"], ["cls"]):
        arguments = arguments[1:]
    returned = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    kind = "method" if of_class else "function"
    return Name(
        f"{owner}.{node.name}", kind, called(node.name, arguments, returned), ast.get_docstring(node) or ""
    )


def _split(arguments: ast.arguments) -> list[str]:
    """Each argument by itself, with its annotation and default, and the marks `/` and `*` where they
    stand.
    """
    positional = [*arguments.posonlyargs, *arguments.args]
    without = [None] * (len(positional) - len(arguments.defaults))
    split = [
        _argument(one, default)
        for one, default in zip(positional, [*without, *arguments.defaults], strict=True)
    ]
    if arguments.posonlyargs:
        split.insert(len(arguments.posonlyargs), "/")
    if arguments.vararg or arguments.kwonlyargs:
        split.append("*" + (_argument(arguments.vararg) if arguments.vararg else ""))
    split += [
        _argument(one, default)
        for one, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    ]
    return [*split, *(["**" + _argument(arguments.kwarg)] if arguments.kwarg else [])]


def _argument(one: ast.arg, default: ast.expr | None = None) -> str:
    kind = f": {ast.unparse(one.annotation)}" if one.annotation else ""
    value = ast.unparse(default) if default is not None else ""
    return one.arg + kind + ((f" = {value}" if kind else f"={value}") if value else "")


def called(name: str, arguments: list[str], returned: str) -> str:
    """A call on one line, or with a line for each argument where that is too wide."""
    line = f"{name}({', '.join(arguments)}){returned}"
    return (
        line
        if len(line) <= WIDE
        else f"{name}(\n" + "".join(f"    {one},\n" for one in arguments) + f"){returned}"
    )


def class_of(node: ast.ClassDef, owner: str, lines: list[str]) -> Name:
    path = f"{owner}.{node.name}"
    bases = ", ".join(ast.unparse(base) for base in node.bases)
    head = f"class {node.name}({bases})" if bases else f"class {node.name}"
    fields = [
        field_of(one, lines)
        for one in node.body
        if isinstance(one, ast.AnnAssign) and public(ast.unparse(one.target))
    ]
    own = [one for one in node.body if isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef))]
    starts = [function_of(one, path, of_class=True).signature for one in own if one.name == "__init__"]
    fields += [
        one.replace("__init__", node.name, 1).removesuffix(" -> None").replace("\n", "\n    ")
        for one in starts
    ]
    members = tuple(function_of(one, path, of_class=True) for one in own if public(one.name))
    return Name(
        path,
        "class",
        "\n".join([head, *(f"    {one}" for one in fields)]),
        ast.get_docstring(node) or "",
        members,
    )


def field_of(node: ast.AnnAssign, lines: list[str]) -> str:
    """A field with its type and default, and what its setting is, as a comment."""
    made = f"{ast.unparse(node.target)}: {ast.unparse(node.annotation)}"
    if (
        isinstance(node.value, ast.Call)
        and isinstance(node.value.func, ast.Name)
        and node.value.func.id in FIELDS
    ):
        options = {one.arg: ast.unparse(one.value) for one in node.value.keywords}
        default = options.get("default", options.get("default_factory", ""))
        words = [one.value for one in node.value.args[1:2] if isinstance(one, ast.Constant)]
        unit = options.get("unit", "''").strip("'")
        said = f"  # {words[0]}{f' [{unit}]' if unit not in ('', '1') else ''}" if words else ""
        return made + (f" = {default}" if default else "") + said
    return made + (f" = {ast.unparse(node.value)}" if node.value is not None else "") + _aside(node, lines)


def _aside(node: ast.stmt, lines: list[str]) -> str:
    """The comment behind a statement."""
    comment = lines[(node.end_lineno or 0) - 1][node.end_col_offset or 0 :].strip()
    return f"  {comment}" if comment.startswith("# ") and "noqa" not in comment else ""


def constants_of(node: ast.Assign | ast.AnnAssign, owner: str, lines: list[str]) -> Iterator[Name]:
    """Names of a module that are given a value; the comment above them is what they are."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    for target in targets:
        if isinstance(target, ast.Name) and public(target.id):
            value = ast.unparse(node.value) if node.value is not None else ""
            kind = f": {ast.unparse(node.annotation)}" if isinstance(node, ast.AnnAssign) else ""
            line = f"{target.id}{kind} = {value}"
            yield Name(
                f"{owner}.{target.id}",
                "constant",
                line if len(line) <= WIDE else f"{target.id}{kind} = …",
                _above(node, lines),
            )


def _above(node: ast.stmt, lines: list[str]) -> str:
    """The comment lines right above a statement."""
    said: list[str] = []
    for line in reversed(lines[: node.lineno - 1]):
        if not line.startswith("# "):
            break
        said.insert(0, line.removeprefix("# "))
    return "\n".join(said)


def places(read: list[Module]) -> dict[str, str]:
    """Dotted public name -> page with its entry; modules and members of classes too."""
    found = {module.path: page_of(module) for module in read}
    return found | {one.path: page_of(module) for module in read for name in module.names for one in name.all}


def page_of(module: Module) -> str:
    return f"{FOLDER}/{module.package}.md"


class Entries:
    """Writes entries; *labels* says on which page an equation stands."""

    def __init__(self, labels: Mapping[str, str]) -> None:
        self.labels = labels

    def module(self, module: Module) -> str:
        """A module as a section with its public names."""
        page = page_of(module)
        title = module.path.removeprefix("labpipe.")
        parts = [f"## {title} {{: #{module.path} }}", self.html(module.text, page, f"labpipe/{module.path}")]
        parts += [self.entry(one, page, module.place) for name in module.names for one in name.all]
        return "\n\n".join(parts)

    def entry(self, name: Name, page: str, place: str) -> str:
        """A name with its signature and docstring."""
        own = name.path.rpartition(".")[2]
        shown = ".".join(name.path.split(".")[-2:]) if name.kind in ("method", "property") else own
        level = "####" if name.kind in ("method", "property") else "###"
        body = self.html(name.text, page, f"{place}: {own}")
        return f"{level} {shown} {{: #{name.path} .{name.kind} }}\n\n{signature(name.signature)}\n\n{body}"

    def html(self, text: str, page: str, place: str) -> str:
        """A docstring as HTML on lines that Markdown leaves alone."""
        blocks: list[str] = []
        for block in re.split(r"\n\s*\n", text.strip("\n")):
            if blocks and block.startswith("    ") and blocks[-1].splitlines()[-1].startswith("    "):
                blocks[-1] += f"\n\n{block}"
            else:
                blocks.append(block)
        made = [part for block in blocks for part in self._block(block, page, place)]
        return f'<div class="docstring">{"".join(made)}</div>' if text else ""

    def _block(self, block: str, page: str, place: str) -> Iterator[str]:
        """A paragraph, and what is indented below its first lines as code."""
        lines = block.splitlines()
        cut = next((n for n, line in enumerate(lines) if line.startswith("    ")), len(lines))
        words = "\n".join(lines[:cut])
        words = words.removesuffix(":") if words.endswith("::") else words
        if words:
            yield f"<p>{self._inline(words, page, place)}</p>"
        if cut < len(lines):
            yield f"<pre><code>{_flat(escape(_dedented(chr(10).join(lines[cut:]))))}</code></pre>"

    def _inline(self, words: str, page: str, place: str) -> str:
        """Words with code between backticks and links to the equations they name."""
        text = " ".join(words.split())
        made = re.sub(r"(`+)(.+?)\1", lambda found: f"<code>{found[2]}</code>", escape(text, quote=False))
        made = re.sub(r"(?<![\w*])\*(\w+)\*(?![\w*])", r"<em>\1</em>", made)
        return re.sub(
            CITATION, lambda found: linked(found[0], lambda label: self._link(label, page, place)), made
        )

    def _link(self, label: str, page: str, place: str) -> str:
        if label not in self.labels:
            raise SystemExit(f"{place}: no page has an equation '{label}'")
        target = way(page, self.labels[label]).removesuffix(".md") + ".html"
        return f'<a href="{target}#{label}">({label})</a>'


def signature(text: str) -> str:
    """A signature, each line by itself, so that what is too wide goes on below its beginning."""
    lines = "".join(f"<span>{escape(line)}&#10;</span>" for line in text.splitlines())
    return f'<pre class="signature"><code>{lines}</code></pre>'


def _dedented(block: str) -> str:
    lines = block.splitlines()
    least = min(len(line) - len(line.lstrip()) for line in lines if line.strip())
    return "\n".join(line[least:] for line in lines)


def _flat(text: str) -> str:
    """Preformatted text on one line: a blank line within would end the block for Markdown."""
    return text.replace("\n", "&#10;")


def layers() -> list[list[str]]:
    """The packages and modules of each layer, the uppermost first, as the import contract has them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    ordered = next(
        contract["layers"]
        for contract in contracts
        if contract["type"] == "layers" and "containers" not in contract
    )
    return [[one.strip().removeprefix("labpipe.") for one in layer.split("|")] for layer in ordered]


def first_sentence(text: str) -> str:
    found = re.match(r".+?\.(?=\s|$)", " ".join(text.split("\n\n")[0].split()))
    return found[0] if found else text


def api_pages(read: list[Module], labels: Mapping[str, str]) -> dict[str, str]:
    """Page below docs/pages -> Markdown: the overview, the names for scripts, and every package."""
    write = Entries(labels)
    by_package: dict[str, list[Module]] = {}
    for module in read:
        by_package.setdefault(module.package, []).append(module)
    pages = {f"{FOLDER}/index.md": overview(read), f"{FOLDER}/scripts.md": scripts(read, write)}
    for package, own in by_package.items():
        title = "labpipe" if package == "labpipe" else f"labpipe.{package}"
        pages[f"{FOLDER}/{package}.md"] = (
            HEAD + "\n\n".join([f"# {title}", *(write.module(module) for module in own)]) + "\n"
        )
    return pages


def overview(read: list[Module]) -> str:
    """Which layer is what: a row per layer, its packages with the first sentence of their docstrings."""
    said = {module.path: module for module in read}
    rows = []
    for number, layer in enumerate(layers(), 1):
        for one in (said[f"labpipe.{name}"] for name in layer):
            target = f"{one.package}.md" if one.package != "labpipe" else f"labpipe.md#{one.path}"
            rows.append(f"| {number} | [`{one.path}`]({target}) | {first_sentence(one.text)} |")
    return (
        "# Python\n\nNotebooks and scripts need the [names of `labpipe` itself](scripts.md); "
        "[Notebooks](../../how-to/notebook.md) shows them at work. Plug-ins and contributors find every "
        "public name below.\n\n"
        "Arrays are numpy's, in SI units unless a docstring says otherwise; frequencies in Hz, angles in "
        "rad. `(n_line, n_output)` is a "
        "shape, `[N/m]` a unit. Bad input raises `labpipe.LabpipeError`, whose message says what is wrong "
        "and where.\n\n"
        "## Layers\n\nLayer 1 is the uppermost. A package imports from the layers below its own, not from "
        "its neighbours and "
        "not from above; CI holds that.\n\n"
        "| layer | package | what it is |\n|---|---|---|\n" + "\n".join(rows) + "\n"
    )


def scripts(read: list[Module], write: Entries) -> str:
    """What `import labpipe` offers, each with its entry."""
    import labpipe

    by_path = {one.path: (one, module) for module in read for name in module.names for one in name.all}
    page = f"{FOLDER}/scripts.md"
    parts = [
        "# Names for scripts and notebooks",
        write.html(labpipe.__doc__ or "", page, "labpipe/__init__.py"),
    ]
    for name in (one for one in labpipe.__all__ if public(one)):
        offered = getattr(labpipe, name)
        one, module = by_path[f"{offered.__module__}.{offered.__qualname__}"]
        shown = re.sub(rf"\b{offered.__name__}\b", name, one.signature, count=1)
        where = f"[`{one.path}`]({way(page, page_of(module))}#{one.path})"
        parts.append(f"## labpipe.{name} {{: #labpipe.{name} }}\n\n{signature(shown)}")
        parts += [write.html(one.text, page, f"{module.place}: {name}"), f"Home: {where}\n{{: .computed }}"]
    return "\n\n".join(parts) + "\n"

"""YAML in which every key and value has its line and column; duplicate keys are refused. A parsed file is a
tree of Marked nodes: a mapping is ``dict[str, Marked]`` in document order, a list ``list[Marked]``, a scalar
the plain Python value. ``--set`` edits it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from labpipe.errors import ConfigError, ConfigErrors

# What stands for a file where an entry was set on the command line.
SET = "--set"


@dataclass
class Marked:
    """A YAML node: its content and its place (file, 1-based line and column)."""

    content: Any
    where: str
    key_where: str = ""
    text: str = ""

    @property
    def place(self) -> str:
        """Where a fault of this entry is reported: its key, or the node (of lists, the whole file)."""
        return self.key_where or self.where

    @property
    def folder(self) -> Path:
        return Path(self.where.rsplit(":", 2)[0]).parent

    def folder_of(self, key: str) -> Path:
        """The folder of the file that an entry stands in; of one by `--set`, which is not a file, its own."""
        entry: Marked = self.content[key]
        return self.folder if entry.where.startswith(SET) else entry.folder

    def without(self, *keys: str) -> Marked:
        return replace(self, content={key: node for key, node in self.content.items() if key not in keys})

    def plain(self) -> Any:
        if isinstance(self.content, dict):
            return {key: node.plain() for key, node in self.content.items()}
        if isinstance(self.content, list):
            return [node.plain() for node in self.content]
        return self.content


def text_of(entries: Mapping[str, Marked], name: str, default: str = "") -> str:
    """The text of an entry, the default where it is not there."""
    return entries[name].text if name in entries else default


class _Loader(yaml.SafeLoader):
    """Safe YAML with plain scalars: no dates, no 1_000, no sexagesimal 45:30, no yes/no booleans."""


_Loader.yaml_implicit_resolvers = {
    first: [pair for pair in resolvers if pair[0] in ("tag:yaml.org,2002:null", "tag:yaml.org,2002:merge")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


# How artefacts begin: megabytes of numbers, of which YAML would make settings one by one.
MADE = re.compile(r'\s*\{\s*"schema":\s*"(labpipe/[^"]+)"')
# A file that people write has fewer entries and characters, also when its aliases stand for what they name.
MOST_NODES, MOST_BYTES = 200_000, 1 << 24
# Characters of a file whose nodes are kept: pipelines share their rigs, and a watch reads the same files
# again and again.
MOST_KEPT = 1 << 15


def load_marked(path: Path, overrides: Iterable[str] = ()) -> Marked:
    """The marked tree of a YAML file with the *overrides*; ConfigError with the place of a fault."""
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ConfigError("is not a regular file", path)
        if path.is_file() and path.stat().st_size > MOST_BYTES:
            what = f"has more than {MOST_BYTES >> 20} MB"
            raise ConfigError(what, path, "a YAML file of settings is needed")
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ConfigError("no such file", path) from None
    except IsADirectoryError:
        raise ConfigError("is a directory", path, "name a YAML file") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"is not UTF-8 text (byte {error.start})", path) from None
    except OSError as error:
        raise ConfigError(error.strerror or str(error), path) from None
    if made := MADE.match(text):
        raise ConfigError(f"is a result of labpipe ({made[1]})", path, "a YAML file of settings is needed")
    tree = parse_marked(text, str(path))
    for assignment in overrides:
        set_entry(tree, assignment)
    return tree


def parse_marked(text: str, name: str) -> Marked:
    """The marked tree of YAML *text*; *name* is the file's name in messages."""
    try:
        node = _compose(text) if len(text) <= MOST_KEPT else _Loader(text).get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = _place(mark, name) if mark else name
        raise ConfigError(f"not valid YAML: {error.problem or error.context}", place) from None
    except RecursionError:
        raise ConfigError("not valid YAML: nested too deeply", name) from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"not valid YAML: {(str(error).splitlines() or ['unreadable'])[0]}", name) from None
    if node is None:
        raise ConfigError("the file is empty", name)
    tree = _Tree(name)
    try:
        marked = tree.mark(node, frozenset())
    except RecursionError:
        raise ConfigError("not valid YAML: nested too deeply", name) from None
    if tree.duplicates:
        raise ConfigErrors(tree.duplicates)
    return marked


@lru_cache(maxsize=32)
def _compose(text: str) -> yaml.Node | None:
    return _Loader(text).get_single_node()


def _place(mark: yaml.Mark, name: str) -> str:
    return f"{name}:{mark.line + 1}:{mark.column + 1}"


class _Tree:
    """The marked nodes of one file: counted, since aliases of aliases may stand for any number."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._count = 0
        self.duplicates: list[ConfigError] = []

    def mark(self, node: yaml.Node, above: frozenset[int]) -> Marked:
        """The marked node; *above*: the nodes that contain it."""
        where = _place(node.start_mark, self._name)
        self._count += 1
        if self._count > MOST_NODES:
            raise ConfigError(f"aliases expand the file to more than {MOST_NODES} entries of the file", where)
        if id(node) in above:
            raise ConfigError("an alias refers to the node that contains it", where)
        above = above | {id(node)}
        if isinstance(node, yaml.MappingNode):
            return Marked(self._mapping(node, above), where)
        if isinstance(node, yaml.SequenceNode):
            return Marked([self.mark(item, above) for item in node.value], where)
        return Marked(_scalar(node), where, text=str(node.value))

    def _mapping(self, node: yaml.MappingNode, above: frozenset[int]) -> dict[str, Marked]:
        entries: dict[str, Marked] = {}
        for key_node, value_node in node.value:
            where = _place(key_node.start_mark, self._name)
            if not isinstance(key_node, yaml.ScalarNode):
                raise ConfigError("a key must be a plain name", where)
            key = str(key_node.value)
            if key in entries:
                hint = f"first at {entries[key].key_where}"
                self.duplicates.append(ConfigError(f"{key}: the key appears twice", where, hint))
                continue
            entries[key] = self.mark(value_node, above)
            entries[key].key_where = where
        return entries


def _scalar(node: yaml.Node) -> Any:
    """Text, None, bool or number: a number only when written as one (45 is, '45' and 45 deg are not)."""
    text = str(node.value)
    if getattr(node, "style", None) in ("'", '"', "|", ">"):
        return text
    if text in ("", "~", "null"):
        return None
    if text in ("true", "false"):
        return text == "true"
    for convert in (int, float):
        try:
            return convert(text) if "_" not in text else text
        except ValueError:
            continue
    return text


def set_entry(root: Marked, assignment: str) -> None:
    """Apply ``key.sub=value`` (YAML) to the tree; list entries by number. ConfigError where it cannot."""
    path, equals, text = assignment.partition("=")
    where = f"{SET} {assignment}"
    if not equals or not path.strip():
        raise ConfigError("not an assignment", where, "write --set key.sub=value")
    value = _plain_or_yaml(text, where)
    keys = _keys(path.strip())
    owner = root
    for key in keys[:-1]:
        owner = _descend(owner, key, where)
    if isinstance(owner.content, list):
        owner.content[_index(owner, keys[-1], where)] = value
    elif isinstance(owner.content, dict):
        owner.content[keys[-1]] = value
    else:
        raise ConfigError(f"'{'.'.join(keys[:-1])}' has no entries", where)


def _plain_or_yaml(text: str, where: str) -> Marked:
    """The value as YAML, or as text where it begins with a sign such as '>=', reserved in YAML."""
    if not text.strip() or text.lstrip()[0] in "><%@`&*!|":
        return Marked(text.strip(), where, where, text.strip())
    value = parse_marked(text, where)
    value.where = value.key_where = where
    return value


def _keys(path: str) -> list[str]:
    # Rules are keys with dots themselves.
    section, _, rest = path.partition(".")
    return [section, rest] if section in ("accept", "expect") and rest else path.split(".")


def _descend(owner: Marked, key: str, where: str) -> Marked:
    if isinstance(owner.content, list):
        item: Marked = owner.content[_index(owner, key, where)]
        return item
    if isinstance(owner.content, dict):
        entry: Marked = owner.content.setdefault(key, Marked({}, where, where))
        return entry
    raise ConfigError(f"'{key}' cannot be set inside a plain value", where)


def _index(owner: Marked, key: str, where: str) -> int:
    if key.isdigit() and int(key) < len(owner.content):
        return int(key)
    raise ConfigError(f"'{key}' is not an entry of a list of {len(owner.content)}", where)

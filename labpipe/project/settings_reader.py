"""From a YAML mapping to a settings dataclass by its declared settings; all faults in one pass."""

from __future__ import annotations

import dataclasses
import difflib
import glob
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TypeVar

from labpipe.artefacts.writing import is_remote, path_of
from labpipe.errors import ConfigError, ConfigErrors
from labpipe.project.marked_yaml import Marked, text_of
from labpipe.quantities import UnitError
from labpipe.records.rig import Rig
from labpipe.records.settings import (
    CONVERTERS,
    EMPTY,
    FileKind,
    Setting,
    is_empty,
    settings_of,
    takes_uncertainty,
)
from labpipe.records.uncertain import is_uncertain, parse_uncertain
from labpipe.registry import Registry, nearest


class Faults:
    """The faults of one file; `raise_any` ends the pass. *folder*: to which its paths are relative."""

    def __init__(self, folder: Path = Path()) -> None:
        self.folder = folder
        self._faults: list[ConfigError] = []

    def add(self, node: Marked, key: str, message: str, hint: str = "") -> None:
        """A fault of the entry *key* at its place in the file."""
        self._faults.append(ConfigError(f"{key}: {message}" if key else message, node.place, hint))

    def add_at(
        self, entries: Mapping[str, Marked], key: str, name: str, message: str, hint: str = ""
    ) -> None:
        """A fault of the entry *name* of a mapping that stands under *key*."""
        self.add(entries[name], join(key, name), message, hint)

    @contextmanager
    def of_unit(self, node: Marked, key: str) -> Iterator[None]:
        """A UnitError of the block becomes a fault of the entry *key*."""
        try:
            yield
        except UnitError as error:
            self.add(node, key, error.what, error.hint)

    def add_of_field(self, error: ConfigError, node: Marked, key: str) -> None:
        """A fault of a mapping's settings, at the entry that the error names, else at the mapping."""
        entry = node.content.get(error.field, node) if isinstance(node.content, dict) else node
        self.add(entry, join(key, error.field), error.what.removeprefix(f"{error.field}: "), error.hint)

    def add_missing_file(self, node: Marked, key: str) -> None:
        self.add(node, key, f"no such file '{node.text}'", "paths are relative to the file that names them")

    def merge(self, error: ConfigError) -> None:
        self._faults.extend(error.faults if isinstance(error, ConfigErrors) else [error])

    def unknown_keys(
        self, node: Marked, key: str, allowed: Iterable[str], meanings: Mapping[str, str] | None = None
    ) -> None:
        """A fault for every key not *allowed*, with the nearest, or the one whose meaning names it. One for
        all where hardly any key of a whole file is known: it is of another kind.
        """
        unknown = [name for name in node.content if name not in allowed]
        strange = [name for name in unknown if not difflib.get_close_matches(name, list(allowed), 1, TYPED)]
        if not key and len(strange) > max(FEW_UNKNOWN, len(node.content) // 2):
            what = f"{', '.join(strange[:FEW_UNKNOWN])} and {len(strange) - FEW_UNKNOWN} more: unknown keys"
            self.add(node, key, what, f"is this a file of another kind? known: {', '.join(allowed)}")
            return
        for name in unknown:
            hint = _suggest(name, allowed, meanings or {})
            self.add(node.content[name], join(key, name), "unknown key", hint)

    def mapping(self, node: Marked, key: str) -> dict[str, Marked]:
        """The entries of a mapping, or none and a fault when the node is something else."""
        if isinstance(node.content, dict):
            return node.content
        self.add(node, key, "a mapping of keys to values is needed")
        return {}

    def text(self, entries: Mapping[str, Marked], key: str, name: str) -> str:
        """The text of an entry *name* under *key*; none where it is not there, a fault where it has none."""
        if name in entries and not entries[name].text:
            self.add_at(entries, key, name, "a text is missing")
        return text_of(entries, name)

    def raise_any(self) -> None:
        if self._faults:
            raise ConfigErrors(self._faults)

    def __len__(self) -> int:
        return len(self._faults)


# Unknown keys of a file up to which each is named by itself.
FEW_UNKNOWN = 2
# Likeness from which an unknown key is a typing error; below it, its word in the meaning of a key says more.
TYPED = 0.75


def _suggest(name: str, allowed: Iterable[str], meanings: Mapping[str, str]) -> str:
    """The hint for an unknown key: one spelt nearly so, else the only one whose meaning begins so."""
    stem = name.lower().rstrip("s")
    by_meaning = [key for key, meaning in meanings.items() if meaning.lower().startswith(stem)]
    if len(stem) <= 3 or len(by_meaning) != 1 or difflib.get_close_matches(name, list(allowed), 1, TYPED):
        return nearest(name, allowed)
    return f"did you mean '{by_meaning[0]}' ({meanings[by_meaning[0]]})?"


def join(*keys: str) -> str:
    """The dotted key of an entry."""
    return ".".join(key for key in keys if key)


# From a YAML node to what the converters of settings take: texts with their units, whole numbers, flags,
# lists, mappings.

# Kinds whose scalars are read as YAML has them; of all others the text counts, so that a number without its
# unit is seen.
BY_CONTENT = ("integer", "flag")


def read_value(node: Marked, setting: Setting) -> Any:
    """The value of a node; UnitError where it is not of the setting's kind."""
    if setting.kind in ("text", "file") and isinstance(node.content, (str, int, float)) and not node.text:
        raise UnitError("a text is missing")
    return CONVERTERS[setting.kind](_plain(node, setting.kind in BY_CONTENT), setting)


def _plain(node: Marked, by_content: bool) -> Any:
    if by_content:
        return node.plain()
    if isinstance(node.content, dict):
        return {name: _plain(entry, False) for name, entry in node.content.items()}
    if isinstance(node.content, list):
        return [_plain(entry, False) for entry in node.content]
    return None if node.content is None else node.text


@dataclass(frozen=True)
class Reading:
    """A pass over a pipeline file; *names*: of sections read before, by which rules address them."""

    faults: Faults
    rig: Rig | None
    names: tuple[str, ...]


# Kinds of files that a settings file can name: how each is read, and which further files it depends on.
# FILE_KINDS by name.

FILE_KINDS = Registry("file kind")


# The content of a table or recording is read later, by those who know its columns.
PATH = FileKind(lambda path: path)


def named_files(settings: Any, folder: Path) -> Iterator[Path]:
    """Every file that settings and nested ones name, relative to *folder*, and the files of those."""
    for name, (setting, _) in settings_of(type(settings)).items():
        value = getattr(settings, name)
        if setting.kind == "file" and value:
            path = folder / value
            yield from FILE_KINDS[setting.file_kind].files(path) if setting.file_kind else (path,)
    for field in fields(settings):
        nested = getattr(settings, field.name)
        for part in nested if isinstance(nested, tuple) else (nested,):
            if is_dataclass(part) and not isinstance(part, type) and settings_of(type(part)):
                yield from named_files(part, folder)


Owner = TypeVar("Owner")

# Kinds of settings that may be given in the long form of a number with its uncertainty, and the entries of
# that form.
LONG_KINDS = ("value", "mass", "uncertain", "text")
SIZES = ("std", "limits", "expanded")
LONG_FORM = ("value", *SIZES, "shape", "k", "dof", "source")

# Placeholder of an entry that the user must fill in, as `labpipe init` writes it.
DECIDE = "DECIDE"


def read_settings(owner: type[Owner], node: Marked, key: str, faults: Faults, **presets: Any) -> Owner | None:
    """An instance of the settings dataclass *owner* from the mapping *node*; None and faults where it cannot
    be read. *presets*: fields that the file does not hold (a name, say), or defaults of missing entries.
    """
    before = len(faults)
    settings = settings_of(owner)
    node = _rename_keys(node, key, settings)
    entries = faults.mapping(node, key)
    if entries:
        meanings = {name: declared.help for name, (declared, _) in settings.items()}
        faults.unknown_keys(node, key, meanings, meanings)
    fields: dict[str, Any] = dict(presets)
    unread: set[str] = set()
    for name, (setting, required) in settings.items():
        count = len(faults)
        if name in entries:
            entry = shorten_number(entries[name], setting.kind)
            uncertain = takes_uncertainty(owner, setting) and is_uncertain(entry.text)
            read = _read_uncertain if uncertain else read_setting
            fields[name] = read(entry, setting, join(key, name), faults)
            if setting.into:
                fields[setting.into] = _content(entries[name], fields[name], setting, join(key, name), faults)
        elif required and name not in presets:
            faults.add(node, join(key, name), "is missing", setting.help)
        if len(faults) > count:
            unread |= {name, setting.into}
    readable = {name: value for name, value in fields.items() if name not in unread}
    instance = _instance(owner, readable, node, key, faults, unread)
    return instance if len(faults) == before else None


def _rename_keys(node: Marked, key: str, settings: Mapping[str, tuple[Setting, bool]]) -> Marked:
    if not isinstance(node.content, dict):
        return node
    new = {setting.before: name for name, (setting, _) in settings.items() if name not in node.content}
    names = {old: new[old] for old in node.content if old in new}
    for old, name in names.items():
        note = (
            f"{node.content[old].place}: {join(key, old)} is called '{name}' now; the old key is read in "
            "this version for the last time"
        )
        warnings.warn(note, FutureWarning, stacklevel=2)
    content = {names.get(name, name): entry for name, entry in node.content.items()}
    return replace(node, content=content) if names else node


def _instance(
    owner: type[Owner], fields: dict[str, Any], node: Marked, key: str, faults: Faults, unread: set[str]
) -> Owner | None:
    """The dataclass, or None and its faults; no second fault for unread entries."""
    declared = dataclasses.fields(owner)  # type: ignore[arg-type]
    if any(field.default is MISSING and field.name not in fields for field in declared):
        return None
    try:
        return owner(**fields)
    except ConfigError as error:
        # A complaint that names what could not be read would be one of the same fault.
        if not any(name and re.search(rf"\b{name}\b", f"{error.field} {error.what}") for name in unread):
            faults.add_of_field(error, node, key)
        return None


def read_kind(tree: Marked, key: str, kinds: Registry, word: str, faults: Faults) -> Any:
    """What the entry `kind` of a mapping names among *kinds*; None and a fault for none of them."""
    entries, known = faults.mapping(tree, key), kinds.names()
    if not (name := text_of(entries, "kind")):
        faults.add(tree, join(key, "kind"), "is missing", f"known: {', '.join(known)}")
    elif name in known:
        return kinds.load(name)
    else:
        faults.add_at(entries, key, "kind", f"unknown {word} '{name}'", nearest(name, known))
    return None


def shorten_number(node: Marked, kind: str = "value") -> Marked:
    """A number in its long form {value, std | limits | expanded, shape, k, dof, source} as its text."""
    if kind not in LONG_KINDS or not isinstance(node.content, dict) or "value" not in node.content:
        return node
    parts = {name: part.text for name, part in node.content.items()}
    sizes = [name for name in SIZES if name in parts]
    shape = parts.get("shape", "rectangular" if "limits" in parts else "")
    factors = ["k=1"] if "std" in parts and {"shape", "k"} & parts.keys() else []
    factors += [f"k={parts.get('k', '2')}"] if "expanded" in parts or "k" in parts else []
    # A second size, and what is unknown, are refused where the text is read.
    more = [name for name in parts if name in ("dof", "source", *sizes[1:]) or name not in LONG_FORM]
    qualities = [*filter(None, [shape]), *factors, *(f"{name}={parts[name]}" for name in more)]
    text = f"{parts['value']} +- {parts[sizes[0]] if sizes else ''}"
    text += f" ({', '.join(qualities)})" if qualities else ""
    return replace(node, content=text, text=text)


def _read_uncertain(node: Marked, setting: Setting, key: str, faults: Faults) -> str | None:
    with faults.of_unit(node, key):
        parse_uncertain(node.text, setting.unit)
        return node.text
    return None


def read_setting(node: Marked, setting: Setting, key: str, faults: Faults) -> Any:
    """One value of the setting's kind; None and a fault where it cannot be read or is still to be decided."""
    if node.text == DECIDE:
        faults.add(node, key, "is still to be decided", setting.help)
        return None
    if is_empty(node.content, setting):
        faults.add(node, key, *EMPTY)
        return None
    if setting.section is not None:
        if setting.kind == "section":
            return read_settings(setting.section, node, key, faults)
        before = len(faults)
        if setting.kind == "sections":
            named = [
                (name, read_settings(setting.section, entry, join(key, name), faults))
                for name, entry in faults.mapping(node, key).items()
            ]
            return None if len(faults) > before else tuple(named)
        if not isinstance(node.content, list):
            faults.add(node, key, "a list is needed", "each entry begins with '- '")
            return None
        listed = [
            read_settings(setting.section, entry, f"{key}.{number}", faults)
            for number, entry in enumerate(node.content, 1)
        ]
        return None if len(faults) > before else tuple(listed)
    with faults.of_unit(node, key):
        value = read_value(node, setting)
        if setting.kind != "file" or (faults.folder / value).is_file():
            return value
        faults.add_missing_file(node, key)
    return None


def _content(node: Marked, name: str | None, setting: Setting, key: str, faults: Faults) -> Any:
    try:
        return None if name is None else FILE_KINDS[setting.file_kind].load(faults.folder / name)
    except ConfigError as error:
        # A fault without a place of its own is reported at the entry that names the file.
        if error.where or isinstance(error, ConfigErrors):
            faults.merge(error)
        else:
            faults.add(node, key, error.what, error.hint)
    return None


def has_file(node: Marked, key: str, faults: Faults) -> bool:
    """Whether an entry is a name, as of a file; a fault where it is not."""
    if not node.text:
        faults.add(node, key, "a file name is needed")
    return bool(node.text)


def files_of(node: Marked, key: str, faults: Faults, *, elsewhere: bool = False) -> list[Path]:
    """The sorted files of a path or glob; a fault for none. *elsewhere*: URLs of objects may be."""
    if not has_file(node, key, faults):
        return []
    try:
        address = path_of(node.text)
    except ConfigError as error:
        faults.add(node, key, f"'{node.text}' {error.what}", error.hint)
        return []
    if is_remote(address):
        if elsewhere:
            return _objects(address, node, key, faults)
        hint = "recordings may be named by URL; copy this file here"
        faults.add(node, key, "is read from this machine only", hint)
        return []
    path = faults.folder / address
    if glob.has_magic(node.text):
        matches = sorted(Path(name) for name in glob.glob(str(path), recursive=True))
        if not matches:
            faults.add(node, key, f"no file matches '{node.text}'", "paths are relative to the pipeline file")
        return matches
    if not path.exists():
        faults.add_missing_file(node, key)
        return []
    return [path]


def _objects(address: Path, node: Marked, key: str, faults: Faults) -> list[Path]:
    """The objects that a URL names, as `files_of`; StorageError where the storage does not answer."""
    # Recordings of this machine are found without an object storage.
    from labpipe.artefacts.places import list_below, status

    if not glob.has_magic(str(address)):
        objects = [address] if status(address) else []
    else:
        plain = next(number for number, part in enumerate(address.parts) if glob.has_magic(part))
        folder, pattern = Path(*address.parts[:plain]), address.parts[plain:]
        paths = (there.path for there in list_below(folder))
        objects = [path for path in paths if glob_matches(path.parts[plain:], pattern)]
    if not objects:
        what = "no object matches" if glob.has_magic(node.text) else "no such object"
        hint = "names are those that the storage lists, capitals included"
        faults.add(node, key, f"{what} '{node.text}'", hint)
    return objects


def glob_matches(names: Sequence[str], pattern: Sequence[str]) -> bool:
    """Whether a path is of a glob, part by part: '**' is any folders, hidden ones as on a disk."""
    if not pattern or not names:
        return not names and all(part == "**" for part in pattern)
    hidden = names[0].startswith(".") and not pattern[0].startswith(".")
    if pattern[0] == "**":
        return glob_matches(names, pattern[1:]) or (not hidden and glob_matches(names[1:], pattern))
    return not hidden and fnmatchcase(names[0], pattern[0]) and glob_matches(names[1:], pattern[1:])


def plain_stem(path: Path) -> str:
    """The name of a file without its ending, nor that of its compression."""
    name = path.stem if path.suffix.lower() in (".gz", ".zst") else path.name
    return Path(name).stem.removesuffix(".frf").removesuffix(".recording")


def list_entries(node: Marked) -> list[Marked]:
    """The entries of a list, or the only entry."""
    return node.content if isinstance(node.content, list) else [node]


def conditions_in(name: str, pattern: str) -> dict[str, str] | None:
    """The conditions in a file's *name*: '427N-up' by '{preload}-{direction}' is preload 427N, direction up;
    None where it differs. '{}' is a part that is not a condition; one that stands twice is the same in both
    places.
    """
    expression, wanted = "", list[str]()
    for number, part in enumerate(re.split(r"\{(\w*)\}", pattern)):
        if number % 2 == 0:
            expression += re.escape(part)
        elif part in wanted:
            expression += f"(?:\\{wanted.index(part) + 1})"
        else:
            expression += "(.+?)" if part else ".+?"
            wanted += [part] if part else []
    match = re.fullmatch(expression, name)
    return None if match is None else dict(zip(wanted, match.groups(), strict=True))

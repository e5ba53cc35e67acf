"""Reading the entries under ``frfs:``: ready FRFs, in files that describe themselves or that the entry describes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from labpipe.config.faults import Faults, join
from labpipe.config.file_names import conditions_in, files_of, listed, plain_stem
from labpipe.config.reader import read_settings
from labpipe.marked_yaml import Marked
from labpipe.records.frf_layout import FrfLayout


@dataclass(frozen=True)
class ReadyFrf:
    """Files of one ready FRF matrix: one file, or one for each element, row or column.

    *layout* describes files that do not describe themselves; *outputs*, *inputs*: of every file the dofs that its name or the entry gives.
    """

    paths: tuple[Path, ...]
    layout: FrfLayout | None = None
    outputs: tuple[tuple[str, ...], ...] = ()
    inputs: tuple[tuple[str, ...], ...] = ()

    @property
    def name(self) -> str:
        """What the names of the files have in common."""
        stems = [path.stem for path in self.paths]
        common = next((n for n, letters in enumerate(zip(*stems, strict=False)) if len(set(letters)) > 1), min(map(len, stems)))
        return stems[0][:common].strip("-_ .") or stems[0]

    def absolute(self) -> ReadyFrf:
        """The same for a process that works in another folder."""
        return dataclasses.replace(self, paths=tuple(path.absolute() for path in self.paths))


def read_ready_frfs(node: Marked, key: str, faults: Faults) -> list[ReadyFrf]:
    """The responses of the entry *key*: a file, a description, or a list of them; faults for those that cannot be read."""
    frfs: list[ReadyFrf] = []
    for entry in listed(node):
        if isinstance(entry.content, dict):
            frfs.extend(_described(entry, key, faults))
        else:
            frfs.extend(ReadyFrf((path,)) for path in files_of(entry, key, faults))
    return frfs


def _described(node: Marked, key: str, faults: Faults) -> list[ReadyFrf]:
    """The response of an entry with `each:`, or the responses of the files that `file:` names."""
    layout = read_settings(FrfLayout, node, key, faults)
    if layout is None:
        return []
    files: list[tuple[Path, ...]]
    if layout.file:
        files = [(path,) for path in files_of(node.content["file"], join(key, "file"), faults)]
    else:
        files = [tuple(path for item in listed(node.content["each"]) for path in files_of(item, join(key, "each"), faults))]
    frfs = []
    for paths in filter(None, files):
        before = len(faults)
        # Files of one pattern do not match it alike; the first says so.
        dofs = [_dofs(path, layout, node, key, faults) for path in paths if len(faults) == before]
        outputs, inputs = zip(*dofs, strict=True)
        if layout.table is not None:
            for word, names in (("output", outputs[0]), ("input", inputs[0])):
                _check_dofs(word, names, layout, node, key, faults)
        frfs.append(ReadyFrf(paths, layout, outputs, inputs))
    return frfs


def _dofs(path: Path, layout: FrfLayout, node: Marked, key: str, faults: Faults) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The dofs of a file's rows and columns: from its name, else from the entry."""
    named = _named(path, layout, node, key, faults) if layout.pattern else {}
    outputs = (named["output"],) if "output" in named else layout.output
    inputs = (named["input"],) if "input" in named else layout.input
    return outputs, inputs


def _named(path: Path, layout: FrfLayout, node: Marked, key: str, faults: Faults) -> dict[str, str]:
    """The dofs in a file's name."""
    matched = conditions_in(plain_stem(path), layout.pattern)
    if matched is not None and set(matched) <= {"output", "input"}:
        return matched
    what = f"does not match '{plain_stem(path)}'" if matched is None else "holds more than {output} and {input}"
    faults.add(node.content["pattern"], join(key, "pattern"), what, "for example 'H_{output}_{input}'; {} stands for any other part")
    return {"output": "?", "input": "?"}


def _check_dofs(word: str, names: tuple[str, ...], layout: FrfLayout, node: Marked, key: str, faults: Faults) -> None:
    """A fault where the dofs of a described file are not as many as its description needs."""
    assert layout.table is not None
    # An element named o/i has both dofs, one named o has its input from the entry.
    has_all = bool(layout.elements) and (word == "output" or all("/" in name for name, _ in layout.elements))
    if not names and not has_all:
        hint = f"name the dof, or its place in the files' names by pattern: '{{{word}}}'"
        faults.add(node, join(key, word), "is missing", hint)
    elif len(names) > 1 and not layout.table.matrix:
        faults.add(node.content[word], join(key, word), "one dof is needed", "several are the rows or columns of a matrix")

"""The commands that the pages show: found, run, and compared with the output that stands below them.

A block of the language `console` holds commands behind "$ " and, where it shows them, the lines that they
print; a line "..." stands for any lines. A comment ahead of the block says what differs: `<!-- test: parse
-->` only reads the options (a cluster, minutes of work), `<!-- test: --set study.repeats=2 -->` adds options,
`<!-- test: exit 1 -->` is another exit code than 0 (options may follow), `<!-- test: with-plugin -->` needs
the plug-in of docs/plugin.

    python docs/console.py PAGE...      write the output of the commands, run in a scratch copy, into the
    pages
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

DOCS = Path(__file__).parent
ROOT = DOCS.parent
PAGES = DOCS / "pages"
BLOCK = re.compile(r"(?:<!-- test: (?P<how>[^\n]*?) -->\n)?```console\n(?P<text>.*?)```", re.DOTALL)
ANY = "..."
PLUGIN = "with-plugin"
# Numbers may differ by this between machines.
ALIKE = 0.02


@dataclass(frozen=True)
class Command:
    """One command of a page: its words, the lines shown below it, its exit code, and options that only the
    test adds.
    """

    words: tuple[str, ...]
    shown: tuple[str, ...] = ()
    code: int = 0
    added: tuple[str, ...] = ()
    parse_only: bool = False
    plugin: bool = False


def commands(text: str) -> Iterator[Command]:
    """The commands of a page in their order."""
    for block in BLOCK.finditer(text):
        how = block["how"] or ""
        parts = re.split(r"^\$ ", block["text"], flags=re.MULTILINE)[1:]
        for part in parts:
            line, *shown = part.rstrip("\n").replace("\\\n", " ").split("\n")
            shown = [one for one in shown if one.strip()]
            made = Command(
                tuple(shlex.split(line)), tuple(shown), 2 if shown and shown[0].startswith("error") else 0
            )
            yield _as_told(made, shlex.split(how))


def _as_told(command: Command, how: list[str]) -> Command:
    """The command with what the comment ahead of its block says."""
    if how[:1] == ["exit"]:
        command, how = replace(command, code=int(how[1])), how[2:]
    if how[:1] == ["parse"]:
        return replace(command, parse_only=True)
    if how[:1] == [PLUGIN]:
        return replace(command, plugin=True)
    return replace(command, added=tuple(how))


def scratch(folder: Path) -> None:
    """Make *folder* what the pages take for the checkout: pipelines, configs and plug-in copied, sample data
    linked.
    """
    for name in ("pipelines", "configs"):
        shutil.copytree(ROOT / name, folder / name)
    shutil.copytree(DOCS / "plugin", folder / "docs/plugin")
    (folder / "sample_data").symlink_to(ROOT / "sample_data")
    _install(folder / "docs/plugin")


def _install(plugin: Path) -> None:
    """What installing the plug-in leaves beside its modules: its name and its entry points."""
    project = tomllib.loads((plugin / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = plugin / "src" / f"labpipe_example-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n", encoding="utf-8"
    )
    groups = [(group, entries.items()) for group, entries in project["entry-points"].items()]
    lines = [
        line
        for group, entries in groups
        for line in (f"[{group}]", *(f"{name} = {target}" for name, target in entries))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def run(command: Command) -> tuple[int, str]:
    """(exit code, what it printed) of a command, run here; one that is only parsed ends with 0.

    With the plug-in, and other programs than labpipe, run in a process of their own: tables of choices are
    looked up once.
    """
    from labpipe.cli.main import COMMANDS, run_command

    program, *words = command.words
    assert program in ("labpipe", "python"), command
    if program == "python" or command.plugin:
        start = ["-m", "labpipe"] if program == "labpipe" else []
        path = os.pathsep.join(
            [str(Path("docs/plugin/src").resolve()), *filter(None, [os.environ.get("PYTHONPATH")])]
        )
        full = [sys.executable, *start, *words]
        ended = subprocess.run(
            full, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path}
        )
        return ended.returncode, ended.stdout + ended.stderr
    if command.parse_only:
        COMMANDS[words[0]].make_context(words[0], list(words[1:]))
        return 0, ""
    stream = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
    with contextlib.redirect_stdout(stream), contextlib.redirect_stderr(stream):
        code = run_command([*words, *command.added])
    stream.seek(0)
    return code, stream.read()


def without_report(command: Command) -> Command:
    """A run whose report the page does not show, without the report: that is most of the time."""
    shows_report = any("report." in line for line in command.shown)
    if command.words[1:2] != ("run",) or shows_report or command.parse_only or command.code == 2:
        return command
    return replace(command, added=(*command.added, "--set", "report.formats=[]"))


def differs(shown: tuple[str, ...], printed: str) -> str:
    """What is shown but was not printed; '' where all is as shown."""
    left = [line for line in printed.splitlines() if line.strip()]
    free = False
    for line in shown:
        if line.strip() == ANY:
            free = True
            continue
        while free and left and not _alike(line, left[0]):
            left.pop(0)
        if not left or not _alike(line, left.pop(0)):
            return line
        free = False
    return "" if free or not left or not shown else f"(no more lines), but {left[0]}"


def _alike(one: str, other: str) -> bool:
    first, second = one.split(), other.split()
    cut = bool(first) and first[-1] == ANY
    if cut:
        first, second = first[:-1], second[: len(first) - 1]
    return len(first) == len(second) and all(map(_same_word, first, second))


def _same_word(one: str, other: str) -> bool:
    if one == other:
        return True
    try:
        return (
            abs(float(one.rstrip(",);")) - float(other.rstrip(",);")))
            <= ALIKE * abs(float(other.rstrip(",);"))) + 1e-12
        )
    except ValueError:
        return False


def written(text: str) -> str:
    """The page with the output of its commands below them.

    Blocks that show none, or parts ("..."), stay as they are.
    """

    def block(found: re.Match[str]) -> str:
        page = found[0]
        for command in commands(found[0]):
            code, printed = run(command)
            said = differs(command.shown, printed)
            if code != command.code or said:
                print(
                    f"exit {code}: {shlex.join(command.words)}\n  shown: {said}\n{printed}", file=sys.stderr
                )
            if command.shown and said and ANY not in "\n".join(command.shown):
                lines = [line.rstrip() for line in printed.splitlines() if line.strip()]
                page = page.replace("\n".join(command.shown) + "\n", "\n".join(lines) + "\n", 1)
        return page

    return BLOCK.sub(block, text)


def main(pages: list[str]) -> None:
    for page in pages:
        path = Path(page).resolve()
        with tempfile.TemporaryDirectory() as folder:
            scratch(Path(folder))
            os.chdir(folder)
            path.write_text(written(path.read_text(encoding="utf-8")), encoding="utf-8")
            os.chdir(ROOT)


if __name__ == "__main__":
    main(sys.argv[1:])
